"""Photos laid upon each other, pixel by pixel, in Numba."""

import numpy as np
from numba import prange

from ..jit import kernel


@kernel(parallel=True)
def left_unexplained(points, photos, starts, asked, turns, shifts, lenses, images, most):
    """What photos of one state leave unexplained of those of another, summed over each group of pixels (G).

    A group has a brightness and a contrast of its own; what is unexplained of a pixel counts as at most `most`.

    points (P 3): what pixels of the other state's photos show, in the world; photos (P): which one of the images shows
    it, the same throughout a group; starts (G + 1): where groups begin, and P; asked (P): brightness, less its mean over the
    group; turns (V 3 3), shifts (V 3), lenses (V 4: fx fy cx cy): from the world to the images' pixels; images (V H W):
    brightness.
    """
    H, W = images.shape[1:]
    G = len(starts) - 1
    left = np.zeros(G)
    seen = np.empty(len(points), np.float32)
    for g in prange(G):
        first, last = starts[g], starts[g + 1]
        v = photos[first]
        image, lens, turn, shift = images[v], lenses[v], turns[v], shifts[v]
        total = squares = products = 0.0
        for i in range(first, last):
            a, b, c = points[i, 0], points[i, 1], points[i, 2]
            x = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c + shift[0]
            y = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c + shift[1]
            z = max(turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c + shift[2], 1e-9)
            column = min(max(lens[0] * x / z + lens[2] - 0.5, 0.0), W - 1.0)
            row = min(max(lens[1] * y / z + lens[3] - 0.5, 0.0), H - 1.0)
            j, k = min(int(row), H - 2), min(int(column), W - 2)
            down, right = row - j, column - k
            upper = image[j, k] + right * (image[j, k + 1] - image[j, k])
            lower = image[j + 1, k] + right * (image[j + 1, k + 1] - image[j + 1, k])
            value = upper + down * (lower - upper)
            seen[i] = value
            total += value
            squares += value * value
            products += value * asked[i]
        count = last - first
        mean = total / count
        varied = max(squares / count - mean * mean, 1e-12)
        contrast = min(max(products / count / varied, 0.5), 2.0)
        over = max(contrast, 1.0)
        for i in range(first, last):
            left[g] += min(abs(asked[i] - contrast * (seen[i] - mean)) / over, most)
    return left

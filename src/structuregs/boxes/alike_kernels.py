"""Photos laid upon each other, pixel by pixel, in Numba."""

import numpy as np
from numba import prange

from ..jit import kernel


@kernel(parallel=True)
def left_unexplained(points, photos, starts, asked, projections, images, most):
    """What photos of one state leave unexplained of those of another, summed over each group of pixels (G).

    A group has a brightness and a contrast of its own; what is unexplained of a pixel counts as at most `most`.

    points (P 3): what pixels of the other state's photos show, in the world; photos (P): which one of the images shows
    it, the same throughout a group; starts (G + 1): where groups begin, and P; asked (P): brightness, less its mean over the
    group; projections (V 3 4): from the world to the images' pixels; images (V H W): brightness.
    """
    H, W = images.shape[1:]
    G = len(starts) - 1
    left = np.zeros(G)
    seen = np.empty(len(points), np.float32)
    for g in prange(G):
        first, last = starts[g], starts[g + 1]
        image, P = images[photos[first]], projections[photos[first]]
        total = squares = products = 0.0
        for i in range(first, last):
            a, b, c = points[i, 0], points[i, 1], points[i, 2]
            x = P[0, 0] * a + P[0, 1] * b + P[0, 2] * c + P[0, 3]
            y = P[1, 0] * a + P[1, 1] * b + P[1, 2] * c + P[1, 3]
            z = max(P[2, 0] * a + P[2, 1] * b + P[2, 2] * c + P[2, 3], 1e-9)
            column = min(max(x / z - 0.5, 0.0), W - 1.0)
            row = min(max(y / z - 0.5, 0.0), H - 1.0)
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

"""The image loss in Numba: value and gradient in one go.

The image is cut into rectangles.  A rectangle and what its windows reach is copied into zero-padded scratch memory; SSIM's
derivatives by the blurred images are formed on it and blurred back.  The window is symmetric, so the adjoint of a blur with
zeros outside the image is the same blur.  A rectangle with nothing but agreement within reach (most of an image of one
object over a plain background) has SSIM 1 and no gradient, and is left out.

Colour images come as (H, 3 W): three channels side by side, so that a step of one pixel along a row is three values.
"""

import math

import numpy as np
from numba import prange

from ..jit import kernel

ROWS, COLUMNS = 48, 96  # of a rectangle, pixels
HALF = 5  # of the 11 x 11 window, pixels
_STEP = 3
_REACH = HALF * _STEP  # values that the window reaches to each side along a row
_MASS = sum(math.exp(-0.5 * (k / 1.5) ** 2) for k in range(-HALF, HALF + 1))
_WEIGHTS = tuple(np.float32(math.exp(-0.5 * (k / 1.5) ** 2) / _MASS) for k in range(-HALF, 1))  # sigma 1.5 pixels
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)


@kernel()
def _sum(values, n):
    total = 0.0
    for x in range(n):
        total += values[x]
    return total


@kernel()
def _absolute(image, target, y0, y1, x0, x1, weight, gradient, columns):
    """Sum of |image - target| in a rectangle; sets the gradient to weight times the sign.  Columns is scratch memory."""
    columns[: x1 - x0] = _ZERO
    for y in range(y0, y1):
        a, b, g = image[y, x0:x1], target[y, x0:x1], gradient[y, x0:x1]
        for x in range(x1 - x0):
            d = a[x] - b[x]
            columns[x] += abs(d)
            g[x] = (weight if d > _ZERO else _ZERO) - (weight if d < _ZERO else _ZERO)
    return _sum(columns, x1 - x0)


@kernel()
def _agree(image, target, y0, y1, x0, x1):
    """Whether two images are the same in a rectangle, cut to the images."""
    x0, x1 = max(x0, 0), min(x1, image.shape[1])
    for y in range(max(y0, 0), min(y1, image.shape[0])):
        a, b = image[y, x0:x1], target[y, x0:x1]
        different = np.int32(0)
        for x in range(x1 - x0):
            different += np.int32(1) if a[x] != b[x] else np.int32(0)
        if different > 0:
            return False
    return True


@kernel()
def _load(source, y0, x0, rows, columns, out):
    """Copies rows and columns of an image that begin at y0, x0; zeros outside the image."""
    height, width = source.shape
    first, last = max(0, -x0), max(0, min(columns, width - x0))
    for y in range(rows):
        row = out[y]
        row[:first] = _ZERO
        row[last:columns] = _ZERO
        if 0 <= y + y0 < height:
            a, b = source[y + y0, x0 + first : x0 + last], row[first:last]
            for x in range(last - first):
                b[x] = a[x]
        else:
            row[first:last] = _ZERO


@kernel()
def _vertical(a, b, y, n, sums):
    """Fills sums (4 n) with the window's sums down the columns from row y on: a, b, a^2 + b^2, a b."""
    for x in range(n):
        u, v = a[y + HALF, x], b[y + HALF, x]
        w = _WEIGHTS[HALF]
        sa, sb, sq, sp = w * u, w * v, w * (u * u + v * v), w * (u * v)
        for k in range(HALF):
            u, v, p, q = a[y + k, x], b[y + k, x], a[y + 2 * HALF - k, x], b[y + 2 * HALF - k, x]
            w = _WEIGHTS[k]
            sa += w * (u + p)
            sb += w * (v + q)
            sq += w * (u * u + v * v + p * p + q * q)
            sp += w * (u * v + p * q)
        sums[0, x], sums[1, x], sums[2, x], sums[3, x] = sa, sb, sq, sp


@kernel()
def _along(source, n, out):
    """The window's sums along a row, for n places."""
    for x in range(n):
        total = _WEIGHTS[HALF] * source[x + _REACH]
        for k in range(HALF):
            total += _WEIGHTS[k] * (source[x + _STEP * k] + source[x + _STEP * (2 * HALF - k)])
        out[x] = total


@kernel()
def _down(source, y, n, out):
    """The window's sums down the columns from row y on, for n places."""
    for x in range(n):
        total = _WEIGHTS[HALF] * source[y + HALF, x]
        for k in range(HALF):
            total += _WEIGHTS[k] * (source[y + k, x] + source[y + 2 * HALF - k, x])
        out[x] = total


@kernel()
def _derivatives(maps, n):
    """In place: blurred a, b, a^2 + b^2, a b to SSIM's derivatives by the first, third and fourth of them, and SSIM."""
    for x in range(n):
        ma, mb, mq, mp = maps[0, x], maps[1, x], maps[2, x], maps[3, x]
        square, product = ma * ma + mb * mb, ma * mb
        a1, a2 = _TWO * product + _C1, _TWO * (mp - product) + _C2
        inverse_1, inverse_2 = _ONE / (square + _C1), _ONE / (mq - square + _C2)
        both = inverse_1 * inverse_2
        s = a1 * a2 * both
        maps[0, x] = _TWO * (mb * (a2 - a1) * both - s * ma * (inverse_1 - inverse_2))
        maps[1, x] = -s * inverse_2
        maps[2, x] = _TWO * a1 * both
        maps[3, x] = s


@kernel()
def _add_gradient(maps, a, b, weight, n, out):
    for x in range(n):
        out[x] += weight * (maps[0, x] + _TWO * a[x] * maps[1, x] + b[x] * maps[2, x])


@kernel()
def _ssim(image, target, y0, y1, x0, x1, weight, gradient, a, b, blurred, sums, maps, columns):
    """Sum of 1 - SSIM in a rectangle; adds weight times its gradient.  The last six arguments are scratch memory."""
    height, width = image.shape
    rows, n = y1 - y0, x1 - x0
    if _agree(image, target, y0 - 2 * HALF, y1 + 2 * HALF, x0 - 2 * _REACH, x1 + 2 * _REACH):
        return 0.0
    _load(image, y0 - 2 * HALF, x0 - 2 * _REACH, rows + 4 * HALF, n + 4 * _REACH, a)
    _load(target, y0 - 2 * HALF, x0 - 2 * _REACH, rows + 4 * HALF, n + 4 * _REACH, b)
    columns[:n] = _ZERO
    first, last = max(0, _REACH - x0), min(n + 2 * _REACH, width - x0 + _REACH)
    for y in range(rows + 2 * HALF):
        if not 0 <= y + y0 - HALF < height:
            blurred[:, y, :n] = _ZERO
            continue
        _vertical(a, b, y, n + 4 * _REACH, sums)
        for q in range(4):
            _along(sums[q], n + 2 * _REACH, maps[q])
        _derivatives(maps, n + 2 * _REACH)
        if HALF <= y < rows + HALF:
            for x in range(n):
                columns[x] += _ONE - maps[3, x + _REACH]
        for q in range(3):
            maps[q, :first] = _ZERO
            maps[q, last : n + 2 * _REACH] = _ZERO
            _along(maps[q], n, blurred[q, y])
    for y in range(rows):
        for q in range(3):
            _down(blurred[q], y, n, maps[q])
        a_row, b_row = a[y + 2 * HALF, 2 * _REACH :], b[y + 2 * HALF, 2 * _REACH :]
        _add_gradient(maps, a_row, b_row, -weight, n, gradient[y + y0, x0:x1])
    return _sum(columns, n)


@kernel(parallel=True)
def loss_and_gradient(image, target, alpha, target_alpha, weights, lanes, g_image, g_alpha, parts):
    """Fills the gradients and parts (rectangles 3): sums of |colour difference|, 1 - SSIM, |alpha difference|.

    Args:
        image: (H, 3 W), as target and g_image.
        target: what the image should be.
        alpha: (H, W), as target_alpha and g_alpha.
        target_alpha: what alpha should be.
        weights: of the three sums in the loss; without a weight SSIM is left out and its sum is 0.
        lanes: threads.
        g_image: output.
        g_alpha: output.
        parts: output, (ceil(H / ROWS) * ceil(W / COLUMNS), 3).
    """
    height, width = alpha.shape
    across = (width + COLUMNS - 1) // COLUMNS
    for lane in prange(lanes):
        n = COLUMNS * _STEP
        a = np.empty((ROWS + 4 * HALF, n + 4 * _REACH), np.float32)
        b = np.empty_like(a)
        blurred = np.empty((3, ROWS + 2 * HALF, n), np.float32)
        sums, maps = np.empty((4, n + 4 * _REACH), np.float32), np.empty((4, n + 2 * _REACH), np.float32)
        columns = np.empty(n, np.float32)
        for job in range(lane, len(parts), lanes):
            y0, x0 = job // across * ROWS, job % across * COLUMNS
            y1, x1 = min(y0 + ROWS, height), min(x0 + COLUMNS, width)
            parts[job, 0] = _absolute(image, target, y0, y1, x0 * _STEP, x1 * _STEP, weights[0], g_image, columns)
            parts[job, 2] = _absolute(alpha, target_alpha, y0, y1, x0, x1, weights[2], g_alpha, columns)
            parts[job, 1] = 0.0
            if weights[1] != 0:
                parts[job, 1] = _ssim(
                    image, target, y0, y1, x0 * _STEP, x1 * _STEP, weights[1], g_image, a, b, blurred, sums, maps, columns
                )  # fmt: skip

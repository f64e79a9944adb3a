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

from .jit import kernel

ROWS, COLUMNS = 64, 128  # of a rectangle, pixels
HALF = 5  # of the 11 x 11 window, pixels
_STEP = 3
_REACH = HALF * _STEP  # values that the window reaches to each side along a row
_MASS = sum(math.exp(-0.5 * (k / 1.5) ** 2) for k in range(-HALF, HALF + 1))
_WEIGHTS = tuple(np.float32(math.exp(-0.5 * (k / 1.5) ** 2) / _MASS) for k in range(-HALF, 1))  # sigma 1.5 pixels
_C1, _C2 = np.float32(0.01**2), np.float32(0.03**2)
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)


@kernel()
def _absolute(image, target, y0, y1, x0, x1, weight, gradient):
    """Sum of |image - target| in a rectangle; sets the gradient to weight times the sign."""
    total = 0.0
    for y in range(y0, y1):
        row = _ZERO
        for x in range(x0, x1):
            d = image[y, x] - target[y, x]
            row += abs(d)
            gradient[y, x] = (weight if d > _ZERO else _ZERO) - (weight if d < _ZERO else _ZERO)
        total += row
    return total


@kernel()
def _load(source, y0, x0, rows, columns, out):
    """Copies rows and columns of an image that begin at y0, x0; zeros outside the image."""
    height, width = source.shape
    first, last = max(0, -x0), max(0, min(columns, width - x0))
    for y in range(rows):
        if 0 <= y + y0 < height:
            out[y, :first] = _ZERO
            for x in range(first, last):
                out[y, x] = source[y + y0, x + x0]
            out[y, last:columns] = _ZERO
        else:
            out[y, :columns] = _ZERO


@kernel()
def _agree(a, b, rows, columns):
    for y in range(rows):
        different = np.int32(0)
        for x in range(columns):
            different += np.int32(1) if a[y, x] != b[y, x] else np.int32(0)
        if different > 0:
            return False
    return True


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
def _along(values, q, x):
    """The window's sum along row q of values, from position x on."""
    total = _WEIGHTS[HALF] * values[q, x + _REACH]
    for k in range(HALF):
        total += _WEIGHTS[k] * (values[q, x + _STEP * k] + values[q, x + _STEP * (2 * HALF - k)])
    return total


@kernel()
def _derivatives(sums, first, last, n, out, ssim):
    """SSIM of a row, and out (3 n): its derivatives by the mean of a, the mean of a^2 + b^2 and the mean of a b.

    Zero outside [first, last), the part of the row on the image.
    """
    for x in range(n):
        ma, mb, mq, mp = _along(sums, 0, x), _along(sums, 1, x), _along(sums, 2, x), _along(sums, 3, x)
        square, product = ma * ma + mb * mb, ma * mb
        a1, a2 = _TWO * product + _C1, _TWO * (mp - product) + _C2
        inverse_1, inverse_2 = _ONE / (square + _C1), _ONE / (mq - square + _C2)
        both = inverse_1 * inverse_2
        s = a1 * a2 * both
        ssim[x] = s
        out[0, x] = _TWO * (mb * (a2 - a1) * both - s * ma * (inverse_1 - inverse_2))
        out[1, x] = -s * inverse_2
        out[2, x] = _TWO * a1 * both
    for q in range(3):
        out[q, :first] = _ZERO
        out[q, last:n] = _ZERO


@kernel()
def _gradient_row(blurred, y, a, b, n, weight, out):
    """Adds weight times SSIM's gradient on one row to out."""
    for x in range(n):
        w = _WEIGHTS[HALF]
        g0, g1, g2 = w * blurred[y + HALF, 0, x], w * blurred[y + HALF, 1, x], w * blurred[y + HALF, 2, x]
        for k in range(HALF):
            w, m = _WEIGHTS[k], 2 * HALF - k
            g0 += w * (blurred[y + k, 0, x] + blurred[y + m, 0, x])
            g1 += w * (blurred[y + k, 1, x] + blurred[y + m, 1, x])
            g2 += w * (blurred[y + k, 2, x] + blurred[y + m, 2, x])
        out[x] += weight * (g0 + _TWO * a[x] * g1 + b[x] * g2)


@kernel()
def _ssim(image, target, y0, y1, x0, x1, weight, gradient, a, b, blurred, sums, row):
    """Sum of 1 - SSIM in a rectangle; adds weight times its gradient.  The last five arguments are scratch memory."""
    height, width = image.shape
    rows, n = y1 - y0, x1 - x0
    _load(image, y0 - 2 * HALF, x0 - 2 * _REACH, rows + 4 * HALF, n + 4 * _REACH, a)
    _load(target, y0 - 2 * HALF, x0 - 2 * _REACH, rows + 4 * HALF, n + 4 * _REACH, b)
    if _agree(a, b, rows + 4 * HALF, n + 4 * _REACH):
        return 0.0
    total = 0.0
    first, last = max(0, _REACH - x0), min(n + 2 * _REACH, width - x0 + _REACH)
    for y in range(rows + 2 * HALF):
        if not 0 <= y + y0 - HALF < height:
            blurred[y, :, :n] = _ZERO
            continue
        _vertical(a, b, y, n + 4 * _REACH, sums)
        _derivatives(sums, first, last, n + 2 * _REACH, row[:3], row[3])
        if HALF <= y < rows + HALF:
            part = _ZERO
            for x in range(n):
                part += _ONE - row[3, x + _REACH]
            total += part
        for q in range(3):
            for x in range(n):
                blurred[y, q, x] = _along(row, q, x)
    for y in range(rows):
        a_row, b_row = a[y + 2 * HALF, 2 * _REACH :], b[y + 2 * HALF, 2 * _REACH :]
        _gradient_row(blurred, y, a_row, b_row, n, -weight, gradient[y + y0, x0:x1])
    return total


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
        blurred = np.empty((ROWS + 2 * HALF, 3, n), np.float32)
        sums, row = np.empty((4, n + 4 * _REACH), np.float32), np.empty((4, n + 2 * _REACH), np.float32)
        for job in range(lane, len(parts), lanes):
            y0, x0 = job // across * ROWS, job % across * COLUMNS
            y1, x1 = min(y0 + ROWS, height), min(x0 + COLUMNS, width)
            parts[job, 0] = _absolute(image, target, y0, y1, x0 * _STEP, x1 * _STEP, weights[0], g_image)
            parts[job, 2] = _absolute(alpha, target_alpha, y0, y1, x0, x1, weights[2], g_alpha)
            parts[job, 1] = 0.0
            if weights[1] != 0:
                parts[job, 1] = _ssim(
                    image, target, y0, y1, x0 * _STEP, x1 * _STEP, weights[1], g_image, a, b, blurred, sums, row
                )  # fmt: skip

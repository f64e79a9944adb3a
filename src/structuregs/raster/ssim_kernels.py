"""The image loss in Numba: value and gradient in one sweep down the image.

Images are cut into blocks of columns.  A block is swept row by row: the window's vertical sums are formed from the images,
filtered along the row, and turned into SSIM's value and its derivatives by the blurred quantities; those derivatives wait in
a ring of eleven rows, the last of which is filtered back to give the gradient of one row.  The window is symmetric, so the
adjoint of a blur with zeros outside the image is the same blur.
"""

import numpy as np
from numba import prange

from .jit import kernel

BLOCK = 64  # columns that one job writes
BAND = 80  # rows that one job writes
TAPS = 11
HALF = TAPS // 2
_REACH = 3 * HALF  # floats to the left or right that the window reaches: three channels side by side
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)


@kernel()
def _same(image, target, y0, y1, x0, x1):
    """Whether image and target agree in a rectangle, cut to the image."""
    for y in range(max(y0, 0), min(y1, image.shape[0])):
        differences = np.int32(0)
        for x in range(max(x0, 0), min(x1, image.shape[1])):
            differences += np.int32(1) if image[y, x] != target[y, x] else np.int32(0)
        if differences:
            return False
    return True


@kernel()
def _vertical(image, target, weights, y, x0, x1, rows):
    """Fills rows (4 n): the window's vertical sums at row y of image, target, sum of squares, product; columns x0 to x1."""
    height = image.shape[0]
    n = x1 - x0
    for q in range(4):
        for x in range(n):
            rows[q, _REACH + x] = _ZERO
    for k in range(max(0, HALF - y), min(TAPS, height + HALF - y)):
        w = weights[k]
        a_row, b_row = image[y + k - HALF], target[y + k - HALF]
        for x in range(n):
            a, b = a_row[x0 + x], b_row[x0 + x]
            rows[0, _REACH + x] += w * a
            rows[1, _REACH + x] += w * b
            rows[2, _REACH + x] += w * (a * a + b * b)
            rows[3, _REACH + x] += w * (a * b)

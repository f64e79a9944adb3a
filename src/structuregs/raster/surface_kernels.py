"""The depth of splats' surface in Numba."""

import math

import numpy as np
from numba import prange

from ..jit import fast_exp2, kernel
from .blend_kernels import TILE
from .records import MAX_ALPHA, MIN_ALPHA

_MAX_ALPHA, _MIN_ALPHA = np.float32(MAX_ALPHA), np.float32(MIN_ALPHA)
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_LEFT = np.float32(0.4)  # of a pixel's light at the surface
_LOWEST = np.float32(math.log2(MIN_ALPHA) - 0.01)
_TINY = np.float32(1e-6)


@kernel(parallel=True)
def surface_forward(starts, splats, drawing, planes, lanes, depth, image):
    """Fills depth (H W), 0 where more than `_LEFT` of the light comes through, and image (H W 3), the mean colour up to there.

    starts, splats: tile lists; drawing: see `pack`; planes (N 3): change of a splat's depth per pixel to the right and
    down, and its deviation; lanes: threads, over which neighbouring tiles are dealt out.
    """
    height, width = depth.shape
    across, tiles = (width + TILE - 1) // TILE, len(starts) - 1
    share = (tiles + lanes - 1) // lanes
    for job in prange(share * lanes):
        tile = (job % share) * lanes + job // share
        if tile < tiles:
            x0, y0 = (tile % across) * TILE, (tile // across) * TILE
            for row in range(y0, min(y0 + TILE, height)):
                for col in range(x0, min(x0 + TILE, width)):
                    _pixel(col, row, starts[tile], starts[tile + 1], splats, drawing, planes, depth, image)


@kernel(inline=False)
def _pixel(col, row, first, past, splats, drawing, planes, depth, image):
    through, r, g, b = _ONE, _ZERO, _ZERO, _ZERO
    depth[row, col] = _ZERO
    for k in range(first, past):
        s = drawing[splats[k]]
        dx, dy = s[0] - np.float32(col), s[1] - np.float32(row)
        power = s[5] + dx * (s[2] * dx + s[3] * dy) + s[4] * dy * dy
        if power < _LOWEST:
            continue
        alpha = min(fast_exp2(min(power, _ZERO)), _MAX_ALPHA)
        if alpha < _MIN_ALPHA:
            continue
        weight = alpha * through
        r += weight * s[6]
        g += weight * s[7]
        b += weight * s[8]
        if through - weight < _LEFT:
            # The share of this splat that brings the light down so far is reached before its middle.
            plane = planes[splats[k]]
            early = np.float32(math.sqrt(_TWO * np.float32(math.log(weight / max(through - _LEFT, _TINY)))))
            depth[row, col] = s[9] - plane[0] * dx - plane[1] * dy - plane[2] * early
            through -= weight
            break
        through -= weight
    covered = max(_ONE - through, _TINY)
    image[row, col, 0], image[row, col, 1], image[row, col, 2] = r / covered, g / covered, b / covered

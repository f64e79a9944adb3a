"""The planarity loss on the CPU: value and gradient in one go, in Numba and float32, held against plain torch by tests.

Every pixel looks at its partners on both sides, along its row and its column: each thread writes to rows of its own.
"""

import math

import numpy as np
from numba import prange

from ..jit import fast_exp2, kernel

_LOG2_E = math.log2(math.e)
_LOWEST = np.float32(-120)
_ZERO, _ONE = np.float32(0), np.float32(1)


@kernel(inline=False)
def _row(P, Q, change_p, change_q, ray_p, ray_q, steepness, edge, lowest, sums):
    """Adds a row's pixels P, held against the pixels Q, to sums: 4 rows of gradients (plane, nearness) and one of losses.

    P, Q (5 n): planes in 3 rows, nearness, 1 where solid. change_p, change_q (n): colour changed up to there.
    ray_p, ray_q (2 n): x and y of the rays. steepness: focal length over the step.
    """
    for x in range(P.shape[1]):
        near_p, near_q = P[3, x], Q[3, x]
        weight = P[4, x] * Q[4, x] * fast_exp2(max(edge * abs(change_q[x] - change_p[x]), _LOWEST))
        meets_q = (P[0, x] * ray_q[0, x] + P[1, x] * ray_q[1, x] + P[2, x]) / near_q
        meets_p = (Q[0, x] * ray_p[0, x] + Q[1, x] * ray_p[1, x] + Q[2, x]) / near_p
        slope_q, slope_p = steepness * (meets_q - _ONE), steepness * (meets_p - _ONE)
        g_q = weight * steepness * ((_ONE if slope_q > _ZERO else _ZERO) - (_ONE if slope_q < _ZERO else _ZERO))
        g_p = weight * steepness * ((_ONE if slope_p > _ZERO else _ZERO) - (_ONE if slope_p < _ZERO else _ZERO))
        g_q = g_q / near_q if abs(slope_q) <= _ONE else _ZERO
        g_p = g_p / near_p if abs(slope_p) <= _ONE else _ZERO
        sums[0, x] += g_q * ray_q[0, x]
        sums[1, x] += g_q * ray_q[1, x]
        sums[2, x] += g_q
        sums[3, x] -= g_p * meets_p if near_p > lowest else _ZERO
        sums[4, x] += weight * min(abs(slope_q), _ONE)


@kernel(parallel=True)
def slopes_and_gradient(planes, solid, changes, lens, steps, edge, lowest, lanes, gradient, parts):
    """Fills gradient (H W 3) of the sum of all pairs' slopes by the planes, and parts (H), each row's share of the sum.

    Args:
        planes: (H W 3), see `PlaneImage`.
        solid: (H W), 1 where there is a surface, else 0.
        changes: (2 H W), colour changed up to a pixel, down its column and along its row.
        lens: (4), fx, fy, cx, cy.
        steps: (S), pixels between two that are held against each other.
        edge: how fast two pixels cease to be on one face with what colour changes between them.
        lowest: least nearness.
        lanes: threads.
        gradient: output.
        parts: output.
    """
    height, width = solid.shape
    table, rays = np.empty((height, 5, width), np.float32), np.empty((height, 2, width), np.float32)
    decay = np.float32(-edge * _LOG2_E)
    for y in range(height):
        for x in range(width):
            u, v = (np.float32(x) + np.float32(0.5) - lens[2]) / lens[0], (np.float32(y) + np.float32(0.5) - lens[3]) / lens[1]
            a, b, c = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2]
            rays[y, 0, x], rays[y, 1, x] = u, v
            table[y, 0, x], table[y, 1, x], table[y, 2, x] = a, b, c
            table[y, 3, x], table[y, 4, x] = max(a * u + b * v + c, lowest), solid[y, x]
    for lane in prange(lanes):
        sums = np.empty((5, width), np.float32)
        for y in range(lane, height, lanes):
            sums[:] = _ZERO
            for step in steps:
                if step < height // 2 and step < width // 2:
                    for other in (y - step, y + step):
                        if 0 <= other < height:
                            _row(
                                table[y], table[other], changes[0, y], changes[0, other], rays[y], rays[other],
                                lens[1] / np.float32(step), decay, lowest, sums,
                            )  # fmt: skip
                    steepness, n = lens[0] / np.float32(step), width - step
                    _row(
                        table[y, :, :n], table[y, :, step:], changes[1, y, :n], changes[1, y, step:], rays[y, :, :n],
                        rays[y, :, step:], steepness, decay, lowest, sums[:, :n],
                    )  # fmt: skip
                    _row(
                        table[y, :, step:], table[y, :, :n], changes[1, y, step:], changes[1, y, :n], rays[y, :, step:],
                        rays[y, :, :n], steepness, decay, lowest, sums[:, step:],
                    )  # fmt: skip
            for x in range(width):
                u, v = rays[y, 0, x], rays[y, 1, x]
                gradient[y, x, 0] = sums[0, x] + u * sums[3, x]
                gradient[y, x, 1] = sums[1, x] + v * sums[3, x]
                gradient[y, x, 2] = sums[2, x] + sums[3, x]
            total = 0.0
            for x in range(width):
                total += sums[4, x]
            parts[y] = total

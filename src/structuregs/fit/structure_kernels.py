"""Coverage and margin on the CPU: value and gradient in one go, in Numba, held against plain torch by tests."""

import math

import numpy as np
from numba import prange

from ..jit import kernel

GRADIENTS = 15  # of each box: rotation (9), centre (3), half extents (3)
_ZERO, _ONE, _HALF = np.float32(0), np.float32(1), np.float32(0.5)
_LEAST = np.float32(1e-9)  # a ray's slope in a box is no less


@kernel()
def _along(R, v, a):
    """Component of a world vector along axis a of a box."""
    return R[0, a] * v[0] + R[1, a] * v[1] + R[2, a] * v[2]


@kernel()
def _slab(R, from_centre, ray, half_extents):
    """Where a ray enters and leaves a box, and through the faces of which axes."""
    enter, leave, enter_axis, leave_axis = np.float32(-np.inf), np.float32(np.inf), 0, 0
    for a in range(3):
        o, d = _along(R, from_centre, a), _along(R, ray, a)
        d = d if abs(d) >= _LEAST else _LEAST
        p, q = (-half_extents[a] - o) / d, (half_extents[a] - o) / d
        if min(p, q) > enter:
            enter, enter_axis = min(p, q), a
        if max(p, q) < leave:
            leave, leave_axis = max(p, q), a
    return enter, leave, enter_axis, leave_axis


@kernel()
def _add_face(R, from_centre, ray, a, t, sign, g, out):
    """Adds the gradient of g t to a box's row of gradients, for a ray that meets a face of axis a at t.

    sign: +1 where the ray leaves the box by the face, -1 where it enters.
    """
    d = _along(R, ray, a)
    d = d if abs(d) >= _LEAST else _LEAST
    g_o, g_d = -g / d, -g * t / d
    for i in range(3):
        out[3 * i + a] += g_o * from_centre[i] + g_d * ray[i]
        out[9 + i] -= R[i, a] * g_o
    out[12 + a] += sign * g / abs(d)


@kernel(parallel=True)
def occupancy_losses(rotations, centres, half_extents, hardness, softness, origin, rays, mask, weights, lanes, sums):
    """Fills sums (H, 1 + 15 K): each row of pixels' share of the weighted losses and of their gradients by the boxes.

    Args:
        rotations: (K 3 3), box to world, as centres (K 3) and half_extents (K 3) are in the world.
        centres: see above.
        half_extents: see above.
        hardness: (K), length over which occupancy grows inside.
        softness: length over which it fades outside.
        origin: (3), of the rays.
        rays: (H W 3), unit directions.
        mask: (H W), of the object.
        weights: (2), of coverage and margin, over the number of pixels.
        lanes: threads.
        sums: output.
    """
    count, (height, width) = len(centres), mask.shape
    for lane in prange(lanes):
        value, slope = np.empty(count, np.float32), np.empty(count, np.float32)
        times, axes = np.empty((count, 2), np.float32), np.empty((count, 2), np.int64)
        from_centres = np.empty((count, 3), np.float32)
        for k in range(count):
            for i in range(3):
                from_centres[k, i] = origin[i] - centres[k, i]
        for y in range(lane, height, lanes):
            out = sums[y]
            out[:] = 0.0
            for x in range(width):
                ray, m = rays[y, x], mask[y, x]
                empty = _ONE
                for k in range(count):
                    enter, leave, first, last = _slab(rotations[k], from_centres[k], ray, half_extents[k])
                    chord = leave - enter
                    length = hardness[k] if chord > _ZERO else softness
                    near = _HALF * np.float32(math.exp(-abs(chord) / length))
                    value[k], slope[k] = _ONE - near if chord > _ZERO else near, near / length
                    times[k, 0], times[k, 1], axes[k, 0], axes[k, 1] = enter, leave, first, last
                    empty *= _ONE - value[k]
                    out[0] += weights[1] * value[k] * (_ONE - m)
                out[0] += weights[0] * empty * m
                for k in range(count):
                    others = _ONE
                    for j in range(count):
                        others *= _ONE - value[j] if j != k else _ONE
                    g = (weights[1] * (_ONE - m) - weights[0] * others * m) * slope[k]
                    if g != _ZERO:
                        row = out[1 + GRADIENTS * k :]
                        _add_face(rotations[k], from_centres[k], ray, axes[k, 1], times[k, 1], _ONE, g, row)
                        _add_face(rotations[k], from_centres[k], ray, axes[k, 0], times[k, 0], -_ONE, -g, row)

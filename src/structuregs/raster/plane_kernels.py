"""The planes that splats lie in, as `planes.tangent_planes` has them, in Numba: values, and gradients written by hand."""

import math

import numpy as np
from numba import prange

from ..jit import kernel
from .project_kernels import camera_point, dot, quat_gradient, rotation, unit_quat, world_column

_ZERO, _ONE = np.float32(0), np.float32(1)


@kernel()
def _shortest(log_scales, i):
    """The splat's shortest axis; the first of equal ones."""
    a, b, c = log_scales[i, 0], log_scales[i, 1], log_scales[i, 2]
    return 0 if a <= b and a <= c else (1 if b <= c else 2)


@kernel()
def _leaning(normal, centre, steepest):
    """What of a plane's normal the camera makes: one that looks away is turned about, and none is steeper than `steepest`.

    Returns:
        the line of sight and one over the centre's distance; the cosine to it; what was added of it; the normal.
    """
    inverse = _ONE / np.float32(math.sqrt(dot(centre, centre)))
    sight = (centre[0] * inverse, centre[1] * inverse, centre[2] * inverse)
    cosine = dot(normal, sight)
    sign, lift = (-_ONE if cosine < _ZERO else _ONE), max(steepest - abs(cosine), _ZERO)
    turned = (
        sign * normal[0] + lift * sight[0],
        sign * normal[1] + lift * sight[1],
        sign * normal[2] + lift * sight[2],
    )
    return sight, inverse, cosine, lift, turned


@kernel()
def _picked(row, j):
    """One of three values.  An index that is not known before makes branches, which copies of a kernel round differently."""
    return row[0] if j == 0 else (row[1] if j == 1 else row[2])


@kernel()
def _axis(W, quats, log_scales, i):
    w, x, y, z, _ = unit_quat(quats, i)
    R, j = rotation(w, x, y, z), _shortest(log_scales, i)
    axis = _picked(R[0], j), _picked(R[1], j), _picked(R[2], j)
    return dot(W[0], axis), dot(W[1], axis), dot(W[2], axis)


@kernel(parallel=True)
def planes_forward(means, quats, log_scales, W, t, steepest, least, planes):
    """Fills planes (N 3).

    W (3 3), t (3): world to camera. steepest: least cosine to the line of sight. least: distance of a plane from the camera.
    """
    for i in prange(len(means)):
        centre = camera_point(W, t, means, i)
        _, _, _, _, normal = _leaning(_axis(W, quats, log_scales, i), centre, steepest)
        away = max(dot(normal, centre), least)
        planes[i, 0], planes[i, 1], planes[i, 2] = normal[0] / away, normal[1] / away, normal[2] / away


@kernel(parallel=True)
def planes_backward(means, quats, log_scales, W, t, steepest, least, g_planes, d_means, d_quats):
    """Fills the gradients d_* from that of the planes."""
    for i in prange(len(means)):
        g = (g_planes[i, 0], g_planes[i, 1], g_planes[i, 2])
        centre, axis = camera_point(W, t, means, i), _axis(W, quats, log_scales, i)
        sight, inverse, cosine, lift, normal = _leaning(axis, centre, steepest)
        away = dot(normal, centre)
        share = -dot(g, normal) / (away * away) if away > least else _ZERO
        away = max(away, least)
        # plane = normal / away, away = normal . centre
        n = (
            g[0] / away + share * centre[0],
            g[1] / away + share * centre[1],
            g[2] / away + share * centre[2],
        )
        # normal = sign axis + lift sight, lift = steepest - |axis . sight|
        sign = -_ONE if cosine < _ZERO else _ONE
        turn = -sign * dot(n, sight) if lift > _ZERO else _ZERO
        s = (lift * n[0] + turn * axis[0], lift * n[1] + turn * axis[1], lift * n[2] + turn * axis[2])
        along = dot(s, sight)
        c = (
            share * normal[0] + (s[0] - along * sight[0]) * inverse,
            share * normal[1] + (s[1] - along * sight[1]) * inverse,
            share * normal[2] + (s[2] - along * sight[2]) * inverse,
        )
        d_means[i, 0], d_means[i, 1], d_means[i, 2] = world_column(W, c[0], c[1], c[2])
        a = world_column(W, sign * n[0] + turn * sight[0], sign * n[1] + turn * sight[1], sign * n[2] + turn * sight[2])
        j, none = _shortest(log_scales, i), (_ZERO, _ZERO, _ZERO)
        d_quats[i, 0], d_quats[i, 1], d_quats[i, 2], d_quats[i, 3] = quat_gradient(
            unit_quat(quats, i), a if j == 0 else none, a if j == 1 else none, a if j == 2 else none
        )

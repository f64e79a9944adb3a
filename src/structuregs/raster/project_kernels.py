"""The projection of splats onto an image in Numba: values, and gradients written by hand.

Notation as in `reference.project`: with the camera's rotation W and a splat's axes A = W R(q) S, the rows of the
projected axes are m_x = fx / z (A_x - u A_z) and m_y = fy / z (A_y - v A_z), with u = x / z and v = y / z kept near the
image; the 2D covariance is [[m_x m_x, m_x m_y], [., m_y m_y]] + dilation.
"""

import math

import numpy as np
from numba import prange

from ..jit import kernel
from .records import MIN_ALPHA, NEAR

_NEAR, _MIN_ALPHA = np.float32(NEAR), np.float32(MIN_ALPHA)
_HUGE = np.float32(1e15)  # larger values, infinity and NaN are not drawn
_ONE, _TWO, _HALF = np.float32(1), np.float32(2), np.float32(0.5)


@kernel()
def rotation(w, x, y, z):
    """The matrix of a unit quaternion, by rows."""
    return (
        (_ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y)),
        (_TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x)),
        (_TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y)),
    )


@kernel()
def times(W, R, j):
    """Column j of the matrix product."""
    return (
        W[0, 0] * R[0][j] + W[0, 1] * R[1][j] + W[0, 2] * R[2][j],
        W[1, 0] * R[0][j] + W[1, 1] * R[1][j] + W[1, 2] * R[2][j],
        W[2, 0] * R[0][j] + W[2, 1] * R[1][j] + W[2, 2] * R[2][j],
    )


@kernel()
def dot(a, b):
    """The inner product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel()
def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@kernel()
def camera_point(W, t, means, i):
    """A splat's centre in the camera's frame."""
    p = (means[i, 0], means[i, 1], means[i, 2])
    return dot(W[0], p) + t[0], dot(W[1], p) + t[1], dot(W[2], p) + t[2]


@kernel()
def unit_quat(quats, i):
    """The unit quaternion and one over the length."""
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    inverse = _ONE / max(np.float32(math.sqrt(w * w + x * x + y * y + z * z)), np.float32(1e-12))
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@kernel()
def _sigmoid(x):
    return _ONE / (_ONE + np.float32(math.exp(-x)))


@kernel()
def _axes(W, R, scales):
    """The rows x, y, z of A = W R S."""
    c0, c1, c2 = times(W, R, 0), times(W, R, 1), times(W, R, 2)
    s0, s1, s2 = scales
    return (
        (c0[0] * s0, c1[0] * s1, c2[0] * s2),
        (c0[1] * s0, c1[1] * s1, c2[1] * s2),
        (c0[2] * s0, c1[2] * s1, c2[2] * s2),
    )


@kernel()
def _image_row(f, a, u, az):
    return (f * (a[0] - u * az[0]), f * (a[1] - u * az[1]), f * (a[2] - u * az[2]))


@kernel()
def _covariance(m_x, m_y, dilation):
    """(xx, xy, yy, determinant) of the dilated 2D covariance; the determinant as a sum of squares, which cannot cancel."""
    xx, xy, yy = dot(m_x, m_x), dot(m_x, m_y), dot(m_y, m_y)
    normal = _cross(m_x, m_y)
    det = dot(normal, normal) + dilation * (xx + yy) + dilation * dilation
    return xx + dilation, xy, yy + dilation, det


@kernel()
def _scales(log_scales, i):
    return (
        np.float32(math.exp(log_scales[i, 0])),
        np.float32(math.exp(log_scales[i, 1])),
        np.float32(math.exp(log_scales[i, 2])),
    )


@kernel(parallel=True)
def project_forward(means, quats, log_scales, logits, W, t, lens, size, xy, conic, depth, extent, opacity):
    """Fills the arrays xy (N 2), conic (N 3), depth (N), extent (N 2) and opacity (N) of a `Projection`.

    W (3 3), t (3): world to camera. lens (9): fx, fy, cx, cy, the limits of u and v, and the dilation. size (2): width, height.
    """
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for i in prange(len(means)):
        x, y, z = camera_point(W, t, means, i)
        o = _sigmoid(logits[i])
        opacity[i] = o
        depth[i] = z
        xy[i, 0], xy[i, 1] = cx, cy
        conic[i, 0], conic[i, 1], conic[i, 2] = _ONE, np.float32(0), _ONE
        extent[i, 0], extent[i, 1] = np.float32(0), np.float32(0)
        if not (z > _NEAR and z < _HUGE and o >= _MIN_ALPHA):
            continue
        w_, x_, y_, z_, _ = unit_quat(quats, i)
        a_x, a_y, a_z = _axes(W, rotation(w_, x_, y_, z_), _scales(log_scales, i))
        u, v = min(max(x / z, lens[4]), lens[5]), min(max(y / z, lens[6]), lens[7])
        xx, cross, yy, det = _covariance(_image_row(fx / z, a_x, u, a_z), _image_row(fy / z, a_y, v, a_z), lens[8])
        px, py = fx * x / z + cx, fy * y / z + cy
        if not (abs(px) < _HUGE and abs(py) < _HUGE and xx < _HUGE and yy < _HUGE and det < _HUGE * _HUGE):
            continue
        xy[i, 0], xy[i, 1] = px, py
        conic[i, 0], conic[i, 1], conic[i, 2] = yy / det, -cross / det, xx / det
        reach = _TWO * np.float32(math.log(o / _MIN_ALPHA))
        ex, ey = np.float32(math.sqrt(reach * xx)), np.float32(math.sqrt(reach * yy))
        if px + ex > 0 and px - ex < size[0] and py + ey > 0 and py - ey < size[1]:
            extent[i, 0], extent[i, 1] = ex, ey


@kernel()
def quat_gradient(unit, c0, c1, c2):
    """Gradient of a quaternion from that of its rotation matrix, given by columns; unit: as of `unit_quat`."""
    w, x, y, z, inverse = unit
    g = (
        _TWO * (x * (c1[2] - c2[1]) + y * (c2[0] - c0[2]) + z * (c0[1] - c1[0])),
        _TWO * (y * (c1[0] + c0[1]) + z * (c2[0] + c0[2]) + w * (c1[2] - c2[1]) - _TWO * x * (c1[1] + c2[2])),
        _TWO * (x * (c1[0] + c0[1]) + z * (c2[1] + c1[2]) + w * (c2[0] - c0[2]) - _TWO * y * (c0[0] + c2[2])),
        _TWO * (x * (c2[0] + c0[2]) + y * (c2[1] + c1[2]) + w * (c0[1] - c1[0]) - _TWO * z * (c0[0] + c1[1])),
    )
    along = g[0] * w + g[1] * x + g[2] * y + g[3] * z
    return (
        (g[0] - along * w) * inverse,
        (g[1] - along * x) * inverse,
        (g[2] - along * y) * inverse,
        (g[3] - along * z) * inverse,
    )


@kernel()
def _mix(a, x, b, y, c, z):
    """The sum of three vectors with weights."""
    return (a * x[0] + b * y[0] + c * z[0], a * x[1] + b * y[1] + c * z[1], a * x[2] + b * y[2] + c * z[2])


@kernel()
def _row_gradients(m_x, m_y, dilation, g_xx, g_xy, g_yy):
    """Gradients of the image rows from that of the conic (yy, -xy, xx) / det.

    By way of the determinant as a sum of squares: -K G K for the inverse K cancels for thin ellipses.
    """
    xx, cross, yy, det = _covariance(m_x, m_y, dilation)
    g_det = -(g_xx * yy - g_xy * cross + g_yy * xx) / (det * det)
    normal = _cross(m_x, m_y)
    share, both, turn = _TWO * dilation * g_det, -g_xy / det, _TWO * g_det
    g_mx = _mix(_TWO * g_yy / det + share, m_x, both, m_y, turn, _cross(m_y, normal))
    g_my = _mix(_TWO * g_xx / det + share, m_y, both, m_x, turn, _cross(normal, m_x))
    return g_mx, g_my


@kernel()
def world_column(W, g_x, g_y, g_z):
    """W^T g."""
    return (
        W[0, 0] * g_x + W[1, 0] * g_y + W[2, 0] * g_z,
        W[0, 1] * g_x + W[1, 1] * g_y + W[2, 1] * g_z,
        W[0, 2] * g_x + W[1, 2] * g_y + W[2, 2] * g_z,
    )


@kernel()
def _axis_gradient(W, f_x, f_y, u, v, g_x, g_y):
    """Gradient of a splat's axis in the world (a column of R S) from those of its entries in the image rows."""
    return world_column(W, f_x * g_x, f_y * g_y, -(u * f_x * g_x + v * f_y * g_y))


@kernel()
def _scaled(a, s):
    return (a[0] * s, a[1] * s, a[2] * s)


@kernel()
def _centre_gradient(p, lens, m_x, m_y, a_z, g_mx, g_my, g_x, g_y, g_depth):
    """Gradient of the centre in the camera's frame; g_x, g_y: of the centre on the image."""
    x, y, z = p
    f_x, f_y = lens[0] / z, lens[1] / z
    d_x, d_y = g_x * f_x, g_y * f_y
    # Both image rows go with 1 / z; u and v follow the centre only inside the limits.
    d_z = g_depth - (d_x * x + d_y * y) / z - (dot(m_x, g_mx) + dot(m_y, g_my)) / z
    if lens[4] <= x / z <= lens[5]:
        g_u = -f_x * dot(g_mx, a_z)
        d_x += g_u / z
        d_z -= g_u * x / (z * z)
    if lens[6] <= y / z <= lens[7]:
        g_v = -f_y * dot(g_my, a_z)
        d_y += g_v / z
        d_z -= g_v * y / (z * z)
    return d_x, d_y, d_z


@kernel(parallel=True)
def project_backward(
    means, quats, log_scales, W, t, lens, opacity, extent, g_xy, g_conic, g_depth, g_opacity,
    d_means, d_quats, d_log_scales, d_logits,
):  # fmt: skip
    """Fills the gradients d_* of the splats' tensors from the gradients g_* of the projection; 0 for splats not drawn."""
    for i in prange(len(means)):
        d_logits[i] = g_opacity[i] * opacity[i] * (_ONE - opacity[i])
        if not extent[i, 0] > 0:
            d_means[i, :], d_quats[i, :], d_log_scales[i, :] = np.float32(0), np.float32(0), np.float32(0)
            continue
        p = camera_point(W, t, means, i)
        unit = unit_quat(quats, i)
        R, s = rotation(unit[0], unit[1], unit[2], unit[3]), _scales(log_scales, i)
        a_x, a_y, a_z = _axes(W, R, s)
        u, v = min(max(p[0] / p[2], lens[4]), lens[5]), min(max(p[1] / p[2], lens[6]), lens[7])
        f_x, f_y = lens[0] / p[2], lens[1] / p[2]
        m_x, m_y = _image_row(f_x, a_x, u, a_z), _image_row(f_y, a_y, v, a_z)
        g_mx, g_my = _row_gradients(m_x, m_y, lens[8], g_conic[i, 0], g_conic[i, 1], g_conic[i, 2])

        d = _centre_gradient(p, lens, m_x, m_y, a_z, g_mx, g_my, g_xy[i, 0], g_xy[i, 1], g_depth[i])
        d_means[i, 0], d_means[i, 1], d_means[i, 2] = world_column(W, d[0], d[1], d[2])

        c0 = _scaled(_axis_gradient(W, f_x, f_y, u, v, g_mx[0], g_my[0]), s[0])
        c1 = _scaled(_axis_gradient(W, f_x, f_y, u, v, g_mx[1], g_my[1]), s[1])
        c2 = _scaled(_axis_gradient(W, f_x, f_y, u, v, g_mx[2], g_my[2]), s[2])
        d_log_scales[i, 0] = c0[0] * R[0][0] + c0[1] * R[1][0] + c0[2] * R[2][0]
        d_log_scales[i, 1] = c1[0] * R[0][1] + c1[1] * R[1][1] + c1[2] * R[2][1]
        d_log_scales[i, 2] = c2[0] * R[0][2] + c2[1] * R[1][2] + c2[2] * R[2][2]

        d_quats[i, 0], d_quats[i, 1], d_quats[i, 2], d_quats[i, 3] = quat_gradient(unit, c0, c1, c2)

"""Posing splats on the CPU in Numba: values, and gradients written by hand, held against plain torch by tests."""

from numba import prange

from ..jit import kernel

BLOCK = 1024  # splats whose gradients are summed together: sums do not depend on the number of threads
SUMS = 16  # of each block: gradients of the matrix (9), the translation (3) and the quaternion (4) that posed it


@kernel(parallel=True)
def place_forward(means, quats, blocks, matrices, centres, turns, out_means, out_quats):
    """Fills out_means (N 3) and out_quats (N 4).

    blocks (B 3): part, first splat and one past the last. matrices (K 3 3), centres (K 3), turns (K 4): canonical to world.
    """
    for b in prange(len(blocks)):
        k = blocks[b, 0]
        A, t, w, x, y, z = matrices[k], centres[k], turns[k, 0], turns[k, 1], turns[k, 2], turns[k, 3]
        for i in range(blocks[b, 1], blocks[b, 2]):
            p, q, r = means[i, 0], means[i, 1], means[i, 2]
            for a in range(3):
                out_means[i, a] = A[a, 0] * p + A[a, 1] * q + A[a, 2] * r + t[a]
            s, u, v, o = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
            out_quats[i, 0] = w * s - x * u - y * v - z * o
            out_quats[i, 1] = w * u + x * s + y * o - z * v
            out_quats[i, 2] = w * v - x * o + y * s + z * u
            out_quats[i, 3] = w * o + x * v - y * u + z * s


@kernel(parallel=True)
def place_backward(means, quats, blocks, matrices, turns, g_means, g_quats, d_means, d_quats, sums):
    """Fills the gradients d_* of the canonical splats, and sums (B 16) of those of what posed each block."""
    for b in prange(len(blocks)):
        k = blocks[b, 0]
        A, w, x, y, z = matrices[k], turns[k, 0], turns[k, 1], turns[k, 2], turns[k, 3]
        out = sums[b]
        out[:] = 0.0
        for i in range(blocks[b, 1], blocks[b, 2]):
            g, h, m = g_means[i], g_quats[i], means[i]
            for a in range(3):
                d_means[i, a] = A[0, a] * g[0] + A[1, a] * g[1] + A[2, a] * g[2]
                for c in range(3):
                    out[3 * a + c] += g[a] * m[c]
                out[9 + a] += g[a]
            s, u, v, o = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
            d_quats[i, 0] = w * h[0] + x * h[1] + y * h[2] + z * h[3]
            d_quats[i, 1] = -x * h[0] + w * h[1] + z * h[2] - y * h[3]
            d_quats[i, 2] = -y * h[0] - z * h[1] + w * h[2] + x * h[3]
            d_quats[i, 3] = -z * h[0] + y * h[1] - x * h[2] + w * h[3]
            out[12] += s * h[0] + u * h[1] + v * h[2] + o * h[3]
            out[13] += -u * h[0] + s * h[1] - o * h[2] + v * h[3]
            out[14] += -v * h[0] + o * h[1] + s * h[2] - u * h[3]
            out[15] += -o * h[0] - v * h[1] + u * h[2] + s * h[3]

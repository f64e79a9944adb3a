"""Canonical splats, posed part by part."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..geometry import SE3, quat_multiply
from ..jit import lanes


def placed(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    counts: tuple[int, ...],
    matrices: Float[Tensor, "K 3 3"],
    poses: SE3,
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"]]:
    """Centres and orientations in the world; on the CPU in float32 a kernel, elsewhere plain torch.

    Args:
        means: canonical, part after part.
        quats: relative to the parts' boxes.
        counts: splats of each part.
        matrices: canonical to the world's axes and scale.
        poses: K poses of the boxes.
    """
    if means.device.type == "cpu" and means.dtype == poses.xyz.dtype == torch.float32:
        return _Place.apply(means, quats, matrices, poses.xyz, poses.wxyz, counts)
    rows = list(zip(means.split(counts), quats.split(counts), strict=True))
    return (
        torch.cat([torch.addmm(poses.xyz[k], mean, matrices[k].T) for k, (mean, _) in enumerate(rows)]),
        torch.cat([quat_multiply(poses.wxyz[k], quat) for k, (_, quat) in enumerate(rows)]),
    )


@cache
def _blocks(counts: tuple[int, ...], size: int) -> np.ndarray:
    """Part, first splat and one past the last of each block."""
    starts = np.cumsum([0, *counts])
    rows = [(k, i, min(i + size, starts[k + 1])) for k in range(len(counts)) for i in range(starts[k], starts[k + 1], size)]
    return np.array(rows, np.int64).reshape(-1, 3)


class _Place(torch.autograd.Function):
    """`placed` as a kernel."""

    @staticmethod
    def forward(ctx, means, quats, matrices, centres, turns, counts):
        from .place_kernels import BLOCK, place_forward

        arrays = [t.detach().contiguous().numpy() for t in (means, quats, matrices, centres, turns)]
        ctx.blocks, ctx.arrays, ctx.parts = _blocks(counts, BLOCK), (*arrays[:3], arrays[4]), len(counts)
        outputs = np.empty_like(arrays[0]), np.empty_like(arrays[1])
        with lanes():
            place_forward(*arrays[:2], ctx.blocks, *arrays[2:], *outputs)
        return tuple(torch.from_numpy(a) for a in outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        from .place_kernels import SUMS, place_backward

        means, quats, matrices, turns = ctx.arrays
        incoming = [g.contiguous().numpy() for g in gradients]
        outgoing = np.empty_like(means), np.empty_like(quats)
        sums = np.empty((len(ctx.blocks), SUMS), np.float32)
        with lanes():
            place_backward(means, quats, ctx.blocks, matrices, turns, *incoming, *outgoing, sums)
        totals = np.zeros((ctx.parts, SUMS))
        np.add.at(totals, ctx.blocks[:, 0], sums)
        posed = torch.from_numpy(totals).float()
        d_matrices, d_centres, d_turns = posed.split((9, 3, 4), 1)
        return *(torch.from_numpy(a) for a in outgoing), d_matrices.reshape(-1, 3, 3), d_centres, d_turns, None

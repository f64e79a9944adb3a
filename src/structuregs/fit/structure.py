"""Structure images and the losses on boxes (supplement 1.5; the figures' I_struct, coverage and margin).

A structure image is the occupancy map of an oriented box.  Here it is analytic: each pixel's ray meets each box in the
box's own frame, and occupancy is a smooth function of the chord between entry and exit.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..geometry import SE3, Box, Camera
from ..jit import lanes
from .structure_kernels import GRADIENTS, occupancy_losses


def structure_images(
    boxes: Box, origin: Float[Tensor, " 3"], directions: Float[Tensor, "*pixels 3"], softness: float
) -> Float[Tensor, "K *pixels"]:
    """Occupancy of K boxes along rays, in (0, 1).

    0.5 where the ray just touches the box; towards 1 with the chord's length inside, within a fraction of the box's
    thickness; and a tail outside, so that a box that does not yet reach a pixel is still pulled to it.

    Args:
        boxes: K boxes in the world.
        origin: of the rays, in the world.
        directions: of the rays; lengths along them count in the world's unit if these are unit vectors.
        softness: decay length of the tail, world units.
    """
    lead = (slice(None), *[None] * (directions.dim() - 1))
    enter, leave = boxes[lead].intersect(origin, directions)
    chord = leave - enter
    thin = boxes.half_extents.detach().amin(-1)[lead]
    hit = 1 - 0.5 * torch.exp(-chord.clamp(min=0) / (0.5 * thin).clamp(max=softness))
    miss = 0.5 * torch.exp(chord.clamp(max=0) / softness)
    return torch.where(chord > 0, hit, miss)


def union(images: Float[Tensor, "K *pixels"]) -> Float[Tensor, "*pixels"]:
    """Occupancy of the whole object: 1 - prod(1 - I_k)."""
    return 1 - (1 - images).prod(0)


def coverage_loss(images: Float[Tensor, "K *pixels"], mask: Float[Tensor, "*pixels"]) -> Float[Tensor, ""]:
    """Mean of the object's mask that no box covers: (1 - I_all) M."""
    return ((1 - union(images)) * mask).mean()


def margin_loss(images: Float[Tensor, "K *pixels"], mask: Float[Tensor, "*pixels"]) -> Float[Tensor, ""]:
    """Mean of what boxes cover outside the object's mask: the sum over parts of I_k (1 - M)."""
    return (images * (1 - mask)).sum(0).mean()


def _distance(box: Box, points: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
    """Signed distance of world points to one box; negative inside."""
    beyond = box.T_world_box.inverse().apply(points).abs() - box.half_extents
    outside = (beyond.clamp(min=0).square().sum(-1) + 1e-12).sqrt()
    return outside + beyond.amax(-1).clamp(max=0)


def _probes(box: Box) -> Float[Tensor, "27 3"]:
    """Corners, middles of edges and faces, and centre of one box, in the world."""
    ticks = torch.tensor([-1.0, 0, 1], dtype=box.half_extents.dtype, device=box.half_extents.device)
    return box.to_world(torch.cartesian_prod(ticks, ticks, ticks))


def contact_loss(boxes: Box) -> Float[Tensor, ""]:
    """Mean gap, in the world's unit, between each moving box and its nearest neighbour; 0 where they touch or overlap."""
    gaps = []
    for k in range(1, len(boxes.half_extents)):
        probes = _probes(boxes[k])
        near = [
            torch.minimum(_distance(boxes[j], probes).amin(), _distance(boxes[k], _probes(boxes[j])).amin())
            for j in range(len(boxes.half_extents))
            if j != k
        ]
        gaps.append(torch.stack(near).amin().clamp(min=0))
    return torch.stack(gaps).mean() if gaps else boxes.half_extents.new_zeros(())


def extent_loss(boxes: Box) -> Float[Tensor, ""]:
    """Mean half extent, in the world's unit: keeps boxes from growing where no mask says otherwise."""
    return boxes.half_extents.mean()


@dataclass(frozen=True)
class StructureWeights:
    """Weights of the losses on boxes (supplement 1.1)."""

    coverage: float = 100.0
    """Of the uncovered part of the mask."""
    margin: float = 50.0
    """Of boxes outside the mask."""
    contact: float = 0.1
    """Of gaps between a moving box and its neighbours."""
    extent: float = 0.01
    """Of the boxes' size."""


def structure_loss(
    boxes: Box,
    motions: SE3,
    cameras: tuple[Camera, Camera],
    masks: tuple[Float[Tensor, "H0 W0"], Float[Tensor, "H1 W1"]],
    weights: StructureWeights,
    softness: float,
    loose: bool,
) -> Float[Tensor, ""]:
    """All losses on boxes, for one view of each state; `loose` adds contact and extent."""
    total = boxes.half_extents.new_zeros(())
    for camera, mask, posed in zip(cameras, masks, (boxes, boxes.moved(motions)), strict=True):
        origin, directions = camera.rays()
        rays = torch.nn.functional.normalize(directions, dim=-1).to(mask.device)
        total = total + occupancy_loss(posed, origin.to(mask.device), rays, mask, weights, softness)
        if loose:
            total = total + weights.contact * contact_loss(posed)
    return total + weights.extent * extent_loss(boxes) if loose else total


def occupancy_loss(
    boxes: Box,
    origin: Float[Tensor, " 3"],
    rays: Float[Tensor, "H W 3"],
    mask: Float[Tensor, "H W"],
    weights: StructureWeights,
    softness: float,
) -> Float[Tensor, ""]:
    """Coverage and margin of K boxes in one view, weighted; arguments as of `structure_images`.

    On the CPU in float32 a kernel, elsewhere plain torch.
    """
    pose = boxes.T_world_box
    if mask.device.type == "cpu" and pose.xyz.dtype == torch.float32:
        return _Occupancy.apply(pose.rotation, pose.xyz, boxes.half_extents, origin, rays, mask, weights, softness)
    images = structure_images(boxes, origin, rays, softness)
    return weights.coverage * coverage_loss(images, mask) + weights.margin * margin_loss(images, mask)


class _Occupancy(torch.autograd.Function):
    """`occupancy_loss` as a kernel; the gradient is made along with the value."""

    @staticmethod
    def forward(ctx, rotations, centres, half_extents, origin, rays, mask, weights, softness) -> Tensor:
        arrays = [t.detach().float().contiguous().numpy() for t in (rotations, centres, half_extents)]
        view = [t.detach().float().contiguous().numpy() for t in (origin, rays, mask)]
        hardness = np.minimum(0.5 * arrays[2].min(-1), np.float32(softness))
        both = np.array([weights.coverage, weights.margin], np.float32) / np.float32(mask.numel())
        sums = np.empty((len(mask), 1 + GRADIENTS * len(centres)))
        with lanes() as threads:
            occupancy_losses(*arrays, hardness, np.float32(softness), *view, both, threads, sums)
        total = torch.from_numpy(sums.sum(0)).to(centres.dtype)
        ctx.save_for_backward(*total[1:].view(-1, GRADIENTS).split((9, 3, 3), 1))
        return total[0]

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        rotations, centres, half_extents = (g * gradients[0] for g in ctx.saved_tensors)
        return rotations.reshape(-1, 3, 3), centres, half_extents, None, None, None, None, None

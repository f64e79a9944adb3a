"""Boxes that follow what their splats have become."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry import SE3, Box
from ..model import PosedParts
from ..points import face_axes

_OPAQUE = 0.3  # opacity from which a splat counts
_ENOUGH = 10  # opaque splats that say how far a box reaches...
_FACES = 100  # ...and so many which way it lies
_PRESSING, _MANY = 0.9, 0.02  # of how far splats may lie outside their box: so many of them as far as that would go farther
_STRAY = 0.002  # of a part's splats: so few may stick out of its box...
_FEW = 0.01  # ...and of those that photos support, while it is fitted
_CELL = 0.005  # of the base's longest half extent: how finely layers of splats are told apart


def object_size(boxes: Box) -> float:
    """About the radius of an object, world units: half the diagonal of its largest box."""
    return float(boxes.half_extents.detach().norm(dim=-1).max())


def tightened(parts: PosedParts) -> PosedParts:
    """The same splats in boxes that reach just as far as their opaque splats do."""
    parts = parts.detach()
    for k in range(len(parts)):
        parts = parts.in_box(k, _tight(parts, k))
    return parts


def base_tightened(parts: PosedParts) -> PosedParts:
    """The same with the base's box alone made to reach just as far as its opaque splats do."""
    return parts.in_box(0, _tight(parts, 0))


def drawn_in(parts: PosedParts, supported: Bool[Tensor, " N"]) -> PosedParts:
    """The same with the boxes of what moves drawn in to their opaque splats that photos support.

    Args:
        parts: as fitted so far.
        supported: by photos (`evidence.supported`).
    """
    parts = parts.detach()
    for k in range(1, len(parts)):
        box, opaque = parts.boxes[k], _opaque(parts, k, supported)
        if len(opaque) > _FACES:
            low, high = _span(opaque, _FEW)
            low, high = torch.maximum(low, -box.half_extents), torch.minimum(high, box.half_extents)
            parts = parts.in_box(k, _spanning(box, low, high))
    return parts


def drawn_out(parts: PosedParts, supported: Bool[Tensor, " N"], reach: float) -> PosedParts:
    """The same with the boxes of what moves drawn out to their opaque splats, where many of these lie as far out as they may.

    A blade's tip that the search cut off then has room to grow on.  Splats that move less than half as far as most of the part
    do not count: beside its hinge a part hardly moves, and may paint what stands still as well.

    Args:
        parts: as fitted so far.
        supported: by photos; others do not count.
        reach: how far outside their box splats may lie, world units.
    """
    parts = parts.detach()
    for k in range(1, len(parts)):
        box, opaque = parts.boxes[k], _opaque(parts, k, supported)
        if len(opaque) > _ENOUGH:
            points = box.T_world_box.apply(opaque)
            travel = (parts.motions[k].apply(points) - points).norm(dim=-1)
            low, high = _span(opaque[travel >= travel.median() / 2], _MANY)
            least, most = -box.half_extents, box.half_extents
            low = torch.where(low < least - _PRESSING * reach, low, least)
            high = torch.where(high > most + _PRESSING * reach, high, most)
            parts = parts.in_box(k, _spanning(box, low, high))
    return parts


def squared_up(parts: PosedParts) -> PosedParts:
    """The same splats in boxes of the same size and place, turned along the parts' faces, as opaque splats show them."""
    parts = parts.detach()
    cell = _CELL * float(parts.boxes.half_extents[0].max())
    for k in range(len(parts)):
        box, splats = parts.boxes[k], parts.part_splats(k)
        points = box.to_world(splats.means)[splats.opacities > _OPAQUE]
        if len(points) >= _FACES:
            start = box.T_world_box.rotation.double().cpu().numpy()
            axes = torch.from_numpy(face_axes(points.double().cpu().numpy(), start, cell)).to(points)
            parts = parts.in_box(k, Box(SE3.from_rotation(axes, box.T_world_box.xyz), box.half_extents))
    return parts


def _opaque(parts: PosedParts, k: int, which: Bool[Tensor, " N"] | None = None) -> Float[Tensor, "P 3"]:
    """A part's opaque splats, of some alone where these are given, from its box's centre along its axes, world units."""
    splats = parts.part_splats(k)
    chosen = splats.opacities > _OPAQUE
    if which is not None:
        chosen &= which.split(parts.counts)[k]
    return splats.means[chosen] * parts.boxes.half_extents[k]


def _span(points: Float[Tensor, "P 3"], but: float) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """From where to where points lie along each axis, but for some share of them at either end."""
    return points.quantile(but, 0), points.quantile(1 - but, 0)


def _spanning(box: Box, low: Float[Tensor, " 3"], high: Float[Tensor, " 3"]) -> Box:
    """A box with another's axes that reaches from `low` to `high` of its centre, along them."""
    pose = SE3.from_quat(box.T_world_box.wxyz, box.T_world_box.apply((high + low) / 2))
    return Box(pose, ((high - low) / 2).clamp(min=1e-6))


def _tight(parts: PosedParts, k: int) -> Box:
    """A part's box, as large as holds all its opaque splats but a few; as it is if the part has hardly any."""
    box, opaque = parts.boxes[k], _opaque(parts, k)
    return _spanning(box, *_span(opaque, _STRAY)) if len(opaque) > _ENOUGH else box

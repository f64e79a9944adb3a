"""Boxes that follow what their splats have become."""

import torch

from ..geometry import SE3, Box
from ..model import PosedParts
from ..points import face_axes

_OPAQUE = 0.3  # opacity from which a splat counts
_ENOUGH = 10  # opaque splats that say how far a box reaches...
_FACES = 100  # ...and so many which way it lies
_CELL = 0.005  # of the base's longest half extent: how finely layers of splats are told apart


def object_size(boxes: Box) -> float:
    """About the radius of an object, world units: half the diagonal of its largest box."""
    return float(boxes.half_extents.norm(dim=-1).max())


def tightened(parts: PosedParts) -> PosedParts:
    """The same splats in boxes that reach just as far as their opaque splats do."""
    parts = parts.detach()
    for k in range(len(parts)):
        parts = parts.in_box(k, _tight(parts, k))
    return parts


def base_tightened(parts: PosedParts) -> PosedParts:
    """The same with the base's box alone made to reach just as far as its opaque splats do."""
    return parts.in_box(0, _tight(parts, 0))


def drawn_out(parts: PosedParts) -> PosedParts:
    """The same with the boxes of what moves made to hold their opaque splats too, where these stick out.

    Splats that grew beyond what the search found of a part, such as a handle's or a blade's tip, then have room to go on.
    """
    parts = parts.detach()
    for k in range(1, len(parts)):
        corners = torch.cat([parts.boxes[k].corners, _tight(parts, k).corners])
        parts = parts.in_box(k, Box.around(corners, parts.boxes.T_world_box.rotation[k]))
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


def _tight(parts: PosedParts, k: int) -> Box:
    """A part's box, as large as holds all its opaque splats but a few; as it is if the part has hardly any."""
    box, splats = parts.boxes[k], parts.part_splats(k)
    opaque = splats.means[splats.opacities > _OPAQUE] * box.half_extents
    if len(opaque) <= _ENOUGH:
        return box
    low, high = (opaque.quantile(q, 0) for q in (0.002, 0.998))
    pose = SE3.from_quat(box.T_world_box.wxyz, box.T_world_box.apply((high + low) / 2))
    return Box(pose, ((high - low) / 2).clamp(min=1e-6))

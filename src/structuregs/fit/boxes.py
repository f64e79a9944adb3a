"""Boxes that follow what their splats have become."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import SE3, Box
from ..model import PosedParts
from ..points import face_axes

_OPAQUE = 0.3  # opacity from which a splat counts
_ENOUGH = 10  # opaque splats that say how far a box reaches...
_FACES = 100  # ...and so many which way it lies
_CELL = 0.005  # of the base's longest half extent: how finely layers of splats are told apart


def tightened(parts: PosedParts) -> PosedParts:
    """The same splats in boxes that reach just as far as their opaque splats do."""
    parts = parts.detach()
    for k in range(len(parts)):
        parts = parts.in_box(k, _tight(parts, k, parts.boxes.T_world_box.rotation[k]))
    return parts


def squared_up(parts: PosedParts) -> PosedParts:
    """The same splats in boxes that are turned along the parts' faces, as opaque splats show them, and tight around them."""
    parts = parts.detach()
    cell = _CELL * float(parts.boxes.half_extents[0].max())
    for k in range(len(parts)):
        box, splats = parts.boxes[k], parts.part_splats(k)
        points = box.to_world(splats.means)[splats.opacities > _OPAQUE]
        if len(points) >= _FACES:
            start = box.T_world_box.rotation.double().cpu().numpy()
            axes = torch.from_numpy(face_axes(points.double().cpu().numpy(), start, cell)).to(points)
            parts = parts.in_box(k, _tight(parts, k, axes))
    return parts


def _tight(parts: PosedParts, k: int, axes: Float[Tensor, "3 3"]) -> Box:
    """The box with these axes that holds all opaque splats of a part but a few; its own if it has hardly any."""
    splats = parts.part_splats(k)
    opaque = parts.boxes[k].to_world(splats.means)[splats.opacities > _OPAQUE] @ axes
    if len(opaque) <= _ENOUGH:
        return parts.boxes[k]
    low, high = (opaque.quantile(q, 0) for q in (0.002, 0.998))
    return Box(SE3.from_rotation(axes, axes @ ((high + low) / 2)), ((high - low) / 2).clamp(min=1e-6))

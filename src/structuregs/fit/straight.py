"""Joints along the axes of the base's box: what is built square moves square, and photos of a plain front hardly say."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..capture import Capture, spread_cameras, stack_views
from ..geometry import SE3, JointKind, Screw, screw_at, straightened
from ..joints import kind_of
from ..model import ArticulatedObject, PosedParts
from .boxes import object_size
from .merge import colour_errors, standard_error

_MOVES = 1e-3  # of the object's size: what slides, or radians, by less has no axis
_STRAIGHT = float(np.cos(np.deg2rad(2.0)))  # what leans less against the base is taken for straight: it comes home if not
_SQUARE_WITHIN = float(np.sin(np.deg2rad(10))) ** 2
_SIZE = 800  # side of a square with as many pixels as the photos that are asked; never more than they have
_PHOTOS = 24
_CLEAR = 2.0  # standard errors over the photos by which their error grows where they tell two motions apart, ...
_TOLD = 0.005  # ...or so much of it: a photo that is worse by more tells them apart however few there are


def askew(parts: PosedParts, kinds: Sequence[JointKind]) -> Float[Tensor, ""]:
    """Sum over joints of the squared sine of the angle to the nearest axis of the base's box, no more than at 10 degrees.

    Drawers run square to what holds them and hinges lie along its edges, and the photos of a plain front say little about
    either.  What slides by less than a thousandth of the object's size has no direction.
    """
    least = _MOVES * object_size(parts.boxes)
    axes, centres = parts.boxes.T_world_box.rotation[0].detach().T, parts.boxes.T_world_box.xyz.detach()
    total = axes.new_zeros(())
    for k, kind in enumerate(kinds, start=1):
        motion = parts.motions[k]
        way = motion.apply(centres[k]) - centres[k] if kind == "prismatic" else motion.wxyz[1:]
        direction = torch.nn.functional.normalize(way, dim=0, eps=least if kind == "prismatic" else 1e-6)
        total = total + (1 - (axes @ direction).square().max()).clamp(max=_SQUARE_WITHIN)
    return total


def lie_along_base(parts: PosedParts) -> Bool[Tensor, " K"]:
    """Which parts' joints lie along an axis of the base's box, within two degrees; what does not move has no axis."""
    axes, least = parts.boxes.T_world_box.rotation[0].double().T, _MOVES * object_size(parts.boxes)
    joints = [_screw(parts, k, kind_of(parts.motions[k])) for k in range(1, len(parts))]
    along = [q > least and bool((axes @ screw.axis).abs().max() > _STRAIGHT) for screw, q in joints]
    return torch.tensor([False, *along])


def held_along_base(parts: PosedParts, chosen: Bool[Tensor, " K"]) -> dict[int, SE3]:
    """The motions of the chosen parts along the nearest axes of the base's box, by part."""
    held = {}
    for k in torch.argwhere(chosen)[:, 0].tolist():
        screw, q = _straight(parts, k, kind_of(parts.motions[k]))
        held[k] = screw.motion(q)
    return held


@torch.no_grad()
def straight_where_loose(obj: ArticulatedObject, capture: Capture) -> ArticulatedObject:
    """The object, each joint along the nearest axis of the base's box where photos of state 1 do not tell it from its own.

    What is built square moves square, and a plain front hardly says how it leans: its axis ends a tenth of a degree off,
    where the base's faces say it exactly.  Of a part that turns or slides truly askew the photos get worse.  The joints are
    asked in turn, each with those before it as they are by then.

    Args:
        obj: as fitted.
        capture: what it was fitted to, its cameras as the fit has put them right.
    """
    if not obj.joints:
        return obj
    stack, parts, joints = stack_views(capture.train[1], _SIZE), obj.parts, list(obj.joints)
    asked = spread_cameras(stack.cameras, _PHOTOS)
    own = colour_errors(parts, stack, asked)
    for k, joint in enumerate(joints, start=1):
        screw, q = _straight(parts, k, joint.kind)
        straight = parts.with_motion(k, screw.motion(q))
        errors = colour_errors(straight, stack, asked)
        lost = errors - own
        if lost.mean() < min(_CLEAR * standard_error(lost), _TOLD * own.mean()):
            parts, own = straight, errors
            joints[k - 1] = replace(joint, axis=tuple(screw.axis.tolist()), origin=tuple(screw.origin.tolist()), q=(0.0, q))
    return replace(obj, parts=parts, joints=tuple(joints))


def _screw(parts: PosedParts, k: int, kind: JointKind) -> tuple[Screw, float]:
    return screw_at(parts.motions[k], kind, parts.boxes.T_world_box.xyz[k])


def _straight(parts: PosedParts, k: int, kind: JointKind) -> tuple[Screw, float]:
    """A part's screw along the nearest axis of the base's box, in float64 as all screws are."""
    base = parts.boxes[0]
    return straightened(*_screw(parts, k, kind), replace(base, T_world_box=base.T_world_box.to(dtype=torch.float64)))

"""Joints that photos do not tell from straight ones."""

from dataclasses import replace

import torch

from ..capture import Capture, spread_cameras, stack_views
from ..geometry import screw_at, straightened
from ..model import ArticulatedObject
from .merge import colour_errors, standard_error

_SIZE = 800  # side of a square with as many pixels as the photos that are asked; never more than they have
_PHOTOS = 24
_CLEAR = 2.0  # standard errors over the photos by which their error grows where they tell two motions apart, ...
_TOLD = 0.005  # ...or so much of it: a photo that is worse by more tells them apart however few there are


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
    base, centres = parts.boxes[0], parts.boxes.T_world_box.xyz
    base = replace(base, T_world_box=base.T_world_box.to(dtype=torch.float64))
    own = colour_errors(parts, stack, asked)
    for k, joint in enumerate(joints, start=1):
        screw, q = straightened(*screw_at(parts.motions[k], joint.kind, centres[k]), base)
        straight = parts.with_motion(k, screw.motion(q))
        errors = colour_errors(straight, stack, asked)
        lost = errors - own
        if lost.mean() < min(_CLEAR * standard_error(lost), _TOLD * own.mean()):
            parts, own = straight, errors
            joints[k - 1] = replace(joint, axis=tuple(screw.axis.tolist()), origin=tuple(screw.origin.tolist()), q=(0.0, q))
    return replace(obj, parts=parts, joints=tuple(joints))

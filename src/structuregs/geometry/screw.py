"""Screws: the axis, pivot and amount of a rigid motion."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from .box import Box
from .se3 import SE3

JointKind = Literal["revolute", "prismatic"]


@dataclass(frozen=True)
class Screw:
    """A motion of one degree of freedom.

    Attributes:
        kind: turning about the line through `origin` along `axis`, or sliding along `axis`.
        axis: unit vector.
        origin: a point of the axis of a turn; where the axis is drawn for a slide.
    """

    kind: JointKind
    axis: Float[Tensor, " 3"]
    origin: Float[Tensor, " 3"]

    def motion(self, q: float | Float[Tensor, "*batch"]) -> SE3:
        """The rigid motions by `q` radians (revolute) or units of length (prismatic)."""
        along = torch.as_tensor(q, dtype=self.axis.dtype, device=self.axis.device)[..., None] * self.axis
        if self.kind == "prismatic":
            return SE3.exp(torch.cat([along, torch.zeros_like(along)], -1))
        turn = SE3.exp(torch.cat([torch.zeros_like(along), along], -1))
        return SE3.from_quat(turn.wxyz, self.origin - turn.apply(self.origin))


def screw_of_motion(T: SE3, kind: JointKind) -> tuple[Screw, float]:
    """The screw of a given kind closest to a motion, and its amount `q` (radians or units of length), q >= 0.

    Supplement 1.4. Prismatic: the translation's direction and norm.  Revolute: axis and angle of the rotation, the
    pivot the minimum-norm least-squares solution of (R - I) p = -t; the part of t along the axis is dropped.
    """
    t = T.xyz
    if kind == "prismatic":
        length = float(t.norm())
        axis = t / length if length > 0 else torch.tensor([0.0, 0, 1], dtype=t.dtype, device=t.device)
        return Screw("prismatic", axis, torch.zeros_like(t)), length
    omega = T.log()[3:]
    angle = float(omega.norm())
    axis = omega / angle if angle > 0 else torch.tensor([0.0, 0, 1], dtype=t.dtype, device=t.device)
    across = t - axis * (axis @ t)
    # On the plane across the axis, (I - R)^-1 in closed form; the solution has no component along the axis.
    cot = math.cos(angle / 2) / max(math.sin(angle / 2), 1e-12)
    origin = 0.5 * (across + cot * torch.linalg.cross(axis, across))
    return Screw("revolute", axis, origin), angle


def screw_at(motion: SE3, kind: JointKind, centre: Float[Tensor, " 3"]) -> tuple[Screw, float]:
    """The screw of a given kind closest to a part's motion and its amount `q >= 0`, in float64.

    The motion is read at the part's centre.  So a slide is the way the part went (the translation of a motion that
    also turns a little depends on where the world's origin lies), and a turn's origin is the axis's point nearest to
    the part.

    Args:
        motion: from state 0 to state 1, in the world.
        kind: which of the two screws.
        centre: the centre of the part in state 0, in the world.
    """
    centre = centre.double()
    motion = SE3.from_quat(motion.wxyz.double(), motion.xyz.double())
    at_centre = SE3.from_quat(motion.wxyz, motion.apply(centre) - centre)
    screw, q = screw_of_motion(at_centre, kind)
    return replace(screw, origin=screw.origin + centre), q


def straightened(screw: Screw, q: float, box: Box) -> tuple[Screw, float]:
    """The screw along the nearest axis of a box, the same way, and as much of `q` as goes along it."""
    axes = box.T_world_box.rotation.T
    along = axes @ screw.axis
    nearest = int(along.abs().argmax())
    straight = replace(screw, axis=axes[nearest] * along[nearest].sign())
    return straight, q * float(straight.axis @ screw.axis)

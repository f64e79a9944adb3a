"""Errors of joints against the true ones."""

from dataclasses import dataclass

import torch

from ..capture import TrueJoint, Truth
from ..geometry import JointKind
from ..metrics import axis_angle_deg, axis_position, geodesic_deg, translation_error
from ..model import ArticulatedObject, Joint
from .matching import match_joints


@dataclass(frozen=True)
class JointScore:
    """One true joint and what was found in its place.

    Attributes:
        part: index of the reconstructed part; None where no part is left for this joint.
        kind: the type that was found; None without a part.
        kind_true: the true type.
        failed: no part, or one of another type.  A failure has no errors, and counts.
        axis_angle_deg: angle between the axes, blind to their signs.
        axis_position: distance of the axes, in the capture's unit; None for a slide, whose axis has no place.
        geodesic_deg: error of a turn from state 0 to state 1; None for a slide.
        translation: error of a slide from state 0 to state 1, in the capture's unit; None for a turn.
    """

    part: int | None
    kind: JointKind | None
    kind_true: JointKind
    failed: bool
    axis_angle_deg: float | None = None
    axis_position: float | None = None
    geodesic_deg: float | None = None
    translation: float | None = None


def score_joints(obj: ArticulatedObject, truth: Truth) -> tuple[JointScore, ...]:
    """The errors of an object's joints, one entry for each true joint, in the truth's order."""
    matched = match_joints(obj, truth)
    return tuple(
        JointScore(None, None, true.kind, failed=True) if found is None else _score(found + 1, obj.joints[found], true)
        for found, true in zip(matched, truth.joints, strict=True)
    )


def _score(part: int, joint: Joint, true: TrueJoint) -> JointScore:
    if joint.kind != true.kind:
        return JointScore(part, joint.kind, true.kind, failed=True)
    axis, axis_true = joint.screw.axis, torch.tensor(true.axis, dtype=torch.float64)
    angle = axis_angle_deg(axis, axis_true)
    if joint.kind == "prismatic":
        error = translation_error(axis, joint.q[1] - joint.q[0], axis_true, true.q1 - true.q0)
        return JointScore(part, joint.kind, true.kind, failed=False, axis_angle_deg=angle, translation=error)
    return JointScore(
        part,
        joint.kind,
        true.kind,
        failed=False,
        axis_angle_deg=angle,
        axis_position=axis_position(joint.screw.origin, axis, torch.tensor(true.origin, dtype=torch.float64), axis_true),
        geodesic_deg=geodesic_deg(joint.motion(joint.q[1]).rotation, true.motion().rotation),
    )

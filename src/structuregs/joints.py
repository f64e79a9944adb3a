"""Joints read off the motions of parts: type, axis, pivot, displacement (supplement 1.4), and how clear they are."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from .geometry import SE3, JointKind, Screw, screw_at
from .model import ArticulatedObject, Joint, PosedParts

PRISMATIC_BELOW_DEG = 5.0  # supplement 1.4
REVIEW_BELOW = 0.75  # of the confidence; where measured, right joints have .8 and more, wrong ones mostly less


@dataclass(frozen=True)
class _Moved:
    """A part and its motion, all that a judgement of its joint looks at (float64)."""

    motion: SE3
    centre: Float[Tensor, " 3"]
    corners: Float[Tensor, "8 3"]
    splats: float

    @property
    def radius(self) -> float:
        """Half the diagonal of the part's box."""
        return max(float((self.corners[0] - self.centre).norm()), 1e-12)

    @property
    def travel(self) -> float:
        """How far the box's corners move, root mean square."""
        return float((self.motion.apply(self.corners) - self.corners).square().sum(-1).mean().sqrt())


def kind_of(motion: SE3) -> JointKind:
    """The joint's type by the supplement's rule: "prismatic" where the rotation is below 5 degrees (1.4)."""
    return "prismatic" if math.degrees(float(motion.angle)) < PRISMATIC_BELOW_DEG else "revolute"


def constrain(motion: SE3, kind: JointKind, centre: Float[Tensor, " 3"]) -> SE3:
    """The motion of exactly one degree of freedom that is closest to `motion` at a part's centre, float64.

    Arguments as in `screw_at`.
    """
    screw, q = screw_at(motion, kind, centre)
    return screw.motion(q)


def joints_of(parts: PosedParts, kinds: Sequence[JointKind] | None = None) -> tuple[Joint, ...]:
    """The joint of every moving part against the base, with its confidence.

    The confidence is a product of scores, each clipped to [0, 1]; `r` is half the diagonal of the part's box:

    - type: `|ln(angle / 5 deg)| / ln 3`: 0 on the boundary between the types, 1 a factor of three away from it;
    - travel: what the box's corners move (rms), over `r / 10`;
    - slide, of a turn: `1 - 2 h / r`, for the slide `h` along the axis that no joint explains;
    - reach, of a turn: `2 - d / (1.5 r)`, for the distance `d` of the axis from the box's centre: 1 for a hinge at
      the box, 0 from `3 r` on, where a slide looks the same;
    - splats: the sum of the part's opacities, over 100.

    After a fit it is lowered further where photos hardly show the part, not alike, or beside it what nothing covers
    (`structuregs.fit.evidence`).

    `review` is the sentence of the lowest score where the confidence is below `REVIEW_BELOW`.

    Args:
        parts: the base and the moving parts.
        kinds: the types of the moving parts where they are already settled; the supplement's rule otherwise.
    """
    parts = parts.detach()
    opacities = parts.splats.opacities.split(parts.counts)
    rows = []
    for k in range(1, len(parts)):
        box, motion = parts.boxes[k], _double(parts.motions[k])
        moved = _Moved(motion, box.T_world_box.xyz.double(), box.corners.double(), float(opacities[k].sum()))
        rows.append(_joint(moved, kinds[k - 1] if kinds is not None else kind_of(motion)))
    return tuple(rows)


def articulate(parts: PosedParts, kinds: Sequence[JointKind] | None = None) -> ArticulatedObject:
    """The articulated object of posed parts: their joints, and every motion held to its joint's one degree of freedom.

    Arguments as in `joints_of`.
    """
    parts = parts.detach()
    joints = joints_of(parts, kinds)
    still = SE3.identity(dtype=torch.float64)
    motions = torch.stack([T.wxyz_xyz for T in (still, *(joint.motion(joint.q[1]) for joint in joints))])
    return ArticulatedObject(replace(parts, motions=SE3(motions.to(parts.motions.wxyz_xyz))), joints)


def _double(motion: SE3) -> SE3:
    """A motion in float64, its quaternion of unit length to that precision."""
    motion = motion.to(dtype=torch.float64)
    return SE3.from_quat(motion.wxyz, motion.xyz)


def _joint(moved: _Moved, kind: JointKind) -> Joint:
    screw, q = screw_at(moved.motion, kind, moved.centre)
    scores = [(min(max(score, 0.0), 1.0), sentence) for score, sentence in _scores(moved, screw)]
    sentence = min(scores)[1]
    confidence = math.prod(score for score, _ in scores)
    (ax, ay, az), (ox, oy, oz) = screw.axis.tolist(), screw.origin.tolist()
    return Joint(
        kind,
        parent=0,
        axis=(ax, ay, az),
        origin=(ox, oy, oz),
        q=(0.0, q),
        confidence=confidence,
        review=sentence if confidence < REVIEW_BELOW else "",
    )


def _scores(moved: _Moved, screw: Screw) -> list[tuple[float, str]]:
    """The scores of `joints_of`, unclipped, each with the sentence that a human reads when it is low."""
    angle, radius, travel = math.degrees(float(moved.motion.angle)), moved.radius, moved.travel
    of_type = abs(math.log(max(angle, 1e-6) / PRISMATIC_BELOW_DEG)) / math.log(3)
    rows = [
        (of_type, f"The part turns by {angle:.1f} degrees, near the {PRISMATIC_BELOW_DEG:g} that part slides from turns."),
        (10 * travel / radius, f"The part moves only {travel:.3g} for its size of {2 * radius:.3g}: its axis is uncertain."),
        (moved.splats / 100, f"Only {moved.splats:.0f} opaque splats show the part: little speaks for its motion."),
    ]
    if screw.kind == "revolute":
        slide = abs(float(screw.axis @ (moved.motion.apply(moved.centre) - moved.centre)))
        away = float((screw.origin - moved.centre).norm())
        rows += [
            (1 - 2 * slide / radius, f"The part also slides {slide:.3g} along the axis that it turns about."),
            (
                2 - away / (1.5 * radius),
                f"The axis runs {away:.3g} away from a part of size {2 * radius:.3g}: is it a slide?",
            ),
        ]
    return rows

"""Motion hypotheses: where could a moving cluster be in the other state, and which of these do masks and images allow?

Hinges turn about a box's own edges and slides run along its axes (method.md, points 3 and 4), so that some thousand rigid
motions hold one close to the truth.  The other state's hull rules most of them out at once; rendering the rest into the
other state's photos, and then letting the images pull at the best of them, decides.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial import KDTree
from torch import Tensor

from ..geometry import SE3, Box, Screw, screw_at
from ..points import Hull

_ANGLES = torch.deg2rad(torch.arange(7.5, 181, 7.5, dtype=torch.float64))
_LENGTHS = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5, 1.75, 2.0], dtype=torch.float64)
_ALONG = np.cos(np.deg2rad(4))  # of two axes that are one


@dataclass(frozen=True)
class Hypothesis:
    """One rigid motion that a cluster may make, from its own state to the other, and what speaks against it.

    Attributes:
        motion: of the world, float64.
        outside: mean depth by which the moved points leave the other state's solid, in voxels.
        unexplained: fraction of the other state's moving points near the motion's reach that it leaves uncovered.
        oddity: how unlike a joint's the motion is (see `oddity`).
        image_error: mean absolute error of the other state's photos with the part moved so; infinite until looked at.
        back_error: the same of its own state's photos with what lies there in the other state moved back.
        seen: what photos of the other state show of the part after a turn, over what those of its own do; 1 where not asked.
    """

    motion: SE3
    outside: float
    unexplained: float
    oddity: float
    image_error: float = float("inf")
    back_error: float = float("inf")
    seen: float = 1.0

    @property
    def error(self) -> float:
        """What the photos of both states say."""
        return self.image_error + self.back_error

    def against(self, weight: float) -> float:
        """What else speaks against the motion, in mean error.

        Light that stays in the world while a part turns can make a mirrored pose look better than the true one, and what is
        shut shows little of itself; therefore what is odd about a motion, and what the masks say, count as shares of
        `weight`: what the photos of the part's own state would lose without it, in mean error.
        """
        return weight * (0.1 * self.oddity + 0.2 * min(self.outside, 1.0) + 0.1 * self.unexplained)


def hinge_screws(box: Box) -> list[Screw]:
    """Turns about lines along the box's axes: its edges, the mid-lines of its faces and of itself, and lines beyond.

    Near its hinge a part hardly moves, and what lies before something else does not show in the masks, so that what is seen
    to move, and its box, end before the hinge, in few views by more than half of the part.
    """
    screws = []
    R, centre, h = box.T_world_box.rotation, box.T_world_box.xyz, box.half_extents
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for i, j in itertools.product((-3, -2.2, -1.6, -1.3, -1, 0, 1, 1.3, 1.6, 2.2, 3), repeat=2):
            if abs(i) > 1 and abs(j) > 1:
                continue
            screws.append(Screw("revolute", R[:, axis], centre + R[:, b] * h[b] * i + R[:, c] * h[c] * j))
    return screws


def slide_screws(box: Box, base: Box) -> list[Screw]:
    """Slides along the axes of the box, and along those of the base that differ from them."""
    axes = list(box.T_world_box.rotation.T)
    for axis in base.T_world_box.rotation.T:
        if max(abs(float(axis @ other)) for other in axes) < _ALONG:
            axes.append(axis)
    return [Screw("prismatic", axis, box.T_world_box.xyz) for axis in axes]


def square_with(box: Box, axis: int, base: Box) -> Float64[Tensor, "3 3"] | None:
    """The box's axes, as columns, turned about one of them to lie square with the base; None if they do.

    Args:
        box: in the world.
        axis: which of its axes stays; of the base's axes, another comes to lie along the one most at right angles to it.
        base: the base's box.
    """
    own = box.T_world_box.rotation
    axes = square_about(own[:, axis], base)
    return None if float((axes[:, 1] @ own).abs().max()) > _ALONG else axes


def square_about(axis: Float64[Tensor, "3"], base: Box) -> Float64[Tensor, "3 3"]:
    """A unit vector and what lies square with it and the base, as columns: of the base's axes the one most at right angles."""
    others = base.T_world_box.rotation
    across = others[:, int((axis @ others).abs().argmin())]
    across = torch.nn.functional.normalize(across - (across @ axis) * axis, dim=0)
    return torch.stack([axis, across, torch.linalg.cross(axis, across)], 1)


def registrations(box: Box, target: Box) -> list[SE3]:
    """Motions that lay the box upon another, in each of the 24 ways that a box can be turned."""
    motions = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            flip = torch.zeros(3, 3, dtype=torch.float64)
            for column, (row, sign) in enumerate(zip(order, signs, strict=True)):
                flip[row, column] = sign
            if torch.linalg.det(flip) > 0:
                turned = SE3.from_rotation(target.T_world_box.rotation @ flip, target.T_world_box.xyz)
                motions.append(turned @ box.T_world_box.inverse())
    return motions


def candidate_motions(wholes: list[Box], base: Box, pairs: list[tuple[Box, Box]]) -> SE3:
    """All motions worth a look for a cluster: M rigid motions of the world, float64.

    Args:
        wholes: boxes of the cluster and of what it may be a piece of; their hinges and slides are tried.
        base: the base's box, for more slides.
        pairs: boxes of what may be one part in the cluster's state and in the other; the one is laid upon the other.
    """
    rows = [SE3.identity(1, dtype=torch.float64).wxyz_xyz]
    for box in wholes:
        rows += [screw.motion(_both_ways(_ANGLES)).wxyz_xyz for screw in hinge_screws(box)]
        reach = float(box.half_extents.max())
        for screw in slide_screws(box, base):
            along = box.T_world_box.rotation.T @ screw.axis
            size = max(float((along.abs() * 2 * box.half_extents).sum()), 0.2 * reach)
            rows.append(screw.motion(_both_ways(_LENGTHS * size)).wxyz_xyz)
    for source, target in pairs:
        rows.append(stack_motions(registrations(source, target)).wxyz_xyz)
    return SE3(torch.cat(rows))


def _both_ways(amounts: Float64[Tensor, " A"]) -> Float64[Tensor, " 2*A"]:
    return torch.stack([amounts, -amounts], 1).flatten()


def hull_scores(
    motions: SE3, points: Float64[np.ndarray, "P 3"], other: Hull, arrivals: Float64[np.ndarray, "Q 3"], box: Box
) -> tuple[Float64[np.ndarray, " M"], Float64[np.ndarray, " M"]]:
    """`outside` and `unexplained` of each motion (see `Hypothesis`).

    Args:
        motions: M motions from the cluster's state to the other.
        points: the cluster's points.
        other: the other state's hull.
        arrivals: points of the other state that this cluster might account for; may be none.
        box: the cluster's box.
    """
    field = np.minimum(other.distance() / other.voxel, 4.0)
    moved = motions[:, None].apply(torch.from_numpy(points)).numpy()
    outside = other.sample(field, moved.reshape(-1, 3), outside=4.0).reshape(len(moved), -1)
    outside = np.maximum(outside - 1.0, 0.0).mean(1)
    if not len(arrivals):
        return outside, np.zeros(len(outside))
    back = motions.inverse()[:, None].apply(torch.from_numpy(arrivals))
    return outside, 1 - box.contains(back, margin=2 * other.voxel).double().mean(1).numpy()


def oddity(motion: SE3, box: Box, still: KDTree) -> float:
    """How unlike a joint's a motion is: 0 for a short slide, or a turn about a line where the part meets what stands still.

    The sum of lengths over the box's half diagonal: the travel of the corners (of two that look alike, the shorter way) and,
    for turns, the slide along the axis and fourfold the distance from the axis, beside the box, to what stands still; these
    two count up to 1.  A panel looks much the same however it is laid upon its place, and in another light the wrong way
    may look better; but only the true way turns about a hinge.

    Args:
        motion: of the box, in the world, float64.
        box: where the part is before the motion.
        still: points of what stands still, in the world.
    """
    size = float(box.half_extents.norm())
    centre = box.T_world_box.xyz
    travel = float((motion.apply(box.corners) - box.corners).square().sum(-1).mean().sqrt())
    total = travel / size
    if float(motion.angle) > np.deg2rad(5):
        screw, _ = screw_at(motion, "revolute", centre)
        slide = abs(float(screw.axis @ (motion.apply(centre) - centre)))
        along = (box.corners - screw.origin) @ screw.axis
        beside = torch.from_numpy(np.linspace(float(along.min()), float(along.max()), 15))[:, None] * screw.axis + screw.origin
        standoff = float(np.median(still.query(beside.numpy())[0]))
        total += min(slide / size, 1.0) + 4 * min(standoff / size, 1.0)
    return total


def flips(motion: SE3, box: Box) -> list[SE3]:
    """The motion followed by half a turn about each of the moved box's axes: it comes to lie in the same place."""
    moved = box.moved(motion)
    axes = moved.T_world_box.rotation.T
    return [Screw("revolute", axis, moved.T_world_box.xyz).motion(np.pi) @ motion for axis in axes]


def displacements(motions: SE3, one: SE3, box: Box) -> Float64[np.ndarray, " M"]:
    """Root mean square distance of a box's corners moved by each of M motions and by one, over its half diagonal."""
    gap = motions[:, None].apply(box.corners) - one.apply(box.corners)
    return (gap.square().sum(-1).mean(-1).sqrt() / box.half_extents.norm()).numpy()


def distinct(motions: SE3, box: Box, gap: float, most: int) -> list[int]:
    """Indices of the first `most` motions, in the order given, no two of which are closer than `gap` (see `displacements`)."""
    kept: list[int] = []
    near = np.zeros(len(motions.wxyz_xyz), bool)
    for index in range(len(near)):
        if not near[index] and len(kept) < most:
            kept.append(index)
            near |= displacements(motions, motions[index], box) < gap
    return kept


def finalists(motions: SE3, costs: list[float], box: Box, most: int) -> list[int]:
    """Indices of the best by the photos and, where these see little of a part or in another light, the best by the masks.

    Args:
        motions: in the masks' order.
        costs: by which the photos order them.
        box: of what moves.
        most: so many of the photos' choice and of the masks', all distinct.
    """
    rows = []
    for order in (np.argsort(costs, kind="stable"), np.arange(len(costs))):
        rows += order[distinct(motions[order], box, 0.15, most)].tolist()
    return [rows[c] for c in distinct(motions[rows], box, 0.02, len(rows))]


def stack_motions(motions: list[SE3]) -> SE3:
    """Single motions as one batch."""
    return SE3(torch.stack([motion.wxyz_xyz for motion in motions]))


def turn_about(centre: Float[Tensor, " 3"], tangent: Float[Tensor, " 6"]) -> SE3:
    """The motion `exp(tangent)` seen from `centre`: a small rotation there does not drag the part away."""
    turn = SE3.exp(tangent)
    return SE3.from_quat(turn.wxyz, turn.xyz + centre - turn.rotation @ centre)

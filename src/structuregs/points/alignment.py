"""Similarities that lay one frame upon another, found from the same cameras as each of the two frames has them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from ..geometry import SE3

_ROUNDS = 30  # of reweighting; both sums of distances have settled long before


@dataclass(frozen=True)
class Similarity:
    """A turn, a scale and a shift.

    Attributes:
        rotation: of the frame.
        scale: factor on lengths.
        shift: where the frame's origin goes.
    """

    rotation: Float64[np.ndarray, "3 3"]
    scale: float
    shift: Float64[np.ndarray, " 3"]

    def apply(self, points: Float64[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3"]:
        """The points in the other frame."""
        return self.scale * points @ self.rotation.T + self.shift


@dataclass(frozen=True)
class Alignment:
    """How one frame lies upon another, and how well the cameras agree then (medians: a few may be far off).

    Attributes:
        similarity: from the frame to the other.
        angle_deg: between the cameras' orientations.
        distance: between their centres, over the median distance of the other frame's centres from their middle.
    """

    similarity: Similarity
    angle_deg: float
    distance: float


def align_cameras(cameras: SE3, others: SE3) -> Alignment:
    """The similarity that lays cameras upon the same cameras as another frame has them.

    Minimises the sum of angles between orientations, then that of distances between centres (no squares, so that a few
    cameras that are far off hardly count), by reweighted least squares from a median.

    Args:
        cameras: poses of V cameras in the one frame.
        others: their poses in the other.

    Raises:
        ValueError: fewer than three cameras, or all of them in one place, leave the scale open.
    """
    turns = Rotation.from_matrix((others.rotation @ cameras.rotation.transpose(-1, -2)).double().numpy())
    centres, goals = cameras.xyz.double().numpy(), others.xyz.double().numpy()
    spread = float(np.median(np.linalg.norm(goals - np.median(goals, 0), axis=1)))
    apart = pdist(centres)
    if len(centres) < 3 or spread < 1e-9 or np.median(apart) < 1e-9:
        raise ValueError(f"{len(centres)} cameras do not tell a scale; give three or more in different places.")
    to_all = np.array([(turn.inv() * turns).magnitude().sum() for turn in turns])
    rotation = turns[int(to_all.argmin())]
    for _ in range(_ROUNDS):
        rotation = turns.mean(1 / np.maximum((rotation.inv() * turns).magnitude(), 1e-4))
    R = rotation.as_matrix()
    turned = centres @ R.T
    scale = float(np.median(pdist(goals) / np.maximum(apart, 1e-9)))
    shift = np.median(goals - scale * turned, 0)
    for _ in range(_ROUNDS):
        weights = 1 / np.maximum(np.linalg.norm(scale * turned + shift - goals, axis=1), 1e-4 * spread)
        weights /= weights.sum()
        mean, goal = weights @ turned, weights @ goals
        scale = float(weights @ ((turned - mean) * (goals - goal)).sum(1) / (weights @ np.square(turned - mean).sum(1)))
        shift = goal - scale * mean
    angles = np.rad2deg((rotation.inv() * turns).magnitude())
    gaps = np.linalg.norm(scale * turned + shift - goals, axis=1)
    return Alignment(Similarity(R, scale, shift), float(np.median(angles)), float(np.median(gaps) / spread))

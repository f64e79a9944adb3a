"""Clusters that hold several parts: told by the photos, to which each splat says how far it would rather move.

Parts that lie side by side and touch, such as the fronts of a cupboard, are one cluster of what moved.  No one motion puts
all of it in place; but each part's splats say which of several motions fits *them*.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree

from .cue import CueConfig, box_around, linked

Points = Float64[np.ndarray, "_ 3"]

FACTORS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.35, 1.5)
"""How far along its own way a motion is tried, against what suits the cluster best as a whole."""

_POOL = 24  # neighbours over which a splat's support is averaged
_VOTERS = 12  # splats around a point that say what it belongs to


def divide(
    points: Points,
    means: Points,
    support: Float64[np.ndarray, "F N"],
    mixed: float,
    least: float,
    cue: CueConfig,
    voxel: float,
) -> list[Points]:
    """The points of one cluster, as those of several parts if its splats disagree about the way.

    The splats of one part like the same factor best, and their support at that factor adds up to about what each could
    reach with a factor of its own.  Where together they could reach much more, the splats that agree with the strongest
    mode are one part, with all points in their box, and what is left falls into pieces that hang together.

    Args:
        points: of the cluster, in the world.
        means: centres of its splats.
        support: of each splat for each of the factors (see `Scene.support`).
        mixed: divide if the splats' own best together reach this many times what the best common factor does...
        least: ...and this much more.
        cue: how near points hang together, and how few are noise.
        voxel: of the hull, world units.
    """
    common = float(support.sum(1).max())
    pooled = support[:, KDTree(means).query(means, k=min(_POOL, len(means)))[1]].mean(2)
    own = np.maximum(pooled.max(0), 0.0)
    if common <= 0 or own.sum() < max(mixed * common, common + least):
        return [points]
    best = pooled.argmax(0)
    strength = np.bincount(best, own, minlength=len(support))
    mode = int(np.convolve(strength, np.ones(3), "same").argmax())
    agrees = _vote(points, means, (np.abs(best - mode) <= 1) & (own > 0), own)
    cores = linked(points[agrees], cue, voxel)
    if not cores:
        return [points]
    box = box_around(max(cores, key=len), thinnest=0.5 * voxel, trim=0.02)
    within = box.contains(torch.from_numpy(points), margin=voxel).numpy()
    pieces = [points[within], *linked(points[~within], cue, voxel)]
    nearest = np.argmin([KDTree(piece).query(points)[0] for piece in pieces], 0)
    return [points[nearest == k] for k in range(len(pieces))]


def _vote(
    points: Points, means: Points, yes: Bool[np.ndarray, " N"], weight: Float64[np.ndarray, " N"]
) -> Bool[np.ndarray, " P"]:
    """Which points have about them more weight of splats that say yes than of others."""
    near = KDTree(means).query(points, k=min(_VOTERS, len(means)))[1]
    return np.where(yes, weight, -weight)[near].sum(1) > 0

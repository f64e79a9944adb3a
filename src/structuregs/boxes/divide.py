"""Clusters that hold several parts: told by the photos, to which each splat says how far it would rather move.

Parts that lie side by side and touch, such as the fronts of a cupboard, are one cluster of what moved.  No one motion puts
all of it in place; but each part's splats say which of several motions fits *them*.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from ..geometry import Box, Screw
from .cue import CueConfig, Points, box_around, linked, one_box_holds

FACTORS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.35, 1.5)
"""How far along its own way a motion is tried, against what suits the cluster best as a whole."""

FINELY = tuple(1 + 0.02 * step for step in range(-10, 11))
"""How far along its own way a piece of a part is tried that goes nearly as far as the rest."""

AROUND = (0.8, 0.9, 1.0, 1.1, 1.2)
"""The same for what may move along with a part: best at one of the middle three."""

_EACH = 0.08  # of what all explain as one, and of the points: every piece of what is cut has so much
_NARROWEST = 4  # voxels: no part beside another is narrower
_POOL = 24  # neighbours over which a splat's support is averaged
_VOTERS = 12  # splats around a point that say what it belongs to
_ALONG = 0.06  # of what the photos of its own state lose without it: what moves along explains so much of the other's...
_SURELY = 0.12  # ...and most of it so much


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
    mode are one part, where they reach most, with all points in their box, and what is left falls into pieces that hang
    together.

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
    local = _pooled(means, support)
    own = np.maximum(local.max(0), 0.0)
    if common <= 0 or own.sum() < max(mixed * common, common + least):
        return [points]
    best = local.argmax(0)
    strength = np.bincount(best, own, minlength=len(support))
    mode = int(np.convolve(strength, np.ones(3), "same").argmax())
    agrees = (np.abs(best - mode) <= 1) & (own > 0)
    cores = linked(points[_vote(points, means, agrees, own)], cue, voxel)
    if not cores:
        return [points]
    strongest = int(np.bincount(nearest_of(cores, means[agrees]), own[agrees], minlength=len(cores)).argmax())
    box = box_around(cores[strongest], thinnest=0.5 * voxel, trim=0.02)
    within = box.contains(torch.from_numpy(points), margin=voxel).numpy()
    pieces = [points[within], *linked(points[~within], cue, voxel)]
    nearest = nearest_of(pieces, points)
    return [points[nearest == k] for k in range(len(pieces))]


def nearest_of(pieces: list[Points], points: Points) -> Int64[np.ndarray, " P"]:
    """Which piece is nearest to each point."""
    return np.argmin([KDTree(piece).query(points)[0] for piece in pieces], 0)


def moving_along(
    part: Points,
    points: Points,
    means: Points,
    support: Float64[np.ndarray, "F N"],
    so_far: Float64[np.ndarray, " N"],
    needed: Float64[np.ndarray, " N"],
    cue: CueConfig,
    voxel: float,
) -> Bool[np.ndarray, " P"]:
    """Which points beside a part belong to it: what its motion explains, and none that goes further or less far.

    A door's panel and the tray behind it hang together in the state in which both are open.  Shut, the panel shows itself;
    what the door's motion takes out of sight, or into the way, is something else.  So is what no box holds with the part:
    near a hinge that two doors share, one above the other, what is of the one moves about like the other.

    Args:
        part: points of the part, in the world.
        points: what lies beside the part, in the world.
        means: centres of its splats.
        support: of each splat for each factor of `AROUND` of the part's motion (see `Scene.support`).
        so_far: the same for the motion that it has been given so far.
        needed: what each splat takes off the error of the photos of its own state.
        cue: how near points hang together, and how few are noise.
        voxel: of the hull, world units.
    """
    own = _pooled(means, needed[None])[0].clip(min=0)
    along = _pooled(means, support - so_far)[AROUND.index(1.0)]
    likely, surely = (_vote(points, means, along > share * own, own) for share in (_ALONG, _SURELY))
    near = np.asarray(KDTree(means).query(points)[1])
    belongs = np.zeros(len(points), bool)
    for piece in linked(points[likely], cue, voxel):
        chosen = KDTree(piece).query(points)[0] == 0
        best = int(np.argmax(support[:, np.unique(near[chosen])].sum(1)))
        clear = surely[chosen].mean() > 0.5 and 0 < best < len(AROUND) - 1
        belongs |= chosen & bool(clear and one_box_holds(part, piece, 0.5 * voxel, cue.hollow))
    return belongs


def _pooled(means: Points, support: Float64[np.ndarray, "F N"]) -> Float64[np.ndarray, "F N"]:
    """The mean support of each splat and its neighbours."""
    return support[:, KDTree(means).query(means, k=min(_POOL, len(means)))[1]].mean(2)


def _vote(
    points: Points, means: Points, yes: Bool[np.ndarray, " N"], weight: Float64[np.ndarray, " N"]
) -> Bool[np.ndarray, " P"]:
    """Which points have about them more weight of splats that say yes than of others."""
    near = KDTree(means).query(points, k=min(_VOTERS, len(means)))[1]
    return np.where(yes, weight, -weight)[near].sum(1) > 0


def cut_across(
    points: Points,
    box: Box,
    places: Float64[np.ndarray, "N 3"],
    support: Float64[np.ndarray, "F N"],
    screw: Screw,
    voxel: float,
    together: float,
    each: float,
    again: bool = True,
) -> list[tuple[Bool[np.ndarray, " P"], int]]:
    """The points of one cluster, cut where pieces of it would rather go ways of their own along its motion.

    Drawers side by side and doors one above the other are one cluster if they touch, and shut they show their fronts alone,
    flush with what stands still.

    Args:
        points: of the cluster, in the world.
        box: around them.
        places: of splats, in the box's canonical space: the cluster's, and of what shows in the other state where it was.
        support: of each of them for each of the factors, moved there or brought back (see `Scene.support`).
        screw: along which the cluster moves as a whole; cuts leave its way uncut.
        voxel: of the hull, world units.
        together: the pieces must explain so many times what they do as one...
        each: ...and every cut so many times what was explained before it.
        again: whether the pieces are cut in their turn.

    Returns:
        Of each piece, which points are its own, and the index of the factor that suits it.
    """
    towards = (box.T_world_box.rotation.T @ screw.axis).abs()
    unmoved = towards < 0.2 if screw.kind == "prismatic" else towards > 0.98
    wide = box.half_extents > _NARROWEST * voxel  # room for two
    axes = [int(axis) for axis in torch.nonzero(unmoved & wide).flatten()]
    common = float(support.sum(1).max())
    local = box.to_canonical(torch.from_numpy(points)).numpy()
    pieces = _cut(places, support, local, axes, each, (_EACH * common, _EACH * len(local)), again)
    if sum(float(reached.max()) for _, reached in pieces) < together * common:
        pieces = [(_everywhere(), support.sum(1))]
    within = [np.all((local > low) & (local <= high), axis=1) for (low, high), _ in pieces]
    return [(inside, int(reached.argmax())) for inside, (_, reached) in zip(within, pieces, strict=True)]


def _everywhere() -> Float64[np.ndarray, "2 3"]:
    return np.array([[-np.inf] * 3, [np.inf] * 3])


def _cut(
    fronts: Float64[np.ndarray, "N 3"],
    support: Float64[np.ndarray, "F N"],
    points: Float64[np.ndarray, "P 3"],
    axes: list[int],
    better: float,
    least: tuple[float, float],
    again: bool,
) -> list[tuple[Float64[np.ndarray, "2 3"], Float64[np.ndarray, " F"]]]:
    """Lowest and highest corner of the pieces that had each better move by itself, and what each reaches for each factor.

    Args:
        fronts: places of splats.
        support: of each splat for each factor of a motion.
        points: of what is cut.
        axes: across which cuts are allowed.
        better: how many times as much as before is reached after a cut.
        least: what each piece must reach, and how many points it must hold.
        again: whether the pieces are cut in their turn.
    """
    best, found = better * float(support.sum(1).max()), None
    for axis in axes:
        order = np.argsort(fronts[:, axis], kind="stable")
        levels = (fronts[order[:-1], axis] + fronts[order[1:], axis]) / 2
        below = support[:, order].cumsum(1)[:, :-1]
        sides = below.max(0), (support.sum(1)[:, None] - below).max(0)
        held = np.searchsorted(np.sort(points[:, axis]), levels, side="right")
        allowed = (np.minimum(*sides) > least[0]) & (np.minimum(held, len(points) - held) > least[1])
        both = np.where(allowed, np.add(*sides), -np.inf)
        if len(both) and both.max() > best:
            best, found = both.max(), (axis, levels[both.argmax()])
    if found is None:
        return [(_everywhere(), support.sum(1))]
    axis, level = found
    low, under = fronts[:, axis] <= level, points[:, axis] <= level
    axes = axes if again else []
    below = _cut(fronts[low], support[:, low], points[under], axes, better, least, again)
    above = _cut(fronts[~low], support[:, ~low], points[~under], axes, better, least, again)
    for bounds, _ in below:
        bounds[1, axis] = min(bounds[1, axis], level)
    for bounds, _ in above:
        bounds[0, axis] = max(bounds[0, axis], level)
    return [*below, *above]

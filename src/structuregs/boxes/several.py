"""Whether what one motion puts in place best is several parts, by the ways along which its pieces would rather go."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float64

from ..geometry import SE3, Screw, screw_at, straightened
from ..joints import kind_of
from .config import SearchConfig
from .cue import Points
from .divide import FACTORS, FINELY, cut_across, divide, nearest_of
from .judge import Trial
from .pieces import MovingPart, Pieces

_ALIGNED = 0.9998  # cosine between two axes: a degree

_Way = tuple[Screw, float]


def is_unclear(part: MovingPart, trial: Trial, config: SearchConfig) -> bool:
    """Whether a part explains so little of what it could that it may be several."""
    return trial.explained(part.hypothesis) < config.clear_case * trial.most


def several_in(part: MovingPart, trial: Trial, pieces: Pieces, known_cut: bool) -> list[Points]:
    """The points of a part as those of several, if it turns out to be several parts; else all of them.

    Along one way, what shows in the other state says splat by splat how far it would rather go.  Of several ways the one
    counts along which the pieces then explain most.  What was shut there says it by its fronts: unless the part was cut
    before, it is also cut across where its pieces had better go further or less far.

    Args:
        part: as it was found, with its rivals.
        trial: the part between the photos.
        pieces: all that moves.
        known_cut: whether the part is a piece of what was cut or divided.
    """
    config = pieces.config
    ways, also = _ways(part, trial, pieces)
    shows = trial.shows(part.hypothesis)
    if not shows or not is_unclear(part, trial, config):
        also = []
    tried = [_motions(way, FACTORS) for way in [*ways, *also]]
    supports = [trial.there.support(trial.piece, motions) for motions in tried] if shows else [None] * len(ways)
    divisions = [_divided(part, trial, pieces, support) for support in supports if support is not None]
    best = max((division for division in divisions if len(division[0]) > 1), key=lambda division: division[1], default=None)
    if best is not None:
        return best[0]
    if known_cut:
        return [part.points]
    for way, support in zip(ways, supports, strict=False):  # not along what rivals add
        together = config.cut_shut if support is None else config.cut
        cut = _cut(part, trial, way, FACTORS, support, pieces.voxel, together, config.cut)
        if len(cut) > 1:
            return [part.points[within] for within, _ in cut]
    return [part.points]


def _ways(part: MovingPart, trial: Trial, pieces: Pieces) -> tuple[list[_Way], list[_Way]]:
    """A part's own way and, if that leans, the same along the base; and those of its rivals, along the base, that differ.

    Several that go different ways along one line, as doors above each other do, look best together when askew, and drawers
    when turned a little about a line far off.  What differs is of another type or along another axis.
    """
    place, base = trial.box.T_world_box.xyz, pieces.base_box
    own = screw_at(part.hypothesis.motion, kind_of(part.hypothesis.motion), place)
    straight = straightened(*own, base)
    ways = [own] if float(straight[0].axis @ own[0].axis) > _ALIGNED else [own, straight]
    asked, also = [straight[0]], []
    for rival in part.rivals:
        screw, q = straightened(*screw_at(rival.motion, kind_of(rival.motion), place), base)
        if all(screw.kind != other.kind or float(screw.axis @ other.axis) < _ALIGNED for other in asked):
            asked.append(screw)
            also.append((screw, q))
    return ways, also


def nearly_alike(part: MovingPart, trial: Trial, pieces: Pieces) -> list[MovingPart]:
    """A part as several that touch and go nearly as far along its way, such as doors above each other; or as it is.

    So little of a difference is told only where the photos see all else in its place.

    Args:
        part: as it was found.
        trial: the part between the photos, with all other parts in place.
        pieces: all that moves.
    """
    config, motion = pieces.config, part.hypothesis.motion
    screw, q = screw_at(motion, kind_of(motion), trial.box.T_world_box.xyz)
    motions = _motions((screw, q), FINELY)
    there = trial.there.support(trial.piece, motions)
    cut = _cut(part, trial, (screw, q), FINELY, there, pieces.voxel, config.cut_finely, config.cut_finely)
    if len(cut) == 1:
        return [part]
    found = []
    for within, factor in cut:
        inside = np.split(within, np.cumsum([len(points) for points in part.pieces])[:-1])
        own = tuple(points[some] for points, some in zip(part.pieces, inside, strict=True) if some.any())
        one = replace(part, pieces=own, hypothesis=trial.moved(part.hypothesis, motions[factor]), rivals=())
        scene, splats = pieces.parted(pieces.held_by_part(one), one.state)
        found.append(replace(one, weight=scene.needs(splats)))

    def error(ways: list[SE3]) -> float:
        return trial.apart((pieces.splats_of(one), pieces.box(one.points), way) for one, way in zip(found, ways, strict=True))

    ways = [one.hypothesis.motion for one in found]
    as_one = min(error([way] * len(found)) for way in [motion, *ways])
    weights = sorted(one.weight for one in found)
    return found if as_one - error(ways) > config.unlike * sum(weights[:-1]) else [part]


def _motions(way: _Way, factors: tuple[float, ...]) -> SE3:
    """Less far and farther along a way."""
    return way[0].motion(way[1] * torch.tensor(factors, dtype=torch.float64))


def _divided(part: MovingPart, trial: Trial, pieces: Pieces, support: Float64[np.ndarray, "F N"]) -> tuple[list[Points], float]:
    """The points of a part, divided by how far along one way its splats would rather go, and what the pieces reach there."""
    config, means = pieces.config, trial.piece.means.double().numpy()
    least = config.divided * part.weight * trial.there.pixels
    several = divide(part.points, means, support, config.mixed, least, config.cue, pieces.voxel)
    nearest = nearest_of(several, means)
    return several, sum(float(support[:, nearest == k].sum(1).max()) for k in range(len(several)))


def _cut(
    part: MovingPart,
    trial: Trial,
    way: _Way,
    factors: tuple[float, ...],
    there: Float64[np.ndarray, "F N"] | None,
    voxel: float,
    together: float,
    each: float,
) -> list[tuple[Bool[np.ndarray, " P"], int]]:
    """`cut_across` of a part's points, where its pieces had better go further or less far along one way."""
    box, motions = trial.box, _motions(way, factors)
    others = trial.others.means.double()
    fronts = trial.others[torch.stack([box.moved(motions[f]).contains(others) for f in range(len(factors))]).any(0)]
    support = trial.here.support(fronts, motions.inverse())
    places = box.moved(way[0].motion(way[1])).to_canonical(fronts.means.double()).numpy()
    if there is not None:
        support = np.concatenate([support, there], 1)
        places = np.concatenate([places, box.to_canonical(trial.piece.means.double()).numpy()])
    return cut_across(part.points, box, places, support, way[0], voxel, together, each)

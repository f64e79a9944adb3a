"""Whether what one motion puts in place best is several parts, by the ways along which its pieces would rather go."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64

from ..geometry import SE3, Box, Screw, screw_at, straightened
from ..joints import kind_of
from .config import SearchConfig
from .cue import Points, box_around
from .divide import FACTORS, FINELY, cut_across, divide, nearest_of
from .hypotheses import square_about
from .judge import Trial
from .pieces import MovingPart, Pieces

_ALIGNED = 0.9998  # cosine between two axes: a degree
_CRUMB = 0.2  # of the weight of two that go nearly as far: what has less is a crumb of something else

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
    ways, also = _ways(part, trial, pieces)
    shows = trial.shows(part.hypothesis)
    if not shows or not is_unclear(part, trial, pieces.config):
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
        cut = _cut(part, trial, pieces, way, support)
        if len(cut) > 1:
            return cut
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
    """A part as two that touch and go nearly as far along its way, such as doors above each other; or as it is.

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
    axes = square_about(screw.axis, pieces.base_box)
    frame = box_around(part.points, 0.5 * pieces.voxel, axes=axes)  # the least box around doors ajar may lie askew
    support, places = _asked(trial, frame, (screw, q), FINELY, there)
    least = config.cut_finely
    cut = cut_across(part.points, frame, places, support, screw, pieces.voxel, least, least, again=False)
    if len(cut) == 1:
        return [part]
    found, placed = [], []
    for within, factor in cut:
        inside = np.split(within, np.cumsum([len(points) for points in part.pieces])[:-1])
        own = tuple(points[some] for points, some in zip(part.pieces, inside, strict=True) if some.any())
        one = replace(part, pieces=own, hypothesis=trial.moved(part.hypothesis, motions[factor]), rivals=())
        scene, splats = pieces.parted(pieces.held_by_part(one), one.state)
        found.append(replace(one, weight=scene.needs(splats)))
        placed.append((splats, pieces.box(one.points)))

    def error(ways: list[SE3]) -> float:
        return trial.apart((*piece, way) for piece, way in zip(placed, ways, strict=True))

    ways = [one.hypothesis.motion for one in found]
    as_one = min(error([way] * len(found)) for way in [motion, *ways])
    weights = [one.weight for one in found]
    if min(weights) < _CRUMB * sum(weights) or as_one - error(ways) < config.unlike * min(weights):
        return [part]
    return found


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


def _cut(part: MovingPart, trial: Trial, pieces: Pieces, way: _Way, there: Float64[np.ndarray, "F N"] | None) -> list[Points]:
    """The points of a part, cut across where its pieces had better go further or less far along one way."""
    config = pieces.config
    support, places = _asked(trial, trial.box, way, FACTORS, there)
    together = config.cut_shut if there is None else config.cut
    cut = cut_across(part.points, trial.box, places, support, way[0], pieces.voxel, together, config.cut)
    return [part.points[within] for within, _ in cut]


def _asked(
    trial: Trial, frame: Box, way: _Way, factors: tuple[float, ...], there: Float64[np.ndarray, "F N"] | None
) -> tuple[Float64[np.ndarray, "F M"], Float64[np.ndarray, "M 3"]]:
    """What splats say for each of some factors of a part's way, and where in a box around the part they are.

    These are the splats of what shows in the other state where the part may be, brought back, and the part's own.

    Args:
        trial: the part between the photos.
        frame: the box.
        way: the part's.
        factors: of it.
        there: what the part's own splats say; None if the other state does not show them.
    """
    box, motions = trial.box, _motions(way, factors)
    others = trial.others.means.double()
    fronts = trial.others[torch.stack([box.moved(motions[f]).contains(others) for f in range(len(factors))]).any(0)]
    support = trial.here.support(fronts, motions.inverse())
    places = frame.moved(way[0].motion(way[1])).to_canonical(fronts.means.double()).numpy()
    if there is None:
        return support, places
    own = frame.to_canonical(trial.piece.means.double()).numpy()
    return np.concatenate([support, there], 1), np.concatenate([places, own])

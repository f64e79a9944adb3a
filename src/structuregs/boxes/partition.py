"""From clusters of what moved to moving parts: each a box in state 0 and the motion that the photos like best."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float64

from ..geometry import SE3, Box
from ..model import Splats
from .cue import Cluster, CueConfig, box_around, clusters
from .hypotheses import Hypothesis, candidate_motions, displacement, distinct, hull_scores
from .judge import StateLook, photo_error, refine


@dataclass(frozen=True)
class SearchConfig:
    """How widely motions are searched."""

    cue: CueConfig = field(default_factory=CueConfig)
    """The motion cue."""
    shortlist: int = 150
    """Hypotheses per cluster that pass the hull and are shown to the photos."""
    finalists: int = 6
    """Distinct hypotheses per cluster that the photos pull into place."""
    looks: int = 8
    """Photos of the other state that judge the shortlist."""
    steps: int = 48
    """Optimiser steps for each finalist."""
    rate: float = 0.03
    """Of a finalist's pose: radians, and parts of the box's half diagonal."""
    worth: float = 0.01
    """A part is kept if it takes at least this fraction off the other state's photo error."""


@dataclass(frozen=True)
class MovingPart:
    """A rigid part as the search found it.

    Attributes:
        state: the state whose cluster it was found by.
        points: of its surface, in that state, in the world.
        hypothesis: its motion from `state` to the other state.
        rivals: what the photos thought of the next best distinct motions.
    """

    state: int
    points: Float64[np.ndarray, "P 3"]
    hypothesis: Hypothesis
    rivals: tuple[Hypothesis, ...] = ()

    @property
    def motion(self) -> SE3:
        """From state 0 to state 1, in the world, float64."""
        return self.hypothesis.motion.inverse() if self.state else self.hypothesis.motion

    def points_in(self, state: int) -> Float64[np.ndarray, "P 3"]:
        """Its points as they stand in a state."""
        points = torch.from_numpy(self.points)
        return (points if state == self.state else self.hypothesis.motion.apply(points)).numpy()


class PartSearch:
    """Turns clusters into moving parts, one after the other, the largest first."""

    def __init__(self, looks: tuple[StateLook, StateLook], config: SearchConfig, seed: int):
        self.looks = looks
        self.config = config
        self.generator = np.random.default_rng(seed)
        self.voxel = looks[0].hull.voxel
        self.clusters = clusters((looks[0].points, looks[1].points), (looks[0].hull, looks[1].hull), config.cue)
        self.boxes = [self._box(cluster.points) for cluster in self.clusters]
        self.base_box = self._box(self._still_points())

    def _box(self, points: Float64[np.ndarray, "P 3"]) -> Box:
        return box_around(points, thinnest=0.5 * self.voxel)

    def _still_points(self) -> Float64[np.ndarray, "P 3"]:
        """Points of either state that no cluster holds."""
        rows = []
        for state, look in enumerate(self.looks):
            still = np.ones(len(look.points), bool)
            for cluster, box in zip(self.clusters, self.boxes, strict=True):
                if cluster.state == state:
                    still &= ~box.contains(torch.from_numpy(look.points), margin=self.voxel).numpy()
            rows.append(look.points[still])
        return max(rows, key=len)

    def _inside(self, splats: Splats, boxes: list[Box]) -> torch.Tensor:
        inside = torch.zeros(len(splats), dtype=torch.bool)
        for box in boxes:
            inside |= box.contains(splats.means.double(), margin=self.voxel)
        return inside

    def _judges(self, state: int) -> np.ndarray:
        count = len(self.looks[state].stack)
        return np.unique(np.linspace(0, count - 1, min(self.config.looks, count)).round().astype(int))

    def search(self, note: Callable[[str], None]) -> list[MovingPart]:
        """All moving parts, with the motions that the photos prefer; unsorted and not yet merged."""
        parts: list[MovingPart] = []
        explained: set[int] = set()
        for index, cluster in enumerate(self.clusters):
            if index in explained:
                continue
            part, gain = self._try(cluster, self.boxes[index], parts, explained)
            if gain < self.config.worth:
                continue
            parts.append(part)
            explained |= self._explained_by(part, self.boxes[index])
            note(f"cluster of {len(cluster.points)} points in state {cluster.state}: photo error {part.hypothesis.image_error:.4f}")
        return parts

    def _explained_by(self, part: MovingPart, box: Box) -> set[int]:
        """Clusters of the other state that lie where the part has moved to."""
        landed = box.moved(part.hypothesis.motion)
        found = set()
        for index, cluster in enumerate(self.clusters):
            if cluster.state != part.state:
                inside = landed.contains(torch.from_numpy(cluster.points), margin=3 * self.voxel)
                if float(inside.double().mean()) > 0.6:
                    found.add(index)
        return found

    def _try(self, cluster: Cluster, box: Box, parts: list[MovingPart], explained: set[int]) -> tuple[MovingPart, float]:
        """The best motion of one cluster, and the fraction of the photo error that it saves against leaving it out."""
        state, other = cluster.state, 1 - cluster.state
        own, target = self.looks[state], self.looks[other]
        rivals = [
            (c, b) for i, (c, b) in enumerate(zip(self.clusters, self.boxes, strict=True)) if c.state == other and i not in explained
        ]
        motions = candidate_motions(box, self.base_box, [b for _, b in rivals])
        sample = self._sample(cluster.points, 300)
        arrivals = self._sample(np.concatenate([c.points for c, _ in rivals]), 300) if rivals else np.zeros((0, 3))
        outside, unexplained = hull_scores(motions, sample, target.hull, arrivals, box)
        ranked = np.argsort(outside + unexplained, kind="stable")[: self.config.shortlist]

        in_cluster = self._inside(own.splats, [box])
        in_any = self._inside(own.splats, [b for c, b in zip(self.clusters, self.boxes, strict=True) if c.state == state])
        piece = own.splats[in_cluster]
        rest = Splats.concatenate([own.splats[~in_any & ~in_cluster], *self._placed(parts, state, other)])
        views = self._judges(other)
        absent = photo_error(rest, piece[:0], SE3.identity(dtype=torch.float64), target.stack, views)
        judged = []
        for m in ranked:
            error = photo_error(rest, piece, motions[int(m)], target.stack, views)
            judged.append(Hypothesis(motions[int(m)], float(outside[m]), float(unexplained[m]), error))
        judged.sort(key=lambda hypothesis: hypothesis.image_error)
        finalists = distinct(judged, box, 0.15, self.config.finalists)
        refined = [
            refine(h, rest, piece, box, target.stack, views, self.config.steps, self.config.rate) for h in finalists
        ]
        refined.sort(key=lambda hypothesis: hypothesis.image_error)
        refined = distinct(refined, box, 0.1, len(refined))
        part = MovingPart(state, cluster.points, refined[0], tuple(refined[1:]))
        return part, (absent - refined[0].image_error) / absent

    def _placed(self, parts: list[MovingPart], state: int, other: int) -> list[Splats]:
        """Splats of the parts found so far, as they stand in state `other`, taken from the state that shows them."""
        rows = []
        for part in parts:
            source = self.looks[part.state].splats
            piece = source[self._inside(source, [self._box(part.points)])]
            rows.append(piece.moved(part.hypothesis.motion) if part.state == state else piece)
        return rows

    def _sample(self, points: Float64[np.ndarray, "P 3"], most: int) -> Float64[np.ndarray, "Q 3"]:
        return points if len(points) <= most else points[self.generator.choice(len(points), most, replace=False)]

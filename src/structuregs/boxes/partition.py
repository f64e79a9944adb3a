"""From clusters of what moved to moving parts: each a box in state 0 and the motion that the photos like best."""

import itertools
from collections.abc import Generator
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree
from torch import Tensor

from ..capture import spread_cameras
from ..geometry import SE3, Box, screw_at
from ..joints import kind_of
from ..model import Splats
from .cue import Cluster, CueConfig, StateLook, box_around, clusters
from .divide import FACTORS, divide
from .hypotheses import Hypothesis, candidate_motions, displacements, distinct, flips, hull_scores, oddity, stack_motions
from .judge import NOISE, Scene, measured, refine, simplest


@dataclass(frozen=True)
class SearchConfig:
    """How widely motions are searched."""

    cue: CueConfig = field(default_factory=CueConfig)
    """The motion cue."""
    most: int = 12
    """Clusters that are looked at, the largest first, of twice as many."""
    mixed: float = 1.6
    """A cluster holds several parts if its splats, each with as much or as little of the motion as suits it, would take this
    many times as much off the photos' error as with one motion for all; of single parts it is .95 to 1.25 times..."""
    divided: float = 0.06
    """...and by more than this share of the cluster's weight: what hardly shows in the other state says nothing."""
    together: int = 3
    """A part may show as several clusters of a state: the boxes of so many with any one are laid upon the other state's."""
    there: float = 0.12
    """A cluster whose absence costs the photos of its own state less than this, in mean error of the pixels that show it, is
    no surface, but splats in the air before one that few views see; surfaces come out at .15 to 1, these below .1."""
    clear: float = 3.0
    """Splats this near to a cluster's box, in voxels, belong to it."""
    shortlist: int = 110
    """Hypotheses per cluster that pass the hull and are shown to the photos."""
    finalists: int = 3
    """Distinct hypotheses per cluster that the photos pull into place: so many of the photos' choice and of the masks'."""
    looks: int = 16
    """Photos of the other state that judge the shortlist."""
    steps: int = 40
    """Optimiser steps for each finalist."""
    rate: float = 0.03
    """Of a finalist's pose: radians, and parts of the box's half diagonal."""
    same: float = 0.15
    """Two parts may be one if their motions are this close, over the half diagonal of the one..."""
    alike: float = 0.12
    """...and if moving it just like the other costs the photos less than this fraction of the part's weight."""
    shown: float = 0.2
    """Clusters are moved together if the photos of the other state then show this share of the weight of each."""
    large: float = 0.01
    """A part that holds this fraction of its state's points came from somewhere: it is kept if it does little harm..."""
    harm: float = 0.01
    """...and adds less than this fraction to the photo error; what is shut may show in no photo."""


@dataclass(frozen=True)
class MovingPart:
    """A rigid part as the search found it.

    Attributes:
        state: the state whose cluster it was found by.
        pieces: points of its surface, in that state, in the world: those of each cluster that it was found as.
        hypothesis: its motion from `state` to the other state.
        gain: fraction that it takes off the error of the other state's photos.
        weight: what the photos of its own state would lose without it, in mean error.
        rivals: what the photos thought of the next best distinct motions.
    """

    state: int
    pieces: tuple[Float64[np.ndarray, "_ 3"], ...]
    hypothesis: Hypothesis
    gain: float
    weight: float
    rivals: tuple[Hypothesis, ...] = ()

    @property
    def points(self) -> Float64[np.ndarray, "P 3"]:
        """All of its points, in its own state."""
        return np.concatenate(self.pieces)

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
        found = clusters(looks, config.cue)
        still = self._still_points(found)
        self.base_box, self.still = self._box(still), KDTree(still)
        moving = [[cluster.points for cluster in found if cluster.state == state] for state in (0, 1)]
        self.moving = [KDTree(np.concatenate([np.zeros((0, 3)), *points])) for points in moving]
        # Of each cluster: its box, its splats among its state's, and what the photos of its state lose without it.
        self.clusters: list[Cluster] = []
        self.boxes: list[Box] = []
        self.held: list[Bool[Tensor, " N"]] = []
        self.weights: list[float] = []
        self.apart: dict[int, int] = {}  # clusters that were one but do not move together, with that one's index
        for cluster in found[: 2 * config.most]:
            if len(self.clusters) < config.most:
                self._take(cluster)
        self.left_over: list[tuple[int, float]] = []  # state and share of its points of large clusters in no part

    def _box(self, points: Float64[np.ndarray, "P 3"]) -> Box:
        return box_around(points, thinnest=0.5 * self.voxel)

    def _still_points(self, found: list[Cluster]) -> Float64[np.ndarray, "P 3"]:
        """Points of either state that none of these clusters holds; all points of state 0 where they hold everything."""
        rows = []
        for state, look in enumerate(self.looks):
            still = np.ones(len(look.points), bool)
            for cluster in found:
                if cluster.state == state:
                    still &= ~self._box(cluster.points).contains(torch.from_numpy(look.points), margin=self.voxel).numpy()
            rows.append(look.points[still])
        return max(rows, key=len) if any(map(len, rows)) else self.looks[0].points

    def _take(self, cluster: Cluster) -> None:
        """Takes a cluster among those to explain, if the photos of its own state need it where they show it."""
        splats = self.looks[cluster.state].splats
        held = self._held(cluster.points, cluster.state)
        scene, piece = self._scene(cluster.state, splats[~held]), splats[held]
        weight = scene.absent(piece) - scene.error(piece, SE3.identity(dtype=torch.float64))
        if weight > self.config.there * scene.footprint(piece):
            self.clusters.append(cluster)
            self.boxes.append(self._box(cluster.points))
            self.held.append(held)
            self.weights.append(weight)

    def _divided(self, part: MovingPart, members: set[int], parts: list[MovingPart]) -> list[int]:
        """Indices of new clusters in place of those of a part, if these turn out to be several parts; none otherwise."""
        box = self._box(part.points)
        screw, q = screw_at(part.hypothesis.motion, kind_of(part.hypothesis.motion), box.T_world_box.xyz)
        piece = self._piece(members)
        scene = self._scene(1 - part.state, self._rest(parts, part.state))
        support = scene.support(piece, screw.motion(q * torch.tensor(FACTORS, dtype=torch.float64)))
        means = piece.means.double().numpy()
        least = self.config.divided * part.weight * scene.look.stack.alpha[scene.views].size
        pieces = divide(part.points, means, support, self.config.mixed, least, self.config.cue, self.voxel)
        before = len(self.clusters)
        if len(pieces) > 1:
            for points in sorted(pieces, key=len, reverse=True):
                self._take(Cluster(part.state, points))
            origin = self.apart.get(min(members), min(members))
            self.apart |= dict.fromkeys(range(before, len(self.clusters)), origin)
        return list(range(before, len(self.clusters)))

    def _splats_of(self, part: MovingPart) -> Splats:
        """A part's splats in its own state: its pieces', as one box around all may hold some of the base."""
        held = [self._held(points, part.state) for points in part.pieces]
        return self.looks[part.state].splats[torch.stack(held).any(0)]

    def _held(self, points: Float64[np.ndarray, "P 3"], state: int) -> Bool[Tensor, " N"]:
        """Which splats of a state lie in the box of points or near it, and no nearer to what else moved."""
        means = self.looks[state].splats.means.double()
        held = self._box(points).contains(means, margin=self.config.clear * self.voxel)
        inside = means[held].numpy()
        held[held.clone()] = torch.from_numpy(
            KDTree(points).query(inside)[0] < self.moving[state].query(inside)[0] + 0.5 * self.voxel
        )
        return held

    def _scene(self, state: int, rest: Splats) -> Scene:
        """A state's photos, some that are well apart, as judges of a part among all the rest."""
        views = spread_cameras(self.looks[state].stack.cameras, self.config.looks)
        return Scene(self.looks[state], rest, np.array(views), self.still)

    def search(self, count: int | None) -> list[MovingPart]:
        """The moving parts with the motions that the photos prefer: all that explain something, or the `count` best."""
        steps = self.steps()
        while True:
            try:
                next(steps)
            except StopIteration as done:
                return done.value[:count]

    def steps(self) -> Generator[int, None, list[MovingPart]]:
        """The search, bit by bit: yields how many clusters are done with, and returns the parts, the best first."""
        parts: list[MovingPart] = []
        explained: set[int] = set()
        refused: dict[int, tuple[int, float]] = {}
        count = len(self.clusters)
        todo = list(range(count))
        while todo:
            index = todo.pop(0)
            yield min(index, count)
            if index in explained:
                continue
            part, members = self._try(index, parts, explained)
            if part.gain > NOISE and (pieces := self._divided(part, members, parts)):
                explained |= members
                todo = pieces + todo
                continue
            share = len(part.points) / len(self.looks[part.state].points)
            large = share > self.config.large
            if part.gain < (-self.config.harm if large else NOISE):
                if large:
                    refused[index] = (part.state, share)
                continue
            parts.append(part)
            explained |= members | self._explained_by(part)
        self.left_over = [what for index, what in refused.items() if index not in explained]
        parts = self._settled(self._without_pieces(self._reconsider(parts)))
        return sorted(parts, key=lambda part: -part.weight)

    def _reconsider(self, parts: list[MovingPart]) -> list[MovingPart]:
        """Looks at each part again with all others in place; one that may as well move like another becomes one with it."""
        parts = list(parts)
        index = 0
        while index < len(parts) > 1:
            part, others = parts[index], parts[:index] + parts[index + 1 :]
            state = part.state
            box, piece, scene, absent = self._again(part, others)
            shared = [p.motion if state == 0 else p.motion.inverse() for p in others]
            own = part.hypothesis
            guests = [scene.moved(own, T, box) for T in shared]
            starts = [own, *part.rivals[:2], *guests]
            again = [self._pulled(h, scene, piece, box, absent, part.weight, self.config.steps) for h in starts]
            by_cost = sorted(again, key=lambda h: h.cost(part.weight))
            gaps = displacements(stack_motions(shared), by_cost[0].motion, box)
            as_they_move = np.array([scene.error(piece, T) for T in shared])
            losses = as_they_move - min(h.image_error for h in again)
            alike = (gaps < self.config.same) & (losses < self.config.alike * part.weight)
            # A piece that continues a weightier part, and has no better motion of its own than that part's, belongs to it.
            needless = as_they_move < min(h.cost(part.weight) for h in again[: -len(shared)])
            alike |= needless & np.array([other.weight > part.weight and self._continues(part, other) for other in others])

            twin = int(np.argmin(np.where(alike, as_they_move, np.inf)))
            if alike[twin]:
                follower, leader = sorted((part, others[twin]), key=lambda p: p.weight)
                parts = self._merged(leader, follower, [p for p in others if p is not others[twin]])
                index = 0
                continue
            again = by_cost
            chosen = distinct(stack_motions([h.motion for h in again]), box, 0.1, len(again))
            parts[index] = replace(part, hypothesis=again[0], rivals=tuple(again[c] for c in chosen[1:]))
            index += 1
        return parts

    def _continues(self, part: MovingPart, other: MovingPart) -> bool:
        """Whether two parts touch where the one was found (the clustering's reach), and one box holds both about as well."""
        theirs = other.points_in(part.state)
        if KDTree(theirs).query(part.points)[0].min() > self.config.cue.link * self.voxel:
            return False
        whole, *both = (float(self._box(p).volume) for p in (np.concatenate([part.points, theirs]), part.points, theirs))
        return sum(both) > self.config.cue.hollow * whole

    def _without_pieces(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, without those that lie within a larger one: what was left over before that one was whole."""
        kept: list[MovingPart] = []
        for part in sorted(parts, key=lambda part: -len(part.points)):
            points = torch.from_numpy(part.points)
            within = [
                self._box(whole.points_in(part.state)).contains(points, margin=3 * self.voxel).double().mean() for whole in kept
            ]
            if not within or max(within) < 0.6:
                kept.append(part)
        return kept

    def _again(self, part: MovingPart, others: list[MovingPart]) -> tuple[Box, Splats, Scene, float]:
        """A part's box and splats, the photos of the other state with all other parts in place, and their error without it."""
        box = self._box(part.points)
        other = 1 - part.state
        scene = self._scene(other, self._rest(others, part.state))
        piece = self._splats_of(part)
        return box, piece, scene, scene.absent(piece)

    def _settled(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts after a longer look at each and the ways it can lie, with the motions of the others as they now are."""
        parts = list(parts)
        for index, part in enumerate(parts):
            box, piece, scene, absent = self._again(part, parts[:index] + parts[index + 1 :])
            own = part.hypothesis
            starts = [own, *part.rivals[:1], *(scene.moved(own, T, box) for T in flips(own.motion, box))]
            again = [self._pulled(h, scene, piece, box, absent, part.weight, 2 * self.config.steps) for h in starts]
            best = min(again, key=lambda h: h.cost(part.weight))
            parts[index] = replace(part, hypothesis=measured(best, scene, piece, box))
        return parts

    def _pulled(
        self, start: Hypothesis, scene: Scene, piece: Splats, box: Box, absent: float, weight: float, steps: int
    ) -> Hypothesis:
        """The simplest motion that does where the photos pull a hypothesis, or the hypothesis, if all in all it is better."""
        refined = refine(start, scene, piece, box, steps, self.config.rate)
        simple = simplest(refined, scene, piece, box, self.base_box, absent)
        return min(simple, scene.judge(start, piece), key=lambda h: h.cost(weight))

    def _merged(self, leader: MovingPart, follower: MovingPart, rest: list[MovingPart]) -> list[MovingPart]:
        """The parts with two of them made one, which moves as the leader does."""
        to_leader = leader.hypothesis.motion.inverse()
        there = (
            follower.pieces
            if follower.state == leader.state
            else tuple(to_leader.apply(torch.from_numpy(points)).numpy() for points in follower.pieces)
        )
        return [replace(leader, pieces=leader.pieces + there), *rest]

    def _explained_by(self, part: MovingPart) -> set[int]:
        """Clusters of either state that lie where the part is in that state."""
        box = self._box(part.points)
        found = set()
        for index, cluster in enumerate(self.clusters):
            there = box if cluster.state == part.state else box.moved(part.hypothesis.motion)
            if float(there.contains(torch.from_numpy(cluster.points), margin=3 * self.voxel).double().mean()) > 0.6:
                found.add(index)
        return found

    def _try(self, index: int, parts: list[MovingPart], done: set[int]) -> tuple[MovingPart, set[int]]:
        """The best motion of one cluster.

        Returns:
            The part, and the indices of the clusters that move with it in its own state.
        """
        cluster, box = self.clusters[index], self.boxes[index]
        state, other = cluster.state, 1 - cluster.state
        target = self.looks[other]
        open_ = [i for i in range(len(self.clusters)) if i not in done]
        arrivals = [i for i in open_ if self.clusters[i].state == other]
        siblings = [i for i in open_ if self.clusters[i].state == state and i != index and not self._known_apart(i, index)]
        wholes = self._unions(siblings, {index})
        pairs = list(itertools.product(wholes, self._unions(arrivals, set())))
        motions = candidate_motions(wholes, self.base_box, pairs)
        landing = np.concatenate([self.clusters[i].points for i in arrivals]) if arrivals else np.zeros((0, 3))
        nothing = np.zeros((0, 3))
        rough = hull_scores(motions, self._sample(cluster.points, 40), target.hull, nothing, box)[0]
        motions = motions[np.flatnonzero(rough < rough.min() + 1.0)]
        points, landing = self._sample(cluster.points, 300), self._sample(landing, 300)
        outside, unexplained = hull_scores(motions, points, target.hull, landing, box)
        travel = displacements(motions, SE3.identity(dtype=torch.float64), box)
        ranked = np.argsort(outside + unexplained + 0.05 * travel, kind="stable")
        ranked = ranked[outside[ranked] < outside.min() + 0.5]
        ranked = ranked[distinct(motions[ranked], box, 0.12, self.config.shortlist)]
        fits = {}
        for i in siblings:
            sample = self._sample(self.clusters[i].points, 100)
            fits[i] = hull_scores(motions[ranked], sample, target.hull, nothing, self.boxes[i])[0] < 0.8

        scene = self._scene(other, self._rest(parts, state))
        absent = scene.absent(target.splats)
        judged: list[tuple[Hypothesis, frozenset[int]]] = []
        for row, m in enumerate(ranked):
            motion = motions[int(m)]
            start = Hypothesis(motion, float(outside[m]), float(unexplained[m]), oddity(motion, box, self.still))
            alone = scene.judge(start, self._piece({index}), quick=True)
            judged.append((alone, frozenset()))
            if together := frozenset(i for i in siblings if fits[i][row]):
                joined = scene.judge(start, self._piece({index, *together}), quick=True)
                share = self.config.shown * sum(self.weights[i] for i in together)
                if joined.image_error < alone.image_error - share:
                    others = scene.error(self._piece(set(together)), motion, quick=True)
                    if joined.image_error < others - self.config.shown * self.weights[index]:
                        judged.append((joined, together))
        weight = self.weights[index]
        refined = []
        for start, group in self._finalists(judged, box, weight):
            piece = self._piece({index, *group})
            refined.append((self._pulled(start, scene, piece, box, absent, weight, self.config.steps), group))
        refined.sort(key=lambda row: row[0].cost(weight))
        chosen = distinct(stack_motions([h.motion for h, _ in refined]), box, 0.1, len(refined))
        refined = [refined[c] for c in chosen]
        best, group = refined[0]
        members = {index, *self._shown(best, index, group, scene)}
        best = measured(best, scene, self._piece(members), box)
        pieces = tuple(self.clusters[i].points for i in sorted(members))
        gain = (absent - best.image_error) / absent
        return MovingPart(state, pieces, best, gain, weight, tuple(rival for rival, _ in refined[1:])), members

    def _shown(self, best: Hypothesis, index: int, group: frozenset[int], scene: Scene) -> set[int]:
        """The clusters of a group that the photos miss if they do not move along."""
        if not group:
            return set()
        everything = scene.error(self._piece({index, *group}), best.motion)
        without = {i: scene.error(self._piece({index, *group} - {i}), best.motion) for i in group}
        return {i for i, error in without.items() if error - everything > self.config.shown * self.weights[i]}

    def _known_apart(self, one: int, other: int) -> bool:
        return one in self.apart and self.apart[one] == self.apart.get(other)

    def _unions(self, indices: list[int], always: set[int]) -> list[Box]:
        """Boxes of what may be one part: the clusters in `always` with none, one, two or all of the largest others."""
        largest = indices[: self.config.together]
        groups = {frozenset(always | set(some)) for n in (0, 1, 2, len(largest)) for some in itertools.combinations(largest, n)}
        points = [np.concatenate([self.clusters[i].points for i in sorted(g)]) for g in sorted(groups, key=sorted) if g]
        return [self._box(p) for p in points]

    def _finalists(
        self, judged: list[tuple[Hypothesis, frozenset[int]]], box: Box, weight: float
    ) -> list[tuple[Hypothesis, frozenset[int]]]:
        """The best by the photos and, where these see little of a part or in another light, the best by the masks.

        Args:
            judged: hypotheses in the masks' order, each with the clusters that move along.
            box: of the cluster.
            weight: of the part in the photos of its own state (see `Hypothesis.cost`).
        """
        by_photos = sorted(judged, key=lambda row: row[0].cost(weight))
        rows = []
        for order in (by_photos, judged):
            chosen = distinct(stack_motions([start.motion for start, _ in order]), box, 0.15, self.config.finalists)
            rows += [order[c] for c in chosen]
        return [rows[c] for c in distinct(stack_motions([start.motion for start, _ in rows]), box, 0.02, len(rows))]

    def _piece(self, members: set[int]) -> Splats:
        """The splats of the clusters in `members`, all of one state."""
        splats = self.looks[self.clusters[min(members)].state].splats
        return splats[torch.stack([self.held[i] for i in sorted(members)]).any(0)]

    def _rest(self, parts: list[MovingPart], state: int) -> Splats:
        """All that stands still in `state`, with the parts found so far as they stand in the other state."""
        splats = self.looks[state].splats
        moving = torch.zeros(len(splats), dtype=torch.bool)
        for cluster, held in zip(self.clusters, self.held, strict=True):
            if cluster.state == state:
                moving |= held
        return Splats.concatenate([splats[~moving], *self._placed(parts, state)])

    def _placed(self, parts: list[MovingPart], state: int) -> list[Splats]:
        """Splats of the parts found so far as they stand in the state other than `state`, each from the one that shows it."""
        rows = []
        for part in parts:
            piece = self._splats_of(part)
            rows.append(piece.moved(part.hypothesis.motion) if part.state == state else piece)
        return rows

    def _sample(self, points: Float64[np.ndarray, "P 3"], most: int) -> Float64[np.ndarray, "Q 3"]:
        return points if len(points) <= most else points[self.generator.choice(len(points), most, replace=False)]

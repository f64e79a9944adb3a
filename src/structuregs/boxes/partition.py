"""From clusters of what moved to moving parts: each a box in state 0 and the motion that the photos like best."""

import itertools
from collections.abc import Generator
from dataclasses import replace

import numpy as np
import torch

from ..geometry import SE3, Box
from .config import SearchConfig
from .cue import Cluster, Points, StateLook, linked
from .hypotheses import (
    Hypothesis,
    candidate_motions,
    displacements,
    distinct,
    finalists,
    hull_scores,
    oddity,
    stack_motions,
)
from .judge import NOISE, Scene, Trial
from .pieces import MovingPart, Pieces
from .progress import Division, Found, Known, Progress, undivided, worth_more
from .refine import just_out_of_sight, measured, shortest_out_of_sight
from .review import PartReview
from .several import is_unclear, several_in

_CLAIM = 0.1  # of a cluster's points: so much of it moves along with a part found before, or it is tried as it is


class PartSearch:
    """Turns clusters into moving parts, one after the other, the largest first."""

    def __init__(self, looks: tuple[StateLook, StateLook], config: SearchConfig, seed: int):
        self.pieces = Pieces(looks, config, seed)
        self.review = PartReview(self.pieces)
        self.config = config
        self.left_over: list[tuple[int, float]] = []  # state and share of its points of large clusters in no part

    def _taken(self, state: int, points: list[Points]) -> list[int]:
        """Indices of new clusters."""
        before = len(self.pieces)
        for some in sorted(points, key=len, reverse=True):
            self.pieces.take(Cluster(state, some))
        return list(range(before, len(self.pieces)))

    def _replaced(self, index: int, points: list[Points]) -> list[int]:
        """Indices of new clusters in place of one; these do not move together."""
        new = self._taken(self.pieces.clusters[index].state, points)
        self.pieces.apart |= dict.fromkeys(new, self.pieces.apart.get(index, index))
        return new

    def _claimed(self, part: MovingPart, found: dict[int, Found]) -> MovingPart | None:
        """What is left of a part, perhaps nothing, when those found before have taken what moves along with them of it.

        Those in `found` are replaced.  None, and nothing is taken, if that is little.
        """
        left, takers = part, dict(found)
        asked = [k for k, one in found.items() if one.part.state == part.state]
        while asked and left.pieces:
            index = asked.pop(0)
            if not self.review.touch(takers[index].part, left):
                continue
            others = [one.part for k, one in takers.items() if k != index]
            taker, rest = self.review.with_claims(takers[index].part, left, others)
            if rest is not left:
                takers[index], left = replace(takers[index], part=taker), rest
                asked.insert(0, index)
        if sum(map(len, left.pieces)) > (1 - _CLAIM) * len(part.points):
            return None
        found.update(takers)
        return left

    def _out_of_sight(self, part: MovingPart, trial: Trial, parts: list[MovingPart]) -> MovingPart | None:
        """A part that nothing explains, where the other state's photos do not show it; None if they would.

        It came from somewhere: from where it was found to go, or from behind the parts found before, straight along the base.
        """
        if trial.out_of_sight(part.hypothesis.motion):
            return part
        motion = shortest_out_of_sight(trial, self.pieces.base_box) if parts else None
        if motion is None:
            return None
        bare = self.pieces.scene(1 - part.state, self.pieces.rest([], part.state))
        if not trial.in_view(motion, bare):  # it was not they that hid it
            return None
        return replace(part, hypothesis=trial.judge(trial.moved(part.hypothesis, motion)))

    def _left_of(self, index: int, parts: list[MovingPart]) -> list[int]:
        """What is left to explain of a cluster, by indices: itself, if no part lies there, or new clusters in its place."""
        cluster = self.pieces.clusters[index]
        within = [self.pieces.within(part, cluster).numpy() for part in parts]
        share = float(np.any(within, 0).mean()) if parts else 0.0
        if share < 0.1:
            return [index]
        if share > 0.6:
            return []
        return self._taken(cluster.state, linked(cluster.points[~np.any(within, 0)], self.config.cue, self.pieces.voxel))

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
        found = yield from self._found()
        return sorted(self.review.reviewed(self._whole_again(found)), key=lambda part: -part.weight)

    def _whole_again(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, two that touch made one if neither shows in the other state, and photos like one motion of both better.

        A door whose handle sticks out may be cut where the box around both is hollow.  Shut, what is plain hardly shows, and
        where its pieces went, each looked at by itself, says little.
        """
        for one, two in itertools.combinations(parts, 2):
            rest = [part for part in parts if part is not one and part is not two]
            if one.state == two.state and self.review.touch(one, two) and not self._either_shows(one, two, rest):
                whole = self._tried_as_one(one, two, rest)
                if whole is not None:
                    return self._whole_again([whole, *rest])
        return parts

    def _either_shows(self, one: MovingPart, two: MovingPart, rest: list[MovingPart]) -> bool:
        return self.review.shows(one, [*rest, two]) or self.review.shows(two, [*rest, one])

    def _tried_as_one(self, one: MovingPart, two: MovingPart, rest: list[MovingPart]) -> MovingPart | None:
        """Two parts as one, with the motion that photos like best; None if they like the two better."""
        same_state = {i for i, cluster in enumerate(self.pieces.clusters) if cluster.state == one.state}
        done = same_state.union(*(self.pieces.explained_by(part) for part in rest))
        new = self._taken(one.state, [np.concatenate([one.points, two.points])])
        if not new:
            return None
        whole, _, trial = self._try(new[0], rest, done, None)
        box, splats_of = self.pieces.box, self.pieces.splats_of
        apart = trial.apart((splats_of(part), box(part.points), part.hypothesis.motion) for part in (one, two))
        return whole if whole.hypothesis.error < apart else None

    def _found(self) -> Generator[int, None, list[MovingPart]]:
        """The parts as they are found, one after the other."""
        count = len(self.pieces)
        so_far = Progress(list(range(count)))
        while so_far.todo:
            index = so_far.todo.pop(0)
            yield min(index, count)
            if so_far.waiting.pop(index, None) is not None:
                so_far.put_first(self._left_of(index, so_far.parts))
            elif index not in so_far.explained:
                self._look_at(index, so_far)
        self.left_over = [what for index, what in so_far.refused.items() if index not in so_far.explained]
        return [one.part for one in undivided(so_far.found, so_far.divisions, so_far.explained).values()]

    def _look_at(self, index: int, so_far: Progress) -> None:
        """Makes a part of a cluster, or several; or leaves it to others, or puts it off."""
        part, members, trial = self._try(index, so_far.parts, so_far.explained, so_far.known.get(index))
        unclear = is_unclear(part, trial, self.config)
        if unclear and (left := self._claimed(part, so_far.found)) is not None:
            so_far.explained |= members
            so_far.put_first(self._taken(part.state, [left.points] if left.pieces else []))
            return
        one = Found(part, -trial.cost(part.hypothesis))
        if unclear and index not in so_far.known and self._is_open(1 - part.state, so_far):
            so_far.known[index] = part.hypothesis, frozenset(members - {index})
            so_far.put_off(index, one.worth, [len(cluster.points) for cluster in self.pieces.clusters])
            return
        explains = members | self._explained_by(part, index)
        if (first := worth_more(so_far.waiting, explains, one.worth)) is not None:
            del so_far.waiting[first]
            so_far.put_first([first, index])
            return
        worthy = part.gain > NOISE and one.worth > 0
        several = several_in(part, trial, self.pieces, index in self.pieces.apart) if worthy else [part.points]
        if len(several) > 1:
            so_far.explained |= members
            new = self._replaced(min(members), several)
            so_far.divisions.append(Division(index, one, new))
            so_far.put_first(new)
            return
        share = len(part.points) / len(self.pieces.looks[part.state].points)
        large = share > self.config.large
        kept = self._kept(one, trial, so_far.parts, large)
        if kept is not None:
            so_far.explained |= explains if kept is one else members | self._explained_by(kept.part, index)
            so_far.found[index] = kept
        elif large:
            so_far.refused[index] = (part.state, share)

    def _kept(self, one: Found, trial: Trial, parts: list[MovingPart], large: bool) -> Found | None:
        """What was found, if it explains enough; what is large need not, if it does little harm or came from out of sight."""
        if one.part.gain >= (-self.config.harm if large else NOISE):
            return one
        unseen = self._out_of_sight(one.part, trial, parts) if large else None
        return None if unseen is None else replace(one, part=unseen)

    def _is_open(self, state: int, so_far: Progress) -> bool:
        return any(self.pieces.clusters[index].state == state for index in set(so_far.todo) - so_far.explained)

    def _shortlist(self, index: int, done: set[int]) -> tuple[list[Hypothesis], list[int]]:
        """Motions that the other state's hull allows a cluster, the best first, and the clusters that may move with it."""
        pieces = self.pieces
        cluster, box = pieces.clusters[index], pieces.boxes[index]
        state, other = cluster.state, 1 - cluster.state
        hull, nothing = pieces.looks[other].hull, np.zeros((0, 3))
        open_ = [i for i in range(len(pieces)) if i not in done]
        arrivals = self._arrivals(index, done)
        siblings = [i for i in open_ if pieces.clusters[i].state == state and i != index and not self._known_apart(i, index)]
        wholes = self._unions(siblings, {index})
        pairs = list(itertools.product(wholes, self._unions(arrivals, set())))
        motions = candidate_motions([*wholes, *pieces.squared(index)], pieces.base_box, pairs)
        rough = hull_scores(motions, pieces.sample(cluster.points, 40), hull, nothing, box)[0]
        motions = motions[np.flatnonzero(rough < rough.min() + 1.0)]
        points, landing = pieces.sample(cluster.points, 300), pieces.sample(self._landing(arrivals), 300)
        outside, unexplained = hull_scores(motions, points, hull, landing, box)
        travel = displacements(motions, SE3.identity(dtype=torch.float64), box)
        ranked = np.argsort(outside + unexplained + 0.05 * travel, kind="stable")
        ranked = ranked[outside[ranked] < outside.min() + 0.5]
        ranked = ranked[distinct(motions[ranked], box, 0.12, self.config.shortlist)]
        starts = []
        for m in ranked.tolist():
            odd = oddity(motions[m], box, pieces.still)
            starts.append(Hypothesis(motions[m], float(outside[m]), float(unexplained[m]), odd))
        return starts, siblings

    def _try(
        self, index: int, parts: list[MovingPart], done: set[int], before: Known | None
    ) -> tuple[MovingPart, set[int], Trial]:
        """The best motion of one cluster.

        Args:
            index: of the cluster.
            parts: found so far.
            done: clusters that belong to a part.
            before: what it was found to do when it was tried before, if it was.

        Returns:
            The part, the indices of the clusters that move with it in its own state, and how it was tried.
        """
        pieces = self.pieces
        box, state = pieces.boxes[index], pieces.clusters[index].state
        starts, siblings = self._shortlist(index, done)
        motions = stack_motions([start.motion for start in starts])
        samples = {i: pieces.sample(pieces.clusters[i].points, 100) for i in siblings}
        hull, nothing = pieces.looks[1 - state].hull, np.zeros((0, 3))
        fits = {i: hull_scores(motions, samples[i], hull, nothing, pieces.boxes[i])[0] < 0.8 for i in siblings}
        alone = pieces.trial(state, pieces.clusters[index].points, pieces.splats_in({index}), pieces.weights[index], parts)
        judged: list[tuple[Hypothesis, frozenset[int], float]] = []
        for row, start in enumerate(starts):
            single = alone.judge(start, quick=True)
            judged.append((single, frozenset(), alone.cost(single, quick=True)))
            if together := frozenset(i for i in siblings if fits[i][row]):
                trial = self._with(alone, index, together)
                error = trial.there.error(trial.piece, start.motion, quick=True)
                if error < single.image_error - self.config.shown * sum(pieces.weights[i] for i in together):
                    others = alone.there.error(pieces.splats_in(set(together)), start.motion, quick=True)
                    if error < others - self.config.shown * alone.weight:
                        joined = replace(single, image_error=error)
                        judged.append((joined, together, trial.cost(joined, quick=True)))
        refined: list[tuple[Hypothesis, frozenset[int], float]] = []
        motions = stack_motions([start.motion for start, _, _ in judged])
        for row in finalists(motions, [cost for _, _, cost in judged], box, self.config.finalists):
            start, group, _ = judged[row]
            trial = self._with(alone, index, group)
            pulled = pieces.pulled(trial.judge(start), trial, self.config.steps)
            refined.append((pulled, group, trial.cost(pulled)))
        near = self.from_rest(index, alone, done)
        refined.append((near, frozenset(), alone.cost(near)))
        if before is not None:
            group = before[1] - done
            trial = self._with(alone, index, group)
            again = trial.judge(before[0])
            refined.append((again, group, trial.cost(again)))
        best = min(refined, key=lambda row: row[2])[0]
        if (unseen := just_out_of_sight(best, alone, pieces.base_box)) is not best:
            refined.append((unseen, frozenset(), alone.cost(unseen)))
        refined.sort(key=lambda row: row[2])
        chosen = distinct(stack_motions([h.motion for h, _, _ in refined]), box, 0.1, len(refined))
        best, group, _ = refined[0]
        members = {index, *self._shown(best, index, group, alone.there)}
        trial = self._with(alone, index, frozenset(members - {index}))
        best = measured(trial.judge(best), trial)
        points = tuple(pieces.clusters[i].points for i in sorted(members))
        rivals = tuple(refined[c][0] for c in chosen[1:])
        return MovingPart(state, points, best, trial.gain(best), alone.weight, rivals), members, trial

    def from_rest(self, index: int, alone: Trial, done: set[int]) -> Hypothesis:
        """Where the photos pull a cluster that they find at rest: what moves little they bring home, wherever its hinge is.

        Only then are the masks asked; of a part at rest they know nothing but that it has moved.

        Args:
            index: of the cluster.
            alone: the cluster between the photos.
            done: clusters that belong to a part.
        """
        pieces, rest = self.pieces, SE3.identity(dtype=torch.float64)
        start = alone.judge(alone.moved(Hypothesis(rest, 0.0, 0.0, 0.0), rest))
        pulled = pieces.pulled(start, alone, 2 * self.config.steps)
        hull, landing = pieces.looks[1 - pieces.clusters[index].state].hull, self._landing(self._arrivals(index, done))
        masks = hull_scores(stack_motions([pulled.motion]), pieces.clusters[index].points, hull, landing, alone.box)
        return replace(pulled, outside=float(masks[0][0]), unexplained=float(masks[1][0]))

    def _arrivals(self, index: int, done: set[int]) -> list[int]:
        """The other state's clusters that a cluster may show as there."""
        clusters = self.pieces.clusters
        return [i for i in range(len(clusters)) if i not in done and clusters[i].state != clusters[index].state]

    def _landing(self, arrivals: list[int]) -> Points:
        """The points of such clusters."""
        return np.concatenate([np.zeros((0, 3)), *(self.pieces.clusters[i].points for i in arrivals)])

    def _with(self, alone: Trial, index: int, group: frozenset[int]) -> Trial:
        """The trial of a cluster with what moves along."""
        members = {index, *group}
        most = sum(self.pieces.weights[i] for i in members)
        return replace(alone, piece=self.pieces.splats_in(members), most=most)

    def _shown(self, best: Hypothesis, index: int, group: frozenset[int], scene: Scene) -> set[int]:
        """The clusters of a group that the photos miss if they do not move along."""
        if not group:
            return set()
        everything = scene.error(self.pieces.splats_in({index, *group}), best.motion)
        without = {i: scene.error(self.pieces.splats_in({index, *group} - {i}), best.motion) for i in group}
        return {i for i, error in without.items() if error - everything > self.config.shown * self.pieces.weights[i]}

    def _explained_by(self, part: MovingPart, index: int) -> set[int]:
        """The clusters that lie where a part is, but for those known to be other parts than its cluster."""
        return {i for i in self.pieces.explained_by(part) if not self._known_apart(i, index)}

    def _known_apart(self, one: int, other: int) -> bool:
        return one in self.pieces.apart and self.pieces.apart[one] == self.pieces.apart.get(other)

    def _unions(self, indices: list[int], always: set[int]) -> list[Box]:
        """Boxes of what may be one part: the clusters in `always` with none, one, two or all of the largest others."""
        largest = indices[: self.config.together]
        groups = {frozenset(always | set(some)) for n in (0, 1, 2, len(largest)) for some in itertools.combinations(largest, n)}
        points = [np.concatenate([self.pieces.clusters[i].points for i in sorted(g)]) for g in sorted(groups, key=sorted) if g]
        return [self.pieces.box(p) for p in points]

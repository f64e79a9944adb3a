"""From clusters of what moved to moving parts: each a box in state 0 and the motion that the photos like best."""

import itertools
from collections.abc import Generator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool
from scipy.spatial import KDTree
from torch import Tensor

from ..geometry import SE3, Box, screw_at
from ..joints import kind_of
from .config import SearchConfig
from .cue import Cluster, Points, StateLook, linked
from .divide import AROUND, FACTORS, cut_across, divide, moving_along
from .hypotheses import (
    Hypothesis,
    candidate_motions,
    displacements,
    distinct,
    finalists,
    flips,
    hull_scores,
    oddity,
    stack_motions,
)
from .judge import NOISE, Scene, Trial, measured
from .pieces import MovingPart, Pieces


class PartSearch:
    """Turns clusters into moving parts, one after the other, the largest first."""

    def __init__(self, looks: tuple[StateLook, StateLook], config: SearchConfig, seed: int):
        self.pieces = Pieces(looks, config, seed)
        self.config = config
        self.left_over: list[tuple[int, float]] = []  # state and share of its points of large clusters in no part

    def _divided(self, part: MovingPart, trial: Trial, known_cut: bool) -> list[Points]:
        """The points of a part as those of several, if it turns out to be several parts; else all of them.

        What shows in the other state says it splat by splat; what was shut there by its fronts.  Unless it was cut before, it
        is also cut across where its pieces had better go further or less far.
        """
        config, box, pieces = self.config, trial.box, self.pieces
        screw, q = screw_at(part.hypothesis.motion, kind_of(part.hypothesis.motion), box.T_world_box.xyz)
        motions = screw.motion(q * torch.tensor(FACTORS, dtype=torch.float64))
        shows = trial.shows(part.hypothesis)
        there = trial.there.support(trial.piece, motions) if shows else np.zeros((len(FACTORS), 0))
        means = trial.piece.means.double()
        if shows:
            least = config.divided * part.weight * trial.there.pixels
            several = divide(part.points, means.numpy(), there, config.mixed, least, config.cue, pieces.voxel)
            if len(several) > 1:
                return several
        if known_cut:
            return [part.points]
        others = trial.others.means.double()
        fronts = trial.others[torch.stack([box.moved(motions[f]).contains(others) for f in range(len(FACTORS))]).any(0)]
        back = trial.here.support(fronts, motions.inverse())
        at = [box.moved(part.hypothesis.motion).to_canonical(fronts.means.double()).numpy()]
        together = config.cut_shut
        if shows:
            at.append(box.to_canonical(means).numpy())
            back = np.concatenate([back, there], 1)
            together = config.cut
        return cut_across(part.points, box, np.concatenate(at), back, screw, pieces.voxel, together)

    def _exchanged(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, each with what its motion explains better of those beside it than theirs; the weightiest takes first."""
        parts = sorted(parts, key=lambda part: -part.weight)
        for taker in range(len(parts)):
            asked = {k for k, part in enumerate(parts) if k == taker or part.state != parts[taker].state}
            while beside := [k for k in range(len(parts)) if k not in asked and self._touch(parts[taker], parts[k])]:
                giver = beside[0]
                asked.add(giver)
                others = [part for k, part in enumerate(parts) if k not in (taker, giver)]
                parts[taker], parts[giver] = self._with_claims(parts[taker], parts[giver], others)
        return [part for part in parts if part.pieces]

    def _with_claims(self, taker: MovingPart, giver: MovingPart, others: list[MovingPart]) -> tuple[MovingPart, MovingPart]:
        """Two parts after the one has taken what moves along with it of the other, which may be all of it."""
        pieces, state = self.pieces, taker.state
        screw, q = screw_at(taker.hypothesis.motion, kind_of(taker.hypothesis.motion), pieces.box(taker.points).T_world_box.xyz)
        motions = screw.motion(q * torch.tensor(AROUND, dtype=torch.float64)).wxyz_xyz
        splats, mine = pieces.splats_of(giver), pieces.looks[state].splats
        there = pieces.scene(1 - state, pieces.rest([*others, taker], state))
        support = there.support(splats, SE3(torch.cat([motions, giver.hypothesis.motion.wxyz_xyz[None]])))
        here = pieces.scene(state, mine[~pieces.held_by_part(giver)])
        needed = here.support(splats, SE3.identity(1, dtype=torch.float64))[0]
        means, voxel = splats.means.double().numpy(), pieces.voxel
        along = moving_along(giver.points, means, support[:-1], support[-1], needed, self.config.cue, voxel)
        if not along.any():
            return taker, giver
        left = linked(giver.points[~along], self.config.cue, voxel)
        if sum(map(len, left)) < self.config.crumbs * len(giver.points):
            return replace(taker, pieces=taker.pieces + giver.pieces, weight=taker.weight + giver.weight), replace(
                giver, pieces=()
            )
        gone = along[KDTree(giver.points).query(means)[1]]
        weight = float(needed[gone].sum()) / here.pixels
        return (
            replace(taker, pieces=(*taker.pieces, giver.points[along]), weight=taker.weight + weight),
            replace(giver, pieces=tuple(left), weight=max(giver.weight - weight, 0.0)),
        )

    def _touch(self, one: MovingPart, other: MovingPart) -> bool:
        """Whether two parts, one of which may be empty, touch where they were found (the clustering's reach)."""
        if not one.pieces or not other.pieces:
            return False
        gap = KDTree(other.points_in(one.state)).query(one.points)[0].min()
        return bool(gap <= self.config.cue.link * self.pieces.voxel)

    def _replaced(self, index: int, points: list[Points]) -> list[int]:
        """Indices of new clusters in place of one; these do not move together."""
        state, before = self.pieces.clusters[index].state, len(self.pieces)
        for some in sorted(points, key=len, reverse=True):
            self.pieces.take(Cluster(state, some))
        new = range(before, len(self.pieces))
        self.pieces.apart |= dict.fromkeys(new, self.pieces.apart.get(index, index))
        return list(new)

    def _left_of(self, index: int, parts: list[MovingPart]) -> list[int]:
        """What is left to explain of a cluster, by indices: itself, if no part lies there, or new clusters in its place."""
        cluster = self.pieces.clusters[index]
        within = [self._within(part, cluster).numpy() for part in parts]
        share = float(np.any(within, 0).mean()) if parts else 0.0
        if share < 0.1:
            return [index]
        if share > 0.6:
            return []
        return self._replaced(index, linked(cluster.points[~np.any(within, 0)], self.config.cue, self.pieces.voxel))

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
        parts = self._exchanged(self._without_doubles(found))
        parts = self._reconsider([self._at_its_clearest(part) for part in parts])
        return sorted(self._settled(self._without_pieces(parts)), key=lambda part: -part.weight)

    def _found(self) -> Generator[int, None, list[MovingPart]]:
        """The parts as they are found, one after the other."""
        parts: list[MovingPart] = []
        explained: set[int] = set()
        refused: dict[int, tuple[int, float]] = {}
        count = len(self.pieces)
        todo = list(range(count))
        waiting: set[int] = set()  # clusters that may be several parts: those of the other state may tell them apart
        waited: set[int] = set()
        while todo:
            index = todo.pop(0)
            yield min(index, count)
            if index in waiting:
                waiting.remove(index)
                todo = self._left_of(index, parts) + todo
                continue
            if index in explained:
                continue
            part, members, trial = self._try(index, parts, explained)
            several = self._divided(part, trial, index in self.pieces.apart) if part.gain > NOISE else [part.points]
            doubtful = len(several) > 1 or trial.explained(part.hypothesis) < self.config.clear_case * trial.most
            if doubtful and index not in waited and self._is_open(1 - part.state, set(todo) - explained):
                waiting.add(index)
                waited.add(index)
                at_last = [*(i for i in todo if i in waiting), index]
                todo = [i for i in todo if i not in waiting] + sorted(
                    at_last, key=lambda i: -len(self.pieces.clusters[i].points)
                )
                continue
            if len(several) > 1:
                explained |= members
                todo = self._replaced(min(members), several) + todo
                continue
            share = len(part.points) / len(self.pieces.looks[part.state].points)
            large = share > self.config.large
            if part.gain < (-self.config.harm if large else NOISE):
                if large:
                    refused[index] = (part.state, share)
                continue
            explained |= members | self._explained_by(part)
            parts.append(part)
        self.left_over = [what for index, what in refused.items() if index not in explained]
        return parts

    def _is_open(self, state: int, todo: set[int]) -> bool:
        return any(self.pieces.clusters[index].state == state for index in todo)

    def _at_its_clearest(self, part: MovingPart) -> MovingPart:
        """The part as the other state shows it, if it is as large there but thinner.

        Where few views look along a panel, the hull carries more than the panel, and what is fitted to it lies askew.
        """
        pieces, other = self.pieces, 1 - part.state
        there = [i for i in sorted(self._explained_by(part)) if pieces.clusters[i].state == other]
        if not there:
            return part
        points = tuple(pieces.clusters[i].points for i in there)
        now, then = pieces.box(part.points), pieces.box(np.concatenate(points))
        smaller = then.half_extents.sort()[0] / now.half_extents.sort()[0]
        if float(smaller.prod()) > self.config.thinner or float(smaller[1:].min()) < 0.8:
            return part
        back = [replace(h, motion=h.motion.inverse()) for h in (part.hypothesis, *part.rivals)]
        weight = sum(pieces.weights[i] for i in there)
        return replace(part, state=other, pieces=points, hypothesis=back[0], rivals=tuple(back[1:]), weight=weight)

    def _reconsider(self, parts: list[MovingPart]) -> list[MovingPart]:
        """Looks at each part again with all others in place; one that may as well move like another becomes one with it."""
        parts = list(parts)
        index = 0
        while index < len(parts) > 1:
            part, others = parts[index], parts[:index] + parts[index + 1 :]
            trial = self._again(part, others)
            shared = [p.motion if part.state == 0 else p.motion.inverse() for p in others]
            own = part.hypothesis
            as_they_move = [trial.judge(trial.moved(own, T)) for T in shared]
            starts = [*(trial.judge(h) for h in (own, *part.rivals[:2])), *as_they_move]
            again = [self.pieces.pulled(h, trial, self.config.steps) for h in starts]
            by_cost = sorted(again, key=trial.cost)
            gaps = displacements(stack_motions(shared), by_cost[0].motion, trial.box)
            losses = np.array([h.error for h in as_they_move]) - min(h.error for h in again)
            touching = np.array([self._continues(part, other) for other in others])
            alike = (gaps < self.config.same) & (losses < self.config.alike * part.weight)
            alike &= trial.shows(starts[0]) | touching  # what does not show in the other state says little of how it moves
            # A piece that continues a weightier part, and has no better motion of its own than that part's, belongs to it.
            best_of_its_own = min(h.error + trial.gone_in(h) + h.against(part.weight) for h in again[: -len(shared)])
            needless = np.array([h.error + trial.gone_in(h) for h in as_they_move]) < best_of_its_own
            alike |= needless & touching & np.array([other.weight > part.weight for other in others])

            twin = int(np.argmin(np.where(alike, losses, np.inf)))
            if alike[twin]:
                follower, leader = sorted((part, others[twin]), key=lambda p: p.weight)
                parts = self._merged(leader, follower, [p for p in others if p is not others[twin]])
                index = 0
                continue
            chosen = distinct(stack_motions([h.motion for h in by_cost]), trial.box, 0.1, len(by_cost))
            parts[index] = replace(part, hypothesis=by_cost[0], rivals=tuple(by_cost[c] for c in chosen[1:]))
            index += 1
        return parts

    def _continues(self, part: MovingPart, other: MovingPart) -> bool:
        """Whether two parts touch where the one was found (the clustering's reach), and one box holds both about as well."""
        if not self._touch(part, other):
            return False
        theirs = other.points_in(part.state)
        whole, *both = (float(self.pieces.box(p).volume) for p in (np.concatenate([part.points, theirs]), part.points, theirs))
        return sum(both) > self.config.cue.hollow * whole

    def _without_doubles(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, without those that lie where others do and beside them explain nothing: found wrong before."""
        parts = list(parts)
        index = 0
        while index < len(parts):
            part, others = parts[index], parts[:index] + parts[index + 1 :]
            points = torch.from_numpy(part.points)
            boxes = [self.pieces.box(other.points_in(part.state)) for other in others]
            within = [box.contains(points, margin=3 * self.pieces.voxel) for box in boxes]
            if others and float(torch.stack(within).any(0).double().mean()) > 0.6:
                trial = self._again(part, others)
                if trial.explained(trial.judge(part.hypothesis)) < 0:
                    parts, index = others, 0
                    continue
            index += 1
        return parts

    def _without_pieces(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, without those that lie within a larger one: what was left over before that one was whole."""
        kept: list[MovingPart] = []
        for part in sorted(parts, key=lambda part: -len(part.points)):
            points = torch.from_numpy(part.points)
            within = [
                self.pieces.box(whole.points_in(part.state)).contains(points, margin=3 * self.pieces.voxel).double().mean()
                for whole in kept
            ]
            if not within or max(within) < 0.6:
                kept.append(part)
        return kept

    def _again(self, part: MovingPart, others: list[MovingPart]) -> Trial:
        """A part between the photos of both states, with all other parts in place."""
        return self.pieces.trial(part.state, part.points, self.pieces.splats_of(part), part.weight, others)

    def _settled(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts after a longer look at each and the ways it can lie, with the motions of the others as they now are."""
        parts = list(parts)
        for index, part in enumerate(parts):
            trial = self._again(part, parts[:index] + parts[index + 1 :])
            own = part.hypothesis
            ways = [own, *part.rivals[:1], *(trial.moved(own, T) for T in flips(own.motion, trial.box))]
            judged = [trial.judge(h) for h in ways]
            hopeful = [h for h in judged if trial.cost(h) < trial.cost(judged[0]) + self.config.hopeless * part.weight]
            again = [self.pieces.pulled(h, trial, 2 * self.config.steps) for h in hopeful]
            parts[index] = replace(part, hypothesis=measured(min(again, key=trial.cost), trial))
        return parts

    def _merged(self, leader: MovingPart, follower: MovingPart, rest: list[MovingPart]) -> list[MovingPart]:
        """The parts with two of them made one, which moves as the leader does."""
        to_leader = leader.hypothesis.motion.inverse()
        there = (
            follower.pieces
            if follower.state == leader.state
            else tuple(to_leader.apply(torch.from_numpy(points)).numpy() for points in follower.pieces)
        )
        return [replace(leader, pieces=leader.pieces + there), *rest]

    def _within(self, part: MovingPart, cluster: Cluster) -> Bool[Tensor, " P"]:
        """Which points of a cluster of either state lie where the part is in that state."""
        box = self.pieces.box(part.points)
        there = box if cluster.state == part.state else box.moved(part.hypothesis.motion)
        return there.contains(torch.from_numpy(cluster.points), margin=3 * self.pieces.voxel)

    def _explained_by(self, part: MovingPart) -> set[int]:
        """Clusters of either state that lie where the part is in that state."""
        clusters = enumerate(self.pieces.clusters)
        return {index for index, cluster in clusters if float(self._within(part, cluster).double().mean()) > 0.6}

    def _shortlist(self, index: int, done: set[int]) -> tuple[list[Hypothesis], list[int]]:
        """Motions that the other state's hull allows a cluster, the best first, and the clusters that may move with it."""
        pieces = self.pieces
        cluster, box = pieces.clusters[index], pieces.boxes[index]
        state, other = cluster.state, 1 - cluster.state
        hull, nothing = pieces.looks[other].hull, np.zeros((0, 3))
        open_ = [i for i in range(len(pieces)) if i not in done]
        arrivals = [i for i in open_ if pieces.clusters[i].state == other]
        siblings = [i for i in open_ if pieces.clusters[i].state == state and i != index and not self._known_apart(i, index)]
        wholes = self._unions(siblings, {index})
        motions = candidate_motions(wholes, pieces.base_box, list(itertools.product(wholes, self._unions(arrivals, set()))))
        landing = np.concatenate([pieces.clusters[i].points for i in arrivals]) if arrivals else nothing
        rough = hull_scores(motions, pieces.sample(cluster.points, 40), hull, nothing, box)[0]
        motions = motions[np.flatnonzero(rough < rough.min() + 1.0)]
        points, landing = pieces.sample(cluster.points, 300), pieces.sample(landing, 300)
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

    def _try(self, index: int, parts: list[MovingPart], done: set[int]) -> tuple[MovingPart, set[int], Trial]:
        """The best motion of one cluster.

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
        refined.sort(key=lambda row: row[2])
        chosen = distinct(stack_motions([h.motion for h, _, _ in refined]), box, 0.1, len(refined))
        best, group, _ = refined[0]
        members = {index, *self._shown(best, index, group, alone.there)}
        trial = self._with(alone, index, frozenset(members - {index}))
        best = measured(trial.judge(best), trial)
        points = tuple(pieces.clusters[i].points for i in sorted(members))
        rivals = tuple(refined[c][0] for c in chosen[1:])
        return MovingPart(state, points, best, trial.gain(best), alone.weight, rivals), members, trial

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

    def _known_apart(self, one: int, other: int) -> bool:
        return one in self.pieces.apart and self.pieces.apart[one] == self.pieces.apart.get(other)

    def _unions(self, indices: list[int], always: set[int]) -> list[Box]:
        """Boxes of what may be one part: the clusters in `always` with none, one, two or all of the largest others."""
        largest = indices[: self.config.together]
        groups = {frozenset(always | set(some)) for n in (0, 1, 2, len(largest)) for some in itertools.combinations(largest, n)}
        points = [np.concatenate([self.pieces.clusters[i].points for i in sorted(g)]) for g in sorted(groups, key=sorted) if g]
        return [self.pieces.box(p) for p in points]

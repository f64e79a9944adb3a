"""Parts looked at again, with all others in place: what belongs to which, which are one or none, and how each moves."""

import itertools
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree
from torch import Tensor

from ..geometry import SE3, screw_at
from ..joints import kind_of
from .alike import Face, Overlap, Shown
from .cue import Points, linked, one_box_holds
from .divide import AROUND, moving_along
from .hypotheses import Hypothesis, displacements, distinct, flips, stack_motions
from .judge import Trial
from .pieces import MovingPart, Pieces
from .refine import just_out_of_sight, measured
from .several import nearly_alike

_NO_SCRAP = 0.5  # of a part's weight, of the 2 that it could: what explains so much is no scrap, wherever it lies
_BLURRED = 1.5  # voxels: no nearer is found how a piece moves that does not show in the other state


class PartReview:
    """What was found one part after the other, seen together."""

    def __init__(self, pieces: Pieces):
        self.pieces = pieces
        self.config = pieces.config

    def reviewed(self, found: list[MovingPart]) -> list[MovingPart]:
        """The parts as all of them together say."""
        parts = self.exchanged(self.without_doubles(found))
        parts = self._reconsider(self.joined([self.at_its_clearest(part) for part in parts]))
        parts = self._settled(self._told_apart(self._without_pieces(parts)))
        return self.going_somewhere([self._laid_alike(part) for part in parts])

    def going_somewhere(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, without those whose motion carries nothing as far as what moved was found from all the other state has.

        There nothing of them lands: they were in the air where they were found.
        """
        least = self.config.cue.threshold * self.pieces.voxel
        return [part for part in parts if np.linalg.norm(part.points_in(1) - part.points_in(0), axis=-1).max() > least]

    def without_doubles(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, without those that lie where others do and beside them explain nothing: found wrong before."""
        parts = list(parts)
        index = 0
        while index < len(parts):
            part, others = parts[index], parts[:index] + parts[index + 1 :]
            within = [self._lying_in(other, part) for other in others]
            lies_there = others and float(torch.stack(within).any(0).double().mean()) > 0.6
            if lies_there and self._explained(part, others) < 0:
                parts, index = others, 0
                continue
            index += 1
        return parts

    def exchanged(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, each with what its motion explains better of those beside it than theirs; the weightiest takes first."""
        parts = sorted(parts, key=lambda part: -part.weight)
        for taker in range(len(parts)):
            asked = {k for k, part in enumerate(parts) if k == taker or part.state != parts[taker].state}
            while beside := [k for k in range(len(parts)) if k not in asked and self.touch(parts[taker], parts[k])]:
                giver = beside[0]
                asked.add(giver)
                others = [part for k, part in enumerate(parts) if k not in (taker, giver) and part.pieces]
                parts[taker], parts[giver] = self.with_claims(parts[taker], parts[giver], others)
        return [part for part in parts if part.pieces]

    def with_claims(self, taker: MovingPart, giver: MovingPart, others: list[MovingPart]) -> tuple[MovingPart, MovingPart]:
        """Two parts after the one has taken what moves along with it of the other, which may be all of it.

        Args:
            taker: which motion is asked for.
            giver: of the same state.
            others: other parts in their places.
        """
        pieces, state = self.pieces, taker.state
        here, splats = pieces.parted(pieces.held_by_part(giver), state)
        if not len(splats) or not self.shows(taker, others):  # crumbs; or none can say what moves along
            return taker, giver
        screw, q = screw_at(taker.hypothesis.motion, kind_of(taker.hypothesis.motion), pieces.box(taker.points).T_world_box.xyz)
        motions = screw.motion(q * torch.tensor(AROUND, dtype=torch.float64)).wxyz_xyz
        there = pieces.scene(1 - state, pieces.rest([*others, taker], state))
        support = there.support(splats, SE3(torch.cat([motions, giver.hypothesis.motion.wxyz_xyz[None]])))
        needed = here.support(splats, SE3.identity(1, dtype=torch.float64))[0]
        means = splats.means.double().numpy()
        along = moving_along(
            taker.points, giver.points, means, support[:-1], support[-1], needed, self.config.cue, pieces.voxel
        )
        if not along.any():
            return taker, giver
        left = linked(giver.points[~along], self.config.cue, pieces.voxel)
        if sum(map(len, left)) < self.config.crumbs * len(giver.points):
            whole = replace(taker, pieces=taker.pieces + giver.pieces, weight=taker.weight + giver.weight)
            return whole, replace(giver, pieces=())
        weight = float(needed[along[KDTree(giver.points).query(means)[1]]].sum()) / here.pixels
        return (
            replace(taker, pieces=(*taker.pieces, giver.points[along]), weight=taker.weight + weight),
            replace(giver, pieces=tuple(left), weight=max(giver.weight - weight, 0.0)),
        )

    def at_its_clearest(self, part: MovingPart) -> MovingPart:
        """The part as the other state shows it, if it is as large there but thinner, and photos show it there about as well.

        Where few views look along a panel, the hull carries more than the panel, and what is fitted to it lies askew.  What is
        thinner because it is shut shows its front only: turned the wrong way round, it may look like the back.
        """
        pieces, other = self.pieces, 1 - part.state
        there = [i for i in sorted(pieces.explained_by(part)) if pieces.clusters[i].state == other]
        if not there:
            return part
        points = tuple(pieces.clusters[i].points for i in there)
        now, then = pieces.box(part.points), pieces.box(np.concatenate(points))
        smaller = then.half_extents.sort()[0] / now.half_extents.sort()[0]
        if float(smaller.prod()) > self.config.thinner or float(smaller[1:].min()) < 0.8:
            return part
        weight = sum(pieces.weights[i] for i in there)
        if weight < self.config.as_clear * part.weight:
            return part
        return replace(_found_in_the_other(part, points), weight=weight)

    def joined(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, those side by side in one state made one that as one explain the photos better, or moving alike as well.

        A door and what stands before it may be found as two.  They are asked before either is pulled into place: each
        would be pulled over what the other leaves unexplained, and what is thin hardly says how it moves.  So may one thing
        be that either state shows, such as a handle pulled out and what of it is seen when it is pushed in.
        """
        parts, beside = list(parts), self.config.cue.link + self.config.clear
        while True:
            ways = []
            for one, two in itertools.combinations(parts, 2):
                follower, leader = sorted((one, two), key=lambda part: part.weight)
                if follower.state != leader.state:
                    follower = self._as_shown_beside(leader, follower)
                if self._voxels_between(follower, leader) <= beside:
                    rest = [part for part in parts if part is not one and part is not two]
                    ways.append((*self._as_one(leader, follower, rest), (one, two)))
            harm, whole, pair = min(ways, key=lambda way: way[0], default=(1.0, None, ()))
            if whole is None or harm > 0:
                return parts
            parts = [whole, *(part for part in parts if all(part is not one for one in pair))]

    def _as_shown_beside(self, leader: MovingPart, follower: MovingPart) -> MovingPart:
        """A part of the other state, which lies there where the leader goes, as what the leader's state shows of it.

        That is what lies where it goes and is not the leader's; nothing if it does not lie there, or shows less well.
        """
        places = [np.zeros((0, 3))]
        if float(self._lying_in(leader, follower).double().mean()) > 0.6:
            clusters = [cluster for cluster in self.pieces.clusters if cluster.state == leader.state]
            places += [cluster.points[self.pieces.within(follower, cluster).numpy()] for cluster in clusters]
        points = np.unique(np.concatenate(places), axis=0)
        points = points[KDTree(leader.points).query(points)[0] > 0] if len(points) else points
        if not len(points):
            return _found_in_the_other(follower, ())
        scene, piece = self.pieces.parted(self.pieces.held_by(points, leader.state), leader.state)
        clear = scene.needs(piece) >= self.config.as_clear * follower.weight
        return _found_in_the_other(follower, (points,) if clear else ())

    def _as_one(self, leader: MovingPart, follower: MovingPart, rest: list[MovingPart]) -> tuple[float, MovingPart]:
        """What speaks against two parts of one state being one, in mean error (below 0: nothing), and the two as one.

        Of the two, whichever is to move like the other has to show where that brings it, or the lesser has to continue the
        greater: wherever it goes unseen, as a tray does behind a door, it would do no harm.
        """
        (whole,) = self._merged(leader, follower, [])
        trial, box = self._again(whole, rest), self.pieces.box
        own, other = (trial.judge(h) for h in (leader.hypothesis, trial.moved(leader.hypothesis, follower.hypothesis.motion)))
        gap = displacements(stack_motions([leader.hypothesis.motion]), follower.hypothesis.motion, box(follower.points))[0]
        agree, continues = gap < self.config.same, self._continues(follower, leader)
        ways = [own, other]
        if not continues:
            seen = [self._seen_along(follower, leader, trial, h) for h in ways]
            seen[1] &= agree or self._seen_along(leader, follower, trial, other)
            ways = list(itertools.compress(ways, seen))
        if not ways:
            return float("inf"), whole
        best = min(ways, key=lambda h: h.error)
        if continues and not agree:  # the greater may lie askew where the lesser would hold it
            best = min(self.pieces.pulled(best, trial, self.config.steps), best, key=lambda h: h.error)
        apart = trial.apart((self.pieces.splats_of(p), box(p.points), p.hypothesis.motion) for p in (leader, follower))
        allowed = self.config.alike * follower.weight if agree else 0.0
        return best.error - apart - allowed, replace(whole, hypothesis=best)

    def _seen_along(self, part: MovingPart, other: MovingPart, trial: Trial, hypothesis: Hypothesis) -> bool:
        """Whether photos of the other state show a part that moves as one with another; `trial` is that of both."""
        alone = trial.there.error(self.pieces.splats_of(other), hypothesis.motion)
        return alone - hypothesis.image_error >= self.config.shows * part.weight

    def _reconsider(self, parts: list[MovingPart]) -> list[MovingPart]:
        """Looks at each part again with all others in place; one that may as well move like another becomes one with it."""
        parts = list(parts)
        index = 0
        while index < len(parts) > 1:
            part, others = parts[index], parts[:index] + parts[index + 1 :]
            trial = self._again(part, others)
            ways = [other.motion_from(part.state) for other in others]
            starts = [part.hypothesis, *part.rivals[:2], *(trial.moved(part.hypothesis, T) for T in ways)]
            judged = [trial.judge(h) for h in starts]
            pulled = [self.pieces.pulled(h, trial, self.config.steps) for h in judged]
            twin = self._twin(part, others, trial, judged, pulled)
            if twin is not None:
                follower, leader = sorted((part, twin), key=lambda p: p.weight)
                parts = self._merged(leader, follower, [p for p in others if p is not twin])
                index = 0
                continue
            by_cost = sorted(pulled, key=trial.cost)
            like = next((other for other, h in zip(others, pulled[-len(others) :], strict=True) if h is by_cost[0]), None)
            if like is not None and (handed := self._handed_over(part, like, by_cost[0], parts)):
                parts, index = handed, 0
                continue
            chosen = distinct(stack_motions([h.motion for h in by_cost]), trial.box, 0.1, len(by_cost))
            parts[index] = replace(part, hypothesis=by_cost[0], rivals=tuple(by_cost[c] for c in chosen[1:]))
            index += 1
        return parts

    def _handed_over(
        self, part: MovingPart, like: MovingPart, best: Hypothesis, parts: list[MovingPart]
    ) -> list[MovingPart] | None:
        """The parts after one has given another what of it goes that other's way, and kept the rest; None if nothing does.

        A tray may hold a corner of the door before it, and as a whole suit the door's way best.  Where that has been pulled
        for the corner to fit, what moves along is told even if the door itself lies a little off.

        Args:
            part: that goes another's way best.
            like: that other.
            best: the way it goes.
            parts: all of them.
        """
        if like.state != part.state or not self.touch(like, part):
            return None
        rest = [other for other in parts if other is not part and other is not like]
        taker, giver = self.with_claims(replace(like, hypothesis=best), part, rest)
        if giver is part or not giver.pieces:
            return None
        after = {id(part): giver, id(like): replace(taker, hypothesis=like.hypothesis)}
        return [after.get(id(other), other) for other in parts]

    def _twin(
        self,
        part: MovingPart,
        others: list[MovingPart],
        trial: Trial,
        judged: list[Hypothesis],
        pulled: list[Hypothesis],
    ) -> MovingPart | None:
        """Which other part a part moves like, or may as well; of several the one that photos mind least; None if none.

        Args:
            part: that was found.
            others: that it may move like.
            trial: the part between the photos, with the others in place.
            judged: its own motion, its rivals, and then the motion of each of the others.
            pulled: the same after the photos have pulled them into place.
        """
        own = len(judged) - len(others)
        as_they_move, best = judged[own:], min(pulled, key=trial.cost)
        gaps = displacements(stack_motions([h.motion for h in as_they_move]), best.motion, trial.box)
        losses = np.array([h.error for h in as_they_move]) - min(h.error for h in pulled)
        touching = np.array([self._continues(part, other) for other in others])
        lesser = np.array([other.weight >= part.weight for other in others])
        shows = trial.shows(judged[0])
        alike = (gaps < self.config.same) & (losses < self.config.alike * part.weight)
        alike &= (shows & lesser) | touching | self._agree(part, others, gaps, shows)
        # A piece that continues a weightier part, or shows, and has no better motion of its own than that belongs to it; so
        # does one on the other side of the hinge, that is in one piece with that part where both hardly move.
        best_of_its_own = min(map(trial.burden, pulled[:own]))
        needless = np.array([h.error + trial.gone_in(h) for h in as_they_move]) < best_of_its_own
        told = np.array([trial.explained(h) > part.weight for h in as_they_move])
        alike |= needless & (touching | shows | told) & lesser
        little = _NO_SCRAP * part.weight
        if not shows and trial.explained(best) < little:  # nor has one that explains little, and loses little
            alike |= (losses < little) & touching & lesser
        twin = int(np.argmin(np.where(alike, losses, np.inf)))
        return others[twin] if alike[twin] else None

    def _agree(
        self, part: MovingPart, others: list[MovingPart], gaps: Float64[np.ndarray, " N"], shows: bool
    ) -> Bool[np.ndarray, " N"]:
        """Which other parts a part moves like as nearly as it can be told.

        What does not show in the other state says little of how it moves, but two pieces do not agree by chance.  A small one
        near a greater, such as a drawer's side, agrees as soon as photos do not tell them apart.

        Args:
            part: in its best place.
            others: that it may move like.
            gaps: between its motion and theirs, over its half diagonal.
            shows: whether photos of the other state show it.
        """
        voxels = np.array([self._voxels_between(part, other) for other in others])
        agree = gaps < self.config.same / np.where(voxels <= self.config.cue.link, 2, 8)
        if shows:
            return agree
        lesser = np.array([other.weight >= part.weight for other in others])
        apart = gaps * float(self.pieces.box(part.points).half_extents.norm()) / self.pieces.voxel
        return agree | (lesser & (voxels <= self.config.cue.link + self.config.clear) & (apart < _BLURRED))

    def shows(self, part: MovingPart, others: list[MovingPart]) -> bool:
        """Whether the photos of the other state show a part, with others in place."""
        trial = self._again(part, others)
        return trial.shows(trial.judge(part.hypothesis))

    def _continues(self, part: MovingPart, other: MovingPart) -> bool:
        """Whether two parts touch where the one was found (the clustering's reach), and one box holds both about as well."""
        if not self.touch(part, other):
            return False
        thinnest, hollow = 0.5 * self.pieces.voxel, self.config.cue.hollow
        return one_box_holds(part.points, other.points_in(part.state), thinnest, hollow)

    def touch(self, one: MovingPart, other: MovingPart) -> bool:
        """Whether two parts touch where the one was found (the clustering's reach)."""
        return self._voxels_between(one, other) <= self.config.cue.link

    def _voxels_between(self, one: MovingPart, other: MovingPart) -> float:
        """The least distance of their points where the one was found, in voxels; infinite if either is empty."""
        if not one.pieces or not other.pieces:
            return float("inf")
        return float(KDTree(other.points_in(one.state)).query(one.points)[0].min()) / self.pieces.voxel

    def _without_pieces(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, without those that lie within a larger one's box and explain little: left over before that was whole."""
        kept: list[MovingPart] = []
        for part in sorted(parts, key=lambda part: -len(part.points)):
            within = [self._lying_in(whole, part).double().mean() for whole in kept]
            others = [other for other in parts if other is not part]
            if not within or max(within) < 0.6 or self._explained(part, others) > _NO_SCRAP * part.weight:
                kept.append(part)
        return kept

    def _explained(self, part: MovingPart, others: list[MovingPart]) -> float:
        """What a part takes off the errors of both states' photos, with others in place."""
        trial = self._again(part, others)
        return trial.explained(trial.judge(part.hypothesis))

    def _lying_in(self, one: MovingPart, other: MovingPart) -> Bool[Tensor, " P"]:
        """Which points of the other part lie in the box of the one, in the state in which the other was found."""
        box = self.pieces.box(one.points_in(other.state))
        return box.contains(torch.from_numpy(other.points), margin=3 * self.pieces.voxel)

    def _told_apart(self, parts: list[MovingPart]) -> list[MovingPart]:
        """The parts, those that are several which go nearly as far as these."""
        left, done = list(parts), []
        while left:
            part = left.pop(0)
            several = nearly_alike(part, self._again(part, [*done, *left]), self.pieces)
            if len(several) > 1:
                left = several + left
            else:
                done.append(part)
        return done

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
            best = measured(min(again, key=trial.cost), trial)
            parts[index] = replace(part, hypothesis=just_out_of_sight(best, trial, self.pieces.base_box))
        return parts

    def _laid_alike(self, part: MovingPart) -> MovingPart:
        """The part, laid in the plane of its face where photos of both states are alike."""
        pieces, here, there = self.pieces, self.pieces.looks[part.state], self.pieces.looks[1 - part.state]
        own, other = Shown(here.stack, here.splats, pieces.held_by_part(part)), Shown(there.stack, there.splats, None)
        overlap = Overlap.between(own, other, part.hypothesis.motion, pieces.box(part.points), pieces.voxel)
        face = Face.most_shown(overlap)
        place = face.alike_at()
        return part if place is None else replace(part, hypothesis=replace(part.hypothesis, motion=face.laid(place)))

    def _merged(self, leader: MovingPart, follower: MovingPart, rest: list[MovingPart]) -> list[MovingPart]:
        """The parts with two of them made one, which moves as the leader does."""
        to_leader = leader.hypothesis.motion.inverse()
        there = (
            follower.pieces
            if follower.state == leader.state
            else tuple(to_leader.apply(torch.from_numpy(points)).numpy() for points in follower.pieces)
        )
        return [replace(leader, pieces=leader.pieces + there), *rest]

    def _again(self, part: MovingPart, others: list[MovingPart]) -> Trial:
        """A part between the photos of both states, with all other parts in place."""
        trial = self.pieces.trial(part.state, part.points, self.pieces.splats_of(part), part.weight, others)
        taken = [other.points_in(1 - part.state) for other in others]
        return replace(trial, taken=KDTree(np.concatenate([self.pieces.stays.data, *taken])))


def _found_in_the_other(part: MovingPart, points: tuple[Points, ...]) -> MovingPart:
    """A part as found in the other state, where it has these points."""
    back = [replace(h, motion=h.motion.inverse()) for h in (part.hypothesis, *part.rivals)]
    return replace(part, state=1 - part.state, pieces=points, hypothesis=back[0], rivals=tuple(back[1:]))

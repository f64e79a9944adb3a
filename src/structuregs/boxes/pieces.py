"""What the search works with: the clusters of what moved, the splats that each holds, and the photos that judge them."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from ..capture import spread_cameras
from ..geometry import SE3, Box
from ..model import Splats
from .config import SearchConfig
from .cue import Cluster, Points, StateLook, base_axes, box_around, clusters
from .hypotheses import Hypothesis, square_with
from .judge import Scene, Trial
from .refine import along_base, refine, simplest

_ABOUT_AS_TIGHT = 1.15  # volume of a box around what the least box holds, against it: discs 1.08, squares 1.36 and more


@dataclass(frozen=True)
class MovingPart:
    """A rigid part as the search found it.

    Attributes:
        state: the state whose clusters and splats show it.
        pieces: points of its surface, in that state, in the world: those of each cluster that it was found as.
        hypothesis: its motion from `state` to the other state.
        gain: fraction that it takes off the error of both states' photos.
        weight: what the photos of its own state would lose without it, in mean error.
        rivals: what the photos thought of the next best distinct motions.
    """

    state: int
    pieces: tuple[Points, ...]
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
        return self.motion_from(0)

    def motion_from(self, state: int) -> SE3:
        """From a state to the other, in the world, float64."""
        return self.hypothesis.motion if state == self.state else self.hypothesis.motion.inverse()

    def points_in(self, state: int) -> Float64[np.ndarray, "P 3"]:
        """Its points as they stand in a state."""
        points = torch.from_numpy(self.points)
        return (points if state == self.state else self.hypothesis.motion.apply(points)).numpy()


class Pieces:
    """The clusters of what moved, with the splats that each holds and what the photos would lose without it.

    Attributes:
        looks: of both states.
        config: of the search.
        voxel: of the hulls, world units.
        views: of each state, which photos judge: some that are well apart.
        still: points of what stands still.
        base_box: around them.
        stays: points of what both states show standing still in one place.
        told_apart: points of all clusters and of what stands still, by state.
        clusters: those that are to be explained, the largest first.
        boxes: of each cluster.
        held: of each cluster, its splats among its state's.
        weights: of each cluster, what the photos of its state lose without it, in mean error.
        apart: clusters that were one but do not move together, with that one's index.
    """

    def __init__(self, looks: tuple[StateLook, StateLook], config: SearchConfig, seed: int):
        self.looks = looks
        self.config = config
        self.generator = np.random.default_rng(seed)
        self.voxel = looks[0].hull.voxel
        self.views = [np.array(spread_cameras(look.stack.cameras, config.looks)) for look in looks]
        found = clusters(looks, config.cue)
        by_state = [self._still_points(found, state) for state in (0, 1)]
        # All points of state 0 where clusters hold everything.
        still = max(by_state, key=len) if any(map(len, by_state)) else looks[0].points
        self.base_box = box_around(still, thinnest=0.5 * self.voxel, axes=base_axes(looks))
        self.still = KDTree(still)
        moving = [[cluster.points for cluster in found if cluster.state == state] for state in (0, 1)]
        self.told_apart = [KDTree(np.concatenate([by_state[state], *moving[state]])) for state in (0, 1)]
        self.stays = KDTree(_in_both(by_state[0], by_state[1], self.voxel))
        self.clusters: list[Cluster] = []
        self.boxes: list[Box] = []
        self.held: list[Bool[Tensor, " N"]] = []
        self.weights: list[float] = []
        self.apart: dict[int, int] = {}
        for cluster in found[: 2 * config.most]:
            if len(self.clusters) < config.most:
                self.take(cluster)

    def __len__(self) -> int:
        return len(self.clusters)

    def _still_points(self, found: list[Cluster], state: int) -> Float64[np.ndarray, "P 3"]:
        """Points of a state that none of these clusters holds."""
        points = self.looks[state].points
        still = np.ones(len(points), bool)
        for cluster in found:
            if cluster.state == state:
                still &= ~self.box(cluster.points).contains(torch.from_numpy(points), margin=self.voxel).numpy()
        return points[still]

    def take(self, cluster: Cluster) -> None:
        """Takes a cluster among those to explain, if the photos of its own state show it, and need it where they do."""
        held = self.held_by(cluster.points, cluster.state)
        weight = self._weight(cluster.points, held, cluster.state)
        if weight is not None:
            self.clusters.append(cluster)
            self.boxes.append(self.box(cluster.points))
            self.held.append(held)
            self.weights.append(weight)

    def is_surface(self, points: Points, state: int) -> bool:
        """Whether points are of a surface, not in the air: the photos of their state show it, and need it where they do."""
        return self._weight(points, self.held_by(points, state), state) is not None

    def _weight(self, points: Points, held: Bool[Tensor, " N"], state: int) -> float | None:
        """What the photos of a state lose without the splats that some points hold, in mean error; None if in the air."""
        scene, piece = self.parted(held, state)
        weight, footprint, share = scene.needs(piece), scene.footprint(piece), len(points) / len(self.looks[state].points)
        shown = footprint > self.config.painted * share and weight > self.config.there * footprint
        return weight if shown else None

    def parted(self, held: Bool[Tensor, " N"], state: int) -> tuple[Scene, Splats]:
        """A state's photos as judges of some of its splats among all its others, and those splats."""
        splats = self.looks[state].splats
        return self.scene(state, splats[~held]), splats[held]

    def box(self, points: Float64[np.ndarray, "P 3"]) -> Box:
        """The box around points."""
        return box_around(points, thinnest=0.5 * self.voxel)

    def squared(self, index: int) -> list[Box]:
        """Boxes around a cluster that share one axis with its own, lie square with the base, and are about as tight.

        The least box around a round door may lie any way in its plane, but its hinge goes by the base.
        """
        points, box = self.clusters[index].points, self.boxes[index]
        turned = (square_with(box, axis, self.base_box) for axis in range(3))
        boxes = [box_around(points, 0.5 * self.voxel, axes=axes) for axes in turned if axes is not None]
        return [one for one in boxes if one.volume < _ABOUT_AS_TIGHT * box.volume]

    def held_by(self, points: Float64[np.ndarray, "P 3"], state: int) -> Bool[Tensor, " N"]:
        """Which splats of a state lie in the box of points or near it, and no nearer to what else moved or stands still."""
        means = self.looks[state].splats.means.double()
        held = self.box(points).contains(means, margin=self.config.clear * self.voxel)
        inside = means[held].numpy()
        held[held.clone()] = torch.from_numpy(
            KDTree(points).query(inside)[0] < self.told_apart[state].query(inside)[0] + 0.5 * self.voxel
        )
        return held

    def splats_of(self, part: MovingPart) -> Splats:
        """A part's splats in its own state: its pieces', as one box around all may hold some of the base."""
        return self.looks[part.state].splats[self.held_by_part(part)]

    def held_by_part(self, part: MovingPart) -> Bool[Tensor, " N"]:
        """Which splats of a part's own state are its own."""
        return torch.stack([self.held_by(points, part.state) for points in part.pieces]).any(0)

    def splats_in(self, members: set[int]) -> Splats:
        """The splats of the clusters in `members`, all of one state."""
        splats = self.looks[self.clusters[min(members)].state].splats
        return splats[torch.stack([self.held[i] for i in sorted(members)]).any(0)]

    def scene(self, state: int, rest: Splats) -> Scene:
        """A state's photos as judges of a part among all the rest."""
        return Scene(self.looks[state], rest, self.views[state], self.still)

    def rest(self, parts: list[MovingPart], state: int) -> Splats:
        """All that stands still in `state`, with the parts found so far as they stand in the other state."""
        splats = self.looks[state].splats
        moving = torch.zeros(len(splats), dtype=torch.bool)
        for cluster, held in zip(self.clusters, self.held, strict=True):
            if cluster.state == state:
                moving |= held
        placed = []
        for part in parts:
            piece = self.splats_of(part)
            placed.append(piece.moved(part.hypothesis.motion) if part.state == state else piece)
        return Splats.concatenate([splats[~moving], *placed])

    def trial(self, state: int, points: Points, piece: Splats, weight: float, others: list[MovingPart]) -> Trial:
        """What was found in a state between the photos of both, with the other parts in place."""
        return Trial(
            there=self.scene(1 - state, self.rest(others, state)),
            here=self.scene(state, self.rest(others, 1 - state)),
            others=self.looks[1 - state].splats,
            piece=piece,
            box=self.box(points),
            weight=weight,
            most=weight,
            near=self.voxel,
            own=KDTree(points),
            taken=self.stays,
            least=self.config.shows * weight,
        )

    def pulled(self, start: Hypothesis, trial: Trial, steps: int) -> Hypothesis:
        """The simplest motion that does where the photos pull a hypothesis, or the hypothesis, if all in all it is better.

        Args:
            start: the hypothesis, with its errors.
            trial: the part between the photos.
            steps: of the pull.
        """
        refined = refine(start, trial, steps, self.config.rate)
        if trial.shows(refined):
            return min(simplest(refined, trial, self.base_box, self.config.plain), start, key=trial.burden)
        refined = simplest(refined, trial, self.base_box, self.config.plain_if_shut)
        return min((along_base(h, trial, self.base_box) for h in (refined, start)), key=trial.burden)

    def sample(self, points: Float64[np.ndarray, "P 3"], most: int) -> Float64[np.ndarray, "Q 3"]:
        """At most so many of the points, drawn by chance."""
        return points if len(points) <= most else points[self.generator.choice(len(points), most, replace=False)]

    def within(self, part: MovingPart, cluster: Cluster) -> Bool[Tensor, " P"]:
        """Which points of a cluster of either state lie where the part is in that state."""
        return self._in_any(self._lying(part)[cluster.state], cluster)

    def explained_by(self, part: MovingPart) -> set[int]:
        """Clusters of either state that lie where the part is in that state."""
        boxes, clusters = self._lying(part), enumerate(self.clusters)
        return {i for i, cluster in clusters if float(self._in_any(boxes[cluster.state], cluster).double().mean()) > 0.6}

    def _lying(self, part: MovingPart) -> dict[int, list[Box]]:
        """The boxes around what of a part's pieces lies together, by state.

        One box around pieces that lie apart, as two drawers do that come out alike, would hold what is between them.
        """
        near, trees = (self.config.cue.link + self.config.clear) * self.voxel, [KDTree(points) for points in part.pieces]
        beside = [[a is b or a.query(b.data, distance_upper_bound=near)[0].min() < near for a in trees] for b in trees]
        count, lump = connected_components(np.array(beside))
        own = [self.box(np.concatenate([part.pieces[i] for i in np.flatnonzero(lump == k)])) for k in range(count)]
        return {part.state: own, 1 - part.state: [box.moved(part.hypothesis.motion) for box in own]}

    def _in_any(self, boxes: list[Box], cluster: Cluster) -> Bool[Tensor, " P"]:
        """Which points of a cluster lie in any of some boxes, or near it."""
        points = torch.from_numpy(cluster.points)
        return torch.stack([box.contains(points, margin=3 * self.voxel) for box in boxes]).any(0)


def _in_both(one: Points, two: Points, gap: float) -> Points:
    """What each of two sets has nearer than `gap` to a point of the other."""
    return np.concatenate([points[KDTree(others).query(points)[0] < gap] for points, others in ((one, two), (two, one))])

"""The motion cue, read both ways, and the clusters of what moved (supplement 1.3, method.md point 3)."""

from dataclasses import dataclass

import numpy as np
import skimage.measure
import torch
import trimesh
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree
from sklearn.cluster import DBSCAN
from torch import Tensor

from ..capture import ImageStack
from ..geometry import Box
from ..model import Splats
from ..points import Hull, face_axes

Points = Float64[np.ndarray, "_ 3"]


@dataclass(frozen=True)
class CueConfig:
    """How moving points are told from still ones, in voxels of the hull."""

    threshold: float = 1.5
    """A point moves if it lies further than this from the other state's solid (tau_motion)."""
    link: float = 2.5
    """Moving points closer than this belong together (DBSCAN's eps)."""
    neighbours: int = 6
    """Points within `link` that make a point dense (DBSCAN's min_samples)."""
    hollow: float = 0.65
    """A cluster is cut in two where the boxes of the pieces together have less than this share of its box's volume."""
    smallest: float = 0.004
    """Clusters below this fraction of a state's points are dropped as noise."""


@dataclass(frozen=True)
class StateLook:
    """What is known of one state by itself.

    Attributes:
        stack: its photos at a small size.
        hull: its visual hull.
        points: its surface, in the world.
        splats: its quick look, in the world.
    """

    stack: ImageStack
    hull: Hull
    points: Float64[np.ndarray, "P 3"]
    splats: Splats


@dataclass(frozen=True)
class Cluster:
    """Points that are in one state and not in the other: a moving part, several, or a piece of one.

    Attributes:
        state: the state in which the points are there.
        points: in the world.
    """

    state: int
    points: Float64[np.ndarray, "P 3"]


def moving_points(points: Float64[np.ndarray, "P 3"], other: StateLook, threshold: float) -> Bool[np.ndarray, " P"]:
    """Points farther than `threshold` (world units) from any surface of the other state, and from its visual hull.

    The distance alone (eq. 1 of the supplement) also finds surfaces that merely came to light, such as the inside of an
    opened cabinet; the masks must say that the other state has nothing there.
    """
    carved = other.hull.sample(other.hull.distance(), points, outside=np.inf) > threshold
    if not len(other.points):
        return carved
    return carved & (KDTree(other.points).query(points, distance_upper_bound=2 * threshold)[0] > threshold)


def held_by_hull(points: Float64[np.ndarray, "P 3"], look: StateLook) -> Bool[np.ndarray, " P"]:
    """Points that a state's visual hull holds, or that lie within a voxel of it."""
    return look.hull.sample(look.hull.distance(), points, outside=np.inf) <= look.hull.voxel


def clusters(looks: tuple[StateLook, StateLook], config: CueConfig) -> list[Cluster]:
    """Clusters of departed (state 0) and arrived (state 1) points, the largest first."""
    found = []
    for state, look in enumerate(looks):
        other = looks[1 - state]
        voxel = other.hull.voxel
        moving = look.points[moving_points(look.points, other, config.threshold * voxel)]
        for whole in linked(moving, config, voxel):
            pieces = split_where_hollow(whole, 0.5 * voxel, config.hollow)
            found += [Cluster(state, piece) for piece in pieces if len(piece) >= config.smallest * len(look.points)]
    return sorted(found, key=lambda cluster: -len(cluster.points))


def linked(points: Float64[np.ndarray, "P 3"], config: CueConfig, voxel: float) -> list[Points]:
    """The points in pieces that hang together, without those that lie alone and pieces of a few points (DBSCAN)."""
    if len(points) < config.neighbours:
        return []
    labels = DBSCAN(eps=config.link * voxel, min_samples=config.neighbours).fit_predict(points)
    pieces = [points[labels == label] for label in range(labels.max() + 1)]
    return [piece for piece in pieces if len(piece) >= 2 * config.neighbours]


def split_where_hollow(points: Float64[np.ndarray, "P 3"], thinnest: float, ratio: float) -> list[Points]:
    """The points, cut by planes across their box's axes for as long as that makes the boxes much smaller.

    Two parts that touch in the state where both are open are one cluster; but no one box fits them well.  A single part cut
    in two by mistake is mended later, as both pieces move alike.

    Args:
        points: in the world.
        thinnest: smallest half extent of a box, world units.
        ratio: cut if the pieces' boxes have less than this share of the volume.
    """
    generator = np.random.default_rng(0)
    sample = points if len(points) <= 600 else points[generator.choice(len(points), 600, replace=False)]
    box = box_around(sample, thinnest, trim=0.01)
    local = (sample - box.T_world_box.xyz.numpy()) @ box.T_world_box.rotation.numpy()
    best, cut = ratio * float(box.volume), None
    for axis in range(3):
        for level in np.quantile(local[:, axis], np.linspace(0.15, 0.85, 15)):
            low = local[:, axis] < level
            if 30 <= low.sum() <= len(low) - 30:
                volume = sum(float(box_around(sample[side], thinnest, trim=0.01).volume) for side in (low, ~low))
                if volume < best:
                    best, cut = volume, (axis, level)
    if cut is None:
        return [points]
    low = ((points - box.T_world_box.xyz.numpy()) @ box.T_world_box.rotation.numpy())[:, cut[0]] < cut[1]
    return [piece for side in (low, ~low) for piece in split_where_hollow(points[side], thinnest, ratio)]


def one_box_holds(one: Points, two: Points, thinnest: float, ratio: float) -> bool:
    """Whether a box around both is hardly more than their own boxes, which have at least this share of its volume."""
    whole, *both = (float(box_around(points, thinnest).volume) for points in (np.concatenate([one, two]), one, two))
    return sum(both) > ratio * whole


def box_around(
    points: Float64[np.ndarray, "P 3"], thinnest: float, trim: float = 0.002, axes: Float64[Tensor, "3 3"] | None = None
) -> Box:
    """The oriented box of least volume around points, the outermost fraction `trim` left out along each axis.

    Args:
        points: in the world.
        thinnest: smallest half extent to give, world units (points on a plane have no thickness).
        trim: fraction of the points that may stick out at each face.
        axes: of the box, as columns, if it is not free to turn.
    """
    axes = _tight_axes(points) if axes is None else axes
    local = points @ axes.numpy()
    low, high = np.quantile(local, [trim, 1 - trim], axis=0)
    box = Box.around(torch.from_numpy(np.stack([low, high]) @ axes.numpy().T), axes)
    return Box(box.T_world_box, box.half_extents.clamp(min=thinnest))


def base_axes(looks: tuple[StateLook, StateLook]) -> Float64[Tensor, "3 3"]:
    """Axes, as columns, of what stands still: those of its faces, near those of the largest solid that both hulls hold.

    Points of a quick look at few photos stray too far from the surface for a box around them to say how the whole lies.
    """
    hull = looks[0].hull
    both = hull.occupied & looks[1].hull.occupied
    if not both.any():
        return _tight_axes(looks[0].points)
    solids = np.asarray(skimage.measure.label(both, connectivity=1))
    axes = _tight_axes(hull.centres(solids == np.bincount(solids[both]).argmax()))
    points = np.concatenate([look.points[held_by_hull(look.points, other)] for look, other in (looks, looks[::-1])])
    return torch.from_numpy(face_axes(points, axes.numpy(), 0.5 * hull.voxel)) if len(points) else axes


def _tight_axes(points: Float64[np.ndarray, "P 3"]) -> Float64[Tensor, "3 3"]:
    """Axes, as columns, of the box of least volume that holds all points."""
    try:
        to_box = trimesh.bounds.oriented_bounds(points)[0]
        axes = torch.from_numpy(to_box[:3, :3].T.copy())
    except (ValueError, IndexError, RuntimeError):  # fewer than four points, or all in one plane
        axes = torch.from_numpy(np.linalg.svd(points - points.mean(0), full_matrices=True)[2].T.copy())
    if torch.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    return axes

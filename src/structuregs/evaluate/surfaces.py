"""Errors of surfaces against the true ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float

from ..capture import Truth, View
from ..export.mesh import without_specks
from ..metrics import chamfer, nearest_distances
from ..model import ArticulatedObject

_STEP = 4  # of the views that say what can be seen, every fourth is looked at
_LOOK = 128  # side of their images, pixels
_DEEPER = 0.03  # of the object's size: true points farther than this behind the nearest one of their pixel are hidden


@dataclass(frozen=True)
class SurfaceProtocol:
    """How surfaces are compared under a protocol.

    Attributes:
        points: drawn from each mesh, uniformly over its area.
        states: in which states; figures are means over them.
        smallest_piece: connected pieces below this share of a part's largest are dropped first.
        seen_only: whether accuracy and completeness over the surface that some camera sees are also taken.
    """

    points: int
    states: tuple[int, ...]
    smallest_piece: float
    seen_only: bool


SURFACE_PROTOCOLS = {
    "paris": SurfaceProtocol(10_000, (0,), 0.0, False),
    "artgs": SurfaceProtocol(10_000, (0, 1), 0.1, False),
    "strict": SurfaceProtocol(100_000, (0, 1), 0.0, True),
}


@dataclass(frozen=True)
class SurfaceScore:
    """How far surfaces lie from the true ones.

    Attributes:
        cd_static: Chamfer distance of the base x 1000: mean squared distances, both directions added, capture's unit squared.
        cd_movable: the same of the moving parts, their mean; None where a true part has no surface to compare.
        cd_whole: the same of all surfaces together.
        accuracy: mean distance of the whole surface from the true one, capture's unit; None unless the protocol asks for it.
        completeness: mean distance of the true surface that some training camera sees from the whole surface; likewise.
    """

    cd_static: float
    cd_movable: float | None
    cd_whole: float
    accuracy: float | None = None
    completeness: float | None = None


def score_surfaces(
    meshes: Sequence[trimesh.Trimesh],
    obj: ArticulatedObject,
    truth: Truth,
    parts: Sequence[int | None],
    protocol: SurfaceProtocol,
    views: Sequence[Sequence[View]] = (),
) -> SurfaceScore | None:
    """The errors of an object's surfaces; None where a true mesh or the base's surface is missing.

    Args:
        meshes: of the object's parts, in the world in state 0.
        obj: moves them into state 1.
        truth: with meshes of every part in the protocol's states.
        parts: the object's part that stands for each true joint's.
        protocol: what is compared, and how.
        views: training views of each state, which say what can be seen.
    """
    wanted = {(state, k) for state in protocol.states for k in range(len(truth.joints) + 1)}
    if not wanted <= truth.meshes.keys() or not len(meshes[0].faces):
        return None
    cleaned = [without_specks(mesh, protocol.smallest_piece) for mesh in meshes]
    rows = []
    for state in protocol.states:
        true = [_loaded(truth, state, k) for k in range(len(truth.joints) + 1)]
        seen = views[state] if protocol.seen_only and views else ()
        rows.append(_score(_moved(cleaned, obj, state), true, parts, protocol.points, seen))
    return _mean(rows)


def _score(
    found: list[trimesh.Trimesh],
    true: list[trimesh.Trimesh],
    parts: Sequence[int | None],
    count: int,
    views: Sequence[View],
) -> SurfaceScore:
    pairs = [(found[0], true[0]), *((found[k] if k is not None else None, true[i]) for i, k in enumerate(parts, start=1))]
    values = [
        None if mesh is None or not len(mesh.faces) else chamfer(_points(mesh, count, 0), _points(target, count, 1))
        for mesh, target in pairs
    ]
    static, *movable = values
    assert static is not None
    whole, whole_true = _points(_together(found), count, 0), _points(_together(true), count, 1)
    moved = [value for value in movable if value is not None]
    accuracy = completeness = None
    if views:
        accuracy = float(nearest_distances(whole, whole_true).mean())
        completeness = float(nearest_distances(whole_true[seen_points(whole_true, views)], whole).mean())
    mean = sum(moved) / len(moved) if moved and len(moved) == len(movable) else None
    return SurfaceScore(static, mean, chamfer(whole, whole_true), accuracy, completeness)


def _together(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of several, colours left out."""
    firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + first for mesh, first in zip(meshes, firsts, strict=True)]
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), process=False)


def _points(mesh: trimesh.Trimesh, count: int, seed: int) -> Float[np.ndarray, "P 3"]:
    """Points uniform over a mesh's area, always the same ones; two equal meshes need two seeds, or no point is off."""
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0])


def _loaded(truth: Truth, state: int, part: int) -> trimesh.Trimesh:
    return trimesh.load_mesh(truth.meshes[state, part], process=False)


def _moved(meshes: Sequence[trimesh.Trimesh], obj: ArticulatedObject, state: int) -> list[trimesh.Trimesh]:
    """The parts' meshes in a state."""
    motions = [np.eye(4), *(T.as_matrix().numpy() for T in obj.motions([joint.q[state] for joint in obj.joints]))]
    return [mesh.copy().apply_transform(motion) for mesh, motion in zip(meshes, motions, strict=True)]


def seen_points(points: Float[np.ndarray, "P 3"], views: Sequence[View]) -> Bool[np.ndarray, " P"]:
    """Which points of a densely sampled surface some camera sees: those near the front of their pixel in a small image."""
    seen = np.zeros(len(points), bool)
    slack = _DEEPER * float(np.ptp(points, axis=0).max())
    for view in views[::_STEP]:
        camera = view.camera.resized(_LOOK, max(1, round(_LOOK * view.camera.height / view.camera.width)))
        pixels, z = camera.project(torch.from_numpy(points))
        column, row = np.floor(pixels.numpy()).astype(np.int64).T
        depth = z.numpy()
        rows = np.flatnonzero((depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height))
        pixel = row[rows] * camera.width + column[rows]
        front = np.full(camera.width * camera.height, np.inf)
        np.minimum.at(front, pixel, depth[rows])
        seen[rows[depth[rows] < front[pixel] + slack]] = True
    return seen


def _mean(rows: Sequence[SurfaceScore]) -> SurfaceScore:
    """The mean of every figure over states; None where one of them is."""

    def mean(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return sum(known) / len(known) if len(known) == len(values) else None

    static, whole = (sum(values) / len(rows) for values in ([r.cd_static for r in rows], [r.cd_whole for r in rows]))
    return SurfaceScore(
        static,
        mean([r.cd_movable for r in rows]),
        whole,
        mean([r.accuracy for r in rows]),
        mean([r.completeness for r in rows]),
    )

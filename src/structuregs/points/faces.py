"""Which way a thing lies, told by its faces: the axes along which points of its surface pile up."""

import itertools

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

_MOST = 4000  # points that are asked
_TURNS = np.arange(-12.0, 12.1, 3.0)  # degrees about each axis, at first
_STARTS = 4  # of the turns at first, the best...
_CLOSE = 4.5  # ...that are so many degrees apart, from which...
_STEPS = (1.5, 0.8, 0.4, 0.2, 0.1, 0.05)  # ...turns of so many degrees climb
_SHARPER = 0.03  # more, of so many points: less is chance, or as good as it was
_FRAME = 1.0  # degrees: the world's axes stand for those that are this near and not clearly sharper

Axes = Float64[np.ndarray, "3 3"]


def face_axes(points: Float64[np.ndarray, "P 3"], start: Axes, cell: float) -> Axes:
    """Axes, as columns, across which points lie in the sharpest layers; within 12 degrees about each axis of those given.

    The box of least volume lies askew where something sticks out at a corner.  Faces do not: seen along a face, its points
    are one peak in the histogram of their places.  The sum of the squares of the three axes' histograms is greatest where
    most faces are seen so.  Where no other axes are clearly better, as of a ball, the given ones stay; and so do the world's
    where they are near: what was photographed on a turntable or in a simulator mostly stands along them.

    Args:
        points: of a surface, in the world.
        start: axes near the ones to find.
        cell: of the histograms, world units: about as large as the points' distance from the surface.
    """
    if len(points) > _MOST:
        points = points[np.random.default_rng(0).choice(len(points), _MOST, replace=False)]
    turned = [start @ turn for turn in _turns(_TURNS)]
    ranked = np.argsort([-_sharpness(points, axes, 2 * cell) for axes in turned], kind="stable")
    starts: list[Axes] = []
    for axes in (turned[k] for k in ranked):
        if len(starts) < _STARTS and all(_apart(axes, other) > _CLOSE for other in starts):
            starts.append(axes)
    sharpness, best = max((_climbed(points, axes, cell) for axes in starts), key=lambda found: found[0])
    as_given = _sharpness(points, start, cell)
    clearly = 1 + _SHARPER * np.sqrt(_MOST / len(points))  # shares scatter the more, the fewer points they are of
    if sharpness <= clearly * as_given:
        sharpness, best = as_given, start
    world = np.round(best)  # signed axes of the world, if the best are near any; at 45 degrees it is no rotation
    near = np.abs(world).sum() == 3 and _apart(best, world) < _FRAME
    return world if near and sharpness <= clearly * _sharpness(points, world, cell) else best


def _climbed(points: Float64[np.ndarray, "P 3"], axes: Axes, cell: float) -> tuple[float, Axes]:
    """Axes from which no small turn leads to sharper layers, after how sharp they are."""
    best = _sharpness(points, axes, cell)
    for step in _STEPS:
        turns = _turns(np.array([-step, 0.0, step]))
        while True:
            turned = [axes @ turn for turn in turns]
            scores = [_sharpness(points, other, cell) for other in turned]
            if max(scores) <= best:
                break
            best, axes = max(scores), turned[int(np.argmax(scores))]
    return best, axes


def _turns(degrees: Float64[np.ndarray, " T"]) -> list[Axes]:
    """Rotations by every combination of angles about the three axes."""
    return list(Rotation.from_rotvec(list(itertools.product(degrees, repeat=3)), degrees=True).as_matrix())


def _apart(one: Axes, other: Axes) -> float:
    """Degrees between two rotations."""
    return float(np.degrees(Rotation.from_matrix(one.T @ other).magnitude()))


def _sharpness(points: Float64[np.ndarray, "P 3"], axes: Axes, cell: float) -> float:
    """Sum over the axes of the squares of a histogram's shares; a point counts in the two cells that it lies between."""
    places = points @ (axes / cell)
    places -= places.min(0)
    total = 0.0
    for place in places.T:
        below = place.astype(int)
        above = place - below
        shares = np.bincount(below, 1 - above, below.max() + 2) + np.bincount(below + 1, above, below.max() + 2)
        total += float(shares @ shares)
    return total / len(points) ** 2

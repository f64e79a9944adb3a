"""Choosing few out of many places, well apart."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..geometry import Camera


def farthest_points(points: Float[np.ndarray, "V 3"], count: int, first: int) -> list[int]:
    """Indices of `count` points, each the farthest from all that were chosen before it, in that order."""
    chosen = [first]
    distance = np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def spread_cameras(cameras: Sequence[Camera], most: int) -> list[int]:
    """Indices of at most `most` cameras, each the farthest from all before it, so that the first few do for a quick look.

    Every n-th camera would not do: on a spiral these may all lie on one side of the object.
    """
    centres = np.stack([camera.centre.numpy() for camera in cameras])
    return farthest_points(centres, min(most, len(cameras)), 0)

"""Point clouds that come from elsewhere than the masks: depth maps, pretrained estimators and files."""

from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
import trimesh
from jaxtyping import Float64

from ..capture import Capture, CaptureError, View
from .estimators import ESTIMATORS, estimated_points

_MOST_POINTS = 40_000  # of a cloud; more only cost time in a cue that is coarse by intent


@dataclass(frozen=True)
class Clouds:
    """Points of an object's surface.

    Attributes:
        points: of state 0 and of state 1, in the world.
        says: what a user should know of where they come from.
    """

    points: tuple[Float64[np.ndarray, "P 3"], Float64[np.ndarray, "Q 3"]]
    says: tuple[str, ...] = ()


def points_from(capture: Capture, source: str) -> Clouds | None:
    """The points of both states in the world from `source`; None for "hull", which needs no cloud.

    Args:
        capture: whose depth maps or photos are read.
        source: "hull", "depth", "vggt", "pi3", an .npz with arrays `points_0` and `points_1`, or a .ply path with `{state}`
            in it, which stands for 0 and 1.

    Raises:
        CaptureError: the depth, the estimator or the file is not there or does not give points.
    """
    if source == "hull":
        return None
    says: list[str] = []
    if source in ESTIMATORS:
        (first, second), says = estimated_points(capture, ESTIMATORS[source])
        first, second = _checked(first, source), _checked(second, source)
    elif source == "depth":
        first, second = (np.concatenate([_back_projected(view) for view in views]) for views in capture.train)
    else:
        first, second = _read(source)
    return Clouds((_thinned(first), _thinned(second)), tuple(says))


def _back_projected(view: View) -> Float64[np.ndarray, "P 3"]:
    depth = view.depth
    if depth is None:
        raise CaptureError(f"view {view.name} has no depth map; use --points hull, which needs none.")
    seen = (depth > 0) & (view.rgba[..., 3] > 127)
    origin, rays = view.camera.rays()
    return (origin + rays * torch.from_numpy(depth)[..., None])[torch.from_numpy(seen)].double().numpy()


def _read(source: str) -> tuple[Float64[np.ndarray, "P 3"], Float64[np.ndarray, "Q 3"]]:
    if source.endswith(".ply") and "{state}" in source:
        return _read_ply(source.replace("{state}", "0")), _read_ply(source.replace("{state}", "1"))
    if not source.endswith(".npz"):
        raise CaptureError(
            f"--points {source}: give hull, depth, {', '.join(ESTIMATORS)}, a file FILE.npz, or a path with {{state}} that ends"
            " in .ply."
        )
    try:
        with np.load(source) as arrays:
            first, second = arrays["points_0"], arrays["points_1"]
    except (OSError, EOFError, BadZipFile, KeyError, TypeError, ValueError) as error:
        raise CaptureError(
            f"--points {source}: no .npz with the arrays points_0 and points_1 of shape N x 3 ({error})."
        ) from error
    return _checked(first, source), _checked(second, source)


def _read_ply(path: str) -> Float64[np.ndarray, "P 3"]:
    if not Path(path).is_file():
        raise CaptureError(f"--points {path}: there is no such file.")
    try:
        loaded = trimesh.load(path)
    except (ValueError, OSError, IndexError, KeyError) as error:
        raise CaptureError(f"--points {path}: not a PLY file that can be read ({error}).") from error
    return _checked(np.asarray(getattr(loaded, "vertices", np.zeros(0))), path)


def _checked(points: np.ndarray, path: str) -> Float64[np.ndarray, "P 3"]:
    numbers = np.issubdtype(points.dtype, np.integer) or np.issubdtype(points.dtype, np.floating)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 100 or not numbers or not np.isfinite(points).all():
        raise CaptureError(f"--points {path}: wanted at least 100 finite points of shape N x 3, found {points.shape}.")
    return points.astype(np.float64)


def _thinned(points: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, "Q 3"]:
    step = max(1, len(points) // _MOST_POINTS)
    return points[::step]

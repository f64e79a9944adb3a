"""Reading and checking a capture folder."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, UInt8
from PIL import Image

from ..geometry import SE3, Camera
from .capture import Capture, View
from .errors import CaptureError
from .layouts import STATES, Frame, Layout, Split, find_layout, list_frames
from .spread import farthest_points

FEWEST_VIEWS = 3
_ROTATION_TOLERANCE = 1e-3  # of R^T R - I; real captures round their poses
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def load_capture(path: Path | str, *, views: int | None = None, seed: int = 0) -> Capture:
    """The capture in a folder of the PARIS or the ArtGS layout.

    Args:
        path: the object's folder, or one above it that holds no other capture.
        views: how many training views of each state to keep, spread over the cameras' positions (default: all).
        seed: chooses the first of them.

    Raises:
        CaptureError: the folder is no whole capture; the message names the file and what to do about it.
    """
    root, layout = find_layout(Path(path))
    generator = np.random.default_rng(seed)
    frames = {split: [_frames(root, layout, split, state) for state in (0, 1)] for split in ("train", "test")}
    if views is not None:
        frames["train"] = [
            _spread_subset(rows, views, f"{root}, state {STATES[s]}", generator) for s, rows in enumerate(frames["train"])
        ]
    name = f"{root.parent.name}_{root.name}" if layout == "paris" else root.name
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        train, test = ([pool.map(_read_view, rows) for rows in frames[split]] for split in ("train", "test"))
        capture = Capture(name, root, (tuple(train[0]), tuple(train[1])), (tuple(test[0]), tuple(test[1])), layout)
    for split in (capture.train, capture.test):
        for state, rows in enumerate(split):
            _check_together(rows, f"{root}, state {STATES[state]}")
    return capture


def camera_of_opengl(
    c2w_opengl: Float64[np.ndarray, "4 4"], K: Float64[np.ndarray, "3 3"], width: int, height: int, where: str = "camera"
) -> Camera:
    """The camera (OpenCV axes) of a camera-to-world matrix with OpenGL axes (x right, y up, z backward).

    Raises:
        CaptureError: the matrix is no rigid motion, or the intrinsics are no pinhole's; `where` begins the message.
    """
    if not (np.isfinite(c2w_opengl).all() and np.isfinite(K).all()):
        raise CaptureError(
            f"{where}: the camera holds values that are no numbers; export the cameras again, or drop its frame."
        )
    R = c2w_opengl[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise CaptureError(
            f"{where}: the camera's 3 x 3 block is no rotation (determinant {np.linalg.det(R):.3f}); "
            "take scale and mirroring out of the camera-to-world matrices."
        )
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise CaptureError(f"{where}: the focal length is {K[0, 0]:g}, {K[1, 1]:g} pixels; it must be positive.")
    if abs(K[0, 1]) > 1e-6 * K[0, 0]:
        raise CaptureError(f"{where}: K has a skew of {K[0, 1]:g}; undistort the images to a pinhole without skew.")
    pose = SE3.from_matrix(torch.from_numpy(c2w_opengl @ _OPENGL_FROM_OPENCV)).to(dtype=torch.float32)
    return Camera(pose, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height)


def opengl_of_camera(camera: Camera) -> Float64[np.ndarray, "4 4"]:
    """The camera-to-world matrix with OpenGL axes, as capture folders hold it."""
    return camera.T_world_camera.to(dtype=torch.float64).as_matrix().numpy() @ _OPENGL_FROM_OPENCV


def _frames(root: Path, layout: Layout, split: Split, state: int) -> list[Frame]:
    """The frames of one split and state, enough of them to reconstruct from."""
    frames = list_frames(root, layout, split, state)
    if split == "train" and len(frames) < FEWEST_VIEWS:
        raise CaptureError(
            f"{root}, state {STATES[state]}: {len(frames)} training views; {FEWEST_VIEWS} or more are needed, take more."
        )
    return frames


def _spread_subset(frames: list[Frame], count: int, where: str, generator: np.random.Generator) -> list[Frame]:
    """`count` frames by farthest-point sampling of the cameras' positions, in the file's order."""
    if not FEWEST_VIEWS <= count <= len(frames):
        raise CaptureError(f"{where}: {count} views were asked for; give a number from {FEWEST_VIEWS} to {len(frames)}.")
    centres = np.stack([frame.c2w_opengl[:3, 3] for frame in frames])
    chosen = farthest_points(centres, count, int(generator.integers(len(frames))))
    return [frames[i] for i in sorted(chosen)]


def _read_view(frame: Frame) -> View:
    """Reads and checks one image and its camera."""
    rgba = _read_rgba(frame.image)
    height, width = rgba.shape[:2]
    return View(frame.name, camera_of_opengl(frame.c2w_opengl, frame.K, width, height, str(frame.image)), rgba, frame.depth)


def _read_rgba(path: Path) -> UInt8[np.ndarray, "H W 4"]:
    try:
        with Image.open(path) as image:
            masked = image.has_transparency_data
            rgba = np.asarray(image.convert("RGBA"))
    except FileNotFoundError as error:
        raise CaptureError(f"{path}: this image is missing; put it back, or drop its frame from the camera file.") from error
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise CaptureError(f"{path}: this image cannot be read ({error}); put it back, or drop its frame.") from error
    if not masked:
        raise CaptureError(f"{path}: the image has no alpha channel; masks are needed, write them as the alpha of RGBA images.")
    if not rgba[..., 3].any():
        raise CaptureError(f"{path}: the mask is empty (alpha is 0 everywhere); mask the object, or drop this frame.")
    return rgba


def _check_together(views: tuple[View, ...], where: str) -> None:
    """What only the views of one state and split together can tell.

    Raises:
        CaptureError: an image of another size than the first; no mask that leaves anything out.
    """
    for view in views:
        if view.rgba.shape != views[0].rgba.shape:
            size, first = (f"{v.camera.width} x {v.camera.height}" for v in (view, views[0]))
            raise CaptureError(
                f"{where}, image {view.name}: {size} pixels, but image {views[0].name} has {first}; use one size."
            )
    if views and all((view.rgba[..., 3] == 255).all() for view in views):
        raise CaptureError(f"{where}: every mask covers its whole image; masks are needed, with alpha 0 off the object.")

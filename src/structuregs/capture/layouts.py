"""The capture folders that can be read: where each layout keeps its images, cameras and ground truth.

Every fact about a layout's file names is in this file; `read` and `write` build on it.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64
from PIL import Image

from .errors import CaptureError

Layout = Literal["paris", "artgs"]
Split = Literal["train", "test"]
STATES = ("start", "end")
_DEPTH_BELOW = 5  # how many folders deep a single capture is looked for


@dataclass(frozen=True)
class Frame:
    """One image as a layout names it, not yet read.

    Attributes:
        name: the image file's stem.
        image: its file.
        depth: the file of its depth map, where there is one.
        c2w_opengl: camera-to-world with OpenGL's camera axes (x right, y up, z backward), as the files hold it.
        K: intrinsic matrix, pixels.
    """

    name: str
    image: Path
    depth: Path | None
    c2w_opengl: Float64[np.ndarray, "4 4"]
    K: Float64[np.ndarray, "3 3"]


def camera_file(root: Path, layout: Layout, split: Split, state: int) -> Path:
    """The JSON file with the cameras of one split and state."""
    if layout == "paris":
        return root / STATES[state] / f"camera_{split}.json"
    return root / f"transforms_{split}_{STATES[state]}.json"


def truth_folder(root: Path, layout: Layout) -> Path | None:
    """Where the ground truth of a capture lies, if it has one; None where the PARIS layout's `load` is not in its path."""
    if layout == "artgs":
        return root / "gt"
    parts = root.resolve().parts
    if "load" not in parts:
        return None
    last = len(parts) - 1 - parts[::-1].index("load")
    return Path(*parts[:last], "data", *parts[last + 1 :])


def motion_file(truth: Path) -> Path:
    """The file of the true joints in a ground truth folder of either layout."""
    nested = truth / "textured_objs" / "trans.json"
    return nested if nested.is_file() else truth / "trans.json"


def mesh_file(truth: Path, state: int, part: int | None, *, numbered: bool) -> Path:
    """The mesh of one part in one state: None = the whole object, 0 = what does not move, k = the k-th moving part.

    `numbered`: the files of moving parts carry a number, as they do where there are several.
    """
    name = STATES[state]
    if part is not None:
        number = f"_{part - 1}" if numbered else ""
        name += f"_dynamic{number}" if part else "_static"
    return truth / STATES[state] / f"{name}_rotate.ply"


def find_layout(path: Path) -> tuple[Path, Layout]:
    """The capture's own folder and its layout, for that folder or for one above it that holds no other capture.

    Raises:
        CaptureError: no capture, several captures, or one state only.
    """
    if not path.is_dir():
        raise CaptureError(f"{path}: there is no such folder; give the folder of one capture.")
    if found := _layout_of(path):
        return path, found
    below = sorted({p for depth in range(1, _DEPTH_BELOW + 1) for p in _captures_at(path, depth)})
    if len(below) == 1 and (found := _layout_of(below[0])):
        return below[0], found
    if below:
        names = ", ".join(str(p.relative_to(path)) for p in below[:5]) + (", ..." if len(below) > 5 else "")
        raise CaptureError(f"{path}: {len(below)} captures lie below this folder ({names}); give one of them.")
    raise CaptureError(
        f"{path}: no capture here; expected start/camera_train.json and end/camera_train.json (PARIS layout) "
        "or transforms_train_start.json and transforms_train_end.json (ArtGS layout)."
    )


def find_captures(path: Path) -> list[Path]:
    """The folders of all captures at or below a folder, or those that a text file lists, one a line.

    Lines are relative to the file's folder; empty ones and those that begin with # do not count.

    Raises:
        CaptureError: there is no such file or folder, or no capture in it.
    """
    if path.is_file():
        lines = [line.strip() for line in path.read_text().splitlines()]
        found = [find_layout(path.parent / line)[0] for line in lines if line and not line.startswith("#")]
        if not found:
            raise CaptureError(f"{path}: the list names no capture; write the folder of one in each line.")
        return found
    if not path.is_dir():
        raise CaptureError(f"{path}: there is no such folder or list; give a folder that holds captures.")
    found = sorted({p for depth in range(_DEPTH_BELOW + 1) for p in _captures_at(path, depth)})
    if not found:
        find_layout(path)  # says what was expected
    return found


def _captures_at(path: Path, depth: int) -> set[Path]:
    """Folders `depth` levels below that hold a camera file of state 0."""
    up = "*/" * depth
    return {p.parents[1] for p in path.glob(f"{up}start/camera_train.json")} | {
        p.parent for p in path.glob(f"{up}transforms_train_start.json")
    }


def _layout_of(path: Path) -> Layout | None:
    """The layout of a capture's own folder; None where it is none."""
    for layout in ("paris", "artgs"):
        files = [camera_file(path, layout, "train", state) for state in (0, 1)]
        there = [file.is_file() for file in files]
        if all(there):
            return layout
        if any(there):
            missing = files[there.index(False)]
            raise CaptureError(f"{missing}: this file is missing, so there is one state only; a capture needs both.")
    return None


def list_frames(root: Path, layout: Layout, split: Split, state: int) -> list[Frame]:
    """The frames of one split and state, in the file's order; none where a capture has no test split.

    Raises:
        CaptureError: the camera file is damaged, or lacks what it must hold.
    """
    file = camera_file(root, layout, split, state)
    if split == "test" and not file.is_file():
        return []
    record = read_json(file)
    try:
        return _paris_frames(file, record, split) if layout == "paris" else _artgs_frames(file, record)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, CaptureError):
            raise
        raise CaptureError(
            f"{file}: not a camera file of the {layout} layout ({error!r}); export the cameras again."
        ) from error


def read_json(file: Path) -> Any:
    """The content of a JSON file.

    Raises:
        CaptureError: the file is missing or damaged.
    """
    try:
        return json.loads(file.read_text())
    except OSError as error:
        raise CaptureError(f"{file}: this file cannot be read ({error.strerror}); put it back.") from error
    except ValueError as error:
        raise CaptureError(f"{file}: this is no valid JSON ({error}); export it again.") from error


def _paris_frames(file: Path, record: dict[str, Any], split: Split) -> list[Frame]:
    K = _matrix(record["K"], 3, f"{file}, K")
    poses = {name: pose for name, pose in record.items() if name != "K"}
    folder = file.parent / split
    return [
        Frame(name, folder / f"{name}.png", None, _matrix(pose, 4, f"{file}, frame {name}"), K) for name, pose in poses.items()
    ]


def _artgs_frames(file: Path, record: dict[str, Any]) -> list[Frame]:
    frames, K = [], None
    for row in record["frames"]:
        image = file.parent / row["file_path"]
        image = image if image.suffix else image.with_suffix(".png")
        depth = image.parent.parent / "depth" / f"{image.stem}.png"
        K = _intrinsics_of_angles(record, image) if K is None else K  # all images of a split have one size: `read` sees to it
        pose = _matrix(row["transform_matrix"], 4, f"{file}, frame {row['file_path']}")
        frames.append(Frame(image.stem, image, depth if depth.is_file() else None, pose, K))
    return frames


def _intrinsics_of_angles(record: dict[str, Any], image: Path) -> Float64[np.ndarray, "3 3"]:
    """The pinhole whose field of view spans `camera_angle_x` (and `camera_angle_y`) radians."""
    try:
        with Image.open(image) as opened:
            width, height = opened.size
    except (OSError, SyntaxError) as error:
        raise CaptureError(f"{image}: this image cannot be read ({error}); put it back, or drop its frame.") from error
    fx = width / 2 / math.tan(record["camera_angle_x"] / 2)
    fy = height / 2 / math.tan(record["camera_angle_y"] / 2) if "camera_angle_y" in record else fx
    return np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])


def _matrix(rows: Any, size: int, where: str) -> Float64[np.ndarray, "n n"]:
    """A square matrix of a JSON file."""
    matrix = np.asarray(rows, dtype=np.float64)
    if matrix.shape != (size, size):
        raise CaptureError(f"{where}: a {size} x {size} matrix is needed, found shape {matrix.shape}; export it again.")
    return matrix

"""Writing captures and their ground truth in the layouts that can be read."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from ..geometry import Camera
from .capture import MM_PER_UNIT, Capture, View
from .layouts import STATES, Layout, Split, camera_file, mesh_file, truth_folder
from .read import opengl_of_camera
from .truth import KIND_OF_TYPE, TrueJoint


@dataclass(frozen=True)
class TrueMesh:
    """A part's true surface in one state: vertices in the world and triangles."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]


def save_capture(capture: Capture, root: Path, layout: Layout) -> None:
    """Writes images and cameras into `root`, so that `load_capture(root)` gives the same capture.

    Depth is written in the ArtGS layout only, in whole thousandths of the capture's unit; the PARIS layout has no place for it.

    Raises:
        ValueError: the cameras of one split and state differ in what the layout holds once for all of them.
    """
    write = _write_paris if layout == "paris" else _write_artgs
    splits: tuple[Split, ...] = ("train", "test")
    jobs = []
    for split in splits:
        for state, views in enumerate(getattr(capture, split)):
            jobs += write(views, root, split, state) if views else []
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(_save_png, *zip(*jobs, strict=True)))


def save_truth(root: Path, layout: Layout, joints: Sequence[TrueJoint], meshes: Mapping[tuple[int, int], TrueMesh]) -> Path:
    """Writes the true joints and meshes beside the capture in `root` and returns their folder (see `load_truth`).

    Args:
        root: the capture's folder; in the PARIS layout it lies below a folder `load`, the truth goes to `data` beside it.
        layout: of the capture.
        joints: of the moving parts.
        meshes: by state and part, as `Truth.meshes`; the whole object's mesh is written as well.
    """
    folder = truth_folder(root, layout)
    if folder is None:
        raise ValueError(
            f"{root}: the PARIS layout keeps the truth beside a folder `load`; save to .../load/<set>/<category>/<id>."
        )
    file = folder / "textured_objs" / "trans.json" if layout == "paris" else folder / "trans.json"
    rows = [_joint_record(joint) for joint in joints]
    _write_json(file, {"trans_info": rows[0] if len(rows) == 1 else rows})
    for state in range(len(STATES)):
        parts = {part: mesh for (s, part), mesh in sorted(meshes.items()) if s == state}
        for part, mesh in parts.items():
            _export(mesh_file(folder, state, part, numbered=len(joints) > 1), [mesh])
        _export(mesh_file(folder, state, None, numbered=False), list(parts.values()))
    return folder


def _write_paris(views: Sequence[View], root: Path, split: Split, state: int) -> list[tuple[np.ndarray, Path]]:
    """Writes the camera file and tells which images to write where."""
    first = _shared_intrinsics(views)
    K = [[first.fx, 0.0, first.cx], [0.0, first.fy, first.cy], [0.0, 0.0, 1.0]]
    poses = {view.name: opengl_of_camera(view.camera).tolist() for view in views}
    file = camera_file(root, "paris", split, state)
    _write_json(file, {"K": K} | poses)
    return [(view.rgba, file.parent / split / f"{view.name}.png") for view in views]


def _write_artgs(views: Sequence[View], root: Path, split: Split, state: int) -> list[tuple[np.ndarray, Path]]:
    """Writes the camera file and tells which images and depth maps to write where."""
    first = _shared_intrinsics(views)
    if not (math.isclose(first.cx, first.width / 2) and math.isclose(first.cy, first.height / 2)):
        raise ValueError(f"{root}: the ArtGS layout has the principal point in the image's middle; save in the PARIS layout.")
    folder = Path(split) / STATES[state]
    frames, jobs = [], []
    for view in views:
        image = folder / "rgba" / f"{view.name}.png"
        pose = opengl_of_camera(view.camera).tolist()
        frames.append({"file_path": image.as_posix(), "time": state, "transform_matrix": pose})
        jobs.append((view.rgba, root / image))
        depth = view.depth
        if depth is not None:
            jobs.append((np.rint(depth * MM_PER_UNIT).astype(np.uint16), root / folder / "depth" / f"{view.name}.png"))
    angles = {
        "camera_angle_x": 2 * math.atan(first.width / 2 / first.fx),
        "camera_angle_y": 2 * math.atan(first.height / 2 / first.fy),
    }
    _write_json(camera_file(root, "artgs", split, state), angles | {"frames": frames})
    return jobs


def _shared_intrinsics(views: Sequence[View]) -> Camera:
    """The first camera, whose intrinsics and size all others share."""
    kinds = {(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in (view.camera for view in views)}
    if len(kinds) > 1:
        raise ValueError(
            f"view {views[0].name} and others: {len(kinds)} different intrinsics, but a layout holds one; resample."
        )
    return views[0].camera


def _joint_record(joint: TrueJoint) -> dict[str, Any]:
    word = next(word for word, kind in KIND_OF_TYPE.items() if kind == joint.kind)
    values = {"l": joint.q0, "r": joint.q1}
    if joint.kind == "revolute":
        values = {key: math.degrees(value) for key, value in values.items()}
    return {"axis": {"o": list(joint.origin), "d": list(joint.axis)}, "type": word, word: values}


def _export(file: Path, meshes: Sequence[TrueMesh]) -> None:
    """Writes meshes as one PLY."""
    import trimesh

    if meshes:
        file.parent.mkdir(parents=True, exist_ok=True)
        both = trimesh.util.concatenate([trimesh.Trimesh(mesh.vertices, mesh.faces, process=False) for mesh in meshes])
        both.export(file)


def _save_png(pixels: np.ndarray, file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(file, compress_level=3)


def _write_json(file: Path, record: dict[str, Any]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(record) + "\n")

"""An articulated object to glTF 2.0 binaries: splats and meshes that move."""

import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, UInt16
from trimesh.visual import ColorVisuals, TextureVisuals

from ..files import replace_file
from ..model import ArticulatedObject, Splats
from .sweep import sweep_values

_FRAMES = 48  # keys of the way there and back
_ARRAY, _ELEMENTS = 34962, 34963  # glTF's names for vertices and indices
_TYPES = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125, np.dtype("<u2"): 5123}
_SHAPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4"}
_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # xyzw: the world's z axis becomes glTF's y axis
_EXTENSION = "KHR_gaussian_splatting"


def export_glb(
    obj: ArticulatedObject,
    meshes: Sequence[trimesh.Trimesh],
    folder: Path,
    *,
    scale: float = 1.0,
    seconds: float = 4.0,
) -> list[Path]:
    """Writes `splats.glb` and `meshes.glb`: a node for each part, and an animation of all joints; returns the files.

    The animation goes over the joints' observed range there and back; at rest the parts stand in state 0.  A part's
    node has its origin at its joint's origin and turns or slides there; the root's turns the world's z axis up to
    glTF's y axis.  The splats are those of the extension KHR_gaussian_splatting, in the colours half way between the
    two states; programs that do not know it show coloured points.  Each file is written aside, then into place.

    Args:
        obj: what is written.
        meshes: of the parts in their order, in the world as they stand in state 0, with colours of the vertices.
        folder: made where it is missing.
        scale: metres in a unit of the capture (glTF's unit is the metre).
        seconds: how long the animation takes.

    Raises:
        ValueError: there is not one mesh for each part.
    """
    if len(meshes) != len(obj.parts):
        raise ValueError(f"export_glb: {len(meshes)} meshes for an object of {len(obj.parts)} parts; give one for each part.")
    origins = _origins(obj)
    pieces = obj.parts.place(obj.parts.boxes, 0.0).split(obj.parts.counts)

    splats, surfaces = _Glb(), _Glb()
    shapes = [_add_splats(splats, piece, origin, scale) for piece, origin in zip(pieces, origins, strict=True)]
    _add_nodes(splats, obj, shapes, scale, seconds)
    shapes = [_add_mesh(surfaces, mesh, origin, scale) for mesh, origin in zip(meshes, origins, strict=True)]
    _add_nodes(surfaces, obj, shapes, scale, seconds)
    return [splats.write(folder / "splats.glb"), surfaces.write(folder / "meshes.glb")]


class _Glb:
    """A glTF document in the making, with all its numbers in one buffer."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "structuregs"}}
        self._chunks: list[bytes] = []

    def add(self, key: str, record: dict[str, Any]) -> int:
        """Appends to one of the document's lists; the index in it."""
        rows = self.document.setdefault(key, [])
        rows.append(record)
        return len(rows) - 1

    def accessor(self, values: np.ndarray, *, target: int | None = _ARRAY, bounds: bool = False) -> int:
        """Appends numbers, one row for each vertex or key; whole numbers of colours are fractions of their type's range."""
        kind = _TYPES[values.dtype]
        data = np.ascontiguousarray(values).tobytes()
        view = {"buffer": 0, "byteOffset": sum(map(len, self._chunks)), "byteLength": len(data)}
        record = {"componentType": kind, "count": len(values), "type": _SHAPES[values.shape[1:]]}
        record["bufferView"] = self.add("bufferViews", view if target is None else view | {"target": target})
        if values.dtype.kind == "u" and target == _ARRAY:
            record["normalized"] = True
        if bounds:
            record |= {"min": values.min(0, keepdims=values.ndim == 1).tolist()}
            record |= {"max": values.max(0, keepdims=values.ndim == 1).tolist()}
        self._chunks.append(data + bytes(-len(data) % 4))
        return self.add("accessors", record)

    def write(self, path: Path) -> Path:
        """Writes the file aside, then into place."""
        buffer = b"".join(self._chunks)
        if buffer:
            self.document["buffers"] = [{"byteLength": len(buffer)}]
        text = json.dumps(self.document, separators=(",", ":")).encode("ascii")
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        if buffer:
            chunks += struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
        return replace_file(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _origins(obj: ArticulatedObject) -> list[Float[np.ndarray, " 3"]]:
    """Where each part's node has its origin in state 0, in the world."""
    return [np.zeros(3), *(np.array(joint.origin, dtype=np.float64) for joint in obj.joints)]


def _add_nodes(glb: _Glb, obj: ArticulatedObject, shapes: Sequence[int | None], scale: float, seconds: float) -> None:
    """The root, below it a node for each part with its shape, and the animation.

    Args:
        glb: receives them.
        obj: names the parts and has the joints.
        shapes: the glTF mesh of each part; None for a part of which there is nothing to draw.
        scale: metres in a unit of the capture.
        seconds: how long the animation takes.
    """
    origins = _origins(obj)
    parents = [None, *(joint.parent for joint in obj.joints)]
    nodes: list[dict[str, Any]] = [{"name": name} for name in obj.parts.names]
    for k, (node, shape, parent) in enumerate(zip(nodes, shapes, parents, strict=True)):
        if shape is not None:
            node["mesh"] = shape
        if parent is not None:
            node["translation"] = ((origins[k] - origins[parent]) * scale).tolist()
            nodes[parent].setdefault("children", []).append(1 + k)
    glb.document |= {"scene": 0, "scenes": [{"nodes": [0]}]}
    for node in ({"name": "object", "rotation": _Y_UP, "children": [1]}, *nodes):
        glb.add("nodes", node)
    if obj.joints:
        glb.add("animations", _animation(glb, obj, scale, seconds))


def _animation(glb: _Glb, obj: ArticulatedObject, scale: float, seconds: float) -> dict[str, Any]:
    """All joints over their observed range and back."""
    origins = _origins(obj)
    values = [*sweep_values(obj.joints, _FRAMES), [0.0] * len(obj.joints)]
    times = glb.accessor(np.linspace(0, seconds, len(values), dtype="<f4"), target=None, bounds=True)
    channels, samplers = [], []
    for k, joint in enumerate(obj.joints, start=1):
        motions = [joint.motion(row[k - 1]) for row in values]
        if joint.kind == "revolute":
            path, keys = "rotation", np.stack([_xyzw(T.wxyz.numpy()) for T in motions])
        else:
            path, keys = "translation", np.stack([T.xyz.numpy() for T in motions]) + origins[k] - origins[joint.parent]
            keys = keys * scale
        output = glb.accessor(keys.astype("<f4"), target=None)
        channels.append({"sampler": len(samplers), "target": {"node": 1 + k, "path": path}})
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
    return {"name": "open_and_close", "channels": channels, "samplers": samplers}


def _add_splats(glb: _Glb, splats: Splats, origin: Float[np.ndarray, " 3"], scale: float) -> int | None:
    """A part's splats, given in the world, as a glTF mesh of points; None where there are none."""
    if not len(splats):
        return None
    means = (splats.means.double().numpy(force=True) - origin) * scale
    quats = torch.nn.functional.normalize(splats.quats.double(), dim=-1).numpy(force=True)
    opacities = splats.opacities.numpy(force=True).astype("<f4")
    columns = {
        f"{_EXTENSION}:ROTATION": _xyzw(quats),
        f"{_EXTENSION}:SCALE": splats.scales.numpy(force=True) * scale,
        f"{_EXTENSION}:OPACITY": opacities,
    }
    sh = splats.sh.numpy(force=True)
    for i in range(sh.shape[1]):
        degree = math.isqrt(i)
        columns[f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{i - degree**2}"] = sh[:, i]
    attributes = {"POSITION": glb.accessor(means.astype("<f4"), bounds=True)}
    attributes["COLOR_0"] = glb.accessor(_linear_rgba(splats.base_rgb.numpy(force=True), opacities))
    attributes |= {name: glb.accessor(column.astype("<f4")) for name, column in columns.items()}
    glb.document["extensionsUsed"] = [_EXTENSION]
    settings = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    return glb.add("meshes", {"primitives": [{"attributes": attributes, "mode": 0, "extensions": {_EXTENSION: settings}}]})


def _add_mesh(glb: _Glb, mesh: trimesh.Trimesh, origin: Float[np.ndarray, " 3"], scale: float) -> int | None:
    """A part's surface, given in the world, as a glTF mesh; None where it has no faces."""
    if not len(mesh.faces):
        return None
    visual = mesh.visual.to_color() if isinstance(mesh.visual, TextureVisuals) else mesh.visual
    assert isinstance(visual, ColorVisuals)
    rgba = np.asarray(visual.vertex_colors, dtype=np.uint8)
    attributes = {
        "POSITION": glb.accessor(((mesh.vertices - origin) * scale).astype("<f4"), bounds=True),
        "NORMAL": glb.accessor(_unit(np.asarray(mesh.vertex_normals)).astype("<f4")),
        "COLOR_0": glb.accessor(_linear_rgba(rgba[:, :3] / 255.0, np.ones(len(rgba)))),
    }
    indices = glb.accessor(np.asarray(mesh.faces).astype("<u4").reshape(-1), target=_ELEMENTS)
    if "materials" not in glb.document:
        # Surfaces seen from few sides are open, so they are drawn from behind also.
        surface = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
        glb.add("materials", {"name": "photos", "pbrMetallicRoughness": surface, "doubleSided": True})
    return glb.add("meshes", {"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]})


def _xyzw(wxyz: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    return np.roll(wxyz, -1, -1)


def _unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Vectors of unit length; those of none, which a vertex without a face has, point upwards."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(lengths > 0, vectors / np.where(lengths > 0, lengths, 1), [0.0, 0.0, 1.0])


def _linear_rgba(rgb: Float[np.ndarray, "N 3"], alpha: Float[np.ndarray, " N"]) -> UInt16[np.ndarray, "N 4"]:
    """Colours, given in sRGB, as glTF has them at vertices: linear, in 16 bits so that dark ones stay apart."""
    rgb = np.clip(rgb, 0, 1)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return (np.column_stack([linear, alpha]) * 65535).round().astype("<u2")

"""The articulated object: what a run ends in, and its file format."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from ..files import replace_file, replacing
from ..geometry import SE3, Box
from .joint import Joint
from .parts import PosedParts
from .splats import Splats

FORMAT = "structuregs-object"
VERSION = 1


@dataclass(frozen=True)
class ArticulatedObject:
    """Parts with their splats and boxes, and the joints that move them.

    Attributes:
        parts: posed parts; `parts.motions[k]` equals `joints[k - 1].motion(joints[k - 1].q[1])`.
        joints: one for each part but the base, in the parts' order.
    """

    parts: PosedParts
    joints: tuple[Joint, ...]

    def boxes_at(self, q: list[float]) -> Box:
        """The K boxes in the world with the joints at `q` (radians or units of length, 0 = state 0)."""
        motions = torch.stack([SE3.identity(dtype=torch.float64).wxyz_xyz, *(T.wxyz_xyz for T in self.motions(q))])
        return self.parts.boxes.moved(SE3(motions.to(self.parts.boxes.half_extents)))

    def motions(self, q: list[float]) -> list[SE3]:
        """The rigid motion of each moving part from state 0 to the joint values `q`, in the world (float64)."""
        if len(q) != len(self.joints):
            raise ValueError(f"at(q): {len(q)} joint values for an object with {len(self.joints)} joints; give one per joint.")
        return [joint.motion(value) for joint, value in zip(self.joints, q, strict=True)]

    def at(self, q: list[float]) -> Splats:
        """All splats in the world with the joints at `q` (radians or units of length; 0 = state 0)."""
        progress = [min(max(v / j.q[1], 0.0), 1.0) for v, j in zip(q, self.joints, strict=True) if j.q[1]]
        shade = sum(progress) / len(progress) if progress else 0.5
        return self.parts.place(self.boxes_at(q), shade - 0.5)


def save_object(obj: ArticulatedObject, folder: Path) -> None:
    """Writes `object.json` and `splats.safetensors` into a folder (see docs/format.md); both are renamed into place."""
    parts = obj.parts
    tensors = {name: value.contiguous() for name, value in parts.splats.tensors().items()} | {"tint": parts.tint.contiguous()}
    record = {
        "format": FORMAT,
        "version": VERSION,
        "parts": [
            {
                "name": parts.names[k],
                "splats": parts.counts[k],
                "box": {
                    "wxyz_xyz": parts.boxes.T_world_box.wxyz_xyz[k].tolist(),
                    "half_extents": parts.boxes.half_extents[k].tolist(),
                },
                "motion_wxyz_xyz": parts.motions.wxyz_xyz[k].tolist(),
            }
            for k in range(len(parts))
        ],
        "joints": [asdict(joint) for joint in obj.joints],
    }
    with replacing(folder / "splats.safetensors") as staged:
        save_file(tensors, staged)
    replace_file(folder / "object.json", json.dumps(record, indent=1) + "\n")


def load_object(folder: Path) -> ArticulatedObject:
    """Reads what `save_object` wrote.

    Raises:
        ValueError: a file is missing, damaged or of another version.
    """
    for name in ("object.json", "splats.safetensors"):
        if not (folder / name).is_file():
            raise ValueError(f"{folder}: no object here ({name} is missing); run `structuregs fit` first.")
    try:
        record = json.loads((folder / "object.json").read_text())
        tensors = load_file(folder / "splats.safetensors")
    except (ValueError, SafetensorError) as error:
        raise ValueError(f"{folder}: the object's files are damaged ({error}); fit it again.") from error
    if not isinstance(record, dict) or (record.get("format"), record.get("version")) != (FORMAT, VERSION):
        found = f"{record.get('format')} {record.get('version')}" if isinstance(record, dict) else type(record).__name__
        raise ValueError(f"{folder}/object.json: format {found}, but this version reads {FORMAT} {VERSION}.")
    try:
        return _object(record, tensors)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder}/object.json: the object's files are damaged ({error!r}); fit it again.") from error


def _object(record: dict[str, Any], tensors: dict[str, Tensor]) -> ArticulatedObject:
    """The object of a file's record and tensors; errors are those of reading them."""
    rows = record["parts"]
    poses = SE3(torch.tensor([row["box"]["wxyz_xyz"] for row in rows]))
    boxes = Box(poses, torch.tensor([row["box"]["half_extents"] for row in rows]))
    motions = SE3(torch.tensor([row["motion_wxyz_xyz"] for row in rows]))
    counts = tuple(row["splats"] for row in rows)
    tint = tensors.pop("tint")
    splats = Splats(**tensors)
    if sum(counts) != len(splats) or len(record["joints"]) != len(rows) - 1:
        raise ValueError("its parts, joints and splats do not add up")
    joints = [row | {key: tuple(row[key]) for key in ("axis", "origin", "q")} for row in record["joints"]]
    return ArticulatedObject(PosedParts(boxes, motions, splats, counts, tint), tuple(Joint(**row) for row in joints))

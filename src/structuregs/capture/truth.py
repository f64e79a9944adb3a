"""The ground truth that a capture's folder keeps beside it; only for measuring a result."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ..geometry import SE3, JointKind, Screw
from .capture import Capture
from .errors import CaptureError
from .layouts import STATES, mesh_file, motion_file, read_json, truth_folder

KIND_OF_TYPE: dict[str, JointKind] = {"rotate": "revolute", "translate": "prismatic"}


@dataclass(frozen=True)
class TrueJoint:
    """How a part truly moves, in the world.

    Attributes:
        kind: "revolute" or "prismatic".
        axis: unit vector.
        origin: a point of the axis.
        q0, q1: the joint's value in state 0 and in state 1, radians or the capture's unit; `q1 - q0` may be negative.
    """

    kind: JointKind
    axis: tuple[float, float, float]
    origin: tuple[float, float, float]
    q0: float
    q1: float

    def motion(self) -> SE3:
        """The part's rigid motion of the world from state 0 to state 1 (float64)."""
        axis, origin = (torch.tensor(v, dtype=torch.float64) for v in (self.axis, self.origin))
        return Screw(self.kind, axis, origin).motion(self.q1 - self.q0)


@dataclass(frozen=True)
class Truth:
    """True joints and surfaces.

    Attributes:
        joints: of the moving parts, in the order of their meshes.
        meshes: mesh files (world frame) by state (0, 1) and part (0 = what does not move, k = the part of `joints[k - 1]`);
            only files that are there.
    """

    joints: tuple[TrueJoint, ...]
    meshes: dict[tuple[int, int], Path]


def find_truth(capture: Capture) -> Path | None:
    """The folder of the ground truth beside a capture, to give to `load_truth`; None where there is none."""
    if capture.layout == "memory":
        return None
    folder = truth_folder(capture.root, "paris" if capture.layout == "paris" else "artgs")
    return folder if folder is not None and motion_file(folder).is_file() else None


def load_truth(path: Path | str) -> Truth:
    """Joints and mesh paths of a ground truth folder of the PARIS or the ArtGS layout.

    Raises:
        CaptureError: the joints' file is missing or damaged.
    """
    folder = Path(path)
    file = motion_file(folder)
    info = read_json(file)
    try:
        rows = info["trans_info"]
        joints = tuple(_read_joint(row) for row in (rows if isinstance(rows, list) else [rows]))
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError(f"{file}: not a record of joints ({error!r}); it needs axis, type, l and r.") from error
    paths = {
        (state, part): _mesh(folder, state, part, len(joints))
        for state in range(len(STATES))
        for part in range(len(joints) + 1)
    }
    return Truth(joints, {key: mesh for key, mesh in paths.items() if mesh.is_file()})


def _mesh(folder: Path, state: int, part: int, moving: int) -> Path:
    """A part's mesh; a single moving part may carry a number or none."""
    numbered = mesh_file(folder, state, part, numbered=True)
    return numbered if moving > 1 or numbered.is_file() else mesh_file(folder, state, part, numbered=False)


def _read_joint(row: dict[str, Any]) -> TrueJoint:
    kind = KIND_OF_TYPE[row["type"]]
    axis = torch.tensor(row["axis"]["d"], dtype=torch.float64)
    x, y, z = (axis / axis.norm()).tolist()
    a, b, c = (float(v) for v in row["axis"]["o"])
    limits = row[row["type"]]
    unit = math.radians(1) if kind == "revolute" else 1.0
    return TrueJoint(kind, (x, y, z), (a, b, c), float(limits["l"]) * unit, float(limits["r"]) * unit)

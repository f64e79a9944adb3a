"""An articulated object to the PLY files of 3D Gaussian splatting."""

from pathlib import Path

import numpy as np
import torch

from ..files import replace_file
from ..model import ArticulatedObject, Splats


def export_ply(obj: ArticulatedObject, folder: Path) -> list[Path]:
    """Writes each part in state 0 and the whole object in each state, all in the world's frame; returns the files.

    The files are `base.ply`, `part_1.ply`, ..., `state_0.ply` and `state_1.ply`: binary, float32, with the properties of
    Kerbl et al. 2023 and no other, because readers refuse more.  Each is written aside, then into place.

    Args:
        obj: what is written, in the capture's unit.
        folder: made where it is missing.
    """
    states = [obj.parts.at_state(state) for state in (0, 1)]
    sets = dict(zip(obj.parts.names, states[0].split(obj.parts.counts), strict=True))
    sets |= {f"state_{state}": splats for state, splats in enumerate(states)}
    return [_write(splats, folder / f"{name}.ply") for name, splats in sets.items()]


def _write(splats: Splats, path: Path) -> Path:
    columns = _columns(splats)
    table = np.stack(list(columns.values()), 1).astype("<f4")
    properties = "".join(f"property float {name}\n" for name in columns)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(splats)}\n{properties}end_header\n"
    return replace_file(path, header.encode("ascii") + table.tobytes())


def _columns(splats: Splats) -> dict[str, np.ndarray]:
    """The properties in the order in which readers expect them."""
    sh = splats.sh.numpy(force=True)
    # Channel by channel: all red coefficients above band 0, then the green ones, then the blue ones.
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * (sh.shape[1] - 1))
    groups = {
        ("x", "y", "z"): splats.means.numpy(force=True),
        ("nx", "ny", "nz"): np.zeros((len(splats), 3)),
        tuple(f"f_dc_{i}" for i in range(3)): sh[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): splats.logit_opacities.numpy(force=True)[:, None],
        tuple(f"scale_{i}" for i in range(3)): splats.log_scales.numpy(force=True),
        tuple(f"rot_{i}" for i in range(4)): torch.nn.functional.normalize(splats.quats, dim=-1).numpy(force=True),
    }
    return {name: values[:, i] for names, values in groups.items() for i, name in enumerate(names)}

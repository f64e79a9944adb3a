import csv
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from door_and_drawer import DOOR, DRAWER, made_of
from structuregs.export.ply import export_ply
from structuregs.geometry import SE3, Camera
from structuregs.model import ArticulatedObject, Splats
from structuregs.raster import render

WEB = Path(__file__).parent / "web"
NAMES = ["base.ply", "part_1.ply", "part_2.ply", "state_0.ply", "state_1.ply"]


def with_harmonics(degree: int) -> ArticulatedObject:
    """A door and a drawer whose splats have harmonics of a degree and a tint."""
    obj, g = made_of(DOOR.motion(), DRAWER.motion()), torch.Generator().manual_seed(1)
    splats = obj.parts.splats
    sh = torch.cat([splats.sh, 0.2 * torch.randn(len(splats), (degree + 1) ** 2 - 1, 3, generator=g)], 1)
    scales = torch.randn(len(splats), 3, generator=g) * 0.3 - 3
    tint = 0.1 * torch.randn(len(splats), 3, generator=g)
    parts = replace(obj.parts, splats=replace(splats, sh=sh, log_scales=scales), tint=tint)
    return replace(obj, parts=parts)


def read(path: Path) -> tuple[list[str], np.ndarray]:
    """The names of a binary PLY's float properties, and its rows."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    element, vertex, count = lines[2].split()
    assert (element, vertex) == ("element", "vertex")
    assert all(line.startswith("property float ") for line in lines[3:])
    names = [line.split()[2] for line in lines[3:]]
    return names, np.frombuffer(body, "<f4").reshape(int(count), len(names))


def splats_of(path: Path) -> Splats:
    """A PLY's splats, put together by the names of its properties."""
    names, rows = read(path)
    column = {name: torch.from_numpy(rows[:, i].copy()) for i, name in enumerate(names)}

    def stacked(prefix: str, count: int) -> torch.Tensor:
        return torch.stack([column[f"{prefix}_{i}"] for i in range(count)], 1)

    above = sum(name.startswith("f_rest_") for name in names) // 3
    channels = [torch.stack([column[f"f_rest_{c * above + i}"] for c in range(3)], 1) for i in range(above)]
    return Splats(
        torch.stack([column[name] for name in "xyz"], 1),
        stacked("rot", 4),
        stacked("scale", 3),
        column["opacity"],
        torch.stack([stacked("f_dc", 3), *channels], 1),
    )


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_properties_are_those_of_3dgs_files_in_their_order(tmp_path, degree):
    export_ply(with_harmonics(degree), tmp_path)
    names, rows = read(tmp_path / "state_1.ply")
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    head = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    tail = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names == head + rest + tail
    assert not rows[:, 3:6].any()


@pytest.mark.parametrize("degree", [0, 2])
def test_what_is_read_back_is_the_object_in_each_state_and_its_parts(tmp_path, degree):
    obj = with_harmonics(degree)
    files = export_ply(obj, tmp_path / "new")
    assert [file.name for file in files] == NAMES
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == NAMES
    for state in (0, 1):
        expected, found = obj.parts.at_state(state), splats_of(files[3 + state])
        for name in ("means", "log_scales", "logit_opacities", "sh"):
            assert torch.equal(getattr(found, name), getattr(expected, name)), name
        assert torch.allclose(found.quats, torch.nn.functional.normalize(expected.quats, dim=-1))
    whole = np.concatenate([read(file)[1] for file in files[:3]])
    assert np.array_equal(whole, read(files[3])[1])


def test_a_state_read_back_looks_like_the_object(tmp_path):
    """Harmonics in the wrong order of channels or coefficients would show in another colour."""
    obj = with_harmonics(3)
    export_ply(obj, tmp_path)
    pose = SE3.from_quat(torch.tensor([0.7, 0.7, 0.1, 0.0]), torch.tensor([0.2, 4.0, -0.4]))
    camera = Camera(pose, 60.0, 60.0, 24.0, 20.0, 48, 40)
    expected = render(obj.at([joint.q[1] for joint in obj.joints]), camera).rgb
    assert float((expected - 1).abs().max()) > 0.3
    assert torch.allclose(render(splats_of(tmp_path / "state_1.ply"), camera).rgb, expected, atol=1e-4)


def test_the_same_object_gives_the_same_bytes(tmp_path):
    pairs = zip(*(export_ply(with_harmonics(1), tmp_path / name) for name in "ab"), strict=True)
    assert all(a.read_bytes() == b.read_bytes() for a, b in pairs)


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_the_same_values(tmp_path, degree):
    """PlayCanvas' own reader, as in SuperSplat."""
    program = WEB / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
    node = shutil.which("node")
    if node is None or not program.exists():
        pytest.skip("needs node and `npm ci --ignore-scripts --prefix tests/web`")
    export_ply(with_harmonics(degree), tmp_path)
    for name in NAMES:
        names, rows = read(tmp_path / name)
        table = tmp_path / "table.csv"
        subprocess.run([node, program, "--quiet", "--overwrite", tmp_path / name, table], check=True, capture_output=True)
        with table.open() as lines:
            found = list(csv.DictReader(lines))
        assert len(found) == len(rows)
        assert set(found[0]) == set(names), json.dumps(list(found[0]))
        values = np.array([[float(row[key]) for key in names] for row in found])
        assert np.allclose(values, rows, rtol=1e-6, atol=1e-7)

import json
import math
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp

from door_and_drawer import DOOR, DRAWER, made_of
from structuregs.export.glb import export_glb
from structuregs.geometry import SE3, Camera
from structuregs.model import SH_C0, ArticulatedObject
from structuregs.raster import render

WEB = Path(__file__).parent / "web"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # glTF's coordinates of the world's


def articulated(degree: int = 0) -> ArticulatedObject:
    """A door that turns by 170 degrees and a drawer, with harmonics and scales of their own."""
    obj, g = made_of(replace(DOOR, q1=DOOR.q0 + math.radians(170)).motion(), DRAWER.motion()), torch.Generator().manual_seed(1)
    splats = obj.parts.splats
    sh = torch.cat([splats.sh, 0.2 * torch.randn(len(splats), (degree + 1) ** 2 - 1, 3, generator=g)], 1)
    scales = torch.randn(len(splats), 3, generator=g) * 0.3 - 3
    return replace(obj, parts=replace(obj.parts, splats=replace(splats, sh=sh, log_scales=scales)))


def meshes_of(obj: ArticulatedObject) -> list[trimesh.Trimesh]:
    """A coloured sphere in the box of each part, in the world in state 0."""
    meshes = []
    for k in range(len(obj.parts)):
        mesh = trimesh.creation.icosphere(subdivisions=1)
        mesh.vertices = obj.parts.boxes[k].to_world(torch.tensor(mesh.vertices).float()).double().numpy()
        colours = np.random.default_rng(k).integers(0, 256, (len(mesh.vertices), 4), dtype=np.uint8)
        mesh.visual.vertex_colors = colours
        meshes.append(mesh)
    return meshes


class Reader:
    """A GLB's document, its numbers, and where its nodes stand: written from the glTF 2.0 specification."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        magic, version, length, size = struct.unpack("<4sIII", data[:16])
        assert (magic, version, length, data[16:20]) == (b"glTF", 2, len(data), b"JSON")
        assert size % 4 == 0
        self.document: dict[str, Any] = json.loads(data[20 : 20 + size])
        binary, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
        assert kind == b"BIN\0"
        self._buffer = data[28 + size :]
        assert len(self._buffer) == binary == self.document["buffers"][0]["byteLength"]
        self.nodes = {node["name"]: i for i, node in enumerate(self.document["nodes"])}

    def numbers(self, index: int) -> np.ndarray:
        accessor = self.document["accessors"][index]
        view = self.document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        kind = np.dtype({5126: "<f4", 5125: "<u4", 5123: "<u2"}[accessor["componentType"]])
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteLength"] == accessor["count"] * width * kind.itemsize
        rows = np.frombuffer(self._buffer, kind, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        if "min" in accessor:
            assert (rows.min(0).tolist(), rows.max(0).tolist()) == (accessor["min"], accessor["max"])
        return rows / np.iinfo(kind).max if accessor.get("normalized") else rows

    def attributes(self, name: str) -> dict[str, np.ndarray]:
        """The vertices' numbers of a part."""
        (primitive,) = self.document["meshes"][self.document["nodes"][self.nodes[name]]["mesh"]]["primitives"]
        return {key: self.numbers(index) for key, index in primitive["attributes"].items()}

    def pose(self, name: str, time: float | None = None) -> np.ndarray:
        """The 4x4 matrix of a node in glTF's world; without a time, at rest."""
        index = self.nodes[name]
        values = {key: self.document["nodes"][index].get(key) for key in ("rotation", "translation")}
        for animation in self.document["animations"] if time is not None else []:
            for channel in animation["channels"]:
                if channel["target"]["node"] == index:
                    sampler = animation["samplers"][channel["sampler"]]
                    assert sampler["interpolation"] == "LINEAR"
                    keys, rows = self.numbers(sampler["input"])[:, 0], self.numbers(sampler["output"])
                    values[channel["target"]["path"]] = _interpolate(channel["target"]["path"], keys, rows, time)
        matrix = np.eye(4)
        if values["rotation"] is not None:
            matrix[:3, :3] = Rotation.from_quat(values["rotation"]).as_matrix()
        if values["translation"] is not None:
            matrix[:3, 3] = values["translation"]
        parents = [other["name"] for other in self.document["nodes"] if index in other.get("children", [])]
        return self.pose(parents[0], time) @ matrix if parents else matrix


def _interpolate(path: str, keys: np.ndarray, rows: np.ndarray, time: float) -> np.ndarray:
    if path == "rotation":
        assert ((rows[1:] * rows[:-1]).sum(1) > math.cos(math.radians(45))).all()  # never the long way round
        return Slerp(keys, Rotation.from_quat(rows))(time).as_quat()
    return np.array([np.interp(time, keys, column) for column in rows.T])


@pytest.fixture(scope="module")
def obj() -> ArticulatedObject:
    return articulated(2)


@pytest.fixture(scope="module")
def files(obj, tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("glb") / "new"
    splats, meshes = export_glb(obj, meshes_of(obj), folder)
    assert sorted(path.name for path in folder.iterdir()) == ["meshes.glb", "splats.glb"]
    return splats, meshes


def moments(obj: ArticulatedObject) -> list[tuple[float, list[float]]]:
    """Times of the animation, of 4 seconds, and the joints' values then."""
    progress = [(0.0, 0.0), (1.0, 0.5), (2.0, 1.0), (3.0, 0.5), (4.0, 0.0), (1.5, (1 - math.cos(0.75 * math.pi)) / 2)]
    return [(time, [p * joint.q[1] for joint in obj.joints]) for time, p in progress]


def test_posed_splats_stand_where_the_object_has_them(obj, files):
    """Centres and orientations, through the nodes' matrices at moments of the animation, against `obj.at`."""
    reader = Reader(files[0])
    rows = torch.arange(len(obj.parts.splats)).split(obj.parts.counts)
    for time, q in moments(obj):
        placed = obj.at(q)
        for name, row in zip(obj.parts.names, rows, strict=True):
            pose, columns = reader.pose(name, time), reader.attributes(name)
            means = columns["POSITION"] @ pose[:3, :3].T + pose[:3, 3]
            assert np.allclose(means, placed[row].means.numpy() @ Y_UP.T, atol=2e-6)
            turned = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_quat(columns["KHR_gaussian_splatting:ROTATION"])
            expected = Rotation.from_matrix(Y_UP) * Rotation.from_quat(np.roll(placed[row].quats.numpy(), -1, 1))
            assert (turned.inv() * expected).magnitude().max() < 1e-5


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_splats_have_the_extensions_attributes_in_its_units(tmp_path, degree):
    obj = articulated(degree)
    reader = Reader(export_glb(obj, meshes_of(obj), tmp_path)[0])
    assert reader.document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    world = obj.parts.place(obj.parts.boxes, 0.0)[sum(obj.parts.counts[:2]) :]
    columns = reader.attributes("part_2")
    prefix = "KHR_gaussian_splatting:"
    assert np.allclose(np.linalg.norm(columns[prefix + "ROTATION"], axis=1), 1, atol=1e-6)
    assert np.allclose(columns[prefix + "SCALE"], np.exp(world.log_scales.numpy()))
    assert np.allclose(columns[prefix + "OPACITY"][:, 0], 1 / (1 + np.exp(-world.logit_opacities.numpy())))
    names = [f"{prefix}SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]
    assert {name for name in columns if "SH_" in name} == set(names)
    assert np.allclose(np.stack([columns[name] for name in names], 1), world.sh.numpy())
    for mesh in reader.document["meshes"]:
        (primitive,) = mesh["primitives"]
        assert primitive["mode"] == 0
        extension = primitive["extensions"]["KHR_gaussian_splatting"]
        assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    # Points for programs without the extension: glTF's colours are linear.
    shown = np.clip(columns["COLOR_0"], 0, None)
    srgb = np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
    assert np.allclose(srgb[:, :3], np.clip(0.5 + SH_C0 * world.sh[:, 0].numpy(), 0, 1), atol=1e-3)


def test_meshes_have_their_surface_colours_and_motion(obj, files):
    reader = Reader(files[1])
    for k, (name, mesh) in enumerate(zip(obj.parts.names, meshes_of(obj), strict=True)):
        columns = reader.attributes(name)
        (primitive,) = reader.document["meshes"][reader.document["nodes"][reader.nodes[name]]["mesh"]]["primitives"]
        assert np.array_equal(reader.numbers(primitive["indices"]).reshape(-1, 3), mesh.faces)
        for time, q in moments(obj):
            pose, moved = reader.pose(name, time), mesh.vertices
            if k:
                moved = obj.motions(q)[k - 1].apply(torch.tensor(moved)).numpy()
            assert np.allclose(columns["POSITION"] @ pose[:3, :3].T + pose[:3, 3], moved @ Y_UP.T, atol=2e-6)
        assert np.allclose(columns["NORMAL"], mesh.vertex_normals, atol=1e-6)
        linear = columns["COLOR_0"][:, :3]
        srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        assert np.array_equal((srgb * 255).round(), np.asarray(mesh.visual.vertex_colors)[:, :3])
        assert (columns["COLOR_0"][:, 3] == 1).all()


def test_nodes_turn_at_their_pivots_and_rest_in_state_0(obj, files):
    for file in files:
        reader = Reader(file)
        for name, joint in zip(obj.parts.names[1:], obj.joints, strict=True):
            rest = reader.pose(name)
            assert np.allclose(rest[:3, 3], Y_UP @ joint.origin)
            assert np.allclose(rest[:3, :3], Y_UP)
        pivots = [reader.pose("part_1", time)[:3, 3] for time in (0.0, 0.7, 2.0)]
        assert np.allclose(pivots, pivots[0])


def test_a_part_on_a_part_moves_with_it(obj, tmp_path):
    """Only the nodes: the drawer's node hangs below the door's, and at rest both stand where they did."""
    chain = replace(obj, joints=(obj.joints[0], replace(obj.joints[1], parent=1)))
    reader = Reader(export_glb(chain, meshes_of(chain), tmp_path)[0])
    door, drawer = reader.pose("part_1", 1.2), reader.pose("part_2", 1.2)
    assert np.allclose(reader.pose("part_2")[:3, 3], Y_UP @ obj.joints[1].origin)
    assert np.allclose(drawer[:3, :3], door[:3, :3])


def test_lengths_are_scaled_and_nothing_else(obj, files, tmp_path):
    for plain, scaled in zip(files, export_glb(obj, meshes_of(obj), tmp_path, scale=0.25), strict=True):
        a, b = Reader(plain), Reader(scaled)
        for name in obj.parts.names:
            before, after = a.pose(name, 1.1), b.pose(name, 1.1)
            assert np.allclose(after[:3, :3], before[:3, :3])
            assert np.allclose(after[:3, 3], 0.25 * before[:3, 3], atol=1e-7)
            for key, values in a.attributes(name).items():
                factor = 0.25 if key.endswith(("POSITION", ":SCALE")) else 1
                assert np.allclose(b.attributes(name)[key], factor * values, atol=1e-6), key


def test_the_same_object_gives_the_same_bytes(obj, files, tmp_path):
    again = export_glb(articulated(2), meshes_of(obj), tmp_path)
    assert [a.read_bytes() for a in files] == [b.read_bytes() for b in again]


def test_an_object_without_joints_and_a_part_without_faces_are_written(tmp_path):
    still = made_of()
    splats, meshes = export_glb(still, [trimesh.Trimesh()], tmp_path)
    assert "animations" not in Reader(splats).document
    data = meshes.read_bytes()
    document = json.loads(data[20:])
    assert document["nodes"][1] == {"name": "base"}
    assert "buffers" not in document


def test_a_mesh_for_each_part_is_asked_for(obj, tmp_path):
    with pytest.raises(ValueError, match="2 meshes for an object of 3 parts; give one for each part"):
        export_glb(obj, meshes_of(obj)[:2], tmp_path / "none")
    assert not (tmp_path / "none").exists()


def node(script: str, *arguments: object) -> str:
    """What a script of tests/web prints."""
    program = shutil.which("node")
    if program is None or not (WEB / "node_modules").is_dir():
        pytest.skip("needs node and `npm ci --ignore-scripts --prefix tests/web`")
    result = subprocess.run([program, WEB / script, *map(str, arguments)], capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_the_validator_of_khronos_finds_nothing_in_the_meshes_and_only_the_new_attributes_in_the_splats(files):
    assert json.loads(node("validate.mjs", files[1])) == []
    issues = json.loads(node("validate.mjs", files[0]))
    unknown = {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert all(issue["code"] in unknown for issue in issues), issues


@pytest.mark.parametrize("which", [0, 1], ids=["splats", "meshes"])
def test_babylon_loads_and_plays_it(obj, files, which):
    times = [time for time, _ in moments(obj)]
    found = json.loads(node("babylon.mjs", files[which], *(time / 4 for time in times)).splitlines()[-1])
    assert found["animations"] == [{"name": "open_and_close", "targets": 2}]
    shapes = {shape["name"]: shape for shape in found["shapes"]}
    for name, count in zip(obj.parts.names, obj.parts.counts, strict=True):
        kind, vertices = [("GaussianSplattingMesh", count), ("Mesh", 42)][which]
        assert (shapes[name]["kind"], shapes[name]["vertices"]) == (kind, vertices)
    for matrices, (_, q) in zip(found["moments"], moments(obj), strict=True):
        for name, joint, motion in zip(obj.parts.names[1:], obj.joints, obj.motions(q), strict=True):
            link = motion @ SE3.from_rotation(torch.eye(3).double(), joint.screw.origin)
            expected = np.eye(4)
            expected[:3] = Y_UP @ link.as_matrix().numpy()[:3]
            # Babylon's matrices multiply row vectors from the right.
            assert np.allclose(np.reshape(matrices[name], (4, 4)).T, expected, atol=1e-6)


def test_babylon_draws_the_splats_as_we_do(obj, files, tmp_path):
    """With the door and the drawer half open, in headless Chromium, through the nodes and harmonics of the file."""
    if CHROMIUM is None:
        pytest.skip("needs chromium")
    eye, width, height, fov = np.array([1.5, -3.0, 1.2]), 240, 200, math.radians(40)
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    R = torch.tensor(np.stack([right, np.cross(forward, right), forward], 1)).float()
    focal = height / 2 / math.tan(fov / 2)
    camera = Camera(SE3.from_rotation(R, torch.tensor(eye).float()), focal, focal, width / 2, height / 2, width, height)
    wish = {"fraction": 0.25, "width": width, "height": height, "fov": fov, "eye": (Y_UP @ eye).tolist(), "target": [0, 0, 0]}
    node("picture.mjs", CHROMIUM, files[0], tmp_path / "drawn.png", json.dumps(wish))
    with Image.open(tmp_path / "drawn.png") as image:
        drawn = np.asarray(image.convert("RGB")) / 255

    def difference(progress: float) -> float:
        meant = render(obj.at([progress * joint.q[1] for joint in obj.joints]), camera).rgb.clamp(0, 1).numpy()
        return float(np.sqrt(((meant - drawn) ** 2).mean()))

    assert difference(0.5) < 0.06
    assert difference(0.5) < 0.5 * min(difference(0.4), difference(0.6))

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from structuregs.capture import Capture, View
from structuregs.export.mesh import export_meshes, part_meshes, without_specks
from structuregs.export.texture import textured
from structuregs.export.tsdf import Volume
from structuregs.geometry import SE3, Box, Camera
from structuregs.joints import articulate
from structuregs.model import SH_C0, PosedParts, Splats
from structuregs.raster import render, render_surface

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)


def camera_at(azimuth: float, height: float = 0.8, distance: float = 4.0, size: int = 96) -> Camera:
    """A camera that looks at the origin, z up."""
    position = np.array([distance * math.cos(azimuth), distance * math.sin(azimuth), height])
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], 1)
    pose = SE3.from_rotation(torch.from_numpy(R), torch.from_numpy(position)).to(dtype=torch.float32)
    return Camera(pose, 1.6 * size, 1.6 * size, size / 2, size / 2, size, size)


def sheet(n: int, colour: tuple[float, float, float], flatness: float = 0.002) -> Splats:
    """Opaque discs that tile [-1, 1]^2 in the plane z = 0 without a gap."""
    u = (torch.arange(n) + 0.5) * 2 / n - 1
    means = torch.stack([*torch.meshgrid(u, u, indexing="ij"), torch.zeros(n, n)], -1).reshape(-1, 3)
    log_scales = torch.tensor([1.2 / n, 1.2 / n, flatness]).log().expand(n * n, 3)
    sh = ((torch.tensor(colour) - 0.5) / SH_C0).expand(n * n, 1, 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(n * n, 4)
    return Splats(means, quats, log_scales.contiguous(), torch.full((n * n,), 6.0), sh.contiguous())


def cube_splats(half: float, colour: tuple[float, float, float], n: int = 24) -> Splats:
    """The six faces of a cube about the origin."""
    face = sheet(n, colour)
    face = Splats(**(face.tensors() | {"means": face.means * half, "log_scales": face.log_scales + math.log(half)}))
    turns = [(0, 0, 0), (math.pi, 0, 0), (math.pi / 2, 0, 0), (-math.pi / 2, 0, 0), (0, math.pi / 2, 0), (0, -math.pi / 2, 0)]
    lift = SE3.from_quat(torch.tensor([1.0, 0, 0, 0]), torch.tensor([0, 0, half]))
    return Splats.concatenate(face.moved(SE3.exp(torch.tensor([0.0, 0, 0, *turn])) @ lift) for turn in turns)


def two_cubes() -> tuple[PosedParts, Capture]:
    """A red cube of half size .4, and a blue one of .2 that touches nothing and slides by .5 along y."""
    halves, centres = (0.4, 0.2), ((-0.5, 0.0, 0.0), (0.4, -0.2, 0.0))
    splats = [cube_splats(half, colour) for half, colour in zip(halves, (RED, BLUE), strict=True)]
    boxes = Box(
        SE3(torch.tensor([[1.0, 0, 0, 0, *centre] for centre in centres])),
        torch.tensor([[half] * 3 for half in halves]),
    )
    motions = SE3(torch.tensor([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0.5, 0]]))
    canonical = [Splats(**(s.tensors() | {"means": s.means / half})) for s, half in zip(splats, halves, strict=True)]
    together = Splats.concatenate(canonical)
    counts = (len(canonical[0]), len(canonical[1]))
    parts = PosedParts(boxes, motions, together, counts, torch.zeros(len(together), 3))
    rows = []
    for state in (0, 1):
        placed, views = parts.at_state(state), []
        for i in range(16):
            camera = camera_at(i * 2.4, height=-2.5 + i / 3, size=240)
            alpha = (render(placed, camera).alpha > 0.5).byte()[..., None] * 255
            views.append(View(f"{i:04d}", camera, torch.cat([alpha, alpha, alpha, alpha], -1).numpy()))
        rows.append(tuple(views))
    return parts, Capture("cubes", Path("cubes"), (rows[0], rows[1]), ((), ()), "memory")


def test_the_surface_of_a_slanted_sheet_is_its_plane():
    camera = camera_at(0.3, height=2.5, size=160)
    surface = render_surface(sheet(20, RED, flatness=1e-4), camera)
    origin, rays = camera.rays()
    depth = -origin[2] / rays[..., 2]
    hit = origin + rays * depth[..., None]
    inside = (hit[..., :2].abs().amax(-1) < 0.9).numpy()
    assert inside.sum() > 2000
    assert np.abs(surface.depth - depth.numpy())[inside].max() < 0.02
    assert np.abs(surface.rgb[inside] - RED).max() < 0.01


def test_a_faint_veil_before_a_wall_does_not_move_the_surface():
    wall = sheet(20, RED)
    veil = Splats(**(sheet(20, BLUE).tensors() | {"logit_opacities": torch.full((400,), -3.0)}))
    camera = Camera(SE3.from_quat(torch.tensor([1.0, 0, 0, 0]), torch.tensor([0.0, 0, -3])), 80.0, 80.0, 16.0, 16.0, 32, 32)
    before = SE3.from_quat(torch.tensor([1.0, 0, 0, 0]), torch.tensor([0.0, 0, -0.5]))
    both = Splats.concatenate([wall, veil.moved(before)])
    surface = render_surface(both, camera)
    assert np.abs(surface.depth - 3).max() < 0.01
    assert render(both, camera).depth.max() < 2.98


def test_most_of_the_light_must_be_gone():
    faint = Splats(**(sheet(4, RED).tensors() | {"logit_opacities": torch.full((16,), -3.0)}))
    assert not render_surface(faint, camera_at(0.0)).depth.any()


def test_fused_depth_of_a_ball_is_the_ball():
    """Depth in closed form; the surface lies within a fraction of a voxel, with normals to the outside."""
    radius, voxel = 0.5, 0.05
    volume = Volume(np.full(3, -0.8), voxel, 3 * voxel, (33, 33, 33))
    projections, depths, empties = [], [], []
    for i in range(24):
        camera = camera_at(i * 2.4, height=-3 + i / 4, size=160)
        origin, rays = (t.double() for t in camera.rays())
        a, b, c = rays.square().sum(-1), 2 * (rays * origin).sum(-1), origin.square().sum() - radius**2
        root = b * b - 4 * a * c
        depth = torch.where(root > 0, (-b - root.clamp(min=0).sqrt()) / (2 * a), torch.zeros_like(root))
        pose = camera.T_world_camera.to(dtype=torch.float64).inverse()
        projections.append((camera.K.double() @ pose.as_matrix()[:3]).numpy())
        depths.append(depth.float().numpy())
        empties.append(np.where(depths[-1] > 0, 0, np.inf).astype(np.float32))
    green = np.broadcast_to(np.float32([0, 1, 0]), (*np.stack(depths).shape, 3)).copy()
    volume.fuse(np.stack(projections), np.stack(depths), np.stack(empties), green)
    vertices, faces, rgb = volume.surface()
    ball = trimesh.Trimesh(vertices, faces, process=False)
    assert np.abs(np.linalg.norm(vertices, axis=1) - radius).max() < voxel / 2
    assert ball.volume == pytest.approx(4 / 3 * math.pi * radius**3, rel=0.05)
    assert np.allclose(rgb, [0, 1, 0])


def test_a_grid_that_saw_nothing_has_no_surface():
    vertices, faces, _ = Volume(np.zeros(3), 0.1, 0.3, (5, 5, 5)).surface()
    assert len(vertices) == len(faces) == 0


def seen_from_above(half: tuple[float, float, float], height: float, voxel: float) -> Volume:
    """A grid, two samples larger than [-.5, .5]^3 on each side, in which 12 cameras above saw a box at a height."""
    n = round(1 / voxel) + 5
    volume = Volume(np.full(3, -0.5 - 2 * voxel), voxel, 3 * voxel, (n, n, n))
    box = Box(SE3.from_quat(torch.tensor([1.0, 0, 0, 0]), torch.tensor([0, 0, height])), torch.tensor(half))
    for i in range(12):
        camera = camera_at(i * 2.4, height=1.2 + i / 4, size=120)
        enter, leave = box.intersect(*camera.rays())
        depth = torch.where(enter < leave, enter, torch.zeros_like(enter)).numpy()[None]
        empty = np.where(depth > 0, 0, np.inf).astype(np.float32)
        pose = camera.T_world_camera.to(dtype=torch.float64).inverse()
        projection = (camera.K.double() @ pose.as_matrix()[:3]).numpy()
        volume.fuse(projection[None], depth, empty, np.full((*depth.shape, 3), 0.5, np.float32))
    return volume


def underside(volume: Volume, rim: int) -> float:
    """Area of the surface at the bottom of the grid's inner part, about its middle."""
    mesh = trimesh.Trimesh(*volume.surface(outside=2, rim=rim)[:2], process=False)
    x, y, z = np.abs(mesh.triangles_center - [0, 0, -0.5]).T
    return float(mesh.area_faces[(x < 0.25) & (y < 0.25) & (z < volume.voxel)].sum())


def test_what_stands_on_the_ground_has_an_underside():
    """A block as large as the grid's inner part, seen from above only: open without a rim, closed with one."""
    volume = seen_from_above((0.5, 0.5, 0.5), 0.0, 0.05)
    assert underside(volume, rim=0) == 0
    assert underside(volume, rim=4) == pytest.approx(0.25, abs=0.03)
    vertices, faces, rgb = volume.surface(outside=2, rim=4)
    assert trimesh.Trimesh(vertices, faces, process=False).volume == pytest.approx(1.0, rel=0.1)
    assert np.allclose(rgb, 0.5, atol=1e-6), "what no image saw has its neighbour's colour"


def test_what_another_thing_hides_is_not_closed():
    """The same block, after more images in which something else stands before all of it."""
    volume = seen_from_above((0.5, 0.5, 0.5), 0.0, 0.05)
    camera = camera_at(0.0)
    pose = camera.T_world_camera.to(dtype=torch.float64).inverse()
    projections = np.repeat((camera.K.double() @ pose.as_matrix()[:3]).numpy()[None], 20, 0)
    screen = np.full((20, 96, 96), 2.0, np.float32)
    volume.fuse(projections, np.zeros_like(screen), screen, np.full((20, 96, 96, 3), 0.5, np.float32))
    assert underside(volume, rim=4) == 0


def test_no_floor_is_made_up_in_the_air():
    """Under a table top, away from the sides, sight ends in the air; there is no surface."""
    voxel = 0.05
    vertices, faces, _ = seen_from_above((0.5, 0.5, 0.05), 0.3, voxel).surface(outside=2, rim=3)
    middle = np.abs(vertices[faces].mean(1)[:, :2]).max(1) < 0.25
    assert middle.any()
    assert vertices[faces].mean(1)[middle, 2].min() > 0.25 - voxel


def test_each_part_has_its_own_surface_in_state_0():
    parts, capture = two_cubes()
    meshes = part_meshes(articulate(parts), capture, voxel=0.02)
    for mesh, half, centre, colour in zip(meshes, (0.4, 0.2), ((-0.5, 0, 0), (0.4, -0.2, 0)), (RED, BLUE), strict=True):
        true = trimesh.creation.box([2 * half] * 3, trimesh.transformations.translation_matrix(centre))
        assert np.abs(mesh.bounds - true.bounds).max() < 0.04
        assert mesh.volume == pytest.approx(true.volume, rel=0.12)
        inside = np.abs(np.asarray(mesh.vertices) - centre).max(1)
        assert np.quantile(np.abs(inside - half), 0.95) < 0.025
        rgba = np.asarray(mesh.visual.vertex_colors)
        assert np.abs(np.median(rgba[:, :3], 0) / 255 - colour).max() < 0.05


def test_the_same_object_gives_the_same_meshes():
    parts, capture = two_cubes()
    once, twice = (part_meshes(articulate(parts), capture, voxel=0.04) for _ in range(2))
    for a, b in zip(once, twice, strict=True):
        assert np.array_equal(a.vertices, b.vertices)
        assert np.array_equal(a.visual.vertex_colors, b.visual.vertex_colors)


def test_a_part_that_cannot_be_seen_has_an_empty_surface_that_can_be_moved():
    parts, capture = two_cubes()
    unseen = replace(parts, splats=replace(parts.splats, logit_opacities=parts.splats.logit_opacities.clone()))
    unseen.splats.logit_opacities[parts.counts[0] :] = -9.0
    _, mesh = part_meshes(articulate(unseen), capture, voxel=0.04)
    assert not len(mesh.faces)
    assert not len(mesh.copy().apply_transform(np.diag([1.0, -1, -1, 1])).faces)


def test_specks_go_and_handles_stay():
    door, handle, speck = (trimesh.creation.box([size] * 3) for size in (1.0, 0.3, 0.05))
    pieces = [door, handle.apply_translation([2, 0, 0]), speck.apply_translation([0, 2, 0])]
    mesh = trimesh.util.concatenate(pieces)
    assert without_specks(mesh, 0.01).area == pytest.approx(door.area + handle.area)
    assert without_specks(mesh, 0.1).area == pytest.approx(door.area)
    assert without_specks(mesh, 0.0).area == pytest.approx(mesh.area)


def coloured_ball() -> trimesh.Trimesh:
    """A ball whose colours are its points' coordinates."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    rgba = np.concatenate([np.rint((ball.vertices + 1) * 127.5), np.full((len(ball.vertices), 1), 255)], 1)
    return trimesh.Trimesh(ball.vertices, ball.faces, process=False, vertex_colors=rgba.astype(np.uint8))


def test_a_texture_holds_the_colours_of_the_places_it_lies_on():
    pytest.importorskip("xatlas")
    pytest.importorskip("fast_simplification")
    light = textured(coloured_ball(), faces=2000, size=512)
    assert len(light.faces) <= 2000
    corners, uv = np.asarray(light.triangles), np.asarray(light.visual.uv)[light.faces]
    image = np.asarray(light.visual.material.image).astype(float)
    for weights in ([0.34, 0.33, 0.33], [0.8, 0.1, 0.1], [0.1, 0.1, 0.8]):
        place, at = np.einsum("fcd,c->fd", corners, weights), np.einsum("fcd,c->fd", uv, weights)
        column, row = np.floor(at[:, 0] * 512).astype(int), np.floor((1 - at[:, 1]) * 512).astype(int)
        found = image[row.clip(0, 511), column.clip(0, 511)] / 127.5 - 1
        assert np.quantile(np.abs(found - place).max(1), 0.99) < 0.05


def test_exported_meshes_open_as_they_are_and_are_the_same_bytes(tmp_path):
    pytest.importorskip("xatlas")
    pytest.importorskip("fast_simplification")
    parts, _ = two_cubes()
    obj, meshes = articulate(parts), [coloured_ball(), trimesh.Trimesh()]
    files = export_meshes(obj, meshes, tmp_path / "once", faces=2000, size=128)
    assert [file.name for file in files] == ["base.ply", "base.obj"]
    surface, light = (trimesh.load_mesh(file, process=False) for file in files)
    assert np.allclose(surface.vertices, meshes[0].vertices, atol=1e-6)
    assert np.array_equal(surface.visual.vertex_colors, meshes[0].visual.vertex_colors)
    assert light.visual.material.image.size == (128, 128)
    assert light.volume == pytest.approx(surface.volume, rel=0.02)
    export_meshes(obj, meshes, tmp_path / "twice", faces=2000, size=128)
    for file in (tmp_path / "once").iterdir():
        assert file.read_bytes() == (tmp_path / "twice" / file.name).read_bytes()

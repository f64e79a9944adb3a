import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from structuregs.capture import Capture, CaptureError, View
from structuregs.geometry import SE3, Box, Camera
from structuregs.points import Hull, Silhouettes, align_cameras, face_axes, object_bounds, points_from
from structuregs.synthetic import RenderOptions, make_capture, make_object

SIZE = 96
SPHERE_CENTRE = np.array([0.3, -0.2, 0.5])
SPHERE_RADIUS = 0.45


def ring_of_cameras(count: int) -> tuple[Camera, ...]:
    """Cameras all around, above and below, that look at the origin from 4 units away."""
    cameras = []
    for i in range(count):
        z = 0.9 - 1.8 * (i + 0.5) / count
        angle, ring = i * math.pi * (3 - math.sqrt(5)), math.sqrt(1 - z * z)
        outward = np.array([ring * math.cos(angle), ring * math.sin(angle), z])
        right = np.cross(-outward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(-outward, right), -outward], 1)
        pose = SE3.from_rotation(torch.from_numpy(R), torch.from_numpy(4 * outward)).to(dtype=torch.float32)
        cameras.append(Camera(pose, 150.0, 150.0, SIZE / 2, SIZE / 2, SIZE, SIZE))
    return tuple(cameras)


CAMERAS = ring_of_cameras(24)


def coverage(camera: Camera, hits: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]) -> np.ndarray:
    """The share of each pixel that the object covers, from 4 x 4 rays through it."""
    n = 4
    fine = hits(*(t.double() for t in camera.resized(n * SIZE, n * SIZE).rays()))
    return fine.float().reshape(SIZE, n, SIZE, n).mean((1, 3)).numpy()


def sphere_mask(camera: Camera, centre: np.ndarray = SPHERE_CENTRE, radius: float = SPHERE_RADIUS) -> np.ndarray:
    """Coverage by the rays that pass the centre closer than the radius."""

    def hits(origin: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        to_centre = (torch.from_numpy(centre) - origin).expand_as(rays)
        return torch.linalg.cross(rays, to_centre).norm(dim=-1) / rays.norm(dim=-1) < radius

    return coverage(camera, hits)


def box_mask(camera: Camera, box: Box) -> np.ndarray:
    def hits(origin: torch.Tensor, rays: torch.Tensor) -> torch.Tensor:
        enter, leave = box.intersect(origin, rays)
        return enter < leave

    return coverage(camera, hits)


def box_silhouettes(box: Box) -> Silhouettes:
    return Silhouettes(CAMERAS, np.stack([box_mask(camera, box) for camera in CAMERAS]))


def sphere_silhouettes() -> Silhouettes:
    return Silhouettes(CAMERAS, np.stack([sphere_mask(camera) for camera in CAMERAS]))


def turned_box(*half_extents: float) -> Box:
    pose = SE3.exp(torch.tensor([0.1, 0.2, -0.1, 0.4, -0.3, 0.7], dtype=torch.float64))
    return Box(pose, torch.tensor(half_extents, dtype=torch.float64))


def points_of(box: Box, count: int) -> np.ndarray:
    g = torch.Generator().manual_seed(0)
    return box.to_world(torch.rand(count, 3, generator=g, dtype=torch.float64) * 2 - 1).numpy()


class TestHull:
    def test_holds_a_sphere_and_little_more(self):
        low, high = np.array([-0.4, -0.9, -0.2]), np.array([1.0, 0.5, 1.2])
        hull = sphere_silhouettes().carve(low, high, 56)
        depth = np.linalg.norm(hull.centres(np.ones_like(hull.occupied)) - SPHERE_CENTRE, axis=1).reshape(hull.occupied.shape)
        assert hull.occupied[depth < SPHERE_RADIUS - 0.5 * hull.voxel].all()
        assert not hull.occupied[depth > 1.06 * SPHERE_RADIUS].any()
        volume = hull.occupied.sum() * hull.voxel**3 / (4 / 3 * np.pi * SPHERE_RADIUS**3)
        assert 0.97 < volume < 1.05

    def test_holds_a_turned_box_and_little_more(self):
        box = turned_box(0.5, 0.3, 0.2)
        hull = box_silhouettes(box).carve(np.full(3, -0.8), np.full(3, 0.8), 64)
        inside = points_of(box, 5000)
        assert hull.sample(hull.distance(), inside, outside=np.inf).max() < 1.5 * hull.voxel
        assert (hull.sample(hull.occupied.astype(float), inside, outside=0.0) == 1).mean() > 0.97
        assert box.contains(torch.from_numpy(hull.centres()), margin=0.08).all()
        assert 1.0 < hull.occupied.sum() * hull.voxel**3 / float(box.volume) < 1.2

    def test_a_sheet_thinner_than_a_voxel_survives_whole(self):
        sheet = turned_box(0.5, 0.4, 0.004)
        hull = box_silhouettes(sheet).carve(np.full(3, -0.9), np.full(3, 0.9), 26)
        assert hull.voxel > 8 * 2 * 0.004, "the voxels are far too coarse to hit the sheet with their centres"
        assert hull.sample(hull.distance(), points_of(sheet, 3000), outside=np.inf).max() < 1.5 * hull.voxel
        layers = hull.occupied.sum() * hull.voxel**2 / (1.0 * 0.8)
        assert 0.9 < layers < 2

    def test_the_grid_spans_what_was_asked(self):
        low, high = np.array([-1.0, -0.5, 0.0]), np.array([1.0, 0.5, 0.3])
        hull = sphere_silhouettes().carve(low, high, 40)
        assert hull.occupied.shape == (40, 20, 6)
        assert hull.voxel == pytest.approx(0.05)
        np.testing.assert_array_equal(hull.origin, low)

    def test_a_place_that_hardly_any_view_sees_is_not_the_object(self):
        blank = Silhouettes(CAMERAS, np.ones((len(CAMERAS), SIZE, SIZE), np.float32))
        hull = blank.carve(np.full(3, -12.0), np.full(3, 12.0), 24)
        assert hull.occupied.any()
        assert np.linalg.norm(hull.centres(), axis=1).max() < 4.5, "beyond the cameras"

    def test_distance_to_a_lone_voxel(self):
        occupied = np.zeros((5, 4, 6), bool)
        occupied[1, 2, 3] = True
        hull = Hull(np.array([1.0, 2.0, 3.0]), 0.5, occupied)
        expected = np.linalg.norm(hull.centres(np.ones_like(occupied)) - hull.centres()[0], axis=1)
        np.testing.assert_allclose(hull.distance().ravel(), expected, atol=1e-12)
        np.testing.assert_allclose(hull.centres(), [[1.75, 3.25, 4.75]])

    def test_nothing_is_near_an_empty_solid(self):
        assert (Hull(np.zeros(3), 1.0, np.zeros((2, 2, 2), bool)).distance() == np.inf).all()

    def test_a_field_is_read_in_the_point_s_own_voxel(self):
        hull = Hull(np.array([1.0, 2.0, 3.0]), 0.5, np.ones((2, 3, 4), bool))
        field = np.arange(24.0).reshape(2, 3, 4)
        points = np.array([[1.01, 2.01, 3.01], [1.99, 3.49, 4.99], [1.5, 2.5, 3.5], [0.99, 2.2, 3.2], [1.2, 2.2, 5.01]])
        assert hull.sample(field, points, outside=-1.0).tolist() == [0.0, 23.0, field[1, 1, 1], -1.0, -1.0]


class TestBounds:
    def test_enclose_both_states_and_little_more(self):
        box = turned_box(0.4, 0.15, 0.1)
        low, high = object_bounds((sphere_silhouettes(), box_silhouettes(box)))
        poles = SPHERE_CENTRE + SPHERE_RADIUS * np.vstack([np.eye(3), -np.eye(3)])
        both = np.concatenate([poles, points_of(box, 20_000)])
        assert (low <= both.min(0)).all()
        assert (high >= both.max(0)).all()
        loose = 0.15 * (both.max(0) - both.min(0)).max()
        assert (low >= both.min(0) - loose).all()
        assert (high <= both.max(0) + loose).all()

    def test_masks_of_other_places_in_every_view_belong_to_no_object(self):
        here = [np.array([(-1.0) ** i * 0.5, (-1.0) ** (i // 2) * 0.5, (-1.0) ** (i // 4) * 0.5]) for i in range(len(CAMERAS))]
        apart = np.stack([sphere_mask(camera, place, 0.2) for camera, place in zip(CAMERAS, here, strict=True)])
        with pytest.raises(CaptureError, match=r"^state 1: no point in space lies inside the masks of all 24 views; check"):
            object_bounds((sphere_silhouettes(), Silhouettes(CAMERAS, apart)))


@pytest.fixture(scope="module")
def laptop() -> Capture:
    return make_capture(make_object("laptop"), RenderOptions(size=64, views=4, test_views=1, samples=1))


class TestDepthClouds:
    def test_lie_on_the_true_surface_of_their_state(self, laptop: Capture):
        clouds = points_from(laptop, "depth")
        assert clouds is not None
        obj = make_object("laptop")
        for state, cloud in enumerate(clouds.points):
            assert len(cloud) > 1000
            distances = []
            for item in (item for part in obj.parts for item in part.at_state(state)):
                local = item.box.T_world_box.inverse().apply(torch.from_numpy(cloud)).abs() - item.box.half_extents
                distances.append(local.clamp(min=0).norm(dim=-1) + local.amax(-1).clamp(max=0).abs())
            assert float(torch.stack(distances).amin(0).max()) < 1e-3

    def test_a_view_without_depth_is_named(self, laptop: Capture):
        bare = tuple(tuple(replace(view, depth_source=None) for view in views) for views in laptop.train)
        with pytest.raises(CaptureError, match=r"^view 0000 has no depth map; use --points hull, which needs none\.$"):
            points_from(replace(laptop, train=(bare[0], bare[1])), "depth")

    def test_the_hull_needs_no_cloud(self, laptop: Capture):
        assert points_from(laptop, "hull") is None


def cloud(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3))


def surface_of(half: Sequence[float], count: int, noise: float, seed: int) -> np.ndarray:
    """Points strewn over the faces of a box around the origin, each as many as its area, with noise."""
    points = trimesh.creation.box(2 * np.array(half)).sample(count, seed=seed)
    return points + np.random.default_rng(seed).normal(0, noise, points.shape)


def turned_by(first: np.ndarray, second: np.ndarray) -> float:
    """Degrees between two frames."""
    return float(np.degrees(Rotation.from_matrix(first.T @ second).magnitude()))


class TestFaceAxes:
    @pytest.mark.parametrize("off", [(0.0, 0.0, 7.0), (3.0, -8.0, 1.0), (-6.0, 5.0, 4.0)])
    def test_finds_how_a_box_lies_though_something_sticks_out_at_corners(self, off: tuple[float, float, float]):
        """The box of least volume around the same points lies askew by degrees."""
        true = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
        knob = surface_of((0.04, 0.05, 0.04), 100, 0.004, 1)
        at = np.array([0.55, 0.45, 0.2])
        points = np.concatenate([surface_of((0.6, 0.4, 0.35), 3000, 0.004, 0), knob + at, knob - at]) @ true.T
        start = true @ Rotation.from_euler("xyz", off, degrees=True).as_matrix()
        assert turned_by(face_axes(points, start, 0.01), true) < 0.3
        least = np.abs(trimesh.bounds.oriented_bounds(points)[0][:3, :3] @ true).max(0)
        assert np.degrees(np.arccos(least.min())) > 2

    def test_axes_that_are_right_stay_as_they_are(self):
        points = surface_of((0.6, 0.4, 0.35), 3000, 0.004, 0)
        assert face_axes(points, np.eye(3), 0.01).tolist() == np.eye(3).tolist()

    @pytest.mark.parametrize(("lies", "found"), [(0.0, 0.0), (0.7, 0.7)])
    def test_the_world_s_axes_stand_for_those_that_are_near_and_as_sharp(self, lies: float, found: float):
        true = Rotation.from_euler("xyz", [0, lies, 0], degrees=True).as_matrix()
        points = surface_of((0.6, 0.4, 0.35), 3000, 0.004, 0) @ true.T
        start = Rotation.from_euler("xyz", [0.1, lies + 0.2, -0.1], degrees=True).as_matrix()
        assert turned_by(face_axes(points, start, 0.01), np.eye(3)) == pytest.approx(found, abs=0.3 if found else 0)

    def test_what_stands_at_45_degrees_is_far_from_the_world_s_axes(self):
        true = Rotation.from_euler("xyz", [0, 0, 45], degrees=True).as_matrix()
        found = face_axes(surface_of((0.6, 0.4, 0.35), 3000, 0.004, 0) @ true.T, true, 0.01)
        np.testing.assert_allclose(found.T @ found, np.eye(3), atol=1e-9)
        assert turned_by(found, true) < 0.3

    @pytest.mark.parametrize("count", [300, 1000, 4000])
    def test_a_ball_has_none_however_few_points_are_of_it(self, count: int):
        points = np.random.default_rng(0).normal(size=(count, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        start = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
        assert face_axes(points, start, 0.01).tolist() == start.tolist()


class TestFiles:
    def test_npz_round_trip(self, laptop: Capture, tmp_path: Path):
        first, second = cloud(150, 0), cloud(200, 1).astype(np.float32)
        np.savez(tmp_path / "points.npz", points_0=first, points_1=second)
        read = points_from(laptop, str(tmp_path / "points.npz"))
        assert read is not None
        np.testing.assert_array_equal(read.points[0], first)
        np.testing.assert_array_equal(read.points[1], second.astype(np.float64))

    def test_ply_round_trip(self, laptop: Capture, tmp_path: Path):
        for state in (0, 1):
            trimesh.PointCloud(cloud(120 + state, state)).export(tmp_path / f"s{state}.ply")
        read = points_from(laptop, str(tmp_path / "s{state}.ply"))
        assert read is not None
        for state in (0, 1):
            np.testing.assert_allclose(read.points[state], cloud(120 + state, state), atol=1e-6)

    def test_a_mesh_s_ply_gives_its_vertices(self, laptop: Capture, tmp_path: Path):
        ball = trimesh.creation.icosphere(subdivisions=3)
        for state in (0, 1):
            ball.export(tmp_path / f"s{state}.ply")
        read = points_from(laptop, str(tmp_path / "s{state}.ply"))
        assert read is not None
        np.testing.assert_allclose(np.linalg.norm(read.points[0], axis=1), 1, atol=1e-6)

    def test_a_huge_cloud_is_thinned_evenly(self, laptop: Capture, tmp_path: Path):
        line = np.linspace(0, 1, 200_000)[:, None].repeat(3, 1)
        np.savez(tmp_path / "points.npz", points_0=line, points_1=line[:500])
        read = points_from(laptop, str(tmp_path / "points.npz"))
        assert read is not None
        assert 20_000 < len(read.points[0]) <= 50_000
        assert np.ptp(np.diff(read.points[0][:, 0])) < 1e-9
        assert len(read.points[1]) == 500

    @pytest.mark.parametrize("source", ["cloud.txt", "one.ply", "hul"])
    def test_an_unknown_source_names_the_choices(self, laptop: Capture, source: str):
        with pytest.raises(CaptureError, match=rf"^--points {source}: give hull, depth, vggt, pi3, a file FILE\.npz, or"):
            points_from(laptop, source)

    @pytest.mark.parametrize(
        "write",
        [
            lambda _: None,
            lambda file: file.write_bytes(b""),
            lambda file: file.write_text("no archive"),
            lambda file: file.write_bytes(b"PK\x03\x04 an archive that ends early"),
            lambda file: file.write_bytes(_npy(cloud(120, 0))),
            lambda file: np.savez(file, points_0=cloud(120, 0)),
            lambda file: np.savez(file, points_0=cloud(120, 0), points_1=np.array([{}] * 120, dtype=object)),
        ],
        ids=["missing", "empty", "text", "cut", "npy", "one state", "objects"],
    )
    def test_no_npz_of_two_clouds(self, laptop: Capture, tmp_path: Path, write: Callable[[Path], object]):
        file = tmp_path / "points.npz"
        write(file)
        with pytest.raises(CaptureError, match=r"points\.npz: no \.npz with the arrays points_0 and points_1 of shape N x 3"):
            points_from(laptop, str(file))

    @pytest.mark.parametrize(
        "bad",
        [cloud(99, 0), cloud(120, 0)[:, :2], cloud(120, 0).ravel(), np.full((120, 3), np.nan), np.full((120, 3), "x")],
        ids=["few", "flat", "one row", "nan", "text"],
    )
    def test_an_array_that_is_no_cloud(self, laptop: Capture, tmp_path: Path, bad: np.ndarray):
        np.savez(tmp_path / "points.npz", points_0=cloud(120, 0), points_1=bad)
        with pytest.raises(CaptureError, match=r"points\.npz: wanted at least 100 finite points of shape N x 3, found \("):
            points_from(laptop, str(tmp_path / "points.npz"))

    def test_a_missing_ply_is_named(self, laptop: Capture, tmp_path: Path):
        trimesh.PointCloud(cloud(120, 0)).export(tmp_path / "s0.ply")
        with pytest.raises(CaptureError, match=r"s1\.ply: there is no such file\.$"):
            points_from(laptop, str(tmp_path / "s{state}.ply"))

    @pytest.mark.parametrize("kept", [0, 20, 150, 400], ids=["empty", "cut in the header", "few points", "cut in the points"])
    def test_a_damaged_ply_is_named(self, laptop: Capture, tmp_path: Path, kept: int):
        data = trimesh.PointCloud(cloud(120, 0)).export(file_type="ply")
        assert isinstance(data, bytes)
        (tmp_path / "s0.ply").write_bytes(data[:kept])
        with pytest.raises(CaptureError, match=r"s0\.ply: (not a PLY file|wanted at least 100)"):
            points_from(laptop, str(tmp_path / "s{state}.ply"))

    def test_text_named_ply(self, laptop: Capture, tmp_path: Path):
        (tmp_path / "s0.ply").write_text("hello\nworld\n")
        with pytest.raises(CaptureError, match=r"s0\.ply: not a PLY file"):
            points_from(laptop, str(tmp_path / "s{state}.ply"))


def poses_of(cameras: Sequence[Camera]) -> SE3:
    return SE3(torch.stack([camera.T_world_camera.wxyz_xyz for camera in cameras]).double())


def in_its_own_frame(poses: SE3) -> tuple[SE3, SE3, float]:
    """The poses in a frame that is turned, shifted and 2.5 times as small; the motion and the scale that lead back."""
    T, scale = SE3.exp(torch.tensor([0.3, -1.0, 0.5, 0.8, -0.5, 1.9], dtype=torch.float64)), 2.5
    away = T.inverse() @ poses
    return SE3.from_quat(away.wxyz, away.xyz / scale), T, scale


class TestCameras:
    def test_are_laid_upon_each_other(self):
        poses = poses_of(CAMERAS)
        away, T, scale = in_its_own_frame(poses)
        alignment = align_cameras(away, poses)
        points = cloud(120, 0)
        expected = T.apply(torch.from_numpy(points * scale)).numpy()
        np.testing.assert_allclose(alignment.similarity.apply(points), expected, atol=1e-6)
        assert alignment.angle_deg < 1e-4
        assert alignment.distance < 1e-6

    def test_though_a_third_of_them_are_wrong(self):
        poses = poses_of(CAMERAS)
        away, T, scale = in_its_own_frame(poses)
        generator = torch.Generator().manual_seed(0)
        wrong = SE3.exp(torch.randn(len(CAMERAS), 6, generator=generator, dtype=torch.float64))
        blunders = torch.arange(len(CAMERAS)) % 3 == 0
        mixed = SE3(torch.where(blunders[:, None], (wrong @ away).wxyz_xyz, away.wxyz_xyz))
        alignment = align_cameras(mixed, poses)
        expected = T.apply(torch.from_numpy(cloud(120, 0) * scale)).numpy()
        np.testing.assert_allclose(alignment.similarity.apply(cloud(120, 0)), expected, atol=0.01)

    def test_in_one_place_tell_no_scale(self):
        poses = poses_of(CAMERAS)
        here = SE3.from_quat(poses.wxyz, torch.zeros_like(poses.xyz))
        with pytest.raises(ValueError, match="do not tell a scale"):
            align_cameras(here, poses)


class StandIn:
    """A model that knows the truth, but for noise: it finds the shown images among a capture's views."""

    def __init__(self, capture: Capture, side: int, noise: float):
        self.capture, self.side, self.noise = capture, side, noise

    def from_pretrained(self, weights: str) -> "StandIn":
        self.weights = weights
        return self

    def to(self, device: torch.device) -> "StandIn":
        assert device.type in ("cpu", "cuda")
        return self

    def eval(self) -> "StandIn":
        return self

    def views(self, images: torch.Tensor) -> list[View]:
        """The views of the images, whose order and state the model is not told."""
        assert images.shape[0] == 1
        assert images.shape[2:] == (3, self.side, self.side)
        known = [view for state in self.capture.train for view in state]
        blank = {id(view): torch.from_numpy(view.image(self.side, self.side)[0]).permute(2, 0, 1) for view in known}
        return [min(known, key=lambda view: float((blank[id(view)] - image).abs().mean())) for image in images[0].cpu()]

    def depth(self, view: View) -> torch.Tensor:
        assert view.depth is not None
        index = torch.arange(self.side) * view.camera.width // self.side
        depth = torch.from_numpy(view.depth)[index[:, None], index]
        return depth * (1 + self.noise * torch.randn(depth.shape, generator=torch.Generator().manual_seed(0)))


class Vggt(StandIn):
    def __call__(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        views = self.views(images)
        away, _, scale = in_its_own_frame(poses_of([view.camera for view in views]))
        depth = torch.stack([self.depth(view) for view in views]) / scale
        return {"pose_enc": away.inverse().wxyz_xyz[None], "depth": depth[None, ..., None], "depth_conf": depth[None]}


class Pi3(StandIn):
    def __call__(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        views = self.views(images)
        cameras = [view.camera.resized(self.side, self.side) for view in views]
        away, T, scale = in_its_own_frame(poses_of(cameras))
        rows = [(camera.rays(), self.depth(view)) for camera, view in zip(cameras, views, strict=True)]
        world = torch.stack([origin + rays * depth[..., None] for (origin, rays), depth in rows])
        points = T.inverse().apply(world.double()) / scale
        sure = torch.ones(1, len(views), self.side, self.side, 1)
        return {"points": points[None].float(), "camera_poses": away.as_matrix()[None], "conf": sure, "more": None}  # pyright: ignore


def install(monkeypatch: pytest.MonkeyPatch, **modules: dict[str, object]) -> None:
    """Modules of these names (with __ for dots) and contents."""
    for name, contents in modules.items():
        module = ModuleType(name.replace("__", "."))
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, module.__name__, module)


def install_stand_in(monkeypatch: pytest.MonkeyPatch, name: str, capture: Capture, noise: float) -> StandIn:
    """Packages of the estimators' names and interfaces, as their READMEs have them."""
    focal = capture.train[0][0].camera.fx / capture.train[0][0].camera.width

    def decode(pose: torch.Tensor, size: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
        K = torch.tensor([[focal * size[1], 0, size[1] / 2], [0, focal * size[0], size[0] / 2], [0, 0, 1]])
        return SE3(pose).as_matrix()[..., :3, :], K.expand(*pose.shape[:2], 3, 3)

    def unproject(depth: torch.Tensor, extrinsics: torch.Tensor, intrinsics: torch.Tensor) -> np.ndarray:
        rows = []
        for z, E, K in zip(depth[..., 0], extrinsics, intrinsics, strict=True):
            pose = SE3.from_rotation(E[:, :3], E[:, 3]).inverse()
            camera = Camera(pose, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), z.shape[1], z.shape[0])
            origin, rays = camera.rays()
            rows.append(origin + rays * z[..., None])
        return torch.stack(rows).numpy()

    if name == "vggt":
        model = Vggt(capture, 518, noise)
        install(monkeypatch, vggt={}, vggt__models={}, vggt__models__vggt={"VGGT": model}, vggt__utils={})
        install(monkeypatch, vggt__utils__pose_enc={"pose_encoding_to_extri_intri": decode})
        install(monkeypatch, vggt__utils__geometry={"unproject_depth_map_to_point_map": unproject})
    else:
        model = Pi3(capture, 504, noise)
        install(monkeypatch, pi3={}, pi3__models={}, pi3__models__pi3={"Pi3": model})
    return model


@pytest.mark.parametrize("name", ["vggt", "pi3"])
class TestEstimators:
    def test_points_come_to_lie_on_the_object(self, name: str, laptop: Capture, monkeypatch: pytest.MonkeyPatch):
        model = install_stand_in(monkeypatch, name, laptop, noise=0.002)
        found, true = points_from(laptop, name), points_from(laptop, "depth")
        assert found is not None
        assert true is not None
        for state in (0, 1):
            away = KDTree(true.points[state]).query(found.points[state])[0]
            assert np.quantile(away, 0.9) < 0.05
            assert np.median(away) < 0.02
        assert model.weights in " ".join(found.says)
        assert "0.00 degrees" in found.says[1]

    def test_cameras_that_disagree_are_refused(self, name: str, laptop: Capture, monkeypatch: pytest.MonkeyPatch):
        model = install_stand_in(monkeypatch, name, laptop, noise=0.0)
        shown = model.views
        monkeypatch.setattr(model, "views", lambda images: shown(images)[::-1])
        with pytest.raises(CaptureError, match=rf"--points {name}, state 0: its cameras agree .* only to .* use --points hull"):
            points_from(laptop, name)

    def test_a_missing_package_says_how_to_get_it(self, name: str, laptop: Capture, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(CaptureError, match=r"pip install .*git\+https.*CC BY-NC 4.0"):
            points_from(laptop, name)


def _npy(array: np.ndarray) -> bytes:
    import io

    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()

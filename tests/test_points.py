import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from structuregs.capture import Capture, CaptureError
from structuregs.geometry import SE3, Box, Camera
from structuregs.points import Hull, Silhouettes, object_bounds, points_from
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
        for state, cloud in enumerate(clouds):
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


class TestFiles:
    def test_npz_round_trip(self, laptop: Capture, tmp_path: Path):
        first, second = cloud(150, 0), cloud(200, 1).astype(np.float32)
        np.savez(tmp_path / "points.npz", points_0=first, points_1=second)
        read = points_from(laptop, str(tmp_path / "points.npz"))
        assert read is not None
        np.testing.assert_array_equal(read[0], first)
        np.testing.assert_array_equal(read[1], second.astype(np.float64))

    def test_ply_round_trip(self, laptop: Capture, tmp_path: Path):
        for state in (0, 1):
            trimesh.PointCloud(cloud(120 + state, state)).export(tmp_path / f"s{state}.ply")
        read = points_from(laptop, str(tmp_path / "s{state}.ply"))
        assert read is not None
        for state in (0, 1):
            np.testing.assert_allclose(read[state], cloud(120 + state, state), atol=1e-6)

    def test_a_mesh_s_ply_gives_its_vertices(self, laptop: Capture, tmp_path: Path):
        ball = trimesh.creation.icosphere(subdivisions=3)
        for state in (0, 1):
            ball.export(tmp_path / f"s{state}.ply")
        read = points_from(laptop, str(tmp_path / "s{state}.ply"))
        assert read is not None
        np.testing.assert_allclose(np.linalg.norm(read[0], axis=1), 1, atol=1e-6)

    def test_a_huge_cloud_is_thinned_evenly(self, laptop: Capture, tmp_path: Path):
        line = np.linspace(0, 1, 200_000)[:, None].repeat(3, 1)
        np.savez(tmp_path / "points.npz", points_0=line, points_1=line[:500])
        read = points_from(laptop, str(tmp_path / "points.npz"))
        assert read is not None
        assert 20_000 < len(read[0]) <= 50_000
        assert np.ptp(np.diff(read[0][:, 0])) < 1e-9
        assert len(read[1]) == 500

    @pytest.mark.parametrize("source", ["cloud.txt", "one.ply", "hul"])
    def test_an_unknown_source_names_the_choices(self, laptop: Capture, source: str):
        with pytest.raises(CaptureError, match=rf"^--points {source}: give hull, depth, a file FILE\.npz, or"):
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


def _npy(array: np.ndarray) -> bytes:
    import io

    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()

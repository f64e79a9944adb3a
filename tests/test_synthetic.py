from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.transform import Rotation

from structuregs.capture import find_truth, load_capture, load_truth
from structuregs.geometry import Box, Camera
from structuregs.synthetic import (
    OBJECTS,
    KnownObject,
    Lighting,
    RenderOptions,
    draw,
    make_capture,
    make_object,
    orbit,
    random_object,
    save_known,
)

SMALL = RenderOptions(size=96, views=6, test_views=2)
FLAT = Lighting(ambient=1.0)  # no shading: a surface has one colour from everywhere
ALL = [make_object(name) for name in OBJECTS] + [random_object(seed, parts) for seed, parts in ((0, 1), (1, 3), (2, 6))]


def all_boxes(obj: KnownObject, state: int):
    return [box for part in obj.parts for box in part.at_state(state)]


def part_of_box(obj: KnownObject) -> np.ndarray:
    return np.repeat(np.arange(len(obj.parts)), [len(part.boxes) for part in obj.parts])


def surface_points(camera: Camera, depth: np.ndarray) -> torch.Tensor:
    """World points of a depth map, as H W 3."""
    origin, directions = camera.rays()
    return (origin + torch.from_numpy(depth)[..., None] * directions).double()


def moved_by_hand(obj: KnownObject, k: int, points: np.ndarray) -> np.ndarray:
    """Points of part k from state 0 to state 1 by SciPy's rotations."""
    joint = obj.joints[k - 1]
    axis, origin = np.array(joint.axis), np.array(joint.origin)
    if joint.kind == "prismatic":
        return points + (joint.q1 - joint.q0) * axis
    return Rotation.from_rotvec((joint.q1 - joint.q0) * axis).apply(points - origin) + origin


@pytest.mark.parametrize("obj", ALL, ids=lambda obj: obj.name)
def test_depth_lies_on_the_surface_of_the_box_that_is_seen(obj):
    for state in (0, 1):
        boxes = all_boxes(obj, state)
        stacked = [Box(item.box.T_world_box, item.box.half_extents) for item in boxes]
        for camera in orbit(obj, 2, SMALL, azimuth=4.0):
            picture = draw(boxes, camera, Lighting(), samples=1)
            points = surface_points(camera, picture.depth)
            assert (picture.box >= 0).sum() > 200
            np.testing.assert_array_equal(picture.box >= 0, picture.depth > 0)
            for b in np.unique(picture.box[picture.box >= 0]):
                local = stacked[b].T_world_box.inverse().apply(points[torch.from_numpy(picture.box == b)])
                gap = (local.abs() - stacked[b].half_extents).amax(-1)
                assert gap.abs().max() < 1e-5, "on a face: not inside, not outside"


def test_the_nearest_of_all_boxes_is_seen():
    obj = random_object(1, 3)
    boxes = all_boxes(obj, 1)
    camera = orbit(obj, 3, SMALL)[1]
    picture = draw(boxes, camera, Lighting(), samples=1)
    origin, directions = camera.rays()
    entries = []
    for item in boxes:
        entry, leave = item.box.intersect(origin.double(), directions.double())
        entries.append(torch.where(entry < leave, entry, torch.inf))
    nearest = torch.stack(entries).amin(0)
    expected = torch.where(nearest.isinf(), 0.0, nearest)
    assert picture.depth == pytest.approx(expected.numpy(), abs=1e-5)


def test_the_mask_of_a_block_is_the_hull_of_its_corners():
    obj = make_object("block")
    for camera in orbit(obj, 4, SMALL, azimuth=1.0):
        picture = draw(obj.parts[0].boxes, camera, Lighting(), samples=8)
        corners = camera.project(obj.parts[0].boxes[0].box.corners)[0].numpy()
        v, u = np.indices(picture.depth.shape) + 0.5
        inside = Delaunay(corners).find_simplex(np.stack([u, v], -1)) >= 0
        assert (inside != (picture.depth > 0)).sum() <= 2, "only where an edge runs through a pixel's centre"
        assert (picture.rgba[..., 3] / 255).sum() == pytest.approx(ConvexHull(corners).volume, rel=2e-3)


@pytest.mark.parametrize("name", ["cabinet", "laptop", "stapler", "slider", "fridge"])
def test_state_1_is_state_0_moved_by_the_joints_texture_and_all(name):
    obj = make_object(name)
    flat = [[replace(item, texture=replace(item.texture, kind="noise")) for item in all_boxes(obj, state)] for state in (0, 1)]
    camera_0, camera_1 = orbit(obj, 1, SMALL, azimuth=-1.2)[0], orbit(obj, 1, SMALL, azimuth=-1.9)[0]
    before, after = (draw(boxes, camera, FLAT, 1) for boxes, camera in zip(flat, (camera_0, camera_1), strict=True))
    part = part_of_box(obj)
    checked = 0
    for k in range(len(obj.parts)):
        seen = (before.box >= 0) & (part[before.box] == k)
        points = surface_points(camera_0, before.depth)[torch.from_numpy(seen)].numpy()
        points = points if k == 0 else moved_by_hand(obj, k, points)
        pixels, depth = camera_1.project(torch.from_numpy(points))
        u, v = np.floor(pixels.numpy()).astype(int).T.clip(0, SMALL.size - 1)
        visible = (part[after.box[v, u]] == k) & (np.abs(after.depth[v, u] - depth.numpy()) < 0.02)
        if visible.sum() > 50:
            difference = np.abs(before.rgba[seen][visible, :3].astype(float) - after.rgba[v, u][visible, :3])
            other = np.abs(before.rgba[seen][visible, :3].astype(float) - np.roll(after.rgba[v, u][visible, :3], 25, axis=0))
            assert np.median(difference) <= 3 < np.median(other)
            checked += 1
    assert checked >= 2, "the base and a moving part are seen in both pictures"


def test_the_light_stays_while_parts_turn():
    obj = make_object("laptop")
    camera = orbit(obj, 1, SMALL)[0]
    part = part_of_box(obj)
    white = (1.0, 1.0, 1.0)
    for k, same in ((0, True), (1, False)):
        means = []
        for state in (0, 1):
            boxes = [replace(i, texture=replace(i.texture, light=white, dark=white)) for i in all_boxes(obj, state)]
            pictures = [draw(boxes, camera, light, 1) for light in (Lighting(), FLAT)]
            seen = (pictures[0].box >= 0) & (part[pictures[0].box] == k)
            means.append(pictures[0].rgba[seen, 1].astype(float).sum() / pictures[1].rgba[seen, 1].sum())
        assert (abs(means[0] - means[1]) < 0.03) == same


def test_shading_follows_lambert_and_exposure_scales_it():
    obj = make_object("block")
    camera = orbit(obj, 1, SMALL, azimuth=0.8)[0]
    boxes = obj.parts[0].boxes
    light = Lighting(towards=(0.0, 0.0, 2.0), ambient=0.3)
    flat, lit, dim = (draw(boxes, camera, which, 1) for which in (FLAT, light, replace(light, exposure=0.5)))
    points = surface_points(camera, flat.depth)
    top = (flat.depth > 0) & ((points[..., 2] - 0.5).abs() < 1e-4).numpy()
    side = (flat.depth > 0) & ~top
    assert lit.rgba[top, :3] == pytest.approx(flat.rgba[top, :3], abs=1)
    assert lit.rgba[side, :3] == pytest.approx(0.3 * flat.rgba[side, :3], abs=1)
    assert dim.rgba[top, :3] == pytest.approx(0.5 * lit.rgba[top, :3], abs=1)


def test_shadows_fall_below_the_stool_and_nowhere_on_its_seat():
    obj = make_object("static")
    camera = orbit(obj, 1, replace(SMALL, elevation_deg=(20.0, 20.0)))[0]
    light = Lighting(towards=(0.3, 0.0, 1.0))
    open_, shaded = (draw(all_boxes(obj, 0), camera, replace(light, shadows=on), 1) for on in (False, True))
    darker = (shaded.rgba[..., :3].astype(int) < open_.rgba[..., :3]).any(-1)
    assert not (shaded.rgba[..., :3] > open_.rgba[..., :3]).any()
    heights = surface_points(camera, open_.depth)[..., 2].numpy()
    assert darker.sum() > 20
    assert heights[darker].max() < 0.7 + 1e-6


@pytest.mark.parametrize("obj", ALL, ids=lambda obj: obj.name)
def test_cameras_see_the_whole_object_in_both_states(obj):
    capture = make_capture(obj, SMALL)
    for view in (view for split in (capture.train, capture.test) for views in split for view in views):
        alpha = view.rgba[..., 3]
        assert not any(edge.any() for edge in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]))
        assert 0.02 < (alpha / 255).mean() < 0.7


@pytest.mark.parametrize("obj", ALL, ids=lambda obj: obj.name)
def test_moving_parts_do_not_run_into_other_parts(obj):
    grid = torch.stack(torch.meshgrid(*[torch.linspace(-0.97, 0.97, 9, dtype=torch.float64)] * 3, indexing="ij"), -1).reshape(
        -1, 3
    )
    for state in (0, 1):
        for k, part in enumerate(obj.parts):
            others = [item.box for j, other in enumerate(obj.parts) if j != k for item in other.at_state(state)]
            for item in part.at_state(state):
                points = item.box.to_world(grid)
                assert not any(box.contains(points, margin=-1e-3).any() for box in others)


def test_meshes_are_closed_face_outward_and_hold_the_boxes_volume():
    obj = make_object("stapler")
    for (state, k), mesh in obj.meshes().items():
        a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
        signed = np.einsum("ij,ij->", a, np.cross(b, c)) / 6  # divergence theorem
        assert signed == pytest.approx(float(sum(item.box.volume for item in obj.parts[k].boxes)))
        if state and k:
            assert mesh.vertices == pytest.approx(moved_by_hand(obj, k, obj.meshes()[0, k].vertices))


def test_the_same_seed_gives_the_same_bytes_and_another_another_object():
    a, b = (make_capture(make_object("door", seed=5), SMALL) for _ in range(2))
    for ours, theirs in zip(a.train[1], b.train[1], strict=True):
        np.testing.assert_array_equal(ours.rgba, theirs.rgba)
    c = make_object("door", seed=6)
    assert c.bounding_sphere() != make_object("door", seed=5).bounding_sphere()
    assert not np.array_equal(make_capture(c, SMALL).train[0][0].rgba, a.train[0][0].rgba)


def test_no_camera_is_used_twice():
    capture = make_capture(make_object("block"), SMALL)
    views = [view for split in (capture.train, capture.test) for state in split for view in state]
    centres = torch.stack([view.camera.centre for view in views])
    assert len(views) == 16
    assert torch.pdist(centres).min() > 0.01


def test_noise_has_the_deviation_asked_for_and_stays_on_the_object():
    quiet, loud = (make_capture(make_object("block"), replace(SMALL, noise=noise)).train[1] for noise in (0.0, 0.02))
    covered = quiet[0].rgba[..., 3] > 0
    error = loud[0].rgba[..., :3].astype(float) - quiet[0].rgba[..., :3]
    assert error[covered].std() / 255 == pytest.approx(0.02, rel=0.05)
    assert not error[~covered].any()


def test_a_change_of_exposure_dims_state_1_only():
    same, dimmed = (make_capture(make_object("slider"), replace(SMALL, exposure_change=change)) for change in (1.0, 0.8))
    np.testing.assert_array_equal(same.train[0][0].rgba, dimmed.train[0][0].rgba)
    bright, dim = (capture.train[1][0].rgba[..., :3].astype(float) for capture in (same, dimmed))
    assert dim == pytest.approx(0.8 * bright, abs=1)


@pytest.mark.parametrize(("layout", "folder"), [("paris", "load/known/cabinet/0"), ("artgs", "cabinet")])
def test_a_known_object_comes_back_from_its_folder_with_its_truth(tmp_path, layout, folder):
    obj = make_object("cabinet")
    made = make_capture(obj, SMALL)
    save_known(obj, made, tmp_path / folder, layout)
    read = load_capture(tmp_path)
    for ours, theirs in zip((*made.train, *made.test), (*read.train, *read.test), strict=True):
        for a, b in zip(ours, theirs, strict=True):
            np.testing.assert_array_equal(a.rgba, b.rgba)
            assert torch.allclose(a.camera.T_world_camera.as_matrix(), b.camera.T_world_camera.as_matrix(), atol=1e-6)
            assert b.camera.fx == pytest.approx(a.camera.fx)
            assert a.depth is not None
            assert b.depth is None if layout == "paris" else b.depth == pytest.approx(a.depth, abs=0.00051)
    found = find_truth(read)
    assert found is not None
    truth = load_truth(found)
    assert truth.meshes.keys() == obj.meshes().keys()
    for ours, theirs in zip(obj.joints, truth.joints, strict=True):
        assert theirs.kind == ours.kind
        assert theirs.motion().wxyz_xyz.numpy() == pytest.approx(ours.motion().wxyz_xyz.numpy())


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"synthetic object 'sofa'.*cabinet, laptop"):
        make_object("sofa")


def test_drawing_from_inside_the_object_is_refused():
    obj = make_object("block")
    camera = orbit(obj, 1, SMALL)[0]
    inside = replace(camera, T_world_camera=replace(camera.T_world_camera, wxyz_xyz=torch.tensor([1.0, 0, 0, 0, 0, 0, 0.25])))
    with pytest.raises(ValueError, match="behind the camera"):
        draw(obj.parts[0].boxes, inside, Lighting())

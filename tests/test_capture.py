import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from structuregs.capture import (
    Capture,
    CaptureError,
    TrueJoint,
    TrueMesh,
    View,
    farthest_points,
    find_truth,
    load_capture,
    load_truth,
    save_capture,
    save_truth,
    spread_cameras,
)
from structuregs.geometry import SE3, Camera
from structuregs.synthetic import RenderOptions, make_object, orbit

WIDTH, HEIGHT = 10, 8
K = [[100.0, 0, 5.0], [0, 100.0, 4.0], [0, 0, 1.0]]
# Four units before the origin, looking along +y with z up: columns are right, up, backward, position.
FACING_NORTH = [[1.0, 0, 0, 0], [0, 0, -1.0, -4.0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]]


def facing_north_from(x: float) -> list[list[float]]:
    pose = [list(row) for row in FACING_NORTH]
    pose[0][3] = x
    return pose


def picture(seed: int = 0) -> Image.Image:
    rgba = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 4)).astype(np.uint8)
    rgba[0, 0, 3] = 0
    return Image.fromarray(rgba)


def write_paris(root: Path, views: int = 4) -> Path:
    """A capture in the PARIS layout by hand."""
    for state in ("start", "end"):
        for split in ("train", "test"):
            (root / state / split).mkdir(parents=True)
            poses = {f"{i:04d}": facing_north_from(float(i)) for i in range(views)}
            (root / state / f"camera_{split}.json").write_text(json.dumps({"K": K} | poses))
            for name in poses:
                picture().save(root / state / split / f"{name}.png")
    return root


def write_artgs(root: Path, views: int = 4, suffix: str = ".png") -> Path:
    """A capture in the ArtGS layout by hand, with depth."""
    for state in ("start", "end"):
        rgba, depth = root / "train" / state / "rgba", root / "train" / state / "depth"
        rgba.mkdir(parents=True)
        depth.mkdir()
        frames = []
        for i in range(views):
            picture().save(rgba / f"{i}.png")
            Image.fromarray(np.full((HEIGHT, WIDTH), 1500, np.uint16)).save(depth / f"{i}.png")
            frames.append(
                {"file_path": f"./train/{state}/rgba/{i}{suffix}", "time": 0, "transform_matrix": facing_north_from(i)}
            )
        angles = {"camera_angle_x": 2 * math.atan(WIDTH / 2 / 100), "camera_angle_y": 2 * math.atan(HEIGHT / 2 / 100)}
        (root / f"transforms_train_{state}.json").write_text(json.dumps(angles | {"frames": frames}))
    return root


@pytest.mark.parametrize("write", [write_paris, write_artgs])
def test_a_hand_made_camera_sees_a_point_where_paper_and_pencil_say(tmp_path, write):
    camera = load_capture(write(tmp_path / "capture")).train[0][0].camera
    pixel, depth = camera.project(torch.tensor([0.1, 0.0, 0.08]))
    # 0.1 to the right, 0.08 above the axis, 4 ahead: u = 5 + 100 * 0.1 / 4, v = 4 - 100 * 0.08 / 4.
    assert pixel.tolist() == pytest.approx([7.5, 2.0], abs=1e-4)
    assert float(depth) == pytest.approx(4.0)
    assert camera.centre.tolist() == pytest.approx([0, -4, 0], abs=1e-6)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)


def test_artgs_image_paths_may_lack_their_suffix_and_the_test_split_may_be_missing(tmp_path):
    capture = load_capture(write_artgs(tmp_path, suffix=""))
    assert capture.layout == "artgs"
    assert [len(views) for views in capture.train + capture.test] == [4, 4, 0, 0]
    np.testing.assert_array_equal(capture.train[1][2].rgba, np.asarray(picture()))


def test_depth_files_are_in_thousandths_and_read_when_asked_for(tmp_path):
    capture = load_capture(write_artgs(tmp_path))
    view = capture.train[0][0]
    assert view.depth is not None
    assert view.depth == pytest.approx(np.full((HEIGHT, WIDTH), 1.5))
    Image.fromarray(np.ones((3, 3), np.uint16)).save(tmp_path / "train/start/depth/1.png")
    (tmp_path / "train/start/depth/2.png").write_bytes(b"no image")
    for i, words in ((1, "3 x 3 pixels, its image 10 x 8"), (2, "cannot be read")):
        with pytest.raises(CaptureError, match=words):
            _ = capture.train[0][i].depth


def test_paris_has_no_depth(tmp_path):
    assert load_capture(write_paris(tmp_path)).train[0][0].depth is None


def test_a_folder_above_a_single_capture_will_do(tmp_path):
    root = write_paris(tmp_path / "load" / "set" / "fridge" / "7")
    assert load_capture(tmp_path).root == root
    assert load_capture(tmp_path).name == "fridge_7"
    write_artgs(tmp_path / "other")
    with pytest.raises(CaptureError, match=r"2 captures lie below this folder \(load/set/fridge/7, other\)"):
        load_capture(tmp_path)


def edit_cameras(root: Path, change) -> None:
    file = root / "start" / "camera_train.json"
    record = json.loads(file.read_text())
    change(record)
    file.write_text(json.dumps(record))


def save_mode(root: Path, mode: str, alpha: int = 128) -> None:
    image = Image.new("RGBA", (WIDTH, HEIGHT), (9, 9, 9, alpha)).convert(mode)
    image.save(root / "start" / "train" / "0001.png")


def all_opaque(root: Path) -> None:
    for file in (root / "end" / "train").iterdir():
        Image.new("RGBA", (WIDTH, HEIGHT), (9, 9, 9, 255)).save(file)


def scale_rotation(record: dict) -> None:
    record["0002"][0][0] = 2.0


def mirror(record: dict) -> None:
    record["0002"][0][0] = -1.0


def set_nan(record: dict) -> None:
    record["0002"][1][3] = math.nan


def set_focal(record: dict) -> None:
    record["K"][0][0] = -5.0


BROKEN = {
    "end/camera_train.json: this file is missing, so there is one state only": lambda r: (r / "end/camera_train.json").unlink(),
    "start/camera_train.json: this is no valid JSON": lambda r: (r / "start/camera_train.json").write_text('{"K": [['),
    "start/camera_train.json: not a camera file": lambda r: edit_cameras(r, lambda c: c.pop("K")),
    "frame 0002: a 4 x 4 matrix is needed": lambda r: edit_cameras(r, lambda c: c.update({"0002": [[1.0, 2.0]]})),
    r"0002.png: the camera's 3 x 3 block is no rotation \(determinant 2": lambda r: edit_cameras(r, scale_rotation),
    r"0002.png: the camera's 3 x 3 block is no rotation \(determinant -1": lambda r: edit_cameras(r, mirror),
    "0002.png: the camera holds values that are no numbers": lambda r: edit_cameras(r, set_nan),
    "the focal length is -5, 100 pixels": lambda r: edit_cameras(r, set_focal),
    "state start: 2 training views; 3 or more": lambda r: edit_cameras(r, lambda c: [c.pop(k) for k in ("0002", "0003")]),
    "start/train/0001.png: this image is missing": lambda r: (r / "start/train/0001.png").unlink(),
    "start/train/0001.png: this image cannot be read": lambda r: (r / "start/train/0001.png").write_bytes(
        b"\x89PNG\r\n\x1a\nno"
    ),
    "start/train/0001.png: the image has no alpha channel; masks are needed": lambda r: save_mode(r, "RGB"),
    "start/train/0001.png: the mask is empty": lambda r: save_mode(r, "RGBA", alpha=0),
    "end: every mask covers its whole image; masks are needed": all_opaque,
    "image 0003: 5 x 5 pixels, but image 0000 has 10 x 8": lambda r: picture().resize((5, 5)).save(r / "start/train/0003.png"),
}


@pytest.mark.parametrize("words", BROKEN)
def test_a_broken_capture_is_named_with_its_place(tmp_path, words):
    root = write_paris(tmp_path)
    BROKEN[words](root)
    with pytest.raises(CaptureError, match=words) as caught:
        load_capture(root)
    assert str(caught.value).startswith(str(tmp_path)), "the message begins with the file"
    assert "\n" not in str(caught.value)


def test_a_truncated_image_is_named(tmp_path):
    root = write_paris(tmp_path)
    file = root / "end" / "train" / "0000.png"
    file.write_bytes(file.read_bytes()[:-60])
    with pytest.raises(CaptureError, match=r"end/train/0000.png: this image cannot be read"):
        load_capture(root)


def test_a_folder_that_is_no_capture_says_what_is_expected(tmp_path):
    with pytest.raises(CaptureError, match=r"no capture here; expected start/camera_train.json"):
        load_capture(tmp_path)
    with pytest.raises(CaptureError, match="there is no such folder"):
        load_capture(tmp_path / "nowhere")


def test_farthest_points_take_the_outliers_before_the_crowd():
    crowd = np.random.default_rng(0).normal(scale=0.01, size=(20, 3))
    outliers = np.array([[5.0, 0, 0], [0, 4.0, 0], [0, 0, 3.0]])
    assert farthest_points(np.concatenate([crowd, outliers]), 4, first=7) == [7, 20, 21, 22]


@pytest.mark.parametrize("count", [5, 16])
def test_a_few_cameras_of_a_spiral_look_from_all_sides(count: int):
    cameras = orbit(make_object("laptop"), 40, RenderOptions(elevation_deg=(0.0, 60.0)))
    few = spread_cameras(cameras, count)
    assert len(set(few)) == count
    azimuths = np.sort([math.degrees(math.atan2(*cameras[i].centre[:2].tolist())) for i in few])
    assert np.diff(azimuths, append=azimuths[0] + 360).max() < 130
    assert spread_cameras(cameras[:3], count) == spread_cameras(cameras[:3], 3)


def test_a_subset_of_views_is_spread_seeded_and_leaves_the_test_views(tmp_path):
    root = write_paris(tmp_path, views=9)  # positions 0, 1, ..., 8 on a line
    capture = load_capture(root, views=3, seed=1)
    for views in capture.train:
        xs = [float(view.camera.centre[0]) for view in views]
        assert {0.0, 8.0} & set(xs), "the end farther from the first camera is always chosen"
        assert xs == sorted(xs)
        assert min(np.diff(xs)) >= 2
    assert [len(views) for views in capture.train + capture.test] == [3, 3, 9, 9]
    names = [[view.name for view in views] for views in capture.train]
    assert names == [[view.name for view in views] for views in load_capture(root, views=3, seed=1).train]
    assert any(names != [[v.name for v in views] for views in load_capture(root, views=3, seed=s).train] for s in range(2, 6))
    for count in (10, 2):
        with pytest.raises(CaptureError, match=f"{count} views were asked for; give a number from 3 to 9"):
            load_capture(root, views=count)


def view_of(rgba: np.ndarray) -> View:
    height, width = rgba.shape[:2]
    return View("v", Camera(SE3.identity(), 1.0, 1.0, 0.0, 0.0, width, height), rgba)


@pytest.mark.parametrize(("width", "height"), [(12, 8), (6, 4), (3, 2), (5, 3), (7, 8), (1, 1), (18, 20)])
def test_images_are_averaged_over_area_with_colours_weighted_by_alpha(width, height):
    rgba = np.random.default_rng(0).integers(0, 256, (8, 12, 4)).astype(np.uint8)
    rgb, alpha = view_of(rgba).image(width, height)
    # Another road: repeat every pixel until the new size divides the image, composite, take means of whole blocks.
    fine = np.kron(rgba / 255, np.ones((height, width, 1)))
    over_white = fine[..., :3] * fine[..., 3:] + (1 - fine[..., 3:])
    assert rgb == pytest.approx(over_white.reshape(height, 8, width, 12, 3).mean((1, 3)), abs=1e-5)
    assert alpha == pytest.approx(fine[..., 3].reshape(height, 8, width, 12).mean((1, 3)), abs=1e-5)


def test_colour_under_a_zero_mask_never_shows():
    rgba = np.zeros((2, 2, 4), np.uint8)
    rgba[..., :3] = 77  # garbage off the object
    rgba[0, 0] = (255, 0, 0, 255)
    rgb, alpha = view_of(rgba).image(1, 1)
    assert rgb[0, 0] == pytest.approx([1.0, 0.75, 0.75])  # a quarter red, the rest white
    assert alpha[0, 0] == pytest.approx(0.25)


def made_capture() -> Capture:
    """Two states of views with turned cameras, odd alpha values and depth."""
    rng = np.random.default_rng(3)

    def views(count: int) -> tuple[View, ...]:
        rows = []
        for i in range(count):
            pose = SE3.from_quat(torch.from_numpy(rng.normal(size=4)).float(), torch.from_numpy(rng.normal(size=3)).float())
            rgba = rng.integers(0, 256, (HEIGHT, WIDTH, 4)).astype(np.uint8)
            depth = rng.uniform(0, 5, (HEIGHT, WIDTH)).astype(np.float32)
            rows.append(View(f"{i:04d}", Camera(pose, 90.0, 95.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT), rgba, depth))
        return tuple(rows)

    return Capture("made", Path("made"), (views(3), views(4)), (views(1), views(2)), "memory")


@pytest.mark.parametrize("layout", ["paris", "artgs"])
def test_reading_gives_what_was_written(tmp_path, layout):
    made = made_capture()
    save_capture(made, tmp_path / "a", layout)
    read = load_capture(tmp_path / "a")
    assert read.layout == layout
    for ours, theirs in zip(made.train + made.test, read.train + read.test, strict=True):
        for a, b in zip(ours, theirs, strict=True):
            assert a.name == b.name
            np.testing.assert_array_equal(a.rgba, b.rgba)
            assert b.camera.T_world_camera.as_matrix().numpy() == pytest.approx(
                a.camera.T_world_camera.as_matrix().numpy(), abs=1e-6
            )
            assert [getattr(b.camera, k) for k in ("fx", "fy", "cx", "cy")] == pytest.approx([90, 95, WIDTH / 2, HEIGHT / 2])
            if layout == "artgs":
                assert b.depth == pytest.approx(a.depth, abs=0.0005001)
            else:
                assert b.depth is None


def test_a_layout_refuses_what_it_cannot_hold(tmp_path):
    made = made_capture()
    first, *rest = made.train[0]
    other_lens = replace(first, camera=replace(first.camera, fx=50.0))
    with pytest.raises(ValueError, match="2 different intrinsics"):
        save_capture(replace(made, train=((other_lens, *rest), made.train[1])), tmp_path, "paris")
    aside = tuple(replace(view, camera=replace(view.camera, cx=1.0)) for view in made.train[0])
    with pytest.raises(ValueError, match="principal point"):
        save_capture(replace(made, train=(aside, made.train[1])), tmp_path, "artgs")
    with pytest.raises(ValueError, match="beside a folder `load`"):
        save_truth(tmp_path, "paris", [], {})


def trans_record(kind: str, low: float, high: float) -> dict:
    return {"axis": {"o": [1.0, 0.0, 5.0], "d": [0.0, 0.0, 2.0]}, "type": kind, kind: {"l": low, "r": high}}


def test_true_joints_move_points_as_worked_out_by_hand(tmp_path):
    rows = [trans_record("rotate", 10, 100), trans_record("rotate", 30, -60), trans_record("translate", 0.25, -0.5)]
    (tmp_path / "trans.json").write_text(json.dumps({"trans_info": rows}))
    (tmp_path / "start").mkdir()
    for name in ("start_static_rotate.ply", "start_dynamic_0_rotate.ply", "start_dynamic_2_rotate.ply", "start_rotate.ply"):
        (tmp_path / "start" / name).touch()
    truth = load_truth(tmp_path)
    assert [joint.kind for joint in truth.joints] == ["revolute", "revolute", "prismatic"]
    point = torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64)
    # A quarter turn about the upright line through (1, 0), forward and back; three quarters of a unit down.
    for joint, moved in zip(truth.joints, ([1, 1, 0], [1, -1, 0], [2, 0, -0.75]), strict=True):
        assert joint.motion().apply(point).tolist() == pytest.approx(moved)
    assert {key: path.name for key, path in truth.meshes.items()} == {
        (0, 0): "start_static_rotate.ply",
        (0, 1): "start_dynamic_0_rotate.ply",
        (0, 3): "start_dynamic_2_rotate.ply",
    }


def test_a_single_true_joint_may_stand_without_a_list_or_a_number(tmp_path):
    (tmp_path / "textured_objs").mkdir()
    (tmp_path / "textured_objs" / "trans.json").write_text(json.dumps({"trans_info": trans_record("rotate", 0, 60)}))
    (tmp_path / "end").mkdir()
    (tmp_path / "end" / "end_dynamic_rotate.ply").touch()
    truth = load_truth(tmp_path)
    assert truth.joints[0].q1 == pytest.approx(math.pi / 3)
    assert truth.meshes == {(1, 1): tmp_path / "end" / "end_dynamic_rotate.ply"}


def test_a_broken_truth_is_named(tmp_path):
    with pytest.raises(CaptureError, match=r"trans.json: this file cannot be read"):
        load_truth(tmp_path)
    (tmp_path / "trans.json").write_text('{"trans_info": {"type": "spin"}}')
    with pytest.raises(CaptureError, match=r"trans.json: not a record of joints \(KeyError\('spin'\)"):
        load_truth(tmp_path)


@pytest.mark.parametrize(("layout", "folder"), [("paris", "load/set/box/1"), ("artgs", "box")])
@pytest.mark.parametrize("moving", [0, 1, 2])
def test_the_truth_lies_beside_its_capture(tmp_path, layout, folder, moving):
    root = tmp_path / folder
    save_capture(made_capture(), root, layout)
    assert find_truth(load_capture(root)) is None
    joints = [
        TrueJoint("revolute", (0.0, 0.6, 0.8), (1.0, 2.0, 3.0), 0.1, -0.7),
        TrueJoint("prismatic", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 2.0),
    ]
    meshes = {
        (state, part): TrueMesh(np.eye(3) * (1 + part) + state, np.array([[0, 1, 2]]))
        for state in (0, 1)
        for part in range(moving + 1)
    }
    written = save_truth(root, layout, joints[:moving], meshes)
    found = find_truth(load_capture(root))
    assert found == written
    assert found.is_relative_to(tmp_path / ("data" if layout == "paris" else "box/gt"))
    truth = load_truth(found)
    for ours, theirs in zip(joints[:moving], truth.joints, strict=True):
        assert ours.kind == theirs.kind
        assert (*theirs.axis, *theirs.origin, theirs.q0, theirs.q1) == pytest.approx(
            (*ours.axis, *ours.origin, ours.q0, ours.q1)
        )
    assert truth.meshes.keys() == meshes.keys()
    for key, path in truth.meshes.items():
        assert trimesh.load_mesh(path).vertices == pytest.approx(meshes[key].vertices)
    assert len(trimesh.load_mesh(found / "end" / "end_rotate.ply", process=False).faces) == moving + 1

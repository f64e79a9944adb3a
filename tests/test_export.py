import math
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from door_and_drawer import DOOR, DRAWER, made_of, photographed
from structuregs.export import draw_structure, render_sweep, sweep_values, telling_order, write_structure, write_sweep
from structuregs.export.overlay import Pen, colour_of, joint_strokes
from structuregs.geometry import SE3, Box, Camera
from structuregs.model import ArticulatedObject, Joint
from structuregs.raster import render


def looking(towards: str) -> Camera:
    """A camera four units before the origin, in the direction of a world axis."""
    R = {"+z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "+y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}[towards]
    R = torch.tensor(R, dtype=torch.float32)
    return Camera(SE3.from_rotation(R, -4 * R[:, 2]), 60.0, 60.0, 24.0, 20.0, 48, 40)


@pytest.fixture(scope="module")
def obj() -> ArticulatedObject:
    return made_of(DOOR.motion(), DRAWER.motion())


def test_a_sweep_starts_in_state_0_turns_in_state_1_and_comes_back_the_same_way(obj):
    values = np.array(sweep_values(obj.joints, 12))
    assert values[0].tolist() == [0, 0]
    assert np.allclose(values[6], [joint.q[1] for joint in obj.joints])
    assert np.allclose(values[1:], values[:0:-1])
    assert (np.diff(values[:7], axis=0) > 0).all()


def test_frames_show_the_object_at_its_joints_values(obj):
    frames = list(render_sweep(obj, looking("+y"), frames=4))
    for state, frame in ((0, frames[0]), (1, frames[2])):
        rgb = render(obj.parts.at_state(state), looking("+y")).rgb.clamp(0, 1).numpy()
        assert np.abs(frame / 255 - rgb).max() < 0.01
    assert np.abs(frames[0].astype(int) - frames[2]).max() > 50


@pytest.mark.parametrize("ending", [".webp", ".gif"])
def test_animations_hold_all_frames_and_play_for_ever(obj, tmp_path, ending):
    (file,) = write_sweep(obj, looking("+y"), tmp_path / f"sweep{ending}", frames=6)
    with Image.open(file) as image:
        assert (image.n_frames, image.size, image.info.get("loop")) == (6, (48, 40), 0)
    assert [p.name for p in tmp_path.iterdir()] == [file.name]


def test_a_film_shows_the_sweep_in_its_colours_and_comes_out_the_same_twice(obj, tmp_path):
    av = pytest.importorskip("av")
    camera = Camera(looking("+y").T_world_camera, 120.0, 120.0, 47.5, 40.5, 95, 81)
    files = [write_sweep(obj, camera, tmp_path / name, frames=6, seconds=0.5)[0] for name in ("a.mp4", "b.mp4")]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mp4", "b.mp4"]
    with av.open(files[0]) as film:
        stream = film.streams.video[0]
        assert (stream.average_rate, stream.duration * stream.time_base) == (12, 0.5)
        shown = [frame.to_ndarray(format="rgb24").astype(float) for frame in film.decode(video=0)]
    meant = [np.pad(frame, ((0, 1), (0, 1), (0, 0)), mode="edge") for frame in render_sweep(obj, camera, frames=6)]
    assert [frame.shape for frame in shown] == [(82, 96, 3)] * 6
    for frame, other in zip(shown, meant, strict=True):
        assert np.abs(frame.mean((0, 1)) - other.mean((0, 1))).max() < 2
        assert np.sqrt(((frame - other) ** 2).mean()) < 12


def test_a_film_without_its_extra_is_a_sentence_and_leaves_nothing(obj, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ValueError, match=r"sweep\.mp4: an \.mp4 needs the package av; install it with `pip install"):
        write_sweep(obj, looking("+y"), tmp_path / "sweep.mp4")
    assert not list(tmp_path.iterdir())


def test_stills_are_one_picture_or_a_folder(obj, tmp_path):
    write_sweep(obj, looking("+y"), tmp_path / "three.png")
    with Image.open(tmp_path / "three.png") as image:
        assert image.size == (3 * 48, 40)
    files = write_sweep(obj, looking("+y"), tmp_path / "stills", frames=5)
    assert sorted(p.name for p in (tmp_path / "stills").iterdir()) == [f"{i:04d}.png" for i in range(5)]
    assert len(files) == 5


def test_another_ending_is_a_sentence(obj, tmp_path):
    with pytest.raises(ValueError, match=r"sweep\.avi: a sweep is written as \.mp4, \.webp, \.gif, \.png or a folder"):
        write_sweep(obj, looking("+y"), tmp_path / "sweep.avi")


def test_the_telling_camera_sees_the_motion_and_not_along_it():
    """A part that slides along y by less than its own depth is seen to move from the z axis, hardly from the y axis."""
    sliding = made_of(SE3.exp(torch.tensor([0, 0.15, 0, 0, 0, 0], dtype=torch.float64)))
    assert telling_order(sliding, [looking("+y"), looking("+z")]) == [1, 0]


def test_a_slide_is_drawn_along_the_way_of_its_parts_centre():
    joint = Joint("prismatic", 0, (0.0, 1.0, 0.0), (1.0, 2.0, 3.0), (0.0, 0.5))
    line, *barbs = joint_strokes(joint, Box(SE3.identity(), torch.ones(3)))
    assert torch.allclose(line, torch.tensor([[1, 2, 3], [1, 2.5, 3]], dtype=torch.float64))
    assert all(torch.equal(barb[0], line[-1]) for barb in barbs)
    assert all(barb[1, 1] < 2.5 for barb in barbs)


def test_a_turn_is_drawn_as_its_axis_past_the_box_and_an_arc_of_its_angle():
    joint = Joint("revolute", 0, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, math.radians(70)))
    strokes = joint_strokes(joint, Box(SE3.identity(), torch.tensor([1.0, 0.5, 2.0])))
    line, arc = strokes[0], next(stroke for stroke in strokes if len(stroke) > 2)
    assert torch.allclose(line[:, :2], torch.tensor([[1.0, 0], [1, 0]], dtype=torch.float64))
    assert line[0, 2] < -2
    assert line[1, 2] > 2
    first, last = (arc[i] - torch.tensor([1.0, 0, 0], dtype=torch.float64) for i in (0, -1))
    turned = math.atan2(float(torch.linalg.cross(first, last)[2]), float(first[:2] @ last[:2]))
    assert turned == pytest.approx(math.radians(70))
    assert torch.allclose(arc[:, 2], arc[0, 2].expand(len(arc)))


def test_the_overview_shows_both_states_with_boxes_over_the_photos(obj, tmp_path):
    capture = photographed(obj)
    picture = draw_structure(capture, obj, columns=2, size=60)
    assert picture.width == 2 * 75
    assert picture.height > 2 * 60  # and the legend
    write_structure(capture, obj, tmp_path / "overview.png")
    assert [p.name for p in tmp_path.iterdir()] == ["overview.png"]
    pixels = np.asarray(picture)[-120:].reshape(-1, 3).astype(int)
    for part in (1, 2):
        assert (np.abs(pixels - np.array(colour_of(part))).max(1) < 12).any()


def test_lines_end_at_the_near_plane_and_are_not_mirrored():
    """A line from before the camera to behind it, all on its right, leaves the left half untouched."""
    picture = Image.new("RGB", (48, 40), "white")
    Pen(picture, looking("+z")).line(torch.tensor([[0.5, 0.0, 0.0], [0.5, 0.0, -9.0]]), (0, 0, 0), 1.0)
    dark = np.asarray(picture).min(2) < 255
    assert dark[:, 24:].any()
    assert not dark[:, :24].any()

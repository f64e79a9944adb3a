import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from door_and_drawer import CENTRES, DOOR, DRAWER, made_of, photographed
from structuregs.capture import TrueJoint, Truth
from structuregs.evaluate import (
    SURFACE_PROTOCOLS,
    evaluate_object,
    evaluate_run,
    match_joints,
    score_joints,
    score_surfaces,
    write_report,
)
from structuregs.evaluate.surfaces import seen_points
from structuregs.geometry import SE3, Screw
from structuregs.model import save_object


def turned(degrees: float, tilt_deg: float = 0.0, shift: float = 0.0) -> SE3:
    """The door's turn about an axis tilted in the xz plane and shifted along y."""
    a = math.radians(tilt_deg)
    axis = torch.tensor([math.sin(a), 0, math.cos(a)], dtype=torch.float64)
    return Screw("revolute", axis, torch.tensor([1.0, shift, 0], dtype=torch.float64)).motion(math.radians(degrees))


def test_parts_are_matched_by_their_motion_whatever_their_order():
    truth = Truth((DRAWER, DOOR), {})
    assert match_joints(made_of(DOOR.motion(), DRAWER.motion()), truth) == [1, 0]
    assert match_joints(made_of(DRAWER.motion(), DOOR.motion()), truth) == [0, 1]


def test_a_type_is_mistaken_only_where_no_assignment_gets_all_types_right():
    """Both parts turn, one almost as the drawer slides: the door keeps the better turn, the drawer fails."""
    scores = score_joints(made_of(turned(59), turned(20)), Truth((DRAWER, DOOR), {}))
    assert [score.part for score in scores] == [2, 1]
    assert [score.failed for score in scores] == [True, False]
    assert (scores[0].kind, scores[0].kind_true) == ("revolute", "prismatic")
    assert scores[0].axis_angle_deg is None


def test_errors_are_those_that_were_made():
    (score,) = score_joints(made_of(turned(61.5)), Truth((DOOR,), {}))
    assert score.geodesic_deg == pytest.approx(1.5, abs=1e-4)
    assert score.axis_angle_deg == pytest.approx(0, abs=1e-4)
    (score,) = score_joints(made_of(turned(60, tilt_deg=2)), Truth((DOOR,), {}))
    assert score.axis_angle_deg == pytest.approx(2, abs=1e-4)
    (score,) = score_joints(made_of(turned(60, shift=0.02)), Truth((DOOR,), {}))
    assert score.axis_position == pytest.approx(0.02, abs=1e-5)
    assert score.translation is None


def test_a_turn_the_other_way_is_seen():
    (score,) = score_joints(made_of(turned(-60)), Truth((DOOR,), {}))
    assert score.axis_angle_deg == pytest.approx(0, abs=1e-4)
    assert score.geodesic_deg == pytest.approx(120, abs=1e-3)


def test_a_slides_error_is_that_of_its_end():
    short = replace(DRAWER, q1=0.37)
    (score,) = score_joints(made_of(short.motion()), Truth((DRAWER,), {}))
    assert score.translation == pytest.approx(0.03, abs=1e-6)
    assert score.axis_position is None
    assert score.geodesic_deg is None


def test_a_truth_given_backwards_is_the_same_motion():
    """PARIS's files hold r - l < 0 for some objects; the opposite axis by the opposite amount is the same turn."""
    backwards = TrueJoint("revolute", (0.0, 0.0, -1.0), (1.0, 0.0, 5.0), math.radians(60), 0.0)
    (score,) = score_joints(made_of(DOOR.motion()), Truth((backwards,), {}))
    assert score.geodesic_deg == pytest.approx(0, abs=1e-4)
    assert score.axis_position == pytest.approx(0, abs=1e-6)


def test_missing_and_extra_parts_are_listed():
    obj = made_of(DOOR.motion())
    report = evaluate_object(obj, photographed(obj), Truth((DRAWER, DOOR), {}))
    assert [score.part for score in report.joints] == [None, 1]
    assert (report.joints[0].kind, report.joints[0].failed) == (None, True)
    assert report.failures == 1
    obj = made_of(DOOR.motion(), DRAWER.motion())
    report = evaluate_object(obj, photographed(obj), Truth((DRAWER,), {}))
    assert report.unmatched_parts == (1,)
    assert report.failures == 0


def test_parallel_drawers_are_told_apart_by_their_places(tmp_path):
    """Both slide alike but for their lengths; the true meshes say which is which."""
    obj = made_of(DRAWER.motion(), replace(DRAWER, q1=0.3).motion())
    meshes = {}
    for k, centre in ((1, CENTRES[2]), (2, CENTRES[1])):
        meshes[0, k] = tmp_path / f"{k}.ply"
        write_ply(meshes[0, k], np.array(centre) + np.array([[0.4, 0.1, 0.2], [-0.4, -0.1, -0.2], [0.4, -0.1, 0.2]]))
    assert match_joints(obj, Truth((DRAWER, replace(DRAWER, q1=0.3)), meshes)) == [1, 0]
    assert match_joints(obj, Truth((DRAWER, replace(DRAWER, q1=0.3)), {})) == [0, 1]


def write_ply(path, vertices):
    head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in vertices)
    path.write_text(head + "element face 1\nproperty list uchar int vertex_indices\nend_header\n" + rows + "3 0 1 2\n")


def test_psnr_of_the_objects_own_renderings_is_that_of_rounding():
    """Errors of rounding to bytes are uniform in +-1/510, so that their root mean square is 1 / (510 sqrt 3)."""
    obj = made_of(DOOR.motion())
    report = evaluate_object(obj, photographed(obj), None)
    expected = 20 * math.log10(510 * math.sqrt(3))
    assert report.psnr == pytest.approx(expected, abs=0.5)
    assert report.psnr_object == pytest.approx(expected, abs=0.5)
    assert report.joints == ()


def test_psnr_looks_at_each_state_in_its_own_place():
    """With the states' test views exchanged, both states are wrong."""
    obj = made_of(DOOR.motion())
    capture = photographed(obj)
    wrong = evaluate_object(obj, replace(capture, test=(capture.test[1], capture.test[0])), None)
    assert all(value is not None and value < 25 for value in wrong.psnr_by_state)


def test_psnr_is_a_mean_over_images_not_over_states():
    obj = made_of(DOOR.motion())
    capture = photographed(obj, views=3)
    dark = replace(capture.test[1][0], rgba=capture.test[0][0].rgba * np.array([0, 0, 0, 1], np.uint8))
    report = evaluate_object(obj, replace(capture, test=(capture.test[0], (dark,))), None)
    a, b = report.psnr_by_state
    assert report.psnr == pytest.approx((3 * a + b) / 4)
    none = evaluate_object(obj, replace(capture, test=((), ())), None)
    assert none.psnr is None


def test_protocols_differ_where_they_say():
    obj = made_of(DOOR.motion())
    capture = photographed(obj)
    rows = {name: evaluate_object(obj, capture, Truth((DOOR,), {}), protocol=name) for name in ("paris", "artgs", "strict")}
    assert rows["paris"].joints == rows["artgs"].joints == rows["strict"].joints
    assert rows["paris"].psnr_object is None
    assert rows["strict"].psnr_object is not None
    with pytest.raises(ValueError, match="give one of paris, artgs, strict"):
        evaluate_object(obj, capture, None, protocol="lenient")


def test_json_of_a_report(tmp_path):
    obj = made_of(DOOR.motion())
    report = evaluate_object(obj, photographed(obj), Truth((DOOR, DRAWER), {}), protocol="paris", seconds=12.5)
    write_report(report, tmp_path / "new" / "report.json")
    record = json.loads((tmp_path / "new" / "report.json").read_text())
    assert record["protocol"] == "paris"
    assert record["seconds"] == 12.5
    assert record["joints"][1]["failed"] is True
    assert set(record["joints"][0]) == {
        "part",
        "kind",
        "kind_true",
        "failed",
        "axis_angle_deg",
        "axis_position",
        "geodesic_deg",
        "translation",
    }


def test_a_folder_that_is_no_run_is_a_sentence(tmp_path):
    with pytest.raises(ValueError, match="run `structuregs fit` first"):
        evaluate_run(tmp_path)
    save_object(made_of(DOOR.motion()), tmp_path / "object")
    with pytest.raises(ValueError, match=r"config\.json is missing"):
        evaluate_run(tmp_path)


def boxes_of(obj, k: int, lift: float = 0.0) -> trimesh.Trimesh:
    """The box of part k as a mesh, raised."""
    box = obj.parts.boxes[k]
    pose = box.T_world_box.as_matrix().numpy()
    mesh = trimesh.creation.box(2 * box.half_extents.numpy(), pose)
    return mesh.apply_translation([0, 0, lift])


def truth_with_meshes(folder, obj, *joints: TrueJoint) -> Truth:
    """True meshes that are the parts' boxes, moved by the true joints."""
    files = {}
    for state in (0, 1):
        for k in range(len(joints) + 1):
            mesh = boxes_of(obj, k)
            if state and k:
                mesh.apply_transform(joints[k - 1].motion().as_matrix().numpy())
            files[state, k] = folder / f"{state}_{k}.ply"
            mesh.export(files[state, k])
    return Truth(joints, files)


def test_surfaces_that_are_the_true_ones_leave_what_sampling_leaves(tmp_path):
    """Two samples of one area A: mean squares of A / (pi P) both ways."""
    obj = made_of(DOOR.motion(), DRAWER.motion())
    truth = truth_with_meshes(tmp_path, obj, DOOR, DRAWER)
    meshes = [boxes_of(obj, k) for k in range(3)]
    for name, points in (("paris", 10_000), ("artgs", 10_000)):
        score = score_surfaces(meshes, obj, truth, [1, 2], SURFACE_PROTOCOLS[name])
        assert score.cd_static == pytest.approx(2000 * meshes[0].area / (math.pi * points), rel=0.1)
        assert score.cd_movable == pytest.approx(2000 * meshes[1].area / (math.pi * points), rel=0.1)
        assert score.accuracy is None


def test_a_surface_in_the_wrong_place_is_measured_in_every_state(tmp_path):
    obj = made_of(DOOR.motion())
    truth = truth_with_meshes(tmp_path, obj, DOOR)
    right = score_surfaces([boxes_of(obj, 0), boxes_of(obj, 1)], obj, truth, [1], SURFACE_PROTOCOLS["artgs"])
    moved = score_surfaces([boxes_of(obj, 0), boxes_of(obj, 1, lift=2)], obj, truth, [1], SURFACE_PROTOCOLS["artgs"])
    assert moved.cd_static == right.cd_static
    assert moved.cd_movable > 2 * 1000 * 1.6**2
    still = replace(obj, joints=tuple(replace(joint, q=(0.0, 0.0)) for joint in obj.joints))
    stays = score_surfaces([boxes_of(obj, 0), boxes_of(obj, 1)], still, truth, [1], SURFACE_PROTOCOLS["artgs"])
    assert stays.cd_movable > 10 * right.cd_movable
    start = score_surfaces([boxes_of(obj, 0), boxes_of(obj, 1)], still, truth, [1], SURFACE_PROTOCOLS["paris"])
    assert start.cd_movable == pytest.approx(right.cd_movable, rel=0.2)


def test_a_part_that_was_not_found_has_no_movable_figure(tmp_path):
    obj = made_of(DOOR.motion())
    meshes = [boxes_of(obj, 0), boxes_of(obj, 1)]
    truth = truth_with_meshes(tmp_path, made_of(DOOR.motion(), DRAWER.motion()), DOOR, DRAWER)
    score = score_surfaces(meshes, obj, truth, [1, None], SURFACE_PROTOCOLS["paris"])
    assert score.cd_movable is None
    assert score.cd_whole > 0


def test_without_true_meshes_there_are_no_surface_figures():
    obj = made_of(DOOR.motion())
    report = evaluate_object(obj, photographed(obj), Truth((DOOR,), {}), meshes=[boxes_of(obj, 0), boxes_of(obj, 1)])
    assert report.surfaces is None
    assert report.as_json()["cd_whole"] is None


def test_a_report_holds_the_surfaces_figures(tmp_path):
    obj = made_of(DOOR.motion())
    truth = truth_with_meshes(tmp_path, obj, DOOR)
    meshes = [boxes_of(obj, 0), boxes_of(obj, 1)]
    record = evaluate_object(obj, photographed(obj), truth, protocol="paris", meshes=meshes).as_json()
    assert 0 < record["cd_movable"] < record["cd_static"] < 1.2
    assert record["completeness"] is None


def test_what_no_camera_sees_is_not_asked_for():
    """A camera below sees the underside of a plate and not its upper side; completeness asks for the former only."""
    obj = made_of(DOOR.motion())
    view = photographed(obj).train[0][0]
    x, y = np.meshgrid(np.linspace(-1, 1, 200), np.linspace(-1, 1, 200))
    sheets = [np.stack([x, y, np.full_like(x, z)], -1).reshape(-1, 3) for z in (-0.3, 0.3)]
    seen = seen_points(np.concatenate(sheets), [view])
    inside = np.abs(sheets[0][:, :2]).max(1) < 0.7
    assert seen[: len(sheets[0])][inside].all()
    assert not seen[len(sheets[0]) :][inside].any()

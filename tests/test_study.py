import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.spatial import KDTree

from structuregs.boxes import CueConfig, clusters, survey
from structuregs.capture import Capture, Truth
from structuregs.evaluate import Setting, Study
from structuregs.evaluate.robustness import perturbed_points
from structuregs.export.chart import curves_chart
from structuregs.export.overlay import draw_error_maps
from structuregs.fit.events import Finished, Preview
from structuregs.fit.schedule import PRESETS
from structuregs.geometry import Box
from structuregs.model import ArticulatedObject
from structuregs.synthetic import make_object
from test_reconstruct import TINY, photographed

SHORT = replace(TINY, steps=60, sizes=((0.0, 48),), checkpoint_every=30, join_at=1.0)


@pytest.fixture(scope="module")
def slider() -> Capture:
    return photographed("slider")


@pytest.fixture(scope="module")
def study(slider: Capture, tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, list[Setting], ArticulatedObject]:
    """Two starts fitted, of the ten that it offers."""
    plan = Study("robustness", slider, tmp_path_factory.mktemp("study"), SHORT, "cpu")
    settings = plan.settings()
    chosen = [setting for setting in settings if setting.name in ("default", "noise_1")]
    obj = None
    for setting in chosen:
        for event in plan.events(setting):
            if isinstance(event, Finished) and setting.name == "default":
                obj = event.obj
    assert obj is not None
    return plan, chosen, obj


def test_perturbed_points_are_what_their_names_say(slider: Capture):
    looks = survey(slider, None, TINY.start, seed=0)
    cue = CueConfig()
    voxel = looks[0].hull.voxel
    rows = perturbed_points(looks, cue, seed=0)
    for n in (1, 2):
        moved = rows[f"noise_{n}"][0] - looks[0].points
        assert moved.std() == pytest.approx(n * voxel, rel=0.05)
    for state, look in enumerate(looks):
        shell = rows["hull_surface"][state]
        assert (look.hull.sample(look.hull.occupied.astype(float), shell, outside=0.0) == 1).all()
        moving = np.concatenate([c.points for c in clusters(looks, cue) if c.state == state] or [np.zeros((0, 3))])
        kept = rows["lopsided"][state]
        lost = len(look.points) - len(kept)
        assert lost == pytest.approx(0.75 * len(moving), abs=3)
        assert KDTree(look.points).query(kept)[0].max() == 0
    again = perturbed_points(looks, cue, seed=0)
    assert all(np.array_equal(again[name][s], rows[name][s]) for name in rows for s in (0, 1))


class TestStudy:
    def test_its_starts_differ_in_threshold_or_points(self, study):
        plan, _, _ = study
        settings = plan.settings()
        assert settings[0] == Setting("default", "as it is", SHORT)
        assert len({(s.config.start.search.cue.threshold, s.points) for s in settings}) == len(settings) == 10
        assert all(Path(s.points).is_file() for s in settings if s.points not in ("hull", "depth"))

    def test_its_fits_draw_the_boxes_from_the_start_to_the_end_and_are_not_done_twice(self, study):
        plan, chosen, _ = study
        for setting in chosen:
            names = [file.name for file in sorted(plan.run(setting).glob("boxes_*.png"))]
            assert names[0] == "boxes_00000.png"
            assert names[-1] == "boxes_00060.png"
            assert not any(isinstance(event, Preview) for event in plan.events(setting))

    def test_writes_a_row_and_a_curve_for_each_start(self, study):
        plan, chosen, _ = study
        files = plan.write(chosen, Truth(make_object("slider").joints, {}))
        table = [line.split(" | ") for line in files[0].read_text().splitlines() if line.startswith("| ")]
        assert [row[0].strip("| ") for row in table[2:]] == ["as it is", "Gaussian noise of 1 voxel on the points"]
        assert table[2][-1].strip("| ") in ("yes", "**no**")
        page = files[1].read_text()
        assert page.count("<polyline") == 2
        assert page.count("<img") == 1 + sum(len(list(plan.run(s).glob("boxes_*.png"))) for s in chosen)
        assert files[2].is_file()

    def test_without_truth_no_verdict_is_given(self, study):
        plan, chosen, _ = study
        rows = [line for line in plan.write(chosen, None)[0].read_text().splitlines() if line.startswith("| as")]
        assert rows[0].split(" | ")[2] == "-"
        assert rows[0].endswith("- |")


class TestAblation:
    def test_every_choice_undone_is_another_fit(self, slider: Capture, tmp_path: Path):
        settings = Study("ablation", slider, tmp_path, PRESETS["default"]).settings()
        assert settings[0].config == PRESETS["default"]
        assert all(a.config != b.config for i, a in enumerate(settings) for b in settings[:i])
        assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def photos(slider: Capture, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Capture]:
    settings = Study("variations", slider, tmp_path_factory.mktemp("study"), SHORT).settings()
    return {setting.name: setting.photos(slider) for setting in settings}


class TestVariations:
    def test_the_photos_held_out_are_never_changed(self, slider: Capture, photos: dict[str, Capture]):
        assert all(changed.test == slider.test for changed in photos.values())
        assert photos["default"] is slider

    def test_half_the_size_is_the_same_picture(self, slider: Capture, photos: dict[str, Capture]):
        for whole, half in zip(slider.train[0], photos["half_size"].train[0], strict=True):
            size = (whole.camera.width // 2, whole.camera.height // 2)
            assert half.rgba.shape[:2] == size[::-1]
            for a, b in zip(whole.image(*size), half.image(*size), strict=True):
                np.testing.assert_allclose(a, b, atol=0.01)
            torch.testing.assert_close(
                half.camera.project(whole.camera.centre + 1)[0] * 2, whole.camera.project(whole.camera.centre + 1)[0]
            )

    def test_masks_are_off_by_two_pixels_on_all_sides(self, slider: Capture, photos: dict[str, Capture]):
        for before, less, more in zip(
            *(c.train[1] for c in (slider, photos["masks_eroded"], photos["masks_dilated"])), strict=True
        ):
            inside, kept, added = (view.rgba[..., 3] > 127 for view in (before, less, more))
            padded = np.pad(inside, 1)
            np.testing.assert_array_equal(kept, ndimage.distance_transform_cdt(padded, "chessboard")[1:-1, 1:-1] > 2)
            np.testing.assert_array_equal(added, ndimage.distance_transform_cdt(~inside, "chessboard") <= 2)

    def test_noise_has_its_deviation_and_leaves_the_masks(self, slider: Capture, photos: dict[str, Capture]):
        before, after = (np.stack([view.rgba for view in c.train[0]]).astype(float) for c in (slider, photos["noise"]))
        assert np.array_equal(before[..., 3], after[..., 3])
        middling = (before[..., :3] > 60) & (before[..., :3] < 195)
        assert (after - before)[..., :3][middling].std() / 255 == pytest.approx(0.05, rel=0.05)

    def test_cameras_turn_about_their_own_centres(self, slider: Capture, photos: dict[str, Capture]):
        for before, after in zip(slider.train[0], photos["cameras_astray"].train[0], strict=True):
            turn = before.camera.T_world_camera.inverse() @ after.camera.T_world_camera
            assert float(torch.rad2deg(turn.angle)) == pytest.approx(0.5, abs=1e-3)
            torch.testing.assert_close(before.camera.centre, after.camera.centre)

    def test_photos_lie_a_pixel_beside_where_cameras_show_a_point(self, slider: Capture, photos: dict[str, Capture]):
        for before, after in zip(slider.train[1], photos["off_centre"].train[1], strict=True):
            point = before.camera.T_world_camera.apply(torch.tensor([0.1, 0.2, 2.0]))
            shown, said = (view.camera.project(point)[0] for view in (before, after))
            torch.testing.assert_close(shown - said, torch.tensor([1.0, -1.0]), atol=1e-4, rtol=0)

    def test_only_state_1_is_in_another_light(self, slider: Capture, photos: dict[str, Capture]):
        assert photos["warmer"].train[0] == slider.train[0]
        before, after = (c.train[1][0].rgba.astype(float) for c in (slider, photos["warmer"]))
        bright = (before[..., :3].max(-1) < 220) & (before[..., :3].min(-1) > 60)
        np.testing.assert_allclose((after / np.maximum(before, 1))[bright].mean(0), (1.1, 1.0, 0.9, 1.0), atol=0.01)

    def test_one_side_is_where_the_motion_is(self, slider: Capture, photos: dict[str, Capture]):
        obj = make_object("slider")
        middle, moving = obj.bounding_sphere()[0], obj.parts[1].boxes[0].box.T_world_box.xyz
        towards = moving - torch.tensor(middle, dtype=torch.float64)
        sides = {
            name: np.mean([float((view.camera.centre - torch.tensor(middle)).double() @ towards) for view in c.train[0]])
            for name, c in (("all", slider), ("side", photos["one_side"]))
        }
        assert len(photos["one_side"].train[0]) == len(slider.train[0]) // 2
        assert sides["side"] > sides["all"]


def test_error_maps_show_in_red_what_no_box_covers(slider: Capture, study):
    _, _, obj = study
    small = replace(obj.parts, boxes=Box(obj.parts.boxes.T_world_box, 0.3 * obj.parts.boxes.half_extents))
    shares = []
    for parts in (obj.parts, small):
        picture = np.asarray(draw_error_maps(slider, replace(obj, parts=parts), size=64)).astype(int)
        shares.append(((picture[..., 0] > 200) & (picture[..., 1] < 120) & (picture[..., 2] < 120)).mean())
    assert shares[0] < 0.02
    assert shares[1] > 3 * shares[0] + 0.02


def test_curves_of_one_chart_share_its_axes():
    """Two straight lines, the one twice as steep as the other: so they must be drawn."""
    curves = {name: [(float(x), slope * x) for x in range(11)] for name, slope in (("a", 1.0), ("b & c", 2.0))}
    svg = curves_chart(curves, x_label="step", y_label="Loss")
    lines = [np.array([tuple(map(float, p.split(","))) for p in line.split()]) for line in re.findall(r'points="([^"]+)"', svg)]
    rises = [line[0, 1] - line[-1, 1] for line in lines]
    assert rises[1] == pytest.approx(2 * rises[0], abs=0.3)
    assert np.allclose(lines[0][:, 0], lines[1][:, 0])
    assert "b &amp; c</text>" in svg

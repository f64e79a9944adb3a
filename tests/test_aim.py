"""Cameras that point beside what their photos show."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from door_and_drawer import DOOR, DRAWER, made_of
from structuregs.capture import Capture, View, stack_views
from structuregs.fit.aim import beside, misaim, offset_gradient, with_coverage
from structuregs.fit.events import Note
from structuregs.fit.loop import Fitter
from structuregs.fit.run import RunFolder
from structuregs.fit.schedule import FitConfig, Growth, Rates
from structuregs.fit.state import FitState
from structuregs.geometry import SE3, Camera
from structuregs.raster import image_loss, render

OBJECT = made_of(DOOR.motion(), DRAWER.motion())
LENS = (200.0, 190.0, 52.0, 43.0, 100, 84)
BESIDE_DEG = 0.6
CENTRED = torch.zeros(2)
STILL = Rates(*[0.0] * 8, principal_point=0.0)  # only turns move
OFFSET = torch.tensor([0.004, -0.007])  # focal lengths: .8 and -1.3 pixels


def cameras(count: int) -> list[Camera]:
    """In a half circle around the object, 4 units away, looking at it."""
    rows = []
    for k in range(count):
        turn = SE3.exp(torch.tensor([0.0, 0, 0, 0, math.pi * k / count, 0]))
        rows.append(Camera(turn @ SE3.exp(torch.tensor([0.0, 0, -4, 0, 0, 0])), *LENS))
    return rows


def turns_of(count: int, seed: int) -> Tensor:
    """Rotation vectors of one length each."""
    generator = torch.Generator().manual_seed(seed)
    return math.radians(BESIDE_DEG) * torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)


def photographed_by(true: list[Camera], turns: list[Tensor], offset: Tensor = CENTRED) -> Capture:
    """Photos by the true cameras, said to be by cameras from which turns (of either state) and the offset lead back there."""
    states = []
    for state in (0, 1):
        views = []
        for k, (camera, turn) in enumerate(zip(true, turns[state], strict=True)):
            image = render(OBJECT.parts.at_state(state), camera)
            straight = (image.rgb - (1 - image.alpha[..., None])) / image.alpha[..., None].clamp(min=1e-3)
            rgba = (255 * torch.cat([straight, image.alpha[..., None]], -1).clamp(0, 1)).round().byte().numpy()
            views.append(View(f"{k:04d}", camera.turned(-turn).shifted(-offset), rgba))
        states.append(tuple(views))
    return Capture("made", Path("made"), (states[0], states[1]), ((), ()), "memory")


def drawn(camera: Camera) -> Tensor:
    image = render(OBJECT.parts.at_state(0), camera)
    return with_coverage(image.rgb, image.alpha)


@pytest.mark.parametrize("axis", range(3))
def test_a_turned_camera_is_told_by_how_much(axis: int):
    """Near the truth the first order is all there is."""
    (camera,) = cameras(1)
    turn = math.radians(0.2) * torch.eye(3)[axis]
    torch.testing.assert_close(misaim(drawn(camera), drawn(camera.turned(turn)), camera), turn, atol=3e-4, rtol=0)


def test_taking_it_again_and_again_leads_there():
    (camera,) = cameras(1)
    photo, turn = drawn(camera), turns_of(1, 3)[0]
    astray = camera.turned(-turn)
    for _ in range(6):
        astray = astray.turned(misaim(drawn(astray), photo, astray))
    torch.testing.assert_close(astray.T_world_camera.rotation, camera.T_world_camera.rotation, atol=2e-5, rtol=0)


def test_a_picture_that_is_empty_asks_for_no_turn():
    (camera,) = cameras(1)
    white = torch.ones(camera.height, camera.width, 4)
    assert misaim(white, white, camera).tolist() == [0, 0, 0]


def test_photos_lie_beside_by_the_pixels_that_the_turns_make():
    """Of turns of one length in random directions, what is across the line of sight is about four fifths."""
    capture = photographed_by(cameras(8), [turns_of(8, 0), turns_of(8, 1)])
    across = torch.cat([turns_of(8, 0), turns_of(8, 1)])[:, :2].norm(dim=-1).median() * LENS[0]
    stacks = [stack_views(views, 1000) for views in capture.train]
    assert beside(OBJECT.parts, stacks) == pytest.approx(float(across), rel=0.15)
    right = photographed_by(cameras(8), [torch.zeros(8, 3)] * 2)
    assert beside(OBJECT.parts, [stack_views(views, 1000) for views in right.train]) < 0.01


def fitter(capture: Capture, rates: Rates = STILL) -> Fitter:
    config = FitConfig(
        steps=60, structure_until=4, image_from=4, structure_size=24, sizes=((0.0, 100),), join_at=2.0, square_at=(),
        one_joint_from=1.0, rates=rates, growth=Growth(interval=1000),
    )  # fmt: skip
    return Fitter(capture, config, FitState.start(OBJECT.parts), 0, torch.device("cpu"))


def test_the_fit_turns_cameras_back_and_goes_on_where_it_was(tmp_path: Path):
    turns = [turns_of(3, 0), turns_of(3, 1)]
    fit = fitter(photographed_by(cameras(3), turns))
    notes = [event.text for event in fit.run(30) if isinstance(event, Note)]
    assert len(notes) == 1
    assert notes[0].startswith("photos lie ")
    fit.state.save(tmp_path / "last.pt")
    other = Fitter(fit.capture, fit.config, FitState.load(tmp_path / "last.pt"), 0, torch.device("cpu"))
    for one in (fit, other):
        list(one.run(60))
        assert one.state.turns is not None
    for found, again, turn in zip(fit.state.turns or (), other.state.turns or (), turns, strict=True):
        torch.testing.assert_close(found, turn, atol=math.radians(0.02), rtol=0)
        assert torch.equal(found, again)


def test_cameras_that_are_right_stay():
    fit = fitter(photographed_by(cameras(3), [torch.zeros(3, 3)] * 2))
    assert not [event for event in fit.run(30) if isinstance(event, Note)]
    assert fit.state.turns is None


def test_the_gradient_of_the_principal_point_is_that_of_finite_differences():
    (camera,) = cameras(1)
    photo = render(OBJECT.parts.at_state(0), camera.shifted(OFFSET))

    def loss_at(offset: Tensor) -> tuple[Tensor, Tensor]:
        splats = OBJECT.parts.at_state(0)
        shifted = camera.shifted(offset)
        picture = render(replace(splats, means=splats.means.clone().requires_grad_()), shifted)
        picture.projection.xy.retain_grad()
        loss = image_loss(picture.rgb, picture.alpha, photo.rgb, photo.alpha, ssim_weight=0.2, alpha_weight=0.5)
        loss.backward()
        return loss.detach(), offset_gradient(picture, shifted)

    _, gradient = loss_at(CENTRED)
    for axis in (0, 1):
        step = 2e-4 * torch.eye(2)[axis]
        slope = (loss_at(step)[0] - loss_at(-step)[0]) / 4e-4
        torch.testing.assert_close(gradient[axis], slope, rtol=0.03, atol=1e-4)


def test_a_picture_without_gradients_is_named():
    (camera,) = cameras(1)
    with pytest.raises(ValueError, match="no gradients of where splats lie"):
        offset_gradient(render(OBJECT.parts.at_state(0), camera), camera)


def test_the_fit_finds_the_principal_point_and_goes_on_where_it_was(tmp_path: Path):
    capture = photographed_by(cameras(3), [torch.zeros(3, 3)] * 2, OFFSET)
    fit = fitter(capture, replace(STILL, principal_point=1e-3))
    fit.config = replace(fit.config, aim_at=1.0, steps=160)
    list(fit.run(80))
    fit.state.save(tmp_path / "last.pt")
    other = Fitter(capture, fit.config, FitState.load(tmp_path / "last.pt"), 0, torch.device("cpu"))
    for one in (fit, other):
        list(one.run(160))
    torch.testing.assert_close(fit.state.offset.detach(), OFFSET, atol=3e-4, rtol=0)
    assert torch.equal(fit.state.offset, other.state.offset)


def test_a_principal_point_that_is_right_stays():
    fit = fitter(photographed_by(cameras(3), [torch.zeros(3, 3)] * 2), replace(STILL, principal_point=1e-4))
    list(fit.run(60))
    assert fit.state.offset.abs().max() * LENS[0] < 0.02, "pixels"


class TestKept:
    def kept(self, root: Path) -> tuple[RunFolder, Capture, list[Tensor]]:
        turns = [turns_of(3, 0), turns_of(3, 1)]
        folder, capture = RunFolder(root), photographed_by(cameras(3), turns)
        folder.keep_cameras(CENTRED, turns, capture)
        return folder, capture, turns

    def test_a_principal_point_is_that_of_test_views_too(self, tmp_path: Path):
        folder, capture = RunFolder(tmp_path), photographed_by(cameras(3), [torch.zeros(3, 3)] * 2, OFFSET)
        capture = replace(capture, test=capture.train)
        folder.keep_cameras(OFFSET, None, capture)
        right = folder.put_right(capture)
        for view, camera in zip([*right.train[0], *right.test[1]], cameras(3) * 2, strict=True):
            assert (view.camera.cx, view.camera.cy) == pytest.approx((camera.cx, camera.cy))
        assert folder.notes.read_text().startswith("all photos lie 0.80 pixels right of and 1.33 above what")
        folder.notes.unlink()
        folder.keep_cameras(OFFSET / 10, None, capture)
        assert not folder.notes.exists()

    def test_a_run_gives_its_capture_back_with_the_cameras_put_right(self, tmp_path: Path):
        folder, capture, _ = self.kept(tmp_path)
        for views in folder.put_right(capture).train:
            for view, camera in zip(views, cameras(3), strict=True):
                torch.testing.assert_close(
                    view.camera.T_world_camera.as_matrix(), camera.T_world_camera.as_matrix(), atol=1e-6, rtol=0
                )
        assert RunFolder(tmp_path / "another").put_right(capture) is capture

    def test_the_notes_say_so_once(self, tmp_path: Path):
        folder, capture, turns = self.kept(tmp_path)
        folder.keep_cameras(CENTRED, turns, capture)
        assert folder.notes.read_text() == "cameras pointed 0.60 degrees beside their photos (median) and were turned\n"

    @pytest.mark.parametrize(
        "damage", ["", "[]", '{"principal_point": [1]}', '{"principal_point": [0, 0], "turns": [{"0000": [1, 2]}, {}]}']
    )
    def test_a_damaged_record_is_named(self, tmp_path: Path, damage: str):
        folder, capture, _ = self.kept(tmp_path)
        folder.cameras.write_text(damage)
        with pytest.raises(ValueError, match=r"cameras\.json: does not say how this capture's cameras are .*; fit again\.$"):
            folder.put_right(capture)

    def test_the_record_names_every_photo(self, tmp_path: Path):
        folder, _, turns = self.kept(tmp_path)
        record = json.loads(folder.cameras.read_text())["turns"]
        assert [sorted(state) for state in record] == [["0000", "0001", "0002"]] * 2
        assert torch.tensor(record[1]["0002"]) == pytest.approx(turns[1][2])

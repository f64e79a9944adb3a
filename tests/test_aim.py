"""Cameras that point beside what their photos show."""

import json
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from door_and_drawer import DOOR, DRAWER, made_of
from structuregs.capture import Capture, View, stack_views
from structuregs.fit.aim import beside, misaim, with_coverage
from structuregs.fit.events import Note
from structuregs.fit.loop import FitState, Fitter
from structuregs.fit.run import RunFolder
from structuregs.fit.schedule import FitConfig, Growth, Rates
from structuregs.geometry import SE3, Camera
from structuregs.raster import render

OBJECT = made_of(DOOR.motion(), DRAWER.motion())
LENS = (200.0, 190.0, 52.0, 43.0, 100, 84)
BESIDE_DEG = 0.6
STILL = Rates(*[0.0] * 8)  # only cameras move


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


def photographed_by(true: list[Camera], turns: list[Tensor]) -> Capture:
    """Photos by the true cameras, said to be by cameras from which the turns (of either state) lead back to those."""
    states = []
    for state in (0, 1):
        views = []
        for k, (camera, turn) in enumerate(zip(true, turns[state], strict=True)):
            image = render(OBJECT.parts.at_state(state), camera)
            straight = (image.rgb - (1 - image.alpha[..., None])) / image.alpha[..., None].clamp(min=1e-3)
            rgba = (255 * torch.cat([straight, image.alpha[..., None]], -1).clamp(0, 1)).round().byte().numpy()
            views.append(View(f"{k:04d}", camera.turned(-turn), rgba))
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


def fitter(capture: Capture) -> Fitter:
    config = FitConfig(
        steps=60, structure_until=4, image_from=4, structure_size=24, sizes=((0.0, 100),), join_at=2.0, square_at=(),
        one_joint_from=1.0, rates=STILL, growth=Growth(interval=1000),
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


class TestKept:
    def kept(self, root: Path) -> tuple[RunFolder, Capture, list[Tensor]]:
        turns = [turns_of(3, 0), turns_of(3, 1)]
        folder, capture = RunFolder(root), photographed_by(cameras(3), turns)
        folder.keep_turns(turns, capture)
        return folder, capture, turns

    def test_a_run_gives_its_capture_back_with_the_cameras_put_right(self, tmp_path: Path):
        folder, capture, _ = self.kept(tmp_path)
        for views in folder.turned(capture).train:
            for view, camera in zip(views, cameras(3), strict=True):
                torch.testing.assert_close(
                    view.camera.T_world_camera.as_matrix(), camera.T_world_camera.as_matrix(), atol=1e-6, rtol=0
                )
        assert RunFolder(tmp_path / "another").turned(capture) is capture

    def test_the_notes_say_so_once(self, tmp_path: Path):
        folder, capture, turns = self.kept(tmp_path)
        folder.keep_turns(turns, capture)
        assert folder.notes.read_text() == "cameras pointed 0.60 degrees beside their photos (median) and were turned\n"

    @pytest.mark.parametrize("damage", ["", "[]", '{"turns": [{}, {}]}', '{"turns": [{"0000": [1, 2]}, {}]}'])
    def test_a_damaged_record_is_named(self, tmp_path: Path, damage: str):
        folder, capture, _ = self.kept(tmp_path)
        folder.cameras.write_text(damage)
        with pytest.raises(ValueError, match=r"cameras\.json: not the turns of this capture's cameras .*; fit again\.$"):
            folder.turned(capture)

    def test_the_record_names_every_photo(self, tmp_path: Path):
        folder, _, turns = self.kept(tmp_path)
        record = json.loads(folder.cameras.read_text())["turns"]
        assert [sorted(state) for state in record] == [["0000", "0001", "0002"]] * 2
        assert torch.tensor(record[1]["0002"]) == pytest.approx(turns[1][2])

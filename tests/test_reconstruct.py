import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from door_and_drawer import made_of
from structuregs.boxes import SearchConfig, StartConfig
from structuregs.boxes.appearance import AppearanceConfig
from structuregs.capture import Capture, TrueJoint, load_capture
from structuregs.fit.events import Finished, FitEvent, Note, StageStarted, Step
from structuregs.fit.reconstruct import fit_run, reconstruct
from structuregs.fit.run import RunFolder
from structuregs.fit.schedule import FitConfig, Growth
from structuregs.fit.state import FitState
from structuregs.geometry import SE3
from structuregs.model import ArticulatedObject, Joint, load_object
from structuregs.synthetic import RenderOptions, make_capture, make_object, save_known

TINY = FitConfig(
    steps=150,
    splats_per_part=400,
    structure_until=20,
    loose_until=20,
    image_from=20,
    structure_size=48,
    sizes=((0.0, 48), (0.5, 64)),
    checkpoint_every=40,
    start=StartConfig(
        voxels=48,
        mask_size=96,
        appearance=AppearanceConfig(size=64, steps=120, splats=2000, looks=12),
        search=SearchConfig(shortlist=20, finalists=3, looks=6, steps=25),
    ),
    growth=Growth(interval=30, most=3000),
)
AIMING = replace(TINY, steps=100, aim_at=0.3)  # when so few steps have made a picture
RESULTS = ("object/splats.safetensors", "object/object.json", "metrics.jsonl")


def photographed(name: str) -> Capture:
    return make_capture(make_object(name), RenderOptions(size=96, views=12, test_views=1, samples=2))


@pytest.fixture(scope="module")
def slider(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture on disk, as a process of its own reads it."""
    root = tmp_path_factory.mktemp("captures") / "load" / "slider"
    save_known(make_object("slider"), photographed("slider"), root, "paris")
    return root


@pytest.fixture(scope="module")
def undisturbed(slider: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[FitEvent]]:
    """A run of the slider, and what it reported."""
    run = tmp_path_factory.mktemp("runs") / "undisturbed"
    events = []
    for event in fit_run(load_capture(slider), run, TINY, device="cpu", seed=3):
        if event == StageStarted("fit", TINY.steps) and event not in events:
            shutil.copytree(run, run.with_name("begun"))
        events.append(event)
    return run, events


@pytest.fixture(scope="module")
def begun(undisturbed: tuple[Path, list[FitEvent]]) -> Path:
    """The same run as it was right after its first checkpoint, before any step."""
    return undisturbed[0].with_name("begun")


def results(run: Path) -> dict[str, bytes]:
    return {name: (run / name).read_bytes() for name in RESULTS}


def axis_angle_deg(joint: Joint, true: TrueJoint) -> float:
    cosine = abs(sum(a * b for a, b in zip(joint.axis, true.axis, strict=True)))
    return math.degrees(math.acos(min(cosine, 1.0)))


def gap_of_axes(joint: Joint, true: TrueJoint) -> float:
    """Distance of the found origin from the true axis."""
    offset = torch.tensor(joint.origin) - torch.tensor(true.origin)
    return float(torch.linalg.cross(offset, torch.tensor(true.axis)).norm())


def finished(events: list[FitEvent]) -> ArticulatedObject:
    last = events[-1]
    assert isinstance(last, Finished)
    return last.obj


class TestObjects:
    def test_a_slide_is_found(self, undisturbed: tuple[Path, list[FitEvent]]):
        (true,) = make_object("slider").joints
        (joint,) = finished(undisturbed[1]).joints
        assert joint.kind == "prismatic"
        assert axis_angle_deg(joint, true) < 2
        assert joint.q == (0.0, pytest.approx(true.q1 - true.q0, abs=0.03))

    def test_a_hinge_is_found(self):
        (true,) = make_object("door").joints
        obj = reconstruct(photographed("door"), config=TINY, device="cpu")
        (joint,) = obj.joints
        assert joint.kind == "revolute"
        assert axis_angle_deg(joint, true) < 5
        assert gap_of_axes(joint, true) < 0.1
        assert math.degrees(joint.q[1]) == pytest.approx(math.degrees(true.q1 - true.q0), abs=6)

    def test_what_does_not_move_has_no_joints_and_what_was_asked_for_is_noted(self, tmp_path: Path):
        short = replace(TINY, steps=60, checkpoint_every=60)
        events = list(fit_run(photographed("static"), tmp_path / "run", short, device="cpu", parts=1))
        obj = finished(events)
        assert obj.joints == ()
        assert len(obj.parts) == 1
        assert Note("0 moving parts found") in events
        assert len(load_object(tmp_path / "run" / "object").parts) == 1
        assert (tmp_path / "run" / "notes.txt").read_text().startswith("1 were asked for: ")


@pytest.fixture(scope="module")
def straight() -> Capture:
    return photographed("slider")


@pytest.fixture(scope="module")
def astray(straight: Capture) -> Capture:
    """The slider by cameras each of which is said to point a degree elsewhere than it did."""
    ways = torch.nn.functional.normalize(torch.randn(2, 12, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    return straight.turned(list(math.radians(1.0) * ways))


@pytest.fixture(scope="module")
def put_right(astray: Capture, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[FitEvent]]:
    """A run of it, and what it reported."""
    run = tmp_path_factory.mktemp("runs") / "astray"
    events = []
    for event in fit_run(astray, run, AIMING, device="cpu"):
        if event == StageStarted("look", 2) and event in events:
            shutil.copytree(run, run.with_name("stopped"))
        events.append(event)
    return run, events


class TestCamerasAstray:
    def test_parts_are_searched_for_again_with_cameras_put_right(
        self, put_right: tuple[Path, list[FitEvent]], astray: Capture, straight: Capture
    ):
        folder, events = put_right
        stages = [event.stage for event in events if isinstance(event, StageStarted)]
        assert stages == ["look", "search", "fit"] * 2
        (true,) = make_object("slider").joints
        (joint,) = finished(events).joints
        assert joint.kind == "prismatic"
        assert axis_angle_deg(joint, true) < 2
        assert "and were turned" in (folder / "notes.txt").read_text()

        def beside_deg(capture: Capture) -> float:
            """Median angle between the cameras' true sight and theirs, over both states."""
            pairs = zip(sum(capture.train, ()), sum(straight.train, ()), strict=True)
            sights = [[view.camera.T_world_camera.rotation[:, 2] for view in pair] for pair in pairs]
            return math.degrees(float(torch.tensor([float((a @ b).clamp(max=1).acos()) for a, b in sights]).median()))

        assert beside_deg(astray) > 0.7
        assert beside_deg(RunFolder(folder).put_right(astray)) < 0.4

    def test_what_stops_in_the_second_search_goes_on_to_the_same_end(
        self, put_right: tuple[Path, list[FitEvent]], astray: Capture
    ):
        stopped = put_right[0].with_name("stopped")
        events = list(fit_run(astray, stopped, AIMING, device="cpu"))
        assert events[0] == Note("going on from step 40")
        assert results(stopped) == results(put_right[0])


class TestEvents:
    def test_tell_the_stages_and_the_steps_in_order(self, undisturbed: tuple[Path, list[FitEvent]]):
        run, events = undisturbed
        stages = [event.stage for event in events if isinstance(event, StageStarted)]
        assert list(dict.fromkeys(stages)) == ["look", "search", "fit"]
        steps = [event for event in events if isinstance(event, Step) and event.stage == "fit"]
        assert [step.step for step in steps] == list(range(10, 151, 10))
        assert Note("1 moving part found") in events
        assert Note("joints at step 90: prismatic") in events
        assert events[-1] == Finished(finished(events), run)

    def test_the_fit_comes_ever_closer_to_the_photos(self, undisturbed: tuple[Path, list[FitEvent]]):
        steps = [event for event in undisturbed[1] if isinstance(event, Step) and event.psnr is not None]
        first, last = (sum(step.psnr or 0.0 for step in some) / 3 for some in (steps[:3], steps[-3:]))
        assert last > first + 3

    def test_the_metrics_file_repeats_the_steps(self, undisturbed: tuple[Path, list[FitEvent]]):
        run, events = undisturbed
        steps = [event for event in events if isinstance(event, Step) and event.stage == "fit"]
        rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        assert rows == [{"step": s.step, "loss": s.loss, "psnr": s.psnr, "splats": s.splats} for s in steps]

    def test_the_folder_holds_the_object_that_was_reported(self, undisturbed: tuple[Path, list[FitEvent]]):
        run, events = undisturbed
        saved, reported = load_object(run / "object"), finished(events)
        assert saved.joints == reported.joints
        assert saved.parts.counts == reported.parts.counts
        for name, value in reported.parts.splats.tensors().items():
            assert torch.equal(saved.parts.splats.tensors()[name], value)
        record = json.loads((run / "config.json").read_text())
        assert (record["seed"], record["views"], record["fit"]["steps"]) == (3, [12, 12], 150)
        assert json.loads((run / "timing.json").read_text())["total"] > 0


def run_in_a_process(capture: Path, run: Path) -> subprocess.Popen[bytes]:
    """Fits as the fixture does, in a process that can be killed."""
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from pathlib import Path\n"
        "from structuregs.capture import load_capture\n"
        "from structuregs.fit.reconstruct import fit_run\n"
        "from test_reconstruct import TINY\n"
        f"list(fit_run(load_capture({str(capture)!r}), Path({str(run)!r}), TINY, device='cpu', seed=3))\n"
    )
    return subprocess.Popen([sys.executable, "-c", code])


def steps_written(run: Path) -> int:
    file = run / "metrics.jsonl"
    return len(file.read_text().splitlines()) if file.exists() else 0


class TestGoingOn:
    def test_a_killed_run_goes_on_to_the_same_bytes(
        self, slider: Path, undisturbed: tuple[Path, list[FitEvent]], begun: Path, tmp_path: Path
    ):
        run = tmp_path / "run"
        shutil.copytree(begun, run)
        process = run_in_a_process(slider, run)
        deadline = time.monotonic() + 300
        while steps_written(run) < 6 and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        os.kill(process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL, "killed while it was at work"
        assert not (run / "object").exists()
        events = list(fit_run(load_capture(slider), run, TINY, device="cpu", seed=3))
        assert any(isinstance(event, Note) and event.text.startswith("going on from step ") for event in events)
        assert not any(isinstance(event, StageStarted) and event.stage == "search" for event in events)
        assert results(run) == results(undisturbed[0])

    @pytest.mark.parametrize("stop", [40, 140])
    def test_so_does_one_that_stopped_at_any_step(
        self, stop: int, slider: Path, undisturbed: tuple[Path, list[FitEvent]], begun: Path, tmp_path: Path
    ):
        run = tmp_path / "run"
        shutil.copytree(begun, run)
        sitting = fit_run(load_capture(slider), run, TINY, device="cpu", seed=3)
        for event in sitting:
            if isinstance(event, Step) and event.stage == "fit" and event.step == stop:
                break
        sitting.close()  # pyright: ignore[reportAttributeAccessIssue]
        assert (
            FitState.load(run / "checkpoints" / "last.pt").step == (stop - 1) // TINY.checkpoint_every * TINY.checkpoint_every
        )
        list(fit_run(load_capture(slider), run, TINY, device="cpu", seed=3))
        assert results(run) == results(undisturbed[0])

    def test_a_finished_run_says_so_and_is_left_as_it_is(self, slider: Path, undisturbed: tuple[Path, list[FitEvent]]):
        run, before = undisturbed
        stamps = {name: (run / name).stat().st_mtime_ns for name in RESULTS}
        events = list(fit_run(load_capture(slider), run, TINY, device="cpu", seed=3))
        assert events[0] == Note(f"{run} is finished; nothing is left to do")
        assert len(events) == 2
        assert finished(events).joints == finished(before).joints
        assert stamps == {name: (run / name).stat().st_mtime_ns for name in RESULTS}

    def test_another_fit_in_the_same_folder_is_refused(self, slider: Path, undisturbed: tuple[Path, list[FitEvent]]):
        run, capture = undisturbed[0], load_capture(slider)
        for config, seed, what in ((replace(TINY, steps=151), 3, "fit"), (TINY, 4, "seed")):
            with pytest.raises(
                ValueError, match=rf"a run with another {what} lies here; go on with the same or choose another"
            ):
                next(fit_run(capture, run, config, device="cpu", seed=seed))

    def test_a_damaged_checkpoint_is_named(self, slider: Path, begun: Path, tmp_path: Path):
        run = tmp_path / "run"
        shutil.copytree(begun, run)
        checkpoint = run / "checkpoints" / "last.pt"
        checkpoint.write_bytes(checkpoint.read_bytes()[:5000])
        with pytest.raises(ValueError, match=r"last\.pt: the checkpoint is damaged; delete it to fit this run from the start"):
            list(fit_run(load_capture(slider), run, TINY, device="cpu", seed=3))


def test_two_pieces_of_one_part_become_one_and_the_run_ends(slider: Path, begun: Path, tmp_path: Path):
    """Joining parts replaces the state of the fit under way; checkpoints and the result must be of the new one.

    The photos show neither piece, so what the two become need not move, and is the base's next.
    """
    run = tmp_path / "run"
    shutil.copytree(begun, run)
    turn = SE3.exp(torch.tensor([0.1, 0.2, 0, 0, 0, 0.5], dtype=torch.float64))
    pieces = made_of(turn, turn, centres=((0.0, 0, 0), (0.6, 0.0, 0.3), (1.3, 0.0, 0.3))).parts
    FitState.start(pieces).save(run / "checkpoints" / "last.pt")
    still = replace(TINY, steps=30, checkpoint_every=10, join_at=0.1, structure_until=30, image_from=30)
    record = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(record | {"fit": asdict(still)}))
    events = list(fit_run(load_capture(slider), run, still, device="cpu", seed=3))
    assert Note("two parts that move alike are one from step 3 on; 1 left") in events
    assert Note("a part that need not move is the base's from step 3 on; 0 left") in events
    assert finished(events).parts.counts == (360,)
    assert FitState.load(run / "checkpoints" / "last.pt").step == 30


def test_without_a_folder_nothing_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    config = replace(TINY, steps=10, structure_until=5, image_from=5)
    first, second = (reconstruct(photographed("static"), config=config, device="cpu", seed=seed) for seed in (0, 1))
    assert first.joints == second.joints == ()
    assert first.parts.splats.means[:10].tolist() != second.parts.splats.means[:10].tolist(), "another seed, another object"
    assert not list(tmp_path.iterdir())

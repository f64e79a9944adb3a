import json
import socket
from pathlib import Path

import pytest
from PIL import Image

from door_and_drawer import DOOR, DRAWER, made_of, photographed
from structuregs import cli, console
from structuregs.capture import save_capture, save_truth
from structuregs.fit.events import Finished, Note, StageStarted, Step
from structuregs.model import save_object


def called(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    """The exit code of `structuregs words...`."""
    monkeypatch.setattr("sys.argv", ["structuregs", *map(str, words)])
    try:
        cli.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A finished run on a capture in the ArtGS layout, both made up."""
    folder = tmp_path_factory.mktemp("run")
    obj = made_of(DOOR.motion(), DRAWER.motion())
    save_truth(folder / "capture", "artgs", (DOOR, DRAWER), {})
    save_capture(photographed(obj, views=3), folder / "capture", "artgs")
    save_object(obj, folder / "object")
    config = {"capture": str(folder / "capture"), "views": [3, 3], "seed": 0}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "timing.json").write_text('{"total": 12.5}')
    return folder


def test_eval_prints_a_table_and_writes_json(run, tmp_path, monkeypatch, capsys):
    assert called(monkeypatch, "eval", run, "--protocol", "paris", "--json", tmp_path / "r.json") == 0
    record = json.loads((tmp_path / "r.json").read_text())
    assert [(row["part"], row["kind"], row["failed"]) for row in record["joints"]] == [
        (1, "revolute", False),
        (2, "prismatic", False),
    ]
    assert record["joints"][0]["geodesic_deg"] < 1e-3
    assert record["joints"][1]["translation"] < 1e-6
    assert (record["protocol"], record["seconds"]) == ("paris", 12.5)
    assert record["psnr"] > 45
    printed = capsys.readouterr().out
    assert "0 of 2 joints failed" in printed
    assert "…" not in printed


def test_eval_of_artgs_prints_tenths_of_the_unit_and_keeps_the_json(run, tmp_path, monkeypatch, capsys):
    (tmp_path / "truth").mkdir()
    record = json.loads((run / "capture" / "gt" / "trans.json").read_text())
    record["trans_info"][0]["axis"]["o"][1] += 0.05
    (tmp_path / "truth" / "trans.json").write_text(json.dumps(record))
    arguments = ("eval", run, "--truth", tmp_path / "truth", "--json", tmp_path / "r.json", "--protocol")
    assert called(monkeypatch, *arguments, "artgs") == 0
    assert "0.5000" in capsys.readouterr().out
    assert json.loads((tmp_path / "r.json").read_text())["joints"][0]["axis_position"] == pytest.approx(0.05, abs=1e-5)
    assert called(monkeypatch, *arguments, "strict") == 0
    assert "0.0500" in capsys.readouterr().out


def test_render_writes_the_picture_in_the_size_asked_for(run, tmp_path, monkeypatch):
    assert called(monkeypatch, "render", run, "-o", tmp_path / "a.gif", "--size", "20", "--frames", "4") == 0
    with Image.open(tmp_path / "a.gif") as image:
        assert (image.n_frames, image.size) == (4, (20, 16))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("eval", "nowhere"), "run `structuregs fit` first"),
        (("render", "nowhere", "-o", "a.gif"), "run `structuregs fit` first"),
        (("export", "nowhere"), "run `structuregs fit` first"),
        (("view", "nowhere"), "run `structuregs fit` first"),
        (("fit", "nowhere", "-o", "run"), "give the folder of one capture"),
    ],
)
def test_a_users_error_is_one_sentence_and_exit_2(words, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert called(monkeypatch, *words) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert sentence in captured.err
    assert captured.out == ""


def test_export_writes_a_folder_for_each_format(run, tmp_path, monkeypatch, capsys):
    assert called(monkeypatch, "export", run, "--to", "html,ply", "-o", tmp_path / "out") == 0
    written = sorted(str(file.relative_to(tmp_path / "out")) for file in (tmp_path / "out").rglob("*.*"))
    parts = [f"ply/{name}.ply" for name in ("base", "part_1", "part_2", "state_0", "state_1")]
    assert written == ["html/object.html", *parts]
    assert f"<title>{run.name}</title>" in (tmp_path / "out" / "html" / "object.html").read_text()
    assert capsys.readouterr().out.count("wrote ") == len(written)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--to", "obj"), "give one or more of mesh,urdf,mjcf,usd,ply,glb,html"),
        (("--to", ""), "give one or more of"),
        (("--to", "ply", "--scale", "0"), "must be above 0"),
        (("--to", "ply", "--limit-margin", "-1"), "give 0 or more"),
    ],
)
def test_an_export_that_cannot_be_is_a_sentence_and_writes_nothing(words, sentence, run, tmp_path, monkeypatch, capsys):
    assert called(monkeypatch, "export", run, "-o", tmp_path / "out", *words) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_missing_extra_is_named(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("structuregs.export.files.find_spec", lambda name: None if name == "pxr" else object())
    assert called(monkeypatch, "export", run, "--to", "ply,usd", "-o", tmp_path / "out") == 2
    assert 'pip install "structuregs[usd]"' in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_a_sentence(run, tmp_path, monkeypatch, capsys):
    (tmp_path / "out").write_text("a file")
    assert called(monkeypatch, "export", run, "--to", "ply", "-o", tmp_path / "out") == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert str(tmp_path / "out") in captured.err.replace("\n", "")


def test_a_port_that_is_taken_is_a_sentence(run, monkeypatch, capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert called(monkeypatch, "view", run, "--port", str(taken.getsockname()[1])) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_view_that_is_not_there_is_a_sentence(run, monkeypatch, capsys):
    assert called(monkeypatch, "render", run, "-o", "a.gif", "--view", "9999") == 2
    assert "they run from 0000 to 0002" in capsys.readouterr().err


def test_debugging_shows_the_traceback(tmp_path, monkeypatch):
    monkeypatch.setenv("STRUCTUREGS_DEBUG", "1")
    with pytest.raises(ValueError, match="run `structuregs fit` first"):
        called(monkeypatch, "eval", tmp_path)


def test_an_interruption_is_one_line_and_exit_130(run, monkeypatch, capsys):
    def interrupt(*_args: object, **_options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("structuregs.evaluate.evaluate_run", interrupt)
    assert called(monkeypatch, "eval", run) == 130
    assert capsys.readouterr().err == "interrupted; run the same command to go on\n"


def test_a_fits_events_are_followed_to_its_end(capsys):
    obj = made_of(DOOR.motion())
    events = [
        StageStarted("boxes", 2),
        Step("boxes", 1, 0.5, None, 240),
        Note("one part was dropped"),
        Step("boxes", 2, 0.25, 30.1, 240),
    ]
    finished = console.follow([*events, Finished(obj, Path("run"))])
    assert finished.obj is obj
    printed = capsys.readouterr().out
    assert "one part was dropped" in printed
    assert "loss 0.2500  PSNR 30.1" in printed
    with pytest.raises(RuntimeError, match="without a result"):
        console.follow(events)


def test_joints_that_need_a_look_are_named(capsys):
    obj = made_of(DOOR.motion(), DRAWER.motion())
    console.print_joints(obj)
    assert "please look" not in capsys.readouterr().out
    six = made_of(type(DOOR)("revolute", DOOR.axis, DOOR.origin, 0.0, 0.105).motion())
    console.print_joints(six)
    assert "part 1, please look: The part turns by 6.0 degrees" in capsys.readouterr().out

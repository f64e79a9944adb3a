"""Many captures: which are found, what the tables say, and that work is taken up where it was left."""

import csv
import json
from pathlib import Path

import pytest

from structuregs import cli
from structuregs.capture import CaptureError, find_captures
from structuregs.evaluate import Bench, BenchRow, bench, write_tables
from structuregs.evaluate.tables import METRICS, at_a_glance, compared, joint_by_joint, published, scene_of, trust

FRIDGE, OTHER = Path("data/fridge/10905"), Path("data/desk/7")


def joint(kind: str = "revolute", *, failed: bool = False, angle: float = 0.5) -> dict:
    turns = kind == "revolute"
    errors = {
        "axis_angle_deg": angle,
        "axis_position": 0.25 if turns else None,
        "geodesic_deg": 2.0 if turns else None,
        "translation": None if turns else 0.125,
    }
    return {"part": 1, "kind": kind, "kind_true": kind, "failed": failed, **(dict.fromkeys(errors) if failed else errors)}


def report(*joints: dict, **others: object) -> dict:
    base = {"protocol": "paris", "joints": list(joints), "unmatched_parts": [], "flagged_parts": [], "seconds": 60.0}
    base |= {"psnr": 30.0, "psnr_by_state": [30.0, 30.0], "psnr_object": None, "peak_gb": 1.5}
    surfaces = {"cd_static": 1.0, "cd_movable": 2.0, "cd_whole": 3.0}
    return base | surfaces | {"failures": sum(j["failed"] for j in joints)} | others


def row_of(table: list[tuple[str, ...]], metric: str, method: str) -> tuple[str, ...]:
    (row,) = [line for line in table if line[:2] == (metric, method)]
    return row[2:]


class TestFinding:
    def made(self, root: Path, *names: str) -> None:
        for name in names:
            (root / name).mkdir(parents=True)
            for state in ("start", "end"):
                (root / name / f"transforms_train_{state}.json").write_text("{}")

    def test_all_captures_below_a_folder_in_order(self, tmp_path):
        self.made(tmp_path, "b", "a", "more/c")
        assert find_captures(tmp_path) == [tmp_path / "a", tmp_path / "b", tmp_path / "more/c"]
        assert find_captures(tmp_path / "a") == [tmp_path / "a"]

    def test_a_list_names_folders_beside_it(self, tmp_path):
        self.made(tmp_path, "a", "b")
        (tmp_path / "list.txt").write_text("# the second\n\nb\n")
        assert find_captures(tmp_path / "list.txt") == [tmp_path / "b"]

    @pytest.mark.parametrize(("name", "says"), [("none", "no such folder or list"), ("empty", "no capture here")])
    def test_what_holds_none_is_named(self, tmp_path, name, says):
        (tmp_path / "empty").mkdir()
        with pytest.raises(CaptureError, match=says):
            find_captures(tmp_path / name)


class TestTables:
    def test_the_published_scenes_stand_beside_the_published_figures(self):
        assert scene_of(FRIDGE) == "fridge"
        assert scene_of(Path("x/fridge/7")) == "7"
        table = compared([BenchRow(FRIDGE, None, 0, report(joint()))], None)
        assert table[0] == ("metric", "method", "fridge", "mean", "failures")
        # The supplement's table 2 (a), column Fridge, and (b).
        assert row_of(table, "Ang Err", "StructureGS") == ("0.055", "0.055", "0")
        assert row_of(table, "CD-w", "ArticulatedGS") == ("1.395", "1.395", "0")
        table = compared([BenchRow(FRIDGE, 10, 0, report(joint()))], 10)
        assert row_of(table, "Ang Err", "StructureGS") == ("1.061", "1.061", "0")
        table = compared([BenchRow(FRIDGE, 7, 0, report(joint()))], 7)
        assert {line[1] for line in table[1:]} == {"structuregs"}

    def test_figures_are_means_over_seeds_and_joints_and_failures_are_counted_not_averaged(self):
        rows = [
            BenchRow(FRIDGE, None, 0, report(joint(angle=0.1))),
            BenchRow(FRIDGE, None, 1, report(joint(angle=0.3))),
            BenchRow(OTHER, None, 0, report(joint("prismatic", angle=1.0), joint(failed=True))),
            BenchRow(OTHER, None, 1, None, "no memory"),
        ]
        table = compared(rows, None)
        assert row_of(table, "Ang Err", "structuregs") == ("0.200", "1.000 F2", "0.600", "2")
        assert row_of(table, "Pos Err", "structuregs") == ("0.250", "F2", "0.250", "2")
        assert row_of(table, "Geo Dist", "structuregs") == ("2.000", "0.125 F2", "1.062", "2")
        assert row_of(table, "CD-s", "structuregs") == ("1.000", "1.000 F1", "1.000", "1")

    def test_a_slide_s_axis_has_no_place(self):
        table = compared([BenchRow(OTHER, None, 0, report(joint("prismatic")))], None)
        assert row_of(table, "Pos Err", "structuregs") == ("-", "-", "0")

    def test_joint_by_joint_it_is_the_worst_seed(self):
        rows = [
            BenchRow(OTHER, None, 0, report(joint(angle=0.1), joint("prismatic"), psnr=31.0)),
            BenchRow(OTHER, None, 1, report(joint(angle=0.7), joint(failed=True), unmatched_parts=[3], seconds=90.0)),
        ]
        _, first, second = joint_by_joint(rows)
        assert first[:3] == ("7 (and 1 parts too many)", "revolute", "0.700")
        assert first[6:] == ("30.0", "1.00", "2.00", "3.00", "60 to 90", "1.50")
        assert second[:3] == ("", "prismatic (F in 1 of 2)", "0.500")
        (_, lost) = joint_by_joint([BenchRow(OTHER, None, 0, None, "no memory")])
        assert lost[:2] == ("7", "no fit ended: no memory")

    def test_at_a_glance_it_is_all_joints_and_fits_and_what_failed_counts_as_not_right(self):
        rows = [
            BenchRow(FRIDGE, None, 0, report(joint(angle=0.1), cd_static=1.0, psnr=31.0)),
            BenchRow(OTHER, None, 0, report(joint("prismatic", angle=0.2), joint(angle=0.9), cd_static=4.0)),
            BenchRow(OTHER, None, 1, report(joint("prismatic", angle=0.4), joint(failed=True))),
            BenchRow(OTHER, None, 2, report(joint("prismatic", angle=0.4), unmatched_parts=[2])),
            BenchRow(OTHER, None, 3, None, "no memory"),
        ]
        _, parts, *lines = at_a_glance(rows)
        assert parts == ("fits with all parts right", "", "", "", "2 of 5")
        figures = {line[0]: line[1:] for line in lines}
        assert figures["axis deg"] == ("0.400", "0.400", "0.900", "5 joints")
        assert figures["slide"] == ("0.1250", "0.1250", "0.1250", "3 joints")
        assert figures["CD static"] == ("1.00", "1.75", "4.00", "4 fits")
        assert figures["PSNR"] == ("30.0", "30.2", "30.0", "4 fits")

    def test_what_no_joint_has_is_no_row(self):
        lines = at_a_glance([BenchRow(OTHER, None, 0, report(joint("prismatic")))])
        assert "turn deg" not in {line[0] for line in lines}

    def test_trust_counts_what_is_wrong_and_not_flagged(self):
        def numbered(part: int | None, **others) -> dict:
            return joint(**others) | {"part": part, "geodesic_deg": None, "axis_position": 0.01}

        joints = (numbered(1), numbered(2, angle=3.0), numbered(3, angle=3.0), numbered(None, failed=True))
        rows = [
            BenchRow(OTHER, None, 0, report(*joints, unmatched_parts=[4, 5], flagged_parts=[2, 5])),
            BenchRow(OTHER, None, 1, report(numbered(1, failed=True), flagged_parts=[])),
            BenchRow(OTHER, None, 2, None, "no memory"),
        ]
        assert trust(rows)[1:] == [
            ("right", "0", "1"),
            ("wrong", "1", "2"),
            ("too many", "1", "1"),
            ("not found", "", "1"),
        ]

    def test_the_files_hold_every_row(self, tmp_path):
        rows = [BenchRow(FRIDGE, v, 0, report(joint())) for v in (None, 10)]
        files = write_tables(Bench((FRIDGE,), tmp_path, (None, 10), (0,)), rows)
        assert sorted(file.name for file in tmp_path.iterdir()) == sorted(file.name for file in files)
        text = (tmp_path / "table.md").read_text()
        assert "## All views" in text
        assert "## 10 views of each state" in text
        lines = list(csv.DictReader((tmp_path / "table.csv").open()))
        assert len(lines) == len(published()) + 2 * len(METRICS)
        assert {"views": "sparse", "metric": "CD-m", "method": "structuregs", "scene": "fridge", "value": "2.000"} in lines
        assert [record["views"] for record in json.loads((tmp_path / "table.json").read_text())] == [None, 10]


class TestRunning:
    def finished(self, folder: Path, name: str, seed: int) -> None:
        (folder / "runs").mkdir(parents=True, exist_ok=True)
        (folder / "runs" / f"{name}_default_all_{seed}_paris.json").write_text(json.dumps(report(joint())))

    def test_what_is_finished_is_not_done_again_and_what_fails_is_a_row(self, tmp_path):
        """The captures do not exist: whatever is run at all fails."""
        for seed in (0, 1):
            self.finished(tmp_path, "10905", seed)
        rows = list(bench(Bench((tmp_path / "fridge/10905", tmp_path / "desk/7"), tmp_path, seeds=(0, 1))))
        assert sorted((row.capture.name, row.seed, row.report is not None) for row in rows) == [
            ("10905", 0, True),
            ("10905", 1, True),
            ("7", 0, False),
            ("7", 1, False),
        ]
        assert all("there is no such folder" in row.error for row in rows if row.report is None)
        assert not list(tmp_path.rglob("*.part*"))

    def test_what_an_older_version_scored_is_scored_again(self, tmp_path):
        """Its report does not say which parts are flagged; the capture does not exist, so that scoring it again fails."""
        self.finished(tmp_path, "10905", 0)
        (file,) = (tmp_path / "runs").iterdir()
        file.write_text(json.dumps({k: v for k, v in report(joint()).items() if k != "flagged_parts"}))
        (row,) = bench(Bench((tmp_path / "10905",), tmp_path, seeds=(0,)))
        assert row.report is None
        assert "there is no such folder" in row.error

    def test_captures_of_one_name_are_told_apart(self, tmp_path):
        self.finished(tmp_path, "a_7", 0)
        self.finished(tmp_path, "b_7", 0)
        rows = list(bench(Bench((tmp_path / "a/7", tmp_path / "b/7"), tmp_path, seeds=(0,))))
        assert all(row.report for row in rows)

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (("--views", "ten"), "--views ten: not a whole number."),
            (("--seeds", ","), "--seeds: nothing is given"),
            (("--at-once", "0"), "--at-once 0: give 1 or more."),
        ],
    )
    def test_a_users_error_is_one_sentence(self, words, sentence, tmp_path, monkeypatch, capsys):
        (tmp_path / "a").mkdir()
        for state in ("start", "end"):
            (tmp_path / "a" / f"transforms_train_{state}.json").write_text("{}")
        monkeypatch.setattr("sys.argv", ["structuregs", "bench", str(tmp_path), "-o", str(tmp_path / "out"), *words])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code == 2
        assert sentence in capsys.readouterr().err
        assert not (tmp_path / "out").exists()

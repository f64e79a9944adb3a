"""Tables of a bench: beside the published figures as a paper prints them, and joint by joint."""

import csv
import io
import json
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from ..files import replace_file
from .bench import Bench, BenchRow

METRICS = ("Ang Err", "Pos Err", "Geo Dist", "CD-s", "CD-m", "CD-w")
OURS = "structuregs"
# PARIS's scenes as its folders name them, and as the published table (StructureGS, supplement, table 2) does.
_SCENES = {
    ("foldchair", "102255"): "foldchair",
    ("fridge", "10905"): "fridge",
    ("laptop", "10211"): "laptop",
    ("oven", "101917"): "oven",
    ("scissor", "11100"): "scissor",
    ("stapler", "103111"): "stapler",
    ("usb", "100109"): "usb",
    ("washer", "103776"): "washer",
    ("blade", "103706"): "blade",
    ("storage", "45135"): "storage",
    ("realscan", "real_fridge"): "real_fridge",
    ("realscan", "real_storage"): "real_storage",
}
_PUBLISHED_VIEWS = {"full": None, "sparse": 10}


@dataclass(frozen=True)
class Cell:
    """A figure of a table: its value, None where there is none, and how many of the fits or joints behind it failed."""

    value: float | None
    failed: int = 0
    text: str = ""

    def __str__(self) -> str:
        shown = (
            "-" if self.value is None and not self.failed else "" if self.value is None else self.text or f"{self.value:.3f}"
        )
        return " ".join(word for word in (shown, f"F{self.failed}" if self.failed else "") if word)


def scene_of(capture: Path) -> str:
    """The scene's name in the published table if it is one of those, else the folder's."""
    return _SCENES.get((capture.parent.name.lower(), capture.name), capture.name)


def published() -> list[dict[str, str]]:
    """The published rows: views (full: all, sparse: 10), metric, method, scene, value ("F" failed, "-" does not apply)."""
    text = (files("structuregs.evaluate") / "paris_table2.csv").read_text()
    return list(csv.DictReader(io.StringIO(text)))


def _values(report: dict[str, Any] | None, metric: str) -> tuple[list[float], int]:
    """A report's figures of one metric, and how many of its joints have none because they failed."""
    if report is None:
        return [], 1
    surface = {"CD-s": "cd_static", "CD-m": "cd_movable", "CD-w": "cd_whole"}.get(metric)
    if surface is not None:
        value = report[surface]
        return ([] if value is None else [value]), int(value is None and surface == "cd_movable" and report["failures"] > 0)
    found = []
    for joint in report["joints"]:
        geodesic = joint["geodesic_deg"] if joint["kind_true"] == "revolute" else joint["translation"]
        value = {"Ang Err": joint["axis_angle_deg"], "Pos Err": joint["axis_position"], "Geo Dist": geodesic}[metric]
        found += [] if joint["failed"] or value is None else [value]
    return found, report["failures"]


def mean_cell(rows: Iterable[BenchRow], metric: str) -> Cell:
    """Mean over seeds and joints."""
    values, failed = [], 0
    for row in rows:
        more, missing = _values(row.report, metric)
        values, failed = values + more, failed + missing
    return Cell(sum(values) / len(values) if values else None, failed)


def compared(rows: Sequence[BenchRow], views: int | None) -> list[tuple[str, ...]]:
    """The rows of a table like the published one: metric, method, a figure for each scene, their mean, failures."""
    scenes = list(dict.fromkeys(scene_of(row.capture) for row in rows))
    table: list[tuple[str, ...]] = [("metric", "method", *scenes, "mean", "failures")]
    setting = {known: name for name, known in _PUBLISHED_VIEWS.items()}.get(views)
    others = [row for row in published() if row["views"] == setting and row["scene"] in scenes]
    for metric in METRICS:
        for method in dict.fromkeys(row["method"] for row in others):
            told = {row["scene"]: row["value"] for row in others if row["method"] == method and row["metric"] == metric}
            cells = [_told(told.get(scene)) for scene in scenes]
            table.append((metric, method, *(str(cell) for cell in cells), *_summary(cells)))
        cells = [mean_cell([row for row in rows if scene_of(row.capture) == scene], metric) for scene in scenes]
        table.append((metric, OURS, *(str(cell) for cell in cells), *_summary(cells)))
    return table


def _told(value: str | None) -> Cell:
    if value is None or value == "-":
        return Cell(None)
    return Cell(None, 1) if value == "F" else Cell(float(value), text=value)


def _summary(cells: Sequence[Cell]) -> tuple[str, str]:
    known = [cell.value for cell in cells if cell.value is not None]
    return (f"{sum(known) / len(known):.3f}" if known else "-"), str(sum(cell.failed for cell in cells))


def joint_by_joint(rows: Sequence[BenchRow]) -> list[tuple[str, ...]]:
    """A row for each true joint of a capture, the worst of its seeds."""
    heads = ("capture", "joint", "axis deg", "position", "turn deg", "slide", "PSNR")
    table: list[tuple[str, ...]] = [(*heads, "CD static", "CD movable", "CD whole", "seconds", "peak GB")]
    for capture in dict.fromkeys(row.capture for row in rows):
        here = [row for row in rows if row.capture == capture]
        reports = [row.report for row in here if row.report is not None]
        if not reports:
            table.append((capture.name, f"no fit ended: {here[0].error}", *[""] * 10))
            continue
        lost = len(here) - len(reports)
        extra = max(len(r["unmatched_parts"]) for r in reports)
        notes = [f"{lost} of {len(here)} fits failed"] * (lost > 0) + [f"and {extra} parts too many"] * (extra > 0)
        name = capture.name + (f" ({', '.join(notes)})" if notes else "")
        figures = (_worst((r["psnr"] for r in reports), 1, min), *(_worst((r[n] for r in reports), 2) for n in _SURFACES))
        times = " to ".join(dict.fromkeys(_worst((r["seconds"] for r in reports), 0, pick) for pick in (min, max)))
        figures = (*figures, times, _worst((r["peak_gb"] for r in reports), 2))
        for k in range(len(reports[0]["joints"])):
            table.append(_joint_row("" if k else name, [r["joints"][k] for r in reports], [""] * 6 if k else figures))
        if not reports[0]["joints"]:
            table.append((name, "no ground truth", *[""] * 4, *figures))
    return table


def at_a_glance(rows: Sequence[BenchRow]) -> list[tuple[str, ...]]:
    """Median, mean and worst of every figure over all joints, or fits, that have it, and how many these are.

    The first row says in how many fits every part is found, of the right type, and none is too many.
    """
    reports = [row.report for row in rows if row.report is not None]
    right = sum(not report["failures"] and not report["unmatched_parts"] for report in reports)
    table: list[tuple[str, ...]] = [("figure", "median", "mean", "worst", "of")]
    table.append(("fits with all parts right", "", "", "", f"{right} of {len(rows)}"))
    joints = [joint for report in reports for joint in report["joints"] if not joint["failed"]]
    for name, source, field, digits, worst in _FIGURES:
        values = [value for one in (joints if source == "joints" else reports) if (value := one[field]) is not None]
        if values:
            shown = (f"{f(values):.{digits}f}" for f in (statistics.median, statistics.mean, worst))
            table.append((name, *shown, f"{len(values)} {source}"))
    return table


_FIGURES = (
    ("axis deg", "joints", "axis_angle_deg", 3, max),
    ("position", "joints", "axis_position", 4, max),
    ("turn deg", "joints", "geodesic_deg", 3, max),
    ("slide", "joints", "translation", 4, max),
    ("PSNR", "fits", "psnr", 1, min),
    ("CD static", "fits", "cd_static", 2, max),
    ("CD movable", "fits", "cd_movable", 2, max),
    ("CD whole", "fits", "cd_whole", 2, max),
)
_WRONG = {"axis_angle_deg": 2.0, "axis_position": 0.02, "geodesic_deg": 2.0, "translation": 0.02}  # beyond these


def trust(rows: Sequence[BenchRow]) -> list[tuple[str, ...]]:
    """How many joints came out right, wrong and too many, and how many of each ask for a human's look.

    Wrong: of another type, or off by more than 2 degrees or .02 units in any figure.  What was not found cannot be flagged
    itself; a fit says how much of what it sees is in no part.
    """
    counts = {(what, flagged): 0 for what in ("right", "wrong", "too many") for flagged in (True, False)}
    missing = 0
    for report in (row.report for row in rows if row.report is not None):
        flagged = set(report["flagged_parts"])
        for joint in report["joints"]:
            if joint["part"] is None:
                missing += 1
                continue
            off = any(joint[name] is not None and joint[name] > bound for name, bound in _WRONG.items())
            counts["wrong" if joint["failed"] or off else "right", joint["part"] in flagged] += 1
        for part in report["unmatched_parts"]:
            counts["too many", part in flagged] += 1
    table: list[tuple[str, ...]] = [("joint", "flagged", "not flagged")]
    table += [(what, str(counts[what, True]), str(counts[what, False])) for what in ("right", "wrong", "too many")]
    return [*table, ("not found", "", str(missing))]


_SURFACES = ("cd_static", "cd_movable", "cd_whole")


def _joint_row(name: str, seen: Sequence[dict[str, Any]], figures: Sequence[str]) -> tuple[str, ...]:
    failed = sum(joint["failed"] for joint in seen)
    kind = seen[0]["kind_true"] + (f" (F in {failed} of {len(seen)})" if failed else "")
    errors = (("axis_angle_deg", 3), ("axis_position", 4), ("geodesic_deg", 3), ("translation", 4))
    return (name, kind, *(_worst((j[e] for j in seen if not j["failed"]), digits) for e, digits in errors), *figures)


def _worst(values: Iterable[float | None], digits: int, pick: Callable[[list[float]], float] = max) -> str:
    known = [value for value in values if value is not None]
    return f"{pick(known):.{digits}f}" if known else ""


def markdown(table: Sequence[tuple[str, ...]]) -> str:
    """A table in Markdown; its first row is the head."""
    lines = [table[0], ("---",) * len(table[0]), *table[1:]]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def write_tables(plan: Bench, rows: Sequence[BenchRow]) -> list[Path]:
    """Writes table.md, table.csv (as the published one, `structuregs` one more method) and table.json (every report)."""
    text, lines = [], [("views", "metric", "method", "scene", "value")]
    lines += [tuple(row[name] for name in lines[0]) for row in published()]
    for views in plan.views:
        here = sorted((row for row in rows if row.views == views), key=lambda row: (plan.captures.index(row.capture), row.seed))
        name = "all views" if views is None else f"{views} views of each state"
        seeds = ", ".join(str(seed) for seed in plan.seeds)
        text.append(f"## {name[0].upper()}{name[1:]}\n\nPreset `{plan.preset}`, protocol `{plan.protocol}`.\n")
        text.append(f"Over all captures and seeds {seeds}.\n")
        text.append(markdown(at_a_glance(here)))
        text.append(f"Means over seeds {seeds} (and joints); Fn: n failures, which the mean leaves out.\n")
        text.append(markdown(compared(here, views)))
        text.append(f"Joint by joint, the worst of seeds {seeds}; {plan.at_once} at a time.\n")
        text.append(markdown(joint_by_joint(here)))
        text.append("Whether what is wrong is flagged (off by more than 2 degrees or .02 units, or of another type).\n")
        text.append(markdown(trust(here)))
        setting = {None: "full", 10: "sparse"}.get(views, str(views))
        for scene in dict.fromkeys(scene_of(row.capture) for row in here):
            of_scene = [row for row in here if scene_of(row.capture) == scene]
            lines += [(setting, metric, OURS, scene, str(mean_cell(of_scene, metric))) for metric in METRICS]
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(lines)
    records = [
        {"capture": str(row.capture), "views": row.views, "seed": row.seed, "error": row.error, "report": row.report}
        for row in rows
    ]
    contents = {"table.md": "\n".join(text), "table.csv": out.getvalue(), "table.json": json.dumps(records, indent=1) + "\n"}
    return [replace_file(plan.folder / name, content) for name, content in contents.items()]

"""What the command line shows: progress bars while something is under way, and tables of what came of it."""

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress

    from .capture import TrueJoint
    from .evaluate import JointScore, Report, SurfaceScore
    from .fit.events import Finished, FitEvent, Step
    from .model import ArticulatedObject
    from .view import LivePage

# Packages that cost a second or more to import are imported where they are used: `--help` must not wait for them.

_COMPILING = "compiling for this processor, once and for all: this first run takes a minute longer"


def follow(events: "Iterable[FitEvent]", page: "LivePage | None" = None) -> "Finished":
    """Shows a fit's events as progress bars and lines, and its object on a page, until it is finished."""
    from .fit.events import Finished, Note, Preview, StageStarted, Step
    from .jit import when_compiling

    with bars() as progress, when_compiling(lambda: progress.console.print(_COMPILING)):
        task = None
        for event in events:
            match event:
                case StageStarted(stage, steps):
                    task = progress.add_task(stage, total=steps, figures="")
                case Step(step=step) if task is not None:
                    progress.update(task, completed=step, figures=_figures(event))
                case Note(text):
                    progress.console.print(text)
                case Preview(make) if page is not None:
                    page.show(make())
                case Finished(obj):
                    if page is not None:
                        page.show(obj)
                    return event
    raise RuntimeError("the fit ended without a result; run the same command to go on.")


def bars() -> "Progress":
    """Progress bars with what is under way and the time left."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = ("{task.description:12}", BarColumn(), MofNCompleteColumn(), "{task.fields[figures]}", TimeRemainingColumn())
    return Progress(*(TextColumn(c) if isinstance(c, str) else c for c in columns))


def _figures(step: "Step") -> str:
    if step.loss is None:
        return ""
    psnr = "" if step.psnr is None else f"  PSNR {step.psnr:.1f}"
    return f"loss {step.loss:.4f}{psnr}  {step.splats} splats"


def print_joints(obj: "ArticulatedObject") -> None:
    """One row for each joint, and a line for each that a human should look at."""
    _print_table(
        ("part", "type", "axis", "origin", "moved by", "confidence"),
        [
            (str(k), j.kind, _vector(j.axis), _vector(j.origin), _amount(j.kind, j.q[1]), f"{j.confidence:.2f}")
            for k, j in enumerate(obj.joints, start=1)
        ],
    )
    for k, joint in enumerate(obj.joints, start=1):
        if joint.review:
            print(f"part {k}, please look: {joint.review}")


def print_report(report: "Report") -> None:
    """The table of a report, in its protocol's units."""
    from .evaluate import PROTOCOLS

    unit = PROTOCOLS[report.protocol].printed_unit
    position = "position" if unit == 1 else f"position ({unit:g} units)"
    heads = ("part", "type", "truth", "axis", position, "geodesic", "translation")
    if report.joints:
        _print_table(heads, [_score_row(score, unit) for score in report.joints])
        print(f"{report.failures} of {len(report.joints)} joints failed; degrees, and the capture's unit unless marked")
    else:
        print("no ground truth beside the capture, so no joints are compared; give it with --truth")
    for k in report.unmatched_parts:
        print(f"part {k} stands for no true joint")
    if report.psnr is not None:
        states = ", ".join("-" if p is None else f"{p:.2f}" for p in report.psnr_by_state)
        inside = "" if report.psnr_object is None else f"; object's own pixels {report.psnr_object:.2f}"
        print(f"PSNR of held-out views {report.psnr:.2f} dB (states 0, 1: {states}{inside})")
    if report.surfaces is not None:
        _print_surfaces(report.surfaces)
    if report.seconds is not None:
        print(f"fitted in {report.seconds:.0f} s")


def _print_surfaces(score: "SurfaceScore") -> None:
    distances = (score.cd_static, score.cd_movable, score.cd_whole)
    shown = (
        f"{what} {'F' if d is None else f'{d:.3f}'}" for what, d in zip(("static", "movable", "whole"), distances, strict=True)
    )
    print(f"Chamfer distances of surfaces x1000: {', '.join(shown)}")
    if score.accuracy is not None and score.completeness is not None:
        print(f"whole surface: accuracy {score.accuracy:.4f}, completeness {score.completeness:.4f} units")


def _score_row(score: "JointScore", unit: float) -> tuple[str, ...]:
    errors = (score.axis_angle_deg, score.axis_position, score.geodesic_deg, score.translation)
    scales = (1.0, unit, 1.0, 1.0)
    shown = ("F" if score.failed else "-" if e is None else f"{e / s:.4f}" for e, s in zip(errors, scales, strict=True))
    return ("-" if score.part is None else str(score.part), score.kind or "-", score.kind_true, *shown)


def print_truth(obj: "ArticulatedObject", truth: "Iterable[TrueJoint]", report: "Report") -> None:
    """What was found, row by row beside what is true."""
    rows = []
    for true, score in zip(truth, report.joints, strict=True):
        if score.part is not None:
            joint = obj.joints[score.part - 1]
            rows.append((f"part {score.part}", joint.kind, _vector(joint.axis), _amount(joint.kind, joint.q[1])))
        rows.append(("truth", true.kind, _vector(true.axis), _amount(true.kind, true.q1 - true.q0)))
    _print_table(("", "type", "axis", "moved by"), rows)
    print_report(report)


def _print_table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(*heads)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def _vector(values: tuple[float, float, float]) -> str:
    return " ".join(f"{v:+.3f}" for v in values)


def _amount(kind: str, q: float) -> str:
    return f"{math.degrees(q):.2f} deg" if kind == "revolute" else f"{q:.4f} units"

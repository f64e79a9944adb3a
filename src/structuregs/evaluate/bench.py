"""Many captures fitted and scored: one process for each fit, taken up again where it was left."""

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..files import replace_file
from .report import Report

_COMMAND = (sys.executable, "-c", "from structuregs.cli import main; main()")


@dataclass(frozen=True)
class Bench:
    """What is fitted and how.

    Attributes:
        captures: their folders.
        folder: where runs and tables go.
        views: numbers of views of each state to fit with; None for all.
        seeds: of the fits.
        preset: of the fits.
        protocol: of the scores.
        device: of the fits.
        at_once: fits at a time; each gets its share of the cores.
    """

    captures: tuple[Path, ...]
    folder: Path
    views: tuple[int | None, ...] = (None,)
    seeds: tuple[int, ...] = (0, 1, 2)
    preset: str = "default"
    protocol: str = "paris"
    device: str = "auto"
    at_once: int = 1


@dataclass(frozen=True)
class BenchRow:
    """One fit and what became of it.

    Attributes:
        capture: the capture's folder.
        views: of each state; None for all.
        seed: of the fit.
        report: `Report.as_json` of the run, with the most memory that the fit held as `peak_gb`; None where it failed.
        error: what a failed fit said last; empty otherwise.
    """

    capture: Path
    views: int | None
    seed: int
    report: dict[str, Any] | None
    error: str = ""


def bench(plan: Bench) -> Iterator[BenchRow]:
    """Fits and scores, and yields each fit when it is done; what lies finished in the folder is not done again.

    A fit that fails is a row like others, and is tried again by the next call.
    """
    plan.folder.mkdir(parents=True, exist_ok=True)
    names = _names(plan.captures)
    jobs = [(c, v, s) for v in plan.views for s in plan.seeds for c in plan.captures]
    with ThreadPoolExecutor(plan.at_once) as pool:
        futures = [pool.submit(_row, plan, names[capture], capture, views, seed) for capture, views, seed in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            for future in futures:
                future.cancel()


def _names(captures: Sequence[Path]) -> dict[Path, str]:
    """A name for each capture: its folder's, with as many above it as tell it from the others."""
    depth = 1
    while len({"_".join(c.parts[-depth:]) for c in captures}) < len(set(captures)):
        depth += 1
    return {c: "_".join(c.parts[-depth:]) for c in captures}


def _row(plan: Bench, name: str, capture: Path, views: int | None, seed: int) -> BenchRow:
    run = plan.folder / "runs" / f"{name}_{plan.preset}_{'all' if views is None else views}_{seed}"
    file = run.with_name(f"{run.name}_{plan.protocol}.json")
    if (report := _finished(file)) is None:
        run.parent.mkdir(parents=True, exist_ok=True)
        options = ["--preset", plan.preset, "--seed", str(seed), "--device", plan.device]
        options += [] if views is None else ["--views", str(views)]
        try:
            peak = _call(plan, run, "fit", str(capture), "-o", str(run), *options)
            staged = file.with_name(f"{run.name}.eval.json")
            _call(plan, run, "eval", str(run), "--protocol", plan.protocol, "--json", str(staged))
        except RuntimeError as error:
            return BenchRow(capture, views, seed, None, str(error))
        # On a run that was taken up again the memory is that of its last sitting.
        report = json.loads(staged.read_text()) | {"peak_gb": peak}
        replace_file(file, json.dumps(report, indent=1) + "\n")
        staged.unlink()
    return BenchRow(capture, views, seed, report)


def _finished(file: Path) -> dict[str, Any] | None:
    """The report of an earlier call; None if there is none, or one of a version that did not count all that this one does."""
    report = json.loads(file.read_text()) if file.exists() else {}
    fields = {field.name for field in dataclasses.fields(Report)} - {"surfaces"}
    return report if fields <= report.keys() else None


def _call(plan: Bench, run: Path, *words: str) -> float:
    """Runs a command, its output in a log beside the run; the most memory that it held, GB.

    Raises:
        RuntimeError: it failed; the message is the last line of the log.
    """
    threads = str(max(1, (os.cpu_count() or 1) // plan.at_once))
    environment = os.environ | {"OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads}
    log = run.with_name(run.name + ".log")
    with log.open("a") as out:
        process = subprocess.Popen([*_COMMAND, *words], env=environment, stdout=out, stderr=out)
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.terminate()
            raise
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        said = [line for line in log.read_text().splitlines() if line.strip()]
        raise RuntimeError(said[-1] if said else f"{words[0]} ended with {process.returncode}; see {log}")
    return usage.ru_maxrss / 2**20

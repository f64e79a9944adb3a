"""Fits and evaluates captures, and writes what came of it as a table.

    python benchmarks/captures.py CAPTURE... -o RUNS [--preset default] [--seeds 0 1 2] [--views N] [--device auto]
        [--jobs 1] [--table FILE]

Every fit is `structuregs fit` in a process of its own, one after the other or `--jobs` at a time (each then with its share
of the cores), and its run is kept in RUNS: what is finished is not done again.  The table has a row for each joint, the
worst of all seeds.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

STRUCTUREGS = (sys.executable, "-c", "from structuregs.cli import main; main()")
HEAD = (
    *("capture", "joint", "axis deg", "position", "turn deg", "slide", "PSNR"),
    *("CD static", "CD movable", "CD whole", "seconds", "peak GB"),
)


@dataclass(frozen=True)
class Job:
    """One fit of one capture."""

    capture: Path
    preset: str
    seed: int
    views: int | None
    runs: Path
    threads: int
    device: str

    @property
    def run(self) -> Path:
        """The folder of its run."""
        views = f"_{self.views}_views" if self.views else ""
        return self.runs / f"{self.capture.name}_{self.preset}{views}_{self.seed}"

    @property
    def report(self) -> Path:
        """What `eval` says of it, with the most memory that the fit held."""
        return self.run.with_suffix(".json")

    def work(self) -> None:
        """Fits and evaluates, unless that has been done."""
        if self.report.exists():
            return
        threads = {"OMP_NUM_THREADS": str(self.threads), "NUMBA_NUM_THREADS": str(self.threads)}
        options = ["--preset", self.preset, "--seed", str(self.seed), "--device", self.device]
        options += ["--views", str(self.views)] if self.views else []
        peak = self._call("fit", str(self.capture), "-o", str(self.run), *options, threads=threads)
        staged = self.report.with_suffix(".part")
        self._call("eval", str(self.run), "--protocol", "paris", "--json", str(staged), threads=threads)
        record = json.loads(staged.read_text()) | {"peak_gb": peak}
        self.report.write_text(json.dumps(record, indent=1) + "\n")
        staged.unlink()
        print(f"{self.run.name}: {record['failures']} failures, {record['seconds']:.0f} s, {peak:.2f} GB", flush=True)

    def _call(self, *words: str, threads: dict[str, str]) -> float:
        """Runs a command, its output in a log beside the run; the most memory that it held, GB."""
        with self.run.with_suffix(".log").open("a") as log:
            process = subprocess.Popen([*STRUCTUREGS, *words], env=os.environ | threads, stdout=log, stderr=log)
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"structuregs {' '.join(words)}: ended with {process.returncode}; see {log.name}.")
        return usage.ru_maxrss / 2**20


def worst(values: Sequence[float | None], digits: int) -> str:
    """The largest of the known values."""
    known = [value for value in values if value is not None]
    return f"{max(known):.{digits}f}" if known else ""


def rows(jobs: Sequence[Job]) -> list[tuple[str, ...]]:
    """A row for each true joint of a capture, over the seeds of its jobs."""
    reports = [json.loads(job.report.read_text()) for job in jobs]
    seconds = " to ".join(f"{s:.0f}" for s in sorted({min(r["seconds"] for r in reports), max(r["seconds"] for r in reports)}))
    extra = max(len(r["unmatched_parts"]) for r in reports)
    found = []
    for k, joint in enumerate(reports[0]["joints"]):
        seen = [r["joints"][k] for r in reports]
        failed = sum(j["failed"] for j in seen)
        kind = joint["kind_true"] + (f" (F in {failed} of {len(seen)})" if failed else "")
        measures = [("axis_angle_deg", 3), ("axis_position", 4), ("geodesic_deg", 3), ("translation", 4)]
        figures = [worst([None if j["failed"] else j[name] for j in seen], digits) for name, digits in measures]
        if k:
            found.append(("", kind, *figures, "", "", "", "", "", ""))
            continue
        whole = [worst([r[name] for r in reports], 2) for name in ("cd_static", "cd_movable", "cd_whole")]
        name = jobs[0].capture.name + (f" (and {extra} parts too many)" if extra else "")
        peak = f"{max(r['peak_gb'] for r in reports):.2f}"
        found.append((name, kind, *figures, f"{min(r['psnr'] for r in reports):.1f}", *whole, seconds, peak))
    return found


def table(jobs: Sequence[Job]) -> str:
    """The table of all jobs in Markdown."""
    lines = [HEAD, ("---",) * len(HEAD)]
    for capture in dict.fromkeys(job.capture for job in jobs):
        lines += rows([job for job in jobs if job.capture == capture])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("-o", "--runs", type=Path, required=True)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--views", type=int)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--table", type=Path, help="write the table here too, for the repository")
    given = parser.parse_args()
    given.runs.mkdir(parents=True, exist_ok=True)
    threads = max(1, (os.cpu_count() or 1) // given.jobs)
    jobs = [
        Job(capture.resolve(), given.preset, seed, given.views, given.runs, threads, given.device)
        for seed in given.seeds
        for capture in given.captures
    ]
    with ThreadPoolExecutor(given.jobs) as pool:
        list(pool.map(Job.work, jobs))
    views = f"{given.views} views of each state" if given.views else "all views"
    seeds = ", ".join(str(seed) for seed in given.seeds)
    cores = f"{given.jobs} fits at a time with {threads} threads each"
    head = f"Preset `{given.preset}`, {views}, worst of seeds {seeds}; {cores}.\n\n"
    print(head + table(jobs))
    if given.table:
        given.table.write_text(head + table(jobs))


if __name__ == "__main__":
    main()

"""The command line: `structuregs fit | eval | render | export | view | bench | study | demo`."""

import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from .console import bars, follow, print_joints, print_report, print_truth

if TYPE_CHECKING:
    from .model import ArticulatedObject

# Packages that cost a second or more to import are imported in the commands: `--help` must not wait for them.

Preset = Literal["fast", "default", "paper"]
CaptureFolder = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")]
RunFolder = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
NewRun = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="RUN")]
Picture = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]


def fit(
    capture: CaptureFolder,
    run: NewRun,
    preset: Preset = "default",
    views: int | None = None,
    parts: int | None = None,
    seed: int = 0,
    points: str = "hull",
    device: Literal["auto", "cpu", "cuda"] = "auto",
    view: bool = False,
) -> None:
    """Reconstruct the object of a capture; on an existing run, go on from its last checkpoint.

    Args:
        capture: Folder of the capture, in the PARIS or the ArtGS layout.
        run: Folder of the run.
        preset: fast: a look in about a minute. default: accurate. paper: the paper's iterations and rates.
        views: Use this many views of each state, spread over the cameras. Default: all.
        parts: Number of moving parts. Default: estimated.
        seed: The same seed gives the same bytes on a CPU.
        points: Where the first points come from: hull (masks), depth (the capture's depth maps), vggt or pi3
            (pretrained models that you install), or a file.
        device: Where to compute.
        view: Show the object in the browser while it is fitted.
    """
    _fit(capture, run, preset=preset, views=views, parts=parts, seed=seed, points=points, device=device, view=view)


def evaluate(
    run: RunFolder,
    truth: Path | None = None,
    protocol: Literal["paris", "artgs", "strict"] = "strict",
    json: Path | None = None,
) -> None:
    """Compare a run with ground truth and with the held-out views of its capture.

    Args:
        run: Folder of the run.
        truth: Folder of the ground truth. Default: where the capture's layout keeps it.
        protocol: paris, artgs: as those benchmarks print their figures. strict: also PSNR over the object's own pixels.
        json: Write the figures to this file too; distances are in the capture's unit under every protocol.
    """
    from .evaluate import evaluate_run, write_report

    report = evaluate_run(run, truth=truth, protocol=protocol)
    if json is not None:
        write_report(report, json)
    print_report(report)


def render(run: RunFolder, output: Picture, size: int = 480, frames: int = 48, view: str | None = None) -> None:
    """Draw the joints of a run swept there and back.

    Args:
        run: Folder of the run.
        output: .webp, .gif or .mp4: an animation. .png: state 0, half way and state 1. A folder: a PNG for each frame.
        size: Longer side of the pictures, pixels.
        frames: Frames of the whole way.
        view: Name of a view of state 1 to look from. Default: the one that shows most of the motion.
    """
    from .capture import load_capture
    from .evaluate import capture_of_run
    from .export import telling_order, write_sweep
    from .model import load_object

    obj = load_object(run / "object")
    cameras = {row.name: row.camera for row in load_capture(capture_of_run(run)).train[1]}
    if view is not None and view not in cameras:
        raise ValueError(
            f"--view {view}: the capture has no such view in state 1; they run from {min(cameras)} to {max(cameras)}."
        )
    names = list(cameras)
    camera = cameras[view if view is not None else names[telling_order(obj, list(cameras.values()))[0]]]
    scale = size / max(camera.width, camera.height)
    camera = camera.resized(round(camera.width * scale), round(camera.height * scale))
    files = write_sweep(obj, camera, output, frames=frames)
    print(f"wrote {output}" + (f" ({len(files)} pictures)" if len(files) > 1 else ""))


def export(
    run: RunFolder,
    to: str = "mesh,urdf,mjcf,usd,ply,glb,html",
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = None,
    scale: float = 1.0,
    limit_margin: float = 0.0,
) -> None:
    """Write the files that simulators, viewers and browsers open: a folder for each format.

    Args:
        run: Folder of a finished run.
        to: Formats, with commas between. mesh: OBJ and PLY. urdf, mjcf, usd: simulators. ply, glb: splats. html: a page.
        output: Where the folders go. Default: `export` in the run.
        scale: Metres per unit of the capture, for simulators and GLB.
        limit_margin: How far joints may go beyond the observed range, radians or metres.
    """
    from .evaluate import training_capture
    from .export import checked_formats, export_files, steps_of
    from .model import load_object

    formats = checked_formats([name.strip() for name in to.split(",") if name.strip()])
    obj, folder = load_object(run / "object"), output or run / "export"
    title = run.resolve().name
    done = export_files(obj, training_capture(run), folder, formats, title=title, scale=scale, limit_margin=limit_margin)
    with bars() as progress:
        steps = steps_of(formats)
        task = progress.add_task("export", total=len(steps), figures=steps[0])
        for step, coming in zip(done, [*steps[1:], ""], strict=True):
            for file in step.files:
                progress.console.print(f"wrote {file}", soft_wrap=True)
            progress.update(task, advance=1, figures=coming)


def view(run: RunFolder, port: int = 0) -> None:
    """Show the object of a run in the browser, with a slider for each joint, until Ctrl-C.

    Args:
        run: Folder of a finished run.
        port: Where the page is served, to this machine only. Default: any free port.
    """
    from .model import load_object
    from .view import serve

    obj = load_object(run / "object")
    serve(obj, title=run.resolve().name, port=port, ready=lambda url: print(f"look at {url} (Ctrl-C ends)", flush=True))


def bench(
    captures: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FOLDER|LIST")],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")],
    views: str = "all",
    seeds: str = "0,1,2",
    preset: Preset = "default",
    protocol: Literal["paris", "artgs", "strict"] = "paris",
    device: Literal["auto", "cpu", "cuda"] = "auto",
    at_once: int = 1,
) -> None:
    """Fit and score many captures, and write tables beside the published figures; run it again to go on.

    Args:
        captures: Folders of captures or above them, or files that list such folders, one a line.
        output: Folder of the runs and of table.md, table.csv and table.json.
        views: Numbers of views of each state to fit with, with commas between; all: every view.
        seeds: Seeds to fit with, with commas between.
        preset: As `fit` takes it.
        protocol: As `eval` takes it.
        device: Where to compute.
        at_once: Fits at a time; the cores are shared out between them.
    """
    from .capture import find_captures
    from .evaluate import Bench, write_tables
    from .evaluate import bench as run_bench

    if not captures:
        raise ValueError("nothing to fit; give folders of captures, or files that list them.")
    if at_once < 1:
        raise ValueError(f"--at-once {at_once}: give 1 or more.")
    found = tuple(dict.fromkeys(folder.resolve() for path in captures for folder in find_captures(path)))
    wanted = tuple(None if word == "all" else _number(word, "--views") for word in _words(views, "--views"))
    numbers = tuple(_number(word, "--seeds") for word in _words(seeds, "--seeds"))
    plan = Bench(found, output, wanted, numbers, preset, protocol, device, at_once)
    rows = []
    with bars() as progress:
        task = progress.add_task("bench", total=len(found) * len(wanted) * len(numbers), figures="")
        for row in run_bench(plan):
            rows.append(row)
            failures = row.error or f"{row.report['failures'] if row.report else 0} joints failed"
            count = "all" if row.views is None else row.views
            progress.console.print(f"{row.capture.name}, {count} views, seed {row.seed}: {failures}", soft_wrap=True)
            progress.update(task, advance=1, figures=row.capture.name)
            files = write_tables(plan, rows)
    print(f"wrote {', '.join(str(file) for file in files)}")


def _words(text: str, option: str) -> list[str]:
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words:
        raise ValueError(f"{option}: nothing is given; write values with commas between.")
    return words


def _number(word: str, option: str) -> int:
    if not word.isdigit():
        raise ValueError(f"{option} {word}: not a whole number.")
    return int(word)


def study(
    kind: Annotated[tyro.conf.Positional[Literal["robustness", "ablation", "variations"]], tyro.conf.arg(metavar="STUDY")],
    capture: CaptureFolder,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="DIR")],
    preset: Preset = "default",
    views: int | None = 10,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> None:
    """Fit a capture under other conditions, and write how the results differ; run it again to go on.

    Args:
        kind: robustness: from bad starts, as section 2 of the paper's supplement. ablation: one choice of the fit undone at
            a time. variations: worse and other photos.
        capture: Folder of the capture.
        output: Folder of the runs and of STUDY.md, STUDY.html and error_maps.png.
        preset: As `fit` takes it.
        views: Use this many views of each state; None: all.
        seed: As `fit` takes it.
        device: Where to compute.
    """
    from .capture import find_truth, load_capture, load_truth
    from .evaluate import Study
    from .fit.schedule import PRESETS

    photos = load_capture(capture, views=views, seed=seed)
    truth = find_truth(photos)
    plan = Study(kind, photos, output, PRESETS[preset], device, seed)
    settings = plan.settings()
    for setting in settings:
        print(f"{kind}: {setting.says}", flush=True)
        follow(plan.events(setting))
    files = plan.write(settings, load_truth(truth) if truth else None)
    print("wrote " + ", ".join(map(str, files)))


def demo(run: NewRun = Path("runs/demo")) -> None:
    """Make a small capture of a known object on the spot, reconstruct it, and print its joints beside the truth.

    Args:
        run: Folder of the run; the capture is made in its `capture` folder.
    """
    from .capture import load_capture, load_truth
    from .evaluate import evaluate_object

    capture = run / "capture"
    truth = load_truth(_make_known(capture))
    obj = _fit(capture, run, preset="fast")
    print_truth(obj, truth.joints, evaluate_object(obj, load_capture(capture), truth))


def _make_known(capture: Path) -> Path:
    """Makes the demo's capture where it is not there yet, aside and then into place; the folder of its truth."""
    from .synthetic import Lighting, RenderOptions, make_capture, make_object, save_known

    if not capture.exists():
        print(f"making a capture of a cabinet with a door and a drawer in {capture}")
        cabinet = make_object("cabinet")
        staged = capture.with_name("capture.part")
        save_known(
            cabinet, make_capture(cabinet, RenderOptions(size=256, views=40, lighting=Lighting(ambient=0.75))), staged, "artgs"
        )
        staged.replace(capture)
    return capture / "gt"


def _fit(
    capture: Path,
    run: Path,
    *,
    preset: Preset,
    views: int | None = None,
    parts: int | None = None,
    seed: int = 0,
    points: str = "hull",
    device: Literal["auto", "cpu", "cuda"] = "auto",
    view: bool = False,
) -> "ArticulatedObject":
    from .capture import load_capture
    from .export import write_report, write_structure
    from .fit.reconstruct import fit_run
    from .fit.run import RunFolder
    from .fit.schedule import PRESETS

    photos = load_capture(capture, views=views, seed=seed)
    events = fit_run(photos, run, PRESETS[preset], device=device, parts=parts, points=points, seed=seed)
    with ExitStack() as stack:
        page = None
        if view:
            from .view import LivePage

            page = stack.enter_context(LivePage(photos.name))
            print(f"look at {page.url}", flush=True)
        obj = follow(events, page).obj
        photos = RunFolder(run).put_right(photos)
        write_structure(photos, obj, run / "overview.png")
        report = write_report(run, photos, obj)
    print_joints(obj)
    print(f"wrote {run}; look at {report}")
    return obj


def main() -> None:
    """Runs the command line; a user's error is one sentence and exit code 2 (`STRUCTUREGS_DEBUG=1` shows the traceback)."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            {
                "fit": fit,
                "eval": evaluate,
                "render": render,
                "view": view,
                "export": export,
                "bench": bench,
                "study": study,
                "demo": demo,
            },
            prog="structuregs",
            description="Photos of an articulated object in two states go in; a working digital twin comes out.",
        )
    except KeyboardInterrupt:
        print("interrupted; run the same command to go on", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # the reader of a pipe left, as `| head` does; nobody is there to be told
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except (ValueError, RuntimeError, OSError) as error:
        if os.environ.get("STRUCTUREGS_DEBUG"):
            raise
        print("structuregs: " + " ".join(str(error).split()), file=sys.stderr)
        sys.exit(2)

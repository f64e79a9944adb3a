"""How fast the renderer and the fit are, against this machine's limits and against what was measured before.

    python benchmarks/speed.py [--sections stages growth] [--device cpu|cuda] [--json FILE] [--against FILE]

stages  every stage of one image with its loss (800 px, 30,000 splats), and the share of the machine's peak that it reaches:
        operations for what computes, bytes for what moves data; both peaks are measured in the same run.
growth  whole iterations of a fit (one view of either state, all losses, the optimiser): presets, and how they grow with
        pixels, splats, parts, views and threads.

`--json` keeps the figures; `--against` holds this run against kept ones and says what got worse: every time is first divided
by that of a fixed load, so that a slower machine is not taken for slower code.  The exit code is then 1.
"""

import argparse
import json
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import torch
from machine import peaks
from raster import make_scene

from structuregs.capture import Capture, View
from structuregs.fit.densify import grow
from structuregs.fit.loop import Fitter
from structuregs.fit.schedule import PRESETS, FitConfig
from structuregs.fit.state import FitState
from structuregs.geometry import SE3, Box, Camera
from structuregs.model import PosedParts, Splats
from structuregs.raster import blend_kernels as bk
from structuregs.raster import image_loss, project, render
from structuregs.raster.records import MIN_ALPHA

WORSE = 1.25  # times slower than before, machines allowed for: what is reported
# Operations for a pixel of a splat's rows in a tile, counted in the kernels' sources (a multiply-add is two, a division,
# a comparison or a conversion one), and for a pixel of the image loss: two blurs of four and of three images.
FORWARD_OPERATIONS, BACKWARD_OPERATIONS = 38, 72
LOSS_OPERATIONS = 3 * 2 * (4 + 3) * (11 + 6)


def measured(function: Callable[[], object], repeats: int = 12) -> float:
    """Median milliseconds, after two rounds that compile and warm up."""
    times = []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        function()
        times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times[2:])


def rows_reached(
    starts: np.ndarray, ends: np.ndarray, splats: np.ndarray, xy: np.ndarray, extent: np.ndarray, across: int
) -> float:
    """Rows of tiles' pixels that the lists' splats span; each is one vector of 16."""
    tile = np.repeat(np.arange(len(ends)), ends - starts[:-1])
    drawn = np.concatenate([splats[a:b] for a, b in zip(starts[:-1], ends, strict=True)])
    top = tile // across * bk.TILE
    low = np.maximum(np.ceil(xy[drawn, 1] - 0.5 - extent[drawn, 1]), top)
    high = np.minimum(np.floor(xy[drawn, 1] - 0.5 + extent[drawn, 1]), top + bk.TILE - 1)
    return float(np.maximum(high - low + 1, 0).sum())


def stages(operations: float, moved: float) -> list[tuple[str, float, float]]:
    """Name, milliseconds, and share of the peak of every stage of one image.

    Args:
        operations: the machine's, billions per second.
        moved: the machine's gigabytes per second.
    """
    splats, camera, target, target_alpha = make_scene(30_000, 800)
    threads = numba.get_num_threads()
    leaves = Splats(**{name: value.clone().requires_grad_() for name, value in splats.tensors().items()})
    seen = project(leaves, camera)
    p = {name: value.detach().numpy() for name, value in vars(seen).items()}
    tables = p["xy"], p["conic"], p["opacity"], p["rgb"], p["depth"], p["extent"]
    drawing, reach = bk.pack(*tables)
    order = bk.depth_order(p["depth"], p["extent"])
    starts, lists = bk.tile_lists(reach, order, camera.width, camera.height, threads)
    size = (camera.height, camera.width)
    drawn = [np.empty((*size, 3), np.float32), np.empty(size, np.float32), np.empty(size, np.float32)]
    ends, behind = np.empty(len(starts) - 1, np.int64), np.ones(3, np.float32)
    bk.blend_forward(starts, lists, drawing, behind, threads, *drawn, ends)
    rng = np.random.default_rng(0)
    incoming = [rng.standard_normal((*size, 3), np.float32), rng.standard_normal(size, np.float32)]
    partials = np.empty((len(lists), bk.PARTIALS), np.float32)
    rows = rows_reached(starts, ends, lists, p["xy"], p["extent"], -(-camera.width // bk.TILE))
    pairs, count = float((ends - starts[:-1]).sum()), len(splats)
    rgb, alpha = (torch.from_numpy(image).requires_grad_() for image in drawn[:2])

    def projecting() -> None:
        out = project(leaves, camera)
        torch.autograd.backward([out.xy, out.conic, out.opacity], [out.xy, out.conic, out.opacity])

    def losing() -> None:
        image_loss(rgb, alpha, target, target_alpha).backward()

    def filling(kernel: Callable[..., object], *arguments: object) -> Callable[[], object]:
        return lambda: kernel(*arguments)

    covered = float((target_alpha > MIN_ALPHA).float().mean())
    compute, stream = operations * 1e9, moved * 1e9
    table = [
        ("project, both ways", measured(projecting), stream, 4.0 * count * (11 + 9 + 9 + 11)),
        ("pack", measured(filling(bk.pack, *tables)), stream, 4.0 * count * (12 + 24)),
        ("sort by depth", measured(filling(bk.depth_order, p["depth"], p["extent"])), stream, 4.0 * count * 3 * 4),
        (
            "tile lists",
            measured(filling(bk.tile_lists, reach, order, camera.width, camera.height, threads)),
            stream,
            4.0 * (3 * 8 * count + pairs),
        ),
        (
            "blend forward",
            measured(filling(bk.blend_forward, starts, lists, drawing, behind, threads, *drawn, ends)),
            compute,
            rows * bk.TILE * FORWARD_OPERATIONS,
        ),
        (
            "blend backward",
            measured(filling(bk.blend_backward, starts, lists, drawing, ends, threads, *drawn, *incoming, None, partials)),
            compute,
            rows * bk.TILE * BACKWARD_OPERATIONS,
        ),
        (
            "sum of the tiles' gradients",
            measured(filling(bk.sum_partials, starts, ends, lists, partials, p["conic"], p["opacity"], threads)),
            stream,
            4.0 * (pairs * (bk.PARTIALS + 1) + count * 2 * bk.PARTIALS),
        ),
        ("image loss, both ways", measured(losing), compute, covered * alpha.numel() * LOSS_OPERATIONS),
    ]
    return [(name, ms, amount / (ms * 1e-3) / peak) for name, ms, peak, amount in table]


def drawers(parts: int, splats: int, seed: int = 0) -> PosedParts:
    """A row of boxes whose faces are covered with splats; all but the first slide out of the row."""
    generator = torch.Generator().manual_seed(seed)
    each = splats // parts
    counts = (splats - each * (parts - 1), *[each] * (parts - 1))
    half = torch.tensor([0.9 / parts, 0.6, 0.5])
    centres = torch.stack([torch.linspace(-0.9, 0.9, 2 * parts + 1)[1::2], torch.zeros(parts), torch.zeros(parts)], -1)
    motions = SE3.identity(parts)
    motions.wxyz_xyz[1:, 5] = 0.5
    means = 2 * torch.rand(splats, 3, generator=generator) - 1
    axis = torch.randint(3, (splats,), generator=generator)
    means[torch.arange(splats), axis] = means[torch.arange(splats), axis].sign()
    size = 0.7 * (12.0 / splats) ** 0.5  # about what covers the faces once
    thin = torch.where(torch.nn.functional.one_hot(axis, 3) > 0, 0.1, 1.0)
    scales = (size * thin * torch.exp(0.3 * torch.randn(splats, 3, generator=generator))).log()
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(splats, 1)
    opacities = torch.randn(splats, generator=generator)
    colours = torch.rand(splats, 1, 3, generator=generator) - 0.5
    boxes = Box(SE3.from_quat(torch.tensor([1.0, 0, 0, 0]).repeat(parts, 1), centres), half.repeat(parts, 1))
    return PosedParts(boxes, motions, Splats(means, quats, scales, opacities, colours), counts, torch.zeros(splats, 3))


def photographed(parts: PosedParts, views: int, size: int) -> Capture:
    """A capture of the parts from a ring of cameras."""
    states = []
    for state in (0, 1):
        splats, images = parts.at_state(state), []
        for v in range(views):
            angle = 2 * np.pi * v / views
            forward = -torch.nn.functional.normalize(
                torch.tensor([np.cos(angle), np.sin(angle), 0.5], dtype=torch.float32), dim=0
            )
            right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0, 1])), dim=0)
            R = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
            camera = Camera(SE3.from_rotation(R, -4.2 * forward), 1.6 * size, 1.6 * size, size / 2, size / 2, size, size)
            image = render(splats, camera)
            rgba = torch.cat([image.rgb.clamp(0, 1), (image.alpha > 0.5).float()[..., None]], -1)
            images.append(View(f"{v:03d}", camera, (rgba * 255).round().to(torch.uint8).numpy()))
        states.append(tuple(images))
    return Capture("drawers", Path(), (states[0], states[1]), ((), ()), "memory")


def iteration(config: FitConfig, device: str, *, px: int, splats: int, parts: int, views: int, steps: int = 12) -> float:
    """Median milliseconds of one whole iteration, half way through the fit; nothing is densified meanwhile."""
    truth = drawers(parts, splats)
    capture = photographed(truth, views, px)
    begin = round(0.55 * config.steps)
    config = replace(config, sizes=((0.0, px),), one_joint_from=1.0, join_at=2.0, growth=replace(config.growth, interval=10**9))
    state = FitState.start(drawers(parts, splats, seed=1).to(torch.device(device)))
    state.variables, *_ = grow(state.variables, None, config.growth, state.size, torch.Generator())  # puts splats in order
    state.step = begin
    fitter = Fitter(capture, config, state, 0, torch.device(device))
    times = []
    for k in range(steps + 3):
        start = time.perf_counter()
        list(fitter.run(begin + k + 1))
        if device == "cuda":
            torch.cuda.synchronize()
        times.append((time.perf_counter() - start) * 1e3)
    return statistics.median(times[3:])


def growth(device: str) -> list[tuple[str, float]]:
    """Name and milliseconds of whole iterations."""
    paper, usual = PRESETS["paper"], PRESETS["default"]
    base = {"px": 800, "splats": 50_000, "parts": 2, "views": 10}
    rows = [("paper", paper, base)]
    rows += [("default, last quarter", usual, base | {"px": 400, "splats": 25_000})]
    rows += [(f"paper, {px} px", paper, base | {"px": px}) for px in (200, 400, 800, 1600)]
    rows += [(f"paper, {n:,} splats", paper, base | {"splats": n}) for n in (10_000, 30_000, 120_000, 300_000, 1_000_000)]
    rows += [(f"paper, {n} parts", paper, base | {"parts": n}) for n in (2, 3, 5, 8)]
    rows += [(f"paper, 200 px, {n} views", paper, base | {"px": 200, "views": n}) for n in (10, 100, 400)]
    figures = []
    for name, config, sizes in rows:
        figures.append((name, iteration(config, device, **sizes)))
        print(f"  {name:34} {figures[-1][1]:9.1f} ms", flush=True)
    if device == "cpu" and numba.get_num_threads() > 1:
        before = numba.get_num_threads()
        numba.set_num_threads(1)
        figures.append(("paper, 1 thread", iteration(paper, device, **base)))
        numba.set_num_threads(before)
        print(f"  {figures[-1][0]:34} {figures[-1][1]:9.1f} ms")
    return figures


def compare(now: dict, before: dict) -> list[str]:
    """What got worse, as sentences."""
    pace = before["operations"] / now["operations"]  # > 1: this machine is the slower one
    worse = []
    for name, ms in now["milliseconds"].items():
        old = before["milliseconds"].get(name)
        if old is not None and ms / old > WORSE * max(pace, 1.0):
            worse.append(f"{name}: {ms:.1f} ms, before {old:.1f} ms on a machine {pace:.2f} times as fast")
    return worse


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sections", nargs="+", choices=("stages", "growth"), default=["stages", "growth"])
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--json", type=Path, help="where to keep the figures")
    parser.add_argument("--against", type=Path, help="figures that were kept")
    args = parser.parse_args()
    torch.set_num_threads(1)  # as `fit` does
    operations, moved = peaks()
    device = torch.cuda.get_device_name() if args.device == "cuda" else platform.processor() or platform.machine()
    print(f"{device}, {numba.get_num_threads()} threads: {operations:.0f} billion operations/s, {moved:.1f} GB/s copied")
    figures: dict[str, float] = {}
    if "stages" in args.sections and args.device == "cpu":
        print("One image, 800 px, 30,000 splats; share of the peak")
        for name, ms, share in stages(operations, moved):
            figures[name] = ms
            print(f"  {name:34} {ms:9.2f} ms {100 * share:6.1f} %")
    if "growth" in args.sections:
        print("Whole iterations")
        figures |= dict(growth(args.device))
        for title, small, large, most in (
            ("400 to 800 px", "paper, 400 px", "paper, 800 px", 4.2),
            ("2 to 5 parts", "paper, 2 parts", "paper, 5 parts", 1.4),
            ("30,000 to 120,000 splats", "paper, 30,000 splats", "paper, 120,000 splats", 3.0),
        ):
            print(f"  {title}: {figures[large] / figures[small]:.2f} times (no more than {most})")
    peak = {"operations": operations, "bytes": moved}
    record = {"device": device, "threads": numba.get_num_threads(), **peak, "milliseconds": figures}
    if args.json:
        args.json.write_text(json.dumps(record, indent=1) + "\n")
    if args.against:
        worse = compare(record, json.loads(args.against.read_text()))
        print("\n".join(worse) if worse else f"Nothing is more than {WORSE} times slower than in {args.against}")
        sys.exit(1 if worse else 0)


if __name__ == "__main__":
    main()

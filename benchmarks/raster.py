"""Milliseconds of the CPU renderer and the image loss, stage by stage, beside plain torch on a reduced size.

    python benchmarks/raster.py [--splats 30000] [--size 800] [--reduced-splats 500] [--reduced-size 64]

The scene is the surface of a cube.  Medians of interleaved runs on the threads that NUMBA_NUM_THREADS gives; machines
differ and are noisy, so read the ratios.
"""

import argparse
import statistics
import time
from collections import defaultdict

import numba
import torch

from structuregs.geometry import SE3, Camera
from structuregs.model import Splats
from structuregs.raster import blend, image_loss, project, reference, render
from structuregs.raster import blend_kernels as bk
from structuregs.raster.cpu import project as cpu_project
from structuregs.raster.image_loss import image_loss_reference

REPEATS = 12


class Clock:
    """Collects times by name."""

    def __init__(self):
        self.times = defaultdict(list)

    def run(self, name, function):
        start = time.perf_counter()
        result = function()
        self.times[name].append((time.perf_counter() - start) * 1e3)
        return result

    def median(self, name):
        return statistics.median(self.times[name][2:])  # the first runs compile and warm up


def make_scene(n, size, seed=0):
    """Splats on a cube's surface that about cover it, a camera that sees three faces, and a target image."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(n, 3, generator=generator) * 2 - 1
    axis = torch.randint(3, (n,), generator=generator)
    means[torch.arange(n), axis] = means[torch.arange(n), axis].sign()
    scales = 0.6 * (24 / n) ** 0.5 * torch.exp(0.4 * torch.randn(n, 3, generator=generator))
    opacities = 0.05 + 0.9 * torch.rand(n, generator=generator)
    colours = torch.rand(n, 1, 3, generator=generator)
    splats = Splats(means, torch.randn(n, 4, generator=generator), scales.log(), opacities.logit(), colours)
    pose = SE3.from_matrix(
        torch.tensor([[0.8253, 0.3187, 0.4661, 0], [0, 0.8253, -0.5646, 0], [-0.5646, 0.4661, 0.6812, 0], [0, 0, 0, 1]])
    )
    pose = SE3.from_quat(pose.wxyz, pose.rotation @ torch.tensor([0.0, 0, -5]))
    camera = Camera(pose, 1.25 * size, 1.25 * size, size / 2, size / 2, size, size)
    image = render(splats, camera)
    noise = 0.05 * torch.randn(size, size, 3, generator=generator) * (image.alpha > 0)[..., None]
    return splats, camera, (image.rgb + noise).contiguous(), image.alpha.clone()


def leaves(splats):
    return Splats(**{name: value.clone().requires_grad_() for name, value in splats.tensors().items()})


def time_stages(clock, prefix, scene, stages, loss):
    """One pass through project, blend and loss and back, each stage cut off from the others."""
    splats, camera, target, target_alpha = scene
    projection = clock.run(f"{prefix} project forward", lambda: stages.project(leaves(splats), camera))
    cut = type(projection)(**{k: v.detach().requires_grad_(k != "extent") for k, v in vars(projection).items()})
    image = clock.run(f"{prefix} blend forward", lambda: stages.blend(cut, camera.width, camera.height, torch.ones(3)))
    rgb, alpha = image.rgb.detach().requires_grad_(), image.alpha.detach().requires_grad_()
    value = clock.run(f"{prefix} loss forward", lambda: loss(rgb, alpha, target, target_alpha))
    clock.run(f"{prefix} loss backward", value.backward)
    clock.run(f"{prefix} blend backward", lambda: torch.autograd.backward([image.rgb, image.alpha], [rgb.grad, alpha.grad]))
    outputs = [projection.xy, projection.conic, projection.rgb, projection.opacity]
    gradients = [cut.xy.grad, cut.conic.grad, cut.rgb.grad, cut.opacity.grad]
    clock.run(f"{prefix} project backward", lambda: torch.autograd.backward(outputs, gradients))


def time_whole(clock, prefix, scene, backend, loss):
    splats, camera, target, target_alpha = scene

    def step():
        image = render(leaves(splats), camera, backend=backend)
        loss(image.rgb, image.alpha, target, target_alpha).backward()

    clock.run(f"{prefix} whole step", step)


def time_lists(clock, scene):
    splats, camera = scene[:2]
    p = {k: v.numpy() for k, v in vars(cpu_project(splats, camera)).items()}
    drawing, reach = clock.run(
        "lists: pack", lambda: bk.pack(p["xy"], p["conic"], p["opacity"], p["rgb"], p["depth"], p["extent"])
    )
    order = clock.run("lists: sort", lambda: bk.depth_order(p["depth"], p["extent"]))
    lanes = numba.get_num_threads()
    _, pairs = clock.run("lists: tiles", lambda: bk.tile_lists(reach, order, camera.width, camera.height, lanes))
    return len(drawing), len(pairs)


class Fast:
    """The stages that the package picks by itself."""

    project, blend = staticmethod(project), staticmethod(blend)


STAGES = [f"{stage} {way}" for stage in ("project", "blend", "loss") for way in ("forward", "backward")] + ["whole step"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in (("splats", 30000), ("size", 800), ("reduced-splats", 500), ("reduced-size", 64)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()
    clock = Clock()
    large, small = make_scene(args.splats, args.size), make_scene(args.reduced_splats, args.reduced_size)
    for _ in range(REPEATS):
        n, pairs = time_lists(clock, large)
        time_stages(clock, "full", large, Fast, image_loss)
        time_whole(clock, "full", large, "auto", image_loss)
        time_stages(clock, "small", small, Fast, image_loss)
        time_whole(clock, "small", small, "auto", image_loss)
        time_stages(clock, "torch", small, reference, image_loss_reference)
        time_whole(clock, "torch", small, "reference", image_loss_reference)
    print(f"{n} splats, {args.size} px, {pairs} (tile, splat) pairs, {numba.get_num_threads()} threads")
    for name in ("pack", "sort", "tiles"):
        print(f"  {'lists: ' + name + ' (in blend forward)':32} {clock.median('lists: ' + name):9.2f} ms")
    print(f"  {'stage':32} {'ms':>9}    on {args.reduced_splats} splats, {args.reduced_size} px: kernels, torch, ratio")
    for stage in STAGES:
        full, small_ms, torch_ms = (clock.median(f"{prefix} {stage}") for prefix in ("full", "small", "torch"))
        print(f"  {stage:32} {full:9.2f}    {small_ms:9.2f} {torch_ms:9.2f} {torch_ms / small_ms:7.0f}x")
    parts = [clock.median(f"full blend {way}") for way in ("forward", "backward")]
    print(f"  whole step / blend: {clock.median('full whole step') / sum(parts):.2f}")


if __name__ == "__main__":
    main()

"""A quick look of each state by itself: splats fitted to one state's photos, and clouds of the surface they show."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy import ndimage
from torch import Tensor

from ..capture import ImageStack, spread_cameras
from ..model import Splats
from ..points import Hull
from ..raster import image_loss, render

LOOK_DILATION = 0.3
"""As `raster.render`'s, px^2, of all pictures of quick looks: their splats are few and coarse, and what is searched with
them is found from farther away where edges are soft."""


@dataclass(frozen=True)
class AppearanceConfig:
    """The short fit of one state by itself."""

    size: int = 128
    """Side of a square with as many pixels as the images, which are cropped to the object."""
    steps: int = 450
    """Optimiser steps, one view each."""
    splats: int = 10_000
    """Splats at the start."""
    looks: int = 24
    """Views from which the surface's points are read."""


def _start(hull: Hull, count: int, generator: np.random.Generator) -> Splats:
    """Splats strewn over the hull, half of them in its outermost layer of voxels."""
    shell = hull.occupied & np.logical_not(ndimage.binary_erosion(hull.occupied))
    centres = []
    for chosen in (hull.occupied, shell):
        cells = hull.centres(chosen)
        picked = cells[generator.integers(len(cells), size=count // 2)]
        centres.append(picked + generator.uniform(-0.5, 0.5, picked.shape) * hull.voxel)
    means = torch.from_numpy(np.concatenate(centres)).float()
    n = len(means)
    return Splats(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        torch.full((n, 3), float(np.log(0.7 * hull.voxel))),
        torch.full((n,), -1.5),
        torch.zeros(n, 1, 3),
    )


def fit_state(stack: ImageStack, hull: Hull, config: AppearanceConfig, seed: int) -> Splats:
    """Splats in the world that look like one state's photos; coarse, but solid where the object is solid."""
    generator = np.random.default_rng(seed)
    splats = _start(hull, config.splats, generator)
    named = {name: value.requires_grad_() for name, value in splats.tensors().items()}
    rates = {"means": 0.35 * hull.voxel, "quats": 2e-2, "log_scales": 3e-2, "logit_opacities": 1e-1, "sh": 4e-2}
    optimiser = torch.optim.Adam([{"params": [named[name]], "lr": rate} for name, rate in rates.items()], eps=1e-15)
    order = np.concatenate([generator.permutation(len(stack)) for _ in range(config.steps // len(stack) + 1)])
    for step, v in enumerate(order[: config.steps].tolist()):
        for group, rate in zip(optimiser.param_groups, rates.values(), strict=True):
            group["lr"] = rate * 0.1 ** (step / config.steps)
        rgb, alpha = stack.target(v)
        picture = render(splats, stack.cameras[v], dilation=LOOK_DILATION)
        loss = image_loss(picture.rgb, picture.alpha, rgb, alpha, ssim_weight=0.0, alpha_weight=0.5)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    solid = torch.sigmoid(named["logit_opacities"].detach()) > 0.02
    return Splats(**{name: value.detach()[solid] for name, value in named.items()})


@torch.no_grad()
def surface_points(splats: Splats, stack: ImageStack, hull: Hull, looks: int) -> Float64[np.ndarray, "P 3"]:
    """Points of the surface that the views see: depths of the splats read back, one point per voxel, at least two hits.

    Args:
        splats: of one state, in the world.
        stack: its views.
        hull: its hull; points are sorted into these voxels, and those outside it are dropped.
        looks: how many views to read, well apart.
    """
    hits = []
    for v in spread_cameras(stack.cameras, looks):
        picture = render(splats, stack.cameras[v], dilation=LOOK_DILATION)
        origin, rays = stack.cameras[v].rays()
        # Where depth jumps from one pixel to the next, its mean lies in the air between.
        clear = (_bend(picture.depth) < 1.5 * hull.voxel) & (picture.alpha > 0.8)
        hits.append((origin + rays * picture.depth[..., None])[clear])
    points = torch.cat(hits).double().numpy()
    cells = np.floor((points - hull.origin) / hull.voxel).astype(np.int64)
    held = np.all((cells >= 0) & (cells < hull.occupied.shape), axis=1)
    held[held] = hull.occupied[tuple(cells[held].T)]
    points, cells = points[held], cells[held]
    _, group, count = np.unique(
        np.ravel_multi_index(tuple(cells.T), hull.occupied.shape), return_inverse=True, return_counts=True
    )
    sums = np.stack([np.bincount(group, weights=points[:, axis]) for axis in range(3)], 1)
    return (sums / count[:, None])[count >= 2]


def _bend(depth: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """How far each pixel's depth lies from the middle of its neighbours', the larger of both directions; slopes have none."""
    padded = torch.nn.functional.pad(depth[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    across = (padded[1:-1, :-2] + padded[1:-1, 2:]) / 2 - depth
    down = (padded[:-2, 1:-1] + padded[2:, 1:-1]) / 2 - depth
    return torch.maximum(across.abs(), down.abs())

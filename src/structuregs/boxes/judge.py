"""The photos as judges of motion hypotheses."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64

from ..capture import ImageStack
from ..geometry import SE3, Box
from ..model import Splats
from ..points import Hull
from ..raster import image_loss, render
from .hypotheses import Hypothesis, turn_about


@dataclass(frozen=True)
class StateLook:
    """What is known of one state by itself.

    Attributes:
        stack: its photos at a small size.
        hull: its visual hull.
        points: its surface, in the world.
        splats: its quick look, in the world.
    """

    stack: ImageStack
    hull: Hull
    points: Float64[np.ndarray, "P 3"]
    splats: Splats


def _photo_error(scene: Splats, stack: ImageStack, v: int) -> torch.Tensor:
    rgb, alpha = stack.target(v)
    picture = render(scene, stack.cameras[v])
    return image_loss(picture.rgb, picture.alpha, rgb, alpha, ssim_weight=0.0, alpha_weight=0.5)


@torch.no_grad()
def photo_error(rest: Splats, part: Splats, motion: SE3, stack: ImageStack, views: np.ndarray) -> float:
    """Mean error of the photos `views` against the rest with the part moved by `motion`."""
    scene = Splats.concatenate([rest, part.moved(motion)])
    return float(np.mean([float(_photo_error(scene, stack, v)) for v in views]))


def refine(
    hypothesis: Hypothesis, rest: Splats, part: Splats, box: Box, stack: ImageStack, views: np.ndarray, steps: int, rate: float
) -> Hypothesis:
    """The hypothesis after the photos have pulled its motion into place, with its new image error.

    Args:
        hypothesis: the motion to start from, from the part's state to the photos'.
        rest: everything else, as it stands in the photos' state.
        part: the part's splats in its own state.
        box: the part's box in its own state; turns are about its moved centre, and `rate` counts in its half diagonal.
        stack: photos of the other state.
        views: which of them to use, for steps in turn and for the final error.
        steps: optimiser steps, one photo each.
        rate: of the tangent at the start; falls to a tenth.
    """
    reach = float(box.half_extents.norm())
    centre = hypothesis.motion.apply(box.T_world_box.xyz).float()
    start = hypothesis.motion.to(dtype=torch.float32)
    unit = torch.tensor([reach] * 3 + [1.0] * 3)
    tangent = torch.zeros(6, requires_grad=True)
    optimiser = torch.optim.Adam([tangent], lr=rate, betas=(0.8, 0.95))
    best, best_error = hypothesis.motion, photo_error(rest, part, hypothesis.motion, stack, views)
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = rate * 0.1 ** (step / steps)
        motion = turn_about(centre, tangent * unit) @ start
        scene = Splats.concatenate([rest, part.moved(motion)])
        loss = _photo_error(scene, stack, int(views[step % len(views)]))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    motion = (turn_about(centre, (tangent * unit).detach()) @ start).to(dtype=torch.float64)
    error = photo_error(rest, part, motion, stack, views)
    if error < best_error:
        best, best_error = motion, error
    return replace(hypothesis, motion=best, image_error=best_error)

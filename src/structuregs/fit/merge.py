"""Parts that are none: two that are one, and what needs no motion."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64

from ..capture import ImageStack, spread_cameras
from ..geometry import SE3
from ..model import PosedParts
from ..raster import render
from .structure import contact_loss

_ALIKE = 0.05  # of their travel: how far the motions of one part's pieces may differ
_VIEWS = 32  # photos that are asked whether a part moves
_WORTH = 0.005  # of the photos' error: what a motion that counts saves at least


def moving_alike(parts: PosedParts) -> tuple[int, int] | None:
    """Two moving parts that touch and whose motions agree to a twentieth of their travel, the larger first; or None."""
    for a in range(1, len(parts)):
        for b in range(a + 1, len(parts)):
            corners = torch.cat([parts.boxes.corners[a], parts.boxes.corners[b]])
            ways = [parts.motions[k].apply(corners) - corners for k in (a, b)]
            apart = (ways[0] - ways[1]).norm(dim=-1).mean()
            travel = torch.minimum(ways[0].norm(dim=-1).mean(), ways[1].norm(dim=-1).mean())
            gap = contact_loss(parts.boxes[[a, b]])
            if apart < _ALIKE * travel and gap < _ALIKE * parts.boxes.half_extents[[a, b]].norm(dim=-1).amax():
                return (a, b) if parts.counts[a] >= parts.counts[b] else (b, a)
    return None


@torch.no_grad()
def idle_part(parts: PosedParts, photos: ImageStack) -> int | None:
    """The moving part that could best stay where it is in state 0, if the photos of state 1 do not get worse by it.

    They get worse if their mean error grows by more than twice its standard error over the photos, and by half a percent.

    Args:
        parts: as fitted so far.
        photos: of state 1.
    """
    asked = spread_cameras(photos.cameras, _VIEWS)
    moving = colour_errors(parts, photos, asked)
    needs = {}
    for k in range(1, len(parts)):
        motions = parts.motions.wxyz_xyz.clone()
        motions[k] = motions[0]
        lost = colour_errors(replace(parts, motions=SE3(motions)), photos, asked) - moving
        needed = max(2 * lost.std() / np.sqrt(max(len(lost) - 1, 1)), _WORTH * moving.mean())
        if lost.mean() < needed:
            needs[k] = float(lost.mean())
    return min(needs, key=needs.__getitem__) if needs else None


def colour_errors(parts: PosedParts, photos: ImageStack, asked: list[int]) -> Float64[np.ndarray, " V"]:
    """Mean absolute colour difference of each photo of state 1 that is asked."""
    splats = parts.at_state(1)
    pictures = [(render(splats, photos.cameras[v]).rgb, photos.target(int(v))[0]) for v in asked]
    return np.array([float((drawn.cpu() - photo).abs().mean()) for drawn, photo in pictures])

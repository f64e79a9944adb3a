"""Parts that are none: two that are one, and what needs no motion."""

import numpy as np
import torch
from jaxtyping import Float64

from ..capture import ImageStack, spread_cameras
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
        lost = colour_errors(parts.with_motion(k, parts.motions[0]), photos, asked) - moving
        needed = max(2 * standard_error(lost), _WORTH * moving.mean())
        if lost.mean() < needed:
            needs[k] = float(lost.mean())
    return min(needs, key=needs.__getitem__) if needs else None


def colour_errors(parts: PosedParts, photos: ImageStack, asked: list[int]) -> Float64[np.ndarray, " V"]:
    """Mean absolute colour difference of each photo of state 1 that is asked."""
    splats = parts.at_state(1)
    pictures = [(render(splats, photos.cameras[v]).rgb, photos.target(int(v))[0]) for v in asked]
    return np.array([float((drawn.cpu() - photo).abs().mean()) for drawn, photo in pictures])


def standard_error(values: Float64[np.ndarray, " V"]) -> float:
    """Of the mean of values; of one alone, 0."""
    return float(values.std() / np.sqrt(max(len(values) - 1, 1)))

"""Errors of rendered images on held-out views."""

from collections.abc import Sequence

import torch

from ..capture import View
from ..metrics import psnr
from ..model import Splats
from ..raster import render


def psnr_on_views(splats: Splats, views: Sequence[View], *, object_only: bool = False) -> float | None:
    """Mean over the views of each image's PSNR, dB, over white and in full size; None without views.

    Args:
        splats: the object in the views' state, in the world.
        views: what is compared with.
        object_only: count only the pixels of the object's mask; the white around it flatters.
    """
    if not views:
        return None
    values = []
    for view in views:
        target, alpha = (torch.from_numpy(x) for x in view.image(view.camera.width, view.camera.height))
        with torch.no_grad():
            image = render(splats, view.camera).rgb.clamp(0, 1)
        values.append(psnr(image, target, alpha > 0 if object_only else None))
    return sum(values) / len(values)

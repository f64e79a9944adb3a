"""The planes that splats lie in, drawn like colours: where the surface is at every pixel, and how it leans."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import Camera
from ..model import Splats
from .render import blend, project, stages

_LEAST = 1e-3  # of the alpha that means are taken over


@dataclass(frozen=True)
class PlaneImage:
    """The mean plane of the splats at every pixel.

    Attributes:
        planes: m, in the camera's frame: the plane is where m . x = 1, and a ray of unit z, d, meets it at depth 1 / (m . d).
            Pixels that see one flat face all have the same m.
        alpha: opacity in [0, 1], without gradient.
    """

    planes: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]


def tangent_planes(splats: Splats, camera: Camera) -> Float[Tensor, "N 3"]:
    """The plane through each splat's centre and square to its shortest axis, as m of `PlaneImage`.

    Planes that the camera sees nearly edge-on are turned towards it.
    """
    return stages(splats.means).tangent_planes(splats, camera)


def render_planes(splats: Splats, camera: Camera) -> PlaneImage:
    """Draws the splats' planes instead of their colours (unbiased depth as in PGSR, Chen et al. 2024).

    Gradients reach centres and orientations by way of the planes alone, not by what covers what: a loss on the image can
    move a surface, and has nothing to gain by making it transparent.
    """
    with torch.no_grad():
        seen = project(splats, camera)
    image = blend(replace(seen, rgb=tangent_planes(splats, camera)), camera.width, camera.height, splats.means.new_zeros(3))
    alpha = image.alpha.detach()
    return PlaneImage(image.rgb / alpha.clamp(min=_LEAST)[..., None], alpha)

"""The renderer's door: picks the back end."""

import importlib
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry import Camera
from ..model import SH_C0, Splats
from .records import DILATION, Projection, Render

Backend = Literal["auto", "reference", "cpu", "cuda"]


def _module(name: str):
    return importlib.import_module(f".{name}", __package__)


def render(
    splats: Splats,
    camera: Camera,
    *,
    background: Float[Tensor, " 3"] | None = None,
    dilation: float = DILATION,
    backend: Backend = "auto",
) -> Render:
    """Draws splats, which are in the world, as the camera sees them; differentiable in the splats and the background.

    Args:
        splats: in the world's frame.
        camera: where from, and the size of the image.
        background: rgb behind everything; white by default.
        dilation: variance by which every splat is widened on the image, px^2.
        backend: "reference" is plain torch (any device and type, slow, differentiable in the camera's pose too), "cpu"
            is Numba (float32), "cuda" is gsplat; "auto" takes the fast one of the splats' device.

    Raises:
        RuntimeError: the cuda back end cannot run here.
    """
    if background is None:
        background = splats.means.new_ones(3)
    if backend == "auto":
        backend = "cuda" if splats.means.is_cuda else "cpu"
    return _module(backend).render(splats, camera, background=background, dilation=dilation)


@torch.no_grad()
def coverage_of(splats: Splats, chosen: Bool[Tensor, " N"], camera: Camera, dilation: float = DILATION) -> Float[Tensor, "H W"]:
    """The share of each pixel that some of the splats paint, where the others may stand before them; else as `render`."""
    sh = torch.zeros(len(splats), 1, 3, device=splats.means.device)
    sh[:, 0] = torch.where(chosen, 0.5, -0.5)[:, None] / SH_C0
    black = splats.means.new_zeros(3)
    return render(replace(splats, sh=sh), camera, background=black, dilation=dilation).rgb[..., 0]


def painted(splats: Splats, camera: Camera, pixels: Bool[Tensor, "H W"] | None = None) -> Float[Tensor, " N"]:
    """The share of the image that each splat paints, where others may stand before it; they add up to the mean alpha.

    Where `pixels` are given, others count as not painted.
    """
    with torch.no_grad():
        projection = project(splats, camera)
    with torch.enable_grad():
        rgb = projection.rgb.clone().requires_grad_()
        picture = blend(replace(projection, rgb=rgb), camera.width, camera.height, splats.means.new_zeros(3))
        drawn = picture.rgb[..., 0] if pixels is None else picture.rgb[..., 0] * pixels
        (weights,) = torch.autograd.grad(drawn.mean(), rgb)
    return weights[:, 0]


def stages(tensor: Tensor):
    """The back end for a tensor like this, as a module."""
    fast = tensor.device.type if tensor.dtype == torch.float32 else ""
    return _module(fast if fast in ("cpu", "cuda") else "reference")


def project(splats: Splats, camera: Camera, dilation: float = DILATION) -> Projection:
    """The first stage of `render`: splats in the world to 2D Gaussians on the image."""
    return stages(splats.means).project(splats, camera, dilation)


def blend(projection: Projection, width: int, height: int, background: Float[Tensor, " 3"]) -> Render:
    """The second stage of `render`: 2D Gaussians to an image, blended from near to far."""
    return stages(projection.xy).blend(projection, width, height, background)

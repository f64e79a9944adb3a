"""Where the surface of splats is: the depth at which most of a pixel's light is gone."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32

from ..geometry import Camera, quat_to_matrix
from ..jit import lanes
from ..model import Splats
from . import blend_kernels as bk
from .cpu import project
from .records import DILATION, Projection
from .surface_kernels import surface_forward

_BLUR = 0.01  # px^2: a splat seen edge-on has no plane that could be told


@dataclass(frozen=True)
class Surface:
    """What an image of splats says of their surface.

    Attributes:
        depth: along the camera's z, where two fifths of the light are left; 0 where more comes through.
        rgb: mean colour of the splats up to there, each weighted by what it adds to the image.
    """

    depth: Float32[np.ndarray, "H W"]
    rgb: Float32[np.ndarray, "H W 3"]


@torch.no_grad()
def render_surface(splats: Splats, camera: Camera, dilation: float = DILATION) -> Surface:
    """The depth of splats' surface, on the CPU, in float32 and without gradients.

    The expected depth of `render` lies behind the surface wherever light seeps through its first splats, and between two
    surfaces at edges; a quantile lies on one of them.  The median gives way to what hangs in the air before a surface a
    little more often than the depth where two fifths are left; with less light, thin boards are missed.  A splat's light is
    lost gradually along the ray, around the plane that fits its ellipsoid best (as in Gaussian opacity fields, Yu et al.
    2024): fat splats count from their near side.  On the image splats are widened as `render` does.
    """
    p = project(splats, camera, dilation)
    xy, conic, opacity, rgb, z, extent = (
        t.float().contiguous().numpy() for t in (p.xy, p.conic, p.opacity, p.rgb, p.depth, p.extent)
    )
    drawing, reach = bk.pack(xy, conic, opacity, rgb, z, extent)
    order = bk.depth_order(z, extent)
    depth, image = np.empty((camera.height, camera.width), np.float32), np.empty((camera.height, camera.width, 3), np.float32)
    planes = _planes(splats, camera, p)
    with lanes() as threads:
        starts, lists = bk.tile_lists(reach, order, camera.width, camera.height, threads)
        surface_forward(starts, lists, drawing, planes, threads, depth, image)
    return Surface(depth, image)


def _planes(splats: Splats, camera: Camera, projection: Projection) -> Float32[np.ndarray, "N 3"]:
    """Of each splat's depth at a given pixel: how its mean changes per pixel to the right and down, and its deviation.

    These are the regression of z on the image's axes, Cov(z, xy) Cov(xy)^-1, and what it leaves unexplained.
    """
    T_camera_world = camera.T_world_camera.inverse()
    centres = T_camera_world.apply(splats.means)
    z = centres[:, 2:].clamp(min=1e-6)
    axes = T_camera_world.rotation @ quat_to_matrix(splats.quats) * splats.scales[:, None, :]
    across = (axes[:, :2] - (centres[:, :2] / z)[..., None] * axes[:, 2:]) * (torch.tensor([camera.fx, camera.fy]) / z)[
        ..., None
    ]
    # Not the projection's covariance, whose dilation would tilt the planes of small splats towards the image.
    xx, xy, yy = (
        across[:, 0].square().sum(-1) + _BLUR,
        (across[:, 0] * across[:, 1]).sum(-1),
        across[:, 1].square().sum(-1) + _BLUR,
    )
    right, down = (across * axes[:, 2:]).sum(-1).unbind(-1)
    det = xx * yy - xy * xy
    slopes = torch.stack([yy * right - xy * down, xx * down - xy * right], -1) / det[:, None]
    both = torch.stack([right, down], -1)
    rest = (axes[:, 2].square().sum(-1) - (slopes * both).sum(-1)).clamp(min=0).sqrt()
    planes = torch.cat([slopes, rest[:, None]], -1)
    return torch.where(projection.visible[:, None], planes, torch.zeros_like(planes)).numpy()

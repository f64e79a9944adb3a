"""What splats ought to be where the photos do not say: flat, and on one smooth surface."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..geometry import Camera
from ..jit import lanes
from ..model import Splats
from ..raster import render_planes
from .surface_kernels import slopes_and_gradient

_STEPS = (1, 3, 9, 27)  # pixels between two that are held against each other: near ones see noise, far ones see bulges
_EDGE = 20.0  # how fast two pixels cease to be on one face with what colour (in [0, 1]) changes on the way between them
_LEAST_NEARNESS = 1e-3


def thickness(splats: Splats) -> Float[Tensor, ""]:
    """Mean of the splats' shortest standard deviation: a surface is made of discs (Chen et al. 2024, PGSR)."""
    return splats.scales.amin(-1).mean()


def planarity_loss(
    splats: Splats, camera: Camera, rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"]
) -> Float[Tensor, ""]:
    """How far pixels lie from the planes of others on the same face, as a slope; each pair counts up to 1.

    Two pixels of a row or a column are on one face as long as the photo changes little from the one to the other: the
    photos say where a surface with texture is, and where there is none it is plane.

    Args:
        splats: in the world.
        camera: of the photo.
        rgb: the photo.
        alpha: its mask.
    """
    image = render_planes(splats, camera)
    solid = (image.alpha > 0.5) & (alpha > 0.5)
    photo = torch.cat([rgb, alpha[..., None]], -1)
    changes = torch.stack([photo.diff(dim=d, prepend=photo.narrow(d, 0, 1)).abs().mean(-1).cumsum(d) for d in (0, 1)])
    return slopes(image.planes, camera, solid, changes) / (4 * len(_STEPS) * solid.sum().clamp(min=1))


def slopes(
    planes: Float[Tensor, "H W 3"], camera: Camera, solid: Bool[Tensor, "H W"], changes: Float[Tensor, "2 H W"]
) -> Float[Tensor, ""]:
    """Sum over pairs of pixels of how much the one's plane misses the other, over the way between them.

    On the CPU in float32 a kernel, elsewhere plain torch.

    Args:
        planes: see `PlaneImage`.
        camera: of the image.
        solid: where there is a surface.
        changes: how much the photo's colours have changed up to a pixel, down its column and along its row.
    """
    if planes.device.type == "cpu" and planes.dtype == torch.float32:
        return _Slopes.apply(planes, camera, solid, changes)
    rays = camera.rays()[1].to(planes) @ camera.T_world_camera.rotation.to(planes)
    nearness = (planes * rays).sum(-1).clamp(min=_LEAST_NEARNESS)
    total = nearness.new_zeros(())
    for axis, focal in ((0, camera.fy), (1, camera.fx)):
        for step in _STEPS:
            if step < len(solid) // 2 and step < solid.shape[1] // 2:
                count = solid.shape[axis] - step
                (plane_a, ray_a, near_a, solid_a, change_a), (plane_b, ray_b, near_b, solid_b, change_b) = (
                    [image.narrow(axis, first, count) for image in (planes, rays, nearness, solid, changes[axis])]
                    for first in (0, step)
                )
                weight = (solid_a & solid_b) * torch.exp(-_EDGE * (change_b - change_a))
                for miss in ((plane_a * ray_b).sum(-1) / near_b - 1, (plane_b * ray_a).sum(-1) / near_a - 1):
                    total = total + (weight * (focal / step * miss.abs()).clamp(max=1)).sum()
    return total


class _Slopes(torch.autograd.Function):
    """`slopes` as a kernel; the gradient is made along with the value."""

    @staticmethod
    def forward(ctx, planes, camera, solid, changes) -> Tensor:
        arrays = [t.detach().float().contiguous().numpy() for t in (planes, solid, changes)]
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
        gradient, parts = np.empty_like(arrays[0]), np.empty(len(arrays[0]))
        with lanes() as threads:
            slopes_and_gradient(*arrays, lens, np.array(_STEPS), _EDGE, np.float32(_LEAST_NEARNESS), threads, gradient, parts)
        ctx.save_for_backward(torch.from_numpy(gradient))
        return torch.tensor(parts.sum(), dtype=planes.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        return ctx.saved_tensors[0] * gradients[0], None, None, None

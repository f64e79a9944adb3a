"""What splats ought to be where the photos do not say: flat, and on one smooth surface."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry import Camera
from ..model import Splats
from ..raster import render_planes

_STEPS = (1, 3, 9, 27)  # pixels between two that are held against each other: near ones see noise, far ones see bulges
_EDGE = 20.0  # how fast two pixels cease to be on one face with what colour (in [0, 1]) changes on the way between them


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
    rays = camera.rays()[1].to(image.planes) @ camera.T_world_camera.rotation.to(image.planes)
    nearness = (image.planes * rays).sum(-1).clamp(min=1e-3)
    solid = (image.alpha > 0.5) & (alpha > 0.5)
    photo = torch.cat([rgb, alpha[..., None]], -1)
    total = nearness.new_zeros(())
    for axis, focal in ((0, camera.fy), (1, camera.fx)):
        change = photo.diff(dim=axis, prepend=photo.narrow(axis, 0, 1)).abs().mean(-1).cumsum(axis)
        for step in _STEPS:
            if step < len(solid) // 2 and step < solid.shape[1] // 2:
                total = total + _slopes(image.planes, rays, nearness, solid, change, axis, step, focal)
    return total / (4 * len(_STEPS) * solid.sum().clamp(min=1))


def _slopes(
    planes: Float[Tensor, "H W 3"],
    rays: Float[Tensor, "H W 3"],
    nearness: Float[Tensor, "H W"],
    solid: Bool[Tensor, "H W"],
    change: Float[Tensor, "H W"],
    axis: int,
    step: int,
    focal: float,
) -> Float[Tensor, ""]:
    """Sum over pairs `step` pixels apart of how much the one's plane misses the other, over the way between them."""

    def ends(image: Tensor) -> tuple[Tensor, Tensor]:
        count = image.shape[axis] - step
        return image.narrow(axis, 0, count), image.narrow(axis, step, count)

    (plane_a, plane_b), (ray_a, ray_b), (near_a, near_b) = ends(planes), ends(rays), ends(nearness)
    (solid_a, solid_b), (change_a, change_b) = ends(solid), ends(change)
    weight = (solid_a & solid_b) * torch.exp(-_EDGE * (change_b - change_a))
    misses = (plane_a * ray_b).sum(-1) / near_b - 1, (plane_b * ray_a).sum(-1) / near_a - 1
    return sum(((weight * (focal / step * miss.abs()).clamp(max=1)).sum() for miss in misses), weight.new_zeros(()))

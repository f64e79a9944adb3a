"""The reference back end: the renderer's maths in plain torch, for any device and floating type."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import Camera, quat_to_matrix
from ..model import Splats
from .records import (
    LEAST_DISTANCE,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR,
    STEEPEST,
    Projection,
    Render,
    frustum_limits,
    splat_rgb,
)


def render(splats: Splats, camera: Camera, *, background: Float[Tensor, " 3"], dilation: float) -> Render:
    """See `structuregs.raster.render`; time and memory grow with pixels times splats."""
    return blend(project(splats, camera, dilation), camera.width, camera.height, background.to(splats.means))


def project(splats: Splats, camera: Camera, dilation: float) -> Projection:
    """Splats in the world to 2D Gaussians (Zwicker et al. 2001): Sigma' = J R S S R^T J^T + dilation."""
    T_camera_world = camera.T_world_camera.to(splats.means.device, splats.means.dtype).inverse()
    p = T_camera_world.apply(splats.means)
    front = p[:, 2] > NEAR
    x, y, z = torch.where(front[:, None], p, torch.ones_like(p)).unbind(-1)
    xy = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1)

    low_u, high_u, low_v, high_v = frustum_limits(camera)
    u, v = (x / z).clamp(low_u, high_u), (y / z).clamp(low_v, high_v)
    axes = T_camera_world.rotation @ quat_to_matrix(splats.quats) * splats.scales[:, None, :]
    row_x = camera.fx / z[:, None] * (axes[:, 0] - u[:, None] * axes[:, 2])
    row_y = camera.fy / z[:, None] * (axes[:, 1] - v[:, None] * axes[:, 2])
    xx, xy_, yy = (row_x * row_x).sum(-1), (row_x * row_y).sum(-1), (row_y * row_y).sum(-1)
    # The determinant as a sum of squares (Cauchy-Binet): it stays positive where xx * yy - xy * xy cancels.
    det = torch.linalg.cross(row_x, row_y).square().sum(-1) + dilation * (xx + yy) + dilation**2
    xx, yy = xx + dilation, yy + dilation
    conic = torch.stack([yy, -xy_, xx], -1) / det[:, None]

    extent = _extent(xy, torch.stack([xx, yy], -1), splats.opacities, camera) * front[:, None]
    drawn = extent[:, 0] > 0
    safe_conic = torch.where(drawn[:, None], conic, torch.ones_like(conic))
    return Projection(xy, safe_conic, torch.where(front, z, p[:, 2]), extent, splat_rgb(splats, camera), splats.opacities)


@torch.no_grad()
def _extent(
    xy: Float[Tensor, "N 2"], variances: Float[Tensor, "N 2"], opacities: Float[Tensor, " N"], camera: Camera
) -> Float[Tensor, "N 2"]:
    """Half sizes of the box where alpha reaches its least, 0 for splats that are off the image, too faint or not finite."""
    extent = (2 * torch.log(opacities / MIN_ALPHA).clamp(min=0)[:, None] * variances).sqrt()
    size = xy.new_tensor([camera.width, camera.height])
    inside = ((xy + extent > 0) & (xy - extent < size)).all(-1) & torch.isfinite(extent).all(-1)
    return torch.where(inside[:, None], extent, torch.zeros_like(extent))


def blend(projection: Projection, width: int, height: int, background: Float[Tensor, " 3"]) -> Render:
    """2D Gaussians to an image, every splat at every pixel, from near to far; ties in depth by index."""
    order = torch.argsort(projection.depth.detach(), stable=True)
    order = order[projection.visible[order]]
    xy, conic, opacity = projection.xy[order], projection.conic[order], projection.opacity[order]
    values = torch.cat([projection.rgb, projection.depth[:, None]], -1)[order]
    rows = []
    columns = torch.arange(width, device=xy.device, dtype=xy.dtype) + 0.5
    for row in range(height):
        dx, dy = xy[:, 0] - columns[:, None], xy[:, 1] - (row + 0.5)
        sigma = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
        alpha = (opacity * torch.exp(-sigma)).clamp(max=MAX_ALPHA)
        alpha = torch.where(alpha >= MIN_ALPHA, alpha, torch.zeros_like(alpha))
        through = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], 1), 1)
        weights = torch.where(through[:, :-1] > MIN_TRANSMITTANCE, alpha * through[:, :-1], torch.zeros_like(alpha))
        rows.append(torch.cat([weights @ values, weights.sum(-1, keepdim=True)], -1))
    colour, depth, alpha = torch.stack(rows).split([3, 1, 1], -1)
    safe = torch.where(alpha > 0, alpha, torch.ones_like(alpha))
    return Render(colour + (1 - alpha) * background, alpha[..., 0], (depth / safe)[..., 0], projection)


def tangent_planes(splats: Splats, camera: Camera) -> Float[Tensor, "N 3"]:
    """See `planes.tangent_planes`."""
    T_camera_world = camera.T_world_camera.inverse().to(splats.means.device, splats.means.dtype)
    centres = T_camera_world.apply(splats.means)
    shortest = splats.log_scales.detach().argmin(-1)[:, None, None].expand(-1, 3, 1)
    normals = quat_to_matrix(splats.quats).gather(2, shortest)[..., 0] @ T_camera_world.rotation.T
    sight = torch.nn.functional.normalize(centres, dim=-1)
    cosine = (normals * sight).sum(-1, keepdim=True)
    normals = torch.where(cosine < 0, -normals, normals) + (STEEPEST - cosine.abs()).clamp(min=0) * sight
    return normals / (normals * centres).sum(-1, keepdim=True).clamp(min=LEAST_DISTANCE)

"""The CUDA back end: the kernels of gsplat 1.5.3 (Ye et al. 2024), stage by stage, with this package's conventions."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import Camera
from ..model import Splats
from .records import NEAR, Projection, Render, splat_rgb
from .reference import tangent_planes

__all__ = ["blend", "project", "render", "tangent_planes"]

_TILE = 16


def _gsplat():
    """The gsplat package with its kernels built.

    Raises:
        RuntimeError: there is no GPU, no gsplat, or its kernels cannot be built.
    """
    if not torch.cuda.is_available():
        raise RuntimeError("render(backend='cuda'): torch sees no NVIDIA GPU here; use backend='cpu' or a CUDA build of torch.")
    try:
        import gsplat  # pyright: ignore[reportMissingImports]
        from gsplat.cuda import _backend  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise RuntimeError(
            f"render(backend='cuda'): gsplat cannot be loaded ({error}); run `pip install 'structuregs[gpu]'`."
        ) from error
    except (OSError, RuntimeError) as error:
        raise RuntimeError(
            f"render(backend='cuda'): gsplat's kernels could not be built ({error}); check that nvcc fits torch's CUDA."
        ) from error
    if getattr(_backend, "_C", None) is None:
        raise RuntimeError("render(backend='cuda'): gsplat found no CUDA compiler to build its kernels; put nvcc on the PATH.")
    return gsplat


def render(splats: Splats, camera: Camera, *, background: Float[Tensor, " 3"], dilation: float) -> Render:
    """See `structuregs.raster.render`; gives no gradient to the camera's pose.

    gsplat leaves out the splat that would bring a pixel's transmittance below 1e-4, where the other back ends draw it as
    the pixel's last: images agree to 1e-4.
    """
    _gsplat()
    splats = Splats(**{name: value.to("cuda", torch.float32) for name, value in splats.tensors().items()})
    return blend(project(splats, camera, dilation), camera.width, camera.height, background.to(splats.means))


def project(splats: Splats, camera: Camera, dilation: float) -> Projection:
    """See `reference.project`."""
    viewmat = camera.T_world_camera.inverse().as_matrix().detach().to(splats.means)[None]
    radii, means2d, depths, conics, _ = _gsplat().fully_fused_projection(
        splats.means, None, splats.quats, splats.scales, viewmat, camera.K.to(splats.means)[None], camera.width,
        camera.height, eps2d=dilation, near_plane=NEAR, opacities=splats.opacities,
    )  # fmt: skip
    extent = radii[0].to(torch.float32)
    return Projection(means2d[0], conics[0], depths[0], extent, splat_rgb(splats, camera), splats.opacities)


def blend(projection: Projection, width: int, height: int, background: Float[Tensor, " 3"]) -> Render:
    """See `reference.blend`."""
    gsplat = _gsplat()
    # From one camera's rows: so the gradient of the kept `xy` is the screen-space gradient.
    xy, radii = projection.xy[None], projection.extent.to(torch.int32)[None]
    across, down = -(-width // _TILE), -(-height // _TILE)
    _, pairs, order = gsplat.isect_tiles(xy, radii, projection.depth.detach()[None], _TILE, across, down)
    starts = gsplat.isect_offset_encode(pairs, 1, across, down)
    values = torch.cat([projection.rgb, projection.depth[:, None]], -1)[None]
    behind = torch.cat([background, background.new_zeros(1)])[None]
    image, alpha = gsplat.rasterize_to_pixels(
        xy, projection.conic[None], values, projection.opacity[None], width, height, _TILE, starts, order, backgrounds=behind
    )
    alpha = alpha[0, ..., 0]
    depth = torch.where(alpha > 0, image[0, ..., 3] / alpha.clamp(min=1e-10), torch.zeros_like(alpha))
    return Render(image[0, ..., :3], alpha, depth, projection)

"""What the stages of the renderer hand on."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry import Camera
from ..model import SH_C0, Splats
from ..model.sh import sh_basis

NEAR = 0.01  # nearer splats are not drawn; the capture's unit
DILATION = 1 / 12  # px^2 on the diagonal of every 2D covariance: the variance of a pixel's square (3DGS: .3, which blurs edges)
MAX_ALPHA = 0.999
MIN_ALPHA = 1 / 255  # fainter contributions are skipped
MIN_TRANSMITTANCE = 1e-4  # a pixel takes no more splats once it lets less than this through
STEEPEST = 0.1  # least cosine between a drawn plane's normal and the line of sight: seen edge-on a plane is nowhere
LEAST_DISTANCE = 1e-6  # of a drawn plane from the camera; the capture's unit
FRUSTUM_MARGIN = 0.3  # the projection is linearised at most this share of half the field of view outside the image


@dataclass(frozen=True)
class Projection:
    """Splats as 2D Gaussians on the image (EWA splatting, Zwicker et al. 2001, as in Kerbl et al. 2023).

    Attributes:
        xy: centres, pixels; a pixel's centre is at +0.5.
        conic: upper triangle (xx, xy, yy) of the inverse 2D covariance, 1 / px^2.
        depth: along the camera's z.
        extent: half sizes of the axis-aligned box around the pixels that a splat can reach; 0 = not drawn. No gradient.
        rgb: colours as seen from the camera, >= 0.
        opacity: in (0, 1).
    """

    xy: Float[Tensor, "N 2"]
    conic: Float[Tensor, "N 3"]
    depth: Float[Tensor, " N"]
    extent: Float[Tensor, "N 2"]
    rgb: Float[Tensor, "N 3"]
    opacity: Float[Tensor, " N"]

    @property
    def radius(self) -> Float[Tensor, " N"]:
        """The larger half size in pixels; 0 = not drawn."""
        return self.extent.amax(-1)

    @property
    def visible(self) -> Bool[Tensor, " N"]:
        """Which splats may have touched a pixel."""
        return self.extent[:, 0] > 0


@dataclass(frozen=True)
class Render:
    """An image of splats.

    Attributes:
        rgb: composited over the background.
        alpha: opacity in [0, 1].
        depth: expected depth along the camera's z, weighted by what each splat adds to alpha; 0 where alpha is 0.
        projection: the splats on the image; call `projection.xy.retain_grad()` before the backward pass to have the
            screen-space gradient in `projection.xy.grad`.
    """

    rgb: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"]
    projection: Projection


def splat_rgb(splats: Splats, camera: Camera) -> Float[Tensor, "N 3"]:
    """Colours seen from the camera's position, clamped at 0."""
    degree = math.isqrt(splats.sh.shape[1]) - 1
    if degree == 0:
        return (0.5 + SH_C0 * splats.sh[:, 0]).clamp(min=0)
    directions = torch.nn.functional.normalize(splats.means - camera.centre.to(splats.means), dim=-1)
    return (0.5 + torch.einsum("nc,ncd->nd", sh_basis(directions, degree), splats.sh)).clamp(min=0)


def frustum_limits(camera: Camera) -> tuple[float, float, float, float]:
    """Lowest and highest x/z, then y/z, at which the projection is linearised."""
    mx, my = FRUSTUM_MARGIN * camera.width / (2 * camera.fx), FRUSTUM_MARGIN * camera.height / (2 * camera.fy)
    return (
        -camera.cx / camera.fx - mx,
        (camera.width - camera.cx) / camera.fx + mx,
        -camera.cy / camera.fy - my,
        (camera.height - camera.cy) / camera.fy + my,
    )

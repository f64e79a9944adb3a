"""Losses between a drawn image and a photo."""

import torch
from jaxtyping import Float
from torch import Tensor

WINDOW = 11  # pixels
WINDOW_SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2


def image_loss(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    target_rgb: Float[Tensor, "H W 3"],
    target_alpha: Float[Tensor, "H W"],
    *,
    ssim_weight: float = 0.2,
    alpha_weight: float = 0.1,
) -> Float[Tensor, ""]:
    """The loss of 3DGS on colour, (1 - w) L1 + w (1 - SSIM), plus a weighted L1 on alpha; means over all pixels.

    Values are in [0, 1]; the targets get no gradient.  On the CPU in float32
    this is a kernel that costs less than drawing the image, elsewhere `image_loss_reference`.
    Source: Kerbl et al. 2023, equation 7.
    """
    if rgb.device.type == "cpu" and rgb.dtype == alpha.dtype == torch.float32:
        from .cpu_loss import ImageLoss

        return ImageLoss.apply(rgb, alpha, target_rgb, target_alpha, ssim_weight, alpha_weight)
    return image_loss_reference(rgb, alpha, target_rgb, target_alpha, ssim_weight=ssim_weight, alpha_weight=alpha_weight)


def image_loss_reference(
    rgb: Float[Tensor, "H W 3"],
    alpha: Float[Tensor, "H W"],
    target_rgb: Float[Tensor, "H W 3"],
    target_alpha: Float[Tensor, "H W"],
    *,
    ssim_weight: float = 0.2,
    alpha_weight: float = 0.1,
) -> Float[Tensor, ""]:
    """`image_loss` in plain torch, for any device and floating type."""
    target_rgb, target_alpha = target_rgb.detach(), target_alpha.detach()
    loss = (1 - ssim_weight) * (rgb - target_rgb).abs().mean()
    if ssim_weight:
        loss = loss + ssim_weight * (1 - ssim(rgb, target_rgb).mean())
    if alpha_weight:
        loss = loss + alpha_weight * (alpha - target_alpha).abs().mean()
    return loss


def window(dtype: torch.dtype = torch.float64) -> Float[Tensor, " 11"]:
    """The normalised Gaussian window of SSIM along one axis."""
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-0.5 * (offsets / WINDOW_SIGMA) ** 2)
    return (weights / weights.sum()).to(dtype)


def ssim(a: Float[Tensor, "H W C"], b: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Structural similarity at every pixel and channel; zero outside the image, as in 3DGS.

    Source: Wang et al. 2004, with an 11 x 11 Gaussian window (sigma 1.5) and values in [0, 1].
    """
    weights = window(a.dtype).to(a.device)

    def blur(image: Tensor) -> Tensor:
        planes = image.permute(2, 0, 1)[:, None]
        planes = torch.nn.functional.conv2d(planes, weights[None, None, :, None], padding=(WINDOW // 2, 0))
        planes = torch.nn.functional.conv2d(planes, weights[None, None, None, :], padding=(0, WINDOW // 2))
        return planes[:, 0].permute(1, 2, 0)

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a * mean_a, blur(b * b) - mean_b * mean_b
    covariance = blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a * mean_a + mean_b * mean_b + C1)
    return luminance * (2 * covariance + C2) / (var_a + var_b + C2)

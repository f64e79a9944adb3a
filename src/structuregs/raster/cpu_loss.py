"""The image loss on the CPU: Numba kernels in float32, held against plain torch by tests."""

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..jit import lanes
from . import loss_kernels as lk


class ImageLoss(torch.autograd.Function):
    """See `image_loss`; the gradient is made along with the value."""

    @staticmethod
    def forward(ctx, rgb, alpha, target_rgb, target_alpha, ssim_weight, alpha_weight) -> Tensor:
        """The loss."""
        height, width = alpha.shape
        arrays = [t.detach().float().contiguous().numpy() for t in (rgb, target_rgb, alpha, target_alpha)]
        image, target = (a.reshape(height, 3 * width) for a in arrays[:2])
        weights = np.array([1 - ssim_weight, ssim_weight, alpha_weight]) / [rgb.numel(), rgb.numel(), alpha.numel()]
        g_image, g_alpha = np.empty_like(image), np.empty_like(arrays[2])
        parts = np.empty((-(-height // lk.ROWS) * -(-width // lk.COLUMNS), 3))
        with lanes() as threads:
            lk.loss_and_gradient(image, target, *arrays[2:], weights.astype(np.float32), threads, g_image, g_alpha, parts)
        ctx.gradients, ctx.scale = (torch.from_numpy(g_image).view(height, width, 3), torch.from_numpy(g_alpha)), 1.0
        return torch.tensor(float(parts.sum(0) @ weights), dtype=rgb.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients):
        """The gradients of rgb and alpha, scaled where they lie: new memory for them would cost as much as the loss."""
        scale = float(gradients[0])
        if scale == 0:
            return *(torch.zeros_like(g) for g in ctx.gradients), None, None, None, None
        for gradient in ctx.gradients:
            gradient.mul_(scale / ctx.scale)
        ctx.scale = scale
        return *ctx.gradients, None, None, None, None

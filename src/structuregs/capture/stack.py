"""Views of one state at one working size, ready for fitting."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from ..geometry import Camera
from .capture import View


@dataclass(frozen=True)
class ImageStack:
    """Images of one size with their cameras, kept as bytes.

    Attributes:
        cameras: V cameras of the images' size.
        rgb: colours over white.
        alpha: coverage by the object, 255 = wholly covered.
    """

    cameras: tuple[Camera, ...]
    rgb: UInt8[np.ndarray, "V H W 3"]
    alpha: UInt8[np.ndarray, "V H W"]

    def __len__(self) -> int:
        return len(self.cameras)

    def target(self, v: int) -> tuple[Float32[Tensor, "H W 3"], Float32[Tensor, "H W"]]:
        """Colours over white and coverage of one view, in [0, 1]."""
        return torch.from_numpy(self.rgb[v]).float() / 255, torch.from_numpy(self.alpha[v]).float() / 255


def stack_views(views: Sequence[View], size: int) -> ImageStack:
    """The views with their longer side averaged down to at most `size` pixels."""

    def shrink(view: View) -> tuple[Camera, np.ndarray, np.ndarray]:
        scale = min(1.0, size / max(view.camera.width, view.camera.height))
        width, height = round(view.camera.width * scale), round(view.camera.height * scale)
        rgb, alpha = view.image(width, height)
        return view.camera.resized(width, height), np.rint(rgb * 255).astype(np.uint8), np.rint(alpha * 255).astype(np.uint8)

    with ThreadPoolExecutor(2) as pool:
        cameras, rgb, alpha = zip(*pool.map(shrink, views), strict=True)
    return ImageStack(tuple(cameras), np.stack(rgb), np.stack(alpha))

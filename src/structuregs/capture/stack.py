"""Views of one state at one working size, cropped to the object, ready for fitting."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from ..geometry import Camera
from .capture import View

_BORDER = 0.04  # empty border kept around the object, as a fraction of the window


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

    def turned(self, turns: Float32[Tensor, "V 3"]) -> "ImageStack":
        """The same images, each camera turned (see `Camera.turned`)."""
        return replace(self, cameras=tuple(c.turned(turn) for c, turn in zip(self.cameras, turns, strict=True)))

    def shifted(self, offset: Float32[Tensor, " 2"]) -> "ImageStack":
        """The same images, every camera's principal point moved (see `Camera.shifted`)."""
        return replace(self, cameras=tuple(c.shifted(offset) for c in self.cameras))

    def __len__(self) -> int:
        return len(self.cameras)

    def target(self, v: int) -> tuple[Float32[Tensor, "H W 3"], Float32[Tensor, "H W"]]:
        """Colours over white and coverage of one view, in [0, 1]."""
        return torch.from_numpy(self.rgb[v]).float().div_(255), torch.from_numpy(self.alpha[v]).float().div_(255)


def stack_views(views: Sequence[View], size: int) -> ImageStack:
    """The views, each cropped to a window around the object and averaged down to at most `size`^2 pixels.

    All windows have the size that the largest mask needs, so that no pixel is spent on what is empty in every view.
    """
    with ThreadPoolExecutor(2) as pool:
        spans = np.array(list(pool.map(_mask_span, views)))
        low, high = spans[:, :2], spans[:, 2:]
        frame = np.array([min(v.camera.width for v in views), min(v.camera.height for v in views)])
        window = np.minimum(np.ceil((high - low).max(0) * (1 + 2 * _BORDER)).astype(int) + 2, frame)
        scale = min(1.0, size / float(np.sqrt(window.prod())))
        # The window becomes a whole number of new pixels; within the frame it may grow by less than one of them.
        pixels = np.maximum(1, np.rint(window * scale)).astype(int)

        def crop(row: tuple[View, np.ndarray]) -> tuple[Camera, np.ndarray, np.ndarray]:
            view, middle = row
            corner = np.clip(np.rint(middle - window / 2).astype(int), 0, frame - window)
            x, y = int(corner[0]), int(corner[1])
            camera = replace(
                view.camera, cx=view.camera.cx - x, cy=view.camera.cy - y, width=int(window[0]), height=int(window[1])
            )
            part = View(view.name, camera, view.rgba[y : y + window[1], x : x + window[0]])
            width, height = int(pixels[0]), int(pixels[1])
            rgb, alpha = part.image(width, height)
            return camera.resized(width, height), np.rint(rgb * 255).astype(np.uint8), np.rint(alpha * 255).astype(np.uint8)

        cameras, rgb, alpha = zip(*pool.map(crop, zip(views, (low + high) / 2, strict=True)), strict=True)
    return ImageStack(tuple(cameras), np.stack(rgb), np.stack(alpha))


def _mask_span(view: View) -> tuple[int, int, int, int]:
    """First column and row of the mask, and one past the last."""
    alpha = view.rgba[..., 3]
    columns, rows = np.flatnonzero(alpha.any(0)), np.flatnonzero(alpha.any(1))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1

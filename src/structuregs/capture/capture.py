"""A capture in memory: posed, masked images of one object in two states."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy.sparse
from jaxtyping import Float32, UInt8, UInt16
from PIL import Image
from torch import Tensor

from ..geometry import Camera
from .errors import CaptureError

MM_PER_UNIT = 1000.0  # depth files count thousandths of the capture's unit


def read_depth(path: Path) -> Float32[np.ndarray, "H W"]:
    """Depth along z in the capture's unit, 0 = none, of a 16-bit PNG in thousandths.

    Raises:
        CaptureError: the file is missing or no image of one channel.
    """
    try:
        with Image.open(path) as image:
            raw = np.asarray(image)
    except (OSError, SyntaxError) as error:
        raise CaptureError(f"{path}: this depth map cannot be read ({error}); write it again as a 16-bit PNG.") from error
    if raw.ndim != 2:
        raise CaptureError(f"{path}: a depth map has one channel, this one has {raw.shape[2]}; write it as a 16-bit grey PNG.")
    return raw.astype(np.float32) / np.float32(MM_PER_UNIT)


@dataclass(frozen=True)
class View:
    """One posed image of the object in one state, with its mask.

    Attributes:
        name: unique among the views of one state and split; the image file's stem.
        camera: whose image it is, in full size.
        rgba: sRGB colour and mask; alpha is straight (colours are not multiplied by it) and 0 off the object.
        depth_source: depth along z at pixel centres, in the capture's unit, 0 = none: the values, or the file that holds
            them, which is read only when `depth` is asked for.
    """

    name: str
    camera: Camera
    rgba: UInt8[np.ndarray, "H W 4"]
    depth_source: Float32[np.ndarray, "H W"] | Path | None = None

    @property
    def depth(self) -> Float32[np.ndarray, "H W"] | None:
        """Depth along z at pixel centres, in the capture's unit, 0 = none; None where the capture has no depth."""
        if not isinstance(self.depth_source, Path):
            return self.depth_source
        depth = read_depth(self.depth_source)
        if depth.shape != self.rgba.shape[:2]:
            size = f"{depth.shape[1]} x {depth.shape[0]}"
            raise CaptureError(
                f"{self.depth_source}: the depth map has {size} pixels, its image {self.camera.width} x {self.camera.height};"
                " write both in the same size."
            )
        return depth

    def image(self, width: int, height: int) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Colour over white and alpha, both in [0, 1], at a size of choice by exact area averaging.

        The colours are multiplied by alpha before they are averaged, as light adds up; `camera.resized` gives the camera.
        """
        alpha = self.rgba[..., 3:]
        light = np.empty_like(self.rgba, dtype=np.uint16)
        np.multiply(self.rgba[..., :3], alpha, out=light[..., :3], dtype=np.uint16)
        np.multiply(alpha, np.uint16(255), out=light[..., 3:], dtype=np.uint16)
        mean = _area_mean(light, width, height)
        mean *= np.float32(1 / 255**2)
        return mean[..., :3] + (1 - mean[..., 3:]), np.ascontiguousarray(mean[..., 3])


@dataclass(frozen=True)
class Capture:
    """Posed, masked images of one object in two states, in one world frame.

    Attributes:
        name: of the object.
        root: the folder it was read from.
        train, test: the views of state 0 and of state 1; the test views are only for measuring.
        layout: the folder's layout, "paris" or "artgs"; "memory" where there is no folder.
    """

    name: str
    root: Path
    train: tuple[tuple[View, ...], tuple[View, ...]]
    test: tuple[tuple[View, ...], tuple[View, ...]]
    layout: str

    def turned(self, turns: Sequence[Float32[Tensor, "_ 3"]]) -> "Capture":
        """The capture with every training camera turned: rotation vectors of either state's (see `Camera.turned`)."""
        first, second = (
            tuple(replace(v, camera=v.camera.turned(turn)) for v, turn in zip(views, state, strict=True))
            for views, state in zip(self.train, turns, strict=True)
        )
        return replace(self, train=(first, second))

    def shifted(self, offset: Float32[Tensor, " 2"]) -> "Capture":
        """The capture with the principal point of every camera moved, those of test views too (see `Camera.shifted`)."""
        train, test = (
            tuple(tuple(replace(v, camera=v.camera.shifted(offset)) for v in views) for views in states)
            for states in (self.train, self.test)
        )
        return replace(self, train=train, test=test)


def _area_mean(image: UInt16[np.ndarray, "H W C"], width: int, height: int) -> Float32[np.ndarray, "h w C"]:
    """Mean over the area of each pixel of the new size; exact for every ratio."""
    H, W, C = image.shape
    if (width, height) == (W, H):
        return image.astype(np.float32)
    if W % width == 0 and H % height == 0:
        fy, fx = H // height, W // width
        rows = image.reshape(height, fy, W * C).sum(1, dtype=np.uint32)
        columns = rows.reshape(height, width, fx, C).sum(2, dtype=np.float32)
        return columns / np.float32(fx * fy)
    rows = _overlaps(H, height) @ image.reshape(H, W * C).astype(np.float32)
    by_column = rows.reshape(height, W, C).swapaxes(0, 1).reshape(W, height * C)
    columns = _overlaps(W, width) @ by_column
    return np.ascontiguousarray(columns.reshape(width, height, C).swapaxes(0, 1))


def _overlaps(old: int, new: int) -> scipy.sparse.csr_matrix:
    """The share that each old pixel has of each new one along one side (new x old; rows add up to 1)."""
    edges = np.union1d(np.arange(new + 1) * old, np.arange(old + 1) * new) / (old * new)
    middles = (edges[1:] + edges[:-1]) / 2
    cells = ((middles * new).astype(int), (middles * old).astype(int))
    return scipy.sparse.csr_matrix(((np.diff(edges) * new).astype(np.float32), cells), shape=(new, old))

"""Captures of known objects: cameras around them, rendering, and files with the truth beside."""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, UInt8

from ..capture import Capture, Layout, View, save_capture, save_truth
from ..geometry import SE3, Camera
from .objects import KnownObject
from .render import Lighting, draw

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class RenderOptions:
    """How a known object is photographed.

    Attributes:
        size: of the square images, pixels.
        views, test_views: of each state.
        samples: rays along each side of a pixel.
        field_of_view_deg: of the whole image.
        elevation_deg: lowest and highest elevation of the cameras above the horizon.
        lighting: the same in both states.
        exposure_change: factor on the colours of state 1 against state 0.
        noise: standard deviation of the error of each colour, in [0, 1].
        seed: of the cameras' azimuths and the noise.
    """

    size: int = 200
    views: int = 24
    test_views: int = 4
    samples: int = 3
    field_of_view_deg: float = 40.0
    elevation_deg: tuple[float, float] = (-5.0, 75.0)
    lighting: Lighting = field(default_factory=Lighting)
    exposure_change: float = 1.0
    noise: float = 0.0
    seed: int = 0


def make_capture(obj: KnownObject, options: RenderOptions | None = None) -> Capture:
    """Photographs of a known object in its two states, in memory, with depth; the cameras of no two sets agree."""
    options = options or RenderOptions()
    generator = np.random.default_rng(options.seed)
    counts = (options.views, options.views, options.test_views, options.test_views)
    # All azimuths are drawn before any noise, so that pictures with and without noise have the same cameras.
    orbits = [orbit(obj, n, options, azimuth) for n, azimuth in zip(counts, generator.uniform(0, 2 * math.pi, 4), strict=True)]
    train = [_photograph(obj, state, orbits[state], options, generator) for state in (0, 1)]
    test = [_photograph(obj, state, orbits[2 + state], options, generator) for state in (0, 1)]
    return Capture(obj.name, Path(obj.name), (train[0], train[1]), (test[0], test[1]), "memory")


def save_known(obj: KnownObject, capture: Capture, root: Path, layout: Layout) -> None:
    """Writes a capture of a known object with its true joints and meshes.

    Args:
        obj: the object.
        capture: from `make_capture`.
        root: the capture's folder; in the PARIS layout it lies below a folder `load`.
        layout: of the files.
    """
    save_truth(root, layout, obj.joints, obj.meshes())
    save_capture(capture, root, layout)


def orbit(obj: KnownObject, count: int, options: RenderOptions, azimuth: float = 0.0) -> list[Camera]:
    """Cameras on a sphere around the object, which see all of it in both states: a Fibonacci spiral from `azimuth` radians."""
    centre, radius = obj.bounding_sphere()
    half_angle = math.radians(options.field_of_view_deg / 2)
    distance = 1.02 * radius / math.sin(half_angle)
    focal = options.size / 2 / math.tan(half_angle)
    low, high = (math.sin(math.radians(angle)) for angle in options.elevation_deg)
    cameras = []
    for i in range(count):
        z = high + (low - high) * (i + 0.5) / count
        angle = azimuth + i * _GOLDEN_ANGLE
        ring = math.sqrt(1 - z * z)
        outward = np.array([ring * math.cos(angle), ring * math.sin(angle), z])
        pose = _looking_along(-outward, np.array(centre) + distance * outward)
        cameras.append(Camera(pose, focal, focal, options.size / 2, options.size / 2, options.size, options.size))
    return cameras


def _looking_along(forward: Float64[np.ndarray, " 3"], position: Float64[np.ndarray, " 3"]) -> SE3:
    """The pose of a camera that looks along a unit vector, with the horizon level (float32)."""
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward], 1)
    return SE3.from_rotation(torch.from_numpy(R), torch.from_numpy(position)).to(dtype=torch.float32)


def _photograph(
    obj: KnownObject, state: int, cameras: Sequence[Camera], options: RenderOptions, generator: np.random.Generator
) -> tuple[View, ...]:
    """Views of one state."""
    boxes = [box for part in obj.parts for box in part.at_state(state)]
    exposure = options.lighting.exposure * (options.exposure_change if state else 1.0)
    lighting = replace(options.lighting, exposure=exposure)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        pictures = list(pool.map(lambda camera: draw(boxes, camera, lighting, options.samples), cameras))
    return tuple(
        View(f"{i:04d}", camera, _with_noise(picture.rgba, options.noise, generator), picture.depth)
        for i, (camera, picture) in enumerate(zip(cameras, pictures, strict=True))
    )


def _with_noise(
    rgba: UInt8[np.ndarray, "H W 4"], deviation: float, generator: np.random.Generator
) -> UInt8[np.ndarray, "H W 4"]:
    """The image with normal errors added to the colours wherever the object is."""
    if not deviation:
        return rgba
    noisy = rgba.copy()
    covered = rgba[..., 3] > 0
    error = 255 * deviation * generator.standard_normal((int(covered.sum()), 3))
    noisy[covered, :3] = np.rint(rgba[covered, :3] + error).clip(0, 255)
    return noisy

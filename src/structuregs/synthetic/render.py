"""Pictures of boxes: nearest hits by the slab test, solid textures, one fixed light.  Compiled by Numba, for the CPU.

Kernels carry no annotations (`no_type_check` keeps the tests' shape checker off them): their docstrings give shapes.
They hold no lock of Python's, so that views render in parallel threads.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, get_args, no_type_check

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, UInt8
from numba import njit

from ..geometry import Camera
from .objects import TexturedBox, TextureKind

# Columns of the table of boxes: axes (3 x 3, in the world, as columns), centre, half extents, texture coordinates of the
# centre, light and dark colour, texture kind, frequency, seed.
_AXES, _CENTRE, _HALF, _ANCHOR, _LIGHT, _DARK, _KIND, _FREQUENCY, _SEED = 0, 9, 12, 15, 18, 21, 24, 25, 26
_STRIPES, _CHECKER, _WOOD, _NOISE = (get_args(TextureKind).index(kind) for kind in ("stripes", "checker", "wood", "noise"))


@dataclass(frozen=True)
class Lighting:
    """Light and shade.

    Attributes:
        towards: direction to the light, in the world; it stays where it is while parts move.
        ambient: in [0, 1], the share of light that comes from everywhere.
        shadows: whether boxes cast shadows.
        exposure: factor on all colours.
    """

    towards: tuple[float, float, float] = (0.35, -0.6, 0.72)
    ambient: float = 0.5
    shadows: bool = False
    exposure: float = 1.0


@dataclass(frozen=True)
class Picture:
    """A rendered view.

    Attributes:
        rgba: straight alpha.
        depth: along z at pixel centres, 0 = none.
        box: index of the box at pixel centres, -1 = none.
    """

    rgba: UInt8[np.ndarray, "H W 4"]
    depth: Float32[np.ndarray, "H W"]
    box: Int32[np.ndarray, "H W"]


class _Light(NamedTuple):
    """`Lighting` for the kernels, with the unit vector to the light."""

    x: float
    y: float
    z: float
    ambient: float
    shadows: bool
    exposure: float


def draw(boxes: Sequence[TexturedBox], camera: Camera, lighting: Lighting, samples: int = 3) -> Picture:
    """The picture of boxes, all in front of the camera, with `samples` x `samples` rays a pixel."""
    x, y, z = (np.array(lighting.towards) / np.linalg.norm(lighting.towards)).tolist()
    light = _Light(x, y, z, lighting.ambient, lighting.shadows, lighting.exposure)
    pose = camera.T_world_camera.to(dtype=torch.float64).as_matrix().numpy()
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    size = (camera.width, camera.height)
    rgba, depth, box = _draw(_tabulate(boxes), _pixel_bounds(boxes, camera), pose, lens, size, samples, light)
    return Picture(rgba, depth, box)


def _tabulate(boxes: Sequence[TexturedBox]) -> Float64[np.ndarray, "B 27"]:
    """A row for each box: one flat array, because Numba counts references to every member of a record."""
    rows = []
    for item in boxes:
        pose, texture = item.box.T_world_box, item.texture
        axes, centre, half = pose.rotation.flatten().tolist(), pose.xyz.tolist(), item.box.half_extents.tolist()
        kind = get_args(TextureKind).index(texture.kind)
        rows.append([*axes, *centre, *half, *item.anchor, *texture.light, *texture.dark, kind, texture.frequency, texture.seed])
    return np.array(rows)


def _pixel_bounds(boxes: Sequence[TexturedBox], camera: Camera) -> Float64[np.ndarray, "B 4"]:
    """Left, top, right and bottom of the pixels that each box can cover."""
    corners = torch.stack([item.box.corners for item in boxes])
    pixels, depth = camera.project(corners)
    if (depth <= 0).any():
        raise ValueError("draw: a box reaches behind the camera; move the camera away from the object.")
    return np.concatenate([np.floor(pixels.amin(1).numpy()), np.ceil(pixels.amax(1).numpy())], 1)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _draw(table, bounds, pose, lens, size, samples, light):
    """Colours (H, W, 4), depth (H, W) and hit boxes (H, W); `pose` is camera-to-world (4, 4), `lens` is fx, fy, cx, cy."""
    width, height = size
    rgba = np.zeros((height, width, 4), np.uint8)
    depth = np.zeros((height, width), np.float32)
    hit = np.full((height, width), -1, np.int32)
    near = np.empty(len(bounds), np.int64)
    origin = (pose[0, 3], pose[1, 3], pose[2, 3])
    for v in range(height):
        for u in range(width):
            count = 0
            for b in range(len(bounds)):
                if bounds[b, 0] <= u + 1 and u <= bounds[b, 2] and bounds[b, 1] <= v + 1 and v <= bounds[b, 3]:
                    near[count] = b
                    count += 1
            if count == 0:
                continue
            t, box, _, _ = _nearest(table, near, count, origin, _ray(pose, lens, u + 0.5, v + 0.5))
            if box >= 0:
                depth[v, u] = t
                hit[v, u] = box
            rgba[v, u] = _pixel(table, near, count, pose, lens, u, v, samples, light)
    return rgba, depth, hit


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _pixel(table, near, count, pose, lens, u, v, samples, light):
    """Mean colour of the rays that hit, and the share of those: four bytes."""
    origin = (pose[0, 3], pose[1, 3], pose[2, 3])
    red = green = blue = 0.0
    hits = 0
    for i in range(samples * samples):
        ray = _ray(pose, lens, u + (i % samples + 0.5) / samples, v + (i // samples + 0.5) / samples)
        t, box, axis, side = _nearest(table, near, count, origin, ray)
        if box >= 0:
            hits += 1
            point = (origin[0] + t * ray[0], origin[1] + t * ray[1], origin[2] + t * ray[2])
            r, g, b = _colour(table, box, axis, side, point, light)
            red, green, blue = red + r, green + g, blue + b
    share = hits / samples**2
    hits = max(hits, 1)
    return _byte(red / hits), _byte(green / hits), _byte(blue / hits), _byte(share)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _byte(value):
    """A value in [0, 1] as a byte; larger ones are white."""
    return np.uint8(round(255 * min(value, 1.0)))


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _ray(pose, lens, x, y):
    """World direction (a triple) through a pixel position; its parameter is the depth along z."""
    a, b = (x - lens[2]) / lens[0], (y - lens[3]) / lens[1]
    return (
        pose[0, 0] * a + pose[0, 1] * b + pose[0, 2],
        pose[1, 0] * a + pose[1, 1] * b + pose[1, 2],
        pose[2, 0] * a + pose[2, 1] * b + pose[2, 2],
    )


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _nearest(table, near, count, origin, ray):
    """Ray parameter, box, axis and side (-1, 1) of the first hit among the boxes `near[:count]`; box -1 where there is none."""
    best, hit, hit_axis, hit_side = np.inf, -1, 0, 1.0
    for b in near[:count]:
        entry, leave, axis, side = -np.inf, np.inf, 0, 1.0
        for a in range(3):
            o = d = 0.0
            for i in range(3):
                o += table[b, _AXES + 3 * i + a] * (origin[i] - table[b, _CENTRE + i])
                d += table[b, _AXES + 3 * i + a] * ray[i]
            d = d if abs(d) > 1e-12 else 1e-12
            sign = 1.0 if d > 0 else -1.0
            t0 = (-sign * table[b, _HALF + a] - o) / d
            t1 = (sign * table[b, _HALF + a] - o) / d
            if t0 > entry:
                entry, axis, side = t0, a, -sign
            leave = min(leave, t1)
        if 0 < entry < leave and entry < best:
            best, hit, hit_axis, hit_side = entry, b, axis, side
    return best, hit, hit_axis, hit_side


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _colour(table, b, axis, side, point, light):
    """Colour (a triple) of a box's surface at a world point: its texture under Lambert's law."""
    n = (side * table[b, _AXES + axis], side * table[b, _AXES + 3 + axis], side * table[b, _AXES + 6 + axis])
    facing = n[0] * light.x + n[1] * light.y + n[2] * light.z
    if facing > 0 and light.shadows:
        above = (point[0] + 1e-4 * n[0], point[1] + 1e-4 * n[1], point[2] + 1e-4 * n[2])
        _, other, _, _ = _nearest(table, np.arange(len(table)), len(table), above, (light.x, light.y, light.z))
        facing = facing if other < 0 else 0.0
    p = (
        _texture_coordinate(table, b, 0, point),
        _texture_coordinate(table, b, 1, point),
        _texture_coordinate(table, b, 2, point),
    )
    mix, strength = _texture(p, int(table[b, _KIND]), table[b, _FREQUENCY], int(table[b, _SEED]))
    strength *= light.exposure * (light.ambient + (1 - light.ambient) * max(facing, 0.0))
    return (
        strength * ((1 - mix) * table[b, _LIGHT] + mix * table[b, _DARK]),
        strength * ((1 - mix) * table[b, _LIGHT + 1] + mix * table[b, _DARK + 1]),
        strength * ((1 - mix) * table[b, _LIGHT + 2] + mix * table[b, _DARK + 2]),
    )


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _texture_coordinate(table, b, a, point):
    """Coordinate `a` of a world point in a box's texture."""
    x, y, z = point[0] - table[b, _CENTRE], point[1] - table[b, _CENTRE + 1], point[2] - table[b, _CENTRE + 2]
    along = table[b, _AXES + a] * x + table[b, _AXES + 3 + a] * y + table[b, _AXES + 6 + a] * z
    return table[b, _ANCHOR + a] + along


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _texture(p, kind, frequency, seed):
    """Share of the dark colour, and a factor on both, at a point (a triple) in texture coordinates."""
    x, y, z = frequency * p[0], frequency * p[1], frequency * p[2]
    slow = _noise(2.1 * p[0], 2.1 * p[1], 2.1 * p[2], seed)
    fine = _noise(11 * p[0], 11 * p[1], 11 * p[2], seed + 1)
    if kind == _STRIPES:
        mix = 0.5 + 0.5 * math.sin(2 * math.pi * (x + 0.7 * y + 0.4 * z + slow))
    elif kind == _CHECKER:
        mix = float((math.floor(x + 0.37) + math.floor(y + 0.37) + math.floor(z + 0.37)) % 2)
    elif kind == _WOOD:
        rings = 2.5 * math.hypot(x + 0.6 * slow, 0.25 * z + 0.5 * y + 0.3 * fine)
        mix = rings - math.floor(rings)
    elif kind == _NOISE:
        cloud = 0.6 * _noise(x, y, z, seed + 2) + 0.4 * _noise(2.3 * x, 2.3 * y, 2.3 * z, seed + 3)
        mix = min(max(2.5 * cloud - 0.75, 0.0), 1.0)
    else:
        mix = fine
    return mix, 0.7 + 0.35 * slow + 0.1 * fine


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _noise(x, y, z, seed):
    """Value noise in [0, 1]: random values on the integer lattice, smoothly interpolated."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    fx, fy, fz = x - i, y - j, z - k
    fx, fy, fz = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy), fz * fz * (3 - 2 * fz)
    total = 0.0
    for corner in range(8):
        a, b, c = corner & 1, corner >> 1 & 1, corner >> 2
        weight = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if c else 1 - fz)
        total += weight * _hash(int(i) + a, int(j) + b, int(k) + c, seed)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _hash(i, j, k, seed):
    """A number in [0, 1) that looks random, of a lattice point and a seed."""
    h = (i * 374761393 + j * 668265263 + k * 2147483647 + seed * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 668265263) & 0xFFFFFFFF
    return (h ^ (h >> 15)) / 4294967296.0

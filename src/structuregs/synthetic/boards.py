"""What known objects are made of: boards with textures, hinges, and parts that are given shut."""

import colorsys
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from ..capture import TrueJoint
from ..geometry import SE3, Box
from .objects import KnownPart, Texture, TexturedBox, TextureKind

Point = tuple[float | int, float | int, float | int]


def walls(low: Point, high: Point, t: float, texture: Texture) -> list[TexturedBox]:
    """Front, back, left and right walls of thickness `t` inside a box."""
    (a, b, c), (x, y, z) = low, high
    return [
        board((a + t, b, c), (x - t, b + t, z), texture),
        board((a + t, y - t, c), (x - t, y, z), texture),
        board((a, b, c), (a + t, y, z), texture),
        board((x - t, b, c), (x, y, z), texture),
    ]


def hinge(axis: Point, origin: Point, q0_deg: float, q1_deg: float) -> TrueJoint:
    """The joint that turns about an axis between two angles, degrees."""
    (x, y, z), (a, b, c) = map(float, axis), map(float, origin)
    return TrueJoint("revolute", (x, y, z), (a, b, c), math.radians(q0_deg), math.radians(q1_deg))


def opened(name: str, boxes: Sequence[TexturedBox], joint: TrueJoint) -> KnownPart:
    """A part of boxes that are given shut, opened to the joint's value in state 0."""
    to_state_0 = replace(joint, q0=0.0, q1=joint.q0).motion()
    return KnownPart(name, tuple(box.moved(to_state_0) for box in boxes), joint)


def board(low: Point, high: Point, texture: Texture) -> TexturedBox:
    """The box between two corners."""
    a, b = (torch.tensor(corner, dtype=torch.float64) for corner in (low, high))
    eye = torch.eye(3, dtype=torch.float64)
    x, y, z = ((a + b) / 2).tolist()
    return TexturedBox(Box(SE3.from_rotation(eye, (a + b) / 2), (b - a) / 2), texture, (x, y, z))


def texture(rng: np.random.Generator, kind: TextureKind | None = None, frequency: float = 4.0) -> Texture:
    """A texture of a random hue and, where none is given, of a random kind."""
    kinds: list[TextureKind] = ["stripes", "checker", "wood", "noise"]
    chosen = kinds[rng.integers(len(kinds))] if kind is None else kind
    hue = rng.uniform(0.03, 0.1) if chosen == "wood" else rng.random()
    light = colorsys.hsv_to_rgb(hue, rng.uniform(0.25, 0.6), rng.uniform(0.8, 0.95))
    dark = colorsys.hsv_to_rgb((hue + rng.uniform(-0.08, 0.08)) % 1, rng.uniform(0.5, 0.8), rng.uniform(0.4, 0.6))
    return Texture(chosen, light, dark, frequency * rng.uniform(0.85, 1.15), int(rng.integers(1 << 16)))

"""Known articulated objects: parts of textured boxes, with true joints."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from ..capture import TrueJoint, TrueMesh
from ..geometry import SE3, Box

TextureKind = Literal["plain", "stripes", "checker", "wood", "noise"]

# Triangles of a box over `Box.corners`, counter-clockwise seen from outside: two for each side of each axis.
_QUADS = [
    [s << a | i << (a + 1) % 3 | j << (a + 2) % 3 for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))][:: 1 if s else -1]
    for a in range(3)
    for s in (0, 1)
]
_FACES = np.array([triangle for a, b, c, d in _QUADS for triangle in ((a, b, c), (a, c, d))])


@dataclass(frozen=True)
class Texture:
    """A solid texture: a pattern between two colours along the axes of its box, darkened by a slow noise.

    Attributes:
        kind: the pattern.
        light, dark: rgb in [0, 1].
        frequency: repeats per unit of length.
        seed: of the noise.
    """

    kind: TextureKind
    light: tuple[float, float, float]
    dark: tuple[float, float, float]
    frequency: float
    seed: int


@dataclass(frozen=True)
class TexturedBox:
    """A solid box and its texture.

    Attributes:
        box: one box, float64.
        texture: in coordinates along the box's axes.
        anchor: texture coordinates of the box's centre; boards of one texture fit together where these agree.
    """

    box: Box
    texture: Texture
    anchor: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def moved(self, T: SE3) -> "TexturedBox":
        """The box after a rigid motion of the world; its texture goes with it."""
        return TexturedBox(self.box.moved(T), self.texture, self.anchor)


@dataclass(frozen=True)
class KnownPart:
    """A rigid part.

    Attributes:
        name: for people.
        boxes: in the world, in state 0 (float64).
        joint: how it moves; None for the base.
    """

    name: str
    boxes: tuple[TexturedBox, ...]
    joint: TrueJoint | None = None

    def at_state(self, state: int) -> tuple[TexturedBox, ...]:
        """Its boxes in the world, in state 0 or 1."""
        if state == 0 or self.joint is None:
            return self.boxes
        motion = self.joint.motion()
        return tuple(box.moved(motion) for box in self.boxes)

    def mesh(self, state: int) -> TrueMesh:
        """The surfaces of its boxes in the world; boxes that touch or overlap are not merged."""
        corners = [item.box.corners.numpy() for item in self.at_state(state)]
        faces = [_FACES + 8 * i for i in range(len(corners))]
        return TrueMesh(np.concatenate(corners), np.concatenate(faces))


@dataclass(frozen=True)
class KnownObject:
    """Parts of which the first is the base and each other one moves by its joint."""

    name: str
    parts: tuple[KnownPart, ...]

    @property
    def joints(self) -> tuple[TrueJoint, ...]:
        """The true joints, part after part."""
        return tuple(part.joint for part in self.parts if part.joint is not None)

    def meshes(self) -> dict[tuple[int, int], TrueMesh]:
        """True surfaces by state and part, as `Truth.meshes` has them."""
        return {(state, k): part.mesh(state) for state in (0, 1) for k, part in enumerate(self.parts)}

    def bounding_sphere(self) -> tuple[tuple[float, float, float], float]:
        """Centre and radius of a sphere around the object in both states: about the middle of its bounds."""
        vertices = torch.from_numpy(np.concatenate([mesh.vertices for mesh in self.meshes().values()]))
        middle = (vertices.amin(0) + vertices.amax(0)) / 2
        x, y, z = middle.tolist()
        return (x, y, z), float((vertices - middle).norm(dim=1).max())

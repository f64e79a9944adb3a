"""Oriented boxes."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .se3 import SE3

_EDGES = torch.tensor([[i, i | b] for i in range(8) for b in (1, 2, 4) if not i & b])


@dataclass(frozen=True)
class Box:
    """Oriented boxes; the canonical space [-1, 1]^3 of each is stretched by its half extents (supplement 1.1).

    Attributes:
        T_world_box: pose of the box's centre and axes.
        half_extents: half of its size along its own axes (MuJoCo's convention; URDF and trimesh use full sizes).
    """

    T_world_box: SE3
    half_extents: Float[Tensor, "*batch 3"]

    @staticmethod
    def around(points: Float[Tensor, "P 3"], R_world_box: Float[Tensor, "3 3"]) -> "Box":
        """The smallest box with the given axes (columns) that holds all points."""
        local = points @ R_world_box
        low, high = local.amin(0), local.amax(0)
        return Box(SE3.from_rotation(R_world_box, R_world_box @ ((low + high) / 2)), (high - low) / 2)

    def to_world(self, canonical: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch2 3"]:
        """Canonical coordinates in [-1, 1]^3 to the world."""
        return self.T_world_box.apply(canonical * self.half_extents)

    def to_canonical(self, points_world: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch2 3"]:
        """World points to canonical coordinates; inside where all are in [-1, 1]."""
        return self.T_world_box.inverse().apply(points_world) / self.half_extents

    def contains(self, points_world: Float[Tensor, "*#batch 3"], margin: float = 0.0) -> Bool[Tensor, "*batch2"]:
        """Whether points lie inside the box grown by `margin` (world units) on every side."""
        local = self.T_world_box.inverse().apply(points_world)
        return (local.abs() <= self.half_extents + margin).all(-1)

    def moved(self, T: SE3) -> "Box":
        """The box after a rigid motion of the world."""
        return Box(T @ self.T_world_box, self.half_extents)

    @property
    def corners(self) -> Float[Tensor, "*batch 8 3"]:
        """Corners in the world; bit i of the index is the sign along axis i."""
        signs = torch.tensor([[1.0 if i >> b & 1 else -1.0 for b in range(3)] for i in range(8)], dtype=self.half_extents.dtype)
        local = signs.to(self.half_extents.device) * self.half_extents[..., None, :]
        return local @ self.T_world_box.rotation.transpose(-1, -2) + self.T_world_box.xyz[..., None, :]

    @property
    def edges(self) -> Float[Tensor, "*batch 12 2 3"]:
        """The twelve edges as pairs of corners."""
        return self.corners[..., _EDGES, :]

    @property
    def volume(self) -> Float[Tensor, "*batch"]:
        """Volume in the world's unit cubed."""
        return 8 * self.half_extents.prod(-1)

    def intersect(
        self, origin: Float[Tensor, "*#rays 3"], direction: Float[Tensor, "*#rays 3"]
    ) -> tuple[Float[Tensor, "*hits"], Float[Tensor, "*hits"]]:
        """Ray parameters of entry and exit by the slab test; the ray misses the box where entry > exit.

        The box's batch shape must broadcast with the rays' shape.
        """
        T_box_world = self.T_world_box.inverse()
        o = T_box_world.apply(origin)
        d = (T_box_world.rotation @ direction[..., None])[..., 0]
        d = torch.where(d.abs() < 1e-9, torch.full_like(d, 1e-9), d)
        a, b = (-self.half_extents - o) / d, (self.half_extents - o) / d
        return torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)

    def __getitem__(self, index: object) -> "Box":
        """Indexes the batch."""
        return Box(self.T_world_box[index], self.half_extents[index])  # pyright: ignore[reportArgumentType]

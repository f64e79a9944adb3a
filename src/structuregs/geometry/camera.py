"""Pinhole cameras."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from .se3 import SE3


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV axes (x right, y down, z forward), pixel centres at +0.5.

    Attributes:
        T_world_camera: its pose, one motion without batch.
        fx, fy, cx, cy: focal lengths and principal point, pixels.
        width, height: of its images, pixels.
    """

    T_world_camera: SE3
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def resized(self, width: int, height: int) -> "Camera":
        """The same view on an image of another size."""
        sx, sy = width / self.width, height / self.height
        return Camera(self.T_world_camera, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def turned(self, turn: Float[Tensor, " 3"]) -> "Camera":
        """The camera turned about its own centre by a rotation vector in its own frame, radians."""
        pose = self.T_world_camera.wxyz_xyz
        return replace(self, T_world_camera=self.T_world_camera @ SE3.exp(torch.cat([torch.zeros(3), turn]).to(pose)))

    def shifted(self, offset: Float[Tensor, " 2"]) -> "Camera":
        """The camera with its principal point moved to the right and down; in focal lengths, as for images of any size."""
        x, y = offset.tolist()
        return replace(self, cx=self.cx + self.fx * x, cy=self.cy + self.fy * y)

    @property
    def K(self) -> Float[Tensor, "3 3"]:
        """Intrinsic matrix, pixels."""
        return torch.tensor([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @property
    def projection(self) -> Float64[Tensor, "3 4"]:
        """World points (homogeneous) to pixels times depth, and depth."""
        return self.K.double() @ self.T_world_camera.to(dtype=torch.float64).inverse().as_matrix()[:3]

    @property
    def centre(self) -> Float[Tensor, " 3"]:
        """Its position in the world."""
        return self.T_world_camera.xyz

    def project(self, points_world: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
        """Pixel positions and depths along z of world points; points behind the camera have depth <= 0."""
        p = self.T_world_camera.inverse().to(dtype=points_world.dtype).apply(points_world)
        z = p[..., 2]
        safe = torch.where(z.abs() < 1e-9, torch.full_like(z, 1e-9), z)
        return torch.stack([self.fx * p[..., 0] / safe + self.cx, self.fy * p[..., 1] / safe + self.cy], -1), z

    def rays(self, pixels: Float[Tensor, "*batch 2"] | None = None) -> tuple[Float[Tensor, " 3"], Float[Tensor, "*batch 3"]]:
        """Origin and directions of the rays through `pixels` (default: every pixel's centre, as `H W 3`).

        Directions have unit z in the camera's frame, so a ray's parameter is the depth along z.
        """
        d = self.directions(pixels)
        return self.centre, d @ self.T_world_camera.rotation.to(d.dtype).T

    def directions(self, pixels: Float[Tensor, "*batch 2"] | None = None) -> Float[Tensor, "*batch 3"]:
        """Of the rays through `pixels`, as in `rays`, in the camera's own frame."""
        if pixels is None:
            v, u = torch.meshgrid(torch.arange(self.height) + 0.5, torch.arange(self.width) + 0.5, indexing="ij")
            pixels = torch.stack([u, v], -1)
        x, y = (pixels[..., 0] - self.cx) / self.fx, (pixels[..., 1] - self.cy) / self.fy
        return torch.stack([x, y, torch.ones_like(x)], -1)

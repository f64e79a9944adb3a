"""Rigid motions, batched and differentiable."""

import functools
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

_SMALL_ANGLE = 1e-3  # radians; below it the series are exact to float64 rounding


def quat_multiply(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Hamilton product of two quaternions `wxyz`: the rotation b followed by a."""
    aw, ax, ay, az = a.unbind(-1)
    if a.dim() == 1:  # one for many: a product of matrices, which costs a tenth
        left = torch.stack([aw, -ax, -ay, -az, ax, aw, -az, ay, ay, az, aw, -ax, az, -ay, ax, aw]).reshape(4, 4)
        return b @ left.T
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def quat_to_matrix(wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions, which need not be of unit length."""
    q = torch.nn.functional.normalize(wxyz, dim=-1)
    products = (q[..., :, None] * q[..., None, :]).flatten(-2)
    weights, ones = _matrix_of_products(q.dtype, q.device)
    return (products @ weights + ones).unflatten(-1, (3, 3))


@functools.cache
def _matrix_of_products(dtype: torch.dtype, device: torch.device) -> tuple[Float[Tensor, "16 9"], Float[Tensor, " 9"]]:
    """Makes a rotation matrix, row by row, of the products of a unit quaternion's components: a few operations, not fifty."""
    w, x, y, z = range(4)
    rows = [
        [(y, y, -2), (z, z, -2)], [(x, y, 2), (w, z, -2)], [(x, z, 2), (w, y, 2)],
        [(x, y, 2), (w, z, 2)], [(x, x, -2), (z, z, -2)], [(y, z, 2), (w, x, -2)],
        [(x, z, 2), (w, y, -2)], [(y, z, 2), (w, x, 2)], [(x, x, -2), (y, y, -2)],
    ]  # fmt: skip
    weights = torch.zeros(16, 9, dtype=dtype, device=device)
    for entry, terms in enumerate(rows):
        for a, b, factor in terms:
            weights[4 * a + b, entry] = factor
    return weights, torch.eye(3, dtype=dtype, device=device).flatten()


def _matrix_to_quat(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions `wxyz` with w >= 0, from the largest of the four components (Shepperd's method)."""
    trace = R.diagonal(dim1=-2, dim2=-1)
    xx, yy, zz = trace.unbind(-1)
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    a, b, c = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    d, e, f = R[..., 1, 0] + R[..., 0, 1], R[..., 0, 2] + R[..., 2, 0], R[..., 2, 1] + R[..., 1, 2]
    candidates = torch.stack(
        [
            torch.stack([squares[..., 0], a, b, c], -1),
            torch.stack([a, squares[..., 1], d, e], -1),
            torch.stack([b, d, squares[..., 2], f], -1),
            torch.stack([c, e, f, squares[..., 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    q = torch.nn.functional.normalize(candidates.gather(-2, best).squeeze(-2), dim=-1)
    return torch.where(q[..., :1] < 0, -q, q)


@dataclass(frozen=True)
class SE3:
    """Rigid motions `T_a_b`: coordinates in b to coordinates in a, `p_a = T_a_b @ p_b`.

    Attributes:
        wxyz_xyz: rotation as a unit quaternion, then the translation (in the capture's unit); any batch shape.
    """

    wxyz_xyz: Float[Tensor, "*batch 7"]

    @staticmethod
    def identity(*batch: int, dtype: torch.dtype = torch.float32, device: torch.device | None = None) -> "SE3":
        """The motion that leaves every point where it is, in the batch shape given."""
        one = torch.tensor([1.0, 0, 0, 0, 0, 0, 0], dtype=dtype, device=device)
        return SE3(one.expand(*batch, 7).clone())

    @staticmethod
    def from_quat(wxyz: Float[Tensor, "*batch 4"], xyz: Float[Tensor, "*batch 3"]) -> "SE3":
        """From quaternions of any length and translations."""
        return SE3(torch.cat([torch.nn.functional.normalize(wxyz, dim=-1), xyz], -1))

    @staticmethod
    def from_rotation(R: Float[Tensor, "*batch 3 3"], xyz: Float[Tensor, "*batch 3"]) -> "SE3":
        """From rotation matrices and translations."""
        return SE3(torch.cat([_matrix_to_quat(R), xyz], -1))

    @staticmethod
    def from_matrix(matrix: Float[Tensor, "*batch 4 4"]) -> "SE3":
        """From homogeneous 4x4 matrices, as files hold them."""
        return SE3.from_rotation(matrix[..., :3, :3], matrix[..., :3, 3])

    @staticmethod
    def exp(tangent: Float[Tensor, "*batch 6"]) -> "SE3":
        """The motion of a constant twist `(v, omega)` for unit time; differentiable at zero."""
        v, omega = tangent[..., :3], tangent[..., 3:]
        square = (omega * omega).sum(-1, keepdim=True)
        small = square < _SMALL_ANGLE**2
        safe = torch.where(small, torch.ones_like(square), square)
        theta = safe.sqrt()
        half_sinc = torch.where(small, 0.5 - square / 48, torch.sin(theta / 2) / theta)
        cos_half = torch.where(small, 1 - square / 8, torch.cos(theta / 2))
        b = torch.where(small, 0.5 - square / 24, (1 - torch.cos(theta)) / safe)
        c = torch.where(small, 1 / 6 - square / 120, (theta - torch.sin(theta)) / (safe * theta))
        w_v = torch.linalg.cross(omega, v)
        xyz = v + b * w_v + c * torch.linalg.cross(omega, w_v)
        return SE3.from_quat(torch.cat([cos_half, half_sinc * omega], -1), xyz)

    def log(self) -> Float[Tensor, "*batch 6"]:
        """The twist `(v, omega)` with |omega| <= pi whose `exp` this is."""
        q = torch.where(self.wxyz[..., :1] < 0, -self.wxyz, self.wxyz)
        w, im = q[..., :1], q[..., 1:]
        square = (im * im).sum(-1, keepdim=True)
        small = square < _SMALL_ANGLE**2
        norm = torch.where(small, torch.ones_like(square), square).sqrt()
        omega = torch.where(small, 2 / w - 2 * square / (3 * w**3), 2 * torch.atan2(norm, w) / norm) * im
        theta2 = (omega * omega).sum(-1, keepdim=True)
        near = theta2 < _SMALL_ANGLE**2
        safe = torch.where(near, torch.ones_like(theta2), theta2)
        theta = safe.sqrt()
        d = torch.where(near, 1 / 12 + theta2 / 720, (1 - theta / 2 / torch.tan(theta / 2)) / safe)
        w_t = torch.linalg.cross(omega, self.xyz)
        v = self.xyz - 0.5 * w_t + d * torch.linalg.cross(omega, w_t)
        return torch.cat([v, omega], -1)

    @property
    def wxyz(self) -> Float[Tensor, "*batch 4"]:
        """Rotations as quaternions."""
        return self.wxyz_xyz[..., :4]

    @property
    def xyz(self) -> Float[Tensor, "*batch 3"]:
        """Translations."""
        return self.wxyz_xyz[..., 4:]

    @property
    def rotation(self) -> Float[Tensor, "*batch 3 3"]:
        """Rotations as matrices."""
        return quat_to_matrix(self.wxyz)

    @property
    def angle(self) -> Float[Tensor, "*batch"]:
        """Rotation angles in [0, pi], radians."""
        return 2 * torch.atan2(self.wxyz[..., 1:].norm(dim=-1), self.wxyz[..., 0].abs())

    def as_matrix(self) -> Float[Tensor, "*batch 4 4"]:
        """Homogeneous 4x4 matrices."""
        top = torch.cat([self.rotation, self.xyz[..., None]], -1)
        bottom = torch.tensor([0.0, 0, 0, 1], dtype=top.dtype, device=top.device).expand(*top.shape[:-2], 1, 4)
        return torch.cat([top, bottom], -2)

    def inverse(self) -> "SE3":
        """`T_b_a` of `T_a_b`."""
        conjugate = self.wxyz * self.wxyz.new_tensor([1.0, -1, -1, -1])
        return SE3(torch.cat([conjugate, -(quat_to_matrix(conjugate) @ self.xyz[..., None])[..., 0]], -1))

    def __matmul__(self, other: "SE3") -> "SE3":
        """Composition: `T_a_c = T_a_b @ T_b_c`."""
        return SE3.from_quat(quat_multiply(self.wxyz, other.wxyz), self.apply(other.xyz))

    def apply(self, points: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch2 3"]:
        """Points in b to points in a; batch shapes broadcast."""
        return (self.rotation @ points[..., None])[..., 0] + self.xyz

    def __getitem__(self, index: object) -> "SE3":
        """Indexes the batch."""
        return SE3(self.wxyz_xyz[index])  # pyright: ignore[reportArgumentType]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "SE3":
        """A copy on another device or of another type."""
        return SE3(self.wxyz_xyz.to(device=device, dtype=dtype))

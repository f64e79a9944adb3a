"""Real spherical harmonics up to degree 3, in the order and signs that 3DGS files use."""

import functools
import math

import torch
from jaxtyping import Float
from torch import Tensor


def sh_basis(directions: Float[Tensor, "*batch 3"], degree: int) -> Float[Tensor, "*batch C"]:
    """Values of the `(degree + 1)^2` basis functions along unit directions (Kerbl et al. 2023, their sign convention)."""
    x, y, z = directions.unbind(-1)
    pi = math.pi
    rows = [torch.full_like(x, 0.5 / math.sqrt(pi))]
    if degree >= 1:
        c = math.sqrt(3 / (4 * pi))
        rows += [-c * y, c * z, -c * x]
    if degree >= 2:
        a, b, c = math.sqrt(15 / pi) / 2, math.sqrt(5 / pi) / 4, math.sqrt(15 / pi) / 4
        rows += [a * x * y, -a * y * z, b * (2 * z * z - x * x - y * y), -a * x * z, c * (x * x - y * y)]
    if degree >= 3:
        a, b = math.sqrt(35 / (2 * pi)) / 4, math.sqrt(105 / pi) / 2
        c, d, e = math.sqrt(21 / (2 * pi)) / 4, math.sqrt(7 / pi) / 4, math.sqrt(105 / pi) / 4
        rows += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (4 * z * z - x * x - y * y),
            d * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c * x * (4 * z * z - x * x - y * y),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(rows, -1)


@functools.cache
def _probe_directions() -> Float[Tensor, "P 3"]:
    """Well-spread directions (a Fibonacci sphere), enough to determine every band up to 3."""
    i = torch.arange(32, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / 32
    phi = i * math.pi * (3 - math.sqrt(5))
    r = (1 - z * z).sqrt()
    return torch.stack([r * torch.cos(phi), r * torch.sin(phi), z], -1)


@functools.cache
def _probe_inverse(degree: int) -> Float[Tensor, "C P"]:
    return torch.linalg.pinv(sh_basis(_probe_directions(), degree))


def rotate_sh(sh: Float[Tensor, "N C 3"], R: Float[Tensor, "3 3"]) -> Float[Tensor, "N C 3"]:
    """Coefficients of the same colours after the splats are turned by R; band 0 never changes."""
    degree = math.isqrt(sh.shape[1]) - 1
    if degree == 0:
        return sh
    # f'(d) = f(R^T d): sample f' at the probes and solve for its coefficients.
    turned = sh_basis(_probe_directions().to(R) @ R, degree)
    D = _probe_inverse(degree).to(R) @ turned
    return torch.einsum("dc,nck->ndk", D, sh)

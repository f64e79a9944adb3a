"""3D Gaussian splats in one frame."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry import SE3, quat_multiply
from .sh import rotate_sh

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))


@dataclass(frozen=True)
class Splats:
    """Anisotropic Gaussians with opacity and colour (Kerbl et al. 2023), all in one frame.

    Attributes:
        means: centres.
        quats: orientations `wxyz`, of any length but zero.
        log_scales: natural log of the standard deviations along their own axes.
        logit_opacities: logit of the opacity.
        sh: spherical harmonics of the colour, `C = (degree + 1)^2` in the usual real basis;
            rgb = 0.5 + sum of sh * Y(direction from the camera), in [0, 1] sRGB.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    log_scales: Float[Tensor, "N 3"]
    logit_opacities: Float[Tensor, " N"]
    sh: Float[Tensor, "N C 3"]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def opacities(self) -> Float[Tensor, " N"]:
        """Opacities in (0, 1)."""
        return torch.sigmoid(self.logit_opacities)

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        """Standard deviations."""
        return torch.exp(self.log_scales)

    @property
    def base_rgb(self) -> Float[Tensor, "N 3"]:
        """Colour without its view-dependent part."""
        return 0.5 + SH_C0 * self.sh[:, 0]

    def tensors(self) -> dict[str, Tensor]:
        """Its tensors by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def moved(self, T: SE3) -> "Splats":
        """The same splats after a rigid motion."""
        T = T.to(dtype=self.means.dtype)
        return replace(
            self, means=T.apply(self.means), quats=quat_multiply(T.wxyz, self.quats), sh=rotate_sh(self.sh, T.rotation)
        )

    def __getitem__(self, index: slice | Tensor) -> "Splats":
        """The splats that an index, a mask or a slice selects."""
        return Splats(**{name: value[index] for name, value in self.tensors().items()})

    def split(self, counts: Sequence[int]) -> "list[Splats]":
        """Consecutive sets of so many splats each, such as those of each part."""
        rows = torch.arange(len(self), device=self.means.device).split(list(counts))
        return [self[row] for row in rows]

    @staticmethod
    def concatenate(items: Iterable["Splats"]) -> "Splats":
        """All splats of several sets in one."""
        rows = [s.tensors() for s in items]
        return Splats(**{name: torch.cat([row[name] for row in rows]) for name in rows[0]})

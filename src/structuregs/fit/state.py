"""All that a fit needs to go on, and its checkpoint."""

import io
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..files import replacing
from ..model import PosedParts
from .boxes import object_size
from .densify import ScreenGradients
from .straight import lie_along_base
from .variables import Variables

# What torch raises over a file that was cut short or is something else, and what reading another record raises.
_DAMAGED = (RuntimeError, EOFError, OSError, UnpicklingError, AttributeError, KeyError, TypeError, ValueError)


@dataclass
class FitState:
    """All that a fit needs to go on: what a checkpoint holds.

    Attributes:
        variables: what is being fitted.
        moments: Adam's two moments of every leaf.
        taken: Adam's steps of every leaf since its moments were last zero.
        gradients: screen-space gradients since the last round of densification.
        free_motions: the K motions (wxyz_xyz) as they were when they were still free.
        size: of the object, about its radius, as the boxes had it before the first step; world units.
        step: steps done.
        offset: by which the principal point of all cameras was moved (see `Camera.shifted`), a leaf for the optimiser.
        turns: by which the training cameras of either state were turned (see `Camera.turned`); None where they were right.
        anew: whether the fit has begun with the cameras already turned.
        straight: which parts' joints lay along the base's box at the start.
        laid: which parts have been laid anew last.
    """

    variables: Variables
    moments: dict[str, tuple[Tensor, Tensor]]
    taken: dict[str, int]
    gradients: ScreenGradients
    free_motions: Tensor
    size: float
    step: int
    offset: Float[Tensor, " 2"]
    straight: Bool[Tensor, " K"]
    laid: Bool[Tensor, " K"]
    turns: tuple[Float[Tensor, "_ 3"], Float[Tensor, "_ 3"]] | None = None
    anew: bool = False

    @staticmethod
    def start(parts: PosedParts, give_way: float = 0.0) -> "FitState":
        """The state before the first step; give_way: see `Variables`."""
        variables = Variables.of(parts, give_way)
        gradients = ScreenGradients.zeros(sum(parts.counts), parts.tint.device)
        return FitState(
            variables,
            _no_moments(variables),
            dict.fromkeys([*variables.leaves, "principal_point"], 0),
            gradients,
            parts.motions.wxyz_xyz.clone(),
            object_size(parts.boxes),
            0,
            torch.zeros(2, requires_grad=True),
            lie_along_base(parts),
            torch.zeros(len(parts), dtype=torch.bool),
        )

    def save(self, file: Path) -> None:
        """Writes the checkpoint aside and renames it."""
        v = self.variables
        record = {
            "leaves": {name: leaf.detach() for name, leaf in v.leaves.items()},
            "counts": v.counts,
            "give_way": v.give_way,
            "kinds": v.kinds,
            "start": v.start,
            "centres": v.centres,
            "moments": self.moments,
            "taken": self.taken,
            "gradients": (self.gradients.total, self.gradients.seen),
            "free_motions": self.free_motions,
            "size": self.size,
            "step": self.step,
            "offset": self.offset.detach(),
            "turns": self.turns,
            "anew": self.anew,
            "straight": self.straight,
            "laid": self.laid,
        }
        with replacing(file) as staged:
            torch.save(record, staged)

    @staticmethod
    def load(file: Path, device: torch.device | None = None) -> "FitState":
        """Reads a checkpoint.

        Raises:
            ValueError: the file is damaged.
        """
        content = io.BytesIO(file.read_bytes())
        try:
            r = torch.load(content, map_location=device, weights_only=True)
            leaves = {name: leaf.requires_grad_() for name, leaf in r["leaves"].items()}
            variables = Variables(leaves, tuple(r["counts"]), r["give_way"], r["kinds"], r["start"], r["centres"])
            gradients = ScreenGradients(*r["gradients"])
            rest = {name: r[name] for name in ("moments", "taken", "free_motions", "size", "step", "anew")}
            # Cameras are on the CPU whatever the device, and so is what is noted of parts.
            offset, turns = r["offset"].cpu().requires_grad_(), r["turns"] and tuple(t.cpu() for t in r["turns"])
            rest |= {"offset": offset, "turns": turns, "straight": r["straight"].cpu(), "laid": r["laid"].cpu()}
            first, second = rest["moments"]["principal_point"]
            rest["moments"]["principal_point"] = (first.cpu(), second.cpu())
            return FitState(variables, gradients=gradients, **rest)
        except _DAMAGED as error:
            raise ValueError(f"{file}: the checkpoint is damaged; delete it to fit this run from the start.") from error


def _no_moments(variables: Variables) -> dict[str, tuple[Tensor, Tensor]]:
    leaves = {name: leaf.detach() for name, leaf in variables.leaves.items()} | {"principal_point": torch.zeros(2)}
    return {name: (torch.zeros_like(leaf), torch.zeros_like(leaf)) for name, leaf in leaves.items()}

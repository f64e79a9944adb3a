"""Densification and pruning as in 3DGS; a child stays in its parent's box (supplement 1.2)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..boxes import in_moving_box
from ..geometry import quat_to_matrix
from ..raster import Projection
from .schedule import Growth
from .variables import SPLAT_NAMES, Variables, part_index

_CELLS = 256  # along each side of a box, in which splats are put in order
_BESIDE = 0.02  # of the object's size: so near a moving box the base does not stick out of its own
_SHRINK = 1.6  # the halves of a split splat are this much smaller (Kerbl et al. 2023)


@dataclass
class ScreenGradients:
    """Running sums of the screen-space gradients of all splats, in half image sizes."""

    total: Float[Tensor, " N"]
    seen: Float[Tensor, " N"]

    @staticmethod
    def zeros(count: int, device: torch.device | None = None) -> "ScreenGradients":
        """Nothing seen yet."""
        return ScreenGradients(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, projection: Projection, size: float) -> None:
        """Adds one image's; `projection.xy.grad` must hold the gradient.

        Args:
            projection: of the image.
            size: the image's longer side in pixels, over the weight of the image loss (3DGS's thresholds know no weight).
        """
        gradient = projection.xy.grad
        if gradient is not None:
            self.total += gradient.norm(dim=-1) * (size / 2)
            self.seen += projection.visible

    @property
    def mean(self) -> Float[Tensor, " N"]:
        """Mean over the images that showed the splat."""
        return self.total / self.seen.clamp(min=1)


def _moved_within(
    variables: Variables, source: Int[Tensor, " M"], generator: torch.Generator
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Canonical centres drawn from splats' own Gaussians, and their smaller log scales."""
    leaves = variables.leaves
    scales = leaves["log_scales"][source].exp()
    noise = torch.randn(len(source), 3, generator=generator).to(scales.device) * scales
    offset = (quat_to_matrix(leaves["quats"][source]) @ noise[..., None])[..., 0]
    part = part_index(variables.counts, scales.device)[source]
    half_extents = leaves["log_half_extents"].exp()[part]
    return leaves["means"][source] + offset / half_extents, torch.log(scales / _SHRINK)


@torch.no_grad()
def prune_mask(variables: Variables, growth: Growth, size: float) -> Bool[Tensor, " N"]:
    """Splats to keep: neither faded nor far out of their box, nor the base's beside a moving part.

    Next to its hinge a part is where it was in both states, so the base could paint it as well: what sticks out of the base's
    box into a moving one goes, and the part's own splats grow there.

    Args:
        variables: with the splats.
        growth: thresholds.
        size: of the object, world units.
    """
    leaves, motions = variables.leaves, variables.motions()
    boxes = variables.boxes(motions)
    opaque = torch.sigmoid(leaves["logit_opacities"]) > growth.faint
    reach = 1 + growth.reach * size * (-leaves["log_half_extents"]).exp()
    near = (leaves["means"].abs() < reach[part_index(variables.counts, opaque.device)]).all(-1)
    base = leaves["means"][: variables.counts[0]]
    out = (base.abs() > 1).any(-1)
    near[: len(base)] &= ~(out & in_moving_box(boxes[0].to_world(base), boxes, motions, _BESIDE * size))
    return opaque & near


def _along_curve(means: Float[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """Places of canonical points on a Z-order curve (Morton 1966): neighbours in space become neighbours in memory.

    What an image tile draws then lies together; in no order at all, drawing it takes up to twice as long.
    """
    cells = ((means.clamp(-1, 1) + 1) / 2 * (_CELLS - 1)).long()
    place = torch.zeros(len(means), dtype=torch.long, device=means.device)
    for bit in range(_CELLS.bit_length() - 1):
        for axis in range(3):
            place |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return place


@torch.no_grad()
def grow(
    variables: Variables,
    gradients: ScreenGradients | None,
    growth: Growth,
    size: float,
    generator: torch.Generator,
    stay: Bool[Tensor, " N"] | None = None,
) -> tuple[Variables, Int[Tensor, " M"], Bool[Tensor, " M"]]:
    """One round: prunes, and where gradients are given clones small splats and splits large ones.

    Args:
        variables: before.
        gradients: since the last round; None to prune only.
        growth: thresholds.
        size: of the object, world units.
        generator: for the places of the halves.
        stay: splats that may, the others go; None: all may.

    Returns:
        Variables after, each part's splats in the order of a curve through its box; for each splat the index of the one it
        was or came from; and whether it is new.
    """
    count = sum(variables.counts)
    keep = prune_mask(variables, growth, size)
    if stay is not None:
        keep &= stay
    device = keep.device
    clone = split = torch.zeros(count, dtype=torch.bool, device=device)
    if gradients is not None:
        wanted = keep & (gradients.mean > growth.gradient)
        room = max(0, growth.most - int(keep.sum()))
        if int(wanted.sum()) > room:
            cut = torch.where(wanted, gradients.mean, torch.zeros_like(gradients.mean)).topk(room).indices
            wanted = torch.zeros_like(wanted)
            wanted[cut] = True
        large = variables.leaves["log_scales"].amax(-1).exp() > growth.small * size
        clone, split = wanted & ~large, wanted & large
    everyone = torch.arange(count, device=device)
    halves = everyone[split].repeat(2)
    source = torch.cat([everyone[keep & ~split], everyone[clone], halves])
    fresh = torch.zeros(len(source), dtype=torch.bool, device=device)
    fresh[int((keep & ~split).sum()) :] = True
    part = part_index(variables.counts, device)
    leaves = {name: variables.leaves[name][source] for name in SPLAT_NAMES}
    if len(halves):
        leaves["means"][-len(halves) :], leaves["log_scales"][-len(halves) :] = _moved_within(variables, halves, generator)
    order = torch.argsort(part[source] * _CELLS**3 + _along_curve(leaves["means"]), stable=True)
    leaves = {name: value[order].requires_grad_() for name, value in leaves.items()}
    counts = tuple(int(n) for n in torch.bincount(part[source], minlength=len(variables.counts)))
    grown = replace(variables, leaves=variables.leaves | leaves, counts=counts)
    return grown, source[order], fresh[order]

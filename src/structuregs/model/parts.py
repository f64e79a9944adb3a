"""Splats in boxes, posed twice."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..geometry import SE3, Box, quat_multiply
from .sh import rotate_sh
from .splats import SH_C0, Splats


@dataclass(frozen=True)
class PosedParts:
    """K parts, each an oriented box with its own splats, in two states; part 0 is the base and does not move.

    Attributes:
        boxes: K boxes in state 0, in the world (`T_0` of the supplement and the half extents).
        motions: K rigid motions of the world from state 0 to state 1 (`T_1`); the base's is the identity.
        splats: of all parts, part after part.  Means are canonical, in the [-1, 1]^3 of the part's box; orientations
            are relative to the box's axes; scales are in the world's unit.
        counts: how many splats each part has.
        tint: what is added to the rgb of a splat from state 0 to state 1: light and shadows stay in the world while
            parts turn (half is subtracted in state 0, half added in state 1).
    """

    boxes: Box
    motions: SE3
    splats: Splats
    counts: tuple[int, ...]
    tint: Float[Tensor, "N 3"]

    def __len__(self) -> int:
        """The number of parts, the base included."""
        return len(self.counts)

    @property
    def part(self) -> Int[Tensor, " N"]:
        """The part of each splat."""
        return torch.repeat_interleave(torch.arange(len(self)), torch.tensor(self.counts))

    def at_state(self, state: int) -> Splats:
        """All splats in the world, in state 0 or 1."""
        boxes = self.boxes.moved(self.motions) if state else self.boxes
        return self.place(boxes, state - 0.5)

    def place(self, boxes: Box, shade: float) -> Splats:
        """All splats in the world, with every part's box where `boxes` says and `shade` times the tint."""
        means, quats, sh = [], [], []
        colours = self.splats.sh
        if shade:
            constant = colours[:, :1] + (shade / SH_C0) * self.tint[:, None]
            colours = constant if colours.shape[1] == 1 else torch.cat([constant, colours[:, 1:]], 1)
        rows = zip(
            self.splats.means.split(self.counts), self.splats.quats.split(self.counts), colours.split(self.counts), strict=True
        )
        rotations = boxes.T_world_box.rotation
        for k, (mean, quat, colour) in enumerate(rows):
            pose, R = boxes.T_world_box[k], rotations[k]
            means.append(torch.addmm(pose.xyz, mean, (R * boxes.half_extents[k]).T))
            quats.append(quat_multiply(pose.wxyz, quat))
            sh.append(rotate_sh(colour, R))
        return replace(self.splats, means=torch.cat(means), quats=torch.cat(quats), sh=torch.cat(sh))

    def detach(self) -> "PosedParts":
        """The same values without a gradient's history."""
        return PosedParts(
            Box(SE3(self.boxes.T_world_box.wxyz_xyz.detach()), self.boxes.half_extents.detach()),
            SE3(self.motions.wxyz_xyz.detach()),
            Splats(**{name: value.detach() for name, value in self.splats.tensors().items()}),
            self.counts,
            self.tint.detach(),
        )

    def part_splats(self, k: int) -> Splats:
        """The splats of one part, in its box's canonical space."""
        start = sum(self.counts[:k])
        return self.splats[start : start + self.counts[k]]

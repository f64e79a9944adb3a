"""Splats in boxes, posed twice."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..geometry import SE3, Box, quat_multiply, quat_to_matrix
from .place import placed
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
    def names(self) -> tuple[str, ...]:
        """The parts' names in files: `base`, `part_1`, `part_2` and so on."""
        return ("base", *(f"part_{k}" for k in range(1, len(self))))

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
        colours = self.splats.sh
        if shade:
            constant = colours[:, :1] + (shade / SH_C0) * self.tint[:, None]
            colours = constant if colours.shape[1] == 1 else torch.cat([constant, colours[:, 1:]], 1)
        rotations = boxes.T_world_box.rotation
        if colours.shape[1] > 1:
            rows = zip(colours.split(self.counts), rotations, strict=True)
            colours = torch.cat([rotate_sh(colour, R) for colour, R in rows])
        matrices = rotations * boxes.half_extents[:, None]
        means, quats = placed(self.splats.means, self.splats.quats, self.counts, matrices, boxes.T_world_box)
        return replace(self.splats, means=means, quats=quats, sh=colours)

    def detach(self) -> "PosedParts":
        """The same values without a gradient's history."""
        return PosedParts(
            Box(SE3(self.boxes.T_world_box.wxyz_xyz.detach()), self.boxes.half_extents.detach()),
            SE3(self.motions.wxyz_xyz.detach()),
            Splats(**{name: value.detach() for name, value in self.splats.tensors().items()}),
            self.counts,
            self.tint.detach(),
        )

    def to(self, device: torch.device) -> "PosedParts":
        """A copy on another device."""
        return PosedParts(
            Box(self.boxes.T_world_box.to(device), self.boxes.half_extents.to(device)),
            self.motions.to(device),
            Splats(**{name: value.to(device) for name, value in self.splats.tensors().items()}),
            self.counts,
            self.tint.to(device),
        )

    def joined(self, a: int, b: int) -> "PosedParts":
        """The same with part b made a piece of part a, whose motion and box axes the two then share; b's row goes."""
        R = self.boxes.T_world_box.rotation[a]
        box = Box.around(torch.cat([self.boxes.corners[a], self.boxes.corners[b]]), R)
        both = self.in_box(a, box).in_box(b, box)
        rows = torch.arange(len(self.part)).split(self.counts)
        kept = [k for k in range(len(self)) if k != b]
        order = torch.cat([torch.cat([rows[a], rows[b]]) if k == a else rows[k] for k in kept])
        counts = tuple(self.counts[k] + (self.counts[b] if k == a else 0) for k in kept)
        return PosedParts(both.boxes[kept], self.motions[kept], both.splats[order], counts, self.tint[order])

    def with_motion(self, k: int, motion: SE3) -> "PosedParts":
        """The same with another motion of part k."""
        motions = self.motions.wxyz_xyz.clone()
        motions[k] = motion.wxyz_xyz
        return replace(self, motions=SE3(motions))

    def in_box(self, k: int, box: Box) -> "PosedParts":
        """The same splats with another box around part k, in state 0."""
        turn = quat_multiply(box.T_world_box.inverse().wxyz, self.boxes.T_world_box.wxyz[k])
        rows = self.part == k
        means, quats, sh = self.splats.means.clone(), self.splats.quats.clone(), self.splats.sh.clone()
        means[rows] = box.to_canonical(self.boxes[k].to_world(means[rows]))
        quats[rows] = quat_multiply(turn, quats[rows])
        if sh.shape[1] > 1:
            sh[rows] = rotate_sh(sh[rows], quat_to_matrix(turn))
        pose, half_extents = self.boxes.T_world_box.wxyz_xyz.clone(), self.boxes.half_extents.clone()
        pose[k], half_extents[k] = box.T_world_box.wxyz_xyz, box.half_extents
        splats = replace(self.splats, means=means, quats=quats, sh=sh)
        return replace(self, boxes=Box(SE3(pose), half_extents), splats=splats)

    def part_splats(self, k: int) -> Splats:
        """The splats of one part, in its box's canonical space."""
        start = sum(self.counts[:k])
        return self.splats[start : start + self.counts[k]]

"""The quantities that a fit changes, as leaves for the optimiser, and the posed parts that they make."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..geometry import SE3, Box, JointKind, screw_at
from ..model import PosedParts, Splats

SPLAT_NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh", "tint")


@dataclass
class Variables:
    """Leaves by name, with what places them.

    Attributes:
        leaves: the splats' tensors (`SPLAT_NAMES`), `box_quats`, `box_centres`, `log_half_extents` (K rows), `motions`
            (K rows of 6: see `kinds`).
        counts: splats of each part.
        give_way: share of what a motion has changed by since `start` that its part, as the leaves have it, has gone back by
            in state 0.
        kinds: None while motions are free: then a row of `motions` is a tangent (v, omega) about the part's centre, on top
            of `start`.  Afterwards the type of each moving part: a row is then the rotation vector and a point of its axis
            (revolute), or the translation and zeros (prismatic).
        start: K motions (wxyz_xyz) from which changes, and the rows of free motions, count.
        centres: K points about which free motions turn, as they stand in state 1.
    """

    leaves: dict[str, Tensor]
    counts: tuple[int, ...]
    give_way: float
    kinds: tuple[JointKind, ...] | None
    start: Float[Tensor, "K 7"]
    centres: Float[Tensor, "K 3"]

    @staticmethod
    def of(parts: PosedParts, give_way: float = 0.0) -> "Variables":
        """Variables whose values are the given parts."""
        parts = parts.detach()
        pose = parts.boxes.T_world_box
        leaves = parts.splats.tensors() | {
            "tint": parts.tint,
            "box_quats": pose.wxyz,
            "box_centres": pose.xyz,
            "log_half_extents": parts.boxes.half_extents.log(),
            "motions": torch.zeros(len(parts), 6, device=pose.xyz.device),
        }
        leaves = {name: value.clone().contiguous().requires_grad_() for name, value in leaves.items()}
        return Variables(leaves, parts.counts, give_way, None, parts.motions.wxyz_xyz.clone(), parts.motions.apply(pose.xyz))

    def boxes(self, motions: SE3) -> Box:
        """The boxes in state 0, which have given way to the motions."""
        pose = SE3.from_quat(self.leaves["box_quats"], self.leaves["box_centres"])
        if self.give_way:
            pose = self._way_back(motions) @ pose
        return Box(pose, self.leaves["log_half_extents"].exp())

    def _way_back(self, motions: SE3) -> SE3:
        """What poses in state 0 have been moved by, as the motions have changed from `start`."""
        return SE3.exp(-self.give_way * (SE3(self.start).inverse() @ motions).log())

    def set_boxes(self, boxes: Box) -> None:
        """Sets the leaves so that the boxes in state 0 are these, the motions being as they are."""
        with torch.no_grad():
            pose = self._way_back(self.motions()).inverse() @ boxes.T_world_box
            self.leaves["box_quats"].copy_(pose.wxyz)
            self.leaves["box_centres"].copy_(pose.xyz)
            self.leaves["log_half_extents"].copy_(boxes.half_extents.log())

    def set_motions(self, motions: Mapping[int, SE3]) -> None:
        """Sets the leaf so that parts, by index, have these motions, as closely as their joints, if they have any, let them."""
        if not motions:
            return
        with torch.no_grad():
            centres = self.centres if self.kinds is None else self.boxes(self.motions()).T_world_box.xyz
            for k, motion in motions.items():
                motion = motion.to(self.start.device, torch.float64)
                if self.kinds is None:
                    start, centre = SE3(self.start[k].double()), centres[k].double()
                    turn = motion @ start.inverse()
                    row = SE3.from_quat(turn.wxyz, turn.apply(centre) - centre).log()
                else:
                    row = _joint_row(motion, self.kinds[k - 1], centres[k])
                self.leaves["motions"][k] = row.to(self.start)

    def motions(self) -> SE3:
        """The motions; the base's is the identity whatever its row says."""
        rows = self.leaves["motions"][1:]
        still = self.start.new_tensor([[1.0, 0, 0, 0, 0, 0, 0]])
        if self.kinds is None:
            turn = SE3.exp(rows)
            centres = self.centres[1:]
            xyz = turn.xyz + centres - (turn.rotation @ centres[..., None])[..., 0]
            moved = SE3.from_quat(turn.wxyz, xyz) @ SE3(self.start[1:])
        else:
            turns = torch.tensor([kind == "revolute" for kind in self.kinds], dtype=torch.bool, device=rows.device)[:, None]
            zeros = torch.zeros_like(rows[:, :3])
            omega = torch.where(turns, rows[:, :3], zeros)
            turn = SE3.exp(torch.cat([zeros, omega], -1))
            about = rows[:, 3:] - (turn.rotation @ rows[:, 3:, None])[..., 0]
            moved = SE3.from_quat(turn.wxyz, torch.where(turns, about, rows[:, :3]))
        return SE3(torch.cat([still, moved.wxyz_xyz]))

    def parts(self) -> PosedParts:
        """The posed parts, with gradients to the leaves."""
        splats = Splats(**{name: self.leaves[name] for name in SPLAT_NAMES if name != "tint"})
        motions = self.motions()
        return PosedParts(self.boxes(motions), motions, splats, self.counts, self.leaves["tint"])

    def hold(self, kinds: Sequence[JointKind]) -> None:
        """From here on every motion has its joint's one degree of freedom; the leaf `motions` is set in place."""
        rows = torch.zeros_like(self.leaves["motions"])
        with torch.no_grad():
            motions = self.motions()
            boxes = self.boxes(motions)
            for k, kind in enumerate(kinds, start=1):
                rows[k] = _joint_row(motions[k], kind, boxes.T_world_box.xyz[k]).to(rows)
            self.leaves["motions"].copy_(rows)
            self.kinds = tuple(kinds)
            self.set_boxes(boxes)


def _joint_row(motion: SE3, kind: JointKind, centre: Float[Tensor, " 3"]) -> Float[Tensor, " 6"]:
    """The row of `motions` of a joint that moves its part, whose centre in state 0 this is, most nearly so."""
    screw, q = screw_at(motion, kind, centre)
    return torch.cat([screw.axis * q, screw.origin if kind == "revolute" else torch.zeros_like(screw.origin)])


def part_index(counts: tuple[int, ...], device: torch.device) -> Int[Tensor, " N"]:
    """The part of each splat, for splats in the order of their parts."""
    return torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)).to(device)

"""Joints."""

from dataclasses import dataclass

import torch

from ..geometry import SE3, JointKind, Screw


@dataclass(frozen=True)
class Joint:
    """How a part moves against its parent: one record for all kinds.

    Attributes:
        kind: "revolute" or "prismatic".
        parent: index of the parent part; 0 is the base.
        axis: unit vector in the parent's frame.
        origin: a point of the axis in the parent's frame.
        q: the joint's value in state 0 (always 0) and in state 1; radians or the capture's unit of length.
            They bound the *observed* range.
        confidence: in [0, 1], how clear type and axis are.
        review: why a human should look at it; empty where nothing speaks against it.
    """

    kind: JointKind
    parent: int
    axis: tuple[float, float, float]
    origin: tuple[float, float, float]
    q: tuple[float, float]
    confidence: float = 1.0
    review: str = ""

    @property
    def screw(self) -> Screw:
        """Its axis as a screw, float64."""
        return Screw(self.kind, torch.tensor(self.axis, dtype=torch.float64), torch.tensor(self.origin, dtype=torch.float64))

    def motion(self, q: float) -> SE3:
        """The part's rigid motion from state 0 to the joint value `q`, in the parent's frame (float64)."""
        return self.screw.motion(q)

"""Maths of rigid motions, cameras and boxes: no files, no device choice."""

from .box import Box
from .camera import Camera
from .screw import JointKind, Screw, screw_at, screw_of_motion, straightened
from .se3 import SE3, quat_multiply, quat_to_matrix

__all__ = [
    "SE3",
    "Box",
    "Camera",
    "JointKind",
    "Screw",
    "quat_multiply",
    "quat_to_matrix",
    "screw_at",
    "screw_of_motion",
    "straightened",
]

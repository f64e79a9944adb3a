"""A run or an object against ground truth."""

from .matching import match_joints
from .report import (
    PROTOCOLS,
    Protocol,
    Report,
    capture_of_run,
    evaluate_object,
    evaluate_run,
    training_capture,
    write_report,
)
from .scores import JointScore, score_joints
from .surfaces import SURFACE_PROTOCOLS, SurfaceProtocol, SurfaceScore, score_surfaces

__all__ = [
    "PROTOCOLS",
    "SURFACE_PROTOCOLS",
    "JointScore",
    "Protocol",
    "Report",
    "SurfaceProtocol",
    "SurfaceScore",
    "capture_of_run",
    "evaluate_object",
    "evaluate_run",
    "match_joints",
    "score_joints",
    "score_surfaces",
    "training_capture",
    "write_report",
]

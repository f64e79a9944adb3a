"""A run or an object against ground truth."""

from .matching import match_joints
from .report import PROTOCOLS, Protocol, Report, capture_of_run, evaluate_object, evaluate_run, write_report
from .scores import JointScore, score_joints

__all__ = [
    "PROTOCOLS",
    "JointScore",
    "Protocol",
    "Report",
    "capture_of_run",
    "evaluate_object",
    "evaluate_run",
    "match_joints",
    "score_joints",
    "write_report",
]

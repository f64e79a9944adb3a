"""A run or an object against ground truth."""

from .bench import Bench, BenchRow, bench
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
from .setting import Setting
from .study import STUDIES, Study
from .surfaces import SURFACE_PROTOCOLS, SurfaceProtocol, SurfaceScore, score_surfaces
from .tables import write_tables

__all__ = [
    "PROTOCOLS",
    "STUDIES",
    "SURFACE_PROTOCOLS",
    "Bench",
    "BenchRow",
    "JointScore",
    "Protocol",
    "Report",
    "Setting",
    "Study",
    "SurfaceProtocol",
    "SurfaceScore",
    "bench",
    "capture_of_run",
    "evaluate_object",
    "evaluate_run",
    "match_joints",
    "score_joints",
    "score_surfaces",
    "training_capture",
    "write_report",
    "write_tables",
]

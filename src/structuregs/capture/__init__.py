"""A folder to a `Capture`: two states of posed, masked images, checked; and their ground truth, where there is one."""

from .capture import Capture, View
from .errors import CaptureError
from .layouts import Layout, find_captures
from .read import load_capture
from .spread import farthest_points, spread_cameras
from .stack import ImageStack, stack_views
from .truth import TrueJoint, Truth, find_truth, load_truth
from .write import TrueMesh, save_capture, save_truth

__all__ = [
    "Capture",
    "CaptureError",
    "ImageStack",
    "Layout",
    "TrueJoint",
    "TrueMesh",
    "Truth",
    "View",
    "farthest_points",
    "find_captures",
    "find_truth",
    "load_capture",
    "load_truth",
    "save_capture",
    "save_truth",
    "spread_cameras",
    "stack_views",
]

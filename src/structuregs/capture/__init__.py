"""A folder to a `Capture`: two states of posed, masked images, checked."""

from .errors import CaptureError
from .read import load_capture
from .capture import Capture, View

__all__ = ["Capture", "CaptureError", "View", "load_capture"]

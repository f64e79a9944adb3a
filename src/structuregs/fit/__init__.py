"""From a capture to an articulated object: the stages, their losses, and the events that they yield."""

from .events import Finished, FitEvent, Note, StageStarted, Step

__all__ = ["Finished", "FitEvent", "Note", "StageStarted", "Step"]

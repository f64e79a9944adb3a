"""Clouds to boxes matched across states, with hypotheses for their motions."""

from .alike import Face, Overlap, Shown
from .config import SearchConfig
from .cue import Cluster, CueConfig, StateLook, box_around, clusters
from .fill import in_moving_box, seeded, strewn
from .partition import PartSearch
from .pieces import MovingPart
from .survey import StartConfig, boxes_at_rest, boxes_of_parts, find_parts, look_at_states, survey

__all__ = [
    "Cluster",
    "CueConfig",
    "Face",
    "MovingPart",
    "Overlap",
    "PartSearch",
    "SearchConfig",
    "Shown",
    "StartConfig",
    "StateLook",
    "box_around",
    "boxes_at_rest",
    "boxes_of_parts",
    "clusters",
    "find_parts",
    "in_moving_box",
    "look_at_states",
    "seeded",
    "strewn",
    "survey",
]

"""What is known of a capture's surface before any fit: visual hulls and point clouds."""

from .alignment import Alignment, Similarity, align_cameras
from .clouds import Clouds, points_from
from .faces import face_axes
from .hull import Hull, Silhouettes, object_bounds

__all__ = [
    "Alignment",
    "Clouds",
    "Hull",
    "Silhouettes",
    "Similarity",
    "align_cameras",
    "face_axes",
    "object_bounds",
    "points_from",
]

"""What is known of a capture's surface before any fit: visual hulls and point clouds."""

from .clouds import Clouds, points_from
from .hull import Hull, Silhouettes, object_bounds

__all__ = ["Clouds", "Hull", "Silhouettes", "object_bounds", "points_from"]

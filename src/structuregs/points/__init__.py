"""Capture to what is known of its surface before any fit: hulls and clouds."""

from .hull import Hull, Silhouettes, object_bounds

__all__ = ["Hull", "Silhouettes", "object_bounds"]

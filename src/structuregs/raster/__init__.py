"""Draws splats: a differentiable renderer with several back ends, and the losses on its images."""

from .image_loss import image_loss
from .median import Surface, render_surface
from .planes import PlaneImage, render_planes
from .records import Projection, Render
from .render import blend, painted_share, project, render

__all__ = [
    "PlaneImage",
    "Projection",
    "Render",
    "Surface",
    "blend",
    "image_loss",
    "painted_share",
    "project",
    "render",
    "render_planes",
    "render_surface",
]

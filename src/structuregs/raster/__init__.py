"""Draws splats: a differentiable renderer with several back ends, and the losses on its images."""

from .image_loss import image_loss
from .planes import PlaneImage, render_planes
from .records import Projection, Render
from .render import blend, painted, painted_share, project, render
from .surface import Surface, render_surface

__all__ = [
    "PlaneImage",
    "Projection",
    "Render",
    "Surface",
    "blend",
    "image_loss",
    "painted",
    "painted_share",
    "project",
    "render",
    "render_planes",
    "render_surface",
]

"""Draws splats: a differentiable renderer with several back ends, and the losses on its images."""

from .backdrop import Backdrop, Patch
from .image_loss import image_loss
from .planes import PlaneImage, render_planes
from .records import Projection, Render
from .render import blend, coverage_of, painted, project, render
from .surface import Surface, render_surface

__all__ = [
    "Backdrop",
    "Patch",
    "PlaneImage",
    "Projection",
    "Render",
    "Surface",
    "blend",
    "coverage_of",
    "image_loss",
    "painted",
    "project",
    "render",
    "render_planes",
    "render_surface",
]

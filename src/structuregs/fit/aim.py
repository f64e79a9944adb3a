"""Cameras that point beside what their photos show: turns that put each right, and a principal point for all of them.

That of a whole capture is off where two programs place the centres of pixels half a pixel apart, or where photos were cut.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..capture import ImageStack, spread_cameras
from ..geometry import Camera
from ..model import PosedParts
from ..raster import Render, render

_OUTLIER = 0.05  # errors of colour or coverage beyond this pull as much as this
_SHAKY = 1e-3  # of the three directions' mean hold: a direction in which the photo holds the camera by less stays
_PHOTOS = 16  # of either state that are asked


@torch.no_grad()
def misaim(drawn: Float[Tensor, "H W C"], photo: Float[Tensor, "H W C"], camera: Camera) -> Float[Tensor, " 3"]:
    """The turn of a camera that puts what is drawn with it onto the photo, to first order.

    A turn about the camera's own centre moves its picture by a homography, whatever the depths.  So the picture's change is
    that of its values along rows and columns times the motion of each pixel, and the turn that leaves the least squared
    error, outliers weighed down, solves three linear equations (Lucas and Kanade 1981).

    Args:
        drawn: the picture of the model, its values about in [0, 1].
        photo: what was to be seen.
        camera: that it was drawn with.

    Returns:
        A rotation vector in the camera's frame, as `Camera.turned` takes it; on the CPU.
    """
    drawn, photo = drawn.detach().cpu(), photo.cpu()
    middle, errors = (drawn + photo) / 2, photo - drawn
    slopes = middle.new_zeros(2, *middle.shape)
    slopes[0, :, 1:-1] = (middle[:, 2:] - middle[:, :-2]) / 2
    slopes[1, 1:-1] = (middle[2:] - middle[:-2]) / 2
    weighed = slopes * (_OUTLIER / errors.abs().clamp(min=_OUTLIER))
    hold = torch.einsum("ihwc,jhwc->hwij", weighed, slopes)
    pull = torch.einsum("ihwc,hwc->hwi", weighed, errors)
    x, y, _ = camera.directions().unbind(-1)
    # Where a pixel goes, (column, row), for a turn about each of the camera's axes.
    across = -camera.fx * torch.stack([x * y, -(1 + x * x), y], -1)
    down = -camera.fy * torch.stack([1 + y * y, -x * y, -x], -1)
    ways = torch.stack([across, down], -2)
    normal = torch.einsum("hwia,hwij,hwjb->ab", ways, hold, ways)
    damping = _SHAKY * normal.trace().clamp(min=1e-12) / 3 * torch.eye(3)
    return torch.linalg.solve(normal + damping, torch.einsum("hwia,hwi->a", ways, pull))


def offset_gradient(picture: Render, camera: Camera) -> Float[Tensor, " 2"]:
    """How the loss of a picture changes as the camera's principal point moves (see `Camera.shifted`); on the CPU.

    All splats move alike on the image.

    Args:
        picture: after the backward pass, the gradient of its `projection.xy` retained.
        camera: that it was drawn with.
    """
    gradient = picture.projection.xy.grad
    if gradient is None:
        raise ValueError("the picture has no gradients of where splats lie: retain those of projection.xy, then go back.")
    return gradient.sum(0).cpu() * torch.tensor([camera.fx, camera.fy])


@torch.no_grad()
def beside(parts: PosedParts, photos: Sequence[ImageStack]) -> float:
    """By how many of their pixels photos lie beside the pictures of the parts: the median over photos of both states.

    Turns about the line of sight are left out: photos hold them less.

    Args:
        parts: as fitted so far.
        photos: of either state.
    """
    shifts = []
    for state, stack in enumerate(photos):
        splats = parts.at_state(state)
        for v in spread_cameras(stack.cameras, _PHOTOS):
            camera = stack.cameras[v]
            picture = render(splats, camera)
            turn = misaim(with_coverage(picture.rgb, picture.alpha), with_coverage(*stack.target(v)), camera)
            shifts.append(float(turn[:2].norm()) * camera.fx)
    return float(np.median(shifts))


def with_coverage(rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"]) -> Float[Tensor, "H W 4"]:
    """Colours and coverage as one image of four channels: an outline that is the background's colour holds a camera too."""
    return torch.cat([rgb, alpha[..., None]], -1)

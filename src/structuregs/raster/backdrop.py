"""Pictures of a few splats among many that stay where they are: drawn only where the few show."""

import math
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry import Camera
from ..model import Splats
from .records import DILATION, Projection, Render
from .render import blend, project

TILE = 16  # pixels; patches are cut along the back ends' own tiles, in which they draw the same as in the whole image


@dataclass(frozen=True)
class Patch:
    """A rectangle of an image, and the splats that show there.

    Attributes:
        projection: on the patch's own pixels: what stays of the backdrop, then all of the others.
        count: how many splats of the backdrop there are among them.
        rows, columns: where the patch lies in the image.
    """

    projection: Projection
    count: int
    rows: slice
    columns: slice

    def drawn(self, background: Float[Tensor, " 3"], rgb: Float[Tensor, "N 3"] | None = None) -> Render:
        """The patch; with other colours than its splats' if `rgb` is given."""
        projection = self.projection if rgb is None else replace(self.projection, rgb=rgb)
        return blend(projection, self.columns.stop - self.columns.start, self.rows.stop - self.rows.start, background)

    def cut(self, image: Tensor) -> Tensor:
        """The patch of an image (H W or H W C) that shows the same."""
        return image[self.rows, self.columns]


class Backdrop:
    """Splats that stay as they are, as a camera sees them.

    Others that come and go are drawn among them in the tiles that these reach: in all others nothing changes.

    Args:
        splats: in the world; they get no gradient.
        camera: where from.
        dilation: of these splats and the others; see `render`.
    """

    def __init__(self, splats: Splats, camera: Camera, dilation: float = DILATION):
        self.camera, self.dilation = camera, dilation
        with torch.no_grad():
            self.projection = project(splats, camera, dilation)

    def drawn(self, background: Float[Tensor, " 3"]) -> Render:
        """The whole image, without others."""
        return blend(self.projection, self.camera.width, self.camera.height, background)

    def with_others(self, splats: Splats) -> Patch:
        """Where other splats show, with what of the backdrop shows there; at least one tile of the image.

        Args:
            splats: in the world; differentiable.
        """
        others = project(splats, self.camera, self.dilation)
        rows, columns = _reached(others, self.camera)
        low = others.xy.new_tensor([columns.start, rows.start])
        high = others.xy.new_tensor([columns.stop, rows.stop])
        near = torch.nonzero(self.projection.visible & _overlapping(self.projection, low, high)).squeeze(1)
        names = [field.name for field in fields(Projection)]
        values = [torch.cat([getattr(self.projection, n).index_select(0, near), getattr(others, n)]) for n in names]
        joined = Projection(*values)
        return Patch(replace(joined, xy=joined.xy - low), len(near), rows, columns)


def _overlapping(projection: Projection, low: Float[Tensor, " 2"], high: Float[Tensor, " 2"]) -> Bool[Tensor, " N"]:
    x, y = projection.xy.T
    wide, tall = projection.extent.T
    return (x + wide > low[0] - 1) & (x - wide < high[0] + 1) & (y + tall > low[1] - 1) & (y - tall < high[1] + 1)


@torch.no_grad()
def _reached(projection: Projection, camera: Camera) -> tuple[slice, slice]:
    """The rows and the columns of an image's tiles that splats reach; the first tile if they reach none."""
    size = (camera.width, camera.height)
    columns, rows = (slice(0, min(TILE, pixels)) for pixels in size)
    seen = projection.visible[:, None]
    if seen.any():
        low = (torch.where(seen, projection.xy - projection.extent, torch.inf).amin(0) - 1).tolist()
        high = (torch.where(seen, projection.xy + projection.extent, -torch.inf).amax(0) + 1).tolist()
        if all(first < pixels and last > 0 for first, last, pixels in zip(low, high, size, strict=True)):
            columns, rows = (
                slice(int(max(first, 0)) // TILE * TILE, min(math.ceil(min(last, pixels) / TILE) * TILE, pixels))
                for first, last, pixels in zip(low, high, size, strict=True)
            )
    return rows, columns

"""Visual hulls: what the masks of all views leave standing."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from numba import prange
from scipy import ndimage

from ..capture import CaptureError
from ..geometry import Camera
from ..jit import kernel, lanes


@dataclass(frozen=True)
class Hull:
    """A solid on a grid of cubic voxels, aligned with the world's axes.

    Attributes:
        origin: the corner of voxel (0, 0, 0), world.
        voxel: edge of a voxel, world units.
        occupied: which voxels no mask rules out.
    """

    origin: Float64[np.ndarray, " 3"]
    voxel: float
    occupied: Bool[np.ndarray, "X Y Z"]

    def centres(self, chosen: Bool[np.ndarray, "X Y Z"] | None = None) -> Float64[np.ndarray, "P 3"]:
        """Centres in the world of the chosen voxels (default: the occupied ones)."""
        return (np.argwhere(self.occupied if chosen is None else chosen) + 0.5) * self.voxel + self.origin

    def distance(self) -> Float64[np.ndarray, "X Y Z"]:
        """Distance of each voxel's centre to the solid, world units; 0 inside."""
        if not self.occupied.any():
            return np.full(self.occupied.shape, np.inf)
        return np.asarray(ndimage.distance_transform_edt(~self.occupied)) * self.voxel

    def sample(
        self, field: Float[np.ndarray, "X Y Z"], points: Float[np.ndarray, "P 3"], outside: float
    ) -> Float[np.ndarray, " P"]:
        """Values of a field on this grid at world points; `outside` where a point lies off the grid."""
        index = np.floor((points - self.origin) / self.voxel).astype(np.int64)
        valid = ((index >= 0) & (index < self.occupied.shape)).all(1)
        values = np.full(len(points), outside, dtype=np.float64)
        values[valid] = field[tuple(index[valid].T)]
        return values


@kernel(parallel=True)
def _carve(origin, voxel, shape, projections, inside):
    """Occupancy: voxels that a third of the views see, and whose centre falls on the mask in every view that sees it."""
    X, Y, Z = shape
    V, H, W = inside.shape
    occupied = np.zeros((X, Y, Z), np.bool_)
    for i in prange(X):
        x = origin[0] + (i + 0.5) * voxel
        for j in range(Y):
            y = origin[1] + (j + 0.5) * voxel
            for k in range(Z):
                z = origin[2] + (k + 0.5) * voxel
                keep = True
                seen = 0
                for v in range(V):
                    P = projections[v]
                    w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
                    if w <= 0:
                        continue
                    col = int(np.floor((P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / w))
                    row = int(np.floor((P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / w))
                    if 0 <= col < W and 0 <= row < H:
                        seen += 1
                        if not inside[v, row, col]:
                            keep = False
                            break
                occupied[i, j, k] = keep and 3 * seen >= V
    return occupied


@dataclass(frozen=True)
class Silhouettes:
    """The masks of one state with their cameras.

    Attributes:
        cameras: V cameras, for images of the masks' size.
        masks: alpha in [0, 1].
    """

    cameras: tuple[Camera, ...]
    masks: Float32[np.ndarray, "V H W"]

    @property
    def projections(self) -> Float64[np.ndarray, "V 3 4"]:
        """Projection matrices, world to pixels."""
        rows = [camera.projection for camera in self.cameras]
        return torch.stack(rows).numpy()

    def carve(self, low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"], resolution: int) -> Hull:
        """The visual hull inside the world box `low .. high`, with `resolution` voxels along its longest side."""
        voxel = float((high - low).max() / resolution)
        shape = tuple(int(n) for n in np.maximum(1, np.ceil((high - low) / voxel - 1e-6)))
        projections = self.projections
        # Grown by half a voxel's footprint, so that thin sheets survive the sampling at voxel centres.
        inside = self.masks > 0.25
        centre = np.append((low + high) / 2, 1.0)
        for v, camera in enumerate(self.cameras):
            radius = 0.5 * voxel * camera.fx / max(float(projections[v, 2] @ centre), 1e-6)
            if radius >= 0.5:
                inside[v] = np.asarray(ndimage.distance_transform_edt(~inside[v])) <= radius
        with lanes():
            occupied = _carve(low, voxel, shape, projections, inside)
        return Hull(low, voxel, occupied)


def _reach(silhouettes: tuple[Silhouettes, ...]) -> tuple[Float64[np.ndarray, " 3"], float]:
    """A ball around the point nearest to all rays through mask centres, as wide as the widest mask."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    spans = []
    for state in silhouettes:
        for camera, mask in zip(state.cameras, state.masks, strict=True):
            rows, cols = np.nonzero(mask > min(0.5, 0.5 * float(mask.max())))
            R, origin = camera.T_world_camera.rotation.double().numpy(), camera.centre.double().numpy()
            d = R @ [(cols.mean() + 0.5 - camera.cx) / camera.fx, (rows.mean() + 0.5 - camera.cy) / camera.fy, 1.0]
            d /= np.linalg.norm(d)
            across = np.eye(3) - np.outer(d, d)
            A, b = A + across, b + across @ origin
            spans.append((origin, (max(np.ptp(rows), np.ptp(cols)) + 2) / camera.fx))
    centre = np.linalg.lstsq(A, b, rcond=None)[0]
    return centre, max(float(np.linalg.norm(centre - origin)) * span for origin, span in spans)


def object_bounds(silhouettes: tuple[Silhouettes, ...]) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """A world box, a little loose, around the visual hulls of all states.

    Raises:
        CaptureError: a hull is empty, as when cameras and images do not belong together.
    """
    centre, radius = _reach(silhouettes)
    low, high = centre - radius, centre + radius
    for _ in range(2):
        hulls = [state.carve(low, high, 48) for state in silhouettes]
        for state, hull in enumerate(hulls):
            if not hull.occupied.any():
                raise CaptureError(
                    f"state {state}: no point in space lies inside the masks of all {len(silhouettes[state].cameras)} views; "
                    "check the cameras' convention and the polarity of the masks."
                )
        points = np.concatenate([hull.centres() for hull in hulls])
        low, high = points.min(0) - 1.5 * hulls[0].voxel, points.max(0) + 1.5 * hulls[0].voxel
    return low, high

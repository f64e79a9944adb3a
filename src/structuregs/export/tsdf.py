"""A truncated signed distance field that depth images are fused into (Curless and Levoy 1996)."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numba import prange
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from ..jit import kernel, lanes


@kernel(parallel=True)
def _fuse(low, voxel, truncation, projections, depth, empty, rgb, field, colour):
    """Adds V images to field (X Y Z 3: see `Volume`) and colour (X Y Z 4: rgb, weights).

    projections (V 3 4): grid's frame to pixels; depth (V H W): 0 = no surface; empty (V H W): up to where nothing stands.
    """
    X, Y, Z = field.shape[:3]
    V, H, W = depth.shape
    for i in prange(X):
        for v in range(V):
            P = projections[v]
            for j in range(Y):
                x, y = low[0] + i * voxel, low[1] + j * voxel
                a = P[0, 0] * x + P[0, 1] * y + P[0, 3]
                b = P[1, 0] * x + P[1, 1] * y + P[1, 3]
                c = P[2, 0] * x + P[2, 1] * y + P[2, 3]
                for k in range(Z):
                    z = low[2] + k * voxel
                    w = c + P[2, 2] * z
                    if w <= 0:
                        continue
                    u, t = (a + P[0, 2] * z) / w, (b + P[1, 2] * z) / w
                    if not (u >= 0 and t >= 0 and u < W and t < H):
                        continue
                    col, row = int(u), int(t)
                    d = depth[v, row, col]
                    if d > 0:
                        ahead = (d - w) / truncation
                        if ahead < -1:
                            field[i, j, k, 2] += np.float32(1)
                            continue
                        field[i, j, k, 0] += min(ahead, np.float32(1))
                        field[i, j, k, 1] += np.float32(1)
                        if ahead < 1:
                            near = 1 - abs(ahead)
                            for n in range(3):
                                colour[i, j, k, n] += near * rgb[v, row, col, n]
                            colour[i, j, k, 3] += near
                    elif w < empty[v, row, col]:
                        field[i, j, k, 0] += np.float32(1)
                        field[i, j, k, 1] += np.float32(1)
                    elif empty[v, row, col] > 0:
                        field[i, j, k, 2] -= np.float32(1)


@dataclass
class Volume:
    """A grid of samples in some frame, with what images have said of them.

    Attributes:
        low: where sample (0, 0, 0) is.
        voxel: distance between samples.
        truncation: distances farther from a surface than this count as this.
        shape: samples along each axis.

    Of each sample the field holds the sum of its distances from the surface, in truncations, how many images gave one, and
    in how many more images the surface hides it than something else does.
    """

    low: Float64[np.ndarray, " 3"]
    voxel: float
    truncation: float
    shape: tuple[int, int, int]
    _field: Float32[np.ndarray, "X Y Z 3"] = field(init=False, repr=False)
    _colour: Float32[np.ndarray, "X Y Z 4"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._field = np.zeros((*self.shape, 3), np.float32)
        self._colour = np.zeros((*self.shape, 4), np.float32)

    def fuse(
        self,
        projections: Float64[np.ndarray, "V 3 4"],
        depth: Float32[np.ndarray, "V H W"],
        empty: Float32[np.ndarray, "V H W"],
        rgb: Float32[np.ndarray, "V H W 3"],
    ) -> None:
        """Adds what V images say.

        Args:
            projections: the grid's frame to pixels.
            depth: of the surface along z; 0 where the image shows none.
            empty: where there is no surface: the depth up to which the pixel's ray is known to be empty; what lies deeper
                something else hides, but for 0: there nothing is known.
            rgb: colours of the surface.
        """
        with lanes():
            _fuse(self.low, self.voxel, self.truncation, projections, depth, empty, rgb, self._field, self._colour)

    def surface(
        self, fewest: float = 1, *, outside: int = 0, rim: int = 0
    ) -> tuple[Float64[np.ndarray, "P 3"], Int64[np.ndarray, "F 3"], Float64[np.ndarray, "P 3"]]:
        """Vertices in the grid's frame, faces with outward normals, and the vertices' rgb.

        Only cells whose eight samples have all been seen `fewest` times are part of the surface: where nothing was seen
        there is a hole, not a guess.  Near the grid's sides it is closed: what no image saw is solid there, if it is mostly
        the surface itself that hides it, as that of a thing on the ground hides its underside.

        Args:
            fewest: images that must have seen a sample.
            outside: samples on each side that lie beyond what is looked for: there nothing is solid that was not seen.
            rim: samples on each side, further in, where the surface is closed.
        """
        total, weight, behind = np.moveaxis(self._field, -1, 0)
        seen = weight >= fewest
        value = np.where(seen, total / np.maximum(weight, 1), np.float32(1))
        if not (value.min() < 0 < value.max()):
            return np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3))
        whole = _cells(seen)
        if rim:
            value[self._inner(outside) & ~seen & (total <= 0) & (behind > 0)] = -1
            whole |= _cells(~self._inner(outside + rim))
        vertices, faces, _, _ = marching_cubes(value, 0.0, gradient_direction="descent")
        cells = np.floor(vertices[faces].mean(1) - 1e-6).astype(np.int64)
        faces = faces[whole[tuple(np.clip(cells, 0, np.array(whole.shape) - 1).T)]]
        used, faces = np.unique(faces, return_inverse=True)
        vertices = vertices[used].astype(np.float64)
        return self.low + vertices * self.voxel, faces.reshape(-1, 3).astype(np.int64), self._rgb(vertices)

    def _inner(self, by: int) -> Bool[np.ndarray, "X Y Z"]:
        """Samples at least so many steps from every side of the grid."""
        inner = np.zeros(self.shape, dtype=bool)
        inner[tuple(slice(by, n - by) for n in self.shape)] = True
        return inner

    def _rgb(self, vertices: Float64[np.ndarray, "P 3"]) -> Float64[np.ndarray, "P 3"]:
        """Colours at vertices; where none was seen, that of the nearest vertex which has one."""
        nearest = tuple(np.clip(np.rint(vertices).astype(np.int64), 0, np.array(self.shape) - 1).T)
        rows = self._colour[nearest].astype(np.float64)
        known = rows[:, 3] > 0
        rgb = rows[:, :3] / np.maximum(rows[:, 3:], 1e-6)
        if known.any() and not known.all():
            rgb[~known] = rgb[known][KDTree(vertices[known]).query(vertices[~known])[1]]
        return rgb


def _cells(samples: Bool[np.ndarray, "X Y Z"]) -> Bool[np.ndarray, "A B C"]:
    """Cells all of whose eight samples are among those given."""
    for axis in range(3):
        n = samples.shape[axis] - 1
        samples = samples.take(range(n), axis) & samples.take(range(1, n + 1), axis)
    return samples

"""Errors of images, surfaces and joints: pure functions on values, in the units that they are given."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

# Sine of the angle below which two axes count as parallel.  The distance of two lines is a quotient by this sine, of
# float64 values of size one: below it, more than six digits are lost.
_PARALLEL = 1e-8


def psnr(image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], where: Bool[Tensor, "H W"] | None = None) -> float:
    """Peak signal-to-noise ratio of an image in [0, 1], dB; infinite for equal images.

    Args:
        image: what is judged.
        target: what it should be.
        where: the pixels that count; all by default.

    Raises:
        ValueError: no pixel counts.
    """
    square = (image - target).square()
    if where is not None:
        square = square[where]
    if not square.numel():
        raise ValueError("psnr: no pixel is left to compare; the mask is empty.")
    return float(-10 * torch.log10(square.double().mean()))


def axis_angle_deg(axis: Float[Tensor, " 3"], axis_true: Float[Tensor, " 3"]) -> float:
    """Angle between two axes in [0, 90] degrees, blind to their signs and lengths.

    By atan2, which keeps its digits where acos of a product near one has lost half of them.
    """
    across = torch.linalg.cross(axis, axis_true).norm()
    return float(torch.rad2deg(torch.atan2(across, (axis @ axis_true).abs())))


def axis_position(
    origin: Float[Tensor, " 3"], axis: Float[Tensor, " 3"], origin_true: Float[Tensor, " 3"], axis_true: Float[Tensor, " 3"]
) -> float:
    """Distance between two lines, each through an origin along an axis, in the origins' unit.

    Parallel lines: the distance of the one's origin from the other line (PARIS's own formula returns 0 there).
    """
    axis, axis_true = axis / axis.norm(), axis_true / axis_true.norm()
    between = origin - origin_true
    normal = torch.linalg.cross(axis, axis_true)
    sine = normal.norm()
    if sine < _PARALLEL:
        return float(torch.linalg.cross(between, axis_true).norm())
    return float((between @ normal).abs() / sine)


def geodesic_deg(R: Float[Tensor, "3 3"], R_true: Float[Tensor, "3 3"]) -> float:
    """Angle of `R R_true^T` in [0, 180] degrees; sensitive to the direction of a turn."""
    D = R @ R_true.T
    twice_sine = torch.stack([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]).norm()
    return float(torch.rad2deg(torch.atan2(twice_sine, D.trace() - 1)))


def translation_error(axis: Float[Tensor, " 3"], length: float, axis_true: Float[Tensor, " 3"], length_true: float) -> float:
    """Norm of the difference of two slides, `|d_p a_p - d_g a_g|`, in the lengths' unit."""
    return float((length * axis - length_true * axis_true).norm())


def nearest_distances(points: Float[np.ndarray, "P 3"], others: Float[np.ndarray, "Q 3"]) -> Float[np.ndarray, " P"]:
    """Distance of each point to the nearest of the others, in their unit."""
    return np.asarray(KDTree(others).query(points)[0])


def chamfer(points: Float[np.ndarray, "P 3"], others: Float[np.ndarray, "Q 3"]) -> float:
    """Chamfer distance as the benchmarks' code computes it: mean squared distances, both directions added, x 1000.

    The papers print "Chamfer-L1" over it.  Of random points it is never zero: on an area A, P of them leave 2000 A / (pi P).
    """
    there, back = nearest_distances(points, others), nearest_distances(others, points)
    return 1000 * float((there**2).mean() + (back**2).mean())

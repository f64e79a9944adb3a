import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from structuregs.metrics import axis_angle_deg, axis_position, chamfer, geodesic_deg, nearest_distances, psnr, translation_error


def vector(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_psnr_of_a_known_difference():
    black = torch.zeros(4, 5, 3)
    assert psnr(black + 0.1, black) == pytest.approx(20, abs=1e-5)
    assert psnr(black, black) == math.inf


def test_psnr_counts_only_the_pixels_asked_for():
    image, target, where = torch.zeros(2, 2, 3), torch.zeros(2, 2, 3), torch.zeros(2, 2, dtype=torch.bool)
    image[0, 0], image[1, 1], where[0, 0] = 0.01, 1.0, True
    assert psnr(image, target, where) == pytest.approx(40, abs=1e-5)
    with pytest.raises(ValueError, match="mask is empty"):
        psnr(image, target, torch.zeros(2, 2, dtype=torch.bool))


@pytest.mark.parametrize("degrees", [0.0, 1e-6, 0.05, 30, 90])
@pytest.mark.parametrize("sign", [1, -1])
def test_axis_angle_is_exact_and_blind_to_sign_and_length(degrees, sign):
    a = math.radians(degrees)
    turned = sign * vector(math.cos(a), math.sin(a), 0) * 3
    assert axis_angle_deg(vector(1, 0, 0), turned) == pytest.approx(degrees, rel=1e-9, abs=1e-12)


def test_axis_angle_of_float32_axes_keeps_small_angles():
    """The acos of a float32 product near one could not tell 0.01 degrees from zero."""
    a = math.radians(0.01)
    axis = torch.tensor([1.0, 0, 0])
    assert axis_angle_deg(axis, torch.tensor([math.cos(a), math.sin(a), 0])) == pytest.approx(0.01, rel=1e-4)


def test_axis_position_of_skew_lines():
    along_x, along_y = vector(1, 0, 0), vector(0, 1, 0)
    assert axis_position(vector(5, 0, 0), along_x, vector(0, -7, 0.3), along_y) == pytest.approx(0.3)
    assert axis_position(vector(5, 0, 0), along_x, vector(9, 4, 0), along_y) == pytest.approx(0)


def test_axis_position_of_parallel_lines_is_their_distance():
    z = vector(0, 0, 1)
    assert axis_position(vector(0, 0, 9), z, vector(3, 4, -2), -2 * z) == pytest.approx(5)


def test_axis_position_is_the_least_distance_of_points_of_the_lines():
    rng = np.random.default_rng(0)
    for _ in range(5):
        p, a, o, b = rng.normal(size=(4, 3))
        least = (
            minimize(lambda st, p=p, a=a, o=o, b=b: np.sum((p + st[0] * a - o - st[1] * b) ** 2), [0, 0], tol=1e-14).fun ** 0.5
        )
        assert axis_position(*map(torch.from_numpy, (p, a, o, b))) == pytest.approx(least, abs=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 0.07, 60, 179.9999, 180])
def test_geodesic_against_scipy(degrees):
    rng = np.random.default_rng(1)
    axis = rng.normal(size=3)
    true = Rotation.random(rng=rng)
    predicted = Rotation.from_rotvec(math.radians(degrees) * axis / np.linalg.norm(axis)) * true
    error = geodesic_deg(torch.from_numpy(predicted.as_matrix()), torch.from_numpy(true.as_matrix()))
    assert error == pytest.approx(degrees, abs=1e-9)


def test_geodesic_sees_the_direction_of_a_turn():
    turn = Rotation.from_euler("z", 40, degrees=True)
    there, back = torch.from_numpy(turn.as_matrix()), torch.from_numpy(turn.inv().as_matrix())
    assert geodesic_deg(there, back) == pytest.approx(80)


def test_translation_error_sees_length_and_direction():
    x, y = vector(1, 0, 0), vector(0, 1, 0)
    assert translation_error(x, 0.5, x, 0.3) == pytest.approx(0.2)
    assert translation_error(x, 0.3, y, 0.4) == pytest.approx(0.5)
    assert translation_error(-x, 0.3, x, 0.3) == pytest.approx(0.6)
    assert translation_error(-x, -0.3, x, 0.3) == pytest.approx(0)


def test_chamfer_adds_squares_of_both_directions():
    """One point at a distance .1 from a pair, which is .3 from it at its farther end: (.1^2 + (.1^2 + .3^2) / 2) x 1000."""
    one, pair = np.array([[0.0, 0, 0]]), np.array([[0.1, 0, 0], [0, 0.3, 0]])
    assert chamfer(one, pair) == pytest.approx(10 + (10 + 90) / 2)
    assert chamfer(pair, one) == pytest.approx(chamfer(one, pair))
    assert chamfer(pair, pair) == 0
    assert nearest_distances(pair, one) == pytest.approx([0.1, 0.3])


def test_chamfer_of_random_points_of_one_square_is_that_of_their_density():
    a, b = np.random.default_rng(0).random((2, 10_000, 3)) * [1, 1, 0]
    assert chamfer(a, b) == pytest.approx(2000 / (math.pi * 10_000), rel=0.05)

"""The reference renderer against closed forms, sampling and finite differences."""

import math

import pytest
import torch

from structuregs.geometry import SE3, Camera, quat_to_matrix
from structuregs.model import SH_C0, Splats
from structuregs.raster import render
from structuregs.raster.reference import project

WHITE = torch.ones(3, dtype=torch.float64)


def camera_at_origin(width=9, height=7, f=100.0, pose=None):
    return Camera(pose or SE3.identity(dtype=torch.float64), f, f, width / 2, height / 2, width, height)


def make_splats(means, scales, opacities, colours):
    n = len(means)
    sh = (torch.tensor(colours, dtype=torch.float64).view(n, 1, 3) - 0.5) / SH_C0
    return Splats(
        torch.tensor(means, dtype=torch.float64),
        torch.tensor([[1.0, 0, 0, 0]] * n, dtype=torch.float64),
        torch.tensor(scales, dtype=torch.float64).log().view(n, 1).expand(n, 3).contiguous(),
        torch.tensor(opacities, dtype=torch.float64).logit(),
        sh,
    )


def draw(splats, camera, background=WHITE):
    return render(splats, camera, background=background, backend="reference")


@pytest.mark.parametrize("dilation", [None, 0.3])
def test_a_round_splat_on_the_axis_is_a_gaussian_of_its_projected_size(dilation: float | None):
    splats = make_splats([[0.0, 0, 4]], [0.05], [0.8], [[1.0, 0, 0]])
    asked = {} if dilation is None else {"dilation": dilation}
    image = render(splats, camera_at_origin(), background=WHITE, backend="reference", **asked)
    variance = (100 * 0.05 / 4) ** 2 + (dilation or 1 / 12)  # of a pixel's square, unless asked otherwise
    x, y = torch.meshgrid(torch.arange(9) - 4.0, torch.arange(7) - 3.0, indexing="xy")
    expected = 0.8 * torch.exp(-(x * x + y * y).double() / (2 * variance))
    torch.testing.assert_close(image.alpha, torch.where(expected >= 1 / 255, expected, 0.0))
    torch.testing.assert_close(image.rgb[..., 1], 1 - image.alpha)


@pytest.mark.parametrize("swap", [False, True])
def test_the_nearer_splat_covers_the_farther_whatever_their_index(swap):
    rows = [([0.0, 0, 4], 0.05, 0.6, [1.0, 0, 0]), ([0.0, 0, 5], 0.05, 0.7, [0.0, 1, 0])]
    means, scales, opacities, colours = zip(*(rows[::-1] if swap else rows), strict=True)
    centre = draw(make_splats(means, scales, opacities, colours), camera_at_origin(), torch.tensor([0.0, 0, 1]).double())
    expected = torch.tensor([0.6, 0.4 * 0.7, 0.4 * 0.3]).double()
    torch.testing.assert_close(centre.rgb[3, 4], expected)
    torch.testing.assert_close(centre.alpha[3, 4].item(), 1 - 0.4 * 0.3)
    torch.testing.assert_close(centre.depth[3, 4].item(), (0.6 * 4 + 0.4 * 0.7 * 5) / (1 - 0.4 * 0.3))


def test_depth_is_zero_where_nothing_is_drawn():
    image = draw(make_splats([[0.0, 0, 4]], [0.01], [0.8], [[1.0, 0, 0]]), camera_at_origin())
    assert image.alpha[0, 0] == 0
    assert image.depth[0, 0] == 0
    assert image.depth[3, 4] == pytest.approx(4)


def test_a_pixel_takes_no_more_splats_once_it_is_full():
    n = 8  # each lets a twentieth through: after the fourth, less than 1e-4 is left
    means = [[0.0, 0, 4 + 0.1 * k] for k in range(n)]
    image = draw(make_splats(means, [0.05] * n, [0.95] * n, [[0.0, 0, 0]] * n), camera_at_origin())
    assert image.alpha[3, 4].item() == pytest.approx(1 - 0.05**4, abs=1e-12)


@pytest.mark.parametrize("means", [[0.0, 0, -4], [0.0, 0, 0.009], [3.0, 0, 4]])
def test_splats_behind_the_camera_or_off_the_image_are_not_drawn(means):
    image = draw(make_splats([means], [0.05], [0.8], [[1.0, 0, 0]]), camera_at_origin())
    assert not image.projection.visible.any()
    assert image.projection.radius.tolist() == [0]
    assert (image.rgb == 1).all()


def test_the_projected_covariance_is_that_of_projected_samples():
    generator = torch.Generator().manual_seed(1)
    pose = SE3.exp(torch.tensor([0.3, -0.2, -5, 0.2, -0.1, 0.5]).double())
    camera = Camera(pose, 500.0, 450.0, 330.0, 210.0, 640, 480)
    splats = Splats(
        torch.tensor([[0.7, 0.4, 0.2]]).double(),
        torch.tensor([[0.9, 0.3, -0.5, 0.2]]).double(),
        torch.tensor([[0.02, 0.005, 0.04]]).double().log(),
        torch.tensor([1.0]).double(),
        torch.zeros(1, 1, 3).double(),
    )
    noise = torch.randn(400_000, 3, generator=generator).double() * splats.scales
    points = splats.means + noise @ quat_to_matrix(splats.quats)[0].T
    pixels, depths = camera.project(points)
    projection = project(splats, camera, 0.3)
    xx, xy, yy = projection.conic[0]
    covariance = torch.linalg.inv(torch.stack([xx, xy, xy, yy]).view(2, 2)) - 0.3 * torch.eye(2).double()
    torch.testing.assert_close(covariance, torch.cov(pixels.T), rtol=0.01, atol=0.05)
    torch.testing.assert_close(projection.xy[0], camera.project(splats.means)[0][0])
    assert projection.depth[0].item() == pytest.approx(depths.mean().item(), abs=1e-3)


def test_colour_follows_the_direction_from_the_camera():
    pose = SE3.exp(torch.tensor([0.5, 0.1, -4, 0, 0, 0]).double())
    splats = make_splats([[0.0, 0, 0]], [0.05], [0.8], [[0.5, 0.5, 0.5]])
    slope = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]]).double()
    splats = Splats(splats.means, splats.quats, splats.log_scales, splats.logit_opacities, slope[None])
    x, y, z = torch.nn.functional.normalize(-pose.xyz, dim=0)
    c = math.sqrt(3 / (4 * math.pi))
    expected = 0.5 + c * torch.stack([-0.1 * y, 0.2 * z, -0.3 * x])
    torch.testing.assert_close(project(splats, camera_at_origin(pose=pose), 0.3).rgb[0], expected)


def test_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(0)
    n = 4
    camera = camera_at_origin(6, 5, 12.0, SE3.exp(torch.tensor([0.1, 0.2, -3, 0.1, 0.1, 0]).double()))
    inputs = [
        0.3 * torch.randn(n, 3, generator=generator).double(),
        torch.randn(n, 4, generator=generator).double(),
        -1.5 + 0.3 * torch.randn(n, 3, generator=generator).double(),
        torch.randn(n, generator=generator).double(),
        0.4 * torch.randn(n, 4, 3, generator=generator).double(),
        torch.rand(3, generator=generator).double(),
    ]

    def images(*tensors):
        image = draw(Splats(*tensors[:5]), camera, tensors[5])
        return image.rgb, image.alpha, image.depth

    assert torch.autograd.gradcheck(images, [t.requires_grad_() for t in inputs])

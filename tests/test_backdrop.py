"""Patches of pictures against the whole pictures, in value and gradient."""

import pytest
import torch

from structuregs.geometry import SE3, Camera
from structuregs.model import Splats
from structuregs.raster import Backdrop, render

# 70 x 90 pixels: no whole number of tiles.
CAMERA = Camera(SE3.exp(torch.tensor([0, 0, -3.0, 0, 0, 0])), 90.0, 90.0, 45.0, 35.0, 90, 70)


def splats(count: int, middle: tuple[float, float, float], spread: float, seed: int) -> Splats:
    g = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=g)

    means = torch.tensor(middle) + spread * normal(count, 3)
    return Splats(means, normal(count, 4), -3 + 0.3 * normal(count, 3), normal(count) + 1, normal(count, 1, 3))


STAYING = splats(300, (0.0, 0.0, 0.0), 0.6, 0)
WHITE = torch.ones(3)
PLACES = [(0.3, 0.1, 0.2), (1.4, -0.9, 0.0), (-0.5, 0.5, -1.5), (0.0, 0.0, 0.9)]


@pytest.mark.parametrize("dilation", [0.1, 0.5])
@pytest.mark.parametrize("place", PLACES)
def test_a_patch_is_a_cut_of_the_whole_picture_and_elsewhere_nothing_changes(
    place: tuple[float, float, float], dilation: float
):
    few = splats(20, place, 0.1, 1)
    patch = Backdrop(STAYING, CAMERA, dilation).with_others(few)
    whole = render(Splats.concatenate([STAYING, few]), CAMERA, dilation=dilation)
    drawn = patch.drawn(WHITE)
    for name in ("rgb", "alpha", "depth"):
        expected = getattr(render(STAYING, CAMERA, dilation=dilation), name).clone()
        expected[patch.rows, patch.columns] = getattr(drawn, name)
        torch.testing.assert_close(expected, getattr(whole, name), atol=1e-5, rtol=0)
    assert drawn.alpha.numel() < 0.5 * whole.alpha.numel()
    assert patch.count < len(STAYING)


@pytest.mark.parametrize("place", PLACES)
def test_others_get_the_gradient_of_the_whole_picture(place: tuple[float, float, float]):
    weights = torch.randn(CAMERA.height, CAMERA.width, 3, generator=torch.Generator().manual_seed(2))
    grads = []
    for in_patch in (True, False):
        few = splats(20, place, 0.1, 1)
        few.means.requires_grad_()
        if in_patch:
            patch = Backdrop(STAYING, CAMERA).with_others(few)
            (patch.drawn(WHITE).rgb * weights[patch.rows, patch.columns]).sum().backward()
        else:
            (render(Splats.concatenate([STAYING, few]), CAMERA).rgb * weights).sum().backward()
        grads.append(few.means.grad)
    assert float(grads[1].abs().max()) > 0.1
    torch.testing.assert_close(grads[0], grads[1], atol=1e-3, rtol=1e-3)


def test_other_colours_are_those_of_the_patch_s_splats():
    few = splats(20, PLACES[0], 0.1, 1)
    patch = Backdrop(STAYING, CAMERA).with_others(few)
    own = (torch.arange(len(patch.projection.rgb)) >= patch.count).float()[:, None].repeat(1, 3)
    share = patch.drawn(torch.zeros(3), own).rgb[..., 0]
    black = patch.drawn(torch.zeros(3), 1 - own).rgb[..., 0]
    torch.testing.assert_close(share + black, patch.drawn(WHITE).alpha, atol=1e-5, rtol=0)


def test_what_lies_outside_the_image_changes_nothing():
    away = splats(20, (0.0, 0.0, -5.0), 0.1, 1)  # behind the camera
    patch = Backdrop(STAYING, CAMERA).with_others(away)
    assert (patch.rows, patch.columns) == (slice(0, 16), slice(0, 16))
    torch.testing.assert_close(patch.drawn(WHITE).rgb, render(STAYING, CAMERA).rgb[:16, :16], atol=1e-5, rtol=0)

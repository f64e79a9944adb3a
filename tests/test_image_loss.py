"""The image loss: torch against scikit-image, Numba against torch."""

from contextlib import nullcontext

import numba
import pytest
import torch
from skimage.metrics import structural_similarity

from structuregs.raster import cpu_loss, image_loss
from structuregs.raster.image_loss import image_loss_reference, ssim


def make_images(height, width, seed=0):
    """A smooth target, a noisy image of it, and their alphas."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, height // 8 + 2, width // 8 + 2, generator=generator)
    target = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")[0].permute(1, 2, 0).contiguous()
    image = target + 0.1 * torch.randn(height, width, 3, generator=generator)
    alphas = torch.rand(2, height, width, generator=generator)
    return image, alphas[0], target, alphas[1]


def loss_and_gradients(function, images, dtype, **weights):
    rgb, alpha, target_rgb, target_alpha = (t.to(dtype) for t in images)
    rgb, alpha = rgb.clone().requires_grad_(), alpha.clone().requires_grad_()
    loss = function(rgb, alpha, target_rgb, target_alpha, **weights)
    (3 * loss).backward()
    return loss, rgb.grad, alpha.grad if alpha.grad is not None else torch.zeros_like(alpha)


def assert_same(images, **weights):
    values = loss_and_gradients(image_loss, images, torch.float32, **weights)
    expected = loss_and_gradients(image_loss_reference, images, torch.float64, **weights)
    assert values[0].item() == pytest.approx(expected[0].item(), abs=3e-6)
    for gradient, reference in zip(values[1:], expected[1:], strict=True):
        assert (gradient - reference).abs().max() <= 1e-4 * reference.abs().max()


def test_ssim_is_scikit_images_inside_the_image():
    image, _, target, _ = make_images(40, 50)
    _, expected = structural_similarity(
        image.double().numpy(), target.double().numpy(), channel_axis=2, data_range=1, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    inside = (slice(5, -5), slice(5, -5))
    torch.testing.assert_close(
        ssim(image.double(), target.double())[inside], torch.from_numpy(expected)[inside].double(), atol=1e-9, rtol=0
    )


def test_outside_the_image_is_zero():
    image, _, target, _ = (t.double() for t in make_images(20, 30))
    pad = torch.nn.ZeroPad2d(8)
    wide = [pad(t.permute(2, 0, 1)).permute(1, 2, 0) for t in (image, target)]
    torch.testing.assert_close(ssim(image, target), ssim(*wide)[8:-8, 8:-8])


@pytest.mark.parametrize("size", [(37, 50), (5, 7), (1, 1), (100, 130), (48, 96), (11, 220)])
def test_the_kernels_are_the_torch_loss_in_value_and_gradient(size):
    assert_same(make_images(*size))


@pytest.mark.parametrize("weights", [{"ssim_weight": 0.0}, {"ssim_weight": 1.0, "alpha_weight": 0.0}, {"alpha_weight": 2.5}])
def test_every_weight_counts(weights):
    assert_same(make_images(30, 40), **weights)


def test_leaving_out_agreement_changes_nothing():
    image, alpha, target, target_alpha = make_images(200, 300)
    image[:60], target[:60] = 1.0, 1.0
    image[:, 150:], target[:, 150:] = 1.0, 1.0
    image[170, 290] = 0.3
    assert_same((image, alpha, target, target_alpha))


def test_equal_images_have_no_loss_and_no_gradient():
    _, alpha, target, _ = make_images(60, 110)
    loss, g_rgb, g_alpha = loss_and_gradients(image_loss, (target, alpha, target, alpha), torch.float32)
    assert loss == 0
    assert (g_rgb == 0).all()
    assert (g_alpha == 0).all()


def test_without_ssim_it_is_the_mean_absolute_difference():
    image, alpha, target, target_alpha = make_images(20, 30)
    expected = (image - target).abs().mean() + 0.5 * (alpha - target_alpha).abs().mean()
    loss = image_loss(image, alpha, target, target_alpha, ssim_weight=0.0, alpha_weight=0.5)
    torch.testing.assert_close(loss, expected)


def test_targets_get_no_gradient():
    image, alpha, target, target_alpha = make_images(20, 30)
    target.requires_grad_()
    for function in (image_loss, image_loss_reference):
        function(image.requires_grad_(), alpha, target, target_alpha).backward()
        assert target.grad is None


@pytest.mark.parametrize("lanes", [2, 3])
def test_the_same_bytes_for_any_number_of_threads(monkeypatch, lanes):
    images = make_images(120, 210)

    def run(count):
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
        monkeypatch.setattr(cpu_loss, "lanes", lambda: nullcontext(count))
        return [t.detach().numpy().tobytes() for t in loss_and_gradients(image_loss, images, torch.float32)]

    before = numba.get_num_threads()
    try:
        assert run(1) == run(lanes)
    finally:
        numba.set_num_threads(before)


def test_a_second_backward_pass_adds_the_same_gradient_again():
    rgb, alpha, target, target_alpha = make_images(20, 30)
    leaves = [value.requires_grad_() for value in (rgb, alpha)]
    loss = image_loss(*leaves, target, target_alpha)
    (3 * loss).backward(retain_graph=True)
    once = [leaf.grad.clone() for leaf in leaves]
    (6 * loss).backward(retain_graph=True)
    (0 * loss).backward()
    for leaf, first in zip(leaves, once, strict=True):
        torch.testing.assert_close(leaf.grad, 3 * first)

"""The Numba renderer against the reference, in values and gradients."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import numba
import numpy as np
import pytest
import torch

from structuregs.geometry import SE3, Camera
from structuregs.jit import fast_exp2
from structuregs.model import Splats
from structuregs.raster import blend, cpu, project, render
from structuregs.raster.blend_kernels import depth_order

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")


def make_splats(n, degree=0, seed=0, log_scale=-2.0, spread=0.5):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    return Splats(
        0.6 * normal(n, 3),
        normal(n, 4),
        log_scale + spread * normal(n, 3),
        1.5 * normal(n),
        0.5 * normal(n, (degree + 1) ** 2, 3),
    )


def make_camera(width, height):
    pose = SE3.exp(torch.tensor([0.1, -0.2, -4, 0.1, -0.15, 0.2]))
    return Camera(pose, 1.2 * width, 1.1 * width, 0.52 * width, 0.47 * height, width, height)


def results(splats, camera, backend, dtype, parts=("rgb", "alpha", "depth"), seed=5, **how):
    """Images of a back end, and the gradients of a random linear function of some of them."""
    generator = torch.Generator().manual_seed(seed)
    tensors = {name: value.to(dtype).clone().requires_grad_() for name, value in splats.tensors().items()}
    background = torch.tensor([0.2, 0.5, 0.9], dtype=dtype, requires_grad=True)
    image = render(Splats(**tensors), camera, background=background, backend=backend, **how)
    image.projection.xy.retain_grad()
    loss = torch.zeros((), dtype=dtype)
    for part in ("rgb", "alpha", "depth"):
        weights = torch.randn(getattr(image, part).shape, generator=generator)
        if part in parts:
            loss = loss + (getattr(image, part) * weights).sum()
    loss.backward()
    values = {"rgb": image.rgb, "alpha": image.alpha, "depth": image.depth, "radius": image.projection.radius}
    gradients = {name: value.grad for name, value in tensors.items()}
    return values, gradients | {"background": background.grad, "xy": image.projection.xy.grad}


def assert_same(splats, camera, parts=("rgb", "alpha", "depth"), tolerance=2e-4, **how):
    """Values to 1e-5 and gradients to a share of their largest entry."""
    values, gradients = results(splats, camera, "cpu", torch.float32, parts, **how)
    expected_values, expected_gradients = results(splats, camera, "reference", torch.float64, parts, **how)
    for name, value in values.items():
        torch.testing.assert_close(
            value.double(), expected_values[name], rtol=1e-5, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}"
        )
    for name, gradient in gradients.items():
        expected = expected_gradients[name]
        if expected is None:
            expected = torch.zeros_like(gradient).double()
        gap, size = (gradient.double() - expected).abs().max(), expected.abs().max()
        assert gap <= tolerance * size + 1e-7, f"{name}: off by {gap:.2e}, largest {size:.2e}"


@pytest.mark.parametrize(
    ("width", "height", "degree", "n"), [(50, 37, 0, 300), (33, 64, 2, 200), (16, 16, 3, 60), (1, 1, 1, 20)]
)
def test_values_and_every_gradient_are_the_references(width, height, degree, n):
    assert_same(make_splats(n, degree, seed=width), make_camera(width, height))


@pytest.mark.parametrize("part", ["rgb", "alpha", "depth"])
def test_gradients_through_one_image_alone(part):
    assert_same(make_splats(100), make_camera(40, 30), (part,))


def test_splats_widened_by_more_on_the_image():
    splats, camera = make_splats(100, log_scale=-4.0), make_camera(40, 30)
    assert_same(splats, camera, dilation=0.3)
    areas = [float(render(splats, camera, dilation=d).projection.radius.square().mean()) for d in (0.1, 0.3)]
    assert areas[1] > 1.2 * areas[0]


def test_long_thin_splats_reach_every_pixel_they_should():
    assert_same(make_splats(40, log_scale=-2.5, spread=2.0, seed=3), make_camera(90, 70))


def test_splats_larger_than_the_image_and_beside_the_frustum():
    splats = make_splats(30, log_scale=0.5, spread=1.0, seed=4)
    assert_same(Splats(3 * splats.means, *list(splats.tensors().values())[1:]), make_camera(40, 30))


def test_full_pixels_stop_where_the_references_do():
    splats = make_splats(400, log_scale=-0.5, spread=0.2, seed=2)
    opaque = Splats(splats.means, splats.quats, splats.log_scales, splats.logit_opacities + 4, splats.sh)
    values, _ = results(opaque, make_camera(40, 40), "cpu", torch.float32)
    assert (values["alpha"] > 1 - 1e-4).any()
    assert_same(opaque, make_camera(40, 40))


@pytest.mark.parametrize("lanes", [2, 5])
def test_the_same_bytes_for_any_number_of_threads(monkeypatch, lanes):
    splats, camera = make_splats(400, 1), make_camera(70, 50)

    def run(count):
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
        monkeypatch.setattr(cpu, "lanes", lambda: nullcontext(count))
        values, gradients = results(splats, camera, "cpu", torch.float32)
        return [t.detach().numpy().tobytes() for t in (*values.values(), *gradients.values())]

    before = numba.get_num_threads()
    try:
        assert run(1) == run(lanes)
    finally:
        numba.set_num_threads(before)


def test_compiling_is_told_once_and_loading_from_the_cache_not_at_all(tmp_path: Path):
    program = """
import numpy as np
from structuregs.jit import when_compiling
from structuregs.raster.blend_kernels import depth_order
said = []
with when_compiling(lambda: said.append(1)):
    for dtype in (np.float32, np.float64):
        depth_order(np.ones(3, dtype), np.ones((3, 2), dtype))
print(len(said))
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    run = [sys.executable, "-c", program]
    said = [subprocess.run(run, env=environment, check=True, capture_output=True, text=True).stdout.strip() for _ in range(2)]
    assert said == ["1", "0"]


def test_splats_that_are_not_finite_leave_no_trace():
    good, camera = make_splats(20), make_camera(40, 30)
    bad = make_splats(6, seed=9)
    bad.means[0, 1] = torch.nan
    bad.log_scales[1] = 200.0
    bad.quats[2] = torch.inf
    bad.logit_opacities[3] = torch.nan
    bad.means[4] = 1e30
    bad.log_scales[5, 0] = torch.nan
    both = Splats.concatenate([bad, good])
    expected, expected_gradients = results(good, camera, "cpu", torch.float32)
    values, gradients = results(both, camera, "cpu", torch.float32)
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(values[name], expected[name])
    for name in NAMES:
        assert torch.equal(gradients[name][6:], expected_gradients[name])
        if name != "logit_opacities":
            assert (gradients[name][:6] == 0).all()
    assert (values["radius"][:6] == 0).all()


def test_points_and_walls_are_drawn_as_by_the_reference():
    splats = make_splats(3)
    splats.log_scales[0] = -60.0  # a point: the dilation alone
    splats.log_scales[1] = 3.0  # covers the image
    splats.logit_opacities[2] = -20.0  # too faint to draw
    assert_same(splats, make_camera(40, 30))


def test_no_splats_leave_the_background():
    image = render(make_splats(0), make_camera(20, 10), background=torch.tensor([0.1, 0.2, 0.3]))
    assert (image.rgb == torch.tensor([0.1, 0.2, 0.3])).all()
    assert (image.alpha == 0).all()
    assert (image.depth == 0).all()


def test_ties_in_depth_go_by_index():
    splats = make_splats(2)
    splats = Splats(splats.means[:1].repeat(2, 1), *list(splats.tensors().values())[1:])
    assert_same(splats, make_camera(40, 30))
    depth, extent = np.array([2, -1, 2, 0.5, -1, 2], np.float32), np.ones((6, 2), np.float32)
    extent[5] = 0
    assert depth_order(depth, extent).tolist() == [1, 4, 3, 0, 2]


def test_stages_compose_to_the_render_and_white_is_the_background():
    splats, camera = make_splats(50), make_camera(40, 30)
    staged = blend(project(splats, camera), 40, 30, torch.ones(3))
    assert torch.equal(staged.rgb, render(splats, camera).rgb)


def test_double_input_is_drawn_in_single_and_gets_double_gradients():
    tensors = {name: value.double().requires_grad_() for name, value in make_splats(20).tensors().items()}
    image = render(Splats(**tensors), make_camera(20, 20))
    image.rgb.sum().backward()
    assert image.rgb.dtype == torch.float32
    assert all(value.grad.dtype == torch.float64 for value in tensors.values())


def test_the_polynomial_is_two_to_the_x():
    x = np.linspace(-8, 0, 2001).astype(np.float32)
    np.testing.assert_allclose([fast_exp2(v) for v in x], np.exp2(x.astype(np.float64)), rtol=6e-7)


def test_threads_may_render_at_once():
    splats, camera = make_splats(200), make_camera(60, 60)
    expected = render(splats, camera).rgb
    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(lambda _: render(splats, camera).rgb, range(40)))
    assert all(torch.equal(image, expected) for image in images)


def test_changing_an_image_in_place_before_the_backward_pass_is_refused():
    tensors = {name: value.requires_grad_() for name, value in make_splats(5).tensors().items()}
    image = render(Splats(**tensors), make_camera(10, 10))
    loss = image.rgb.sum()
    with torch.no_grad():
        image.rgb.clamp_(0, 0.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()

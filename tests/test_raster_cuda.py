"""The CUDA renderer against the reference; without a GPU, how it says so."""

from importlib.util import find_spec

import pytest
import torch

from structuregs.raster import render
from test_raster_cpu import make_camera, make_splats, results

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.mark.skipif(torch.cuda.is_available(), reason="says what is missing only where there is no GPU")
def test_without_a_gpu_the_error_says_what_to_do():
    with pytest.raises(RuntimeError, match="no NVIDIA GPU here; use backend='cpu'"):
        render(make_splats(3), make_camera(20, 20), backend="cuda")


@pytest.mark.skipif(not (torch.cuda.is_available() and find_spec("gsplat")), reason="needs an NVIDIA GPU and gsplat")
@pytest.mark.parametrize("degree", [0, 2])
def test_values_and_gradients_are_the_references(degree):
    splats, camera = make_splats(200, degree), make_camera(50, 37)
    values, gradients = results(splats, camera, "cuda", torch.float32)
    expected_values, expected_gradients = results(splats, camera, "reference", torch.float64)
    for name in ("rgb", "alpha", "depth"):
        assert (values[name].cpu() - expected_values[name]).abs().max() < 5e-3
        assert (values[name].cpu() - expected_values[name]).abs().mean() < 1e-4
    for name, gradient in gradients.items():
        gap, size = (gradient.cpu() - expected_gradients[name]).abs().max(), expected_gradients[name].abs().max()
        assert gap < 1e-2 * size, name

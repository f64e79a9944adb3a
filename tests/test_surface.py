"""The losses that shape surfaces, against planes whose depth is known in closed form."""

from dataclasses import replace

import pytest
import torch

from structuregs.fit.surface import planarity_loss, slopes, thickness
from structuregs.geometry import SE3, Camera
from structuregs.model import Splats
from structuregs.raster import render_planes
from structuregs.raster.planes import tangent_planes

CAMERA = Camera(SE3.identity(), 70.0, 70.0, 32.0, 32.0, 64, 64)


def wall(normal: torch.Tensor, distance: float, bumps: float = 0.0) -> Splats:
    """Discs of 0.06 that fill the view with the plane normal . x = distance, their centres up to `bumps` off along z."""
    steps = torch.linspace(-3, 3, 121)
    x, y = (axis.reshape(-1) for axis in torch.meshgrid(steps, steps, indexing="ij"))
    z = (distance - normal[0] * x - normal[1] * y) / normal[2]
    z = z + bumps * (2 * torch.rand(len(z), generator=torch.Generator().manual_seed(0)) - 1)
    half = torch.nn.functional.normalize(normal + torch.tensor([0.0, 0, 1]), dim=0)  # half way from z: turns z into the normal
    quat = torch.stack([half[2], -half[1], half[0], torch.zeros(())]).expand(len(z), 4)
    scales = torch.tensor([0.06, 0.06, 0.001]).log().expand(len(z), 3)
    return Splats(torch.stack([x, y, z], -1), quat, scales, torch.full((len(z),), 3.0), torch.zeros(len(z), 1, 3))


def unit(*xyz: float) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.tensor(xyz, dtype=torch.float32), dim=0)


GREY = torch.full((64, 64, 3), 0.5)
WHOLE = torch.ones(64, 64)


class TestPlanes:
    @pytest.mark.parametrize("normal", [unit(0, 0, 1), unit(0.3, -0.2, 1), unit(-0.5, 0.4, 1)])
    def test_discs_of_a_wall_give_its_depth_at_every_pixel(self, normal: torch.Tensor):
        image = render_planes(wall(normal, 3.0), CAMERA)
        rays = CAMERA.rays()[1]
        torch.testing.assert_close(1 / (image.planes * rays).sum(-1), 3.0 / (rays @ normal), rtol=2e-4, atol=0)
        torch.testing.assert_close(image.planes, (normal / 3.0).expand(64, 64, 3), rtol=0, atol=1e-4)

    def test_a_camera_that_is_turned_sees_the_planes_turned(self):
        pose = SE3.exp(torch.tensor([0.1, 0.2, -0.3, 0.1, -0.2, 0.4]))
        splats = wall(unit(0.3, -0.2, 1), 3.0)
        here = render_planes(splats, CAMERA)
        there = render_planes(splats.moved(pose), replace(CAMERA, T_world_camera=pose))
        torch.testing.assert_close(there.planes, here.planes, rtol=0, atol=1e-4)

    def test_nothing_is_gained_by_fading_or_moving_sideways_what_is_in_the_way(self):
        leaves = {name: value.clone().requires_grad_() for name, value in wall(unit(0.2, 0.1, 1), 3.0, 0.1).tensors().items()}
        planarity_loss(Splats(**leaves), CAMERA, GREY, WHOLE).backward()
        assert leaves["logit_opacities"].grad is None
        assert leaves["log_scales"].grad is None
        assert leaves["means"].grad is not None
        assert leaves["means"].grad.abs().max() > 0

    @pytest.mark.parametrize("part", ["means", "quats"])
    def test_their_gradients_are_the_references(self, part: str):
        generator = torch.Generator().manual_seed(3)
        splats = Splats(
            torch.randn(300, 3, generator=generator) + torch.tensor([0.0, 0, 4]),
            torch.randn(300, 4, generator=generator),
            torch.randn(300, 3, generator=generator),
            torch.zeros(300),
            torch.zeros(300, 1, 3),
        )
        camera = replace(CAMERA, T_world_camera=SE3.exp(torch.tensor([0.1, 0.2, -0.3, 0.1, -0.2, 0.4])))
        weights = torch.randn(300, 3, generator=generator)
        gradients, values = [], []
        for dtype in (torch.float32, torch.float64):
            leaves = {name: value.to(dtype).clone().requires_grad_() for name, value in splats.tensors().items()}
            planes = tangent_planes(Splats(**leaves), camera)
            (planes * weights).sum().backward()
            values.append(planes.detach())
            gradients.append(leaves[part].grad)
        torch.testing.assert_close(values[0].double(), values[1], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(gradients[0].double(), gradients[1], rtol=1e-3, atol=1e-4)


class TestPlanarity:
    @pytest.mark.parametrize("size", [(64, 64), (31, 70), (7, 9)])
    def test_the_kernel_is_the_torch_loss_in_value_and_gradient(self, size: tuple[int, int]):
        generator = torch.Generator().manual_seed(1)
        camera = replace(CAMERA, fx=80.0, width=size[1], height=size[0])
        rough = torch.tensor([0.1, -0.05, 0.33]) + 0.01 * torch.randn(*size, 3, generator=generator)
        solid = torch.rand(size, generator=generator) > 0.2
        changes = torch.stack([(0.02 * torch.rand(size, generator=generator)).cumsum(axis) for axis in (0, 1)])
        values, gradients = [], []
        for dtype in (torch.float32, torch.float64):
            planes = rough.to(dtype).clone().requires_grad_()
            value = slopes(planes, camera, solid, changes.to(dtype))
            (2 * value).backward()
            values.append(value.item())
            gradients.append(planes.grad)
        assert values[0] == pytest.approx(values[1], rel=1e-4)
        torch.testing.assert_close(gradients[0].double(), gradients[1], rtol=1e-3, atol=1e-4 * float(gradients[1].abs().max()))

    def test_a_wall_has_none_whatever_its_slope(self):
        for normal in (unit(0, 0, 1), unit(0.4, -0.3, 1)):
            assert planarity_loss(wall(normal, 3.0), CAMERA, GREY, WHOLE) < 2e-3

    def test_bumps_cost_more_the_higher_they_are(self):
        losses = [float(planarity_loss(wall(unit(0.2, 0.1, 1), 3.0, bumps), CAMERA, GREY, WHOLE)) for bumps in (0, 0.03, 0.1)]
        assert losses[1] > 5 * losses[0]
        assert losses[2] > 1.5 * losses[1]

    def test_two_faces_may_meet_where_the_photo_has_an_edge(self):
        left, right = wall(unit(0.5, 0, 1), 3.0), wall(unit(-0.5, 0, 1), 3.0)
        roof = Splats.concatenate([left[left.means[:, 0] > 0], right[right.means[:, 0] <= 0]])
        two_tone = GREY.clone()
        two_tone[:, 32:] = 0.9
        plain, edged = (float(planarity_loss(roof, CAMERA, photo, WHOLE)) for photo in (GREY, two_tone))
        assert edged < 0.1 * plain

    def test_following_it_flattens_a_bumpy_wall(self):
        normal = unit(0.2, 0.1, 1)
        splats = wall(normal, 3.0, 0.05)
        means = splats.means.clone().requires_grad_()
        optimiser = torch.optim.Adam([means], lr=2e-3)
        rays = CAMERA.rays()[1]

        def error() -> float:
            """Standard deviation of the drawn surface from the wall's slope."""
            depth = 1 / (render_planes(replace(splats, means=means.detach()), CAMERA).planes * rays).sum(-1)
            return float(((rays * depth[..., None]) @ normal).std())

        before = error()
        for _ in range(60):
            optimiser.zero_grad()
            planarity_loss(replace(splats, means=means), CAMERA, GREY, WHOLE).backward()
            optimiser.step()
        assert error() < 0.5 * before

    def test_what_the_mask_leaves_out_does_not_count(self):
        assert planarity_loss(wall(unit(0.2, 0.1, 1), 3.0, 0.1), CAMERA, GREY, torch.zeros(64, 64)) == 0


def test_thickness_is_the_mean_of_the_shortest_axes():
    scales = torch.tensor([[0.1, 0.2, 0.3], [0.5, 0.4, 0.6]])
    splats = wall(unit(0, 0, 1), 3.0)[:2]
    assert float(thickness(replace(splats, log_scales=scales.log()))) == pytest.approx(0.25)

import math

import pytest
import torch
from torch import Tensor

from structuregs.fit.structure import (
    StructureWeights,
    contact_loss,
    coverage_loss,
    extent_loss,
    margin_loss,
    occupancy_loss,
    structure_images,
    structure_loss,
    union,
)
from structuregs.geometry import SE3, Box, Camera

F64 = torch.float64


def boxes_of(*rows: tuple[list[float], list[float]]) -> Box:
    """Boxes from rows of a pose's twist and half extents."""
    tangents, half_extents = (torch.tensor(column, dtype=F64) for column in zip(*rows, strict=True))
    return Box(SE3.exp(tangents), half_extents)


def aligned(*rows: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Box:
    return boxes_of(*(([*centre, 0.0, 0.0, 0.0], list(half)) for centre, half in rows))


def single(box: Box) -> Box:
    """The same in float32."""
    return Box(box.T_world_box.to(dtype=torch.float32), box.half_extents.float())


def camera_at(angle: float, height: float, size: int = 24, distance: float = 4.0) -> Camera:
    """Looks at the origin from a ring around the z axis."""
    outward = torch.tensor([math.cos(angle), math.sin(angle), height], dtype=F64)
    outward = outward / outward.norm()
    right = torch.linalg.cross(-outward, torch.tensor([0.0, 0, 1], dtype=F64))
    right = right / right.norm()
    R = torch.stack([right, torch.linalg.cross(-outward, right), -outward], 1)
    pose = SE3.from_rotation(R, distance * outward).to(dtype=torch.float32)
    return Camera(pose, 1.6 * size, 1.6 * size, size / 2, size / 2, size, size)


TWO = boxes_of(([0.1, -0.2, 0.0, 0.3, 0.2, -0.5], [0.5, 0.3, 0.2]), ([-0.3, 0.2, 0.1, -0.7, 0.4, 1.0], [0.3, 0.6, 0.08]))


def unit_rays(camera: Camera) -> tuple[Tensor, Tensor]:
    origin, rays = (t.to(F64) for t in camera.rays())
    return origin, torch.nn.functional.normalize(rays, dim=-1)


class TestStructureImages:
    def test_follow_the_chord_counted_by_points_along_the_ray(self):
        origin, rays = unit_rays(camera_at(0.7, 0.4))
        softness = 0.05
        t = torch.linspace(2, 6, 8001, dtype=F64)
        points = origin + rays[..., None, :] * t[:, None]
        images = structure_images(TWO, origin, rays, softness)
        for k in range(2):
            chord = TWO[k].contains(points).double().sum(-1) * (t[1] - t[0])
            hit = chord > 0.01
            scale = min(0.5 * float(TWO.half_extents[k].min()), softness)
            assert 20 < hit.sum() < hit.numel() - 20
            torch.testing.assert_close(images[k][hit], 1 - 0.5 * torch.exp(-chord[hit] / scale), atol=0.01, rtol=0)
            assert (images[k][chord == 0] <= 0.51).all()

    def test_are_a_half_on_the_outline(self):
        box = aligned(((0.0, 0, 0), (0.5, 0.5, 0.5)))
        diagonal = torch.tensor([[1.0, 1, 0]], dtype=F64) / math.sqrt(2)
        corner = torch.tensor([-0.5, 0.5, 0.0], dtype=F64)
        for side in (-1e-7, 1e-7):
            origin = corner - 2 * diagonal[0] + torch.tensor([side, -side, 0.0], dtype=F64)
            assert structure_images(box, origin, diagonal, 0.05).item() == pytest.approx(0.5, abs=1e-4)

    def test_tend_to_the_silhouette_as_the_softness_falls(self):
        origin, rays = unit_rays(camera_at(2.0, 0.3))
        sharp = structure_images(TWO, origin, rays, 1e-4)
        for k in range(2):
            enter, leave = TWO[k].intersect(origin, rays)
            clear = (leave - enter).abs() > 0.01
            torch.testing.assert_close(sharp[k][clear], (enter < leave).to(F64)[clear], atol=1e-6, rtol=0)

    def test_the_tail_falls_with_the_distance_of_a_miss(self):
        box = aligned(((0.0, 0, 0), (0.5, 0.5, 0.5)))
        diagonal = torch.tensor([1.0, 1, 0], dtype=F64) / math.sqrt(2)
        beside = torch.tensor([-0.5, 0.5, 0.0], dtype=F64) + torch.tensor([[-0.1, 0.1, 0], [-0.2, 0.2, 0]], dtype=F64)
        near, far = (structure_images(box, b - 2 * diagonal, diagonal[None], 0.3).item() for b in beside)
        # The slabs of x and y are 0.2 and 0.4 apart along their axes; the chord counts along the ray.
        assert near == pytest.approx(0.5 * math.exp(-0.2 * math.sqrt(2) / 0.3), rel=1e-6)
        assert far == pytest.approx(0.5 * math.exp(-0.4 * math.sqrt(2) / 0.3), rel=1e-6)

    def test_gradients_are_those_of_finite_differences(self):
        origin, rays = unit_rays(camera_at(0.7, 0.4, size=6))

        def images(tangent: Tensor, log_half: Tensor) -> Tensor:
            # The length scale of a hit is held constant; a wide box keeps it at the softness.
            return structure_images(Box(SE3.exp(tangent), log_half.exp()), origin, rays, 0.1)

        tangent = torch.tensor([[0.1, -0.2, 0.0, 0.3, 0.2, -0.5]], dtype=F64, requires_grad=True)
        log_half = torch.tensor([[0.5, 0.4, 0.3]], dtype=F64).log().requires_grad_()
        assert torch.autograd.gradcheck(images, (tangent, log_half))


class TestLosses:
    images = torch.tensor([[[0.5, 1.0], [0.0, 0.2]], [[0.5, 0.0], [0.0, 0.6]]], dtype=F64)
    mask = torch.tensor([[1.0, 1.0], [1.0, 0.0]], dtype=F64)

    def test_union_by_hand(self):
        torch.testing.assert_close(union(self.images), torch.tensor([[0.75, 1.0], [0.0, 0.68]], dtype=F64))

    def test_coverage_by_hand(self):
        assert coverage_loss(self.images, self.mask).item() == pytest.approx((0.25 + 0.0 + 1.0) / 4)

    def test_margin_by_hand(self):
        assert margin_loss(self.images, self.mask).item() == pytest.approx((0.2 + 0.6) / 4)

    def test_extent_by_hand(self):
        assert extent_loss(aligned(((0.0, 0, 0), (1.0, 2, 3)), ((5.0, 0, 0), (4.0, 5, 6)))).item() == pytest.approx(3.5)


class TestContact:
    base = ((0.0, 0.0, 0.0), (0.5, 0.5, 0.5))

    def test_is_the_gap_of_aligned_boxes(self):
        boxes = aligned(self.base, ((1.0, 0.1, 0.0), (0.2, 0.3, 0.3)))
        assert contact_loss(boxes).item() == pytest.approx(0.3, abs=1e-5)

    @pytest.mark.parametrize("x", [0.7, 0.6, 0.2, 0.0], ids=["touching", "overlapping", "inside", "same centre"])
    def test_is_zero_where_boxes_meet(self, x: float):
        assert contact_loss(aligned(self.base, ((x, 0.0, 0.0), (0.2, 0.3, 0.3)))).item() == pytest.approx(0, abs=1e-5)

    def test_counts_the_nearest_neighbour_of_each_moving_box(self):
        boxes = aligned(
            self.base, ((1.0, 0, 0), (0.2, 0.3, 0.3)), ((1.8, 0, 0), (0.2, 0.3, 0.3)), ((0.0, 5.0, 0), (0.5, 0.5, 0.5))
        )
        assert contact_loss(boxes).item() == pytest.approx((0.3 + 0.4 + 4.0) / 3, abs=1e-5)

    def test_a_rigid_motion_of_all_changes_nothing(self):
        boxes = aligned(self.base, ((1.1, 0.2, 0.0), (0.2, 0.1, 0.3)))
        T = SE3.exp(torch.tensor([0.3, -1.0, 2.0, 0.5, 1.0, -0.3], dtype=F64))
        assert contact_loss(boxes.moved(T)).item() == pytest.approx(contact_loss(boxes).item(), abs=1e-9)

    def test_nothing_moves_without_moving_boxes(self):
        assert contact_loss(aligned(self.base)).item() == 0

    def test_pulls_a_box_to_its_neighbour(self):
        x = torch.tensor(1.0, dtype=F64, requires_grad=True)
        pose = torch.stack([torch.zeros(3, dtype=F64), torch.stack([x, x * 0, x * 0])])
        quats = torch.tensor([[1.0, 0, 0, 0]] * 2, dtype=F64)
        contact_loss(Box(SE3.from_quat(quats, pose), torch.tensor([[0.5] * 3, [0.2] * 3], dtype=F64))).backward()
        assert x.grad is not None
        assert x.grad.item() == pytest.approx(1.0, abs=1e-5)


class TestStructureLoss:
    def test_is_the_weighted_sum_over_both_states(self):
        camera = camera_at(0.3, 0.5)
        g = torch.Generator().manual_seed(0)
        masks = (torch.rand(24, 24, generator=g), torch.rand(24, 24, generator=g))
        boxes = single(aligned(((0.0, 0, 0), (0.4, 0.3, 0.2)), ((0.9, 0, 0), (0.2, 0.2, 0.2))))
        motions = SE3.exp(torch.tensor([[0.0] * 6, [0.1, 0.2, 0.3, 0.2, 0.1, 0.4]]))
        weights = StructureWeights(coverage=3.0, margin=5.0, contact=7.0, extent=11.0)
        origin, rays = (t.float() for t in unit_rays(camera))
        parts, contacts = 0.0, 0.0
        for mask, posed in zip(masks, (boxes, boxes.moved(motions)), strict=True):
            images = structure_images(posed, origin, rays, 0.05)
            parts += 3 * float(coverage_loss(images, mask)) + 5 * float(margin_loss(images, mask))
            contacts += 7 * float(contact_loss(posed))
        tight = structure_loss(boxes, motions, (camera, camera), masks, weights, 0.05, loose=False)
        loose = structure_loss(boxes, motions, (camera, camera), masks, weights, 0.05, loose=True)
        assert tight.item() == pytest.approx(parts, rel=1e-5)
        assert loose.item() == pytest.approx(parts + contacts + 11 * float(extent_loss(boxes)), rel=1e-5)

    @pytest.mark.parametrize("count", [1, 2, 5])
    def test_the_kernel_is_the_torch_loss_in_value_and_gradient(self, count: int):
        generator = torch.Generator().manual_seed(count)
        tangents = 0.4 * torch.randn(count, 6, generator=generator, dtype=F64)
        half_extents = 0.2 + 0.4 * torch.rand(count, 3, generator=generator, dtype=F64)
        camera, mask = camera_at(0.7, 0.3, 40), (torch.rand(40, 40, generator=generator) > 0.4).to(F64)
        origin, rays = unit_rays(camera)
        results = []
        for dtype in (torch.float32, F64):
            leaves = [value.to(dtype).requires_grad_() for value in (tangents, half_extents)]
            boxes = Box(SE3.exp(leaves[0]), leaves[1])
            loss = occupancy_loss(boxes, origin.to(dtype), rays.to(dtype), mask.to(dtype), StructureWeights(), 0.05)
            (3 * loss).backward()
            results.append((loss, leaves[0].grad, leaves[1].grad))
        for fast, exact in zip(*results, strict=True):
            assert (fast - exact).norm() <= 1e-3 * exact.norm()

    def test_the_weights_are_the_supplement_s(self):
        assert StructureWeights() == StructureWeights(coverage=100.0, margin=50.0, contact=0.1, extent=0.01)

    def test_alone_they_fit_a_box_to_the_masks_of_a_known_one(self):
        true = boxes_of(([0.1, -0.15, 0.05, 0.2, -0.1, 0.3], [0.6, 0.35, 0.2]))
        cameras = [camera_at(2.4 * i, -0.6 + 0.15 * i) for i in range(10)]
        masks = []
        for camera in cameras:
            enter, leave = true.intersect(*unit_rays(camera.resized(96, 96)))
            masks.append((enter < leave).float().reshape(24, 4, 24, 4).mean((1, 3)))
        tangent = torch.tensor([[0.0, 0.0, 0, 0, 0, 0.05]], requires_grad=True)
        log_half = torch.full((1, 3), 0.4).log().requires_grad_()
        optimiser = torch.optim.Adam([tangent, log_half], lr=2e-2)
        still = SE3.identity(1)
        for step in range(300):
            optimiser.param_groups[0]["lr"] = 2e-2 * 0.05 ** (step / 300)
            i, j = step % 10, (3 * step + 1) % 10
            box = Box(SE3.exp(tangent), log_half.exp())
            loss = structure_loss(
                box, still, (cameras[i], cameras[j]), (masks[i], masks[j]), StructureWeights(), 0.02, loose=True
            )
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        found = Box(SE3.exp(tangent.detach().to(F64)), log_half.detach().to(F64).exp())
        torch.testing.assert_close(found.T_world_box.xyz, true.T_world_box.xyz, atol=0.015, rtol=0)
        torch.testing.assert_close(found.half_extents, true.half_extents, atol=0.02, rtol=0)
        error = (true.T_world_box.inverse() @ found.T_world_box).angle
        assert math.degrees(error.item()) < 2

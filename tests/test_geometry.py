import math

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from structuregs.geometry import SE3, Box, Camera, Screw, quat_multiply, screw_of_motion

D = torch.float64
ANGLES = [0.0, 1e-9, 1e-4, 0.999e-3, 1.001e-3, 0.3, 2.0, math.pi - 1e-4, math.pi - 1e-9]


def normal(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=D)


def twist(angle: float, seed: int = 0) -> torch.Tensor:
    v, omega = normal(seed, 2, 3)
    return torch.cat([v, angle * omega / omega.norm()])


def random_motion(seed: int, *batch: int) -> SE3:
    values = normal(seed, *batch, 7)
    return SE3.from_quat(values[..., :4], values[..., 4:])


def close(a: SE3, b: SE3, tolerance: float = 1e-12) -> bool:
    return torch.allclose(a.as_matrix(), b.as_matrix(), rtol=0, atol=tolerance)


def test_group_axioms():
    a, b, c = (random_motion(seed, 4) for seed in range(3))
    one = SE3.identity(4, dtype=D)
    assert close((a @ b) @ c, a @ (b @ c))
    assert close(a @ one, a)
    assert close(one @ a, a)
    assert close(a @ a.inverse(), one)
    assert close(a.inverse() @ a, one)
    assert close((a @ b).inverse(), b.inverse() @ a.inverse())


def test_composition_and_application_are_those_of_the_matrices():
    a, b, points = random_motion(0, 5), random_motion(1, 5), normal(2, 5, 3)
    assert torch.allclose((a @ b).as_matrix(), a.as_matrix() @ b.as_matrix())
    ones = torch.cat([points, torch.ones(5, 1, dtype=D)], -1)
    assert torch.allclose(a.apply(points), (a.as_matrix() @ ones[..., None])[:, :3, 0])


def test_quaternions_against_scipy():
    a, b = normal(0, 4), normal(1, 4)
    theirs = Rotation.from_quat(a.numpy(), scalar_first=True) * Rotation.from_quat(b.numpy(), scalar_first=True)
    ours = SE3.from_quat(quat_multiply(a, b), torch.zeros(3, dtype=D))
    assert np.allclose(ours.rotation.numpy(), theirs.as_matrix())


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential(angle):
    tangent = twist(angle)
    x, y, z = tangent[3:].tolist()
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generator[:3, 3] = tangent[:3].numpy()
    assert np.allclose(SE3.exp(tangent).as_matrix().numpy(), expm(generator), rtol=0, atol=1e-12)


@pytest.mark.parametrize("angle", [*ANGLES, math.pi])
def test_log_undoes_exp(angle):
    tangent = twist(angle)
    back = SE3.exp(tangent).log()
    if angle < math.pi - 1e-6:
        assert torch.allclose(back, tangent, rtol=0, atol=1e-9)
    assert close(SE3.exp(back), SE3.exp(tangent), 1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.9e-3, 1.1e-3, 1.0, math.pi - 1e-3])
def test_gradients_of_exp_and_log_against_finite_differences(angle):
    tangent = twist(angle).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: SE3.exp(t).as_matrix(), tangent, atol=1e-6)
    assert torch.autograd.gradcheck(lambda t: SE3.exp(t).log(), tangent, atol=1e-5)


@pytest.mark.parametrize("angle", ANGLES)
def test_angle_is_that_of_the_twist_and_blind_to_the_quaternions_sign(angle):
    T = SE3.exp(twist(angle))
    assert float(T.angle) == pytest.approx(angle, abs=1e-12)
    assert float(SE3.from_quat(-T.wxyz, T.xyz).angle) == pytest.approx(angle, abs=1e-12)


def test_matrices_come_back_also_after_half_turns():
    for axis in (*torch.eye(3, dtype=D), normal(3, 3)):
        T = SE3.exp(torch.cat([normal(1, 3), math.pi * axis / axis.norm()]))
        assert close(SE3.from_matrix(T.as_matrix()), T, 1e-9)
    T = random_motion(5, 50)
    assert close(SE3.from_matrix(T.as_matrix()), T)


@pytest.mark.parametrize("q", [1e-6, 0.3, 3.0])
@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_screw_comes_back_from_its_motion(kind, q):
    axis = normal(0, 3)
    screw = Screw(kind, axis / axis.norm(), normal(1, 3))
    found, amount = screw_of_motion(screw.motion(q), kind)
    assert amount == pytest.approx(q, rel=1e-6)
    assert torch.allclose(found.axis, screw.axis, atol=1e-8)
    assert close(found.motion(amount), screw.motion(q), 1e-9)


def test_points_of_the_axis_stay_and_others_keep_their_distance():
    screw = Screw("revolute", torch.tensor([0.0, 0.6, 0.8], dtype=D), normal(1, 3))
    T, point = screw.motion(1.2), normal(2, 3)
    assert torch.allclose(T.apply(screw.origin + 3 * screw.axis), screw.origin + 3 * screw.axis)
    assert torch.dist(T.apply(point), screw.origin) == pytest.approx(float(torch.dist(point, screw.origin)))


def test_pivot_is_the_minimum_norm_least_squares_solution():
    """Of (R - I) p = -t, as the supplement has it (1.4), by numpy's solver."""
    for seed in range(5):
        T = random_motion(seed)
        pivot = np.linalg.lstsq((T.rotation - torch.eye(3, dtype=D)).numpy(), -T.xyz.numpy(), rcond=1e-9)[0]
        assert np.allclose(screw_of_motion(T, "revolute")[0].origin.numpy(), pivot, atol=1e-9)


def test_pivot_of_a_float32_half_turn():
    """The angle pi in float32 lies above pi: its cotangent must stay near zero."""
    T = SE3(torch.tensor([0.0, 0, 0, 1, 2, 4, 0]))
    screw, q = screw_of_motion(T, "revolute")
    assert q == pytest.approx(math.pi, abs=1e-6)
    assert torch.allclose(screw.origin, torch.tensor([1.0, 2, 0]), atol=1e-5)


def tilted_box() -> Box:
    return Box(random_motion(7), torch.tensor([0.5, 0.3, 0.2], dtype=D))


def test_canonical_coordinates_go_there_and_back():
    box, canonical = tilted_box(), normal(0, 6, 3)
    world = box.to_world(canonical)
    assert torch.allclose(box.to_canonical(world), canonical)
    assert torch.equal(box.contains(world), (canonical.abs() <= 1).all(-1))
    assert torch.allclose(box.to_world(torch.zeros(1, 3, dtype=D))[0], box.T_world_box.xyz)


def test_contains_grows_by_the_margin():
    box = Box(SE3.identity(), torch.tensor([1.0, 2, 3]))
    points = torch.tensor([[1.05, 0, 0], [0, 0, 3.2]])
    assert box.contains(points).tolist() == [False, False]
    assert box.contains(points, margin=0.1).tolist() == [True, False]


def test_corners_and_edges():
    box = tilted_box()
    canonical = box.to_canonical(box.corners)
    assert torch.allclose(canonical.abs(), torch.ones(8, 3, dtype=D))
    for i in range(8):
        assert [bool(v > 0) for v in canonical[i]] == [bool(i >> b & 1) for b in range(3)]
    lengths, counts = (box.edges[:, 0] - box.edges[:, 1]).norm(dim=-1).sort().values, (0.4, 0.6, 1.0)
    assert torch.allclose(lengths, torch.tensor(counts, dtype=D).repeat_interleave(4))
    assert float(box.volume) == pytest.approx(0.4 * 0.6 * 1.0)


def test_moved_box_holds_the_moved_points():
    box, T = tilted_box(), random_motion(3)
    points = box.to_world(torch.rand(10, 3, dtype=D) * 2 - 1)
    assert torch.allclose(box.moved(T).to_canonical(T.apply(points)), box.to_canonical(points))


def test_box_around_points_touches_them_on_every_side():
    R, points = random_motion(1).rotation, normal(2, 40, 3)
    canonical = Box.around(points, R).to_canonical(points)
    assert torch.allclose(canonical.amax(0), torch.ones(3, dtype=D))
    assert torch.allclose(canonical.amin(0), -torch.ones(3, dtype=D))


def test_intersect_of_an_axis_parallel_ray():
    box = Box(SE3.from_quat(torch.tensor([1.0, 0, 0, 0]), torch.tensor([0.0, 0, 5])), torch.tensor([1.0, 1, 2]))
    entry, leave = box.intersect(torch.zeros(3), torch.tensor([0.0, 0, 1]))
    assert (float(entry), float(leave)) == pytest.approx((3, 7))
    entry, leave = box.intersect(torch.tensor([1.5, 0, 0]), torch.tensor([0.0, 0, 1]))
    assert entry > leave


def test_intersect_finds_the_canonical_boundary_on_any_ray():
    """Through two points on faces of a tilted box, the ray's parameters there are 0 and 1."""
    box = tilted_box()
    canonical = torch.rand(2, 20, 3, dtype=D) * 1.8 - 0.9
    canonical[0, :, 0], canonical[1, :, 2] = -1, 1
    start, stop = box.to_world(canonical[0]), box.to_world(canonical[1])
    entry, leave = box.intersect(start, stop - start)
    assert torch.allclose(entry, torch.zeros(20, dtype=D), atol=1e-9)
    assert torch.allclose(leave, torch.ones(20, dtype=D))


def camera() -> Camera:
    return Camera(random_motion(4).to(dtype=torch.float32), 120.0, 130.0, 31.0, 25.5, 64, 48)


def test_projecting_a_rays_points_gives_its_pixel_and_depth():
    view = camera()
    origin, directions = view.rays()
    depth = torch.rand(48, 64) * 3 + 0.5
    pixels, z = view.project(origin + depth[..., None] * directions)
    assert directions.shape == (48, 64, 3)
    assert torch.allclose(z, depth, atol=1e-5)
    assert torch.allclose(pixels[..., 0], (torch.arange(64) + 0.5).expand(48, 64), atol=1e-3)
    assert torch.allclose(pixels[..., 1], (torch.arange(48)[:, None] + 0.5).expand(48, 64), atol=1e-3)


def test_projection_of_a_hand_made_camera():
    """At the origin, looking along +z: x right, y down; a point right of and below the axis lands right and below."""
    view = Camera(SE3.identity(), 100.0, 100.0, 50.0, 40.0, 100, 80)
    pixels, z = view.project(torch.tensor([[0.2, 0.1, 2.0], [0, 0, -1.0]]))
    assert pixels[0].tolist() == pytest.approx([60, 45])
    assert z.tolist() == [2, -1]
    half, _ = view.resized(50, 40).project(torch.tensor([[0.2, 0.1, 2.0]]))
    assert half[0].tolist() == pytest.approx([30, 22.5])
    assert torch.equal(view.K @ torch.tensor([0.0, 0, 1]), torch.tensor([50.0, 40, 1]))


def test_a_turned_camera_stays_where_it_is_and_looks_elsewhere():
    """Turned to the right (about y, down) by an angle: what lay there at infinity is on the axis now."""
    view, angle = camera(), 0.3
    turned = view.turned(torch.tensor([0.0, angle, 0.0]))
    assert torch.equal(turned.centre, view.centre)
    R = view.T_world_camera.rotation
    aside = R @ torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    pixels, _ = turned.project(view.centre + 1000 * aside)
    assert pixels.tolist() == pytest.approx([view.cx, view.cy], abs=0.02)


def test_a_shifted_camera_shows_all_points_beside_by_as_many_focal_lengths_in_any_size():
    view, offset = camera(), torch.tensor([0.02, -0.01])
    points = torch.tensor([[0.2, 0.1, 2.0], [-0.4, 0.3, 5.0]])
    for size in ((view.width, view.height), (50, 40)):
        before = view.resized(*size)
        moved = view.shifted(offset).resized(*size).project(points)[0] - before.project(points)[0]
        torch.testing.assert_close(moved, (offset * torch.tensor([before.fx, before.fy])).expand(2, 2), atol=1e-4, rtol=0)


def test_directions_are_the_rays_in_the_camera_s_frame():
    view = camera()
    _, rays = view.rays()
    torch.testing.assert_close(view.directions() @ view.T_world_camera.rotation.T, rays)
    pixel = torch.tensor([[view.cx + view.fx, view.cy - 2 * view.fy]])
    torch.testing.assert_close(view.directions(pixel), torch.tensor([[1.0, -2.0, 1.0]]))

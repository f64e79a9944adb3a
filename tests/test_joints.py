import math

import pytest
import torch

from structuregs.geometry import SE3, Box, Screw
from structuregs.joints import articulate, constrain, joints_of, kind_of, screw_at
from structuregs.metrics import axis_angle_deg, axis_position
from structuregs.model import PosedParts, Splats


def random_pose(seed: int, dtype=torch.float64) -> SE3:
    g = torch.Generator().manual_seed(seed)
    return SE3.from_quat(torch.randn(4, generator=g, dtype=dtype), torch.randn(3, generator=g, dtype=dtype))


def unit(*values: float) -> torch.Tensor:
    v = torch.tensor(values, dtype=torch.float64)
    return v / v.norm()


def posed(motion: SE3, splats: int = 500, dtype=torch.float64, centre=(0.4, -0.2, 0.7)) -> PosedParts:
    """A base and one part of half extents (.3, .2, .05) at `centre`, moved by `motion`."""
    pose = SE3.from_quat(torch.tensor([0.9, 0.1, -0.3, 0.2], dtype=torch.float64), torch.tensor(centre, dtype=torch.float64))
    poses = torch.stack([SE3.identity(dtype=torch.float64).wxyz_xyz, pose.wxyz_xyz])
    boxes = Box(SE3(poses.to(dtype)), torch.tensor([[0.5, 0.5, 0.5], [0.3, 0.2, 0.05]], dtype=dtype))
    motions = torch.stack([SE3.identity(dtype=torch.float64).wxyz_xyz, motion.wxyz_xyz]).to(dtype)
    n = 2 * splats
    cloud = Splats(
        torch.zeros(n, 3, dtype=dtype),
        torch.tensor([[1.0, 0, 0, 0]], dtype=dtype).repeat(n, 1),
        torch.zeros(n, 3, dtype=dtype),
        torch.full((n,), 4.0, dtype=dtype),
        torch.zeros(n, 1, 3, dtype=dtype),
    )
    return PosedParts(boxes, SE3(motions), cloud, (splats, splats), torch.zeros(n, 3, dtype=dtype))


def hinge(degrees: float) -> tuple[Screw, SE3]:
    """A hinge that runs along an edge of the part of `posed`."""
    screw = Screw("revolute", unit(0.2, 0.3, 1), torch.tensor([0.4, 0.1, 0.5], dtype=torch.float64))
    return screw, screw.motion(math.radians(degrees))


@pytest.mark.parametrize("degrees", [5.1, 20, 90, 179.99, 180])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 2e-3)])
def test_a_clean_turn_comes_back(degrees, dtype, tolerance):
    screw, motion = hinge(degrees)
    (joint,) = joints_of(posed(motion, dtype=dtype))
    axis, origin = joint.screw.axis, joint.screw.origin
    assert joint.kind == "revolute"
    assert joint.q[0] == 0
    assert joint.q[1] == pytest.approx(math.radians(degrees), abs=tolerance)
    assert axis_angle_deg(axis, screw.axis) < math.degrees(tolerance)
    assert axis_position(origin, axis, screw.origin, screw.axis) < tolerance


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-6)])
def test_a_clean_slide_comes_back_drawn_at_the_part(dtype, tolerance):
    axis = unit(1, -2, 0.5)
    (joint,) = joints_of(posed(Screw("prismatic", axis, torch.zeros(3, dtype=torch.float64)).motion(0.3), dtype=dtype))
    assert joint.kind == "prismatic"
    assert joint.q[1] == pytest.approx(0.3, abs=tolerance)
    assert torch.allclose(joint.screw.axis, axis, atol=10 * tolerance)
    assert joint.origin == pytest.approx((0.4, -0.2, 0.7), abs=tolerance)
    assert joint.confidence > 0.99
    assert not joint.review


def test_the_type_changes_at_five_degrees():
    assert kind_of(hinge(4.999)[1]) == "prismatic"
    assert kind_of(hinge(5.001)[1]) == "revolute"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 0, -1), (1, 2, -2)])
def test_half_a_turn_has_its_pivot_half_way(axis, dtype):
    """By 180 degrees every point goes to its mirror image: the pivot is the mean of a point's two places."""
    across = torch.linalg.cross(unit(*axis), unit(0.3, 0.5, 0.7)) * 2
    motion = SE3.from_quat(torch.cat([torch.zeros(1, dtype=torch.float64), unit(*axis)]), 2 * across).to(dtype=dtype)
    screw, q = screw_at(motion, "revolute", torch.zeros(3, dtype=dtype))
    assert q == pytest.approx(math.pi, abs=1e-6)
    assert torch.allclose(screw.origin, across, atol=1e-6)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_joints_turn_with_the_world(kind):
    """The joint of the moved object is the moved joint: axis, the point that it is drawn at, amount and confidence."""
    noise = SE3.exp(torch.tensor([0.01, -0.02, 0.015, 0.02, 0.01, -0.015], dtype=torch.float64))
    parts = posed(noise @ (hinge(40)[1] if kind == "revolute" else SE3.exp(unit(1, 0, 0, 0, 0, 0) * 0.4)))
    (joint,) = joints_of(parts)
    assert joint.kind == kind
    for seed in range(5):
        T = random_pose(seed)
        moved = PosedParts(parts.boxes.moved(T), T @ parts.motions @ T.inverse(), parts.splats, parts.counts, parts.tint)
        (other,) = joints_of(moved)
        assert other.kind == kind
        assert torch.allclose(other.screw.axis, T.rotation @ joint.screw.axis, atol=1e-9)
        assert torch.allclose(other.screw.origin, T.apply(joint.screw.origin), atol=1e-9)
        assert other.q == pytest.approx(joint.q)
        assert other.confidence == pytest.approx(joint.confidence)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_constrain_keeps_clean_motions_and_is_idempotent(kind):
    centre = torch.tensor([1.0, 2, 3], dtype=torch.float64)
    screw = Screw(kind, unit(3, 1, 2), unit(1, 1, 0))
    clean = screw.motion(0.4)
    assert torch.allclose(constrain(clean, kind, centre).as_matrix(), clean.as_matrix(), atol=1e-12)
    noisy = SE3.exp(torch.tensor([0.01, -0.02, 0.015, 0.02, 0.01, -0.015], dtype=torch.float64)) @ clean
    once = constrain(noisy, kind, centre)
    assert torch.allclose(constrain(once, kind, centre).as_matrix(), once.as_matrix(), atol=1e-12)


def test_constrain_drops_only_the_slide_along_the_axis():
    screw, motion = hinge(50)
    spiral = SE3.from_quat(motion.wxyz, motion.xyz + 0.2 * screw.axis)
    centre = torch.tensor([0.4, -0.2, 0.7], dtype=torch.float64)
    assert torch.allclose(constrain(spiral, "revolute", centre).as_matrix(), motion.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("motion", [hinge(70)[1], SE3.exp(unit(1, 2, 0, 0, 0, 0) * 0.3)])
def test_the_object_in_state_1_is_the_parts_in_state_1(motion):
    noise = SE3.exp(torch.tensor([0.01, -0.02, 0.015, 0.02, 0.01, -0.015], dtype=torch.float64))
    obj = articulate(posed(noise @ motion, dtype=torch.float32))
    q1 = [joint.q[1] for joint in obj.joints]
    assert torch.allclose(obj.joints[0].motion(q1[0]).as_matrix().float(), obj.parts.motions[1].as_matrix(), atol=1e-6)
    assert torch.allclose(obj.at(q1).means, obj.parts.at_state(1).means, atol=1e-6)
    assert torch.allclose(obj.at([0.0]).means, obj.parts.at_state(0).means, atol=1e-6)


def test_settled_kinds_overrule_the_rule():
    (joint,) = joints_of(posed(hinge(4)[1]), kinds=("revolute",))
    assert joint.kind == "revolute"
    assert joint.q[1] == pytest.approx(math.radians(4))


def test_a_clear_door_needs_no_review():
    (joint,) = joints_of(posed(hinge(60)[1]))
    assert joint.confidence > 0.99
    assert joint.review == ""


def test_small_doubts_add_up():
    """Two scores of .8, of the type and of the splats: either alone passes, both ask for a look."""
    turn = hinge(5 * 3**0.8)[1]
    one, other, both = (joints_of(posed(T, splats=n))[0] for T, n in ((turn, 200), (hinge(60)[1], 80), (turn, 80)))
    assert not one.review
    assert not other.review
    assert both.confidence == pytest.approx(one.confidence * other.confidence, abs=0.02)
    assert both.review


def test_review_names_the_doubt():
    screw, turn = hinge(60)
    far = Screw("revolute", screw.axis, torch.tensor([0.0, 3, 0], dtype=torch.float64)).motion(math.radians(20))
    doubtful = {
        "near the 5": posed(hinge(6)[1]),
        "moves only": posed(SE3.exp(unit(1, 0, 0, 0, 0, 0) * 0.005)),
        "also slides": posed(SE3.from_quat(turn.wxyz, turn.xyz + 0.2 * screw.axis)),
        "away from a part": posed(far),
        "opaque splats": posed(turn, splats=10),
    }
    for words, parts in doubtful.items():
        (joint,) = joints_of(parts)
        assert words in joint.review
        assert joint.confidence < 0.5

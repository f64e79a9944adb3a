import json

import numpy as np
import pytest
import torch

from structuregs.geometry import SE3, Box
from structuregs.joints import articulate
from structuregs.model import SH_C0, ArticulatedObject, Joint, PosedParts, Splats, load_object, save_object
from structuregs.model.place import placed
from structuregs.model.sh import rotate_sh, sh_basis


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_splats(n: int, degree: int = 0, seed: int = 0) -> Splats:
    g = generator(seed)
    return Splats(
        torch.rand(n, 3, generator=g) * 2 - 1,
        torch.randn(n, 4, generator=g),
        torch.randn(n, 3, generator=g) - 3,
        torch.randn(n, generator=g),
        torch.randn(n, (degree + 1) ** 2, 3, generator=g),
    )


def two_parts(degree: int = 0) -> PosedParts:
    g = generator(1)
    poses = SE3.from_quat(torch.randn(2, 4, generator=g), torch.randn(2, 3, generator=g))
    turn = SE3.exp(torch.tensor([0.1, -0.2, 0.0, 0.0, 0.3, 0.9]))
    motions = SE3(torch.stack([SE3.identity().wxyz_xyz, turn.wxyz_xyz]))
    boxes = Box(poses, torch.tensor([[1.0, 0.5, 0.7], [0.4, 0.3, 0.1]]))
    return PosedParts(boxes, motions, random_splats(12, degree), (7, 5), torch.randn(12, 3, generator=g) * 0.1)


def directions(n: int = 20) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(n, 3, generator=generator(2), dtype=torch.float64), dim=-1)


def covariances(splats: Splats) -> torch.Tensor:
    R = SE3.from_quat(splats.quats, splats.means).rotation
    return R @ torch.diag_embed(splats.scales**2) @ R.transpose(-1, -2)


def test_basis_is_orthonormal_on_the_sphere():
    """By Gauss quadrature: the 16 functions up to degree 3 integrate to the identity."""
    nodes, weights = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(8))
    phi = torch.arange(16, dtype=torch.float64) * (2 * torch.pi / 16)
    z, p = torch.meshgrid(nodes, phi, indexing="ij")
    r = (1 - z * z).sqrt()
    basis = sh_basis(torch.stack([r * p.cos(), r * p.sin(), z], -1), 3).reshape(-1, 16)
    weight = (weights[:, None] * (2 * torch.pi / 16)).expand(8, 16).reshape(-1, 1)
    assert torch.allclose(basis.T @ (weight * basis), torch.eye(16, dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_harmonics_have_the_colours_of_directions_turned_back(degree):
    sh = torch.randn(6, (degree + 1) ** 2, 3, generator=generator(0), dtype=torch.float64)
    R = SE3.exp(torch.tensor([0, 0, 0, 0.4, -1.1, 2.0], dtype=torch.float64)).rotation
    turned = torch.einsum("dc,nck->ndk", sh_basis(directions(), degree), rotate_sh(sh, R))
    expected = torch.einsum("dc,nck->ndk", sh_basis(directions() @ R, degree), sh)
    assert torch.allclose(turned, expected, atol=1e-10)


def test_the_kernel_that_poses_splats_is_plain_torch_in_value_and_every_gradient():
    g = generator(4)
    counts = (3000, 1, 1500)  # more than a block, one splat, and part of a block
    shapes = ((4501, 3), (4501, 4), (3, 3, 3), (3, 7))
    inputs = [torch.randn(shape, generator=g, dtype=torch.float64) for shape in shapes]
    weights = [torch.randn(shape, generator=g, dtype=torch.float64) for shape in shapes[:2]]
    found = []
    for dtype in (torch.float32, torch.float64):
        leaves = [value.to(dtype).clone().requires_grad_() for value in inputs]
        outputs = placed(leaves[0], leaves[1], counts, leaves[2], SE3(leaves[3]))
        sum((o * w.to(dtype)).sum() for o, w in zip(outputs, weights, strict=True)).backward()
        found.append([*(o.detach() for o in outputs), *(leaf.grad for leaf in leaves)])
    for fast, exact in zip(*found, strict=True):
        torch.testing.assert_close(fast.double(), exact, rtol=1e-5, atol=1e-5 * float(exact.abs().max()))


@pytest.mark.parametrize("degree", [0, 2])
def test_state_1_is_state_0_moved_by_the_parts_motions(degree):
    parts = two_parts(degree)
    before, after = parts.at_state(0), parts.at_state(1)
    assert torch.equal(parts.part, torch.tensor([0] * 7 + [1] * 5))
    moves = parts.motions[parts.part]
    R = moves.rotation
    assert torch.allclose(after.means, moves.apply(before.means), atol=1e-5)
    assert torch.allclose(covariances(after), R @ covariances(before) @ R.transpose(-1, -2), atol=1e-5)
    turned = torch.cat([rotate_sh(before.sh[i : i + 1], R[i]) for i in range(len(before))])
    turned[:, 0] += parts.tint / SH_C0
    assert torch.allclose(after.sh, turned, atol=1e-4)


def test_splats_in_the_canonical_cube_lie_in_the_parts_box():
    parts = two_parts()
    for state, boxes in enumerate((parts.boxes, parts.boxes.moved(parts.motions))):
        means = parts.at_state(state).means.split(parts.counts)
        assert all(boxes[k].contains(mean, margin=1e-5).all() for k, mean in enumerate(means))


def test_tint_is_split_evenly_between_the_states():
    parts = two_parts()
    assert torch.allclose(parts.at_state(1).base_rgb - parts.at_state(0).base_rgb, parts.tint, atol=1e-6)
    middle = (parts.at_state(0).base_rgb + parts.at_state(1).base_rgb) / 2
    assert torch.allclose(middle, parts.splats.base_rgb, atol=1e-6)


def test_object_at_its_joints_values_is_the_parts_in_that_state():
    obj = articulate(two_parts(degree=1))
    for state in (0, 1):
        swept, posed = obj.at([joint.q[state] for joint in obj.joints]), obj.parts.at_state(state)
        for name, value in posed.tensors().items():
            assert torch.allclose(swept.tensors()[name].abs(), value.abs(), atol=1e-4), name


def test_object_half_way_has_turned_half_the_angle():
    obj = articulate(two_parts())
    (whole,) = obj.motions([obj.joints[0].q[1]])
    (half,) = obj.motions([obj.joints[0].q[1] / 2])
    assert torch.allclose((half @ half).as_matrix(), whole.as_matrix(), atol=1e-9)


def test_wrong_number_of_joint_values_is_a_sentence():
    with pytest.raises(ValueError, match="2 joint values for an object with 1 joints; give one per joint"):
        articulate(two_parts()).motions([0.0, 1.0])


def test_objects_come_back_from_their_folder_and_are_written_as_the_same_bytes(tmp_path):
    obj = articulate(two_parts(degree=2))
    save_object(obj, tmp_path / "a")
    back = load_object(tmp_path / "a")
    assert back.joints == obj.joints
    assert back.parts.counts == obj.parts.counts
    for name, value in obj.parts.splats.tensors().items():
        assert torch.equal(back.parts.splats.tensors()[name], value)
    save_object(back, tmp_path / "b")
    for name in ("object.json", "splats.safetensors"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert {p.name for p in (tmp_path / "a").iterdir()} == {"object.json", "splats.safetensors"}


def saved(folder) -> ArticulatedObject:
    obj = articulate(two_parts())
    save_object(obj, folder)
    return obj


def test_a_folder_without_object_is_a_sentence(tmp_path):
    with pytest.raises(ValueError, match=r"no object here \(object.json is missing\); run `structuregs fit` first"):
        load_object(tmp_path)
    saved(tmp_path)
    (tmp_path / "splats.safetensors").unlink()
    with pytest.raises(ValueError, match=r"splats\.safetensors is missing"):
        load_object(tmp_path)


def test_damaged_files_are_a_sentence(tmp_path):
    for name in ("object.json", "splats.safetensors"):
        saved(tmp_path)
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: len(data) // 2])
        with pytest.raises(ValueError, match="damaged"):
            load_object(tmp_path)


def test_another_version_is_refused(tmp_path):
    saved(tmp_path)
    record = json.loads((tmp_path / "object.json").read_text())
    (tmp_path / "object.json").write_text(json.dumps(record | {"version": 99}))
    with pytest.raises(ValueError, match="structuregs-object 99, but this version reads structuregs-object 1"):
        load_object(tmp_path)


@pytest.mark.parametrize("key", ["parts", "joints"])
def test_a_record_without_its_rows_is_a_sentence(tmp_path, key):
    saved(tmp_path)
    record = json.loads((tmp_path / "object.json").read_text())
    del record[key]
    (tmp_path / "object.json").write_text(json.dumps(record))
    with pytest.raises(ValueError, match="damaged"):
        load_object(tmp_path)


def test_joint_motion_at_zero_is_no_motion():
    joint = Joint("revolute", 0, (0.0, 0.6, 0.8), (1.0, 2.0, 3.0), (0.0, 1.0))
    assert torch.allclose(joint.motion(0.0).as_matrix(), torch.eye(4, dtype=torch.float64), atol=1e-15)


def test_splats_are_selected_and_joined_row_by_row():
    splats = random_splats(6, degree=1)
    joined = Splats.concatenate([splats[:2], splats[torch.tensor([2, 3, 4, 5])]])
    assert all(torch.equal(value, splats.tensors()[name]) for name, value in joined.tensors().items())
    assert torch.allclose(splats.base_rgb, 0.5 + 0.28209479177387814 * splats.sh[:, 0])

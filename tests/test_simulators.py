import math
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from door_and_drawer import made_of
from structuregs.export.links import GRAVITY, Mechanism, convex_pieces, inertia_of, mechanism_of
from structuregs.export.mjcf import export_mjcf, write_mjcf
from structuregs.export.urdf import export_urdf, write_urdf
from structuregs.export.usd import export_usd, write_usd
from structuregs.geometry import SE3, Screw
from structuregs.model import ArticulatedObject

coacd = pytest.importorskip("coacd")

SCALE = 0.8
MARGIN = 0.05


def screw(kind: str, axis: tuple[float, ...], origin: tuple[float, ...]) -> Screw:
    direction = torch.tensor(axis, dtype=torch.float64)
    return Screw(kind, direction / direction.norm(), torch.tensor(origin, dtype=torch.float64))


def made() -> ArticulatedObject:
    """A base, a door and a drawer, neither along the world's axes."""
    door = screw("revolute", (0.2, -0.1, 1.0), (1.0, 0.1, 0.3)).motion(1.1)
    drawer = screw("prismatic", (0.3, -1.0, 0.15), (0.0, 0.0, 0.0)).motion(0.4)
    return made_of(door, drawer)


def boxes_of(obj: ArticulatedObject) -> list[trimesh.Trimesh]:
    """The parts' boxes as coloured meshes."""
    meshes = []
    for k in range(len(obj.parts)):
        pose = obj.parts.boxes[k].T_world_box.as_matrix().double().numpy()
        mesh = trimesh.creation.box(extents=2 * obj.parts.boxes.half_extents[k].double().numpy(), transform=pose)
        mesh.visual.vertex_colors = np.tile(np.uint8([200, 60 * k, 50, 255]), (len(mesh.vertices), 1))
        meshes.append(mesh)
    return meshes


@pytest.fixture(scope="module")
def obj() -> ArticulatedObject:
    return made()


@pytest.fixture(scope="module")
def mechanism(obj) -> Mechanism:
    return mechanism_of(obj, boxes_of(obj), scale=SCALE, limit_margin=MARGIN)


@pytest.fixture(scope="module")
def values(mechanism) -> np.ndarray:
    """20 random values of each joint, in radians and metres."""
    low, high = (np.array([getattr(j, end) for j in mechanism.joints]) for end in ("lower", "upper"))
    return np.random.default_rng(0).uniform(low, high, (20, len(mechanism.joints)))


def expected(obj: ArticulatedObject, q: np.ndarray) -> list[np.ndarray]:
    """Poses of the moving links by the object's own motions, from joint values in radians and metres."""
    own = [value / (SCALE if joint.kind == "prismatic" else 1) for value, joint in zip(q.tolist(), obj.joints, strict=True)]
    poses = []
    for motion, joint in zip(obj.motions(own), obj.joints, strict=True):
        pose = motion.as_matrix().numpy() @ trimesh.transformations.translation_matrix(joint.origin)
        pose[:3, 3] *= SCALE
        poses.append(pose)
    return poses


def assert_poses_agree(obj: ArticulatedObject, values: np.ndarray, poses_at) -> None:
    for q in values:
        np.testing.assert_allclose(poses_at(q), expected(obj, q), atol=1e-6)


def matrix(wxyz: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    return SE3.from_quat(torch.tensor(wxyz, dtype=torch.float64), torch.tensor(xyz, dtype=torch.float64)).as_matrix().numpy()


def mujoco_poses(path: Path):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)

    def poses_at(q: np.ndarray) -> list[np.ndarray]:
        for i, value in enumerate(q, start=1):
            data.joint(f"joint_{i}").qpos[0] = value
        mujoco.mj_kinematics(model, data)
        return [matrix(data.body(f"part_{i}").xquat, data.body(f"part_{i}").xpos) for i in range(1, len(q) + 1)]

    return poses_at


def test_yourdfpy_and_the_object_agree_on_the_links_poses(obj, mechanism, values, tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy")
    robot = yourdfpy.URDF.load(str(write_urdf(mechanism, tmp_path)))

    def poses_at(q: np.ndarray) -> list[np.ndarray]:
        robot.update_cfg({f"joint_{i}": value for i, value in enumerate(q, start=1)})
        return [robot.get_transform(f"part_{i}", "base") for i in range(1, len(q) + 1)]

    assert_poses_agree(obj, values, poses_at)


@pytest.mark.parametrize("write", [write_urdf, write_mjcf])
def test_mujoco_and_the_object_agree_on_the_links_poses(obj, mechanism, values, tmp_path, write):
    assert_poses_agree(obj, values, mujoco_poses(write(mechanism, tmp_path)))


def test_pybullet_and_the_object_agree_on_the_links_poses_and_the_base_does_not_fall(obj, mechanism, values, tmp_path):
    bullet = pytest.importorskip("pybullet")
    world = bullet.connect(bullet.DIRECT)
    bullet.setGravity(0, 0, -GRAVITY, physicsClientId=world)
    body = bullet.loadURDF(str(write_urdf(mechanism, tmp_path)), physicsClientId=world)
    infos = [
        bullet.getJointInfo(body, i, physicsClientId=world) for i in range(bullet.getNumJoints(body, physicsClientId=world))
    ]
    index = {info[12].decode(): i for i, info in enumerate(infos)}
    names = {info[1].decode(): i for i, info in enumerate(infos)}

    def state(link: str) -> np.ndarray:
        at = bullet.getLinkState(body, index[link], computeForwardKinematics=True, physicsClientId=world)
        return matrix(np.roll(at[5], 1), np.array(at[4]))

    def poses_at(q: np.ndarray) -> list[np.ndarray]:
        for i, value in enumerate(q, start=1):
            bullet.resetJointState(body, names[f"joint_{i}"], value, physicsClientId=world)
        return [state(f"part_{i}") for i in range(1, len(q) + 1)]

    assert_poses_agree(obj, values, poses_at)
    for _ in range(240):
        bullet.stepSimulation(physicsClientId=world)
    np.testing.assert_allclose(state("base"), np.eye(4), atol=1e-6)
    bullet.disconnect(world)


def usd_joint_frames(joint) -> tuple[np.ndarray, np.ndarray, str]:
    """The joint's frames in body 0 and in body 1, and body 1's name."""
    frames = []
    for i in (0, 1):
        turn, place = joint.GetAttribute(f"physics:localRot{i}").Get(), joint.GetAttribute(f"physics:localPos{i}").Get()
        frames.append(matrix(np.array([turn.GetReal(), *turn.GetImaginary()]), np.array(place, dtype=np.float64)))
    return frames[0], frames[1], joint.GetRelationship("physics:body1").GetTargets()[0].name


def test_usd_and_the_object_agree_on_the_links_poses(obj, mechanism, values, tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdPhysics

    stage = usd.Stage.Open(str(write_usd(obj, mechanism, tmp_path, scale=SCALE)))

    def poses_at(q: np.ndarray) -> list[np.ndarray]:
        poses = []
        for i, value in enumerate(q, start=1):
            joint = stage.GetPrimAtPath(f"/object/joint_{i}")
            frame_0, frame_1, body = usd_joint_frames(joint)
            turns = joint.IsA(UsdPhysics.RevoluteJoint)
            assert (body, joint.GetAttribute("physics:axis").Get()) == (f"part_{i}", "X")
            unit = math.pi / 180 if turns else 1
            assert joint.GetAttribute("physics:lowerLimit").Get() * unit - 1e-6 <= value
            assert joint.GetAttribute("physics:upperLimit").Get() * unit + 1e-6 >= value
            move = trimesh.transformations.rotation_matrix(value, [1, 0, 0])
            if not turns:
                move = trimesh.transformations.translation_matrix([value, 0, 0])
            poses.append(frame_0 @ move @ np.linalg.inv(frame_1))
        return poses

    assert_poses_agree(obj, values, poses_at)


def test_usd_bodies_stand_in_state_0_with_their_splats_where_the_object_has_them(obj, mechanism, tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdPhysics

    stage = usd.Stage.Open(str(write_usd(obj, mechanism, tmp_path, scale=SCALE)))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Z", 1.0)
    assert stage.GetDefaultPrim().HasAPI(UsdPhysics.ArticulationRootAPI)
    placed = obj.parts.place(obj.parts.boxes, 0.0)
    for k, link in enumerate(mechanism.links):
        body = stage.GetPrimAtPath(f"/object/{link.name}")
        assert body.HasAPI(UsdPhysics.RigidBodyAPI)
        assert body.GetAttribute("physics:mass").Get() == pytest.approx(link.inertia.mass)
        pose = np.array(UsdGeom.Xformable(body).GetLocalTransformation()).T
        field = body.GetChild("splats")
        assert field.GetTypeName() == "ParticleField3DGaussianSplat"
        rows = slice(120 * k, 120 * k + 120)
        means = np.array(field.GetAttribute("positions").Get()) + pose[:3, 3]
        np.testing.assert_allclose(means, SCALE * placed.means[rows].numpy(), atol=1e-5)
        scales = np.array(field.GetAttribute("scales").Get())
        np.testing.assert_allclose(scales, SCALE * placed.scales[rows].numpy(), rtol=1e-5)
        turns = [[q.GetReal(), *q.GetImaginary()] for q in field.GetAttribute("orientations").Get()]
        want = torch.nn.functional.normalize(placed.quats[rows], dim=-1).numpy()
        np.testing.assert_allclose(np.array(turns), want, atol=1e-6)
        np.testing.assert_allclose(
            np.array(field.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()), placed.sh[rows, 0].numpy(), atol=1e-6
        )


def test_usd_shows_the_mesh_or_the_splats(obj, mechanism, tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    stage = usd.Stage.Open(str(write_usd(obj, mechanism, tmp_path, scale=SCALE)))
    look = stage.GetDefaultPrim().GetVariantSet("look")
    assert look.GetVariantSelection() == "mesh"
    for shown, hidden in (("mesh", "splats"), ("splats", "mesh")):
        look.SetVariantSelection(shown)
        seen = {
            name: UsdGeom.Imageable(stage.GetPrimAtPath(f"/object/part_1/{prim}")).ComputeVisibility()
            for name, prim in (("mesh", "visual"), ("splats", "splats"))
        }
        assert seen == {shown: "inherited", hidden: "invisible"}


def test_mujoco_opens_and_closes_every_joint_under_gravity(mechanism, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(write_mjcf(mechanism, tmp_path)))
    data = mujoco.MjData(model)
    low, high = model.jnt_range.T
    for target, until in ((high, 2.5), (low, 5.0)):
        data.ctrl[:] = target
        while data.time < until:
            mujoco.mj_step(model, data)
            assert np.all(data.qpos > low - 0.1 * (high - low))
            assert np.all(data.qpos < high + 0.1 * (high - low))
            assert data.ncon == 0
        np.testing.assert_allclose(data.qpos, target, atol=0.02 * np.max(high - low))
        assert np.abs(data.qvel).max() < 1e-3
    assert not any(warning.number for warning in data.warning)


def test_mujoco_sees_the_density_of_the_mesh(obj, mechanism, tmp_path):
    """The inertia that arrives is that of a solid box in closed form, about its centre."""
    mujoco = pytest.importorskip("mujoco")
    for path in (write_mjcf(mechanism, tmp_path), write_urdf(mechanism, tmp_path)):
        model = mujoco.MjModel.from_xml_path(str(path))
        for k in (1, 2):
            size = 2 * SCALE * obj.parts.boxes.half_extents[k].double().numpy()
            mass = 300 * size.prod()
            thick = 0.01**2 * (size @ size) / 6
            want = np.sort(mass * ((size @ size - size**2) / 12 + thick))
            body = model.body(f"part_{k}")
            assert body.mass[0] == pytest.approx(mass)
            np.testing.assert_allclose(np.sort(body.inertia), want, rtol=1e-6)
            where = SCALE * (obj.parts.boxes.T_world_box.xyz[k].double().numpy() - np.array(obj.joints[k - 1].origin))
            np.testing.assert_allclose(body.ipos, where, atol=1e-6)


def test_limits_are_the_observed_range_and_a_margin(obj, mechanism, tmp_path):
    urdf = ElementTree.parse(write_urdf(mechanism, tmp_path)).getroot()
    for i, joint in enumerate(obj.joints, start=1):
        limit = urdf.find(f"joint[@name='joint_{i}']/limit")
        unit = SCALE if joint.kind == "prismatic" else 1
        assert float(limit.get("lower")) == pytest.approx(-MARGIN)
        assert float(limit.get("upper")) == pytest.approx(joint.q[1] * unit + MARGIN)
        assert min(float(limit.get(key)) for key in ("effort", "velocity")) > 0


def test_effort_lifts_what_the_joint_carries(mechanism):
    """A drawer pulled straight up, and a lid lifted from the horizontal, weigh less than the motor's effort."""
    for joint in mechanism.joints:
        inertia = mechanism.links[joint.child].inertia
        lever = np.linalg.norm(np.cross(joint.axis, inertia.centre)) if joint.kind == "revolute" else 1.0
        assert joint.drive.effort > inertia.mass * GRAVITY * lever


def test_no_links_of_the_object_collide_but_others_do(mechanism, tmp_path):
    """Boxes that overlap by half make no contact; a ball that falls on the base does."""
    mujoco = pytest.importorskip("mujoco")
    root = ElementTree.parse(write_mjcf(mechanism, tmp_path)).getroot()
    ball = ElementTree.SubElement(root.find("worldbody"), "body", name="ball", pos="-0.2 0 0.42")
    ElementTree.SubElement(ball, "freejoint")
    ElementTree.SubElement(ball, "geom", size="0.05", mass="0.1")
    (tmp_path / "with_ball.xml").write_bytes(ElementTree.tostring(root))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "with_ball.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    touching = {frozenset(model.geom(g).bodyid[0] for g in pair) for pair in data.contact.geom}
    assert touching == {frozenset((model.body("base").id, model.body("ball").id))}


def test_the_copy_without_visuals_is_otherwise_the_same(mechanism, tmp_path):
    whole = ElementTree.parse(write_urdf(mechanism, tmp_path)).getroot()
    bare = ElementTree.parse(tmp_path / "object_novisual.urdf").getroot()
    assert len(whole.findall("link/visual")) == 3 and not bare.findall("link/visual")
    for element in [*whole.findall("link"), whole]:
        for child in [*element.findall("visual"), *element.findall("material")]:
            element.remove(child)
    assert ElementTree.canonicalize(ElementTree.tostring(whole), strip_text=True) == ElementTree.canonicalize(
        ElementTree.tostring(bare), strip_text=True
    )


def test_textures_reach_every_format(obj, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    usd = pytest.importorskip("pxr.Usd")
    meshes = boxes_of(obj)
    picture = Image.new("RGB", (8, 8), (10, 200, 30))
    uv = np.random.default_rng(0).random((len(meshes[1].vertices), 2))
    meshes[1].visual = trimesh.visual.TextureVisuals(uv=uv, image=picture)
    mechanism = mechanism_of(obj, meshes)
    urdf, mjcf, stage = write_urdf(mechanism, tmp_path), write_mjcf(mechanism, tmp_path), write_usd(obj, mechanism, tmp_path)
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    assert model.tex_data[:3].tolist() == [10, 200, 30] and model.mat_texid[model.mat("part_1").id].max() == 0
    link = ElementTree.parse(urdf).getroot().find("material[@name='part_1_material']/texture")
    assert link.get("filename") == "meshes/part_1.png"
    assert Image.open(tmp_path / "meshes" / "part_1.png").getpixel((3, 3)) == (10, 200, 30)
    shown = trimesh.load(tmp_path / "meshes" / "part_1.obj", process=False)
    np.testing.assert_allclose(np.sort(np.unique(shown.visual.uv[:, 0])), np.sort(uv[:, 0]), atol=1e-6)
    stage = usd.Stage.Open(str(stage))
    file = stage.GetPrimAtPath("/object/part_1/material/texture").GetAttribute("inputs:file").Get()
    assert Image.open(file.resolvedPath).getpixel((3, 3)) == (10, 200, 30)


def test_the_same_object_gives_the_same_bytes(obj, tmp_path):
    pytest.importorskip("pxr.Usd")
    found = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        for export in (export_urdf, export_mjcf, export_usd):
            export(obj, boxes_of(obj), folder)
        found.append({file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()})
    assert found[0] == found[1]
    assert not [name for name in found[0] if ".part" in str(name)]


def bowl() -> trimesh.Trimesh:
    """A box without its lid, of walls without thickness."""
    box = trimesh.creation.box(extents=(0.6, 0.5, 0.4))
    return trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] < 0.5], process=False)


@pytest.mark.parametrize(
    "mesh",
    [
        bowl(),
        trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]),
        trimesh.creation.box(extents=(1.0, 1e-5, 1.0)),
        trimesh.creation.box(extents=(1e-6, 1e-6, 1.0)),
        trimesh.creation.annulus(0.3, 0.31, 0.5),
    ],
    ids=["open", "flat", "thin", "rod", "ring"],
)
def test_every_mesh_has_the_inertia_of_a_body(mesh):
    pieces = convex_pieces(mesh)
    inertia = inertia_of(mesh, pieces)
    low, middle, high = np.linalg.eigvalsh(inertia.moment)
    assert inertia.mass > 0 and low > 1e-6 * high and low + middle >= high
    grown = mesh.bounds + np.array([[-1.0], [1.0]]) * 0.02 * np.linalg.norm(mesh.extents)
    assert np.all((inertia.centre > grown[0]) & (inertia.centre < grown[1]))
    assert all(piece.is_volume and piece.is_convex for piece in pieces)


def test_pieces_leave_a_drawer_hollow():
    """The walls' middles lie in a piece, and the middle of the hollow in none."""
    walls = [((0.6, 0.5, 0.04), (0, 0, -0.18)), ((0.6, 0.04, 0.4), (0, 0.23, 0)), ((0.6, 0.04, 0.4), (0, -0.23, 0))]
    walls += [((0.04, 0.5, 0.4), (0.28, 0, 0)), ((0.04, 0.5, 0.4), (-0.28, 0, 0))]
    matrices = [trimesh.transformations.translation_matrix(place) for _, place in walls]
    tray = trimesh.util.concatenate([trimesh.creation.box(size, T) for (size, _), T in zip(walls, matrices, strict=True)])
    pieces = convex_pieces(tray)
    inside = [
        any(np.all(((point - piece.triangles[:, 0]) * piece.face_normals).sum(1) < 0) for piece in pieces)
        for point in np.array([(0, 0, 0.02), (0.28, 0, 0), (-0.28, 0, 0), (0, 0.23, 0), (0, -0.23, 0), (0, 0, -0.18)])
    ]
    assert inside == [False, True, True, True, True, True]


def test_sapien_and_moveit_are_told_that_no_links_collide(mechanism, tmp_path):
    """SAPIEN heeds pairs of the reason "Default", and refuses them between a part and what it hangs on."""
    write_urdf(mechanism, tmp_path)
    for name in ("object.srdf", "object_novisual.srdf"):
        rows = ElementTree.parse(tmp_path / name).getroot().findall("disable_collisions")
        found = {(row.get("link1"), row.get("link2")): row.get("reason") for row in rows}
        assert found == {("base", "part_1"): "Adjacent", ("base", "part_2"): "Adjacent", ("part_1", "part_2"): "Default"}


def test_an_empty_mesh_is_its_part_s_box(obj):
    meshes = boxes_of(obj)
    want = mechanism_of(obj, meshes).links[1].inertia
    meshes[1] = trimesh.Trimesh()
    assert mechanism_of(obj, meshes).links[1].inertia.mass == pytest.approx(want.mass)


@pytest.mark.parametrize(
    ("options", "match"),
    [({"scale": 0.0}, "--scale 0.0"), ({"limit_margin": -1.0}, "--limit-margin -1.0"), ({"name": "my door"}, "'my door'")],
)
def test_arguments_that_make_no_sense_are_refused_and_nothing_is_written(obj, tmp_path, options, match):
    with pytest.raises(ValueError, match=match):
        export_urdf(obj, boxes_of(obj), tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("package", "export", "extra"), [("coacd", "urdf", "sim"), ("coacd", "mjcf", "sim"), ("pxr", "usd", "usd")]
)
def test_a_missing_extra_is_named_in_one_sentence(package, export, extra, tmp_path):
    script = (
        f"import sys; sys.modules[{package!r}] = None\n"
        "from pathlib import Path; import trimesh\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from door_and_drawer import made_of\n"
        f"from structuregs.export.{export} import export_{export}\n"
        "obj = made_of()\n"
        f"try: export_{export}(obj, [trimesh.creation.box()], Path({str(tmp_path / 'out')!r}))\n"
        "except ValueError as error: print(error)\n"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert f'pip install "structuregs[{extra}]"' in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()

"""An articulated object to URDF."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import trimesh

from ..files import replace_file
from ..model import ArticulatedObject
from .assets import checked_name, collision_name, mean_colour, number, numbers, texture_of, write_meshes
from .links import Link, LinkJoint, Mechanism, mechanism_of

_MESHES = "meshes"
_SAPIEN_PAIRS = 31  # SAPIEN refuses an SRDF that asks it to ignore more pairs


def export_urdf(
    obj: ArticulatedObject,
    meshes: Sequence[trimesh.Trimesh],
    folder: Path,
    *,
    name: str = "object",
    scale: float = 1.0,
    limit_margin: float = 0.0,
) -> Path:
    """Writes an object as URDF (`write_urdf` of its `mechanism_of`); returns the file."""
    checked_name(name)
    return write_urdf(mechanism_of(obj, meshes, scale=scale, limit_margin=limit_margin), folder, name=name)


def write_urdf(mechanism: Mechanism, folder: Path, *, name: str = "object") -> Path:
    """Writes `<name>.urdf` and the meshes that it refers to; returns it.

    Beside it: `<name>_novisual.urdf`, the same without visuals, which SAPIEN loads on a machine without a GPU; and an SRDF
    for each, from which SAPIEN (up to 31 pairs) and MoveIt learn that no two links should collide.

    The base hangs on a link named `world`, at which PyBullet, ROS and Gazebo fix it.  PyBullet tests no contacts between
    links of one model unless it is asked to; SAPIEN, Isaac and Gazebo none between a part and what it hangs on.  MuJoCo
    does test a part against a base that is fixed, and a URDF cannot tell it otherwise: there, simulate the MJCF.

    Args:
        mechanism: the links and joints.
        folder: made where it is missing.
        name: of the model and the files, [A-Za-z0-9_].
    """
    checked_name(name)
    write_meshes(mechanism, folder / _MESHES)
    srdf = _xml_text(_srdf(mechanism, name))
    for stem, visuals in ((f"{name}_novisual", False), (name, True)):
        replace_file(folder / f"{stem}.srdf", srdf)
        replace_file(folder / f"{stem}.urdf", _xml_text(_robot(mechanism, name, visuals)))
    return folder / f"{name}.urdf"


def _robot(mechanism: Mechanism, name: str, visuals: bool) -> ElementTree.Element:
    robot = ElementTree.Element("robot", name=name)
    compiler = {"discardvisual": "false", "strippath": "false", "fusestatic": "false", "balanceinertia": "true"}
    ElementTree.SubElement(ElementTree.SubElement(robot, "mujoco"), "compiler", compiler)
    if visuals:
        for link in mechanism.links:
            _add_material(robot, link)
    ElementTree.SubElement(robot, "link", name="world")
    for link in mechanism.links:
        _add_link(robot, link, visuals)
    fixed = ElementTree.SubElement(robot, "joint", name="world_base", type="fixed")
    _add_ends(fixed, "world", mechanism.links[0].name, numbers(mechanism.links[0].origin))
    for joint in mechanism.joints:
        _add_joint(robot, joint, mechanism)
    return robot


def _add_material(robot: ElementTree.Element, link: Link) -> None:
    material = ElementTree.SubElement(robot, "material", name=f"{link.name}_material")
    plain = texture_of(link.visual) is None
    ElementTree.SubElement(material, "color", rgba=numbers(mean_colour(link.visual)) if plain else "1 1 1 1")
    if not plain:
        ElementTree.SubElement(material, "texture", filename=f"{_MESHES}/{link.name}.png")


def _add_link(robot: ElementTree.Element, link: Link, visuals: bool) -> None:
    element = ElementTree.SubElement(robot, "link", name=link.name)
    inertial = ElementTree.SubElement(element, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=numbers(link.inertia.centre), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=number(link.inertia.mass))
    moment = link.inertia.moment
    entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ElementTree.SubElement(inertial, "inertia", {key: number(moment[at]) for key, at in entries.items()})
    if visuals:
        visual = _add_mesh(element, "visual", link.name)
        ElementTree.SubElement(visual, "material", name=f"{link.name}_material")
    for i in range(len(link.pieces)):
        _add_mesh(element, "collision", collision_name(link.name, i))


def _add_mesh(link: ElementTree.Element, kind: str, file: str) -> ElementTree.Element:
    element = ElementTree.SubElement(link, kind, name=f"{file}_{kind}" if kind == "visual" else file)
    ElementTree.SubElement(element, "origin", xyz="0 0 0", rpy="0 0 0")
    ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), "mesh", filename=f"{_MESHES}/{file}.obj")
    return element


def _add_joint(robot: ElementTree.Element, joint: LinkJoint, mechanism: Mechanism) -> None:
    element = ElementTree.SubElement(robot, "joint", name=joint.name, type=joint.kind)
    _add_ends(element, mechanism.links[joint.parent].name, mechanism.links[joint.child].name, numbers(joint.offset))
    ElementTree.SubElement(element, "axis", xyz=numbers(joint.axis))
    limits = {"lower": joint.lower, "upper": joint.upper, "effort": joint.drive.effort, "velocity": joint.drive.velocity}
    ElementTree.SubElement(element, "limit", {key: number(value) for key, value in limits.items()})
    ElementTree.SubElement(element, "dynamics", damping=number(joint.drive.damping), friction="0")


def _add_ends(joint: ElementTree.Element, parent: str, child: str, xyz: str) -> None:
    ElementTree.SubElement(joint, "origin", xyz=xyz, rpy="0 0 0")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)


def _srdf(mechanism: Mechanism, name: str) -> ElementTree.Element:
    """Pairs of links that should not collide; SAPIEN heeds those whose reason is "Default", MoveIt all."""
    robot = ElementTree.Element("robot", name=name)
    hung = {frozenset((mechanism.links[j.parent].name, mechanism.links[j.child].name)) for j in mechanism.joints}
    pairs = list(mechanism.pairs())
    many = len(pairs) - len(hung) > _SAPIEN_PAIRS
    for a, b in pairs:
        reason = "Adjacent" if frozenset((a, b)) in hung else "Never" if many else "Default"
        ElementTree.SubElement(robot, "disable_collisions", link1=a, link2=b, reason=reason)
    return robot


def _xml_text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"

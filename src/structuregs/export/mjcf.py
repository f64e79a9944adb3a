"""An articulated object to MuJoCo's MJCF."""

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import trimesh

from ..files import replace_file
from ..model import ArticulatedObject
from .assets import checked_name, collision_name, mean_colour, number, numbers, texture_of, write_meshes
from .links import Link, LinkJoint, Mechanism, mechanism_of

_MESHES = "meshes"


def export_mjcf(
    obj: ArticulatedObject,
    meshes: Sequence[trimesh.Trimesh],
    folder: Path,
    *,
    name: str = "object",
    scale: float = 1.0,
    limit_margin: float = 0.0,
) -> Path:
    """Writes an object as MJCF (`write_mjcf` of its `mechanism_of`); returns the file."""
    checked_name(name)
    return write_mjcf(mechanism_of(obj, meshes, scale=scale, limit_margin=limit_margin), folder, name=name)


def write_mjcf(mechanism: Mechanism, folder: Path, *, name: str = "object") -> Path:
    """Writes `<name>.xml` and the meshes that it refers to; returns it.

    The base is fixed to the world, every joint has a position actuator of its own name, and no two links of the object
    collide with each other; with all else they do.

    Args:
        mechanism: the links and joints.
        folder: made where it is missing.
        name: of the model and the file, [A-Za-z0-9_].
    """
    checked_name(name)
    write_meshes(mechanism, folder / _MESHES)
    root = ElementTree.Element("mujoco", model=name)
    ElementTree.SubElement(root, "compiler", angle="radian", meshdir=_MESHES, texturedir=_MESHES, autolimits="true")
    ElementTree.SubElement(root, "option", integrator="implicitfast")
    _add_defaults(root)
    assets = ElementTree.SubElement(root, "asset")
    for link in mechanism.links:
        _add_assets(assets, link)
    _add_bodies(ElementTree.SubElement(root, "worldbody"), mechanism, 0)
    contact = ElementTree.SubElement(root, "contact")
    for a, b in mechanism.pairs():
        ElementTree.SubElement(contact, "exclude", name=f"{a}_{b}", body1=a, body2=b)
    actuator = ElementTree.SubElement(root, "actuator")
    for joint in mechanism.joints:
        _add_actuator(actuator, joint)
    ElementTree.indent(root)
    return replace_file(folder / f"{name}.xml", ElementTree.tostring(root, encoding="unicode") + "\n")


def _add_defaults(root: ElementTree.Element) -> None:
    """Geoms that are only seen, and geoms that only collide, in MuJoCo's usual groups."""
    defaults = ElementTree.SubElement(root, "default")
    seen = ElementTree.SubElement(defaults, "default", {"class": "visual"})
    ElementTree.SubElement(seen, "geom", type="mesh", contype="0", conaffinity="0", group="2", mass="0")
    felt = ElementTree.SubElement(defaults, "default", {"class": "collision"})
    ElementTree.SubElement(felt, "geom", type="mesh", group="3", mass="0")


def _add_assets(assets: ElementTree.Element, link: Link) -> None:
    material = {"name": link.name, "rgba": numbers(mean_colour(link.visual)), "specular": "0"}
    if texture_of(link.visual) is not None:
        ElementTree.SubElement(assets, "texture", name=link.name, type="2d", file=f"{link.name}.png")
        material |= {"rgba": "1 1 1 1", "texture": link.name}
    ElementTree.SubElement(assets, "material", material)
    # A shell's inertia is defined for open surfaces too; the links' inertia is given, so nothing else hangs on it.
    ElementTree.SubElement(assets, "mesh", name=link.name, file=f"{link.name}.obj", inertia="shell")
    for i in range(len(link.pieces)):
        piece = collision_name(link.name, i)
        ElementTree.SubElement(assets, "mesh", name=piece, file=f"{piece}.obj", inertia="convex")


def _add_bodies(above: ElementTree.Element, mechanism: Mechanism, k: int) -> None:
    """A link and all that hang on it."""
    link = mechanism.links[k]
    offset = mechanism.joint_of(k).offset if k else link.origin
    body = ElementTree.SubElement(above, "body", name=link.name, pos=numbers(offset))
    moment = link.inertia.moment
    full = numbers([moment[at] for at in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
    mass = number(link.inertia.mass)
    ElementTree.SubElement(body, "inertial", pos=numbers(link.inertia.centre), mass=mass, fullinertia=full)
    if k:
        _add_joint(body, mechanism.joint_of(k))
    ElementTree.SubElement(body, "geom", {"class": "visual", "mesh": link.name, "material": link.name})
    for i in range(len(link.pieces)):
        piece = collision_name(link.name, i)
        ElementTree.SubElement(body, "geom", {"name": piece, "class": "collision", "mesh": piece})
    for joint in mechanism.joints:
        if joint.parent == k:
            _add_bodies(body, mechanism, joint.child)


def _add_joint(body: ElementTree.Element, joint: LinkJoint) -> None:
    values = {
        "name": joint.name,
        "type": "hinge" if joint.kind == "revolute" else "slide",
        "axis": numbers(joint.axis),
        "range": numbers((joint.lower, joint.upper)),
        "damping": number(joint.drive.damping),
        "armature": number(joint.drive.armature),
    }
    ElementTree.SubElement(body, "joint", values)


def _add_actuator(actuator: ElementTree.Element, joint: LinkJoint) -> None:
    drive = joint.drive
    values = {
        "name": joint.name,
        "joint": joint.name,
        "kp": number(drive.stiffness),
        "kv": number(drive.stiffness_rate),
        "ctrlrange": numbers((joint.lower, joint.upper)),
        "forcerange": numbers((-drive.effort, drive.effort)),
    }
    ElementTree.SubElement(actuator, "position", values)

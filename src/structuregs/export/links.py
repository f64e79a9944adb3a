"""What simulators need of an articulated object: links with mass and collision pieces, joints with limits and drives."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from scipy.spatial import QhullError

from ..geometry import JointKind
from ..model import ArticulatedObject, Joint

DENSITY = 300.0  # kg/m^3: of furniture, whose boards are denser and whose reconstructed surfaces enclose some air
GRAVITY = 9.81

_THIN = 0.01  # of a link's diagonal: thinner links weigh and turn as if they were so thick
_LEAST_MASS = 1e-3  # kg
_LEAST_RANGE = 1e-3  # of a joint, radians or metres: consumers refuse an empty range, or read it as none
_OPENING = 1.0  # seconds in which a drive opens its joint
_SAG = 0.01  # of a joint's range: how far a drive lets its link hang
_COAST = 0.5  # seconds in which a joint that nothing drives loses 63 % of its speed

# Of coacd: fine enough for the hollow of a drawer, and some ten seconds for a part of 700,000 faces on one core.
_CONCAVITY = 0.15
_MOST_PIECES = 16
_PIECE_VERTICES = 64
_FACES = 3000  # a mesh is decimated to as many before it is cut
_SLIVER = 1e-5  # of the volume around a link; smaller pieces are dropped


@dataclass(frozen=True)
class Inertia:
    """Mass properties of a link.

    Attributes:
        mass: kg.
        centre: of mass, in the link's frame, metres.
        moment: about the centre, along the link's axes, kg m^2; positive definite, and no moment exceeds the sum of the
            other two.
    """

    mass: float
    centre: Float[np.ndarray, " 3"]
    moment: Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class Link:
    """A part as simulators see it.

    Its frame stands at its joint's origin, along the world's axes, as the part stands in state 0; the base's frame is
    the world's.

    Attributes:
        name: `base`, `part_1`, ...
        origin: of its frame in the world in state 0, metres.
        visual: what is seen of it, in its frame, metres.
        pieces: convex pieces for collisions, in its frame, metres.
        inertia: its mass properties.
    """

    name: str
    origin: Float[np.ndarray, " 3"]
    visual: trimesh.Trimesh
    pieces: tuple[trimesh.Trimesh, ...]
    inertia: Inertia


@dataclass(frozen=True)
class Drive:
    """Resistance and strength of a joint, chosen from the mass that it moves and how far that reaches.

    Attributes:
        damping: of the joint itself, N m s/rad or N s/m.
        effort: the most that a motor should give, N m or N.
        velocity: the fastest that it should move, rad/s or m/s.
        stiffness: of a position controller, N m/rad or N/m.
        stiffness_rate: its damping, N m s/rad or N s/m: with the joint's own it is critical.
        armature: inertia added to the joint, kg m^2 or kg; keeps light links stable at common time steps.
    """

    damping: float
    effort: float
    velocity: float
    stiffness: float
    stiffness_rate: float
    armature: float


@dataclass(frozen=True)
class LinkJoint:
    """A joint between two links, in radians and metres.

    Attributes:
        name: `joint_1`, ...
        kind: "revolute" or "prismatic".
        parent: index of the link that it hangs on.
        child: index of the link that it moves.
        offset: of the child's origin in the parent's frame, state 0.
        axis: unit vector, in either link's frame (they are parallel in state 0).
        lower: smallest value.
        upper: largest value.
        drive: its resistance and strength.
    """

    name: str
    kind: JointKind
    parent: int
    child: int
    offset: Float[np.ndarray, " 3"]
    axis: Float[np.ndarray, " 3"]
    lower: float
    upper: float
    drive: Drive


@dataclass(frozen=True)
class Mechanism:
    """Links and the joints between them.

    Attributes:
        links: one for each part, in order.
        joints: one for each link but the base, in order.
    """

    links: tuple[Link, ...]
    joints: tuple[LinkJoint, ...]

    def joint_of(self, link: int) -> LinkJoint:
        """The joint that moves a link other than the base."""
        return self.joints[link - 1]

    def pairs(self) -> Iterator[tuple[str, str]]:
        """Names of every two links.

        None of them should collide: doors and drawers share edges with the base and with each other, and pieces that
        overlap there by a millimetre would push the joints.
        """
        for k, link in enumerate(self.links):
            for other in self.links[k + 1 :]:
                yield link.name, other.name


def mechanism_of(
    obj: ArticulatedObject, meshes: Sequence[trimesh.Trimesh], *, scale: float = 1.0, limit_margin: float = 0.0
) -> Mechanism:
    """The links and joints of an object.

    Args:
        obj: the object.
        meshes: one for each part, in the world as the parts stand in state 0; where one is empty its part's box stands in.
        scale: metres per unit of the object.
        limit_margin: radians or metres that are added to the observed range on both sides.

    Raises:
        ValueError: a package is missing, or an argument makes no sense.
    """
    if len(meshes) != len(obj.parts):
        raise ValueError(f"links: {len(meshes)} meshes for an object of {len(obj.parts)} parts; give one for each part.")
    if not (math.isfinite(scale) and scale > 0):
        raise ValueError(f"--scale {scale}: metres per unit must be above 0.")
    if not (math.isfinite(limit_margin) and limit_margin >= 0):
        raise ValueError(f"--limit-margin {limit_margin}: the margin of the limits (radians or metres) must not be below 0.")
    links = tuple(_link(obj, k, mesh, scale) for k, mesh in enumerate(meshes))
    joints = tuple(
        _joint(joint, k, links, _carried(obj.joints, k), scale, limit_margin) for k, joint in enumerate(obj.joints, start=1)
    )
    return Mechanism(links, joints)


def _link(obj: ArticulatedObject, k: int, mesh: trimesh.Trimesh, scale: float) -> Link:
    origin = scale * np.array(obj.joints[k - 1].origin) if k else np.zeros(3)
    if len(mesh.faces) == 0:
        box = obj.parts.boxes[k]
        T = box.T_world_box.to("cpu", torch.float64).as_matrix().numpy()
        mesh = trimesh.creation.box(extents=2 * np.maximum(box.half_extents.cpu().double().numpy(), 1e-6), transform=T)
    visual = mesh.copy()
    visual.vertices = visual.vertices * scale - origin
    pieces = convex_pieces(visual)
    return Link(obj.parts.names[k], origin, visual, pieces, inertia_of(visual, pieces))


def _joint(joint: Joint, k: int, links: tuple[Link, ...], carried: list[int], scale: float, margin: float) -> LinkJoint:
    axis = np.array(joint.axis)
    axis = axis / np.linalg.norm(axis)
    unit = scale if joint.kind == "prismatic" else 1.0
    lower = min(joint.q) * unit - margin
    upper = max(max(joint.q) * unit + margin, lower + _LEAST_RANGE)
    offset = links[k].origin - links[joint.parent].origin
    drive = _drive(joint.kind, axis, links[k].origin, [links[i] for i in carried], upper - lower)
    return LinkJoint(f"joint_{k}", joint.kind, joint.parent, k, offset, axis, lower, upper, drive)


def _carried(joints: Sequence[Joint], k: int) -> list[int]:
    """A part and all that hang on it."""
    carried = [k]
    for part in carried:
        carried += [child for child, joint in enumerate(joints, start=1) if joint.parent == part]
    return carried


def _drive(
    kind: JointKind, axis: Float[np.ndarray, " 3"], origin: Float[np.ndarray, " 3"], links: list[Link], way: float
) -> Drive:
    """The drive of a joint that carries links over a range `way`."""
    mass = sum(link.inertia.mass for link in links)
    if kind == "prismatic":
        load, weight = mass, mass * GRAVITY
    else:
        load = weight = 0.0
        for link in links:
            arm = link.origin + link.inertia.centre - origin
            distance = float(np.linalg.norm(np.cross(axis, arm)))
            load += float(axis @ link.inertia.moment @ axis) + link.inertia.mass * distance**2
            weight += link.inertia.mass * GRAVITY * distance
    armature = 0.05 * load
    load += armature
    way = max(way, 0.05)  # a drive for less would be needlessly stiff
    stiffness = max(weight / (_SAG * way), load * (2 * math.pi / _OPENING) ** 2)
    damping = load / _COAST
    velocity = 2 * way / _OPENING
    # Speeding up and slowing down over the whole way, against gravity and friction, with half as much again.
    effort = 1.5 * (load * 4 * way / _OPENING**2 + weight + damping * velocity)
    return Drive(damping, effort, velocity, stiffness, max(2 * math.sqrt(stiffness * load) - damping, damping), armature)


def inertia_of(mesh: trimesh.Trimesh, pieces: Sequence[trimesh.Trimesh]) -> Inertia:
    """Mass properties of a solid of even density.

    The solid is the mesh where it is closed, else its convex pieces together, else the box around it.  Where it is thin
    it weighs what it does and turns as if it were a hundredth of its diagonal thick, so that no moment vanishes.

    Args:
        mesh: a link's surface, in the link's frame, metres.
        pieces: closed convex pieces of it.
    """
    diagonal = float(np.linalg.norm(mesh.extents))
    thin = max(_THIN * diagonal, 1e-4)
    extents = np.maximum(mesh.extents, thin)
    around = trimesh.creation.box(extents=extents, transform=trimesh.transformations.translation_matrix(mesh.bounds.mean(0)))
    vertices, faces = trimesh.util.append_faces([piece.vertices for piece in pieces], [piece.faces for piece in pieces])
    together = trimesh.Trimesh(vertices, faces, process=False)
    solid = next((s for s in (mesh, together) if _is_solid(s, around)), around)
    mass = max(solid.volume * DENSITY, _LEAST_MASS)
    moment = solid.moment_inertia / solid.volume * mass + np.eye(3) * mass * thin**2 / 6
    return Inertia(float(mass), np.array(solid.center_mass), np.array((moment + moment.T) / 2))


def _is_solid(mesh: trimesh.Trimesh, around: trimesh.Trimesh) -> bool:
    """Whether a mesh has the mass properties of a body: surfaces inside out within others can take them away."""
    if not mesh.is_volume or not 1e-6 * around.volume < mesh.volume:
        return False
    low, middle, high = np.linalg.eigvalsh(mesh.moment_inertia)
    inside = np.all((mesh.center_mass >= around.bounds[0]) & (mesh.center_mass <= around.bounds[1]))
    return bool(inside and low > 0 and low + middle >= high * (1 - 1e-9))


def convex_pieces(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, ...]:
    """Few convex pieces that together cover a mesh (CoACD; Wei et al. 2022); the same for the same mesh.

    Raises:
        ValueError: coacd is not installed.
    """
    try:
        import coacd
    except ImportError as error:
        raise ValueError('collision pieces need coacd, which is missing; `pip install "structuregs[sim]"`.') from error
    extents = np.maximum(mesh.extents, max(_THIN * float(np.linalg.norm(mesh.extents)), 1e-4))
    centre = mesh.bounds.mean(0)
    around = trimesh.creation.box(extents=extents, transform=trimesh.transformations.translation_matrix(centre))
    if np.any(mesh.extents < 1e-3 * extents.max()):
        return (around,)  # flat: there is nothing to cut
    coacd.set_log_level("error")
    simple = _decimated(mesh)
    # coacd's rounding depends on where and how large the mesh is: it gets one of size 1 about the origin.
    size = float(extents.max())
    cut = coacd.run_coacd(
        coacd.Mesh((simple.vertices - centre) / size, simple.faces),
        threshold=_CONCAVITY,
        max_convex_hull=_MOST_PIECES,
        preprocess_resolution=25,
        resolution=500,
        mcts_nodes=6,
        mcts_iterations=20,
        mcts_max_depth=2,
        decimate=True,
        max_ch_vertex=_PIECE_VERTICES,
        seed=0,
    )
    hulls = (_hull(np.asarray(vertices) * size + centre) for vertices, _ in cut)
    least = _SLIVER * float(extents.prod())
    return tuple(hull for hull in hulls if hull is not None and hull.volume > least) or (around,)


def _decimated(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A mesh of few enough faces to be cut in seconds."""
    bare = trimesh.Trimesh(mesh.vertices, mesh.faces)
    if len(mesh.faces) <= _FACES:
        return bare
    try:
        return bare.simplify_quadric_decimation(face_count=_FACES)
    except ImportError as error:
        raise ValueError(
            'collision pieces need fast-simplification, which is missing; `pip install "structuregs[sim]"`.'
        ) from error


def _hull(points: Float[np.ndarray, "P 3"]) -> trimesh.Trimesh | None:
    """The convex hull of points; nothing where they lie in a plane."""
    try:
        hull = trimesh.convex.convex_hull(points)
    except QhullError:
        return None
    return hull if hull.is_volume else None

"""An articulated object to USD: UsdPhysics articulation, meshes and splats."""

# pyright: reportAttributeAccessIssue=false
# (usd-core fills its modules when they are imported, and says nothing about it.)

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from ..files import replace_file, replacing
from ..geometry import SE3
from ..model import ArticulatedObject, Splats
from .assets import checked_name, collision_name, mean_colour, png_bytes, texture_of, uv_of, vertex_rgb
from .links import Link, LinkJoint, Mechanism, mechanism_of

_TEXTURES = "textures"
_LOOK = "look"  # the variant set that chooses between mesh and splats


def export_usd(
    obj: ArticulatedObject,
    meshes: Sequence[trimesh.Trimesh],
    folder: Path,
    *,
    name: str = "object",
    scale: float = 1.0,
    limit_margin: float = 0.0,
) -> Path:
    """Writes an object as USD (`write_usd` of its `mechanism_of`); returns the file."""
    checked_name(name)
    _require_usd()
    mechanism = mechanism_of(obj, meshes, scale=scale, limit_margin=limit_margin)
    return write_usd(obj, mechanism, folder, name=name, scale=scale)


def write_usd(obj: ArticulatedObject, mechanism: Mechanism, folder: Path, *, name: str = "object", scale: float = 1.0) -> Path:
    """Writes `<name>.usdc`, z up, in metres, and the textures that it refers to; returns it.

    The default prim is the articulation: one rigid body for each link, the base fixed to the world, and a joint with a
    position drive for each moving part, with limits in degrees or metres.  No two links collide with each other.  Each
    link holds its mesh and its splats (`ParticleField3DGaussianSplat`, colours half way between the two states); the
    variant set `look` shows one of them, at first the mesh.  A physics scene with gravity stands beside the default
    prim, so that it does not come along where the object is referenced.

    Args:
        obj: whose splats are written.
        mechanism: its links and joints, in metres.
        folder: made where it is missing.
        name: of the file and the default prim, [A-Za-z0-9_].
        scale: metres per unit of the object.

    Raises:
        ValueError: usd-core is missing, or older than its schema for splats.
    """
    checked_name(name)
    _require_usd()
    from pxr import Sdf, Usd, UsdGeom, UsdPhysics

    layer = Sdf.Layer.CreateAnonymous(".usdc")
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(root.GetPrim())
    UsdPhysics.ArticulationRootAPI.Apply(root.GetPrim())
    splats = _splats_of_links(obj, mechanism, scale)
    for link, piece in zip(mechanism.links, splats, strict=True):
        _add_link(stage, f"/{name}/{link.name}", link)
        _add_splats(stage, f"/{name}/{link.name}/splats", piece)
        image = texture_of(link.visual)
        if image is not None:
            replace_file(folder / _TEXTURES / f"{link.name}.png", png_bytes(image))
    _add_looks(root.GetPrim(), mechanism)
    _exclude_contacts(stage, name, mechanism)
    fixed = UsdPhysics.FixedJoint.Define(stage, f"/{name}/world_base")
    fixed.CreateBody1Rel().SetTargets([f"/{name}/{mechanism.links[0].name}"])
    for joint in mechanism.joints:
        _add_joint(stage, f"/{name}", joint, mechanism)
    UsdPhysics.Scene.Define(stage, "/physicsScene")
    file = folder / f"{name}.usdc"
    with replacing(file) as staged:
        if not layer.Export(str(staged)):
            raise OSError(f"{staged}: USD could not write this file.")
    return file


def _require_usd() -> None:
    try:
        from pxr import UsdVol
    except ImportError as error:
        raise ValueError('a USD file needs usd-core, which is missing; `pip install "structuregs[usd]"`.') from error
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise ValueError('usd-core is older than its schema for splats; `pip install --upgrade "structuregs[usd]"`.')


def _splats_of_links(obj: ArticulatedObject, mechanism: Mechanism, scale: float) -> list[Splats]:
    """The splats of each part in its link's frame, metres."""
    pieces = []
    for link, piece in zip(mechanism.links, obj.parts.place(obj.parts.boxes, 0.0).split(obj.parts.counts), strict=True):
        origin = torch.as_tensor(link.origin, dtype=piece.means.dtype)
        pieces.append(replace(piece, means=piece.means * scale - origin, log_scales=piece.log_scales + math.log(scale)))
    return pieces


def _add_link(stage: Any, path: str, link: Link) -> None:
    """A rigid body with its mass, its mesh and its collision pieces."""
    from pxr import Gf, UsdGeom, UsdPhysics

    body = UsdGeom.Xform.Define(stage, path)
    body.AddTranslateOp(precision=UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*link.origin.tolist()))
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    moments, turn = _principal(link.inertia.moment)
    mass = UsdPhysics.MassAPI.Apply(body.GetPrim())
    mass.CreateMassAttr(link.inertia.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*link.inertia.centre.tolist()))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*turn))
    visual = _add_mesh(stage, f"{path}/visual", link.visual)
    _add_material(stage, f"{path}/material", link, visual)
    for i, piece in enumerate(link.pieces):
        mesh = _add_mesh(stage, f"{path}/{collision_name(link.name, i)}", piece)
        mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)


def _principal(moment: np.ndarray) -> tuple[list[float], list[float]]:
    """Principal moments, and the turn `wxyz` from their axes to the link's."""
    moments, axes = np.linalg.eigh(moment)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    turn = SE3.from_rotation(torch.from_numpy(axes), torch.zeros(3, dtype=torch.float64))
    return moments.tolist(), turn.wxyz.tolist()


def _add_mesh(stage: Any, path: str, mesh: trimesh.Trimesh) -> Any:
    from pxr import UsdGeom, Vt

    prim = UsdGeom.Mesh.Define(stage, path)
    vertices = np.asarray(mesh.vertices, np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.asarray(mesh.faces, np.int32).ravel()))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([vertices.min(0), vertices.max(0)])))
    return prim


def _add_material(stage: Any, path: str, link: Link, visual: Any) -> None:
    """Colours of the mesh: the texture where there is one, else those of its vertices, and a preview surface of them."""
    from pxr import Sdf, UsdGeom, UsdShade, Vt

    rgb, textured = vertex_rgb(link.visual), texture_of(link.visual) is not None
    colour = visual.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant if rgb is None else UsdGeom.Tokens.vertex)
    values = np.array([mean_colour(link.visual)[:3]]) if rgb is None else rgb
    colour.Set(Vt.Vec3fArray.FromNumpy(values.astype(np.float32)))
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, f"{path}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    reader = UsdShade.Shader.Define(stage, f"{path}/primvar")
    reader.CreateIdAttr("UsdPrimvarReader_float2" if textured else "UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st" if textured else "displayColor")
    source, output = reader, "result"
    if textured:
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        source, output = UsdShade.Shader.Define(stage, f"{path}/texture"), "rgb"
        source.CreateIdAttr("UsdUVTexture")
        source.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(f"./{_TEXTURES}/{link.name}.png")
        source.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
        source.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        coordinates = UsdGeom.PrimvarsAPI(visual).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
        coordinates.Set(Vt.Vec2fArray.FromNumpy(uv_of(link.visual).astype(np.float32)))
    source.CreateOutput(output, Sdf.ValueTypeNames.Float3)
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(source.ConnectableAPI(), output)
    UsdShade.MaterialBindingAPI.Apply(visual.GetPrim()).Bind(material)


def _add_splats(stage: Any, path: str, splats: Splats) -> None:
    """Splats as a particle field; USD's harmonics are those of 3DGS, grouped by splat."""
    from pxr import UsdVol, Vt

    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, path)
    means, scales = splats.means.float().numpy(), splats.scales.float().numpy()
    quats = torch.nn.functional.normalize(splats.quats.float(), dim=-1).numpy()
    field.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(means))
    field.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(np.ascontiguousarray(quats[:, [1, 2, 3, 0]])))
    field.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
    field.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(splats.opacities.float().numpy()))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(math.isqrt(splats.sh.shape[1]) - 1)
    coefficients = np.ascontiguousarray(splats.sh.float().numpy().reshape(-1, 3))
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(coefficients))
    reach = 3 * scales.max(1, keepdims=True) if len(means) else scales[:, :1]
    low, high = ((means - reach).min(0), (means + reach).max(0)) if len(means) else (np.zeros(3), np.zeros(3))
    field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([low, high]).astype(np.float32)))


def _add_looks(root: Any, mechanism: Mechanism) -> None:
    """A variant set that hides the splats, or the meshes."""
    from pxr import UsdGeom

    looks = root.GetVariantSets().AddVariantSet(_LOOK)
    for shown, hidden in (("splats", "visual"), ("mesh", "splats")):
        looks.AddVariant(shown)
        looks.SetVariantSelection(shown)
        with looks.GetVariantEditContext():
            for link in mechanism.links:
                prim = root.GetStage().GetPrimAtPath(root.GetPath().AppendPath(f"{link.name}/{hidden}"))
                UsdGeom.Imageable(prim).MakeInvisible()


def _exclude_contacts(stage: Any, name: str, mechanism: Mechanism) -> None:
    from pxr import UsdPhysics

    for a, b in mechanism.pairs():
        api = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(f"/{name}/{a}"))
        api.CreateFilteredPairsRel().AddTarget(f"/{name}/{b}")


def _add_joint(stage: Any, root: str, joint: LinkJoint, mechanism: Mechanism) -> None:
    """A joint about or along the x axis of a frame of its own, with limits and a position drive."""
    from pxr import Gf, UsdPhysics

    turns = joint.kind == "revolute"
    schema = UsdPhysics.RevoluteJoint if turns else UsdPhysics.PrismaticJoint
    prim = schema.Define(stage, f"{root}/{joint.name}")
    prim.CreateBody0Rel().SetTargets([f"{root}/{mechanism.links[joint.parent].name}"])
    prim.CreateBody1Rel().SetTargets([f"{root}/{mechanism.links[joint.child].name}"])
    prim.CreateAxisAttr("X")
    turn = Gf.Quatf(Gf.Rotation(Gf.Vec3d(1, 0, 0), Gf.Vec3d(*joint.axis.tolist())).GetQuat())
    prim.CreateLocalPos0Attr(Gf.Vec3f(*joint.offset.tolist()))
    prim.CreateLocalRot0Attr(turn)
    prim.CreateLocalPos1Attr(Gf.Vec3f(0))
    prim.CreateLocalRot1Attr(turn)
    unit = math.degrees(1.0) if turns else 1.0
    prim.CreateLowerLimitAttr(joint.lower * unit)
    prim.CreateUpperLimitAttr(joint.upper * unit)
    drive = UsdPhysics.DriveAPI.Apply(prim.GetPrim(), "angular" if turns else "linear")
    drive.CreateTypeAttr("force")
    drive.CreateTargetPositionAttr(0.0)
    drive.CreateStiffnessAttr(joint.drive.stiffness / unit)
    drive.CreateDampingAttr((joint.drive.stiffness_rate + joint.drive.damping) / unit)
    drive.CreateMaxForceAttr(joint.drive.effort)

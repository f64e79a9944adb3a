"""The files that descriptions of robots refer to: OBJ visuals with MTL and texture, OBJ collision pieces."""

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals

from ..files import replace_file
from .links import Mechanism

_GREY = (0.7, 0.7, 0.7, 1.0)


def checked_name(name: str) -> str:
    """The name of a model, if every consumer takes it.

    Raises:
        ValueError: it holds other characters than A-Z, a-z, 0-9 and _.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ValueError(f"{name!r}: a model's name begins with a letter and holds only A-Z, a-z, 0-9 and _; choose another.")
    return name


def number(value: float) -> str:
    """A number as text, to 12 digits; never a negative zero."""
    return format(float(value) + 0.0, ".12g")


def numbers(values: Sequence[float] | np.ndarray) -> str:
    """Numbers as text, apart by spaces."""
    return " ".join(number(value) for value in values)


def write_meshes(mechanism: Mechanism, folder: Path) -> None:
    """Writes every link's visual and collision pieces.

    `part_1.obj` with `part_1.mtl` is a visual, with `part_1.png` where it has a texture; `part_1_collision_0.obj`, ...
    are its convex pieces.  All are in the link's frame, in metres.
    """
    for link in mechanism.links:
        write_visual(link.visual, link.name, folder)
        for i, piece in enumerate(link.pieces):
            replace_file(folder / f"{collision_name(link.name, i)}.obj", _obj_text(piece))


def collision_name(link: str, piece: int) -> str:
    """The name of a collision piece's file, without its ending, and of what stands for it in a scene."""
    return f"{link}_collision_{piece}"


def write_visual(mesh: trimesh.Trimesh, name: str, folder: Path) -> None:
    """Writes a mesh as OBJ with MTL, and with a PNG where it has a texture."""
    image = texture_of(mesh)
    r, g, b, alpha = mean_colour(mesh) if image is None else (1.0, 1.0, 1.0, 1.0)
    lines = [f"newmtl {name}", f"Kd {numbers((r, g, b))}", "Ks 0 0 0", f"d {number(alpha)}", "illum 1"]
    if image is not None:
        replace_file(folder / f"{name}.png", png_bytes(image))
        lines.append(f"map_Kd {name}.png")
    replace_file(folder / f"{name}.mtl", "\n".join(lines) + "\n")
    replace_file(folder / f"{name}.obj", _obj_text(mesh, name))


def texture_of(mesh: trimesh.Trimesh) -> Image.Image | None:
    """The picture that lies on a mesh; none where its colours are elsewhere."""
    if not isinstance(mesh.visual, TextureVisuals) or mesh.visual.uv is None:
        return None
    material = mesh.visual.material
    image = getattr(material, "image", None)
    return getattr(material, "baseColorTexture", None) if image is None else image


def uv_of(mesh: trimesh.Trimesh) -> np.ndarray:
    """Texture coordinates of the vertices, N by 2; no row where there are none."""
    uv = mesh.visual.uv if isinstance(mesh.visual, TextureVisuals) else None
    return np.zeros((0, 2)) if uv is None else np.asarray(uv)


def png_bytes(image: Image.Image) -> bytes:
    """A picture as the bytes of a PNG."""
    stream = io.BytesIO()
    image.convert("RGB").save(stream, format="PNG")
    return stream.getvalue()


def vertex_rgb(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """Colours of the vertices in [0, 1], N by 3; none where the mesh has none."""
    if not isinstance(mesh.visual, ColorVisuals) or mesh.visual.kind is None:
        return None
    return np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0


def mean_colour(mesh: trimesh.Trimesh) -> tuple[float, float, float, float]:
    """One colour for the whole mesh, rgba in [0, 1], for consumers that know neither textures nor vertex colours."""
    image, rgb = texture_of(mesh), vertex_rgb(mesh)
    if image is not None:
        rgb = np.asarray(image.convert("RGB").resize((1, 1), Image.Resampling.BOX)).reshape(1, 3) / 255.0
    if rgb is None:
        return _GREY
    r, g, b = (round(float(value), 4) for value in rgb.mean(0))
    return r, g, b, 1.0


def _obj_text(mesh: trimesh.Trimesh, material: str = "") -> str:
    """A mesh as OBJ; with a material also its colours or texture coordinates, and its normals."""
    faces = np.asarray(mesh.faces) + 1
    if not material:
        return _rows("v %.9g %.9g %.9g", mesh.vertices) + _rows("f %d %d %d", faces)
    rgb = vertex_rgb(mesh)
    text = f"mtllib {material}.mtl\nusemtl {material}\n"
    if rgb is None:
        text += _rows("v %.9g %.9g %.9g", mesh.vertices)
    else:
        text += _rows("v %.9g %.9g %.9g %.4g %.4g %.4g", np.hstack([mesh.vertices, rgb]))
    text += _rows("vn %.4g %.4g %.4g", mesh.vertex_normals)
    if texture_of(mesh) is None:
        return text + _rows("f %d//%d %d//%d %d//%d", faces.repeat(2, axis=1))
    return text + _rows("vt %.7g %.7g", uv_of(mesh)) + _rows("f %d/%d/%d %d/%d/%d %d/%d/%d", faces.repeat(3, axis=1))


def _rows(form: str, values: np.ndarray) -> str:
    return "".join(f"{form}\n" % tuple(row) for row in values.tolist())

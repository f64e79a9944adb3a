"""Meshes with colours per vertex to lighter meshes with a texture."""

from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float64, Int64, UInt8
from PIL import Image
from scipy import ndimage
from scipy.spatial import KDTree
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial

from ..jit import kernel

_NEAREST = 3  # vertices whose colours a texel mixes


def textured(mesh: trimesh.Trimesh, *, faces: int = 20_000, size: int = 1024) -> trimesh.Trimesh:
    """A lighter mesh of the same shape whose texture holds the colours of the mesh's vertices.

    Args:
        mesh: with vertex colours.
        faces: to which it is decimated.
        size: side of the texture, pixels.

    Raises:
        ValueError: an optional package is missing.
    """
    try:
        import fast_simplification
        import xatlas
    except ImportError as error:
        raise ValueError(f"textured meshes need {error.name}; run `pip install 'structuregs[sim]'`.") from error
    vertices, triangles = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    if len(triangles) > faces:
        simplify: Any = fast_simplification.simplify
        vertices, triangles = simplify(vertices, triangles, target_count=faces)
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices, triangles.astype(np.uint32))
    pack = xatlas.PackOptions()
    # A resolution is left open: with one, xatlas may spread the charts over several atlases.
    pack.padding, pack.bilinear = 2, True
    atlas.generate(pack_options=pack)
    source, triangles, uv = atlas[0]
    vertices = np.asarray(vertices, np.float64)[source]
    rgb = np.asarray(mesh.visual.vertex_colors)[:, :3]  # pyright: ignore[reportAttributeAccessIssue, reportOptionalMemberAccess]
    image = _baked(vertices, triangles.astype(np.int64), uv.astype(np.float64), size, np.asarray(mesh.vertices), rgb)
    material = SimpleMaterial(image=Image.fromarray(image))
    return trimesh.Trimesh(vertices, triangles, process=False, visual=TextureVisuals(uv=uv, material=material))


def _baked(
    vertices: Float64[np.ndarray, "P 3"],
    faces: Int64[np.ndarray, "F 3"],
    uv: Float64[np.ndarray, "P 2"],
    size: int,
    coloured: Float64[np.ndarray, "Q 3"],
    rgb: UInt8[np.ndarray, "Q 3"],
) -> UInt8[np.ndarray, "T T 3"]:
    """The texture: each texel has the colour of the coloured points nearest to its place on the surface."""
    places = np.full((size, size, 3), np.nan)
    _fill(vertices, faces, uv, places)
    rows, columns = np.nonzero(np.isfinite(places[..., 0]))
    image = np.full((size, size, 3), 255, np.uint8)
    if not len(rows):
        return image
    far, nearest = KDTree(coloured).query(places[rows, columns], k=min(_NEAREST, len(coloured)))
    far, nearest = np.reshape(far, (len(rows), -1)), np.reshape(nearest, (len(rows), -1))
    weight = 1 / (far + 1e-9)
    mixed = (rgb[nearest] * (weight / weight.sum(1, keepdims=True))[..., None]).sum(1)
    image[rows, columns] = np.rint(mixed).astype(np.uint8)
    # Gutters take the colour of the nearest chart, so that filters do not bleed white into seams.
    empty = np.ones((size, size), bool)
    empty[rows, columns] = False
    row, column = np.asarray(ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True))
    return image[row, column]


@kernel()
def _fill(vertices, faces, uv, places):
    """Writes where on the surface each texel lies, places (T T 3); the first row is at v = 1."""
    size = len(places)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by = uv[a, 0] * size, (1 - uv[a, 1]) * size, uv[b, 0] * size, (1 - uv[b, 1]) * size
        cx, cy = uv[c, 0] * size, (1 - uv[c, 1]) * size
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0:
            continue
        for row in range(max(0, int(min(ay, by, cy) - 0.5)), min(size, int(max(ay, by, cy) + 1.5))):
            for col in range(max(0, int(min(ax, bx, cx) - 0.5)), min(size, int(max(ax, bx, cx) + 1.5))):
                x, y = col + 0.5, row + 0.5
                u = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
                v = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
                if u >= 0 and v >= 0 and u + v <= 1:
                    for n in range(3):
                        places[row, col, n] = (1 - u - v) * vertices[a, n] + u * vertices[b, n] + v * vertices[c, n]

"""A clean surface for each part, from its splats as the photos' cameras see them; and files of it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float32, Float64, UInt8
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from trimesh.visual import ColorVisuals

from ..capture import Capture, ImageStack, stack_views
from ..files import replace_file
from ..geometry import SE3, Box, Camera
from ..model import ArticulatedObject, Splats
from ..raster import render_surface
from .assets import write_visual
from .texture import textured
from .tsdf import Volume

_SIZE = 600  # side of the images that depth is rendered in, pixels
_VOXELS = 250  # along the object's longest side
_TRUNCATION = 3.0  # voxels; more would close gaps and swallow thin boards
_RIM = 5  # voxels along the sides of a box where unseen space is closed off; deeper in, sight ends in the air
_FEWEST = 0.025  # share of the views that must have looked at a place before a surface is drawn there
_SPECK = 0.01  # pieces below this share of a part's largest piece are noise; a handle is larger
_EMPTY = 64  # of 255: where a photo's mask is below this, its ray meets nothing
_BATCH = 16  # views that are fused at once


def part_meshes(obj: ArticulatedObject, capture: Capture, *, voxel: float | None = None) -> list[trimesh.Trimesh]:
    """The surface of each part, in the parts' order, with vertex colours.

    Depth, rendered part by part from the training cameras of both states, is fused in the frame of the part's box.
    A part counts where it is in front of all others; where another part is in front, or the photo's mask is empty, the ray
    says how far space is empty.  What no photo saw stays open, but for a rim along the sides of the box, where what the part
    itself hides is closed: what stands on the ground has an underside.  Nothing stands beyond the box and a small margin.

    Args:
        obj: whose parts.
        capture: the photos that it was fitted to: their cameras and masks.
        voxel: side of the grid's cells, the capture's unit; default: 1/250 of the object's longest side.

    Returns:
        Meshes in the world, as the parts stand in state 0; a part that cannot be seen has no faces.
    """
    parts = obj.parts.to(torch.device("cpu"))
    corners = parts.boxes.corners.reshape(-1, 3)
    voxel = voxel or float((corners.amax(0) - corners.amin(0)).max()) / _VOXELS
    volumes = [_volume(parts.boxes.half_extents[k].double().numpy(), voxel) for k in range(len(parts))]
    for state, views in enumerate(capture.train):
        boxes = parts.boxes.moved(parts.motions) if state else parts.boxes
        pieces = parts.at_state(state).split(parts.counts)
        for looks in _batches(pieces, boxes, stack_views(views, _SIZE), _TRUNCATION * voxel):
            for k, volume in enumerate(volumes):
                volume.fuse(
                    np.stack([look.projections[k] for look in looks]),
                    np.stack([look.depth[k] for look in looks]),
                    np.stack([look.empty[k] for look in looks]),
                    np.stack([look.rgb[k] for look in looks]),
                )
    fewest = max(1.0, _FEWEST * sum(len(views) for views in capture.train))
    return [_mesh(volume, parts.boxes[k], fewest) for k, volume in enumerate(volumes)]


@dataclass(frozen=True)
class _Look:
    """What one camera says of K parts.

    Attributes:
        projections: from each box's frame to pixels.
        depth: of each part's surface where the photo shows it, 0 elsewhere.
        empty: how far the ray is known to be empty of each part where the photo does not show it.
        rgb: of each part.
    """

    projections: Float64[np.ndarray, "K 3 4"]
    depth: Float32[np.ndarray, "K H W"]
    empty: Float32[np.ndarray, "K H W"]
    rgb: Float32[np.ndarray, "K H W 3"]


def _batches(pieces: list[Splats], boxes: Box, stack: ImageStack, margin: float) -> Iterator[list[_Look]]:
    looks = (_look(pieces, boxes, camera, mask, margin) for camera, mask in zip(stack.cameras, stack.alpha, strict=True))
    for first in range(0, len(stack), _BATCH):
        yield [next(looks) for _ in range(min(_BATCH, len(stack) - first))]


def _look(pieces: list[Splats], boxes: Box, camera: Camera, mask: UInt8[np.ndarray, "H W"], margin: float) -> _Look:
    surfaces = [render_surface(piece, camera) for piece in pieces]
    depth = np.stack([surface.depth for surface in surfaces])
    distant = np.where(depth > 0, depth, np.float32(np.inf))
    front = distant.min(0)
    shown = (depth > 0) & (distant <= front + margin)
    behind = np.where(np.isfinite(front), front - margin, np.where(mask < _EMPTY, np.inf, 0)).astype(np.float32)
    return _Look(
        np.stack([_projection(camera, boxes.T_world_box[k]) for k in range(len(pieces))]),
        np.where(shown, depth, np.float32(0)),
        np.where(shown, np.float32(0), behind[None]),
        np.stack([surface.rgb for surface in surfaces]),
    )


def _projection(camera: Camera, T_world_box: SE3) -> Float64[np.ndarray, "3 4"]:
    return (camera.projection @ T_world_box.to(dtype=torch.float64).as_matrix()).numpy()


def _volume(half_extents: Float64[np.ndarray, " 3"], voxel: float) -> Volume:
    """An empty grid over a box and the truncation around it."""
    truncation = _TRUNCATION * voxel
    half = half_extents + truncation
    x, y, z = (int(n) + 1 for n in np.ceil(2 * half / voxel))
    return Volume(-half, voxel, truncation, (x, y, z))


def _mesh(volume: Volume, box: Box, fewest: float) -> trimesh.Trimesh:
    vertices, faces, rgb = volume.surface(fewest, outside=math.ceil(_TRUNCATION), rim=_RIM)
    if not len(faces):
        return trimesh.Trimesh()  # with no colours: trimesh cannot copy colours of no vertices
    world = box.T_world_box.to(dtype=torch.float64).apply(torch.from_numpy(vertices)).numpy()
    rgba = np.concatenate([np.rint(rgb.clip(0, 1) * 255), np.full((len(rgb), 1), 255)], 1).astype(np.uint8)
    return without_specks(trimesh.Trimesh(world, faces, process=False, vertex_colors=rgba), _SPECK)


def without_specks(mesh: trimesh.Trimesh, share: float) -> trimesh.Trimesh:
    """The mesh without its connected pieces whose area is below a share of the largest piece's.

    Args:
        mesh: pieces are connected where faces share a vertex.
        share: in [0, 1].
    """
    if not len(mesh.faces):
        return mesh
    faces, n = np.asarray(mesh.faces), len(mesh.vertices)
    links = coo_matrix((np.ones(2 * len(faces), bool), (faces[:, [0, 0]].ravel(), faces[:, [1, 2]].ravel())), shape=(n, n))
    piece = connected_components(links, directed=False)[1][faces[:, 0]]
    area = np.bincount(piece, weights=mesh.area_faces)
    faces = faces[area[piece] >= share * area.max()]
    used, faces = np.unique(faces, return_inverse=True)
    colours = np.asarray(mesh.visual.vertex_colors)[used] if isinstance(mesh.visual, ColorVisuals) else None
    return trimesh.Trimesh(mesh.vertices[used], faces.reshape(-1, 3), process=False, vertex_colors=colours)


def export_meshes(
    obj: ArticulatedObject,
    meshes: Sequence[trimesh.Trimesh],
    folder: Path,
    *,
    light: Sequence[trimesh.Trimesh] | None = None,
    faces: int = 20_000,
    size: int = 1024,
) -> list[Path]:
    """Writes every part's surface twice: `base.ply`, as it is, and `base.obj` with `.mtl` and `.png`, lighter and textured.

    Args:
        obj: names the parts.
        meshes: of its parts, in order, in the world in state 0, with vertex colours; a part without faces is left out.
        folder: made if it is not there.
        light: the lighter, textured meshes, where they have been made already (`textured`).
        faces: of a textured mesh, at most.
        size: side of a texture, pixels.

    Returns:
        The PLY and OBJ files.
    """
    files = []
    for k, (name, mesh) in enumerate(zip(obj.parts.names, meshes, strict=True)):
        if not len(mesh.faces):
            continue
        content = mesh.export(file_type="ply")
        assert isinstance(content, bytes)
        files.append(replace_file(folder / f"{name}.ply", content))
        write_visual(light[k] if light is not None else textured(mesh, faces=faces, size=size), name, folder)
        files.append(folder / f"{name}.obj")
    return files

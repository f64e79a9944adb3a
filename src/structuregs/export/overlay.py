"""A picture of an object's structure: boxes and joint axes drawn over photos of both states."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ..capture import Capture, View, spread_cameras, stack_views
from ..files import replacing
from ..fit.structure import structure_images, union
from ..geometry import Box, Camera
from ..model import ArticulatedObject, Joint
from .sweep import telling_order

Colour = tuple[int, int, int]

# Okabe and Ito's colours, which stay apart for colour-blind eyes; the base is grey.
_BASE: Colour = (110, 110, 110)
_PARTS: tuple[Colour, ...] = ((213, 94, 0), (0, 114, 178), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233))
_FINER = 3  # drawn this many times larger, then averaged down
_CANDIDATES = 24  # cameras of each state that are looked at
_NEAR = 0.05  # lines end this far before the camera, in the capture's unit


def draw_structure(capture: Capture, obj: ArticulatedObject, *, columns: int = 3, size: int = 360) -> Image.Image:
    """Photos of state 0 above photos of state 1, with every part's box and every joint's axis drawn over them.

    A turn is an arrow along its axis with an arc about it, from state 0 to state 1; a slide is an arrow along the way
    of the part's centre.  The photos are those on which the motion shows most, spread over the cameras.

    Args:
        capture: the photos.
        obj: what was found in them.
        columns: photos of each state.
        size: height of each photo, pixels.
    """
    rows = []
    for state, views in enumerate(capture.train):
        q = [joint.q[state] for joint in obj.joints]
        chosen = _choose(obj, views, columns)
        rows.append(np.hstack([_draw_view(view, obj, obj.boxes_at(q), size) for view in chosen]))
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    return Image.fromarray(np.vstack([_legend(obj.joints, width), *rows]))


def write_structure(capture: Capture, obj: ArticulatedObject, file: Path) -> None:
    """Writes `draw_structure` as a PNG, aside and then into place."""
    with replacing(file) as staged:
        draw_structure(capture, obj).save(staged, format="PNG")


def draw_error_maps(capture: Capture, obj: ArticulatedObject, *, size: int = 220) -> Image.Image:
    """What the losses on boxes see (supplement, figure 1), on the most telling view of each state, a row for each.

    From left to right: the photo, its mask, the structure image of all boxes, what of the mask no box covers (red), and
    what each moving part's box covers outside the mask, in the part's colour.

    Args:
        capture: the photos.
        obj: whose boxes are drawn.
        size: the side of a square with as many pixels as one picture.
    """
    rows = []
    for state, views in enumerate(capture.train):
        boxes = obj.boxes_at([joint.q[state] for joint in obj.joints])
        stack = stack_views(_choose(obj, views, 1), size)
        origin, directions = stack.cameras[0].rays()
        rays = torch.nn.functional.normalize(directions.float(), dim=-1)
        softness = 0.01 * float(boxes.half_extents.norm(dim=-1).max())
        parts = structure_images(
            Box(boxes.T_world_box.to(dtype=torch.float32), boxes.half_extents.float()), origin.float(), rays, softness
        )
        rgb, mask = stack.target(0)
        shown = [
            rgb,
            _tinted(mask, (0, 0, 0)),
            _tinted(union(parts), (0, 0, 0)),
            _tinted((1 - union(parts)) * mask, (220, 30, 30)),
        ]
        shown += [_tinted(parts[k] * (1 - mask), colour_of(k)) for k in range(1, len(parts))]
        rows.append(torch.cat(shown, 1))
    width = max(row.shape[1] for row in rows)
    rows = [torch.nn.functional.pad(row, (0, 0, 0, width - row.shape[1]), value=1.0) for row in rows]
    return Image.fromarray((torch.cat(rows) * 255).round().byte().numpy())


def _tinted(amount: Float[Tensor, "H W"], colour: Colour) -> Float[Tensor, "H W 3"]:
    """White where the amount is 0, and the colour where it is 1."""
    return 1 - amount[..., None].clamp(0, 1) * (1 - torch.tensor(colour) / 255)


def _choose(obj: ArticulatedObject, views: tuple[View, ...], count: int) -> list[View]:
    """The most telling view, and others far from it among the more telling half of a spread of candidates."""
    spread = [views[i] for i in spread_cameras([view.camera for view in views], _CANDIDATES)]
    best = [spread[i] for i in telling_order(obj, [view.camera for view in spread])]
    best = best[: max(count, len(best) // 2)]
    return [best[i] for i in spread_cameras([view.camera for view in best], count)]


def _draw_view(view: View, obj: ArticulatedObject, boxes: Box, size: int) -> np.ndarray:
    width = round(size * view.camera.width / view.camera.height)
    rgb, _ = view.image(width, size)
    photo = Image.fromarray((rgb * 255).round().astype(np.uint8)).resize((width * _FINER, size * _FINER))
    pen = Pen(photo, view.camera.resized(width * _FINER, size * _FINER))
    for k, edges in enumerate(boxes.edges):
        for edge in edges:
            pen.line(edge, colour_of(k), 1.5)
    for k, joint in enumerate(obj.joints, start=1):
        for stroke in joint_strokes(joint, obj.parts.boxes[k]):
            pen.line(stroke, (255, 255, 255), 5.0)
            pen.line(stroke, colour_of(k), 2.5)
    return np.asarray(photo.reduce(_FINER))


def colour_of(part: int) -> Colour:
    """The colour that a part is drawn in; grey for the base."""
    return _PARTS[(part - 1) % len(_PARTS)] if part else _BASE


def joint_strokes(joint: Joint, box: Box) -> list[Float[Tensor, "_ 3"]]:
    """The lines that draw a joint, in the world.

    Args:
        joint: of the part.
        box: the part's box in state 0.
    """
    axis, origin = joint.screw.axis, joint.screw.origin
    if joint.kind == "prismatic":
        return _arrow(torch.stack([origin, joint.motion(joint.q[1]).apply(origin)]))
    along = (box.corners.double() - origin) @ axis
    low, high = float(along.min()), float(along.max())
    beyond = 0.15 * max(high - low, float(box.half_extents.max()))
    line = torch.stack([origin + (low - beyond) * axis, origin + (high + beyond) * axis])
    # The arc starts towards the part's centre; where the axis runs through that, any direction across the axis will do.
    spoke = _across(box.T_world_box.xyz.double() - origin, axis)
    if float(spoke.norm()) < 1e-3 * float(box.half_extents.norm()):
        spoke = _across(torch.eye(3, dtype=torch.float64)[int(axis.abs().argmin())], axis)
    spoke = spoke / spoke.norm() * 0.5 * float(box.half_extents.norm())
    start = origin + 0.5 * (low + high) * axis + spoke
    arc = torch.stack([joint.motion(float(q)).apply(start) for q in np.linspace(*joint.q, 32)])
    return [*_arrow(line), *_arrow(arc)]


def _across(v: Float[Tensor, " 3"], axis: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    return v - axis * (axis @ v)


def _arrow(line: Float[Tensor, "P 3"]) -> list[Float[Tensor, "_ 3"]]:
    """A line with a head of four barbs at its last point."""
    tip, back = line[-1], line[-2] - line[-1]
    length = 0.12 * float((line[1:] - line[:-1]).norm(dim=-1).sum())
    if length == 0:
        return [line]
    back = back / back.norm()
    side = torch.linalg.cross(back, torch.eye(3, dtype=back.dtype)[int(back.abs().argmin())])
    side = side / side.norm()
    other = torch.linalg.cross(back, side)
    barbs = [torch.stack([tip, tip + length * (back + 0.4 * s)]) for s in (side, -side, other, -other)]
    return [line, *barbs]


class Pen:
    """Draws lines of the world on a picture."""

    def __init__(self, picture: Image.Image, camera: Camera) -> None:
        self._draw = ImageDraw.Draw(picture)
        self._camera = camera

    def line(self, points_world: Float[Tensor, "P 3"], colour: Colour, width: float) -> None:
        """A line through points, as wide as `width` pixels of the finished picture; it ends at the near plane."""
        points = points_world.double()
        _, depths = self._camera.project(points)
        for (a, b), (z_a, z_b) in zip(pairwise(points), pairwise(depths.tolist()), strict=True):
            if max(z_a, z_b) <= _NEAR:
                continue
            if min(z_a, z_b) < _NEAR:
                crossing = torch.lerp(a, b, (_NEAR - z_a) / (z_b - z_a))
                a, b = (crossing, b) if z_a < z_b else (a, crossing)
            pixels, _ = self._camera.project(torch.stack([a, b]))
            self._draw.line([(x, y) for x, y in pixels.tolist()], fill=colour, width=round(width * _FINER))


def _legend(joints: tuple[Joint, ...], width: int) -> np.ndarray:
    """A line of text for each joint, in its part's colour."""
    height = 22
    picture = Image.new("RGB", (width, height * len(joints) + 8), (255, 255, 255))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(15)
    for k, joint in enumerate(joints, start=1):
        amount = f"{math.degrees(joint.q[1]):.1f} deg" if joint.kind == "revolute" else f"{joint.q[1]:.3f} units"
        text = f"part {k}: {joint.kind}, {amount}, confidence {joint.confidence:.2f}"
        draw.text((8, 4 + height * (k - 1)), text, fill=colour_of(k), font=font)
    return np.asarray(picture)

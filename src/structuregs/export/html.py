"""A self-contained page that shows an articulated object, with a slider for each joint."""

import base64
import html
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt16
from torch import Tensor

from ..files import replace_file
from ..geometry import SE3, Camera
from ..model import ArticulatedObject, Splats
from .overlay import colour_of, joint_strokes
from .page import filled, page_file
from .sweep import telling_order

_LEVELS = 65535  # of a 16-bit number
# The page opens in the most telling direction: of those to both sides of where the parts stick out, or of all round.
_ASIDE = math.radians(40)
_OUTWARD = 0.1  # of the object's radius
_AZIMUTHS = 12
_LOOK_SIZE = 96  # pixels of the pictures that it is chosen by
_ELEVATION = math.radians(20)
_HALF_FIELD = math.pi / 9  # of view, as in controls.js


def export_html(obj: ArticulatedObject, path: Path, *, title: str = "") -> Path:
    """Writes the page of `page_of` aside, then into place; returns its path.

    Args:
        obj: what is shown.
        path: of the HTML file; its folder is made.
        title: above the picture; the file's name without its ending if empty.
    """
    return replace_file(path, page_of(obj, title=title or path.stem))


def page_of(obj: ArticulatedObject, *, title: str) -> str:
    """The text of a page that needs nothing else: opened from disk, offline, it shows the object with WebGL2.

    Joints run over their observed range.  The colours are those without a view-dependent part.
    """
    # No string of the data may end the element that holds it.
    scene = json.dumps(scene_of(obj), separators=(",", ":")).replace("<", "\\u003c")
    return _page(title, scene, "viewer.js", "controls.js")


def live_page(*, title: str) -> str:
    """The text of the same page without a scene: it asks for `scene` beside it, once a second (structuregs.view)."""
    return _page(title, "null", "viewer.js", "controls.js", "live.js", allowed="; connect-src 'self'")


def _page(title: str, scene: str, *scripts: str, allowed: str = "") -> str:
    """The page with a scene and scripts; `allowed` adds to what its security policy lets it do."""
    script = "\n".join(page_file(name) for name in scripts)
    style = page_file("viewer.css")
    return filled("viewer.html", title=html.escape(title), style=style, scene=scene, script=script, allowed=allowed)


def scene_of(obj: ArticulatedObject, *, view: dict[str, Any] | None = None) -> dict[str, Any]:
    """What the page's script draws, ready for JSON; everything in the world as it stands in state 0.

    `splats` holds 16 unsigned 16-bit numbers a splat in base64, part after part; number n of column c stands for
    `low[c] + n (high[c] - low[c]) / 65535`.  The columns: mean (3), rotation as modified Rodrigues parameters (3),
    logarithm of the scales (3), rgb halfway between the states (3), opacity, tint (3).

    Args:
        obj: what is drawn.
        view: that the page opens with; that of `first_view` if None, for which the object is rendered.
    """
    numbers, low, high = quantised(splat_columns(obj))
    return {
        "splats": base64.b64encode(numbers.astype("<u2").tobytes()).decode("ascii"),
        "low": low.tolist(),
        "high": high.tolist(),
        "parts": [
            {
                "name": "base" if k == 0 else f"part_{k}",
                "count": count,
                "colour": colour_of(k),
                "edges": _rounded(obj.parts.boxes[k].edges),
            }
            for k, count in enumerate(obj.parts.counts)
        ],
        "joints": [
            {
                "kind": joint.kind,
                "parent": joint.parent,
                "axis": joint.axis,
                "origin": joint.origin,
                "q": joint.q,
                "review": joint.review,
                "strokes": [_rounded(stroke) for stroke in joint_strokes(joint, obj.parts.boxes[k])],
            }
            for k, joint in enumerate(obj.joints, start=1)
        ],
        "view": view if view is not None else first_view(obj),
    }


def splat_columns(obj: ArticulatedObject) -> Float32[np.ndarray, "N 16"]:
    """The values of every splat in state 0, in the columns of `scene_of`."""
    splats = obj.parts.place(obj.parts.boxes, 0.0)
    columns = [
        splats.means,
        _rodrigues(splats),
        splats.log_scales,
        splats.base_rgb,
        splats.opacities[:, None],
        obj.parts.tint,
    ]
    return torch.cat([column.detach().cpu() for column in columns], 1).float().numpy()


def quantised(
    columns: Float32[np.ndarray, "N C"],
) -> tuple[UInt16[np.ndarray, "N C"], Float32[np.ndarray, " C"], Float32[np.ndarray, " C"]]:
    """16-bit numbers, and the values that the least and the greatest number of each column stand for."""
    low = columns.min(0) if len(columns) else np.zeros(columns.shape[1], np.float32)
    high = columns.max(0) if len(columns) else low
    span = np.where(high > low, high - low, 1).astype(np.float64)
    return np.rint((columns - low) / span * _LEVELS).astype(np.uint16), low, high


def _rodrigues(splats: Splats) -> Float[Tensor, "N 3"]:
    """Orientations as axis times tan(angle / 4), each in [-1, 1]: three numbers of even precision, none singular."""
    unit = torch.nn.functional.normalize(splats.quats, dim=-1)
    unit = torch.where(unit[:, :1] < 0, -unit, unit)
    return unit[:, 1:] / (1 + unit[:, :1])


def opening_camera(obj: ArticulatedObject, size: int) -> Camera:
    """The camera of a square picture that shows the whole object in both states, from where the page opens."""
    view = first_view(obj)
    return _orbiting(torch.tensor(view["target"]), view["radius"], view["azimuth"], size)


def first_view(obj: ArticulatedObject) -> dict[str, Any]:
    """Where the page's camera orbits, and the direction it starts in."""
    states = [obj.boxes_at([joint.q[s] for joint in obj.joints]) for s in (0, 1)]
    corners = torch.cat([boxes.corners.reshape(-1, 3) for boxes in states])
    target = (corners.amin(0) + corners.amax(0)) / 2
    radius = max(float((corners - target).norm(dim=-1).max()), 1e-6)
    centres = states[1].T_world_box.xyz
    out = (centres[1:] - centres[0]).mean(0)[:2] if len(obj.joints) else centres[0, :2] * 0
    azimuths = [2 * math.pi * i / _AZIMUTHS for i in range(_AZIMUTHS)]
    if float(out.norm()) > _OUTWARD * radius:
        azimuths = [math.atan2(float(out[1]), float(out[0])) + side * _ASIDE for side in (-1, 1)]
    cameras = [_orbiting(target, radius, azimuth, _LOOK_SIZE) for azimuth in azimuths]
    best = azimuths[telling_order(obj, cameras)[0]]
    return {"target": _rounded(target), "radius": radius, "azimuth": best, "elevation": _ELEVATION}


def _orbiting(target: Float[Tensor, " 3"], radius: float, azimuth: float, size: int) -> Camera:
    """The page's camera in a direction of the horizon, with a square picture into which a sphere about the target fits."""
    c, s, ce, se = math.cos(azimuth), math.sin(azimuth), math.cos(_ELEVATION), math.sin(_ELEVATION)
    R = torch.tensor([[-s, se * c, -ce * c], [c, se * s, -ce * s], [0.0, -ce, -se]])
    distance = 1.1 * radius / math.sin(_HALF_FIELD)
    focal = 0.5 * size / math.tan(_HALF_FIELD)
    return Camera(SE3.from_rotation(R, target.float() - distance * R[:, 2]), focal, focal, size / 2, size / 2, size, size)


def _rounded(values: Tensor) -> list[Any]:
    """Nested lists, short in JSON; a millionth of a unit is no longer seen."""
    rounded = np.round(values.detach().cpu().double().numpy(), 6)
    return rounded.tolist()

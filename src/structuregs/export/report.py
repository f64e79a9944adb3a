"""The report of a run: one page with what was found, how well it fits, and how it came about."""

import json
import math
from collections.abc import Iterator, Sequence
from html import escape
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from ..capture import Capture, View, spread_cameras, stack_views
from ..files import replace_file
from ..fit.run import RunFolder
from ..geometry import Camera
from ..metrics import psnr
from ..model import ArticulatedObject, Joint, Splats
from ..raster import render
from .chart import Point, line_chart
from .html import opening_camera
from .overlay import colour_of, draw_structure
from .page import image_url, plain_page, png_url
from .sweep import render_sweep, telling_order

_CANDIDATES = 12  # views of each state that the shown ones are chosen from
_PHOTO_SIZE = 380  # the side of a square with as many pixels as a picture
_SWEEP_SIZE, _SWEEP_FRAMES, _SWEEP_MS = 480, 30, 100
_BORDER = 8  # pixels of white around the animation
_UNCLEAR = 0.5  # a joint of less confidence is a warning


def write_report(run: Path, capture: Capture, obj: ArticulatedObject, *, views: int = 3) -> Path:
    """Writes `RUN/report.html` aside, then into place; returns its path.  The page needs no other file.

    Held-out photos are shown where the capture has them, photos that the fit has seen elsewhere.

    Args:
        run: folder of the run; what it lacks of `metrics.jsonl`, `timing.json`, `notes.txt` and `config.json` is left out.
        capture: the photos.
        obj: what was found in them.
        views: photos of each state beside their renderings.
    """
    folder = RunFolder(run)
    metrics = folder.records()
    seconds = folder.seconds()
    opening = opening_camera(obj, _SWEEP_SIZE)
    sections = [
        _warnings(obj, capture, folder.sentences()),
        _section("Joints", _joint_table(obj.joints) + _structure(run, capture, obj)),
        _section("Photos and renderings", _comparison(capture, obj, opening, views)),
        _section("The fit", _timing(metrics, seconds) + _curves(metrics)) if metrics else "",
        _section("Configuration", _settings(json.loads(folder.config.read_text()))) if folder.config.exists() else "",
    ]
    text = plain_page(
        "report.html",
        title=escape(capture.name),
        lead=escape(_lead(obj)),
        figures=_figures(capture, obj, metrics, seconds),
        animation=_sweep(obj, opening),
        sections="\n".join(section for section in sections if section),
        footer="Lengths are in the capture's unit, axes and origins in its frame. Written by structuregs.",
    )
    return replace_file(run / "report.html", text)


def _section(title: str, content: str) -> str:
    return f"<section>\n<h2>{title}</h2>\n{content}\n</section>"


def _lead(obj: ArticulatedObject) -> str:
    """What was found, in one sentence."""
    turns = sum(joint.kind == "revolute" for joint in obj.joints)
    slides = len(obj.joints) - turns
    if turns + slides < 2:
        return f"A base and one part that {'turns' if turns else 'slides'}." if obj.joints else "A base; nothing moves."
    kinds = [
        f"{n} that {one if n == 1 else many}" for n, one, many in ((turns, "turns", "turn"), (slides, "slides", "slide")) if n
    ]
    return f"A base and {turns + slides} moving parts: {' and '.join(kinds)}."


def _figures(capture: Capture, obj: ArticulatedObject, metrics: list[dict[str, Any]], seconds: float) -> str:
    """The numbers at the head of the page."""
    last = [record["psnr"] for record in metrics if record["psnr"] is not None][-10:]
    rows = [
        ("photos of the two states", " + ".join(str(len(state)) for state in capture.train)),
        ("splats", f"{len(obj.parts.splats):,}"),
    ]
    if last:
        rows.append(("PSNR in training", f"{sum(last) / len(last):.1f} dB"))
    if seconds:
        rows.append(("for the whole fit", _duration(seconds)))
    return "".join(f"<div><dt>{label}</dt><dd>{value}</dd></div>" for label, value in rows)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _warnings(obj: ArticulatedObject, capture: Capture, notes: Sequence[str]) -> str:
    """What a reader should know before trusting the rest; empty where there is nothing."""
    rows = [f"Part {k}: {joint.review}" for k, joint in enumerate(obj.joints, start=1) if joint.review]
    rows += [
        f"Part {k}: its joint's type and axis are not clear (confidence {joint.confidence:.2f})."
        for k, joint in enumerate(obj.joints, start=1)
        if not joint.review and joint.confidence < _UNCLEAR
    ]
    rows += [] if any(capture.test) else ["No photos were held out: the renderings are beside photos that the fit has seen."]
    items = "".join(f"<li>{escape(row)}</li>" for row in [*rows, *notes])
    return f'<section class="warnings">\n<h2>Please note</h2>\n<ul>{items}</ul>\n</section>' if items else ""


def _joint_table(joints: Sequence[Joint]) -> str:
    heads = ("Part", "Type", "Axis", "Origin", "Moved by", "Confidence", "Review")
    rows = []
    for k, joint in enumerate(joints, start=1):
        share = f'<span class="bar"><span style="width:{100 * joint.confidence:.0f}%"></span></span>'
        cells = [f"{_dot(k)}part {k}", joint.kind, _vector(joint.axis), _vector(joint.origin), _amount(joint)]
        cells.append(f"{share}{joint.confidence:.2f}")
        row = "".join(f"<td>{cell}</td>" for cell in cells)
        rows.append(f'<tr>{row}<td class="wide">{escape(joint.review) or "–"}</td></tr>')
    head = "".join(f"<th>{name}</th>" for name in heads)
    return f'<div class="scroll"><table><tr>{head}</tr>{"".join(rows)}</table></div>'


def _dot(part: int) -> str:
    return f'<span class="dot" style="background:rgb{colour_of(part)}"></span>'


def _vector(values: Sequence[float]) -> str:
    return " ".join(f"{round(value, 3) + 0.0:+.3f}".replace("-", "−") for value in values)


def _amount(joint: Joint) -> str:
    return f"{math.degrees(joint.q[1]):.1f}°" if joint.kind == "revolute" else f"{joint.q[1]:.3f} units"


def _structure(run: Path, capture: Capture, obj: ArticulatedObject) -> str:
    """Boxes and axes over photos: the run's picture, or one drawn now."""
    file = run / "overview.png"
    url = png_url(file.read_bytes()) if file.exists() else image_url(draw_structure(capture, obj), "PNG")
    return (
        "<h3>Boxes and axes over photos of state 0 (above) and state 1 (below)</h3>\n"
        f'<img src="{url}" alt="Boxes and joint axes over photos of both states">'
    )


def _comparison(capture: Capture, obj: ArticulatedObject, opening: Camera, count: int) -> str:
    """Photos of both states, each beside the rendering of its camera."""
    rows = []
    for state in (0, 1):
        held_out = bool(capture.test[state])
        views = _shown(obj, capture.test[state] if held_out else capture.train[state], opening, count)
        splats = obj.parts.at_state(state)
        kind = "held out" if held_out else "seen by the fit"
        pairs = "\n".join(_pairs(views, splats, kind))
        rows.append(f'<h3>State {state}</h3>\n<div class="pairs">\n{pairs}\n</div>')
    legend = (
        '<p class="note">Left the photo, right the rendering; the PSNR is that of the whole image over white in full size.</p>'
    )
    return legend + "\n".join(rows)


def _shown(obj: ArticulatedObject, views: Sequence[View], opening: Camera, count: int) -> list[View]:
    """Of views that are spread over the cameras, those that show most of the motion, from the side of the moving parts."""
    spread = [views[i] for i in spread_cameras([view.camera for view in views], _CANDIDATES)]
    towards = opening.T_world_camera.rotation[:, 2]
    before = [view for view in spread if float(view.camera.T_world_camera.rotation[:, 2] @ towards) > 0]
    chosen = before if len(before) >= count else spread
    return [chosen[i] for i in telling_order(obj, [view.camera for view in chosen])[:count]]


@torch.no_grad()
def _pairs(views: Sequence[View], splats: Splats, kind: str) -> Iterator[str]:
    """A figure of each view and its rendering, cropped to the object."""
    stack = stack_views(views, _PHOTO_SIZE)
    for v, view in enumerate(views):
        target, _ = view.image(view.camera.width, view.camera.height)
        error = psnr(render(splats, view.camera).rgb.clamp(0, 1), torch.from_numpy(target))
        drawn = (render(splats, stack.cameras[v]).rgb.clamp(0, 1) * 255).round().byte().numpy()
        photo, rendering = (image_url(Image.fromarray(rgb), "JPEG") for rgb in (stack.rgb[v], drawn))
        name = escape(view.name)
        yield (
            f'<figure class="pair"><div><img src="{photo}" alt="Photo {name}">'
            f'<img src="{rendering}" alt="Rendering {name}"></div>'
            f"<figcaption><span>view {name}, {kind}</span><span>{error:.1f} dB</span></figcaption></figure>"
        )


def _sweep(obj: ArticulatedObject, camera: Camera) -> str:
    """The joints moving there and back, as an animation's data URL."""
    there = islice(render_sweep(obj, camera, frames=_SWEEP_FRAMES), _SWEEP_FRAMES // 2 + 1)
    first, *others = (Image.fromarray(rgb) for rgb in _cropped(np.stack(list(there))))
    back = others[-2::-1]
    return image_url(first, "WEBP", save_all=True, append_images=others + back, duration=_SWEEP_MS, loop=0, quality=80)


def _cropped(frames: UInt8[np.ndarray, "F H W 3"]) -> UInt8[np.ndarray, "F h w 3"]:
    """Frames without the rows and columns that are white in all of them, but for a few."""
    inked = frames.min((0, 3)) < 250
    spans = []
    for lines in (inked.any(1), inked.any(0)):
        (found,) = np.nonzero(lines)
        low, high = (found[0], found[-1] + 1) if len(found) else (0, len(lines))
        spans.append(slice(max(low - _BORDER, 0), high + _BORDER))
    return frames[:, spans[0], spans[1]]


def _timing(metrics: list[dict[str, Any]], seconds: float) -> str:
    steps = metrics[-1]["step"]
    took = f" in {_duration(seconds)}, with all that came before the first ({1000 * seconds / steps:.0f} ms a step)"
    return f'<p class="note">{steps:,} steps{took if seconds else ""}.</p>'


def loss_points(metrics: list[dict[str, Any]]) -> list[Point]:
    """Step and loss of a run's records (`RunFolder.records`), where there is a loss that a logarithm can draw."""
    return [(float(record["step"]), record["loss"]) for record in metrics if (record["loss"] or 0) > 0]


def _curves(metrics: list[dict[str, Any]]) -> str:
    loss = loss_points(metrics)
    quality: list[Point] = [(float(record["step"]), record["psnr"]) for record in metrics if record["psnr"] is not None]
    charts = []
    if loss:
        charts.append(("Loss", line_chart(loss, x_label="step", y_label="Loss", log=True, colour="#d55e00")))
    if quality:
        label = "PSNR of the training photos, dB"
        charts.append((label, line_chart(quality, x_label="step", y_label=label)))
    figures = "".join(f"<figure><h3>{title}</h3>{chart}</figure>" for title, chart in charts)
    return f'<div class="curves">{figures}</div>'


def _settings(config: dict[str, Any]) -> str:
    rows = "".join(f"<div><dt>{escape(key)}</dt><dd>{escape(value)}</dd></div>" for key, value in _flat(config))
    return f'<details>\n<summary>All settings of this run</summary>\n<dl class="settings">{rows}</dl>\n</details>'


def _flat(config: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Every value of nested settings, under its keys joined by points."""
    for key, value in config.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value)

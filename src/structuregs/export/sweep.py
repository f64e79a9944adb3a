"""An object's joints swept there and back: animations and stills."""

import math
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from ..files import replacing
from ..geometry import Camera
from ..model import ArticulatedObject, Joint, Splats
from ..raster import render

_STILLS = 3
_LOOK_SIZE = 96  # pixels of the renderings that a camera is chosen by
_FORMATS = {".webp": "WEBP", ".gif": "GIF"}


def sweep_values(joints: Sequence[Joint], frames: int) -> list[list[float]]:
    """Joint values of each frame: all joints from state 0 to state 1 and back, slowly at both ends; a seamless loop."""
    progress = [(1 - math.cos(2 * math.pi * i / frames)) / 2 for i in range(frames)]
    return [[p * joint.q[1] for joint in joints] for p in progress]


def render_sweep(obj: ArticulatedObject, camera: Camera, *, frames: int = 48) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Yields the frames of the sweep over white, as bytes.

    Args:
        obj: what moves.
        camera: from where, and in which size.
        frames: of the whole way there and back.
    """
    for q in sweep_values(obj.joints, frames):
        yield _picture(obj.at(q), camera)


def write_sweep(obj: ArticulatedObject, camera: Camera, path: Path, *, frames: int = 48, seconds: float = 3.0) -> list[Path]:
    """Writes the sweep aside, then into place; returns the files.

    Args:
        obj: what moves.
        camera: from where, and in which size.
        path: `.mp4` (needs the extra `video`), `.webp` or `.gif`: an animation; `.png`: state 0, half way and state 1
            side by side; without an ending: a folder of one numbered PNG for each frame.
        frames: of the whole way there and back.
        seconds: how long an animation takes.

    Raises:
        ValueError: the path has another ending, or is an `.mp4` and the extra is missing.
    """
    ending = path.suffix.lower()
    if ending not in (*_FORMATS, ".mp4", ".png", ""):
        endings = ".mp4, .webp, .gif, .png or a folder"
        raise ValueError(f"{path}: a sweep is written as {endings}; give a path with one of these endings.")
    if ending == "":
        path.mkdir(parents=True, exist_ok=True)
        return [
            _save(Image.fromarray(rgb), path / f"{i:04d}.png", "PNG")
            for i, rgb in enumerate(render_sweep(obj, camera, frames=frames))
        ]
    path.parent.mkdir(parents=True, exist_ok=True)
    if ending == ".png":
        stops = [[joint.q[1] * i / (_STILLS - 1) for joint in obj.joints] for i in range(_STILLS)]
        return [_save(Image.fromarray(np.hstack([_picture(obj.at(q), camera) for q in stops])), path, "PNG")]
    if ending == ".mp4":
        return [_save_film(render_sweep(obj, camera, frames=frames), camera, path, frames / seconds)]
    first, *rest = (Image.fromarray(rgb) for rgb in render_sweep(obj, camera, frames=frames))
    options = {"save_all": True, "append_images": rest, "duration": round(1000 * seconds / frames), "loop": 0}
    return [_save(first, path, _FORMATS[ending], **options)]


def telling_order(obj: ArticulatedObject, cameras: Sequence[Camera]) -> list[int]:
    """Indices of the cameras, first the one whose image changes most from state 0 to state 1."""
    states = (obj.at([0.0] * len(obj.joints)), obj.at([joint.q[1] for joint in obj.joints]))
    changes = []
    for camera in cameras:
        scale = _LOOK_SIZE / max(camera.width, camera.height)
        small = camera.resized(round(camera.width * scale), round(camera.height * scale))
        before, after = (_picture(splats, small).astype(np.float32) for splats in states)
        changes.append(float(np.abs(after - before).mean()))
    return sorted(range(len(cameras)), key=lambda i: -changes[i])


def _picture(splats: Splats, camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
    with torch.no_grad():
        rgb = render(splats, camera).rgb
    return (rgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def _save(image: Image.Image, path: Path, kind: str, **options: object) -> Path:
    with replacing(path) as staged:
        image.save(staged, format=kind, **options)
    return path


def _save_film(pictures: Iterable[UInt8[np.ndarray, "H W 3"]], camera: Camera, path: Path, rate: float) -> Path:
    """An H.264 film of `rate` pictures a second; an odd width or height grows by one pixel, as the format asks."""
    try:
        import av
        from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc
    except ImportError as error:
        raise ValueError(
            f"{path}: an .mp4 needs the package av; install it with `pip install 'structuregs[video]'`."
        ) from error
    grown = ((0, camera.height % 2), (0, camera.width % 2), (0, 0))
    with replacing(path) as staged, av.open(staged, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000), options={"crf": "18"})
        stream.pix_fmt = "yuv420p"
        stream.width, stream.height = camera.width + camera.width % 2, camera.height + camera.height % 2
        # Players guess wrong where a film does not say how its colours are coded.
        stream.color_range, stream.colorspace = ColorRange.MPEG, Colorspace.ITU601
        stream.color_primaries, stream.color_trc = ColorPrimaries.BT709, ColorTrc.IEC61966_2_1
        stream.thread_count = 1  # the bytes depend on the number of threads
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(np.pad(picture, grown, mode="edge"), format="rgb24")
            film.mux(stream.encode(frame))
        film.mux(stream.encode())
    return path

"""All the files that an object can end in: which formats there are, what each needs, and where it goes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from ..capture import Capture
from ..model import ArticulatedObject
from .glb import export_glb
from .html import export_html
from .links import Mechanism, mechanism_of
from .mesh import export_meshes, part_meshes
from .mjcf import write_mjcf
from .ply import export_ply
from .texture import textured
from .urdf import write_urdf
from .usd import write_usd

# Each format, and the packages that it needs beyond the project's own, with the extra that installs them.
_SIM = {"coacd": "sim", "fast_simplification": "sim", "xatlas": "sim"}
FORMATS: dict[str, dict[str, str]] = {
    "mesh": {"fast_simplification": "sim", "xatlas": "sim"},
    "urdf": _SIM,
    "mjcf": _SIM,
    "usd": _SIM | {"pxr": "usd"},
    "ply": {},
    "glb": {},
    "html": {},
}
_OF_MESHES = {"mesh", "urdf", "mjcf", "usd", "glb"}
_OF_LINKS = {"urdf", "mjcf", "usd"}
_OF_TEXTURES = _OF_LINKS | {"mesh"}


@dataclass(frozen=True)
class Exported:
    """One step of an export is done.

    Attributes:
        what: a format, or "surfaces" or "collision pieces", which several formats share.
        files: what was written; empty for what is shared.
    """

    what: str
    files: tuple[Path, ...] = ()


def checked_formats(names: Sequence[str]) -> list[str]:
    """The formats, each once, in the order of `FORMATS`.

    Raises:
        ValueError: there is no such format, or a package that it needs is not installed.
    """
    unknown = [name for name in names if name not in FORMATS]
    if unknown or not names:
        raise ValueError(f"--to {','.join(names)}: give one or more of {','.join(FORMATS)}.")
    chosen = [name for name in FORMATS if name in names]
    missing = {extra for name in chosen for package, extra in FORMATS[name].items() if find_spec(package) is None}
    if missing:
        raise ValueError(
            f"--to {','.join(chosen)}: a package that this needs is missing; "
            f'`pip install "structuregs[{",".join(sorted(missing))}]"`.'
        )
    return chosen


def steps_of(formats: Sequence[str]) -> list[str]:
    """What `export_files` will report, in order."""
    shared = [name for name, users in (("surfaces", _OF_MESHES), ("collision pieces", _OF_LINKS)) if users & set(formats)]
    return [*shared, *formats]


def export_files(
    obj: ArticulatedObject,
    capture: Capture,
    folder: Path,
    formats: Sequence[str],
    *,
    name: str = "object",
    title: str = "object",
    scale: float = 1.0,
    limit_margin: float = 0.0,
) -> Iterator[Exported]:
    """Writes an object in some formats, each into a folder of its own, and yields what is done.

    Args:
        obj: the object.
        capture: its photos; surfaces are fused over their cameras and masks.
        folder: where the formats' folders go.
        formats: as `checked_formats` gives them.
        name: of the robot, the stage and the page's file; letters, digits and underscores.
        title: of the page.
        scale: metres per unit of the capture, for simulators and glTF; meshes, splats and the page keep the capture's unit.
        limit_margin: by how much joints may go beyond the observed range, radians or metres.

    Raises:
        ValueError: a size that is no size.
        OSError: a folder cannot be written.
    """
    if not scale > 0:
        raise ValueError(f"--scale {scale}: metres per unit must be above 0.")
    if limit_margin < 0:
        raise ValueError(f"--limit-margin {limit_margin}: give 0 or more.")
    folder.mkdir(parents=True, exist_ok=True)
    chosen = set(formats)
    meshes = part_meshes(obj, capture) if chosen & _OF_MESHES else []
    light = [textured(mesh) if len(mesh.faces) else mesh for mesh in meshes] if chosen & _OF_TEXTURES else []
    if meshes:
        yield Exported("surfaces")
    mechanism = None
    if chosen & _OF_LINKS:
        mechanism = mechanism_of(obj, light, scale=scale, limit_margin=limit_margin)
        yield Exported("collision pieces")
    for kind in formats:
        target = folder / kind
        if mechanism is not None and kind in _OF_LINKS:
            yield Exported(kind, (_simulated(obj, mechanism, target, kind, name, scale),))
        elif kind == "mesh":
            yield Exported(kind, tuple(export_meshes(obj, meshes, target, light=light)))
        elif kind == "ply":
            yield Exported(kind, tuple(export_ply(obj, target)))
        elif kind == "glb":
            yield Exported(kind, tuple(export_glb(obj, meshes, target, scale=scale)))
        else:
            yield Exported(kind, (export_html(obj, target / f"{name}.html", title=title),))


def _simulated(obj: ArticulatedObject, mechanism: Mechanism, folder: Path, kind: str, name: str, scale: float) -> Path:
    if kind == "urdf":
        return write_urdf(mechanism, folder, name=name)
    if kind == "mjcf":
        return write_mjcf(mechanism, folder, name=name)
    return write_usd(obj, mechanism, folder, name=name, scale=scale)

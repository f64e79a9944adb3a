"""structuregs: photos of an articulated object in two states go in; a working digital twin comes out."""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .capture import Capture, CaptureError, View, load_capture
    from .evaluate import Report, evaluate_object, evaluate_run
    from .export import (
        draw_structure,
        export_files,
        export_glb,
        export_html,
        export_meshes,
        export_mjcf,
        export_ply,
        export_urdf,
        export_usd,
        part_meshes,
        render_sweep,
        write_report,
        write_sweep,
    )
    from .fit.reconstruct import reconstruct
    from .geometry import SE3, Box, Camera, Screw
    from .joints import articulate, joints_of
    from .model import ArticulatedObject, Joint, PosedParts, Splats, load_object, save_object
    from .raster import render

__all__ = [
    "SE3",
    "ArticulatedObject",
    "Box",
    "Camera",
    "Capture",
    "CaptureError",
    "Joint",
    "PosedParts",
    "Report",
    "Screw",
    "Splats",
    "View",
    "articulate",
    "draw_structure",
    "evaluate_object",
    "evaluate_run",
    "export_files",
    "export_glb",
    "export_html",
    "export_meshes",
    "export_mjcf",
    "export_ply",
    "export_urdf",
    "export_usd",
    "joints_of",
    "load_capture",
    "load_object",
    "part_meshes",
    "reconstruct",
    "render",
    "render_sweep",
    "save_object",
    "write_report",
    "write_sweep",
]

# Threads that wait for others sleep instead of spinning: on cores that are shared with other work, spinning makes every
# kernel wait for a thread that is not running.  OpenMP reads this once, when it is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# The rooms need torch, which takes a second to import: each name is fetched from its room when it is first used.
_ROOMS = {
    "capture": ("Capture", "CaptureError", "View", "load_capture"),
    "evaluate": ("Report", "evaluate_object", "evaluate_run"),
    "export": (
        "draw_structure",
        "export_files",
        "export_glb",
        "export_html",
        "export_meshes",
        "export_mjcf",
        "export_ply",
        "export_urdf",
        "export_usd",
        "part_meshes",
        "render_sweep",
        "write_report",
        "write_sweep",
    ),
    "fit.reconstruct": ("reconstruct",),
    "geometry": ("SE3", "Box", "Camera", "Screw"),
    "joints": ("articulate", "joints_of"),
    "model": ("ArticulatedObject", "Joint", "PosedParts", "Splats", "load_object", "save_object"),
    "raster": ("render",),
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f".{_ROOM_OF[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]

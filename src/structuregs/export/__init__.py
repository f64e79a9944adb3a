"""An articulated object to pictures, pages, meshes, splat files and simulators' files."""

from .files import FORMATS, Exported, checked_formats, export_files, steps_of
from .glb import export_glb
from .html import export_html
from .links import Mechanism, mechanism_of
from .mesh import export_meshes, part_meshes
from .mjcf import export_mjcf
from .overlay import draw_structure, write_structure
from .ply import export_ply
from .report import write_report
from .sweep import render_sweep, sweep_values, telling_order, write_sweep
from .urdf import export_urdf
from .usd import export_usd

__all__ = [
    "FORMATS",
    "Exported",
    "Mechanism",
    "checked_formats",
    "draw_structure",
    "export_files",
    "export_glb",
    "export_html",
    "export_meshes",
    "export_mjcf",
    "export_ply",
    "export_urdf",
    "export_usd",
    "mechanism_of",
    "part_meshes",
    "render_sweep",
    "steps_of",
    "sweep_values",
    "telling_order",
    "write_report",
    "write_structure",
    "write_sweep",
]

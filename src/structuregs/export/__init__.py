"""An articulated object to pictures and animations."""

from .overlay import draw_structure, write_structure
from .sweep import render_sweep, sweep_values, telling_order, write_sweep

__all__ = ["draw_structure", "render_sweep", "sweep_values", "telling_order", "write_structure", "write_sweep"]

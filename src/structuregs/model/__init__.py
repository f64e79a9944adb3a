"""The nouns: splats, posed parts, joints, the articulated object; saving and loading them."""

from .joint import Joint
from .object import ArticulatedObject, load_object, save_object
from .parts import PosedParts
from .splats import SH_C0, Splats

__all__ = ["SH_C0", "ArticulatedObject", "Joint", "PosedParts", "Splats", "load_object", "save_object"]

"""Known articulated objects, rendered with truth: for the demo and the tests."""

from .catalog import OBJECTS, Front, make_object, random_object
from .objects import KnownObject, KnownPart, Texture, TexturedBox
from .render import Lighting, Picture, draw
from .scene import RenderOptions, make_capture, orbit, save_known

__all__ = [
    "OBJECTS",
    "Front",
    "KnownObject",
    "KnownPart",
    "Lighting",
    "Picture",
    "RenderOptions",
    "Texture",
    "TexturedBox",
    "draw",
    "make_capture",
    "make_object",
    "orbit",
    "random_object",
    "save_known",
]

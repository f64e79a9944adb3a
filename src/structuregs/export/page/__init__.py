"""The pages that are written: templates, styles and scripts, and how they become one file."""

import base64
import io
from importlib.resources import files
from typing import Any

from PIL import Image


def page_file(name: str) -> str:
    """The text of a file of this folder."""
    return files(__name__).joinpath(name).read_text(encoding="utf-8").rstrip("\n")


def filled(template: str, **fields: str) -> str:
    """A template of this folder with a field's text for each `{{name}}`; what the fields hold is left as it is.

    Args:
        template: name of the file.
        fields: HTML, or what goes into a style or a script.
    """
    first, *pieces = page_file(template).split("{{")
    texts = (piece.partition("}}") for piece in pieces)
    return first + "".join(fields[name] + rest for name, _, rest in texts)


def plain_page(template: str, *, title: str, **fields: str) -> str:
    """A page without scripts, in the report's style, whose body is a template of this folder; `title` and fields are HTML."""
    body = filled(template, title=title, **fields)
    return filled("plain.html", title=title, style=page_file("report.css"), body=body)


def image_url(image: Image.Image, kind: str, **options: Any) -> str:
    """An image as a data URL.

    Args:
        image: what is shown.
        kind: "JPEG", "PNG" or "WEBP".
        options: as Pillow's `save` takes them.
    """
    data = base64.b64encode(image_bytes(image, kind, **options)).decode("ascii")
    return f"data:image/{kind.lower()};base64,{data}"


def image_bytes(image: Image.Image, kind: str, **options: Any) -> bytes:
    """An image as a file holds it; arguments as of `image_url`."""
    memory = io.BytesIO()
    quality = {"quality": 88} if kind == "JPEG" else {}
    image.save(memory, format=kind, **quality, **options)
    return memory.getvalue()


def png_url(data: bytes) -> str:
    """The bytes of a PNG file as a data URL."""
    return f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"

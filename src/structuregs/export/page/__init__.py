"""The pages that are written: templates, styles and scripts, and how they become one file."""

from importlib.resources import files


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

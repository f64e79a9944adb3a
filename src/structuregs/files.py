"""Files that are there whole or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Where to write a file aside (`name.part.ending`): it takes the place of `path` in the end, and goes if that fails.

    Folders are made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    staged = path.with_stem(f"{path.stem}.part")
    try:
        yield staged
        staged.replace(path)
    finally:
        staged.unlink(missing_ok=True)


def replace_file(path: Path, content: str | bytes) -> Path:
    """Writes a file aside, then into place, and makes its folders; returns its path."""
    with replacing(path) as staged:
        staged.write_bytes(content.encode() if isinstance(content, str) else content)
    return path

import ast
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from jaxtyping import TypeCheckError

import structuregs
from structuregs.geometry import SE3

PACKAGE = Path(structuregs.__file__).parent

# A room imports only rooms of lower levels; the two doors may import all of them.
LEVELS = {
    "files": 0,
    "geometry": 0,
    "jit": 0,
    "model": 1,
    "capture": 1,
    "metrics": 1,
    "raster": 2,
    "points": 2,
    "boxes": 3,
    "joints": 2,
    "synthetic": 3,
    "fit": 4,
    "export": 5,
    "evaluate": 6,
    "view": 6,
    "console": 7,
}
DOORS = {"__init__", "cli"}
# The one room that may import a heavy package.
ONLY_IN = {"gsplat": "raster"}


def room_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports_of(file: Path) -> set[str]:
    """Absolute names of the modules that a file imports, relative ones resolved."""
    package = ["structuregs", *file.relative_to(PACKAGE).parts[:-1]]
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names |= {module} if node.module else {f"{module}.{alias.name}" for alias in node.names}
    return names


FILES = sorted(PACKAGE.rglob("*.py"))


def test_every_room_has_a_level():
    assert {room_of(file) for file in FILES} <= LEVELS.keys() | DOORS


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_rooms_import_only_lower_levels(file):
    room = room_of(file)
    if room in DOORS:
        return
    others = {name.split(".")[1] for name in imports_of(file) if name.startswith("structuregs.")} - {room}
    wrong = {other for other in others if LEVELS.get(other, 99) >= LEVELS[room]}
    assert not wrong, f"{file.name} (level {LEVELS[room]}) imports {wrong}"


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_heavy_packages_stay_in_their_rooms(file):
    top = {name.split(".")[0] for name in imports_of(file)}
    assert not {package for package, room in ONLY_IN.items() if package in top and room_of(file) != room}


def test_modules_of_a_room_import_each_other_in_no_circle():
    graph = {module_name(file): imports_of(file) for file in FILES if file.name != "__init__.py"}
    seen: dict[str, str] = {}

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, f"circle: {' -> '.join([*path, name])}"
        if name in graph and name not in seen:
            for other in graph[name]:
                visit(other, (*path, name))
            seen[name] = "done"

    for name in graph:
        visit(name, ())


def module_name(file: Path) -> str:
    return ".".join(["structuregs", *file.relative_to(PACKAGE).with_suffix("").parts])


def modules_after(code: str) -> set[str]:
    script = f"import sys; {code}; print(*sys.modules)"
    return set(subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout.split())


def test_importing_the_package_and_its_help_loads_nothing_heavy():
    assert not modules_after("import structuregs") & {"torch", "numpy", "numba", "scipy"}
    help_of_fit = "sys.argv[1:] = ['fit', '--help']; import io, contextlib, structuregs.cli as c\n"
    help_of_fit += "with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit): c.main()\n"
    assert not modules_after(f"exec({help_of_fit!r})") & {"torch", "numba", "scipy"}


def test_every_public_name_is_there():
    for name in structuregs.__all__:
        assert getattr(structuregs, name).__name__ == name
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = structuregs.nothing_of_the_kind


def test_shapes_are_checked_while_tests_run():
    """Fails where the jaxtyping hook or its type checker is off: then no annotation of the package is checked."""
    with pytest.raises(TypeCheckError):
        SE3(torch.zeros(6))

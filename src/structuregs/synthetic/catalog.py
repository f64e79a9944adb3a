"""The known objects by name; the seed varies their sizes and textures.  Fronts face -y, z is up, about two units in size."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ..capture import TrueJoint
from .boards import Point, board, hinge, opened, texture, walls
from .objects import KnownObject, KnownPart, Texture, TexturedBox
from .things import THINGS

_GAP = 0.012  # between a front and its neighbours
_BOARD = 0.05  # thickness of boards


@dataclass(frozen=True)
class Front:
    """What closes one compartment of a cupboard.

    Attributes:
        kind: a hinged door, a drawer with its tray, or nothing.
        q0, q1: how far it is open in state 0 and in state 1: degrees, or the share of the tray's depth.
        hinge: the side of a door's hinge, seen from the front.
    """

    kind: Literal["door", "drawer", "open"]
    q0: float = 0.0
    q1: float = 0.0
    hinge: Literal["left", "right"] = "left"


def make_object(name: str, seed: int = 0) -> KnownObject:
    """The known object of that name.

    Raises:
        ValueError: there is none of that name.
    """
    if name not in OBJECTS:
        raise ValueError(f"synthetic object {name!r}: there is none of that name; choose one of {', '.join(OBJECTS)}.")
    return OBJECTS[name](np.random.default_rng(seed))


def random_object(seed: int, parts: int) -> KnownObject:
    """A cupboard with `parts` doors and drawers in two columns (one for a single part), some shut in state 0, some not."""
    rng = np.random.default_rng(seed)
    columns = 1 if parts == 1 else 2
    fronts = []
    for i in range(parts):
        shut = rng.random() < 0.5
        if rng.random() < 0.5:
            q0 = 0.0 if shut else rng.uniform(10, 30)
            outer = "right" if i % columns else "left"  # doors in the middle would swing into each other
            fronts.append(Front("door", q0, q0 + rng.uniform(40, 70), outer))
        else:
            q0 = 0.0 if shut else rng.uniform(0.1, 0.3)
            fronts.append(Front("drawer", q0, q0 + rng.uniform(0.35, 0.6)))
    fronts += [Front("open")] * (-parts % columns)
    rows = [fronts[i : i + columns] for i in range(0, len(fronts), columns)]
    return _cupboard(f"random_{seed}_{parts}", rng, rng.uniform(1.1, 1.5), rng.uniform(0.6, 0.9), rng.uniform(1.1, 1.5), rows)


def _cabinet(rng: np.random.Generator) -> KnownObject:
    """A door below and a drawer above, both shut in state 0."""
    rows = [[Front("door", 0.0, rng.uniform(60, 75))], [Front("drawer", 0.0, rng.uniform(0.55, 0.7))]]
    return _cupboard("cabinet", rng, rng.uniform(1.0, 1.2), rng.uniform(0.75, 0.9), rng.uniform(1.2, 1.4), rows, (0.65, 0.35))


def _fridge(rng: np.random.Generator) -> KnownObject:
    """Two doors with hinges on one side: the lower one ajar in state 0, the upper one shut."""
    rows = [[Front("door", 20.0, rng.uniform(75, 90), "right")], [Front("door", 0.0, rng.uniform(50, 60), "right")]]
    return _cupboard("fridge", rng, rng.uniform(0.7, 0.85), rng.uniform(0.65, 0.8), rng.uniform(1.5, 1.7), rows, (0.62, 0.38))


def _door(rng: np.random.Generator) -> KnownObject:
    """One door, ajar in state 0."""
    return _cupboard(
        "door", rng, 1.0, rng.uniform(0.6, 0.8), rng.uniform(1.1, 1.3), [[Front("door", 15.0, rng.uniform(60, 75))]]
    )


def _drawer(rng: np.random.Generator) -> KnownObject:
    """One drawer below an open compartment, shut in state 0."""
    rows = [[Front("drawer", 0.0, rng.uniform(0.5, 0.7))], [Front("open")]]
    return _cupboard("drawer", rng, rng.uniform(1.0, 1.3), rng.uniform(0.7, 0.9), 0.9, rows)


def _laptop(rng: np.random.Generator) -> KnownObject:
    """A screen on a hinge behind the keys, open in both states."""
    w, d = rng.uniform(0.6, 0.7), rng.uniform(0.42, 0.5)
    shell = texture(rng, "noise")
    base = [
        board((-w, -d, 0), (w, d, 0.07), shell),
        board((-0.85 * w, -0.2 * d, 0.07), (0.85 * w, 0.8 * d, 0.085), texture(rng, "checker", 9.0)),
        board((-0.25 * w, -0.85 * d, 0.07), (0.25 * w, -0.35 * d, 0.078), texture(rng, "plain")),
    ]
    screen = [
        board((-w, -d, 0.09), (w, d, 0.14), replace(shell, seed=shell.seed + 1)),
        board((-0.9 * w, -0.85 * d, 0.082), (0.9 * w, 0.85 * d, 0.09), texture(rng, "stripes", 3.0)),
    ]
    joint = hinge((-1, 0, 0), (0, d, 0.09), 40.0, rng.uniform(100, 115))
    return KnownObject("laptop", (KnownPart("base", tuple(base)), opened("screen", screen, joint)))


def _slider(rng: np.random.Generator) -> KnownObject:
    """A carriage on a rail, in plain sight in both states."""
    rail, stop = texture(rng, "stripes", 4.0), texture(rng, "checker", 6.0)
    base = [
        board((-1, -0.25, 0), (1, 0.25, 0.1), rail),
        board((-1, -0.06, 0.1), (1, 0.06, 0.2), texture(rng, "wood")),
        board((-1, -0.2, 0.1), (-0.94, 0.2, 0.4), stop),
        board((0.94, -0.2, 0.1), (1, 0.2, 0.4), stop),
    ]
    half, height = rng.uniform(0.18, 0.25), rng.uniform(0.45, 0.6)
    carriage = [
        board((-0.9, -0.22, 0.21), (-0.9 + 2 * half, 0.22, height), texture(rng, "checker", 5.0)),
        board((-0.85, -0.08, height), (-0.9 + 1.4 * half, 0.08, height + 0.15), texture(rng, "noise")),
    ]
    joint = TrueJoint("prismatic", (1.0, 0.0, 0.0), (0.0, 0.0, 0.2), 0.0, rng.uniform(0.7, 0.9))
    return KnownObject("slider", (KnownPart("base", tuple(base)), KnownPart("carriage", tuple(carriage), joint)))


def _stapler(rng: np.random.Generator) -> KnownObject:
    """An arm that reaches across its hinge to both sides."""
    length, metal = rng.uniform(0.95, 1.15), texture(rng, "plain")
    base = [
        board((-0.2, -length, 0), (0.2, 0.35, 0.08), texture(rng, "checker", 5.0)),
        board((-0.2, -0.12, 0.08), (-0.14, 0.12, 0.46), metal),
        board((0.14, -0.12, 0.08), (0.2, 0.12, 0.46), metal),
    ]
    arm = [
        board((-0.13, -length, 0.27), (0.13, 0.2, 0.42), texture(rng, "stripes", 5.0)),
        board((-0.08, -0.97 * length, 0.22), (0.08, -0.2, 0.27), texture(rng, "noise")),
    ]
    joint = hinge((-1, 0, 0), (0, 0, 0.34), 5.0, rng.uniform(40, 50))
    return KnownObject("stapler", (KnownPart("base", tuple(base)), opened("arm", arm, joint)))


def _chest(rng: np.random.Generator) -> KnownObject:
    """A chest with a hollow lid, ajar in state 0."""
    w, d, h, t = rng.uniform(0.7, 0.85), rng.uniform(0.42, 0.5), rng.uniform(0.5, 0.65), _BOARD
    wood, lid = texture(rng, "wood"), texture(rng, "stripes", 3.0)
    joint = hinge((-1, 0, 0), (0, d, h), 15.0, rng.uniform(70, 85))
    base = [board((-w, -d, 0), (w, d, t), wood), *walls((-w, -d, t), (w, d, h), t, wood)]
    top = h + 0.2
    cover = [board((-w, -d, top), (w, d, top + t), lid), *walls((-w, -d, h + 0.005), (w, d, top), t, lid)]
    cover.append(board((-0.1, -d - 0.04, h + 0.03), (0.1, -d, h + 0.12), texture(rng, "plain")))
    return KnownObject("chest", (KnownPart("base", tuple(base)), opened("lid", cover, joint)))


def _static(rng: np.random.Generator) -> KnownObject:
    """A stool: nothing moves."""
    legs = texture(rng, "wood")
    boxes = [board((-0.6, -0.5, 0.7), (0.6, 0.5, 0.8), texture(rng, "checker", 3.0))]
    boxes += [board((x - 0.06, y - 0.06, 0), (x + 0.06, y + 0.06, 0.7), legs) for x in (-0.5, 0.5) for y in (-0.4, 0.4)]
    return KnownObject("static", (KnownPart("base", tuple(boxes)),))


def _block(rng: np.random.Generator) -> KnownObject:
    """One convex block: nothing moves."""
    return KnownObject("block", (KnownPart("base", (board((-0.6, -0.4, 0), (0.6, 0.4, 0.5), texture(rng, "checker", 3.0)),)),))


OBJECTS: dict[str, Callable[[np.random.Generator], KnownObject]] = {
    "cabinet": _cabinet,
    "laptop": _laptop,
    "slider": _slider,
    "stapler": _stapler,
    "chest": _chest,
    "fridge": _fridge,
    "door": _door,
    "drawer": _drawer,
    "static": _static,
    "block": _block,
    **THINGS,
}


def _cupboard(
    name: str,
    rng: np.random.Generator,
    width: float,
    depth: float,
    height: float,
    rows: Sequence[Sequence[Front]],
    shares: Sequence[float] | None = None,
) -> KnownObject:
    """A cupboard of compartments in rows from below, whose heights have the given shares (default: equal)."""
    t, w, d = _BOARD, width / 2, depth / 2
    body = texture(rng, "wood")
    shell = [board((-w, -d, 0), (w, d, t), body), board((-w, -d, height - t), (w, d, height), body)]
    shell += walls((-w, -d, t), (w, d, height - t), t, body)[1:]
    levels = t + (height - 2 * t) * np.cumsum([0, *(shares or [1 / len(rows)] * len(rows))])
    parts = []
    for i, row in enumerate(rows):
        low, high = float(levels[i]), float(levels[i + 1])
        if i:
            shell.append(board((t - w, -d, low - t / 2), (w - t, d - t, low + t / 2), body))
        sides = np.linspace(-w, w, len(row) + 1)
        shell += [board((x - t / 2, -d, low + t / 2), (x + t / 2, d - t, high - t / 2), body) for x in sides[1:-1]]
        for j, front in enumerate(row):
            if front.kind != "open":
                corners = ((float(sides[j]), -d, low), (float(sides[j + 1]), d - t, high))
                parts.append((_make_door if front.kind == "door" else _make_drawer)(front, *corners, rng))
    return KnownObject(name, (KnownPart("base", tuple(shell)), *parts))


def _make_door(front: Front, low: Point, high: Point, rng: np.random.Generator) -> KnownPart:
    """A slab with a handle before the compartment between two corners, hinged at the edge that touches the body."""
    slab = _front_slab(low, high, texture(rng))
    left = front.hinge == "left"
    edge = low[0] + _GAP if left else high[0] - _GAP
    free = high[0] - 0.1 if left else low[0] + 0.1
    middle, face = (low[2] + high[2]) / 2, low[1] - _BOARD
    handle = board((free - 0.025, face - 0.05, middle - 0.12), (free + 0.025, face, middle + 0.12), texture(rng, "plain"))
    joint = hinge((0, 0, -1) if left else (0, 0, 1), (edge, low[1], middle), front.q0, front.q1)
    return opened("door", [slab, handle], joint)


def _make_drawer(front: Front, low: Point, high: Point, rng: np.random.Generator) -> KnownPart:
    """A slab with a handle and an open tray behind it."""
    slab = _front_slab(low, high, texture(rng))
    middle, level, face = (low[0] + high[0]) / 2, (low[2] + high[2]) / 2, low[1] - _BOARD
    handle = board((middle - 0.12, face - 0.05, level - 0.025), (middle + 0.12, face, level + 0.025), texture(rng, "plain"))
    inside, t = _BOARD + _GAP, 0.03
    length = 0.92 * (high[1] - low[1])
    a = (low[0] + inside, low[1], low[2] + inside)
    b = (high[0] - inside, low[1] + length, low[2] + 0.75 * (high[2] - low[2]))
    wood = texture(rng, "wood")
    tray = [board(a, (b[0], b[1], a[2] + t), wood), *walls((a[0], a[1], a[2] + t), b, t, wood)[1:]]
    joint = TrueJoint("prismatic", (0.0, -1.0, 0.0), (middle, low[1], level), front.q0 * length, front.q1 * length)
    return opened("drawer", [slab, handle, *tray], joint)


def _front_slab(low: Point, high: Point, texture: Texture) -> TexturedBox:
    """The board before a compartment; it overlaps the frame and leaves a gap to its neighbours."""
    return board((low[0] + _GAP, low[1] - _BOARD, low[2] + _GAP), (high[0] - _GAP, low[1], high[2] - _GAP), texture)

"""Known objects that are no furniture to put things in: thin, crossing, far-turning ones, and ones that hide what moves."""

import math
from collections.abc import Callable

import numpy as np
import torch

from ..capture import TrueJoint
from ..geometry import Screw
from .boards import Point, board, hinge, opened, texture, walls
from .objects import KnownObject, KnownPart, TexturedBox


def _thing(name: str, base: list[TexturedBox], *parts: KnownPart) -> KnownObject:
    return KnownObject(name, (KnownPart("base", tuple(base)), *parts))


def _sliding(axis: Point, q0: float, q1: float) -> TrueJoint:
    x, y, z = map(float, axis)
    return TrueJoint("prismatic", (x, y, z), (0.0, 0.0, 0.0), q0, q1)


def _chair(rng: np.random.Generator) -> KnownObject:
    """A folding chair: the seat swings up between the legs."""
    wood, cloth = texture(rng, "wood"), texture(rng, "checker")
    lean = Screw("revolute", torch.tensor([1.0, 0, 0], dtype=torch.float64), torch.zeros(3, dtype=torch.float64)).motion(-0.26)
    frame = [board((x - 0.04, -0.04, 0), (x + 0.04, 0.04, 1.6), wood) for x in (-0.5, 0.5)]
    frame += [board((-0.46, -0.03, 1.1), (0.46, 0.03, 1.55), texture(rng, "stripes"))]
    frame += [board((-0.46, -0.03, 0.2), (0.46, 0.03, 0.28), wood)]
    seat = [board((-0.44, -0.75, 0.68), (0.44, 0.1, 0.75), cloth)]
    seat += [board((x - 0.04, -0.7, 0.62), (x + 0.04, 0.05, 0.68), wood) for x in (-0.38, 0.38)]
    joint = hinge((-1, 0, 0), (0, 0.15, 0.7), 0.0, rng.uniform(65, 75))
    return _thing("chair", [item.moved(lean) for item in frame], opened("seat", seat, joint))


def _faucet(rng: np.random.Generator) -> KnownObject:
    """A lever on top of a faucet."""
    metal = texture(rng, "stripes", 5.0)
    base = [
        board((-0.5, -0.4, 0), (0.5, 0.4, 0.08), texture(rng, "noise")),
        board((-0.12, -0.12, 0.08), (0.12, 0.12, 0.8), metal),
        board((-0.08, -0.9, 0.6), (0.08, -0.12, 0.74), metal),
        board((-0.08, -0.9, 0.4), (0.08, -0.76, 0.6), metal),
    ]
    lever = [
        board((-0.12, -0.12, 0.82), (0.12, 0.12, 0.95), texture(rng, "checker", 6.0)),
        board((-0.06, -0.75, 0.95), (0.06, 0.1, 1.03), texture(rng, "noise")),
    ]
    return _thing("faucet", base, opened("lever", lever, hinge((0, 0, 1), (0, 0, 0), -30.0, rng.uniform(50, 70))))


def _glasses(rng: np.random.Generator) -> KnownObject:
    """Two thin temples, each on a hinge of its own."""
    rim = texture(rng, "stripes", 6.0)
    base = [board((-0.12, -0.04, 0.25), (0.12, 0.04, 0.35), rim)]
    for x in (-0.5, 0.5):
        base += [board((x - 0.4, -0.04, z), (x + 0.4, 0.04, z + 0.1), rim) for z in (-0.1, 0.4)]
        base += [board((x + side - 0.05, -0.04, 0), (x + side + 0.05, 0.04, 0.4), rim) for side in (-0.35, 0.35)]
    temples = []
    for side, name in ((-1, "left"), (1, "right")):
        low, high = side * 0.92 - 0.03, side * 0.92 + 0.03
        temple = [
            board((low, 0.06, 0.32), (high, 1.3, 0.42), texture(rng, "checker", 6.0)),
            board((low, 1.2, 0.2), (high, 1.3, 0.32), texture(rng, "noise")),
        ]
        temples.append(opened(name, temple, hinge((0, 0, side), (side * 0.92, 0.05, 0), 0.0, rng.uniform(25, 35))))
    return _thing("glasses", base, *temples)


def _jackknife(rng: np.random.Generator) -> KnownObject:
    """A blade that turns far out of its handle."""
    handle = texture(rng, "checker", 6.0)
    base = [board((-1, y - 0.025, 0), (0.1, y + 0.025, 0.3), handle) for y in (-0.125, 0.125)]
    base += [board((-1, -0.1, 0), (-0.1, 0.1, 0.05), texture(rng, "plain"))]
    blade = [board((-0.85, -0.04, 0.1), (0.05, 0.04, 0.28), texture(rng, "stripes", 5.0))]
    joint = hinge((0, 1, 0), (0, 0, 0.19), 15.0, rng.uniform(155, 170))
    return _thing("jackknife", base, opened("blade", blade, joint))


def _knife(rng: np.random.Generator) -> KnownObject:
    """A blade that slides out of the handle that hides it, pushed by a knob."""
    handle = texture(rng, "checker", 6.0)
    base = [board((-1, -0.12, 0), (0.2, 0.12, 0.05), handle), board((-1, -0.08, 0.05), (-0.95, 0.08, 0.12), handle)]
    base += [board((-1, y - 0.045, 0.12), (0.2, y + 0.045, 0.17), handle) for y in (-0.075, 0.075)]
    base += [board((-1, y - 0.02, 0.05), (0.2, y + 0.02, 0.12), handle) for y in (-0.1, 0.1)]
    knob = texture(rng, "plain")
    blade = [
        board((-0.75, -0.07, 0.07), (0.25, 0.07, 0.1), texture(rng, "stripes", 7.0)),
        board((-0.27, -0.02, 0.1), (-0.23, 0.02, 0.18), knob),
        board((-0.3, -0.06, 0.18), (-0.2, 0.06, 0.24), knob),
    ]
    return _thing("knife", base, opened("blade", blade, _sliding((1, 0, 0), 0.05, rng.uniform(0.35, 0.45))))


def _oven(rng: np.random.Generator) -> KnownObject:
    """A door on a hinge below, with a bar for a handle, and a rack behind it."""
    shell = texture(rng, "noise")
    base = [board((-0.6, -0.5, z), (0.6, 0.5, z + 0.05), shell) for z in (-0.05, 1.1)]
    base += walls((-0.6, -0.5, 0), (0.6, 0.5, 1.1), 0.05, shell)[1:]
    base += [board((-0.55, -0.5, 0.85), (0.55, -0.46, 1.1), texture(rng, "stripes"))]
    base += [board((-0.55, -0.4, 0.35), (0.55, 0.4, 0.37), texture(rng, "checker", 8.0))]
    bar = texture(rng, "plain")
    door = [board((-0.58, -0.56, 0.02), (0.58, -0.51, 0.83), texture(rng, "checker", 3.0))]
    door += [board((-0.5, -0.66, 0.72), (0.5, -0.62, 0.76), bar)]
    door += [board((x - 0.025, -0.62, 0.72), (x + 0.025, -0.56, 0.76), bar) for x in (-0.475, 0.475)]
    return _thing("oven", base, opened("door", door, hinge((1, 0, 0), (0, -0.5, 0), 0.0, rng.uniform(70, 88))))


def _scissors(rng: np.random.Generator) -> KnownObject:
    """Two blades that cross."""

    def blade(z: float, side: int) -> list[TexturedBox]:
        ring = texture(rng, "checker", 6.0)
        near, far = sorted((side * 0.02, side * 0.27))
        boards = [board((-0.15, -0.06, z), (1.0, 0.06, z + 0.05), texture(rng, "noise"))]
        boards += [board((-0.6, -0.06, z), (-0.15, 0.06, z + 0.05), texture(rng, "stripes", 5.0))]
        boards += [board((-1.0, y - 0.05, z - 0.03), (-0.6, y + 0.05, z + 0.08), ring) for y in (near, far)]
        boards += [board((x - 0.05, near, z - 0.03), (x + 0.05, far, z + 0.08), ring) for x in (-0.95, -0.65)]
        return boards

    base, other = blade(0.0, -1), blade(0.055, 1)
    return _thing("scissors", base, opened("blade", other, hinge((0, 0, 1), (0, 0, 0), -8.0, -rng.uniform(40, 55))))


def _stick(rng: np.random.Generator) -> KnownObject:
    """A memory stick: its cover turns far about one end."""
    base = [
        board((-0.7, -0.22, 0), (0.3, 0.22, 0.18), texture(rng, "noise")),
        board((0.3, -0.15, 0.04), (0.75, 0.15, 0.14), texture(rng, "stripes", 8.0)),
    ]
    metal = texture(rng, "checker", 5.0)
    cover = [board((-0.6, -0.24, z), (0.8, 0.24, z + 0.04), metal) for z in (-0.06, 0.2)]
    cover += [board((0.8, -0.24, -0.06), (0.85, 0.24, 0.24), metal)]
    return _thing("stick", base, opened("cover", cover, hinge((0, 0, 1), (-0.45, 0, 0), 10.0, rng.uniform(120, 150))))


def _suitcase(rng: np.random.Generator) -> KnownObject:
    """A handle on two bars that hide in the case."""
    shell = texture(rng, "noise")
    base = [board((-0.5, -0.3, -0.04), (0.5, 0.3, 0), shell), *walls((-0.5, -0.3, 0), (0.5, 0.3, 1), 0.04, shell)]
    base += [
        board((-0.5, low, 1), (0.5, high, 1.04), texture(rng, "checker", 5.0)) for low, high in ((-0.3, -0.02), (0.1, 0.3))
    ]
    metal = texture(rng, "stripes", 6.0)
    bars = [board((x - 0.03, 0, 0.25), (x + 0.03, 0.08, 1.06), metal) for x in (-0.31, 0.31)]
    bars += [board((-0.34, 0, 1.06), (0.34, 0.08, 1.14), texture(rng, "plain"))]
    return _thing("suitcase", base, opened("handle", bars, _sliding((0, 0, 1), 0.0, rng.uniform(0.5, 0.65))))


def _switch(rng: np.random.Generator) -> KnownObject:
    """A rocker between two rails on a plate: it tips a little about its middle, and either end hides what the other shows."""
    base = [
        board((-0.6, -0.05, -0.9), (0.6, 0.05, 0.9), texture(rng, "noise")),
        board((-0.4, -0.1, -0.6), (-0.3, -0.05, 0.6), texture(rng, "plain")),
        board((0.3, -0.1, -0.6), (0.4, -0.05, 0.6), texture(rng, "plain")),
        board((-0.28, -0.14, -0.06), (0.28, -0.05, 0.06), texture(rng, "plain")),
    ]
    rocker = board((-0.28, -0.28, -0.5), (0.28, -0.16, 0.5), texture(rng, "checker", 5.0))
    tip = rng.uniform(7, 9)
    return _thing("switch", base, opened("rocker", [rocker], hinge((1, 0, 0), (0, -0.16, 0), -tip, tip)))


def _toilet(rng: np.random.Generator) -> KnownObject:
    """A seat and a lid on one hinge; the shut lid hides most of the seat."""
    china, wood = texture(rng, "noise"), texture(rng, "wood")
    base = [board((-0.4, -0.6, -0.05), (0.4, 0.4, 0), china), *walls((-0.4, -0.6, 0), (0.4, 0.4, 0.6), 0.1, china)]
    base += [board((-0.45, 0.4, 0), (0.45, 0.7, 1.2), texture(rng, "checker", 3.0))]
    seat = [board((x - 0.085, -0.62, 0.61), (x + 0.085, 0.38, 0.65), wood) for x in (-0.335, 0.335)]
    seat += [board((-0.25, low, 0.61), (0.25, high, 0.65), wood) for low, high in ((-0.62, -0.45), (0.22, 0.38))]
    lid = [board((-0.42, -0.62, 0.66), (0.42, 0.38, 0.7), texture(rng, "stripes"))]
    joints = hinge((-1, 0, 0), (0, 0.38, 0.63), 0.0, rng.uniform(45, 55)), hinge((-1, 0, 0), (0, 0.38, 0.68), 0.0, 88.0)
    return _thing("toilet", base, opened("seat", seat, joints[0]), opened("lid", lid, joints[1]))


def _washer(rng: np.random.Generator) -> KnownObject:
    """A round door in the front of a washing machine."""
    shell = texture(rng, "plain")
    base = [board((-0.6, -0.5, z), (0.6, 0.5, z + 0.05), shell) for z in (-0.05, 1.5)]
    base += walls((-0.6, -0.48, 0), (0.6, 0.5, 1.5), 0.05, shell)[1:]
    base += [
        board((-0.6, -0.5, 0), (0.6, -0.48, 0.3), shell),
        board((-0.6, -0.5, 1.1), (0.6, -0.48, 1.5), texture(rng, "stripes")),
    ]
    base += [board((x - 0.1, -0.5, 0.3), (x + 0.1, -0.48, 1.1), shell) for x in (-0.5, 0.5)]
    middle, across = torch.tensor([0.0, -0.55, 0.7], dtype=torch.float64), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    slab = board((-0.38, -0.6, 0.38), (0.38, -0.52, 1.02), texture(rng, "noise"))
    door = [slab.moved(Screw("revolute", across, middle).motion(k * math.pi / 4)) for k in range(4)]
    joint = hinge((0, 0, -1), (-0.5, -0.51, 0.7), 0.0, rng.uniform(80, 110))
    return _thing("washer", base, opened("door", door, joint))


def _window(rng: np.random.Generator) -> KnownObject:
    """A pane that slides before another."""
    wood = texture(rng, "wood")
    base = [board((-0.9, -0.1, z), (0.9, 0.1, z + 0.1), wood) for z in (-0.1, 1.2)]
    base += [board((x - 0.05, -0.1, 0), (x + 0.05, 0.1, 1.2), wood) for x in (-0.85, 0.85)]
    base += [board((-0.8, 0.03, 0), (0.05, 0.07, 1.2), texture(rng, "checker", 3.0))]
    pane = [
        board((-0.05, -0.07, 0.01), (0.78, -0.03, 1.19), texture(rng, "stripes")),
        board((-0.03, -0.12, 0.5), (0.02, -0.07, 0.7), texture(rng, "plain")),
    ]
    return _thing("window", base, opened("pane", pane, _sliding((-1, 0, 0), 0.0, rng.uniform(0.4, 0.65))))


THINGS: dict[str, Callable[[np.random.Generator], KnownObject]] = {
    "chair": _chair,
    "faucet": _faucet,
    "glasses": _glasses,
    "jackknife": _jackknife,
    "knife": _knife,
    "oven": _oven,
    "scissors": _scissors,
    "stick": _stick,
    "suitcase": _suitcase,
    "switch": _switch,
    "toilet": _toilet,
    "washer": _washer,
    "window": _window,
}

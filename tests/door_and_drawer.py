"""A made-up object with a door and a drawer, without a fit, for tests of what reads objects."""

import math
from pathlib import Path

import torch

from structuregs.capture import Capture, TrueJoint, View
from structuregs.geometry import SE3, Box, Camera
from structuregs.joints import articulate
from structuregs.model import ArticulatedObject, PosedParts, Splats
from structuregs.raster import render

DOOR = TrueJoint("revolute", (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 0.1, 0.1 + math.radians(60))
DRAWER = TrueJoint("prismatic", (0.0, -1.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.4)
CENTRES = ((0.0, 0.0, 0.0), (0.6, 0.0, 0.3), (0.0, 0.0, -0.4))


def made_of(*motions: SE3, centres: tuple[tuple[float, float, float], ...] = CENTRES) -> ArticulatedObject:
    """A base and a part of half extents (.4, .1, .2) for each motion, 120 splats each."""
    n = 1 + len(motions)
    poses = torch.tensor([[1.0, 0, 0, 0, *centre] for centre in centres[:n]])
    boxes = Box(SE3(poses), torch.tensor([[0.5, 0.5, 0.5]] + [[0.4, 0.1, 0.2]] * len(motions)))
    moves = torch.stack([SE3.identity().wxyz_xyz, *(T.wxyz_xyz.float() for T in motions)])
    g = torch.Generator().manual_seed(0)
    splats = Splats(
        torch.rand(120 * n, 3, generator=g) * 2 - 1,
        torch.randn(120 * n, 4, generator=g),
        torch.full((120 * n, 3), math.log(0.05)),
        torch.full((120 * n,), 3.0),
        torch.rand(120 * n, 1, 3, generator=g) * 2 - 1,
    )
    return articulate(PosedParts(boxes, SE3(moves), splats, (120,) * n, torch.zeros(120 * n, 3)))


def photographed(obj: ArticulatedObject, views: int = 2, aside: float = 0.0) -> Capture:
    """A capture in memory whose views, each so far aside of the one before, are the object's own renderings, as bytes."""
    rows = []
    for state in (0, 1):
        row = []
        for i in range(views):
            place = SE3.from_quat(torch.tensor([1.0, 0, 0, 0]), torch.tensor([i * aside, 0, -4]))
            camera = Camera(place, 60.0, 60.0, 20.0, 16.0, 40, 32)
            image = render(obj.parts.at_state(state), camera)
            alpha = (image.alpha > 0.02).byte() * 255
            rgb = (image.rgb.clamp(0, 1) * 255).round().byte()
            rgba = torch.cat([torch.where(alpha[..., None] > 0, rgb, 255), alpha[..., None]], -1).numpy()
            row.append(View(f"{i:04d}", camera, rgba))
        rows.append(tuple(row))
    return Capture("made", Path("made"), (rows[0], rows[1]), (rows[0], rows[1]), "memory")

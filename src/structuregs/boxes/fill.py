"""Boxes to posed parts: the splats that a fit starts from."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry import SE3, Box, quat_multiply
from ..model import SH_C0, PosedParts, Splats
from .cue import StateLook
from .pieces import MovingPart

FAINT = -2.2  # logit of the opacity of splats that are only on trial, about 0.1


def strewn(
    boxes: Box,
    motions: SE3,
    per_part: int,
    sh_degree: int,
    generator: torch.Generator,
    rgb: Float[Tensor, " 3"],
    reach: float = 0.0,
) -> PosedParts:
    """Parts whose boxes are evenly strewn with faint splats of one colour (supplement 1.1: uniform in [-1, 1]^3).

    With a `reach` (world units) they are strewn so far around the boxes too.
    """
    K = len(boxes.half_extents)
    means = torch.rand(K * per_part, 3, generator=generator) * 2 - 1
    means *= (1 + reach / boxes.half_extents).repeat_interleave(per_part, 0)
    # Each splat about as large as its share of the space.
    spacing = ((2 * (boxes.half_extents + reach)).prod(-1) / per_part) ** (1 / 3)
    log_scales = (0.5 * spacing).log().repeat_interleave(per_part)[:, None].expand(-1, 3)
    sh = torch.zeros(K * per_part, (sh_degree + 1) ** 2, 3)
    sh[:, 0] = (rgb - 0.5) / SH_C0
    splats = Splats(
        means,
        torch.tensor([1.0, 0, 0, 0]).repeat(K * per_part, 1),
        log_scales.contiguous().float(),
        torch.full((K * per_part,), FAINT),
        sh,
    )
    return PosedParts(boxes, motions, splats, (per_part,) * K, torch.zeros(K * per_part, 3))


def seeded(
    boxes: Box,
    motions: SE3,
    looks: tuple[StateLook, StateLook],
    parts: list[MovingPart],
    per_part: int,
    sh_degree: int,
    generator: torch.Generator,
    reach: float,
) -> PosedParts:
    """Parts that begin as the quick looks show them, with faint splats strewn in for what these leave out.

    A part's splats come from the state that it was found by, where it stands clear of the rest, and the base's from the
    state by which most was found.  So a part has its shape before its motion is fitted, and the motion has to explain the
    other state.

    Args:
        boxes: K boxes in state 0.
        motions: K motions to state 1.
        looks: of both states.
        parts: what the boxes 1 to K - 1 hold.
        per_part: strewn splats in each box.
        sh_degree: of the spherical harmonics.
        generator: of the strewn splats' places.
        reach: how far around the boxes splats are strewn, world units: looks miss what is thin and sticks out.
    """
    found = [sum(len(part.points) for part in parts if part.state == state) for state in (0, 1)]
    sources = [int(found[1] > found[0]), *(part.state for part in parts)]
    posed = (boxes, boxes.moved(motions))
    free = [torch.ones(len(look.splats), dtype=torch.bool) for look in looks]
    pieces = []
    for k in [*range(1, len(sources)), 0]:
        look, box = looks[sources[k]].splats, posed[sources[k]][k]
        inside = free[sources[k]] & box.contains(look.means)
        for state in (0, 1):
            free[state] &= ~posed[state][k].contains(looks[state].splats.means)
        pieces.append(_in_box(look[inside], box, sh_degree))
    pieces = [pieces[-1], *pieces[:-1]]
    pieces[0] = _doubted(pieces[0], boxes, motions)
    faint = strewn(boxes, motions, per_part, sh_degree, generator, looks[0].splats.base_rgb.mean(0), reach)
    extra = [faint.part_splats(k) for k in range(len(sources))]
    extra[0] = extra[0][~in_moving_box(boxes[0].to_world(extra[0].means), boxes, motions)]
    counts = tuple(len(piece) + len(more) for piece, more in zip(pieces, extra, strict=True))
    rows = [splats for pair in zip(pieces, extra, strict=True) for splats in pair]
    return PosedParts(boxes, motions, Splats.concatenate(rows), counts, torch.zeros(sum(counts), 3))


def in_moving_box(points: Float[Tensor, "N 3"], boxes: Box, motions: SE3, margin: float = 0.0) -> Bool[Tensor, " N"]:
    """Whether world points lie in a moving box grown by `margin` (world units) on every side, in either state."""
    inside = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for posed in (boxes, boxes.moved(motions)):
        for k in range(1, len(boxes.half_extents)):
            inside |= posed[k].contains(points, margin)
    return inside


def _doubted(base: Splats, boxes: Box, motions: SE3) -> Splats:
    """The base's splats, those faint that lie where a moving part is in the other state: they have yet to prove themselves.

    A look at one state cannot tell what hangs in a place that hardly any view sees into, such as the opening of a cabinet;
    what it leaves there would hide the part that belongs there in the other state.
    """
    doubtful = in_moving_box(boxes[0].to_world(base.means), boxes, motions)
    faint = torch.where(doubtful, base.logit_opacities.clamp(max=FAINT), base.logit_opacities)
    return replace(base, logit_opacities=faint)


def _in_box(splats: Splats, box: Box, sh_degree: int) -> Splats:
    """World splats of constant colour in one box's canonical space."""
    sh = torch.zeros(len(splats), (sh_degree + 1) ** 2, 3)
    sh[:, :1] = splats.sh[:, :1]
    quats = quat_multiply(box.T_world_box.inverse().wxyz, splats.quats)
    return Splats(box.to_canonical(splats.means), quats, splats.log_scales, splats.logit_opacities, sh)

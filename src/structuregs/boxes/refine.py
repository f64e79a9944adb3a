"""Motions pulled into place by the photos, and made as plain as the photos allow."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int64
from scipy.optimize import minimize_scalar

from ..geometry import SE3, Box, Screw, screw_at, straightened
from ..joints import kind_of
from .hypotheses import Hypothesis, turn_about
from .judge import NOISE, Trial

_SLIDES = 32  # lengths up to what was found that are tried, and...
_FARTHER = 1.5  # ...up to so many times as much, as long as it is in sight where it is in the way


def refine(hypothesis: Hypothesis, trial: Trial, steps: int, rate: float) -> Hypothesis:
    """The hypothesis after the photos have pulled its motion into place, with its new errors.

    Args:
        hypothesis: the motion to start from, from the part's state to the other, with its errors.
        trial: the part between the photos; turns are about its moved centre, and `rate` counts in its half diagonal.
        steps: optimiser steps, one photo of either state each.
        rate: of the tangent at the start; falls to a tenth.
    """
    box = trial.box
    reach = float(box.half_extents.norm())
    centre = hypothesis.motion.apply(box.T_world_box.xyz).float()
    start = hypothesis.motion.to(dtype=torch.float32)
    brought = trial.brought(hypothesis.motion)
    unit = torch.tensor([reach] * 3 + [1.0] * 3)
    tangent = torch.zeros(6, requires_grad=True)
    optimiser = torch.optim.Adam([tangent], lr=rate, betas=(0.8, 0.95))
    orders = [_order(len(scene.views), steps) for scene in (trial.there, trial.here)]
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = rate * 0.1 ** (step / steps)
        motion = turn_about(centre, tangent * unit) @ start
        there, here = (int(scene.views[order[step]]) for scene, order in zip((trial.there, trial.here), orders, strict=True))
        loss = trial.there.loss(trial.piece.moved(motion), there) + trial.here.loss(brought.moved(motion.inverse()), here)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    motion = (turn_about(centre, (tangent * unit).detach()) @ start).to(dtype=torch.float64)
    return min(hypothesis, trial.judge(trial.moved(hypothesis, motion)), key=lambda h: h.error)


def _order(count: int, steps: int) -> Int64[np.ndarray, " S"]:
    """Which of so many photos each step looks at: each once in a round."""
    return np.concatenate([np.random.default_rng(turn).permutation(count) for turn in range(steps // count + 1)])


def simplest(hypothesis: Hypothesis, trial: Trial, base: Box, share: float) -> Hypothesis:
    """The hypothesis, or the simplest motion near it that the photos like about as well.

    A few photos of a small part hardly tell a slide from a slide with a little turn, or one along the box from one a little
    askew; joints are built along boxes, and they turn or slide.  Tried in turn: the slide and the turn along the
    nearest axis of the base or of the box, whichever is better, the slide, the turn.  Of a shut drawer without texture the
    photos can leave the way loose by more than 20 degrees; how far off an axis may be is theirs to say.

    Args:
        hypothesis: a motion with its errors.
        trial: the part between the photos.
        base: the base's box.
        share: "about as well" is less than this share of what the part takes off the photos' error.
    """
    box = trial.box
    motion, centre = hypothesis.motion, box.T_world_box.xyz
    slide, length = screw_at(motion, "prismatic", centre)
    turn, angle = screw_at(motion, "revolute", centre)
    ways: list[list[tuple[Screw, float]]] = [[], [], [(slide, length)], [(turn, angle)]]
    for way, (screw, q) in zip(ways, ((slide, length), (turn, angle)), strict=False):
        way += [straightened(screw, q, base), straightened(screw, q, box)]
    enough = hypothesis.error + share * max(trial.absent - hypothesis.error, 0.0) + NOISE * trial.absent
    for way in ways:
        judged = [trial.judge(trial.moved(hypothesis, screw.motion(q))) for screw, q in way]
        best = min(judged, key=lambda h: h.error, default=None)
        if best is not None and best.error < enough:
            return best
    return hypothesis


def along_base(hypothesis: Hypothesis, trial: Trial, base: Box) -> Hypothesis:
    """The hypothesis; a slide, or a turn out of sight or into the way, becomes a slide along the base, whatever that costs.

    For what does not show in the other state: photos know nothing of its way, only of what happens to lie there.  What has
    gone in somewhere are drawers and trays; a door that is shut is seen (see `Trial.gone_in`), and spoils no photo.

    Args:
        hypothesis: a judged motion.
        trial: the part between the photos.
        base: the base's box.
    """
    motion = hypothesis.motion
    if kind_of(motion) == "revolute" and not (trial.in_the_way(hypothesis) or trial.out_of_sight(motion)):
        return hypothesis
    straight, q = straightened(*screw_at(motion, "prismatic", trial.box.T_world_box.xyz), base)
    return trial.judge(trial.moved(hypothesis, straight.motion(q)))


def measured(hypothesis: Hypothesis, trial: Trial) -> Hypothesis:
    """The hypothesis, turned or slid a little more or less along its own axis as the photos see it, within a tenth.

    Args:
        hypothesis: a motion with its errors.
        trial: the part between the photos.
    """
    screw, q = screw_at(hypothesis.motion, kind_of(hypothesis.motion), trial.box.T_world_box.xyz)

    found = minimize_scalar(
        lambda at: trial.judge(replace(hypothesis, motion=screw.motion(float(at)))).error,
        bounds=(0.9 * q, 1.1 * q),
        method="bounded",
        options={"maxiter": 8},
    )
    q = float(found.x)  # pyright: ignore[reportAttributeAccessIssue]
    return min(hypothesis, trial.judge(replace(hypothesis, motion=screw.motion(q))), key=lambda h: h.error)


def just_out_of_sight(hypothesis: Hypothesis, trial: Trial, base: Box) -> Hypothesis:
    """The hypothesis; a slide that takes the part out of sight goes straight in, and no farther than it has to.

    A tray that was pushed in behind a door could be anywhere there, for all that photos say.  Cupboards are built so that what
    slides in goes along them and ends just behind what hides it.  Photos may have left part of it in sight, where it only
    spoils them, as what lies there, brought back, pulls elsewhere: then it goes on.  Where no way along an axis of the base
    hides the part, its own is asked.

    Args:
        hypothesis: a judged motion.
        trial: the part between the photos.
        base: the base's box.
    """
    if kind_of(hypothesis.motion) != "prismatic" or trial.peeps_out(hypothesis):
        return hypothesis
    own, q = screw_at(hypothesis.motion, "prismatic", trial.box.T_world_box.xyz)
    lengths = (q * np.arange(1, round(_FARTHER * _SLIDES) + 1) / _SLIDES).tolist()

    def first_hidden(screw: Screw, lengths: list[float]) -> SE3 | None:
        return next(filter(trial.out_of_sight, map(screw.motion, lengths)), None)

    motion = first_hidden(own, lengths[:_SLIDES])
    if motion is None and not trial.in_the_way(hypothesis):
        return hypothesis
    motion = first_hidden(straightened(own, q, base)[0], lengths) or motion or first_hidden(own, lengths[_SLIDES:])
    return hypothesis if motion is None else trial.judge(trial.moved(hypothesis, motion))


def shortest_out_of_sight(trial: Trial, base: Box) -> SE3 | None:
    """The shortest slide along an axis of the base, no longer than the base, that takes the part out of sight; None if none."""
    axes = base.T_world_box.rotation.T
    for share in np.arange(1, _SLIDES + 1) / _SLIDES:
        for axis in (*axes, *-axes):
            motion = Screw("prismatic", axis, trial.box.T_world_box.xyz).motion(2 * share * float(base.half_extents.max()))
            if trial.out_of_sight(motion):
                return motion
    return None

"""The photos as judges of motion hypotheses."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from scipy.optimize import minimize_scalar
from scipy.spatial import KDTree
from torch import Tensor

from ..geometry import SE3, Box, screw_at
from ..joints import kind_of
from ..model import SH_C0, Splats
from ..raster import Render, image_loss, painted_share, render
from .cue import StateLook
from .hypotheses import Hypothesis, oddity, turn_about

_ALPHA_WEIGHT = 0.5  # of the mask's error beside the colour's
_FEW = 5  # photos that do for a quick look
NOISE = 0.002  # fraction of the photo error below which a difference says nothing


@dataclass(frozen=True)
class Scene:
    """One state's photos, and everything but one part as it stands in them.

    Attributes:
        look: the photos' state.
        rest: splats of all the rest, in the world.
        views: which photos judge; the first few of them do for a quick look.
        still: points of what stands still, in the world.
    """

    look: StateLook
    rest: Splats
    views: Int64[np.ndarray, " L"]
    still: KDTree

    def loss(self, part: Splats, v: int) -> Float[Tensor, ""]:
        """Error of one photo with the part where it is."""
        stack = self.look.stack
        rgb, alpha = stack.target(v)
        picture = render(Splats.concatenate([self.rest, part]), stack.cameras[v])
        return image_loss(picture.rgb, picture.alpha, rgb, alpha, ssim_weight=0.0, alpha_weight=_ALPHA_WEIGHT)

    @torch.no_grad()
    def error(self, part: Splats, motion: SE3, quick: bool = False) -> float:
        """Mean error of the judging photos with the part moved."""
        moved = part.moved(motion)
        views = self.views[:_FEW] if quick else self.views
        return float(np.mean([float(self.loss(moved, int(v))) for v in views]))

    @torch.no_grad()
    def absent(self, part: Splats) -> float:
        """Mean error of the judging photos without the part."""
        return float(np.mean([float(self.loss(part[:0], int(v))) for v in self.views]))

    @torch.no_grad()
    def footprint(self, part: Splats) -> float:
        """Mean share of the judging photos that shows the part where it is."""
        both = Splats.concatenate([self.rest, part])
        chosen = torch.arange(len(both)) >= len(self.rest)
        return float(np.mean([painted_share(both, chosen, self.look.stack.cameras[v]) for v in self.views]))

    def support(self, part: Splats, motions: SE3) -> Float64[np.ndarray, "M N"]:
        """What each splat of a part takes off the photos' error under each of M motions of the part.

        The fall of a pixel's error against the picture without the part, shared out among the splats by how much of the
        pixel each of them paints; summed over the pixels of the judging photos.
        """
        rows = np.zeros((len(motions.wxyz_xyz), len(part)))
        for v in self.views.tolist():
            camera, target = self.look.stack.cameras[v], self.look.stack.target(v)
            with torch.no_grad():
                without = _errors(render(self.rest, camera), *target)
            for m, row in enumerate(rows):
                both = Splats.concatenate([self.rest, part.moved(motions[m])])
                sh = both.sh.requires_grad_()
                picture = render(replace(both, sh=sh), camera)
                fall = (without - _errors(picture, *target)).detach()
                painted = torch.autograd.grad(picture.rgb, sh, fall[..., None].expand_as(picture.rgb) / 3)[0]
                row += painted[len(self.rest) :, 0].sum(-1).double().numpy() / SH_C0
        return rows

    def judge(self, hypothesis: Hypothesis, part: Splats, quick: bool = False) -> Hypothesis:
        """The hypothesis with its image error."""
        return replace(hypothesis, image_error=self.error(part, hypothesis.motion, quick))

    def moved(self, hypothesis: Hypothesis, motion: SE3, box: Box) -> Hypothesis:
        """The hypothesis with another motion of its box; what masks and photos say is still that of the old one."""
        return replace(hypothesis, motion=motion, oddity=oddity(motion, box, self.still))


def _errors(picture: Render, rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """What `Scene.loss` is the mean of."""
    return (picture.rgb - rgb).abs().mean(-1) + _ALPHA_WEIGHT * (picture.alpha - alpha).abs()


def refine(hypothesis: Hypothesis, scene: Scene, part: Splats, box: Box, steps: int, rate: float) -> Hypothesis:
    """The hypothesis after the photos have pulled its motion into place, with its new image error.

    Args:
        hypothesis: the motion to start from, from the part's state to the photos'.
        scene: the photos, and the rest.
        part: the part's splats in its own state.
        box: the part's box in its own state; turns are about its moved centre, and `rate` counts in its half diagonal.
        steps: optimiser steps, one photo each.
        rate: of the tangent at the start; falls to a tenth.
    """
    reach = float(box.half_extents.norm())
    centre = hypothesis.motion.apply(box.T_world_box.xyz).float()
    start = hypothesis.motion.to(dtype=torch.float32)
    unit = torch.tensor([reach] * 3 + [1.0] * 3)
    tangent = torch.zeros(6, requires_grad=True)
    optimiser = torch.optim.Adam([tangent], lr=rate, betas=(0.8, 0.95))
    rounds = steps // len(scene.views) + 1
    order = np.concatenate([np.random.default_rng(turn).permutation(len(scene.views)) for turn in range(rounds)])
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = rate * 0.1 ** (step / steps)
        motion = turn_about(centre, tangent * unit) @ start
        loss = scene.loss(part.moved(motion), int(scene.views[order[step]]))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    motion = (turn_about(centre, (tangent * unit).detach()) @ start).to(dtype=torch.float64)
    moved = scene.moved(hypothesis, motion, box)
    return min(scene.judge(hypothesis, part), scene.judge(moved, part), key=lambda h: h.image_error)


def simplest(hypothesis: Hypothesis, scene: Scene, part: Splats, box: Box, base: Box, absent: float) -> Hypothesis:
    """The hypothesis, or the simplest motion near it that the photos like about as well.

    A few photos of a small part hardly tell a slide from a slide with a little turn, or one along the box from one a little
    askew; joints are built along boxes, and they turn or slide.  Tried in turn: the slide and the turn along an axis of
    the box or the base, the slide, the turn.

    Args:
        hypothesis: a motion with its image error.
        scene: the photos, and the rest.
        part: the part's splats in its own state.
        box: the part's box in its own state.
        base: the base's box.
        absent: error of the photos without the part; what the part takes off it is what "about as well" counts in.
    """
    motion, centre = hypothesis.motion, box.T_world_box.xyz
    slide, length = screw_at(motion, "prismatic", centre)
    turn, angle = screw_at(motion, "revolute", centre)
    axes = torch.cat([box.T_world_box.rotation.T, base.T_world_box.rotation.T])
    candidates = [(slide, length), (turn, angle)]
    for screw, q in ((turn, angle), (slide, length)):
        along = axes @ screw.axis
        nearest = int(along.abs().argmax())
        if abs(float(along[nearest])) > np.cos(np.deg2rad(15)):
            candidates.insert(0, (replace(screw, axis=axes[nearest]), q * float(along[nearest])))
    enough = hypothesis.image_error + 0.05 * max(absent - hypothesis.image_error, 0.0) + NOISE * absent
    for screw, q in candidates:
        simple = screw.motion(q)
        judged = scene.judge(scene.moved(hypothesis, simple, box), part)
        if judged.image_error < enough:
            return judged
    return hypothesis


def measured(hypothesis: Hypothesis, scene: Scene, part: Splats, box: Box) -> Hypothesis:
    """The hypothesis, turned or slid a little more or less along its own axis as the photos see it, within a tenth.

    Args:
        hypothesis: a motion with its image error.
        scene: the photos, and the rest.
        part: the part's splats in its own state.
        box: the part's box in its own state.
    """
    screw, q = screw_at(hypothesis.motion, kind_of(hypothesis.motion), box.T_world_box.xyz)

    found = minimize_scalar(
        lambda at: scene.error(part, screw.motion(float(at))),
        bounds=(0.9 * q, 1.1 * q),
        method="bounded",
        options={"maxiter": 12},
    )
    q = float(found.x)  # pyright: ignore[reportAttributeAccessIssue]
    again = scene.judge(replace(hypothesis, motion=screw.motion(q)), part)
    return min(hypothesis, again, key=lambda h: h.image_error)

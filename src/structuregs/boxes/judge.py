"""The photos as judges of motion hypotheses."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial import KDTree
from torch import Tensor

from ..geometry import SE3, Box
from ..joints import kind_of
from ..model import Splats
from ..raster import Backdrop, Render, image_loss
from .appearance import LOOK_DILATION
from .cue import StateLook
from .hypotheses import Hypothesis, oddity

_ALPHA_WEIGHT = 0.5  # of the mask's error beside the colour's
_FEW = 4  # photos of either state that do for a quick look
_HIDDEN = 0.3  # of a part's weight speaks against a turn that hides the part, ...
_SEEN_SHUT = 0.2  # ...none against one after which so much is seen of it, against its own state; shut doors show more
_GONE = 0.1  # a slide after which less than this share of a part is seen takes it out of sight, ...
_PEEPS = 0.01  # ...if it costs and helps the other state's photos no more than this share of the part's weight
_IN_THE_WAY = 0.05  # what costs the other state's photos this share of its weight; fronts that are shut cost .03 and less
_HOLLOW = 6.0  # voxels: what lies in the part's box, but farther from all of its points, is seen through it
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

    @cached_property
    def _seen(self) -> dict[int, tuple[Backdrop, Float[Tensor, "H W"]]]:
        """Of the photos that were asked for: the rest as it stands in them, and their errors without the part."""
        return {}

    def _without(self, v: int) -> tuple[Backdrop, Float[Tensor, "H W"]]:
        """The rest as it stands in a photo, and the photo's errors without the part."""
        if v not in self._seen:
            backdrop = Backdrop(self.rest, self.look.stack.cameras[v], LOOK_DILATION)
            picture = backdrop.drawn(self.rest.means.new_ones(3))
            self._seen[v] = backdrop, _errors(picture, *self.look.stack.target(v)).detach()
        return self._seen[v]

    def loss(self, part: Splats, v: int) -> Float[Tensor, ""]:
        """Error of one photo with the part where it is."""
        backdrop, without = self._without(v)
        patch = backdrop.with_others(part)
        picture = patch.drawn(part.means.new_ones(3))
        rgb, alpha = map(patch.cut, self.look.stack.target(v))
        error = image_loss(picture.rgb, picture.alpha, rgb, alpha, ssim_weight=0.0, alpha_weight=_ALPHA_WEIGHT)
        elsewhere = without.sum() - patch.cut(without).sum()
        return (error * alpha.numel() + elsewhere) / without.numel()

    @torch.no_grad()
    def error(self, part: Splats, motion: SE3, quick: bool = False) -> float:
        """Mean error of the judging photos with the part moved."""
        moved = part.moved(motion)
        views = self.views[:_FEW] if quick else self.views
        return float(np.mean([float(self.loss(moved, int(v))) for v in views]))

    @cached_property
    def absent(self) -> float:
        """Mean error of the judging photos without the part."""
        return self._mean_without(self.views)

    @cached_property
    def absent_quick(self) -> float:
        """The same of the few photos of a quick look."""
        return self._mean_without(self.views[:_FEW])

    def _mean_without(self, views: Int64[np.ndarray, " L"]) -> float:
        return float(np.mean([float(self._without(v)[1].mean()) for v in views.tolist()]))

    def without(self, quick: bool = False) -> float:
        """`absent`, or `absent_quick`."""
        return self.absent_quick if quick else self.absent

    def needs(self, part: Splats) -> float:
        """What the photos lose without a part where it is, in mean error."""
        return self.absent - self.error(part, SE3.identity(dtype=torch.float64))

    @torch.no_grad()
    def footprint(self, part: Splats) -> float:
        """Mean share of the judging photos that the part paints where it is."""
        painted = 0.0
        for v in self.views.tolist():
            patch = self._without(v)[0].with_others(part)
            own = (torch.arange(len(patch.projection.rgb)) >= patch.count).float()
            painted += float(patch.drawn(part.means.new_zeros(3), own[:, None].repeat(1, 3)).rgb[..., 0].sum())
        return painted / self.pixels

    @property
    def pixels(self) -> int:
        """How many pixels the judging photos have."""
        return self.look.stack.alpha[self.views].size

    def support(self, part: Splats, motions: SE3) -> Float64[np.ndarray, "M N"]:
        """What each splat of a part takes off the photos' error under each of M motions of the part.

        The fall of a pixel's error against the picture without the part, shared out among the splats by how much of the
        pixel each of them paints; summed over the pixels of the judging photos.
        """
        rows = np.zeros((len(motions.wxyz_xyz), len(part)))
        for v in self.views.tolist():
            backdrop, without = self._without(v)
            target = self.look.stack.target(v)
            for m, row in enumerate(rows):
                with torch.no_grad():
                    patch = backdrop.with_others(part.moved(motions[m]))
                rgb = patch.projection.rgb.requires_grad_()
                picture = patch.drawn(part.means.new_ones(3), rgb)
                fall = (patch.cut(without) - _errors(picture, *map(patch.cut, target))).detach()
                painted = torch.autograd.grad(picture.rgb, rgb, fall[..., None].expand_as(picture.rgb) / 3)[0]
                row += painted[patch.count :].sum(-1).double().numpy()
        return rows


def _errors(picture: Render, rgb: Float[Tensor, "H W 3"], alpha: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """What `Scene.loss` is the mean of."""
    return (picture.rgb - rgb).abs().mean(-1) + _ALPHA_WEIGHT * (picture.alpha - alpha).abs()


@dataclass(frozen=True)
class Trial:
    """A part between the photos of both states.

    Laid where it was in the other state, the part has to explain that state's photos; and what lies there in the other state,
    brought back, has to explain those of its own.  What was shut shows little of itself in the one, but all in the other.

    Attributes:
        there: photos of the other state, and the rest of the part's own state as it stands in them.
        here: photos of the part's own state, and the rest of the other state as it stands in them.
        others: all splats of the other state, in the world.
        piece: the part's splats, in its own state.
        box: the part's box in its own state.
        weight: what the photos of the part's own state would lose without it, in mean error.
        most: what it can explain of either: its weight, with that of what moves along.
        near: how far from the moved box splats count as lying there, world units.
        own: points of the part, in its own state.
        taken: points of what stands still in both states and, where they are asked, of the other parts as they stand in the
            other; what is nearer to them is not the part's.
        least: a part shows in the other state if it takes this much off the error of its photos.
    """

    there: Scene
    here: Scene
    others: Splats
    piece: Splats
    box: Box
    weight: float
    most: float
    near: float
    own: KDTree
    taken: KDTree
    least: float

    @property
    def absent(self) -> float:
        """Error of the photos of both states without the part."""
        return self.there.absent + self.here.absent

    def _lying_in(self, box: Box) -> Bool[Tensor, " N"]:
        """Which splats of the other state lie in a box there."""
        return box.contains(self.others.means.double(), margin=self.near)

    def brought(self, motion: SE3) -> Splats:
        """What lies in the other state where a motion takes the part, and no nearer to what is something else; still there.

        A slide into the base would bring back of its walls what lies there, as if the part had been that.
        """
        lying = self.others[self._lying_in(self.box.moved(motion))]
        if not len(lying):
            return lying
        means = lying.means.double()
        from_own = self.own.query(motion.inverse().apply(means).numpy())[0]
        there = from_own < _HOLLOW * self.near
        there &= from_own < self.taken.query(means.numpy())[0] + 0.5 * self.near
        return lying[torch.from_numpy(there)]

    @cached_property
    def in_sight(self) -> float:
        """Mean share of the photos of its own state that the part paints."""
        return self.here.footprint(self.piece)

    def judge(self, hypothesis: Hypothesis, quick: bool = False) -> Hypothesis:
        """The hypothesis with its errors, and how much of the part is seen after a turn (which a quick look leaves out)."""
        motion = hypothesis.motion
        there = self.there.error(self.piece, motion, quick)
        here = self.here.error(self.brought(motion), motion.inverse(), quick)
        asked = not quick and kind_of(motion) == "revolute"
        seen = self.there.footprint(self.piece.moved(motion)) / max(self.in_sight, 1e-12) if asked else 1.0
        return replace(hypothesis, image_error=there, back_error=here, seen=seen)

    def apart(self, pieces: Iterable[tuple[Splats, Box, SE3]]) -> float:
        """Error of the photos of both states with pieces of the part each moved its own way.

        Args:
            pieces: splats and box of each in its own state, and its motion; what lies where two go belongs to the first.
        """
        rest = SE3.identity(dtype=torch.float64)
        free = torch.ones(len(self.others), dtype=torch.bool)
        gone, come = [], []
        for splats, box, motion in pieces:
            lying = free & self._lying_in(box.moved(motion))
            free &= ~lying
            gone.append(splats.moved(motion))
            come.append(self.others[lying].moved(motion.inverse()))
        return self.there.error(Splats.concatenate(gone), rest) + self.here.error(Splats.concatenate(come), rest)

    def moved(self, hypothesis: Hypothesis, motion: SE3) -> Hypothesis:
        """The hypothesis with another motion; what masks and photos say is still that of the old one."""
        return replace(hypothesis, motion=motion, oddity=oddity(motion, self.box, self.there.still))

    def explained(self, hypothesis: Hypothesis, quick: bool = False) -> float:
        """What a judged hypothesis takes off the errors of either state's photos, together.

        What takes more than `most` off one takes another part's place, which says nothing for it.
        """
        without = self.there.without(quick), self.here.without(quick)
        return sum(min(a - b, self.most) for a, b in zip(without, (hypothesis.image_error, hypothesis.back_error), strict=True))

    def shows(self, hypothesis: Hypothesis) -> bool:
        """Whether the photos of the other state show more than the front of the part where a judged hypothesis takes it."""
        return self.there.absent - hypothesis.image_error > self.least

    def peeps_out(self, hypothesis: Hypothesis) -> bool:
        """Whether the photos of the other state show more than a little of the part where a judged hypothesis takes it."""
        return hypothesis.image_error < self.there.absent - _PEEPS * self.weight

    def out_of_sight(self, motion: SE3) -> bool:
        """Whether the photos of the other state neither mind nor show the part where a motion takes it."""
        unseen = self.there.error(self.piece, motion) < self.there.absent + _PEEPS * self.weight
        return unseen and not self.in_view(motion, self.there)

    def in_view(self, motion: SE3, scene: Scene) -> bool:
        """Whether more than a little of the part is before all else of a scene where a motion takes it."""
        return scene.footprint(self.piece.moved(motion)) >= _GONE * self.in_sight

    def in_the_way(self, hypothesis: Hypothesis) -> bool:
        """Whether the photos of the other state mind the part where a judged hypothesis takes it."""
        return hypothesis.image_error > self.there.absent + _IN_THE_WAY * self.weight

    def gone_in(self, hypothesis: Hypothesis) -> float:
        """What speaks against a judged turn that takes the part out of sight, in mean error.

        What the other state does not show has gone in somewhere: drawers and trays do, but a door that is shut is seen,
        however little it differs in colour from what it shuts off.
        """
        return self.weight * _HIDDEN * max(1 - hypothesis.seen / _SEEN_SHUT, 0.0)

    def doubts(self, hypothesis: Hypothesis) -> float:
        """What speaks against a judged hypothesis whatever the photos' errors, in mean error."""
        return hypothesis.against(self.weight) + self.gone_in(hypothesis)

    def cost(self, hypothesis: Hypothesis, quick: bool = False) -> float:
        """What hypotheses are compared by: what speaks against them, less what they explain."""
        return self.doubts(hypothesis) - self.explained(hypothesis, quick)

    def burden(self, hypothesis: Hypothesis) -> float:
        """What motions near each other are compared by: what speaks against them, and all of the photos' error.

        How much a part shows differs between the states' photos, the more so the fewer they are; what it takes off beyond its
        weight says nothing of where it is, but all of how exactly it lies there.
        """
        return self.doubts(hypothesis) + hypothesis.error

    def gain(self, hypothesis: Hypothesis) -> float:
        """Fraction that the part takes off the error of both states' photos."""
        return (self.absent - hypothesis.error) / self.absent

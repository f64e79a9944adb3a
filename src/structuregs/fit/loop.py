"""The fit's loop: posed parts in, better posed parts out, one view of either state a step."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ..capture import Capture, ImageStack, stack_views
from ..geometry import SE3, Camera, JointKind
from ..joints import kind_of
from ..model import PosedParts, Splats
from ..raster import Render, image_loss, render
from .aim import beside, misaim, offset_gradient, with_coverage
from .boxes import base_tightened, drawn_in, drawn_out, squared_up
from .densify import ScreenGradients, grow
from .events import FitEvent, Note, Step
from .evidence import shown, supported
from .laying import laid_anew
from .merge import idle_part, moving_alike
from .schedule import FitConfig
from .state import FitState
from .straight import askew, held_along_base
from .structure import StructureWeights, structure_loss
from .surface import planarity_loss, thickness
from .variables import SPLAT_NAMES

_REPORT_EVERY = 10
_BESIDE = 0.2  # pixels of the photos that steps work at: photos that lie farther beside have their cameras turned
_AIM = 0.5  # of the way that a photo asks for: the other photos speak too
_Value = TypeVar("_Value")
_BOX_NAMES = ("box_quats", "box_centres", "log_half_extents")
_POSE_NAMES = ("motions", "principal_point")


class Fitter:
    """One fit under way: a capture, a configuration and a `FitState` that every step changes."""

    def __init__(self, capture: Capture, config: FitConfig, state: FitState, seed: int, device: torch.device):
        self.capture = capture
        self.config = config
        self.state = state
        self.seed = seed
        self.device = device
        self.masks = [stack_views(views, config.structure_size) for views in capture.train]
        self.faces = [stack_views(views, config.planarity_size) for views in capture.train] if config.planarity_weight else []
        self.stacks: tuple[int, list[ImageStack]] = (0, [])

    def run(self, steps: int) -> Iterator[FitEvent]:
        """Takes steps until `steps` are done; yields a `Step` now and then."""
        while self.state.step < min(steps, self.config.steps):
            if self._is_at(self.config.join_at):
                yield from self._merge_parts()
            aiming = max(round(self.config.aim_at * self.config.steps), self.config.image_from + 1)
            if self.state.step == aiming and self.state.turns is None:
                yield from self._aim_cameras()
            if self._is_at(*self.config.square_at):
                self._square_up()
            if self._is_at(*self.config.lay_at):
                yield from self._lay_anew()
            yield from self._settle_joints()
            loss, psnr = self._step()
            self._densify()
            self.state.step += 1
            if self.state.step % _REPORT_EVERY == 0:
                yield Step("fit", self.state.step, loss, psnr, sum(self.state.variables.counts))

    def _is_at(self, *times: float) -> bool:
        """Whether the fit is at the step that one of these parts of it ends with."""
        return self.state.step in [round(at * self.config.steps) for at in times]

    def _merge_parts(self) -> Iterator[FitEvent]:
        """Makes one part of two that touch and move alike, and leaves to the base what need not move."""
        step = self.state.step
        while True:
            with torch.no_grad():
                parts = self.state.variables.parts().detach()
            pair, idle = moving_alike(parts), None
            if pair is None:
                idle = idle_part(parts, self._aimed_images()[1])
                if idle is None:
                    return
                pair = (0, idle)
            s = self.state
            joined = FitState.start(parts.joined(*pair), self.config.give_way)
            self.state = replace(joined, size=s.size, step=step, offset=s.offset, turns=s.turns, anew=s.anew)
            what = "a part that need not move is the base's" if idle else "two parts that move alike are one"
            yield Note(f"{what} from step {step} on; {len(parts) - 2} left")

    def _aim_cameras(self) -> Iterator[FitEvent]:
        """Has cameras turned from now on, where photos lie beside what they show of the parts."""
        with torch.no_grad():
            pixels = beside(self.state.variables.parts(), self._images())
        if pixels > _BESIDE:
            first, second = (torch.zeros(len(views), 3) for views in self.capture.train)
            self.state.turns = (first, second)
            yield Note(f"photos lie {pixels:.1f} pixels beside what their cameras show: cameras are turned from now on")

    @torch.no_grad()
    def _square_up(self) -> None:
        """Turns boxes along the faces of their parts, as joints are drawn to the axes of the base's.

        The base's is also made tight, and those of what moves are drawn in to what photos support, and out where that
        presses on.
        """
        variables, reach = self.state.variables, self.config.growth.reach * self.state.size
        parts = base_tightened(squared_up(variables.parts()))
        known = supported(parts, self._aimed_images())
        parts = drawn_out(drawn_in(parts, known), known, reach)
        for name in ("means", "quats", "sh"):
            variables.leaves[name].copy_(getattr(parts.splats, name))
        variables.set_boxes(parts.boxes)

    def _lay_anew(self) -> Iterator[FitEvent]:
        """Lays parts where photos of both states are alike; their motions then rest for a while."""
        variables, capture = self.state.variables, self.capture
        if self.state.turns is not None:
            capture = capture.turned(self.state.turns)
        motions = laid_anew(variables.parts().detach(), capture.shifted(self.state.offset.detach()))
        variables.set_motions(motions)
        self.state.laid[:] = False
        self.state.laid[list(motions)] = True
        if motions:
            yield Note(f"parts laid anew in their planes at step {self.state.step}: {', '.join(map(str, motions))}")

    def _settle_joints(self) -> Iterator[FitEvent]:
        """Holds every motion to one degree of freedom once its time has come."""
        variables = self.state.variables
        if variables.kinds is None and self.state.step >= self.config.one_joint_from * self.config.steps:
            with torch.no_grad():
                motions = variables.motions()
            self.state.free_motions = motions.wxyz_xyz
            kinds = _kinds(variables.parts().detach())
            variables.hold(kinds)
            first, second = self.state.moments["motions"]
            self.state.moments["motions"], self.state.taken["motions"] = (torch.zeros_like(first), torch.zeros_like(second)), 0
            if kinds:
                yield Note(f"joints at step {self.state.step}: {', '.join(kinds)}")

    def _view(self, state: int, count: int) -> int:
        """The view of a state for this step: every view once in each round, in an order of its own."""
        turn, place = divmod(self.state.step, count)
        return int(_order(self.seed, state, turn, count)[place])

    def _in_force(self, schedule: Sequence[tuple[float, _Value]]) -> _Value:
        """What a schedule of (part of the fit, value) says for this step."""
        return [value for start, value in schedule if self.state.step >= start * self.config.steps][-1]

    def _images(self) -> list[ImageStack]:
        """Both states' images in the size that this step works at."""
        size = self._in_force(self.config.sizes)
        if self.stacks[0] != size:
            self.stacks = (size, [stack_views(views, size) for views in self.capture.train])
        return self.stacks[1]

    def _aimed_images(self) -> list[ImageStack]:
        """`_images` with their cameras as they are turned and shifted by now."""
        images = [stack.shifted(self.state.offset) for stack in self._images()]
        return images if self.state.turns is None else [i.turned(t) for i, t in zip(images, self.state.turns, strict=True)]

    def _camera(self, stack: ImageStack, state: int, v: int) -> Camera:
        """The camera of a view as it is turned and shifted by now."""
        camera = stack.cameras[v].shifted(self.state.offset)
        return camera if self.state.turns is None else camera.turned(self.state.turns[state][v])

    def _step(self) -> tuple[float, float | None]:
        """One step of the optimiser; its loss and the images' PSNR."""
        config, step, variables = self.config, self.state.step, self.state.variables
        loss = torch.zeros((), device=self.device)
        psnr = None
        parts = variables.parts()
        if step < config.structure_until:
            loss = loss + self._structure_loss(parts)
        pictures = []
        if step >= config.image_from:
            error, pictures, psnr = self._image_loss(parts)
            loss = loss + error
        loss.backward()
        if config.hypotheses:  # the base's box is known, and is no smaller for being hollow, as that of a table with its legs
            for name in _BOX_NAMES:
                if (gradient := variables.leaves[name].grad) is not None:
                    gradient[0] = 0
        if step < config.growth.last * config.steps:
            for picture, _ in pictures:
                self.state.gradients.add(picture.projection, max(picture.alpha.shape) / config.image_weight)
        if pictures and self._rate("principal_point"):
            self.state.offset.grad = sum((offset_gradient(*picture) for picture in pictures), torch.zeros(2))
        self._move()
        return float(loss.detach()), psnr

    def _structure_loss(self, parts: PosedParts) -> Tensor:
        views = [self._view(s, len(stack)) for s, stack in enumerate(self.masks)]
        cameras = (self._camera(self.masks[0], 0, views[0]), self._camera(self.masks[1], 1, views[1]))
        masks = [stack.target(v)[1].to(self.device) for stack, v in zip(self.masks, views, strict=True)]
        boxes, motions = parts.boxes, parts.motions
        if not self.config.motions_with_structure:
            motions = SE3(motions.wxyz_xyz.detach())
            boxes = self.state.variables.boxes(motions)
        loose = self.state.step < self.config.loose_until
        return structure_loss(
            boxes,
            motions,
            cameras,
            (masks[0], masks[1]),
            StructureWeights(),
            softness=0.01 * self.state.size,
            loose=loose,
        )

    def _image_loss(self, parts: PosedParts) -> tuple[Tensor, list[tuple[Render, Camera]], float | None]:
        config = self.config
        posed = [parts.at_state(s) for s in (0, 1)]
        loss = self._priors(parts, posed)
        ssim_weight = self._in_force(config.ssim_weights)
        pictures, squares = [], []
        for s, stack in enumerate(self._images()):
            v = self._view(s, len(stack))
            rgb, alpha = (image.to(self.device) for image in stack.target(v))
            camera = self._camera(stack, s, v)
            picture = render(posed[s], camera)
            if self.state.turns is not None:
                drawn, photo = with_coverage(picture.rgb, picture.alpha), with_coverage(rgb, alpha)
                self.state.turns[s][v] += _AIM * misaim(drawn, photo, camera)
            picture.projection.xy.retain_grad()
            pictures.append((picture, camera))
            loss = loss + config.image_weight * image_loss(
                picture.rgb, picture.alpha, rgb, alpha, ssim_weight=ssim_weight, alpha_weight=config.alpha_weight
            )
            if (self.state.step + 1) % _REPORT_EVERY == 0:
                squares.append(float((picture.rgb.detach() - rgb).square().mean()))
        return loss, pictures, -10 * float(np.log10(max(np.mean(squares), 1e-12))) if squares else None

    def _priors(self, parts: PosedParts, posed: Sequence[Splats]) -> Tensor:
        """What is likelier whatever the photos say; posed: the splats in both states."""
        config = self.config
        loss = torch.zeros((), device=self.device)
        if config.along_base:
            loss = loss + config.along_base * askew(parts, self.state.variables.kinds or _kinds(parts.detach()))
        if config.tint_penalty:
            loss = loss + config.image_weight * config.tint_penalty * parts.tint.abs().mean()
        if config.opacity_penalty:
            loss = loss + config.opacity_penalty * parts.splats.opacities.mean()
        if config.thickness_penalty:
            loss = loss + config.thickness_penalty / self.state.size * thickness(parts.splats)
        if config.planarity_weight and self.state.step >= config.planarity_from * config.steps:
            for s, stack in enumerate(self.faces):
                v = self._view(s, len(stack))
                rgb, alpha = (image.to(self.device) for image in stack.target(v))
                loss = loss + config.planarity_weight * planarity_loss(posed[s], self._camera(stack, s, v), rgb, alpha)
        return loss

    def _rate(self, name: str) -> float:
        """The learning rate of a leaf in this step."""
        rates, config = self.config.rates, self.config
        done = max(0, self.state.step - config.image_from) / max(1, config.steps - config.image_from)
        if name in _BOX_NAMES:  # without the losses on boxes only splats and motions have something to explain
            return rates.boxes * rates.poses_final**done if self.state.step < config.structure_until else 0.0
        if name in _POSE_NAMES and self.state.step < config.motions_from * config.steps:
            return 0.0
        if name == "principal_point" and self.state.turns is not None:  # turns put every photo right by itself
            return 0.0
        finals = {"means": rates.means_final, "motions": rates.motions_final, "principal_point": rates.poses_final}
        final = finals.get(name, rates.appearance_final)
        return getattr(rates, name) * final**done

    @torch.no_grad()
    def _move(self) -> None:
        """A step of the optimiser; motions that are to rest do, and those that are to stay straight do."""
        state, config, variables = self.state, self.config, self.state.variables
        before = variables.leaves["motions"].clone()
        self._adam()
        if not self._rate("motions"):
            return
        if any(0 <= state.step - round(at * config.steps) < config.laid_rest * config.steps for at in config.lay_at):
            variables.leaves["motions"][state.laid] = before[state.laid]
        if state.step < config.straight_until * config.steps:
            variables.set_motions(held_along_base(variables.parts(), state.straight))

    @torch.no_grad()
    def _adam(self) -> None:
        """Adam (Kingma and Ba 2015), leaf by leaf.

        A motion's six directions share one second moment, and so do the two of the principal point: scaled each by itself,
        those of which the photos say little would be driven about by noise as fast as the others move for a reason.
        """
        for name, leaf in [*self.state.variables.leaves.items(), ("principal_point", self.state.offset)]:
            rate = self._rate(name)
            if leaf.grad is not None and rate:
                self.state.taken[name] = t = self.state.taken[name] + 1
                first, second = self.state.moments[name]
                first.lerp_(leaf.grad, 0.1)
                square = leaf.grad.square()
                second.lerp_(square.mean(-1, keepdim=True).expand_as(square) if name in _POSE_NAMES else square, 0.001)
                correction = np.sqrt(1 - 0.999**t) / (1 - 0.9**t)
                leaf.addcdiv_(first, second.sqrt().add_(1e-15), value=-rate * correction)
            leaf.grad = None

    @torch.no_grad()
    def _founded(self, *, last: bool) -> Bool[Tensor, " N"] | None:
        """Splats that may stay, as photos have it; None for all.

        After the last step those that some photo shows; once boxes fit their parts, what is outside of its box needs support.
        """
        parts = self.state.variables.parts().detach()
        if last:
            return shown(parts, self._aimed_images())
        if self.state.step < min(self.config.square_at, default=1.0) * self.config.steps:
            return None
        return (parts.splats.means.abs() <= 1).all(-1) | supported(parts, self._aimed_images())

    def _densify(self) -> None:
        """A round of densification or of pruning, where the schedule asks for one; what photos give no reason for goes."""
        config, growth, done = self.config, self.config.growth, self.state.step + 1
        last = done == config.steps
        if done <= config.image_from or (done % growth.interval and not last):
            return
        growing = growth.first * config.steps < done <= growth.last * config.steps and not last
        stay = self._founded(last=last)
        noise = torch.Generator().manual_seed(int(np.random.default_rng((self.seed, self.state.step)).integers(2**62)))
        gradients = self.state.gradients if growing else None
        self.state.variables, source, fresh = grow(self.state.variables, gradients, growth, self.state.size, noise, stay)
        for name in SPLAT_NAMES:
            first, second = (moment[source] for moment in self.state.moments[name])
            first[fresh], second[fresh] = 0, 0
            self.state.moments[name] = (first, second)
        self.state.gradients = ScreenGradients.zeros(len(source), self.device)
        if growing and growth.reset and done % growth.reset == 0:
            with torch.no_grad():
                self.state.variables.leaves["logit_opacities"].clamp_(max=float(np.log(0.01 / 0.99)))


@functools.lru_cache(maxsize=8)
def _order(seed: int, state: int, turn: int, count: int) -> np.ndarray:
    """The order of a state's views in one round."""
    return np.random.default_rng((seed, state, turn)).permutation(count)


def _kinds(parts: PosedParts) -> list[JointKind]:
    """The types of the moving parts as they now move."""
    return [kind_of(parts.motions[k]) for k in range(1, len(parts))]

"""What a fit does when: the configuration and its presets."""

from dataclasses import dataclass, field

from ..boxes import StartConfig


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates at the start of the fit."""

    means: float = 1.6e-2
    """Of splat centres, in the unit box (supplement 1.1)."""
    quats: float = 4e-3
    """Of splat orientations."""
    log_scales: float = 1e-2
    """Of the logarithms of splat sizes."""
    logit_opacities: float = 5e-2
    """Of splat opacities."""
    sh: float = 1e-2
    """Of the colours' spherical harmonics."""
    tint: float = 5e-3
    """Of the colour difference between the states, rgb."""
    boxes: float = 3e-3
    """Of the boxes' poses and half extents (T_0), radians and world units."""
    motions: float = 6e-3
    """Of the motions (T_1), radians and world units: what a search of few photos left ten degrees off still comes home."""
    principal_point: float = 8e-6
    """Of the principal point that all cameras share, focal lengths; it moves when motions do."""
    means_final: float = 0.02
    """Fraction of its start that the rate of the centres has fallen to at the end."""
    motions_final: float = 0.033
    """The same for motions."""
    poses_final: float = 0.1
    """The same for boxes and the principal point."""
    appearance_final: float = 0.2
    """The same for all other rates."""


@dataclass(frozen=True)
class Growth:
    """Densification and pruning, as in 3DGS."""

    first: float = 0.2
    """Part of the fit after which splats begin to multiply."""
    last: float = 0.7
    """Part of the fit after which they no longer do."""
    interval: int = 100
    """Steps between two rounds."""
    gradient: float = 1e-4
    """Mean screen-space gradient (in half image sizes) above which a splat is cloned or split (3DGS: 2e-4, with D-SSIM's
    larger gradients from the start)."""
    small: float = 0.01
    """Splats smaller than this (times the object's size) are cloned, larger ones split."""
    most: int = 25_000
    """No more splats than this."""
    faint: float = 0.005
    """Splats of lower opacity go."""
    reach: float = 0.1
    """Splats whose centre is farther than this (times the object's size) outside their box go; where photos ask for what
    sticks out of it, such as a handle that the looks missed, they find it."""
    reset: int = 0
    """Steps between two resets of the opacities; 0 for none."""


@dataclass(frozen=True)
class FitConfig:
    """The whole fit.  Parts of the fit are fractions of `steps`."""

    steps: int = 1400
    """Optimiser steps, each with one view of either state."""
    hypotheses: bool = True
    """Search each part's motion before the fit; otherwise start from rest, as in the supplement."""
    splats_per_part: int = 1000
    """Splats strewn in each box at the start (supplement: 10,000, and nothing else to start from)."""
    sh_degree: int = 0
    """Degree of the spherical harmonics."""
    structure_until: int = 150
    """Step at which the losses on boxes end."""
    loose_until: int = 150
    """Step at which contact and extent end."""
    image_from: int = 150
    """Step at which the image loss begins."""
    structure_size: int = 96
    """Size of the structure images: the side of a square with as many pixels."""
    motions_from: float = 0.2
    """Part of the fit after which motions move.  While splats still fill their boxes, which are wider than their parts, what
    sticks out of a part where photos see it pushes it aside, and splats that settle afterwards keep it there."""
    aim_at: float = 0.15
    """Part of the fit at which, once photos are compared, those that lie beside their cameras' pictures have the cameras
    turned, from then on; 1 for never."""
    give_way: float = 0.5
    """Share of every change of a motion that state 0 gives way by, so that both states move towards each other: splats settle
    half-way between what the two ask for, and would else hold a motion back; 0 to move state 1 alone, as in the supplement."""
    motions_with_structure: bool = False
    """Whether the losses on boxes move the motions too, from `motions_from` on."""
    sizes: tuple[tuple[float, int], ...] = ((0.0, 160), (0.35, 256), (0.65, 400), (0.92, 800))
    """(part of the fit, size) from which on images have that size, cropped to the object; never more than they have."""
    image_weight: float = 10.0
    """Of the image loss."""
    ssim_weights: tuple[tuple[float, float], ...] = ((0.0, 0.05), (0.65, 0.2))
    """(part of the fit, share) from which on D-SSIM has that share of the image loss.  While texture is finer than the splats
    it throws turns off; afterwards surfaces come out better with 3DGS's .2 than with less."""
    alpha_weight: float = 0.5
    """Of the mask's error beside the colour's.  More brings turns nearer, and costs surfaces more: a mask asks for more opacity
    wherever its object is."""
    tint_penalty: float = 0.3
    """Of the mean absolute colour difference between the states."""
    opacity_penalty: float = 0.2
    """Of the splats' mean opacity: what the photos do not need fades, and less hangs before the surface (3DGS-MCMC)."""
    thickness_penalty: float = 10.0
    """Of the splats' mean thickness over the object's size."""
    planarity_weight: float = 0.1
    """Of the loss that makes faces without texture plane."""
    planarity_from: float = 0.5
    """Part of the fit after which faces are made plane: what is hollow has to be found hollow before."""
    planarity_size: int = 160
    """Size of the images that it is taken from: the side of a square with as many pixels."""
    lay_at: tuple[float, ...] = (0.35, 0.7)
    """Parts of the fit after which parts are laid anew in the plane of their face, where photos of both states are alike."""
    laid_rest: float = 0.15
    """Part of the fit for which the motions of those parts then rest, until splats have forgotten where they were before."""
    along_base: float = 1.0
    """Of the squared sine of the angle between a joint's axis and the nearest one of the base's box, where that is small.  At
    the end joints that photos do not tell from ones along the base go along it.  0 for neither."""
    straight_until: float = 0.8
    """Part of the fit up to which joints that begin along the base's box stay along it.  While splats settle, photos of a plain
    front draw its axis aside, and splats then hold it there; one that is truly askew comes home afterwards.  0 for none."""
    square_at: tuple[float, ...] = (0.35, 0.6)
    """Parts of the fit after which boxes are turned along the faces of their parts, drawn in to what photos support, and drawn
    out where splats press on.  From the first on splats need support outside their box."""
    join_at: float = 0.35
    """Part of the fit after which parts that touch and move alike are made one, and what need not move is left to the base;
    1 for never."""
    one_joint_from: float = 0.6
    """Part of the fit after which every motion is held to its joint's one degree of freedom; 1 for never."""
    checkpoint_every: int = 250
    """Steps between two checkpoints."""
    start: StartConfig = field(default_factory=StartConfig)
    """What comes before the fit: hulls, looks, boxes, motions."""
    rates: Rates = field(default_factory=Rates)
    """Learning rates."""
    growth: Growth = field(default_factory=Growth)
    """Densification and pruning."""

    def __post_init__(self) -> None:
        if self.structure_until < self.image_from:
            raise ValueError(
                f"structure_until {self.structure_until} lies before image_from {self.image_from}: no loss is on in between."
            )
        if self.motions_with_structure and self.motions_from * self.steps >= self.structure_until:
            raise ValueError(
                f"motions_with_structure: the losses on boxes end at step {self.structure_until}, before motions move (from"
                f" step {self.motions_from * self.steps:g} on); give a lower motions_from."
            )


PRESETS: dict[str, FitConfig] = {
    "fast": FitConfig(steps=700, structure_until=60, loose_until=60, image_from=60, sizes=((0.0, 200), (0.7, 320))),
    "default": FitConfig(),
    "paper": FitConfig(
        steps=10_000,
        hypotheses=False,
        splats_per_part=10_000,
        structure_until=10_000,
        loose_until=1500,
        image_from=400,
        motions_from=0.0,
        aim_at=1.0,
        give_way=0.0,
        motions_with_structure=True,
        sizes=((0.0, 1600),),
        ssim_weights=((0.0, 0.2),),
        alpha_weight=0.0,
        tint_penalty=0.0,
        opacity_penalty=0.0,
        thickness_penalty=0.0,
        planarity_weight=0.0,
        along_base=0.0,
        square_at=(),
        join_at=1.0,
        lay_at=(),
        straight_until=0.0,
        one_joint_from=1.0,
        checkpoint_every=500,
        rates=Rates(
            quats=1e-3,
            log_scales=5e-3,
            sh=2.5e-3,
            tint=0.0,
            boxes=1e-2,
            motions=1e-2,
            principal_point=0.0,
            means_final=0.01,  # 3DGS's rates include this fall
            motions_final=0.01,
            poses_final=0.01,  # a constant 1e-2 shakes all splats of a box by a hundredth of its size
            appearance_final=1.0,
        ),
        growth=Growth(first=0.05, last=0.5, gradient=2e-4, reset=3000, most=50_000, reach=0.03),
    ),
}

"""What each choice of the fit is worth: one undone at a time."""

from dataclasses import replace
from pathlib import Path

from ..capture import Capture
from ..fit.schedule import FitConfig
from .setting import Setting


def ablations(capture: Capture, config: FitConfig, folder: Path, seed: int) -> list[Setting]:  # noqa: ARG001
    """The fit as it is, then with one choice undone in each; arguments as of every study."""
    last = config.sizes[-1][1]
    rows = {
        "no_tint": ("no colour difference between the states", without_tint(config)),
        "given_lens": ("principal point as given", replace(config, rates=replace(config.rates, principal_point=0.0))),
        "heavy_masks": ("masks of four times the weight", replace(config, alpha_weight=4 * config.alpha_weight)),
        "one_state": ("motions move state 1 alone", replace(config, give_way=0.0)),
        "free_joints": ("motions not held to one degree of freedom", replace(config, one_joint_from=1.0)),
        "free_axes": ("joints not drawn to the base's axes", replace(config, along_base=0.0, straight_until=0.0)),
        "never_held": ("joints that begin along the base not kept there", replace(config, straight_until=0.0)),
        "never_laid": ("parts not laid anew on the way", replace(config, lay_at=())),
        "no_surface": (
            "no losses on surfaces",
            replace(config, planarity_weight=0.0, opacity_penalty=0.0, thickness_penalty=0.0),
        ),
        "no_ssim": ("no SSIM", replace(config, ssim_weights=((0.0, 0.0),))),
        "ssim_of_3dgs": ("SSIM's share as in 3DGS from the start", replace(config, ssim_weights=((0.0, 0.2),))),
        "steady_poses": (
            "rates of poses that do not fall",
            replace(config, rates=replace(config.rates, motions_final=1.0, poses_final=1.0)),
        ),
        "half_size": ("photos of half the size", replace(config, sizes=tuple((at, size // 2) for at, size in config.sizes))),
        "full_size": ("photos of the last size from the start", replace(config, sizes=((0.0, last),))),
        "eager_motions": ("motions move as soon as photos are compared", replace(config, motions_from=0.0)),
        "boxes_pull": (
            "losses on boxes move the motions too",
            replace(config, motions_with_structure=True, motions_from=0.0),
        ),
        "no_search": ("no search: motions start at rest", replace(config, hypotheses=False)),
    }
    return [Setting("default", "as it is", config), *(Setting(name, *row) for name, row in rows.items())]


def without_tint(config: FitConfig) -> FitConfig:
    """The fit with one colour for both states."""
    return replace(config, tint_penalty=0.0, rates=replace(config.rates, tint=0.0))

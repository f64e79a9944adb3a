"""Photos that are worse than, or other than, those of the capture."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

from ..boxes import clusters, survey
from ..capture import Capture, View
from ..fit.schedule import FitConfig
from .ablation import without_tint
from .setting import Setting

_PIXELS = 2  # by which masks are off
_NOISE = 0.05  # standard deviation of colours in [0, 1]
_ASTRAY_DEG = 0.5  # of the cameras
_OFF_CENTRE = (1.0, -1.0)  # pixels by which photos lie beside their cameras, right and down
_BRIGHTER = (1.2, 1.2, 1.2)  # factors on the channels of state 1
_WARMER = (1.1, 1.0, 0.9)


def variations(capture: Capture, config: FitConfig, folder: Path, seed: int) -> list[Setting]:  # noqa: ARG001
    """The photos as they are, then changed in one way in each; arguments as of every study."""
    brighter, warmer = partial(_gained, gains=_BRIGHTER), partial(_gained, gains=_WARMER)
    rows: dict[str, tuple[str, Callable[[Capture], Capture]]] = {
        "one_side": ("the half of the views from the side where things move", partial(_one_side, config=config, seed=seed)),
        "half_size": ("photos of half the size", partial(_each, change=_halved)),
        "noise": (f"noise of {_NOISE:g} on the colours", partial(_noisy, seed=seed)),
        "masks_eroded": (f"masks eroded by {_PIXELS} pixels", partial(_each, change=_eroded)),
        "masks_dilated": (f"masks dilated by {_PIXELS} pixels", partial(_each, change=_dilated)),
        "cameras_astray": (f"cameras turned by {_ASTRAY_DEG:g} degrees", partial(_astray, seed=seed)),
        "off_centre": ("principal points off by a pixel each way", partial(_each, change=_off_centre)),
        "brighter": (f"state 1 brighter by {_BRIGHTER[0]:g}", brighter),
        "warmer": ("state 1 in warmer light", warmer),
    }
    found = [Setting(name, says, config, photos=photos) for name, (says, photos) in rows.items()]
    flat = without_tint(config)
    found += [Setting(f"{s.name}_no_tint", f"{s.says}, one colour for both", flat, photos=s.photos) for s in found[-2:]]
    return [Setting("default", "as they are", config), *found]


def _each(capture: Capture, change: Callable[[View], View]) -> Capture:
    """The capture with every training view changed; the test views are as they were."""
    train = [tuple(change(view) for view in state) for state in capture.train]
    return replace(capture, train=(train[0], train[1]))


def _halved(view: View) -> View:
    width, height = view.camera.width // 2, view.camera.height // 2
    rgb, alpha = view.image(width, height)
    straight = (rgb - (1 - alpha[..., None])) / np.maximum(alpha[..., None], 1e-6)
    rgba = np.concatenate([straight, alpha[..., None]], -1)
    return View(view.name, view.camera.resized(width, height), np.rint(255 * rgba.clip(0, 1)).astype(np.uint8))


def _eroded(view: View) -> View:
    rgba = view.rgba.copy()
    rgba[..., 3] = ndimage.grey_erosion(rgba[..., 3], 2 * _PIXELS + 1)
    return replace(view, rgba=rgba)


def _dilated(view: View) -> View:
    """What the wider mask adds is white, as a background might be."""
    rgba = view.rgba.copy()
    rgba[rgba[..., 3] == 0, :3] = 255
    rgba[..., 3] = ndimage.grey_dilation(rgba[..., 3], 2 * _PIXELS + 1)
    return replace(view, rgba=rgba)


def _noisy(capture: Capture, seed: int) -> Capture:
    generator = np.random.default_rng(seed)

    def change(view: View) -> View:
        rgba = view.rgba.copy()
        error = 255 * _NOISE * generator.standard_normal(rgba[..., :3].shape)
        rgba[..., :3] = np.rint(rgba[..., :3] + error).clip(0, 255)
        return replace(view, rgba=rgba)

    return _each(capture, change)


def _astray(capture: Capture, seed: int) -> Capture:
    """Every camera turned about its own centre, each about another axis."""
    generator = torch.Generator().manual_seed(seed)

    def change(view: View) -> View:
        axis = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0)
        return replace(view, camera=view.camera.turned(np.deg2rad(_ASTRAY_DEG) * axis))

    return _each(capture, change)


def _off_centre(view: View) -> View:
    right, down = _OFF_CENTRE
    return replace(view, camera=replace(view.camera, cx=view.camera.cx - right, cy=view.camera.cy - down))


def _gained(capture: Capture, gains: tuple[float, float, float]) -> Capture:
    """State 1's colours times a gain for each channel."""
    state_1 = tuple(
        replace(view, rgba=np.rint(view.rgba * np.array([*gains, 1.0])).clip(0, 255).astype(np.uint8))
        for view in capture.train[1]
    )
    return replace(capture, train=(capture.train[0], state_1))


def _one_side(capture: Capture, config: FitConfig, seed: int) -> Capture:
    """Of either state the half of the views whose cameras are nearest to the direction in which what moves lies."""
    looks = survey(capture, None, config.start, seed)
    found = clusters(looks, config.start.search.cue)
    if not found:
        return capture
    middle = np.concatenate([look.points for look in looks]).mean(0)
    towards = np.concatenate([cluster.points for cluster in found]).mean(0) - middle
    train = []
    for views in capture.train:
        side = np.array([(view.camera.centre.double().numpy() - middle) @ towards for view in views])
        kept = np.sort(np.argsort(-side, kind="stable")[: max(len(views) // 2, 3)])
        train.append(tuple(views[i] for i in kept))
    return replace(capture, train=(train[0], train[1]))

"""Bad starts (supplement, section 2): other thresholds, noisy, foreign and lopsided points."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.spatial import KDTree

from ..boxes import CueConfig, StateLook, clusters, survey
from ..capture import Capture
from ..files import replace_file
from ..fit.schedule import FitConfig
from .setting import Setting

Points = Float64[np.ndarray, "_ 3"]

_LEFT = 0.25  # of a cluster's extent along its longest axis: the fragment that a lopsided start leaves of it


def bad_starts(capture: Capture, config: FitConfig, folder: Path, seed: int) -> list[Setting]:
    """The starts, the unperturbed one first; writes the points of those that begin from other points below `folder`."""
    rows = [Setting("default", "as it is", config)]
    cue = config.start.search.cue
    for name, factor in (("third", 1 / 3), ("half", 0.5), ("double", 2.0), ("triple", 3.0)):
        search = replace(config.start.search, cue=replace(cue, threshold=cue.threshold * factor))
        changed = replace(config, start=replace(config.start, search=search))
        rows.append(Setting(f"threshold_{name}", f"threshold of the motion cue x {factor:.2g}", changed))
    files = {name: folder / "points" / f"{name}.npz" for name in _SAYS}
    if not all(file.exists() for file in files.values()):
        looks = survey(capture, None, config.start, seed)
        for name, points in perturbed_points(looks, cue, seed).items():
            replace_file(files[name], _as_npz(points))
    rows += [Setting(name, says, config, points=str(files[name].resolve())) for name, says in _SAYS.items()]
    if all(views[0].depth is not None for views in capture.train):
        rows.append(Setting("depth", "points from the capture's depth maps", config, points="depth"))
    return rows


def perturbed_points(looks: tuple[StateLook, StateLook], cue: CueConfig, seed: int) -> dict[str, tuple[Points, Points]]:
    """Points of both states for each setting of `_SAYS`.

    noise_1, noise_2: the looks' own with Gaussian noise of so many voxels.  hull_surface: the outermost voxels of the
    visual hulls, which is what masks alone say.  lopsided: the looks' own without most of those that move: a fragment is
    left of each cluster, so that one box holds nearly everything.

    Args:
        looks: of both states.
        cue: tells which points move.
        seed: of the noise.
    """
    generator = np.random.default_rng(seed)
    own = [look.points for look in looks]
    rows = {f"noise_{n}": [p + generator.normal(0, n * looks[0].hull.voxel, p.shape) for p in own] for n in (1, 2)}
    hulls = [look.hull for look in looks]
    shells = [hull.occupied & np.logical_not(ndimage.binary_erosion(hull.occupied)) for hull in hulls]
    rows["hull_surface"] = [hull.centres(shell) for hull, shell in zip(hulls, shells, strict=True)]
    rows["lopsided"] = list(own)
    for cluster in clusters(looks, cue):
        spread = cluster.points - cluster.points.mean(0)
        along = spread @ np.linalg.svd(spread, full_matrices=False)[2][0]
        gone = KDTree(cluster.points[along > np.quantile(along, _LEFT)])
        kept = rows["lopsided"][cluster.state]
        rows["lopsided"][cluster.state] = kept[gone.query(kept)[0] > 0]
    return {name: (first, second) for name, (first, second) in rows.items()}


_SAYS = {
    "noise_1": "Gaussian noise of 1 voxel on the points",
    "noise_2": "Gaussian noise of 2 voxels on the points",
    "hull_surface": "points of the visual hulls' surface",
    "lopsided": "of each moving cluster only a fragment of a quarter",
}


def _as_npz(points: tuple[Points, Points]) -> bytes:
    """Both states' points as `fit --points` reads them."""
    memory = io.BytesIO()
    np.savez(memory, points_0=points[0], points_1=points[1])
    return memory.getvalue()

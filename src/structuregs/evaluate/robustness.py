"""How fits fare from bad starts (supplement, section 2, figure 2): other thresholds, noisy, foreign and lopsided points."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.spatial import KDTree

from ..boxes import CueConfig, StateLook, clusters, survey
from ..capture import Capture, Truth
from ..export.assets import replace_file
from ..export.chart import curves_chart
from ..export.overlay import draw_error_maps, draw_structure
from ..export.page import image_bytes, plain_page, png_url
from ..export.report import loss_points
from ..fit.events import Finished, FitEvent, Preview, Step
from ..fit.reconstruct import RunFolder, fit_run
from ..fit.schedule import FitConfig
from ..model import ArticulatedObject, load_object
from .report import evaluate_object
from .tables import markdown

Points = Float64[np.ndarray, "_ 3"]

_MOMENTS = (0.0, 0.1, 0.5)  # of the steps: when the boxes' progress is drawn, and at the end
_LEFT = 0.25  # of a cluster's extent along its longest axis: the fragment that a lopsided start leaves of it
_TWICE, _PLUS_DEG, _PLUS = 2.0, 0.05, 0.001  # what a perturbed run may err by: twice the unperturbed, and this


@dataclass(frozen=True)
class Setting:
    """One way to start.

    Attributes:
        name: of the setting and of its run's folder.
        says: what is different, in a few words.
        threshold: factor on the motion cue's threshold (`CueConfig.threshold`).
        points: where the first points come from, as `fit_run` takes it.
    """

    name: str
    says: str
    threshold: float = 1.0
    points: str = "hull"


@dataclass(frozen=True)
class RobustnessStudy:
    """The same capture fitted from several starts, each in a run of its own in `folder/runs`.

    Attributes:
        capture: what was photographed.
        folder: of the runs, the perturbed points and the results.
        config: of the unperturbed fit.
        device: of the fits.
        seed: of the fits and of the noise.
    """

    capture: Capture
    folder: Path
    config: FitConfig
    device: str = "auto"
    seed: int = 0

    def settings(self) -> list[Setting]:
        """The starts, the unperturbed one first; writes the points of those that begin from other points."""
        rows = [Setting("default", "as it is")]
        for name, factor in (("third", 1 / 3), ("half", 0.5), ("double", 2.0), ("triple", 3.0)):
            rows.append(Setting(f"threshold_{name}", f"threshold of the motion cue x {factor:.2g}", factor))
        files = {name: self.folder / "points" / f"{name}.npz" for name in _SAYS}
        if not all(file.exists() for file in files.values()):
            looks = survey(self.capture, None, self.config.start, self.seed)
            for name, points in perturbed_points(looks, self.config.start.search.cue, self.seed).items():
                replace_file(files[name], _as_npz(points))
        rows += [Setting(name, says, points=str(files[name].resolve())) for name, says in _SAYS.items()]
        if all(views[0].depth is not None for views in self.capture.train):
            rows.append(Setting("depth", "points from the capture's depth maps", points="depth"))
        return rows

    def run(self, setting: Setting) -> Path:
        """Folder of a setting's run."""
        return self.folder / "runs" / setting.name

    def events(self, setting: Setting) -> Iterator[FitEvent]:
        """The fit of a setting, from where it was left; draws the boxes as they move."""
        run = self.run(setting)
        cue = self.config.start.search.cue
        search = replace(self.config.start.search, cue=replace(cue, threshold=cue.threshold * setting.threshold))
        config = replace(self.config, start=replace(self.config.start, search=search))
        moments, step = self._moments(), 0
        for event in fit_run(self.capture, run, config, device=self.device, points=setting.points, seed=self.seed):
            if isinstance(event, Step) and event.stage == "fit":
                step = event.step
            if isinstance(event, Preview) and any(moment <= step < moment + config.steps // 20 for moment in moments):
                moment = max(moment for moment in moments if moment <= step)
                if not (picture := _picture(run, moment)).exists():
                    self._draw(event.obj(), picture)
            if isinstance(event, Finished):
                self._draw(event.obj, _picture(run, config.steps))
            yield event

    def _moments(self) -> list[int]:
        """The steps at which the boxes are drawn, but for the last."""
        return [round(share * self.config.steps) for share in _MOMENTS]

    def _draw(self, obj: ArticulatedObject, file: Path) -> None:
        replace_file(file, image_bytes(draw_structure(self.capture, obj, columns=1, size=220), "PNG"))

    def write(self, settings: Sequence[Setting], truth: Truth | None) -> list[Path]:
        """Writes `robustness.md`, `robustness.html` and `error_maps.png` of finished fits; returns their paths.

        Args:
            settings: those whose runs are finished, the unperturbed first.
            truth: the true joints, if they are known; without them only photos are compared.
        """
        objects = {setting: load_object(RunFolder(self.run(setting)).object) for setting in settings}
        table = _table([(setting, _figures(objects[setting], self.capture, truth)) for setting in settings])
        maps = image_bytes(draw_error_maps(self.capture, objects[settings[0]]), "PNG")
        curves = {setting.name: loss_points(RunFolder(self.run(setting)).records()) for setting in settings}
        chart = curves_chart({name: curve for name, curve in curves.items() if curve}, x_label="step", y_label="Loss", log=True)
        legend = "Photo, mask, structure image of all boxes, what no box covers, and what each box covers outside the mask."
        sections = [
            f"<section><h2>Final errors</h2>{_as_html(table)}</section>",
            f"<section><h2>Fitting error</h2>{chart}</section>",
            *(self._progress(setting) for setting in settings),
            f'<section><h2>{legend}</h2><img src="{png_url(maps)}" alt="Error maps"></section>',
        ]
        page = plain_page(
            "study.html",
            title=escape(f"{self.capture.name}: bad starts"),
            lead="The same photos fitted from several starts.",
            sections="\n".join(sections),
            footer="Lengths are in the capture's unit. Written by structuregs.",
        )
        text = f"# {self.capture.name}: bad starts\n\n{markdown(table)}\n{_BOUND}\n"
        files = {"robustness.md": text, "robustness.html": page, "error_maps.png": maps}
        return [replace_file(self.folder / name, content) for name, content in files.items()]

    def _progress(self, setting: Setting) -> str:
        """A row of pictures of the boxes, from the start to the end."""
        steps = [*self._moments(), self.config.steps]
        files = [(step, _picture(self.run(setting), step)) for step in steps]
        shown = "".join(
            f'<figure><img src="{png_url(file.read_bytes())}" alt="step {step}"><figcaption>step {step}</figcaption></figure>'
            for step, file in files
            if file.exists()
        )
        return f'<section><h2>{escape(setting.says)}</h2><div class="row">{shown}</div></section>'


_BOUND = (
    f"Within: types and number of parts right, and every error at most {_TWICE:g} times that of the unperturbed run and"
    f" {_PLUS_DEG:g} deg, or {_PLUS:g} units."
)


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


def _picture(run: Path, step: int) -> Path:
    return run / f"boxes_{step:05d}.png"


@dataclass(frozen=True)
class _Figures:
    """What became of one fit; errors are the worst over the joints, None where no joint has them."""

    parts: int
    failed: int | None
    extra: int | None
    axis_deg: float | None
    position: float | None
    turn_deg: float | None
    slide: float | None
    psnr: float | None


def _figures(obj: ArticulatedObject, capture: Capture, truth: Truth | None) -> _Figures:
    report = evaluate_object(obj, capture, truth)

    def worst(name: str) -> float | None:
        return max((e for score in report.joints if (e := getattr(score, name)) is not None), default=None)

    return _Figures(
        parts=len(obj.parts) - 1,
        failed=report.failures if truth else None,
        extra=len(report.unmatched_parts) if truth else None,
        axis_deg=worst("axis_angle_deg"),
        position=worst("axis_position"),
        turn_deg=worst("geodesic_deg"),
        slide=worst("translation"),
        psnr=report.psnr,
    )


def _within(row: _Figures, default: _Figures) -> bool:
    """Whether a run came out about as the unperturbed one."""
    bounds = {"axis_deg": _PLUS_DEG, "position": _PLUS, "turn_deg": _PLUS_DEG, "slide": _PLUS}
    errors = [(getattr(row, name), getattr(default, name), plus) for name, plus in bounds.items()]
    close = all(one is not None and one <= _TWICE * other + plus for one, other, plus in errors if other is not None)
    return close and (row.failed, row.extra) == (0, 0)


def _table(rows: Sequence[tuple[Setting, _Figures]]) -> list[tuple[str, ...]]:
    """Heads, then a row for each setting."""

    def shown(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    table: list[tuple[str, ...]] = [
        ("start", "parts", "failed", "too many", "axis deg", "position", "turn deg", "slide", "PSNR", "within")
    ]
    for setting, row in rows:
        forms = zip(
            (row.axis_deg, row.position, row.turn_deg, row.slide, row.psnr), (".3f", ".4f", ".3f", ".4f", ".1f"), strict=True
        )
        verdict = "-" if row.failed is None else "yes" if _within(row, rows[0][1]) else "**no**"
        counts = ["-" if count is None else str(count) for count in (row.parts, row.failed, row.extra)]
        table.append((setting.says, *counts, *(shown(value, form) for value, form in forms), verdict))
    return table


def _as_html(table: Sequence[Sequence[str]]) -> str:
    heads = "".join(f"<th>{escape(cell)}</th>" for cell in table[0])
    rows = ("".join(f"<td>{escape(cell.strip('*'))}</td>" for cell in row) for row in table[1:])
    return f"<table><tr>{heads}</tr>" + "".join(f"<tr>{row}</tr>" for row in rows) + f"</table><p>{escape(_BOUND)}</p>"

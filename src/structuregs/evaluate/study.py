"""Studies: the same capture fitted under other conditions, and how the results differ."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from ..capture import Capture, Truth
from ..export.chart import curves_chart
from ..export.overlay import draw_error_maps, draw_structure
from ..export.page import image_bytes, plain_page, png_url
from ..export.report import loss_points
from ..files import replace_file
from ..fit.events import Finished, FitEvent, Preview, Step
from ..fit.reconstruct import fit_run
from ..fit.run import RunFolder
from ..fit.schedule import FitConfig
from ..model import ArticulatedObject, load_object
from .ablation import ablations
from .report import evaluate_object
from .robustness import bad_starts
from .setting import Setting
from .tables import markdown
from .variations import variations

_MOMENTS = (0.0, 0.1, 0.5)  # of the steps: when the boxes' progress is drawn, and at the end
_TWICE, _PLUS_DEG, _PLUS = 2.0, 0.05, 0.001  # what another run may err by: twice the unchanged, and this
# Of each study: its settings, its title, and what it does.
STUDIES = {
    "robustness": (bad_starts, "bad starts", "The same photos fitted from several starts."),
    "ablation": (ablations, "choices undone", "The same photos fitted with one choice undone at a time."),
    "variations": (variations, "other photos", "The same object fitted to worse and to other photos."),
}


@dataclass(frozen=True)
class Study:
    """The same capture fitted in several settings, each in a run of its own in `folder/runs`.

    Attributes:
        kind: one of `STUDIES`.
        capture: what was photographed.
        folder: of the runs and the results.
        config: of the unchanged fit.
        device: of the fits.
        seed: of the fits and of the noise.
    """

    kind: str
    capture: Capture
    folder: Path
    config: FitConfig
    device: str = "auto"
    seed: int = 0

    def settings(self) -> list[Setting]:
        """What is fitted, the unchanged first."""
        return STUDIES[self.kind][0](self.capture, self.config, self.folder, self.seed)

    def run(self, setting: Setting) -> Path:
        """Folder of a setting's run."""
        return self.folder / "runs" / setting.name

    def events(self, setting: Setting) -> Iterator[FitEvent]:
        """The fit of a setting, from where it was left; draws the boxes as they move."""
        run, config = self.run(setting), setting.config
        moments, step = self._moments(), 0
        photos = setting.photos(self.capture)
        for event in fit_run(photos, run, config, device=self.device, points=setting.points, seed=self.seed):
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
        """Writes `KIND.md`, `KIND.html` and `error_maps.png` of finished fits; returns their paths.

        Args:
            settings: those whose runs are finished, the unchanged first.
            truth: the true joints, if they are known; without them only photos are compared.
        """
        objects = {setting: load_object(RunFolder(self.run(setting)).object) for setting in settings}
        _, title, lead = STUDIES[self.kind]
        figures = {s: _figures(objects[s], RunFolder(self.run(s)).seconds(), self.capture, truth) for s in settings}
        table = _table(list(figures.items()))
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
            title=escape(f"{self.capture.name}: {title}"),
            lead=lead,
            sections="\n".join(sections),
            footer="Lengths are in the capture's unit. Written by structuregs.",
        )
        text = f"# {self.capture.name}: {title}\n\n{markdown(table)}\n{_BOUND}\n"
        files = {f"{self.kind}.md": text, f"{self.kind}.html": page, "error_maps.png": maps}
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
    f"Within: types and number of parts right, and every error at most {_TWICE:g} times that of the unchanged run and"
    f" {_PLUS_DEG:g} deg, or {_PLUS:g} units."
)


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
    seconds: float


def _figures(obj: ArticulatedObject, seconds: float, capture: Capture, truth: Truth | None) -> _Figures:
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
        seconds=seconds,
    )


def _within(row: _Figures, default: _Figures) -> bool:
    """Whether a run came out about as the unchanged one."""
    bounds = {"axis_deg": _PLUS_DEG, "position": _PLUS, "turn_deg": _PLUS_DEG, "slide": _PLUS}
    errors = [(getattr(row, name), getattr(default, name), plus) for name, plus in bounds.items()]
    close = all(one is not None and one <= _TWICE * other + plus for one, other, plus in errors if other is not None)
    return close and (row.failed, row.extra) == (0, 0)


def _table(rows: Sequence[tuple[Setting, _Figures]]) -> list[tuple[str, ...]]:
    """Heads, then a row for each setting."""

    def shown(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    table: list[tuple[str, ...]] = [
        ("setting", "parts", "failed", "too many", "axis deg", "position", "turn deg", "slide", "PSNR", "seconds", "within")
    ]
    for setting, row in rows:
        forms = zip(
            (row.axis_deg, row.position, row.turn_deg, row.slide, row.psnr, row.seconds),
            (".3f", ".4f", ".3f", ".4f", ".1f", ".0f"),
            strict=True,
        )
        verdict = "-" if row.failed is None else "yes" if _within(row, rows[0][1]) else "**no**"
        counts = ["-" if count is None else str(count) for count in (row.parts, row.failed, row.extra)]
        table.append((setting.says, *counts, *(shown(value, form) for value, form in forms), verdict))
    return table


def _as_html(table: Sequence[Sequence[str]]) -> str:
    heads = "".join(f"<th>{escape(cell)}</th>" for cell in table[0])
    rows = ("".join(f"<td>{escape(cell.strip('*'))}</td>" for cell in row) for row in table[1:])
    return f"<table><tr>{heads}</tr>" + "".join(f"<tr>{row}</tr>" for row in rows) + f"</table><p>{escape(_BOUND)}</p>"

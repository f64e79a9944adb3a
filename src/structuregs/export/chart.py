"""Curves as inline SVG."""

import math
from collections.abc import Mapping, Sequence
from html import escape

Point = tuple[float, float]

_WIDTH, _HEIGHT = 520, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 14, 12, 34
_COLOURS = ("#000000", "#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe and Ito's
_SMOOTHED = 9  # points that a point of the bold curve is the mean of


def line_chart(points: Sequence[Point], *, x_label: str, y_label: str, log: bool = False, colour: str = "#0072b2") -> str:
    """A curve over its running mean as an `<svg>` element.

    Args:
        points: at least one, in the order of x.
        x_label: what x counts, below its axis.
        y_label: what y is, for who cannot see the picture.
        log: whether y, which must then be positive, is drawn by its logarithm.
        colour: of the curve, as CSS has it.
    """
    (rows, (raw, smooth)) = _drawn([points], x_label, log)
    rows.append(f'<polyline points="{_path(raw[0])}" stroke="{colour}" stroke-width="1" opacity="0.3"/>')
    rows.append(f'<polyline points="{_path(smooth[0])}" stroke="{colour}" stroke-width="2"/>')
    return _svg(rows, y_label)


def curves_chart(curves: Mapping[str, Sequence[Point]], *, x_label: str, y_label: str, log: bool = False) -> str:
    """The running means of several curves in one `<svg>` element, each with its name in its colour.

    Args:
        curves: points by name, as of `line_chart`.
        x_label: what x counts, below its axis.
        y_label: what y is, for who cannot see the picture.
        log: whether y, which must then be positive, is drawn by its logarithm.
    """
    rows, (_, smooth) = _drawn(list(curves.values()), x_label, log)
    for k, (name, line) in enumerate(zip(curves, smooth, strict=True)):
        colour, dashes = _COLOURS[k % len(_COLOURS)], "" if k < len(_COLOURS) else ' stroke-dasharray="5 3"'
        rows.append(f'<polyline points="{_path(line)}" stroke="{colour}" stroke-width="1.5"{dashes}/>')
        at = f'x="{_WIDTH - _RIGHT - 4}" y="{_TOP + 12 + 13 * k}" text-anchor="end"'
        rows.append(f'<text {at} style="fill:{colour}">{escape(name)}</text>')
    return _svg(rows, y_label)


def _drawn(
    curves: Sequence[Sequence[Point]], x_label: str, log: bool
) -> tuple[list[str], tuple[list[list[Point]], list[list[Point]]]]:
    """Grid and labels of a chart that holds all curves, and where the points of these and of their running means lie."""
    height_of = math.log10 if log else float
    heights = [[height_of(y) for _, y in points] for points in curves]
    low, high = min(map(min, heights)), max(map(max, heights))
    pad = 0.05 * (high - low) or 0.5
    low, high = low - pad, high + pad
    x_low = min(points[0][0] for points in curves)
    x_high = max(*(points[-1][0] for points in curves), x_low + 1)

    def place(x: float, y: float) -> Point:
        across = _LEFT + (x - x_low) / (x_high - x_low) * (_WIDTH - _LEFT - _RIGHT)
        return across, _TOP + (high - y) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)

    rows = []
    for tick in _log_ticks(low, high) if log else ticks(low, high):
        y = place(x_low, height_of(tick))[1]
        rows.append(f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
        rows.append(f'<text x="{_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for tick in ticks(x_low, x_high):
        x = place(tick, low)[0]
        rows.append(f'<text x="{x:.1f}" y="{_HEIGHT - _BOTTOM + 16}" text-anchor="middle">{tick:g}</text>')
    rows.append(f'<text x="{_WIDTH - _RIGHT}" y="{_HEIGHT - 3}" text-anchor="end" class="label">{x_label}</text>')
    lines = [
        [[place(x, y) for (x, _), y in zip(points, some, strict=True)] for points, some in zip(curves, ys, strict=True)]
        for ys in (heights, [_running_mean(ys) for ys in heights])
    ]
    return rows, (lines[0], lines[1])


def _svg(rows: Sequence[str], y_label: str) -> str:
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{y_label}">{"".join(rows)}</svg>'


def ticks(low: float, high: float, most: int = 6) -> list[float]:
    """At most `most` round values in a range, evenly apart by 1, 2 or 5 times a power of ten."""
    raw = (high - low) / (most - 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
    return [round(i * step, 12) for i in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten between two logarithms, with 2 and 5 times these where they are few."""
    factors = (1, 2, 5) if high - low < 3 else (1,)
    tens = range(math.floor(low), math.ceil(high) + 1)
    values = [factor * 10.0**ten for ten in tens for factor in factors]
    return [value for value in values if low <= math.log10(value) <= high]


def _running_mean(values: Sequence[float]) -> list[float]:
    """The mean over a window about each value, which is narrower at the ends and stays in the middle."""
    means = []
    for i in range(len(values)):
        reach = min(i, len(values) - 1 - i, _SMOOTHED // 2)
        window = values[i - reach : i + reach + 1]
        means.append(sum(window) / len(window))
    return means


def _path(points: Sequence[Point]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)

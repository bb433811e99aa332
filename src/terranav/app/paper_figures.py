"""The papers' figures redrawn from the data of a reproduction, whatever it is about."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from itertools import cycle, zip_longest

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from terranav.app.style import INS, MAIN, OTHERS, new_figure, styled
from terranav.experiment.papers.outcome import Figure, Series

FloatArray = NDArray[np.float64]

_COLOURS = (MAIN, INS, *OTHERS)
_DASHES = ("solid", (0, (5, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2)))
_MANY = 400  # points of a cloud that are drawn small
_LIMIT = "#454d55"
_MARKERS = "os^Dv"
_HEIGHT_IN, _SQUARE_IN = 4.6, 7.0


def draw(figure: Figure) -> Drawing:
    """Draw a figure.

    Parameters
    ----------
    figure : Figure
        Lines break where y is NaN; on a logarithmic axis also where y is not positive.

    Returns
    -------
    matplotlib.figure.Figure
    """
    kinds = {"lines": _lines, "points": _points, "bars": _bars}
    with styled():
        drawing = new_figure(_HEIGHT_IN)
        axes = drawing.subplots()
        shown = [series for series in figure.series if np.isfinite(series.y).any()]
        shown = [_positive(series) for series in shown] if figure.log_y else shown
        limits = [series for series in shown if figure.kind != "bars" and _is_limit(series)]
        kinds[figure.kind](axes, [series for series in shown if not any(series is limit for limit in limits)])
        for series, dashes in zip(limits, cycle(_DASHES[1:])):
            axes.plot(series.x, series.y, color=_LIMIT, linestyle=dashes, linewidth=1.1, label=series.label)
        if figure.log_y and shown:
            axes.set_yscale("log")
            _plain_ticks(axes)
        if not shown:
            axes.text(0.5, 0.5, "nothing to draw: no finite value", ha="center", transform=axes.transAxes)
        axes.set(xlabel=figure.x_label, ylabel=figure.y_label)
        axes.set_axisbelow(True)
        if figure.kind == "points" and _same_scale(axes, figure):
            drawing.set_figheight(_SQUARE_IN)
            axes.set_aspect("equal", adjustable="datalim")
        if len(shown) > 1 or any(series.label for series in shown):
            _legend(drawing, axes)
    return drawing


def data_csv(figure: Figure) -> str:
    """The data of a figure, one row a point: series, x, y, and low and high where there is a band."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n").writerow
    banded = any(series.low is not None for series in figure.series)
    write(["series", "x", "y", *(["low", "high"] if banded else [])])
    for series in figure.series:
        columns = [series.x, series.y, *([series.low, series.high] if banded else [])]
        for values in zip_longest(*[() if column is None else column.tolist() for column in columns]):
            write([series.label, *["" if value is None or math.isnan(value) else repr(value) for value in values]])
    return out.getvalue()


def _positive(series: Series) -> Series:
    """The series with NaN where a logarithmic axis has no place, the lower end of a band on its smallest value."""
    y = np.where(series.y > 0.0, series.y, np.nan)
    if series.low is None:
        return Series(series.label, series.x, y, series.low, series.high)
    floor = np.nanmin(y) if np.isfinite(y).any() else np.nan
    return Series(series.label, series.x, y, np.where(series.low > 0.0, series.low, floor), series.high)


def _is_limit(series: Series) -> bool:
    """Whether a series is a limit that others are held against: one value all along, without a band."""
    known = series.y[np.isfinite(series.y)]
    return series.low is None and known.size > 1 and bool(np.ptp(known) == 0.0)


def _style(i: int) -> tuple[str, object]:
    """Colour and dashes of line i: the dashes change when the colours have all been used."""
    return _COLOURS[i % len(_COLOURS)], _DASHES[i // len(_COLOURS) % len(_DASHES)]


def _lines(axes: Axes, all_series: Sequence[Series]) -> None:
    """Lines, with a band where there are limits, and a dot for a value that has a gap on both sides."""
    for i, series in enumerate(all_series):
        colour, dashes = _style(i)
        axes.plot(series.x, series.y, color=colour, linestyle=dashes, linewidth=1.6, label=series.label)
        known = np.isfinite(series.y)
        alone = known & ~np.append(False, known[:-1]) & ~np.append(known[1:], False)
        axes.plot(series.x[alone], series.y[alone], "o", color=colour, markersize=3.5)
        if series.low is not None and series.high is not None:
            axes.fill_between(series.x, series.low, series.high, color=colour, alpha=0.15, linewidth=0)


def _points(axes: Axes, all_series: Sequence[Series]) -> None:
    """A cloud each, with an error bar where there are limits."""
    for i, series in enumerate(all_series):
        colour = _COLOURS[i % len(_COLOURS)]
        marker = _MARKERS[i % len(_MARKERS)]
        size, alpha = (5.0, 0.85) if series.x.size <= _MANY else (3.0, 0.45)
        axes.plot(
            series.x, series.y, marker, color=colour, markersize=size, markeredgewidth=0, alpha=alpha,
            label=series.label,
        )  # fmt: skip
        if series.low is not None and series.high is not None:
            axes.vlines(series.x, series.low, series.high, color=colour, linewidth=1.3)


def _bars(axes: Axes, all_series: Sequence[Series]) -> None:
    """Bars side by side around their common centres, with an error bar where there are limits."""
    centres = np.unique(np.concatenate([series.x for series in all_series])) if all_series else np.empty(0)
    room = 0.86 * float(np.min(np.diff(centres))) if centres.size > 1 else 0.86
    width = room / max(len(all_series), 1)
    for i, series in enumerate(all_series):
        x = series.x + (i + 0.5) * width - 0.5 * room
        axes.bar(x, series.y, width, color=_COLOURS[i % len(_COLOURS)], label=series.label, linewidth=0)
        if series.low is not None and series.high is not None:
            axes.vlines(x, series.low, series.high, color="#333a41", linewidth=1.2)
    if 1 < centres.size <= 12 and np.allclose(centres, np.round(centres)):
        axes.set_xticks(centres)
    axes.grid(visible=False, axis="x")


def _plain_ticks(axes: Axes) -> None:
    """Numbers such as 20 and 0.5 instead of powers of ten, between them only where there is room."""
    low, high = axes.get_ylim()
    crowded = high > 30.0 * low
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    axes.yaxis.set_minor_formatter(
        FuncFormatter(lambda y, _: "" if crowded or f"{y:.0e}"[0] not in "235" else f"{y:g}")
    )


def _same_scale(axes: Axes, figure: Figure) -> bool:
    """Whether both axes are lengths in one unit and of one size, such as north against east error."""
    units = [label[label.rfind("[") :] for label in (figure.x_label, figure.y_label) if "[" in label]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    return len(units) == 2 and units[0] == units[1] and 1 / 3 < (right - left) / (high - low) < 3


def _legend(drawing: Drawing, axes: Axes) -> None:
    """The labels above the picture, where they hide nothing, in as many columns as fit."""
    handles, labels = axes.get_legend_handles_labels()
    longest = max(map(len, labels))
    columns = max(1, min(len(labels), 118 // (longest + 7)))
    legend = drawing.legend(handles, labels, loc="outside upper left", ncols=columns, fontsize=9.5)
    for handle in legend.legend_handles:
        if isinstance(handle, Line2D):
            handle.set(alpha=1.0, markersize=6.0)

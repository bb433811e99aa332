"""The pictures of a run against time and in error space; each function returns a matplotlib Figure."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from terranav.app.ahead_figure import terrain_ahead
from terranav.app.outcome import BASELINE, ELLIPSE_95, Outcome
from terranav.app.style import (
    BOUND,
    BOUND_DASHES,
    INS,
    MAIN,
    TRUTH,
    USABLE,
    WITHHELD,
    colours,
    new_figure,
    status_ribbon,
    styled,
    time_axis,
)
from terranav.app.trackmap import track_map
from terranav.core.records import Posterior
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]


def error_history(outcome: Outcome) -> Figure:
    """Distance from the truth against time for every estimator, the main one's claim, and every status."""
    with styled():
        ribbon = _ribbon(outcome)
        figure = new_figure(4.6 + 0.3 * len(ribbon))
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[4.2, 0.3 * len(ribbon) + 0.12])
        time, label = time_axis(outcome.recording.time_s, float(outcome.recording.time_s[0]))
        shades = colours(outcome)
        floor = _errors(top, outcome, time, shades)
        top.set_ylabel("distance from the truth" if outcome.recording.has_truth else "claimed error")
        top.set_yscale("log")
        top.set_ylim(bottom=floor)
        top.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g} m" if y < 1000 else f"{y / 1000:g} km"))
        top.yaxis.set_minor_formatter(FuncFormatter(lambda y, _: ""))
        top.legend(loc="upper left", ncols=5, fontsize=9.5, frameon=True, framealpha=0.85, edgecolor="none")
        status_ribbon(bottom, time, ribbon)
        bottom.set_xlabel(label)
        bottom.set_xlim(*_span(outcome))
    return figure


def north_east(outcome: Outcome) -> Figure:
    """North and east error of the main estimator inside the 2-sigma band that it claims."""
    with styled():
        result = outcome.results[outcome.main]
        figure = new_figure(4.4)
        time, label = time_axis(result.time_s, float(result.time_s[0]))
        panels = figure.subplots(2, 1, sharex=True)
        after = result.time_s - result.time_s[0] >= outcome.first_fix_s(outcome.main)
        after = after if after.any() else np.ones_like(after)
        for axis, (axes, name) in enumerate(zip(panels, ("north", "east"), strict=True)):
            error, band = result.error_m[:, axis], 2.0 * np.sqrt(result.cov_m2[:, axis, axis])
            axes.fill_between(time, -band, band, color=MAIN, alpha=0.16, linewidth=0, label="claimed ±2σ")
            if outcome.bound is not None:
                least = 2.0 * outcome.bound.sigma_m[:, axis]
                axes.plot(time, least, color=BOUND, linewidth=1, linestyle=BOUND_DASHES, label="bound ±2σ")
                axes.plot(time, -least, color=BOUND, linewidth=1, linestyle=BOUND_DASHES)
            axes.axhline(0.0, color="#8a9199", linewidth=0.8)
            axes.plot(time, error, color=MAIN, linewidth=1.3, label=f"{name} error of {outcome.main}")
            reach = 1.25 * float(np.nanmax(np.abs(np.concatenate([error[after], band[after]]))))
            axes.set_ylim(-reach, reach)
            axes.set_ylabel(f"{name} [m]")
        panels[0].legend(loc="upper right", ncols=3, fontsize=9.5, frameon=True, framealpha=0.85, edgecolor="none")
        panels[1].set_xlabel(label)
        panels[1].set_xlim(*_span(outcome))
    return figure


def profiles(outcome: Outcome) -> Figure | None:
    """What was measured against what the maps say along the corrected track; None without readings to compare."""
    charts = [(chart, *outcome.readings_of(chart.kind)) for chart in outcome.maps]
    charts = [(chart, time_s, value) for chart, time_s, value in charts if time_s.size]
    if not charts:
        return None
    with styled():
        figure = new_figure(4.8 * len(charts))
        panels = figure.subplots(2 * len(charts), 1, sharex=True, height_ratios=[3, 1.2] * len(charts), squeeze=False)
        for row, (chart, time_s, value) in enumerate(charts):
            upper, lower = panels[2 * row, 0], panels[2 * row + 1, 0]
            label = _profile((upper, lower), outcome, chart, time_s, value)
            upper.set_ylabel(f"{chart.kind} [{chart.unit}]")
            lower.set_ylabel(f"measured\n− map [{chart.unit}]")
        panels[-1, 0].set_xlabel(label)
        panels[-1, 0].set_xlim(*_span(outcome))
        handles, labels = panels[0, 0].get_legend_handles_labels()
        panels[0, 0].legend(
            handles, labels, loc="lower left", bbox_to_anchor=(0, 1), ncols=4, fontsize=9.5, borderpad=0.2
        )
    return figure


def posterior(outcome: Outcome) -> Figure | None:
    """What the main estimator believed of the INS error at the end; None when it has nothing to draw."""
    result = outcome.results[outcome.main]
    if result.posterior is None:
        return None
    with styled():
        figure = new_figure(5.6, 6.6)
        axes = figure.subplots()
        _density(axes, result.posterior)
        mean = result.ins_error_m[-1]
        _ellipse(axes, mean, result.cov_m2[-1])
        axes.plot(
            mean[1], mean[0], "o", color=MAIN, markeredgecolor="white", markersize=8, label=f"{outcome.main} says"
        )
        truth = mean + result.error_m[-1]  # (indicated - true) = (indicated - estimated) + (estimated - true)
        if np.isfinite(truth).all():
            axes.plot(truth[1], truth[0], "P", color=TRUTH, markeredgecolor="white", markersize=11, label="the truth")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(visible=False)
        axes.set(xlabel="INS error east [m]", ylabel="INS error north [m]")
        figure.legend(loc="outside lower center", ncols=3, fontsize=9.5)
    return figure


def _span(outcome: Outcome) -> tuple[float, float]:
    """Limits of the time axis."""
    time, _ = time_axis(outcome.recording.time_s, float(outcome.recording.time_s[0]))
    return float(time[0]), float(time[-1]) if time.size > 1 else float(time[0]) + 1.0


def _ribbon(outcome: Outcome) -> list[tuple[str, NDArray[np.str_]]]:
    """The statuses of every estimator, and below the main one's, where it is watched, whether a fix was offered."""
    rows: list[tuple[str, NDArray[np.str_]]] = []
    for name, result in outcome.results.items():
        if name != BASELINE:
            rows.append((name, result.status))
        if name == outcome.main and result.watched:
            rows.append(("its fix", np.where(result.usable, USABLE, WITHHELD)))
    return rows


def _errors(axes: Axes, outcome: Outcome, time: FloatArray, shades: dict[str, str]) -> float:
    """Draw the errors (or, without truth, the claims alone); return where the log axis should start."""
    rec, main = outcome.recording, outcome.results[outcome.main]
    claim = 2.0 * np.sqrt(np.trace(main.cov_m2, axis1=1, axis2=2))
    lowest = [np.percentile(claim, 2)]
    if main.watched:
        axes.plot(time, main.protection_m, color=MAIN, linewidth=1.2, linestyle=(0, (4, 1.5)), label="protection level")
    axes.fill_between(time, 1e-3, claim, color=MAIN, alpha=0.14, linewidth=0, label=f"2σ claimed by {outcome.main}")
    if BASELINE in outcome.results and outcome.main != BASELINE:
        base = 2.0 * np.sqrt(np.trace(outcome.results[BASELINE].cov_m2, axis1=1, axis2=2))
        axes.plot(time, base, color=INS, linewidth=1, linestyle=":", label="2σ of the INS")
    if rec.has_truth:
        axes.plot(time, outcome.ins_distance_m, color=INS, linewidth=1.8, linestyle=(0, (5, 2)), label="INS alone")
        for name in sorted(outcome.results, key=lambda entry: entry == outcome.main):
            if name != BASELINE:
                error = np.hypot(*outcome.results[name].error_m.T)
                width, order = (1.9, 4) if name == outcome.main else (1.2, 3)
                axes.plot(time, error, color=shades[name], linewidth=width, zorder=order, label=name)
                lowest.append(np.nanpercentile(error, 5))
    if outcome.bound is not None:
        least = outcome.bound.drms_m
        axes.plot(time, least, color=BOUND, linewidth=1.4, linestyle=BOUND_DASHES, zorder=5, label="Cramér-Rao bound")
        lowest.append(np.percentile(least, 5))
    return 0.7 * max(float(np.nanmin(lowest)), 0.5)


def _profile(panels: tuple[Axes, Axes], outcome: Outcome, chart: Map, time_s: FloatArray, value: FloatArray) -> str:
    """Draw one kind's readings and the map below three tracks; return the label of the time axis."""
    upper, lower = panels
    rec, result = outcome.recording, outcome.results[outcome.main]
    time, label = time_axis(rec.time_s, float(rec.time_s[0]))
    read = np.searchsorted(rec.time_s, time_s)
    along = chart.sample(result.lat_deg, result.lon_deg)
    below_ins = chart.sample(rec.lat_deg, rec.lon_deg)
    upper.plot(time, below_ins, color=INS, linewidth=1.2, alpha=0.75, label="map at the INS position")
    if rec.has_truth:
        true = chart.sample(rec.columns["true_lat_deg"], rec.columns["true_lon_deg"])
        upper.plot(time, true, color=TRUTH, linewidth=3.0, alpha=0.25, label="map at the true position")
    upper.plot(time, along, color=MAIN, linewidth=1.5, label=f"map where {outcome.main} is")
    size = 3.5 if read.size < 400 else 1.4
    upper.plot(time[read], value, "o", color=TRUTH, markersize=size, markeredgewidth=0, label="measured", zorder=4)
    limit = _limits(np.concatenate([value, along]))
    upper.set_ylim(*limit)
    lower.axhline(0.0, color="#8a9199", linewidth=0.8)
    lower.plot(time[read], value - below_ins[read], ".", color=INS, markersize=size, alpha=0.45)
    lower.plot(time[read], value - along[read], "o", color=MAIN, markersize=size, markeredgewidth=0)
    lower.set_ylim(*_limits((value - along[read])[read >= read.size // 10], 3.0))
    return label


def _limits(values: FloatArray, widen: float = 1.25) -> tuple[float, float]:
    """Axis limits that a few outliers do not blow up."""
    known = values[np.isfinite(values)]
    if not known.size:
        return -1.0, 1.0
    low, high = np.percentile(known, [0.5, 99.5])
    middle, half = 0.5 * (low + high), max(0.5 * widen * (high - low), 1e-6)
    return float(middle - half), float(middle + half)


def _density(axes: Axes, belief: Posterior) -> None:
    """Draw a posterior: a grid as shades, particles as dots, nothing of what has no weight."""
    if belief.weight.ndim == 2:
        used = belief.weight > 1e-4 * belief.weight.max()
        rows, cols = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
        box = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        axes.set_facecolor(colormaps["Blues"](0.0))
        axes.pcolormesh(
            belief.east_m[box[1]],
            belief.north_m[box[0]],
            belief.weight[box],
            cmap="Blues",
            shading="nearest",
            rasterized=True,
        )
        return
    strength = belief.weight / belief.weight.max()
    axes.scatter(belief.east_m, belief.north_m, s=4 + 10 * strength, c=MAIN, alpha=0.25, linewidths=0)


def _ellipse(axes: Axes, mean_m: FloatArray, cov_m2: FloatArray) -> None:
    """Draw the claimed 95 % ellipse of an error (north, east)."""
    variances, directions = np.linalg.eigh(cov_m2)
    width, height = 2.0 * ELLIPSE_95 * np.sqrt(variances)
    north, east = directions[:, 0]
    angle = float(np.degrees(np.arctan2(north, east)))
    axes.add_patch(
        Ellipse(
            (mean_m[1], mean_m[0]),
            width,
            height,
            angle=angle,
            fill=False,
            color=MAIN,
            linewidth=1.6,
            label="95 % ellipse",
        )
    )


#: file stem of each picture and the function that draws it, in the order of the report
FIGURES: dict[str, Callable[[Outcome], Figure | None]] = {
    "track": track_map,
    "error": error_history,
    "profile": profiles,
    "north_east": north_east,
    "posterior": posterior,
    "ahead": terrain_ahead,
}

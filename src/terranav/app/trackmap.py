"""The picture of where it went: the tracks over the shaded map, north up, whatever the map's own projection."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LightSource, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from terranav.app.mapping import meridian, parallel
from terranav.app.outcome import BASELINE, Outcome
from terranav.app.style import INS, TRUTH, colours, new_figure, nice_length, styled
from terranav.app.words import distance
from terranav.core.earth import metres_per_degree
from terranav.core.records import Status

if TYPE_CHECKING:
    from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
Frame = tuple[float, float, float, float]  # south, west, north, east [deg]

_LAND = ["#dfe6d3", "#e9ecd8", "#efe8d2", "#e6d8bd", "#dccbb3", "#f2ede6"]
_SEA = ["#9fbcd0", "#b4cddc", "#c9dde7", "#dfebf0"]
_FIELD = ["#a9c3dc", "#dfe7ee", "#f4f2ee", "#f0dccf", "#dfa98f"]
_COLOURS = {"terrain": _LAND, "bathymetry": _SEA}
_LONG_SIDE = 640  # samples of the background along its longer side
HALO = [patheffects.withStroke(linewidth=4.0, foreground="white", alpha=0.85)]


def track_map(outcome: Outcome) -> Figure:
    """Shaded map with the true track, the INS's, and every estimator's."""
    with styled():
        frame = _frame(outcome)
        south, west, north, east = frame
        wide = _aspect(frame)
        height = float(np.clip(8.9 / wide, 3.4, 7.2)) + 0.75
        figure = new_figure(height)
        axes = figure.subplots()
        if outcome.maps:
            shade(axes, outcome.maps[0], frame)
        axes.set(xlim=(west, east), ylim=(south, north))
        _tracks(axes, outcome)
        dress(axes, frame, bar_left=not _in_corner(outcome, frame))
        figure.legend(loc="outside lower center", ncols=4, fontsize=10)
    return figure


def shade(axes: Axes, chart: Map, frame: Frame) -> None:
    """Draw a map inside a frame as a coloured relief; where it says nothing stays hatched."""
    south, west, north, east = frame
    wide = _aspect(frame)
    cols = max(int(_LONG_SIDE * min(1.0, wide)), 2)
    rows = max(int(_LONG_SIDE * min(1.0, 1.0 / wide)), 2)
    lat = north - (np.arange(rows) + 0.5) * (north - south) / rows
    lon = west + (np.arange(cols) + 0.5) * (east - west) / cols
    values = chart.sample(lat[:, None], lon[None, :])
    known = np.isfinite(values)
    axes.set_facecolor("#f1f1f1")
    axes.patch.set(hatch="///", edgecolor="#d5d5d5")
    if not known.any():
        return
    per_lat, per_lon = metres_per_degree(0.5 * (south + north))
    dy, dx = (north - south) / rows * float(per_lat), (east - west) / cols * float(per_lon)
    filled = np.where(known, values, np.median(values[known]))
    light = hillshade(filled, dx, dy)
    low, high = np.percentile(values[known], [1, 99])
    scaled = np.clip((filled - low) / max(high - low, 1e-9), 0, 1)
    picture = np.empty((rows, cols, 4))
    picture[..., :3] = _ramp(chart.kind)(scaled)[..., :3] * (0.45 + 0.55 * light)[..., None]
    picture[..., 3] = known
    axes.imshow(picture, extent=(west, east, south, north), origin="upper", aspect="auto", interpolation="bilinear")


def dress(axes: Axes, frame: Frame, *, bar_left: bool = True) -> None:
    """North-up axes in degrees with the right proportions, and a scale bar at the lower left or right."""
    south, west, north, east = frame
    per_lat, per_lon = (float(value) for value in metres_per_degree(0.5 * (south + north)))
    axes.set_aspect(per_lat / per_lon)
    axes.grid(visible=False)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: meridian(x, _digits(east - west))))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: parallel(y, _digits(north - south))))
    axes.tick_params(labelsize=9)
    for spine in axes.spines.values():
        spine.set_visible(True)
    scale_bar(axes, frame, per_lon, at_left=bar_left)
    axes.annotate(
        "N",
        (0.972, 0.965),
        (0.972, 0.875),
        xycoords="axes fraction",
        ha="center",
        va="center",
        fontweight="bold",
        arrowprops={"arrowstyle": "-|>", "color": "#222222", "linewidth": 1.6},
        path_effects=HALO,
        zorder=9,
    )


def scale_bar(axes: Axes, frame: Frame, per_unit: float, *, at_left: bool = True) -> None:
    """A bar of a round length at the lower left or right; `per_unit` is the metres in a unit of the axis across."""
    south, west, north, east = frame
    length = nice_length((east - west) * per_unit / 4)
    x0, y0 = west + 0.03 * (east - west), south + 0.035 * (north - south)
    if not at_left:
        x0 = east - 0.03 * (east - west) - length / per_unit
    x1 = x0 + length / per_unit
    axes.plot([x0, x1], [y0, y0], color="#222222", linewidth=3.5, path_effects=HALO, solid_capstyle="butt", zorder=9)
    text = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    axes.annotate(
        text, (0.5 * (x0 + x1), y0), (0, 5), textcoords="offset points", ha="center", path_effects=HALO, zorder=9
    )


def _digits(width_deg: float) -> int:
    """Decimals that tell six ticks apart."""
    return max(0, math.ceil(-math.log10(width_deg / 6)))


def _tracks(axes: Axes, outcome: Outcome) -> None:
    """The lines, from the least important to the most."""
    rec, shades = outcome.recording, colours(outcome)
    if rec.has_truth:
        lat, lon = rec.columns["true_lat_deg"], rec.columns["true_lon_deg"]
        axes.plot(lon, lat, color=TRUTH, linewidth=4.0, path_effects=HALO, zorder=4, label="true track")
    dashes = (0, (5, 2))
    axes.plot(
        rec.lon_deg, rec.lat_deg, color=INS, linewidth=1.8, linestyle=dashes, path_effects=HALO, label="INS alone"
    )
    names = [name for name in outcome.results if name not in (BASELINE, outcome.main)] + [outcome.main]
    for name in names:
        if name == BASELINE:
            continue
        result, is_main = outcome.results[name], name == outcome.main
        fixed = np.isin(result.status, (Status.CONVERGED.value, Status.DEGRADED.value))
        lon = np.where(fixed, result.lon_deg, np.nan)
        width, order = (1.9, 6) if is_main else (1.2, 5)
        axes.plot(
            lon,
            result.lat_deg,
            color=shades[name],
            linewidth=width,
            zorder=order,
            label=name,
            marker="o" if fixed.size < 250 else "",
            markersize=2.5 * width / 1.9,
        )
    _ends(axes, outcome)


def _ends(axes: Axes, outcome: Outcome) -> None:
    """Mark the start, and how far the INS is off at the end."""
    rec = outcome.recording
    lat, lon = rec.lat_deg, rec.lon_deg
    if rec.has_truth:
        lat, lon = rec.columns["true_lat_deg"], rec.columns["true_lon_deg"]
    axes.plot(lon[0], lat[0], "o", color="white", markeredgecolor=TRUTH, markeredgewidth=2, markersize=8, zorder=8)
    axes.annotate(
        "start", (lon[0], lat[0]), (8, 8), textcoords="offset points", fontsize=9.5, path_effects=HALO, zorder=8
    )
    off = outcome.final_ins_error_m
    if np.isfinite(off):
        axes.plot([lon[-1], rec.lon_deg[-1]], [lat[-1], rec.lat_deg[-1]], color=INS, linewidth=1, zorder=7)
        axes.plot(rec.lon_deg[-1], rec.lat_deg[-1], "X", color=INS, markeredgecolor="white", markersize=10, zorder=8)
        axes.plot(lon[-1], lat[-1], "s", color=TRUTH, markeredgecolor="white", markersize=8, zorder=8)
        west, east = axes.get_xlim()
        to_left = rec.lon_deg[-1] > 0.35 * west + 0.65 * east
        axes.annotate(
            f"INS ends {distance(off)} off",
            (rec.lon_deg[-1], rec.lat_deg[-1]),
            (-10 if to_left else 10, 14 if rec.lat_deg[-1] >= lat[-1] else -22),
            textcoords="offset points",
            horizontalalignment="right" if to_left else "left",
            color=INS,
            fontweight="bold",
            fontsize=9.5,
            path_effects=HALO,
            zorder=8,
        )


def _in_corner(outcome: Outcome, frame: Frame) -> bool:
    """Whether a track passes where the scale bar would stand at the lower left."""
    south, west, north, east = frame
    columns = outcome.recording.columns
    found = False
    for prefix in ("", "true_") if outcome.recording.has_truth else ("",):
        lat, lon = columns[f"{prefix}lat_deg"], columns[f"{prefix}lon_deg"]
        low, left = lat < south + 0.16 * (north - south), lon < west + 0.34 * (east - west)
        found = found or bool((low & left).any())
    return found


def _frame(outcome: Outcome) -> Frame:
    """South, west, north, east of everything that matters, with a margin; a runaway INS does not blow it up."""
    rec = outcome.recording
    prefix = "true_" if rec.has_truth else ""
    lat, lon = rec.columns[f"{prefix}lat_deg"], rec.columns[f"{prefix}lon_deg"]
    lat, lon = lat[np.isfinite(lat)], lon[np.isfinite(lon)]
    per_lat, per_lon = (float(value) for value in metres_per_degree(float(np.mean(lat))))
    size_m = max(np.ptp(lat) * per_lat, np.ptp(lon) * per_lon, 1000.0)
    reach = 0.6 * size_m
    low = np.array([lat.min(), lon.min()]) - reach / np.array([per_lat, per_lon])
    high = np.array([lat.max(), lon.max()]) + reach / np.array([per_lat, per_lon])
    points = np.stack([rec.lat_deg, rec.lon_deg], axis=1)
    inside = np.clip(points, low, high)
    south, west = np.minimum(inside.min(axis=0), [lat.min(), lon.min()]) - 0.06 * size_m / np.array([per_lat, per_lon])
    north, east = np.maximum(inside.max(axis=0), [lat.max(), lon.max()]) + 0.06 * size_m / np.array([per_lat, per_lon])
    return _at_least((float(south), float(west), float(north), float(east)), per_lat, per_lon)


def _at_least(frame: Frame, per_lat: float, per_lon: float) -> Frame:
    """Widen a frame that is very flat or very tall, so that the map around the track can be seen."""
    south, west, north, east = frame
    height, width = (north - south) * per_lat, (east - west) * per_lon
    more_lat = max(0.45 * width - height, 0.0) / 2 / per_lat
    more_lon = max(0.9 * height - width, 0.0) / 2 / per_lon
    return south - more_lat, west - more_lon, north + more_lat, east + more_lon


def _aspect(frame: Frame) -> float:
    """Width over height on the ground."""
    south, west, north, east = frame
    per_lat, per_lon = metres_per_degree(0.5 * (south + north))
    return float((east - west) * per_lon / ((north - south) * per_lat))


def hillshade(values: FloatArray, dx: float, dy: float) -> FloatArray:
    """Light in 0..1 from the north-west, exaggerated by the overall roughness, so that any shows.

    The measure is the mean slope: a root mean square is that of the steepest part, and leaves lowlands beside mountains
    and shelves beside a continental slope without relief; but of a mostly level picture it takes a fifth of that.
    """
    slope = np.hypot(*np.gradient(values, dy, dx))
    rough = max(float(np.mean(slope)), 0.2 * float(np.sqrt(np.mean(slope**2))))
    exaggeration = 0.3 / rough if rough > 0 else 1.0
    light: FloatArray = LightSource(315, 45).hillshade(values, vert_exag=exaggeration, dx=dx, dy=dy)
    return light


def _ramp(kind: str) -> Colormap:
    """Pale colours, so that the tracks stand out."""
    return LinearSegmentedColormap.from_list(kind, _COLOURS.get(kind, _FIELD))

"""The picture of where terrain-aided navigation works: the expected 1-sigma over the shaded map, and where to fly."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import patheffects
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from terranav.app.style import new_figure, styled
from terranav.app.trackmap import dress, shade
from terranav.app.words import distance, percent
from terranav.core.earth import metres_per_degree

if TYPE_CHECKING:
    from terranav.maps.map import Map
    from terranav.planning.suitability import Suitability

FloatArray = NDArray[np.float64]

GOOD, FAIR, POOR, BAD = "#1f6f8b", "#7fc4b8", "#f3c14b", "#c4472f"
ARROWS = 16  # along the longer side
MATTERS = 1.25  # worst over best heading from which on it matters which way to fly
_HALO: list[patheffects.AbstractPathEffect] = [patheffects.withStroke(linewidth=2.6, foreground="white", alpha=0.9)]


def suitability_map(found: Suitability, chart: Map, limit_m: float) -> Figure:
    """Two panels over the relief: the worst heading against the limit, and the best one with arrows where it matters.

    Parameters
    ----------
    found : Suitability
    chart : Map
        The one that it was made of.
    limit_m : float
        Largest 1-sigma that counts as a fix [m].
    """
    frame = _frame(found)
    south, west, north, east = frame
    per_lat, per_lon = (float(value) for value in metres_per_degree(0.5 * (south + north)))
    wide = (east - west) * per_lon / ((north - south) * per_lat)
    with styled():
        figure = new_figure(float(np.clip(5.4 / wide, 3.0, 9.0)) + 1.9, 11.5)
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        share = found.share_within(limit_m)
        figure.suptitle(_words(found, chart), x=0.01, ha="left", fontsize=11.5, linespacing=1.4)
        for axes, grid, text in (
            (left, found.worst_m, f"Any heading: within {limit_m:g} m over {percent(share['worst'])} of the map"),
            (right, found.best_m, f"Best heading: within {limit_m:g} m over {percent(share['best'])} of the map"),
        ):
            shade(axes, chart, frame)
            _overlay(axes, grid, frame, limit_m)
            axes.set_title(text)
            dress(axes, frame)
        _arrows(right, found, limit_m, per_lat / per_lon)
        _key(figure, found, chart, limit_m)
    return figure


def _words(found: Suitability, chart: Map) -> str:
    """What the picture shows, under which assumptions, and what to doubt."""
    settings, ins = found.settings, found.ins
    verb = "that ends there" if settings.anchor == "end" else "that starts there"
    return (
        f"Expected position 1-sigma after a straight {settings.distance_m / 1000:g} km leg {verb}\n"
        f"at {settings.speed_mps:g} m/s, sensor {settings.sensor_sigma:g} {chart.unit} 1-sigma "
        f"at {settings.rate_hz:g} Hz, "
        f"{ins.name or 'given'} INS off by {distance(ins.position_sigma_m)} at the start. "
        f"Beyond {distance(found.trusted_m)} expect more than told."
    )


def _frame(found: Suitability) -> tuple[float, float, float, float]:
    """South, west, north, east of the blocks' outer edges [deg]."""
    half_lat = 0.5 * abs(float(found.lat_deg[0] - found.lat_deg[1]))
    half_lon = 0.5 * abs(float(found.lon_deg[1] - found.lon_deg[0]))
    return (
        float(found.lat_deg[-1]) - half_lat,
        float(found.lon_deg[0]) - half_lon,
        float(found.lat_deg[0]) + half_lat,
        float(found.lon_deg[-1]) + half_lon,
    )


def _overlay(axes: Axes, grid: FloatArray, frame: tuple[float, float, float, float], limit_m: float) -> None:
    """Four colours by how the 1-sigma compares with the limit; nothing where the map holds no leg."""
    south, west, north, east = frame
    norm = BoundaryNorm([0.0, 0.5 * limit_m, limit_m, 2.0 * limit_m, np.inf], 4)
    axes.imshow(
        np.ma.masked_invalid(grid),
        extent=(west, east, south, north),
        origin="upper",
        aspect="auto",
        interpolation="nearest",
        cmap=ListedColormap([GOOD, FAIR, POOR, BAD]),
        norm=norm,
        alpha=0.55,
    )


def _arrows(axes: Axes, found: Suitability, limit_m: float, stretch: float) -> None:
    """For each square of some blocks the heading that is best over it, an arrow where it stays within the limit.

    Where the worst heading is nearly as good, a dot.
    """
    lat, lon, best, worst, heading = _squares(found)
    across, up = (lon - found.lon_deg[0]) / np.ptp(found.lon_deg), (lat - found.lat_deg[-1]) / np.ptp(found.lat_deg)
    shown = best <= limit_m
    shown &= ~((across > 0.9) & (up > 0.83)) & ~((across < 0.22) & (up < 0.09))  # where north and the scale stand
    matters = worst > MATTERS * best
    dots = shown & ~matters
    axes.scatter(lon[dots], lat[dots], s=11, color="#1a1a1a", edgecolors="white", linewidths=0.9, zorder=6)
    turned = shown & matters
    sides = (np.ptp(found.lat_deg) / (ARROWS + 1), np.ptp(found.lon_deg) / stretch / (ARROWS + 1))
    length, angle = 0.62 * max(sides), np.radians(heading[turned])
    arrows = axes.quiver(
        lon[turned],
        lat[turned],
        length * np.sin(angle) * stretch,
        length * np.cos(angle),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        pivot="middle",
        width=0.0045,
        headwidth=4.5,
        color="#1a1a1a",
        zorder=6,
    )
    arrows.set_path_effects(_HALO)


def _squares(found: Suitability) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Middle, median 1-sigma of the best and of the worst heading, and the best heading, of squares of blocks."""
    longer = max(found.best_m.shape)
    rows, cols = (np.array_split(np.arange(n), max(1, round(ARROWS * n / longer))) for n in found.best_m.shape)
    told = []
    for row in rows:
        for col in cols:
            part = found.sigma_m[:, row[0] : row[-1] + 1, col[0] : col[-1] + 1].reshape(found.headings_deg.size, -1)
            whole = np.isfinite(part).mean(axis=1) > 0.5  # a heading that half of the square allows
            if whole.any():
                middle = np.array([np.median(legs[np.isfinite(legs)]) for legs in part[whole]])
                place = found.lat_deg[row].mean(), found.lon_deg[col].mean()
                told.append((*place, middle.min(), middle.max(), found.headings_deg[whole][middle.argmin()]))
    lat, lon, best, worst, heading = np.array(told, dtype=np.float64).reshape(-1, 5).T
    return lat, lon, best, worst, heading


def _has_voids(found: Suitability, chart: Map) -> bool:
    """Whether the map says nothing in the middle of some block."""
    return bool(np.isnan(chart.sample(found.lat_deg[:, None], found.lon_deg[None, :])).any())


def _key(figure: Figure, found: Suitability, chart: Map, limit_m: float) -> None:
    """What the colours and signs mean; only what there is."""
    half, double = distance(0.5 * limit_m), distance(2.0 * limit_m)
    entries = (
        (GOOD, f"works well: below {half}"),
        (FAIR, f"works: {half} to {distance(limit_m)}"),
        (POOR, f"poor: {distance(limit_m)} to {double}"),
        (BAD, f"does not work: above {double}"),
    )
    handles: list[Artist] = [Patch(facecolor=colour, alpha=0.75, label=text) for colour, text in entries]
    sign: dict[str, Any] = {"color": "#1a1a1a", "linestyle": "", "markersize": 11}
    handles.append(Line2D([], [], marker=r"$\rightarrow$", label="fly this way: the best heading around", **sign))
    handles.append(Line2D([], [], marker=".", label="any heading is nearly as good", **{**sign, "markersize": 8}))
    if _has_voids(found, chart):
        handles.append(Patch(facecolor="#f1f1f1", edgecolor="#c5c5c5", hatch="///", label="void: the map says nothing"))
    if np.isnan(found.best_m).any():
        handles.append(Patch(facecolor="#e6d8bd", label="relief alone: the map holds no whole leg"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=9.5)

"""The picture of where terrain-aided navigation works: the expected 1-sigma over the shaded map, the best heading."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
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
_HALO: list[patheffects.AbstractPathEffect] = [patheffects.withStroke(linewidth=2.6, foreground="white", alpha=0.9)]


def suitability_map(found: Suitability, chart: Map, limit_m: float) -> Figure:
    """Two panels over the relief: the worst heading against the limit, and the best heading with its arrow.

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
        share, settings = found.share_within(limit_m), found.settings
        verb = "ending" if settings.anchor == "end" else "starting"
        figure.suptitle(
            f"Expected position 1-sigma after a straight {settings.distance_m / 1000:g} km leg {verb} there",
            x=0.01, ha="left", fontsize=13,
        )  # fmt: skip
        for axes, grid, title in (
            (left, found.worst_m, f"worst heading: within {limit_m:g} m over {percent(share['worst'])}"),
            (right, found.best_m, f"best heading (arrow): within {limit_m:g} m over {percent(share['best'])}"),
        ):
            shade(axes, chart, frame)
            _overlay(axes, grid, frame, limit_m)
            axes.set_title(title)
            dress(axes, frame)
        _arrows(right, found, limit_m, per_lat / per_lon)
        _key(figure, limit_m)
    return figure


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
    """The best heading of one block in so many, where it stays within the limit."""
    every = max(1, round(max(found.best_m.shape) / ARROWS))
    rows, cols = (np.arange(every // 2, size, every) for size in found.best_m.shape)
    heading, sigma = found.best_heading_deg[np.ix_(rows, cols)], found.best_m[np.ix_(rows, cols)]
    shown = np.isfinite(heading) & (sigma <= limit_m)
    lon, lat = np.meshgrid(found.lon_deg[cols], found.lat_deg[rows])
    across, up = np.meshgrid(cols / found.lon_deg.size, 1.0 - rows / found.lat_deg.size)
    shown &= ~((across > 0.9) & (up > 0.83)) & ~((across < 0.22) & (up < 0.09))  # where north and the scale stand
    length = 0.62 * every * abs(float(found.lat_deg[0] - found.lat_deg[1]))
    angle = np.radians(heading[shown])
    arrows = axes.quiver(
        lon[shown],
        lat[shown],
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


def _key(figure: Figure, limit_m: float) -> None:
    """What the colours mean."""
    half, double = distance(0.5 * limit_m), distance(2.0 * limit_m)
    entries = (
        (GOOD, f"works well: below {half}"),
        (FAIR, f"works: {half} to {distance(limit_m)}"),
        (POOR, f"poor: {distance(limit_m)} to {double}"),
        (BAD, f"does not work: above {double}"),
    )
    handles = [Patch(facecolor=colour, alpha=0.75, label=text) for colour, text in entries]
    handles.append(Patch(facecolor="#f1f1f1", edgecolor="#c5c5c5", hatch="///", label="void"))
    handles.append(Patch(facecolor="#e6d8bd", label="plain: no heading with a whole leg"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=9.5)

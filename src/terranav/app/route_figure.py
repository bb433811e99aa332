"""The picture of a route: over the shaded map in the colours of its 1-sigma, the straight line beside it; heights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from terranav.app.style import INS, MAIN, new_figure, styled
from terranav.app.trackmap import dress, shade
from terranav.app.words import distance
from terranav.core.earth import metres_per_degree

if TYPE_CHECKING:
    from terranav.maps.map import Map
    from terranav.planning._route_judge import Line
    from terranav.planning.route import Route

FloatArray = NDArray[np.float64]
Area = tuple[str, Sequence[FloatArray]]
Frame = tuple[float, float, float, float]  # south, west, north, east [deg]

_GOOD_TO_BAD = LinearSegmentedColormap.from_list("sigma", ["#1f6f8b", "#3fae8f", "#f3c14b", "#d1495b", "#7d1d3f"])
_HALO: list[patheffects.AbstractPathEffect] = [patheffects.withStroke(linewidth=6.0, foreground="white", alpha=0.95)]
_TEXT: list[patheffects.AbstractPathEffect] = [patheffects.withStroke(linewidth=3.0, foreground="white", alpha=0.9)]
_KEEP_OUT, _STRAIGHT = "#8e44ad", "#30363c"


def route_picture(route: Route, chart: Map, keep_out: Sequence[Area] = ()) -> Figure:
    """Map, 1-sigma along the way, and the height profile where there is one.

    Parameters
    ----------
    route : Route
    chart : Map
    keep_out : sequence of (name, rings)
    """
    frame = _frame(route)
    south, west, north, east = frame
    per_lat, per_lon = (float(value) for value in metres_per_degree(0.5 * (south + north)))
    wide = (east - west) * per_lon / ((north - south) * per_lat)
    high = bool(np.isfinite(route.line.altitude_m).all())
    map_in = float(np.clip(8.6 / wide, 3.4, 7.6))
    with styled():
        figure = new_figure(map_in + (4.2 if high else 2.6))
        panels = figure.subplots(3 if high else 2, 1, height_ratios=[map_in, 2.0, *([1.5] if high else [])])
        scale = Normalize(0.0, _top_of_scale(route))
        shade(panels[0], chart, frame)
        _lines(panels[0], route, scale, 0.5 * (west + east))
        _areas(panels[0], keep_out, 0.5 * (west + east))
        panels[0].set(xlim=(west, east), ylim=(south, north))
        dress(panels[0], frame)
        figure.suptitle(_title(route), x=0.01, ha="left", fontsize=11.5)
        _sigmas(panels[1], route, scale)
        if high:
            panels[1].set_xlabel("")
            _heights(panels[2], route.line)
    return figure


def _title(route: Route) -> str:
    told = f"Route of {distance(route.line.length_m)}: 1-sigma at most {distance(route.line.top_m)}"
    straight = f"straight line of {distance(route.straight.length_m)}: {distance(route.straight.top_m)}"
    return f"{told}\n{straight}" + (" (it cannot be flown)" if route.straight.barred else "")


def _top_of_scale(route: Route) -> float:
    """Where the colours end: what is above belongs to the straight line and is off the scale."""
    high = [float(np.max(route.line.sigma_m))]
    if route.settings.limit_m is not None:
        high.append(route.settings.limit_m)
    return 1.05 * max(high)


def _frame(route: Route) -> Frame:
    """South, west, north, east of both lines with a margin; longitudes about the start's."""
    lat = np.concatenate([route.line.lat_deg, route.straight.lat_deg])
    about = float(route.line.lon_deg[0])
    lon = np.concatenate([_near(route.line.lon_deg, about), _near(route.straight.lon_deg, about)])
    per_lat, per_lon = (float(value) for value in metres_per_degree(float(lat.mean())))
    size = max(np.ptp(lat) * per_lat, np.ptp(lon) * per_lon)
    centre = 0.5 * (lat.min() + lat.max()), 0.5 * (lon.min() + lon.max())
    high = max(0.5 * np.ptp(lat) * per_lat + 0.1 * size, 0.25 * size) / per_lat
    wide = max(0.5 * np.ptp(lon) * per_lon + 0.1 * size, 0.45 * size) / per_lon
    return float(centre[0] - high), float(centre[1] - wide), float(centre[0] + high), float(centre[1] + wide)


def _near(lon_deg: FloatArray, about: float) -> FloatArray:
    """Longitudes within 180 degrees of one."""
    return np.asarray(about + (lon_deg - about + 180.0) % 360.0 - 180.0)


def _lines(axes: Axes, route: Route, scale: Normalize, about: float) -> None:
    """The straight line, and the route in the colours of its 1-sigma."""
    straight, line = route.straight, route.line
    lon = _near(straight.lon_deg, about)
    axes.plot(
        lon, straight.lat_deg, color=_STRAIGHT, linewidth=1.6, linestyle=(0, (5, 3)), path_effects=_TEXT, zorder=5
    )
    points = np.column_stack([_near(line.lon_deg, about), line.lat_deg])
    axes.plot(*points.T, color="white", linewidth=0.1, path_effects=_HALO, zorder=6)
    drawn = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)),
        cmap=_GOOD_TO_BAD, norm=scale, linewidth=3.4, capstyle="round", zorder=7,
    )  # fmt: skip
    drawn.set_array(line.sigma_m[1:])
    axes.add_collection(drawn)
    figure = axes.get_figure()
    assert figure is not None
    bar = figure.colorbar(drawn, ax=axes, aspect=30, pad=0.015, shrink=0.9)
    bar.set_label("1-sigma of the position [m]")
    for name, place in (("A", 0), ("B", -1)):
        lon_deg, lat_deg = (
            float(_near(route.line.corners_deg[place : place + 1 or None, 1], about)[0]),
            line.corners_deg[place, 0],
        )
        axes.plot(
            lon_deg, lat_deg, "o", color="white", markeredgecolor="#111111", markeredgewidth=2, markersize=9, zorder=8
        )
        axes.annotate(
            name,
            (lon_deg, lat_deg),
            (9, 9),
            textcoords="offset points",
            fontweight="bold",
            path_effects=_TEXT,
            zorder=9,
        )


def _areas(axes: Axes, keep_out: Sequence[Area], about: float) -> None:
    """Keep-out areas, their holes left open."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for _, rings in keep_out:
        codes, points = [], []
        for ring in rings:
            lon = np.unwrap(ring[:, 1], period=360.0)
            lon = lon + _near(lon[:1], about)[0] - lon[0]
            points.append(np.column_stack([lon, ring[:, 0]]))
            codes += [Path.MOVETO] + [Path.LINETO] * (len(ring) - 2) + [Path.CLOSEPOLY]
        shape = Path(np.concatenate(points), codes)
        axes.add_patch(
            PathPatch(shape, facecolor=_KEEP_OUT + "44", edgecolor=_KEEP_OUT, hatch="xx", linewidth=1.4, zorder=4)
        )


def _sigmas(axes: Axes, route: Route, scale: Normalize) -> None:
    """1-sigma against distance, of both lines."""
    line, straight, settings = route.line, route.straight, route.settings
    axes.plot(
        straight.distance_m / 1000.0,
        straight.sigma_m,
        color=_STRAIGHT,
        linewidth=1.4,
        linestyle=(0, (5, 3)),
        label="straight",
    )
    axes.plot(line.distance_m / 1000.0, line.sigma_m, color=MAIN, linewidth=2.0, label="route")
    if settings.limit_m is not None:
        axes.axhline(settings.limit_m, color=INS, linewidth=1.2, label="limit")
    if settings.settle_m > 0.0:
        axes.axvspan(0.0, settings.settle_m / 1000.0, color="#e3e7ea", zorder=0, label="does not count")
    high = max(float(line.sigma_m.max()), float(straight.sigma_m.max()), settings.limit_m or 0.0)
    axes.set(ylabel="1-sigma [m]", xlabel="km from A", ylim=(0.0, 1.3 * high))
    axes.set_xlim(0.0, max(line.distance_m[-1], straight.distance_m[-1]) / 1000.0)
    axes.legend(loc="upper left", ncols=4, fontsize=9.5)


def _heights(axes: Axes, line: Line) -> None:
    """The lowest flyable altitude over the ground."""
    way = line.distance_m / 1000.0
    floor = float(line.ground_m.min()) - 0.08 * float(np.ptp(line.altitude_m) + 1.0)
    axes.fill_between(way, floor, line.ground_m, color="#b9a98c", linewidth=0, label="ground")
    axes.plot(way, line.altitude_m, color=MAIN, linewidth=1.6, label="lowest flyable altitude")
    top = float(line.altitude_m.max()) + 0.3 * float(np.ptp(line.altitude_m) + 1.0)
    axes.set(ylabel="altitude [m]", xlabel="km from A", ylim=(floor, top), xlim=(0.0, float(way[-1])))
    axes.legend(loc="upper left", ncols=2, fontsize=9.5)

"""The picture of a profile looked for on a whole map: where it fits, the best place near by, and the heights there."""

from __future__ import annotations

import math

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from terranav.app.locating import Search
from terranav.app.style import MAIN, OTHERS, TRUTH, new_figure, styled
from terranav.app.trackmap import Frame, dress, shade
from terranav.app.words import distance, percent
from terranav.core.earth import metres_per_degree
from terranav.planning.locate import Place

FloatArray = NDArray[np.float64]

SHOWN = 4  # candidates
LEAST = 1e-3  # probability of one that is shown beside the best
RING_M = 3.035  # radius of the 99 % ellipse in 1-sigmas
_HALO: list[patheffects.AbstractPathEffect] = [patheffects.withStroke(linewidth=3.5, foreground="white", alpha=0.9)]


def locate_picture(search: Search) -> Figure:
    """Candidates over the shaded map, the best one near by, and the profile against the map under each."""
    every, complete = search.found.candidates, search.found.complete
    places = [one for k, one in enumerate(every[:SHOWN]) if k == 0 or not complete or one.probability >= LEAST]
    with styled():
        figure = new_figure(8.2, 11.5)
        panels = figure.subplot_mosaic([["whole", "near"], ["heights", "heights"]], height_ratios=[1.5, 1.0])
        south, west, north, east = search.chart.bounds_deg
        whole: Frame = (south, west, north, east)
        shade(panels["whole"], search.chart, whole)
        _set(panels["whole"], whole)
        panels["whole"].set_title(_title(search, places))
        if places:
            near = _around(search, places[0])
            shade(panels["near"], search.chart, near)
            _set(panels["near"], near)
            first = "the likeliest place" if complete else "the first of them, if it is the place"
            panels["near"].set_title(f"{first}; 1-sigma of its end {distance(places[0].sigma_m)}")
        for k, place in reversed(list(enumerate(places))):
            _track(panels["whole"], search, place, k, small=True)
            _track(panels["near"], search, place, k, small=False)
        dress(panels["whole"], whole)
        if places:
            dress(panels["near"], near)
        else:
            panels["near"].set_axis_off()
        _heights(panels["heights"], search, places)
    return figure


def _set(axes: Axes, frame: Frame) -> None:
    south, west, north, east = frame
    axes.set(xlim=(west, east), ylim=(south, north))


def _title(search: Search, places: list[Place]) -> str:
    """The verdict; of a search that was stopped no probabilities, which would be of a part alone."""
    found = search.found
    if not found.complete:
        return f"search stopped; {len(places)} of many places that fit"
    return f"{found.verdict}: {_chances(places, len(found.candidates))}"


def _chances(places: list[Place], of: int) -> str:
    """The probabilities in words."""
    if not places:
        return "no place fits"
    shares = ", ".join(percent(place.probability, 1) for place in places)
    return f"{shares} ({of} {'place' if of == 1 else 'places'})"


def _colour(number: int) -> str:
    return MAIN if number == 0 else OTHERS[(number - 1) % len(OTHERS)]


def _lon_near(search: Search, lon: FloatArray) -> FloatArray:
    """Longitudes beside the map's own."""
    middle = 0.5 * (search.chart.bounds_deg[1] + search.chart.bounds_deg[3])
    beside: FloatArray = middle + (lon - middle + 180.0) % 360.0 - 180.0
    return beside


def _around(search: Search, place: Place) -> Frame:
    """A square about the track, placed."""
    lat, lon = place.under(search.track)
    lon = _lon_near(search, lon)
    middle = 0.5 * (lat.min() + lat.max()), 0.5 * (lon.min() + lon.max())
    per_lat, per_lon = (float(value) for value in metres_per_degree(middle[0]))
    reach = 0.62 * max(np.ptp(lat) * per_lat, np.ptp(lon) * per_lon, 20.0 * search.chart.cell_m)
    high, wide = reach / per_lat, reach / per_lon
    return float(middle[0] - high), float(middle[1] - wide), float(middle[0] + high), float(middle[1] + wide)


def _track(axes: Axes, search: Search, place: Place, number: int, *, small: bool) -> None:
    """One candidate: the track, its end with a number, and where the end may be."""
    lat, lon = place.under(search.track)
    lon, colour = _lon_near(search, lon), _colour(number)
    axes.plot(lon, lat, color=colour, linewidth=1.8 if small else 2.4, path_effects=_HALO, zorder=6)
    axes.plot(lon[-1], lat[-1], "o", color=colour, markeredgecolor="white", markersize=7, zorder=8)
    axes.annotate(
        str(number + 1), (lon[-1], lat[-1]), (7, 7), textcoords="offset points", color=colour,
        fontweight="bold", path_effects=_HALO, zorder=9, annotation_clip=True,
    )  # fmt: skip
    if not small and number == 0:
        _ring(axes, place, float(lon[-1]))
        _truth(axes, search)


def _ring(axes: Axes, place: Place, lon: float) -> None:
    """The 99 % ellipse of the end."""
    per_lat, per_lon = (float(value) for value in metres_per_degree(place.lat_deg))
    to_degrees = np.array([[0.0, 1.0 / per_lon], [1.0 / per_lat, 0.0]])
    values, ways = np.linalg.eigh(to_degrees @ place.cov_m2 @ to_degrees.T)
    width, height = 2.0 * RING_M * np.sqrt(np.maximum(values, 0.0))
    angle = math.degrees(math.atan2(ways[1, 0], ways[0, 0]))
    axes.add_patch(
        Ellipse((lon, place.lat_deg), width, height, angle=angle, fill=False, color=MAIN, linewidth=1.4, zorder=7)
    )


def _truth(axes: Axes, search: Search) -> None:
    """The true track, where it is known."""
    rec = search.recording
    if rec.has_truth:
        rows = slice(search.first_row, search.row + 1)
        lat, lon = rec.columns["true_lat_deg"][rows], _lon_near(search, rec.columns["true_lon_deg"][rows])
        axes.plot(lon, lat, color=TRUTH, linewidth=1.2, linestyle=(0, (2, 2)), zorder=7, label="true track")
        axes.legend(loc="upper left", frameon=True, framealpha=0.85, edgecolor="none", fontsize=9)


def _heights(axes: Axes, search: Search, places: list[Place]) -> None:
    """The profile less the best offset, and the map under each candidate, its own offset beside the best's in it."""
    track, chart = search.track, search.chart
    along = track.along_m / 1000.0
    offset = places[0].offset if places else 0.0
    axes.plot(
        along, track.height - offset, ".", color=TRUTH, markersize=4, label=f"readings less {offset:.0f} {chart.unit}"
    )
    for k, place in enumerate(places):
        under = chart.sample(*place.under(track)) + (place.offset - offset)
        label = f"map under {k + 1}, rms {place.rms:.1f} {chart.unit}"
        axes.plot(along, under, color=_colour(k), linewidth=2.0 if k == 0 else 1.3, label=label, zorder=3 - 0.1 * k)
    axes.set_xlabel("km along the track")
    axes.set_ylabel(f"{chart.kind} [{chart.unit}]")
    axes.set_xlim(float(along[0]), float(along[-1]))
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=5, fontsize=9.5, borderpad=0.2)

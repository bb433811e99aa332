"""Where the aircraft is to go: waypoints drawn inside a map, and heights that keep clear of the ground.

The height is the highest ground within `_ASIDE_M` to both sides and `_AHEAD_M` ahead and behind, plus the clearance,
raised where the aircraft could not climb or sink as steeply as that asks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree, offset_m, offset_of, shift
from terranav.core.errors import DataError
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
Place = tuple[float, float]

_STATION_M, _ASIDE_M, _AHEAD_M = 100.0, 1000.0, 1200.0
_CLIMB, _SINK = 0.045, 0.065  # slopes that the aircraft can hold
_MARGIN_M, _LARGEST_M = 4000.0, 30_000.0  # from the map's edge; side of the area that is flown over
_LEAST_M = 6000.0  # side of it
_TRIES, _SHARPEST_DEG = 4000, 115.0


@dataclass(frozen=True, eq=False)
class Course:
    """Legs between waypoints, and the planned height along them.

    Attributes
    ----------
    places : tuple of (lat_deg, lon_deg)
    along_m : (legs + 1,)
        Distance of each waypoint from the first [m].
    alt_m : (n,)
        Planned height above mean sea level every 100 m [m].
    """

    places: tuple[Place, ...]
    along_m: FloatArray
    alt_m: FloatArray

    def leg(self, number: int, place: Place) -> tuple[float, float, float, float]:
        """Course of a leg [deg], and where a place lies: across to the right of it, along it, and to go [m]."""
        start, end = self.places[number], self.places[number + 1]
        north, east = offset_of(*start, *end)
        course = math.atan2(east, north)
        done_north, done_east = offset_of(*start, *place)
        along = done_north * math.cos(course) + done_east * math.sin(course)
        across = done_east * math.cos(course) - done_north * math.sin(course)
        return math.degrees(course) % 360.0, across, along, math.hypot(north, east) - along

    def turn_deg(self, number: int) -> float:
        """How much the course changes at the end of a leg, 0 at the last [deg]."""
        if number + 2 >= len(self.places):
            return 0.0
        before, after = (
            math.atan2(*offset_of(*self.places[i], *self.places[i + 1])[::-1]) for i in (number, number + 1)
        )
        return abs((math.degrees(after - before) + 180.0) % 360.0 - 180.0)

    def height(self, along_m: float) -> tuple[float, float]:
        """Planned height [m] and its slope [1] at a distance along the course."""
        at = min(max(along_m / _STATION_M, 0.0), len(self.alt_m) - 1.001)
        i = int(at)
        low, high = float(self.alt_m[i]), float(self.alt_m[i + 1])
        return low + (at - i) * (high - low), (high - low) / _STATION_M


def plan_course(chart: Map, length_m: float, clearance_m: float, rng: Generator) -> Course:
    """Draw a course over a terrain map.

    Parameters
    ----------
    chart : Map
        Of terrain.
    length_m : float
        At least so long [m].
    clearance_m : float
        Above the highest ground near it [m].
    rng : Generator

    Raises
    ------
    DataError
        For a map of another kind, and one too small or too full of voids to be flown over.
    """
    if chart.kind != "terrain":
        raise DataError(f"{chart.name}: a map of {chart.kind}, expected terrain to fly over")
    centre, half_north, half_east = _area(chart)
    places: list[Place] = []
    length, heading, tries = 0.0, math.nan, 0
    while length < length_m:
        tries += 1
        if tries > _TRIES:
            raise DataError(f"{chart.name}: no leg without voids was found, expected land of {_LEAST_M / 1e3:g} km")
        offset = rng.uniform(-1.0, 1.0, 2) * (half_north, half_east)
        lat, lon = shift(*centre, float(offset[0]), float(offset[1]))
        place = (float(lat), float(lon))
        if places:
            north, east = offset_of(*places[-1], *place)
            reach, course = math.hypot(north, east), math.degrees(math.atan2(east, north))
            turn = abs((course - heading + 180.0) % 360.0 - 180.0) if math.isfinite(heading) else 0.0
            shortest = 0.7 * min(half_north, half_east)
            if reach < shortest or turn > _SHARPEST_DEG + tries / 100.0 or not _known(chart, places[-1], place):
                continue
            length, heading = length + reach, course
        places.append(place)
        tries = 0
    legs = [math.hypot(*offset_of(*a, *b)) for a, b in pairwise(places)]
    along = np.concatenate([[0.0], np.cumsum(legs)])
    return Course(tuple(places), along, _heights(chart, places, along, clearance_m))


def _area(chart: Map) -> tuple[Place, float, float]:
    """Middle of the area that is flown over, and half its sides north and east [m]."""
    south, west, north, east = chart.bounds_deg
    centre = chart.centre_deg
    per_lat, per_lon = (float(value) for value in metres_per_degree(centre[0]))
    sides = (north - south) * per_lat, (east - west) * per_lon
    halves = [0.5 * min(side - 2.0 * _MARGIN_M, _LARGEST_M) for side in sides]
    if 2.0 * min(halves) < _LEAST_M:
        least = (_LEAST_M + 2.0 * _MARGIN_M) / 1e3
        raise DataError(
            f"{chart.name}: {sides[0] / 1e3:.1f} x {sides[1] / 1e3:.1f} km, expected at least {least:g} x {least:g} km "
            "to fly over"
        )
    return centre, halves[0], halves[1]


def _known(chart: Map, start: Place, end: Place) -> bool:
    """Whether the map has no void near a leg."""
    return bool(np.isfinite(_ground(chart, *_stations(start, end))).all())


def _stations(start: Place, end: Place) -> tuple[FloatArray, FloatArray, float]:
    """Places every 100 m of a leg (n,), and its course [rad]."""
    north, east = offset_of(*start, *end)
    reach = math.hypot(north, east)
    share = np.arange(0.0, reach, _STATION_M) / reach
    return *shift(*start, share * north, share * east), math.atan2(east, north)


def _ground(chart: Map, lat: FloatArray, lon: FloatArray, course: float) -> FloatArray:
    """Highest ground (n,) to both sides of places on a leg [m]; NaN where any of it is unknown."""
    aside = np.linspace(-_ASIDE_M, _ASIDE_M, 9)
    there = shift(lat[:, None], lon[:, None], -math.sin(course) * aside[None, :], math.cos(course) * aside[None, :])
    return np.asarray(chart.sample(*there).max(axis=1))


def _heights(chart: Map, places: list[Place], along: FloatArray, clearance_m: float) -> FloatArray:
    """Planned heights every 100 m of the whole course [m]."""
    at, ground = [], []
    for number, (start, end) in enumerate(pairwise(places)):
        lat, lon, course = _stations(start, end)
        north, east = offset_m(*start, lat, lon)
        at.append(along[number] + np.hypot(north, east))
        ground.append(_ground(chart, lat, lon, course))
    grid = np.arange(0.0, along[-1] + _STATION_M, _STATION_M)
    needed = np.interp(grid, np.concatenate(at), np.concatenate(ground))
    reach = int(_AHEAD_M / _STATION_M)
    padded = np.pad(needed, reach, mode="edge")
    needed = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1) + clearance_m
    climb, sink = _CLIMB * _STATION_M * np.arange(grid.size), _SINK * _STATION_M * np.arange(grid.size)
    rising = np.maximum.accumulate((needed - climb)[::-1])[::-1] + climb  # high enough early enough
    return np.asarray(np.maximum.accumulate(rising + sink) - sink)  # and no steeper down

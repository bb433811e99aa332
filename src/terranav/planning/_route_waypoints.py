"""The few places that an autopilot is given of a route: its corners, and where the height profile bends."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import offset_m
from terranav.planning._route_judge import Line

FloatArray = NDArray[np.float64]

TOLERANCE_M = 15.0  # by which heights between two waypoints may exceed the lowest profile, about


def waypoints(line: Line, radius_m: float) -> FloatArray:
    """(m, 3) latitude, longitude [deg] and altitude [m] of start, corners, bends of the profile, and end.

    Straight climbs between them are nowhere below `line.altitude_m` and nowhere steeper than it: chords of the profile,
    all raised by as much as the lowest of them lacks. Altitudes are NaN where the line has none.
    """
    at = np.array([_nearest(line, place) for place in line.corners_deg])
    at[0], at[-1] = 0, line.lat_deg.size - 1
    corners = np.column_stack([line.corners_deg, line.altitude_m[at]])
    if np.isnan(line.altitude_m).all():
        return corners
    free = np.ones(line.lat_deg.size, dtype=bool)  # on a leg, not in the arc of a corner
    for place in line.corners_deg[1:-1]:
        north, east = offset_m(place[0], place[1], line.lat_deg, line.lon_deg)
        free &= np.hypot(north, east) > radius_m
    chosen = np.unique(np.concatenate([at, *[_bends(line, a, b, free) for a, b in pairwise(at.tolist())]]))
    lack = line.altitude_m - np.interp(line.distance_m, line.distance_m[chosen], line.altitude_m[chosen])
    places = np.column_stack([line.lat_deg, line.lon_deg, line.altitude_m])[chosen]
    is_corner = np.isin(chosen, at)
    places[is_corner, :2] = corners[np.searchsorted(at, chosen[is_corner]), :2]
    places[:, 2] += math.ceil(10.0 * max(float(lack.max()), 0.0)) / 10.0
    return np.asarray(places)


def _nearest(line: Line, place: FloatArray) -> int:
    """The reading nearest to a place."""
    return int(np.argmin(np.hypot(*offset_m(place[0], place[1], line.lat_deg, line.lon_deg))))


def _bends(line: Line, first: int, last: int, free: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Readings between two at which the profile must bend to stay within the tolerance (Douglas and Peucker, 1973)."""
    found, open_spans = [], [(first, last)]
    while open_spans:
        a, b = open_spans.pop()
        inner = np.arange(a + 1, b)[free[a + 1 : b]]
        if not inner.size:
            continue
        ends = line.distance_m[[a, b]], line.altitude_m[[a, b]]
        away = np.abs(line.altitude_m[inner] - np.interp(line.distance_m[inner], *ends))
        if away.max() > TOLERANCE_M:
            middle = int(inner[away.argmax()])
            found.append(middle)
            open_spans += [(a, middle), (middle, b)]
    return np.array(found, dtype=np.int64)

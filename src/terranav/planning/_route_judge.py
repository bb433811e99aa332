"""The judge of routes, and the order in which they are looked for (`terranav.planning.route` says what it is worth)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import offset_m, wrap_longitude
from terranav.core.errors import DataError
from terranav.planning._route_lattice import Lattice, Wanted
from terranav.planning._route_line import Mending, Worth, flyable, length_of, plain, rounded, spaced
from terranav.planning._route_plane import Place, Plane, Walls
from terranav.planning._route_sensing import Sensing, longest_axis

FloatArray = NDArray[np.float64]

STAGES = (0.15, 0.4)  # shares of extra length that are tried before the one that is allowed
TRIES = 4  # searches under an ever tighter limit
_GRAIN = 0.002  # of a 1-sigma: what is nearer than that counts as the same
_SPARE = 1e-4  # of the limit, for the difference between the quick recursion and the bound itself
_NEVER: Worth = (math.inf, math.inf)


@dataclass(frozen=True)
class Ask:
    """What a route is to be, in metres: `route.RouteSettings` with nothing left open.

    Attributes
    ----------
    limit_m : float
        0 for none.
    share : float
        Extra length allowed, as a share of the straight line's.
    settle_m, radius_m, margin_m : float
    """

    limit_m: float
    share: float
    settle_m: float
    radius_m: float
    margin_m: float


@dataclass(frozen=True, eq=False)
class Line:
    """A line over the map, at its readings.

    Attributes
    ----------
    lat_deg, lon_deg : (n,) [deg]
    distance_m : (n,)
        From the start.
    sigma_m : (n,)
        1-sigma along the longest axis of the position error, by `terranav.planning.bound`.
    altitude_m, ground_m : (n,)
        The lowest flyable altitude, in the map's datum, and the ground; NaN where the map's kind has no height.
    corners_deg : (m, 2)
        Latitude and longitude of start, corners and end.
    length_m : float
    top_m : float
        Largest 1-sigma from `settle_m` on.
    barred : tuple of str
        Why the line cannot be flown; empty when it can.
    """

    lat_deg: FloatArray
    lon_deg: FloatArray
    distance_m: FloatArray
    sigma_m: FloatArray
    altitude_m: FloatArray
    ground_m: FloatArray
    corners_deg: FloatArray
    length_m: float
    top_m: float
    barred: tuple[str, ...]

    @property
    def steepest_deg(self) -> float:
        """Steepest climb or descent between readings, NaN without heights."""
        if self.lat_deg.size < 2 or np.isnan(self.altitude_m).all():
            return math.nan
        rise = np.abs(np.diff(self.altitude_m) / np.diff(self.distance_m))
        return math.degrees(math.atan(float(rise.max())))


@dataclass(frozen=True, eq=False)
class Found:
    """The best line, the straight one, how many labels were followed, and whether a search was a coarse one."""

    line: Line
    straight: Line
    labels: int
    coarse: bool


@dataclass(frozen=True)
class Judge:
    """Everything that a route is judged by."""

    plane: Plane
    sensing: Sensing
    walls: Walls
    ask: Ask

    def found(self, ends: tuple[Place, Place]) -> Found:
        """The best route that is found: first among ways that are little longer than the straight one."""
        self._check(ends)
        ask, base = self.ask, self.line(np.array(self.plane.ends_m))
        best, labels, coarse = None if base.barred else base, 0, False
        for share in (*[stage for stage in STAGES if stage < 0.8 * ask.share], ask.share):
            if best is not None and best.top_m <= ask.limit_m:
                break
            longest = self.plane.length_m * (1.0 + share)
            lattice = Lattice(self.plane, self.sensing, self.walls, ask.radius_m, self._room, longest)
            inner = ask.limit_m
            for _ in range(TRIES):
                way = lattice.best(Wanted(inner, longest, ask.settle_m))
                labels, coarse = labels + way.labels, coarse or way.coarse
                if not len(way.points_m):
                    break
                mending = Mending(self._worth(inner, longest), 0.5 * lattice.side_m)
                line = self.line(mending.mended(plain(way.points_m)))
                if not line.barred and (best is None or self._key(line) < self._key(best)):
                    best = line
                if way.top_m > inner or line.top_m <= ask.limit_m:
                    break
                inner *= ask.limit_m / line.top_m
        if best is None:
            raise DataError(
                f"there is no way from {told(ends[0])} to {told(ends[1])} within {longest / 1000:.1f} km that can be "
                f"flown: the straight line {' and '.join(base.barred)}, and none was found around"
            )
        return Found(best, base, labels, coarse)

    @property
    def _room(self) -> float:
        """What is kept from the walls, with that by which an arc cuts a corner of up to 45 degrees."""
        return self.ask.margin_m + (0.09 * self.ask.radius_m if len(self.walls.sides) else 0.0)

    def _key(self, line: Line) -> Worth:
        return graded(line.top_m, self.ask.limit_m), line.length_m

    def _worth(self, limit: float, longest: float) -> Callable[[FloatArray], Worth]:
        """What corners are worth, by the quick recursion."""

        def worth(corners: FloatArray) -> Worth:
            if not flyable(corners, self.ask.radius_m):
                return _NEVER
            line = rounded(corners, self.ask.radius_m)
            length = length_of(line)
            if length > longest or self.walls.hit_track(line, self.ask.margin_m) >= 0:
                return _NEVER
            lat, lon = self.plane.to_earth(spaced(line, self.sensing.spacing_m))
            if self._barred_at(lat, lon):
                return _NEVER
            top = self._top(self.sensing.sigmas(lat, lon))
            return graded(top, limit * (1.0 - _SPARE)), length

        return worth

    def _top(self, sigma: FloatArray) -> float:
        first = math.ceil(self.ask.settle_m / self.sensing.spacing_m)
        return float(sigma[min(first, sigma.size - 1) :].max())

    def _barred_at(self, lat: FloatArray, lon: FloatArray) -> list[str]:
        """Why positions cannot be flown over."""
        chart, heights = self.sensing.chart, self.sensing.heights
        ground, on = chart.sample(lat, lon), chart.covers(lat, lon)
        found = []
        if not on.all():
            found.append(f"leaves the map {chart.name}")
        if np.isnan(ground[on]).any():
            found.append(f"crosses a void of {chart.name}")
        if heights is not None and (ground + heights.clearance_m > heights.ceiling_m).any():
            found.append(f"the ground rises to {np.nanmax(ground):.0f} m, too high for the ceiling")
        return found

    def line(self, corners: FloatArray) -> Line:
        """A line with its figures by the bound."""
        sensing = self.sensing
        drawn = rounded(corners, self.ask.radius_m)
        points = spaced(drawn, sensing.spacing_m)
        lat, lon = self.plane.to_earth(points)
        lon = wrap_longitude(lon)
        barred = self._barred_at(lat, lon)
        met = self.walls.hit_track(drawn, self.ask.margin_m)
        if met >= 0:
            barred.append(f"enters the keep-out area {self.walls.names[met]!r}")
        cov = sensing.bound(lat, lon)
        sigma = longest_axis(cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1])
        high, ground = np.full((2, lat.size), math.nan)
        if sensing.heights is not None:
            high, ground = sensing.altitudes(lat, lon)
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*offset_m(lat[:-1], lon[:-1], lat[1:], lon[1:])))])
        rest = length_of(np.array([points[-1], drawn[-1]]))
        at = np.stack(self.plane.to_earth(corners), axis=1)
        at[:, 1] = wrap_longitude(at[:, 1])
        return Line(lat, lon, way, sigma, high, ground, at, float(way[-1]) + rest, self._top(sigma), tuple(barred))

    def _check(self, ends: tuple[Place, Place]) -> None:
        """Raise for an end where no vehicle can be."""
        chart, heights = self.sensing.chart, self.sensing.heights
        for name, place, point in zip(("start", "end"), ends, self.plane.ends_m, strict=True):
            ground = float(chart.sample(*place))
            if math.isnan(ground):
                raise DataError(f"route {name} {told(place)} lies in a void of the map {chart.name}")
            met = int(self.walls.hit(np.concatenate([point, point])[None], self.ask.margin_m)[0])
            if met >= 0:
                raise DataError(f"route {name} {told(place)} lies in the keep-out area {self.walls.names[met]!r}")
            if heights is not None and ground + heights.clearance_m > heights.ceiling_m:
                raise DataError(
                    f"route {name} {told(place)}: ground at {ground:.0f} m and a clearance of "
                    f"{heights.clearance_m:g} m are above the ceiling of {heights.ceiling_m:g} m"
                )


def graded(top_m: float, limit_m: float) -> float:
    """How bad a largest 1-sigma is: all are as good that are within the limit, or within a grain of one another."""
    return -math.inf if top_m <= limit_m else math.ceil(math.log(max(top_m, 1e-6)) / _GRAIN)


def told(place: Place) -> str:
    """A place as it is typed."""
    return f"{place[0]:g},{place[1]:g}"

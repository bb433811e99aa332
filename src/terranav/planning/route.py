"""Routes that keep a vehicle located: the predicted 1-sigma position error under a limit, or as low as can be.

From A, where the position is known to `start_sigma_m` (satellites end there), to B. Along a route the covariance is the
Cramer-Rao bound of `terranav.planning.bound`; a route is worth the largest 1-sigma along the longest axis from
`settle_m` on. Two questions:

- with a limit: the least length whose largest 1-sigma stays under it;
- without: the smallest largest 1-sigma for at most `extra` more length than the straight line (the geodesic).

What happens, and what each step is worth:

1. *Lattice.* Nodes along and across the geodesic, sixteen headings, corners only as sharp as the turn radius allows on
   half of both edges. An edge is flown in pieces of about half a lattice side. The readings of a piece are summed up
   exactly for a position that stays (the map error's correlation included, but not beyond the piece) and taken to
   arrive at its end: an approximation, on the whole too good (its largest 1-sigma is about a tenth to a fifth low).
2. *Search.* Labels of place, heading, covariance, length and largest 1-sigma, in the order of (1-sigma beyond the
   limit, length + straight line to the goal), which never overrates what is left (`terranav.kernels.routing`). That
   would be exact on the lattice if a label were dropped only when another is better in all of its covariance.
   Heuristic: only the blocks of position, velocity and so on are compared, with a share to spare, and at one place and
   heading no more than a dozen labels live. Ways that are little longer than the straight one are looked at first.
3. *Mending.* Arcs at the corners, then corners left out or moved as long as that helps, judged by the recursion of the
   bound along the whole line. Heuristic: a local optimum.
4. *Judgement.* The line that is given out is run through `terranav.planning.bound` itself; those are the figures told.
   If it is over the limit and the search believed otherwise, the search is done again under a tighter one. Exact, for
   the bound's own model.

So what is told of a route holds; that no better one exists is not proved. The bound is that of small errors: it does
not know of the other valley that looks the same (`planning.suitability`, self-similarity).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import GRAVITY_MPS2, metres_per_degree
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.maps.map import Map
from terranav.planning._route_judge import Ask, Judge, Line, told
from terranav.planning._route_plane import Area, Place, Plane, Walls
from terranav.planning._route_sensing import HEIGHTED, Heights, Sensing
from terranav.planning._route_waypoints import waypoints

FloatArray = NDArray[np.float64]

BANK_DEG = 25.0  # of a turn whose radius is not given
LONGEST_M = 1_500_000.0


@dataclass(frozen=True)
class RouteSettings:
    """What is asked, the sensor and the vehicle.

    Attributes
    ----------
    limit_m : float or None
        Largest 1-sigma allowed, > 0 [m]; None: as low as can be.
    extra : float or None
        Length that may be added to the straight line's, as a share of it, >= 0; None is 0.15, and 1 with a limit.
    start_sigma_m : float
        1-sigma of the position at the start, per axis, > 0 [m].
    settle_m : float
        The 1-sigma counts from so far on, >= 0 [m].
    sensor_sigma : float
        1-sigma of a reading [unit of the map], > 0.
    rate_hz, speed_mps : float
        Readings a second; ground speed; > 0.
    turn_radius_m : float or None
        > 0; None is that of a bank of 25 degrees at the speed.
    clearance_m : float
        Least height above ground, >= 0 [m]; for maps of terrain and seabed, as are the next three.
    climb_deg : float
        Steepest climb and descent, 0 < angle < 90.
    ceiling_m : float or None
        Largest altitude, in the map's datum [m].
    altimeter_range_m : float or None
        Above this height over ground there is no reading, > clearance_m [m].
    margin_m : float
        Kept from keep-out areas, >= 0 [m].

    Raises
    ------
    ConfigError
        For a value out of its range.
    """

    limit_m: float | None = None
    extra: float | None = None
    start_sigma_m: float = 10.0
    settle_m: float = 0.0
    sensor_sigma: float = 5.0
    rate_hz: float = 1.0
    speed_mps: float = 60.0
    turn_radius_m: float | None = None
    clearance_m: float = 150.0
    climb_deg: float = 5.0
    ceiling_m: float | None = None
    altimeter_range_m: float | None = None
    margin_m: float = 0.0

    def __post_init__(self) -> None:
        for name in ("start_sigma_m", "sensor_sigma", "rate_hz", "speed_mps"):
            finite(f"route {name}", getattr(self, name), above=0.0)
        for name in ("settle_m", "clearance_m", "margin_m"):
            finite(f"route {name}", getattr(self, name), minimum=0.0)
        finite("route climb_deg", self.climb_deg, above=0.0, maximum=89.0)
        for name, above in (("limit_m", 0.0), ("turn_radius_m", 0.0), ("altimeter_range_m", self.clearance_m)):
            if getattr(self, name) is not None:
                finite(f"route {name}", getattr(self, name), above=above)
        if self.extra is not None:
            finite("route extra", self.extra, minimum=0.0, maximum=10.0)
        if self.ceiling_m is not None:
            finite("route ceiling_m", self.ceiling_m)

    @property
    def radius_m(self) -> float:
        """Of a turn [m]."""
        told = self.turn_radius_m
        return self.speed_mps**2 / (GRAVITY_MPS2 * math.tan(math.radians(BANK_DEG))) if told is None else told

    @property
    def share(self) -> float:
        """Extra length allowed, as a share of the straight line."""
        if self.extra is not None:
            return self.extra
        return 0.15 if self.limit_m is None else 1.0


@dataclass(frozen=True, eq=False)
class Route:
    """A route, the straight line beside it, and whether the limit is kept.

    Attributes
    ----------
    line, straight : Line
    kept : bool
        Whether the largest 1-sigma is within the limit; True without one.
    labels : int
        How many labels the searches followed.
    coarse : bool
        A search followed too many labels and was done again with fewer: what is told holds, but better routes may
        have been missed.
    settings : RouteSettings
    ins : InsGrade
    """

    line: Line
    straight: Line
    kept: bool
    labels: int
    coarse: bool
    settings: RouteSettings
    ins: InsGrade

    @property
    def extra(self) -> float:
        """Length more than the straight line's, as a share of it."""
        return self.line.length_m / self.straight.length_m - 1.0


def plan_route(
    chart: Map,
    start: Place,
    end: Place,
    settings: RouteSettings | None = None,
    ins: InsGrade | None = None,
    *,
    keep_out: Sequence[Area] = (),
) -> Route:
    """A route from start to end.

    Parameters
    ----------
    chart : Map
    start, end : (latitude, longitude) [deg]
    settings : RouteSettings, optional
    ins : InsGrade, optional
        Its position sigma is replaced by `start_sigma_m`.
    keep_out : sequence of (name, rings)
        Rings (n, 2) of latitude and longitude [deg], closed; by the even-odd rule the later ones are holes.

    Returns
    -------
    Route
        `kept` is False when no route within the limit was found: it is then the best that was.

    Raises
    ------
    ConfigError
        Start and end are one place, too far apart, or no places on Earth.
    DataError
        An end is off the map, in a void or in a keep-out area, or below the ceiling there is no room; or there is no
        way between the ends.
    """
    settings = settings or RouteSettings()
    grade = replace(ins or InsGrade(), position_sigma_m=settings.start_sigma_m)
    for name, place in (("start", start), ("end", end)):
        finite(f"route {name} latitude", place[0], minimum=-90.0, maximum=90.0)
        finite(f"route {name} longitude", place[1], minimum=-180.0, maximum=360.0)
        if not bool(chart.covers(*place)):
            raise DataError(f"route {name} {told(place)} is off the map {chart.name}, {_spans(chart)}")
    plane = Plane.between(start, end)
    if plane.length_m < 2.0 * chart.cell_m:
        raise ConfigError(
            f"route start {told(start)} and end {told(end)} are {plane.length_m:.0f} m apart, expected at least two "
            f"cells of the map ({2.0 * chart.cell_m:.0f} m)"
        )
    if plane.length_m * (1.0 + settings.share) > LONGEST_M:
        raise ConfigError(
            f"route of {plane.length_m / 1000:.0f} km with {100 * settings.share:g} % more is longer than "
            f"{LONGEST_M / 1000:.0f} km, expected a shorter one or a smaller extra"
        )
    found = _judge(_near(chart, plane, settings), plane, settings, grade, keep_out).found((start, end))
    kept = settings.limit_m is None or found.line.top_m <= settings.limit_m
    return Route(found.line, found.straight, kept, found.labels, found.coarse, settings, grade)


def waypoints_of(route: Route) -> FloatArray:
    """(m, 3) latitude, longitude [deg] and altitude [m] for an autopilot: corners, and bends of the height profile.

    Straight climbs between them are nowhere below the line's altitudes and nowhere steeper than `climb_deg`.
    """
    return waypoints(route.line, route.settings.radius_m)


def recording_of(line: Line, chart: Map, settings: RouteSettings, ins: InsGrade) -> Recording:
    """A flight along a line with its position true, and what a perfect sensor would read at its places.

    Parameters
    ----------
    line : Line
    chart : Map
    settings : RouteSettings
        Those the line was made with.
    ins : InsGrade
        Becomes the recording's.

    Returns
    -------
    Recording
        Readings are left out where the map is void or the ground out of the altimeter's range; the times are those at
        the speed of the settings.
    """
    step = float(line.distance_m[-1]) / max(line.distance_m.size - 1, 1)
    rate = settings.speed_mps / step if step > 0.0 else settings.rate_hz
    return replace(_sensing(chart, settings, ins), rate_hz=rate).recording(line.lat_deg, line.lon_deg)


def _sensing(chart: Map, settings: RouteSettings, grade: InsGrade) -> Sensing:
    """The sensor over a map, as it is told."""
    ceiling = math.inf if settings.ceiling_m is None else settings.ceiling_m
    reach = math.inf if settings.altimeter_range_m is None else settings.altimeter_range_m
    heights = Heights(settings.clearance_m, settings.climb_deg, ceiling, reach) if chart.kind in HEIGHTED else None
    return Sensing(chart, grade, settings.sensor_sigma, settings.rate_hz, settings.speed_mps, heights)


def _judge(chart: Map, plane: Plane, settings: RouteSettings, grade: InsGrade, keep_out: Sequence[Area]) -> Judge:
    """What routes over a map are judged by."""
    whole = _sensing(chart, settings, grade)
    ask = Ask(settings.limit_m or 0.0, settings.share, settings.settle_m, settings.radius_m, settings.margin_m)
    return Judge(plane, whole.thinned(plane.length_m * (1.0 + settings.share)), Walls.of(keep_out, plane), ask)


def _near(chart: Map, plane: Plane, settings: RouteSettings) -> Map:
    """The map about all ways that are short enough."""
    whole = plane.length_m * (1.0 + settings.share)
    half = np.array([0.5 * whole, 0.5 * math.sqrt(max(whole**2 - plane.length_m**2, 0.0))]) + 4.0 * chart.cell_m
    angle = np.linspace(0.0, 2.0 * math.pi, 181)
    lat, lon = plane.to_earth(np.stack([half[0] * np.cos(angle), half[1] * np.sin(angle)], axis=1))
    south, _, north, _ = chart.bounds_deg
    per_lat = float(metres_per_degree(plane.middle_deg[0])[0])
    over = 4.0 * chart.cell_m / per_lat
    if np.abs(lat).max() > 89.0:
        return chart
    return chart.crop(
        max(float(lat.min()) - over, south - over), float(lon.min()), min(float(lat.max()) + over, north + over),
        float(lon.max()),
    )  # fmt: skip


def _spans(chart: Map) -> str:
    south, west, north, east = chart.bounds_deg
    return f"which spans latitudes {south:.4f} to {north:.4f} and longitudes {west:.4f} to {east:.4f}"

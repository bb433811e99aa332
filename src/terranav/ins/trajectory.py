"""A route of waypoints flown smoothly: straight legs, coordinated turns, smooth changes of speed and height.

The route is drawn on a conformal plane (transverse Mercator about its middle) and driven at speeds over the ellipsoid.
A turn is flown by, not over, its waypoint: circular, with a roll-in and roll-out during which the curvature follows
3 u^2 - 2 u^3, so that course, roll and acceleration have no steps that an IMU would feel. In a turn of radius r at
speed v the roll is atan(v^2 / (g r)); heading is the course, pitch the angle of the flight path.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import Proj
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from terranav.core.checks import finite
from terranav.core.earth import GRAVITY_MPS2, metres_per_degree, offset_m, shift, wrap_longitude
from terranav.core.errors import ConfigError

FloatArray = NDArray[np.float64]

MAX_LATITUDE_DEG = 89.0
MAX_BANK_DEG = 75.0
_NODES_PER_TURN = 257
_NODE_SPACING_M = 2000.0


@dataclass(frozen=True, eq=False)
class Route:
    """Where to fly, and how.

    Attributes
    ----------
    waypoints : (n, 3)
        Latitude [deg], longitude [deg], altitude [m], n >= 2.
    speed_mps : float or (n - 1,)
        Speed over the ellipsoid, of the whole route or of each leg [m/s]; it changes after the turn into a leg.
    bank_deg : float
        Roll in turns [deg], in (0, 75].
    turn_radius_m : float or None
        Radius of all turns [m]; it replaces `bank_deg`.
    roll_in_s : float
        Time from level to full bank [s].
    accel_mps2 : float
        Largest acceleration along the track when the speed changes [m/s^2].

    Raises
    ------
    ConfigError
        For fewer than two waypoints, positions that are not finite or within a degree of a pole, a leg of no length,
        a speed that is not positive, an impossible bank or radius.
    """

    waypoints: ArrayLike
    speed_mps: float | Sequence[float] | FloatArray
    bank_deg: float = 20.0
    turn_radius_m: float | None = None
    roll_in_s: float = 3.0
    accel_mps2: float = 1.0
    #: (n, 3) and (n - 1,), checked
    points: FloatArray = field(init=False, repr=False)
    speeds: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        points = _numbers("waypoints", self.waypoints)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
            raise ConfigError(
                f"route waypoints has shape {points.shape}, expected (n, 3) with n >= 2: latitude, longitude, altitude"
            )
        for i, (lat, lon, alt) in enumerate(points.tolist(), start=1):
            finite(f"route waypoint {i} latitude", lat, minimum=-MAX_LATITUDE_DEG, maximum=MAX_LATITUDE_DEG)
            finite(f"route waypoint {i} longitude", lon, minimum=-180.0, maximum=360.0)
            finite(f"route waypoint {i} altitude", alt)
        length = np.hypot(*offset_m(points[:-1, 0], points[:-1, 1], points[1:, 0], points[1:, 1]))
        for i in np.flatnonzero(length < 1e-3).tolist():
            raise ConfigError(f"route waypoints {i + 1} and {i + 2} are the same place, expected a leg of some length")
        speeds = np.atleast_1d(_numbers("speed_mps", self.speed_mps))
        if speeds.shape not in ((1,), (len(points) - 1,)):
            raise ConfigError(
                f"route speed_mps has {speeds.size} values, expected one or one a leg ({len(points) - 1})"
            )
        for speed in speeds.tolist():
            finite("route speed_mps", speed, above=0.0)
        finite("route bank_deg", self.bank_deg, above=0.0, maximum=MAX_BANK_DEG)
        finite("route roll_in_s", self.roll_in_s, above=0.0)
        finite("route accel_mps2", self.accel_mps2, above=0.0)
        if self.turn_radius_m is not None:
            radius = finite("route turn_radius_m", self.turn_radius_m, above=0.0)
            bank = math.degrees(math.atan(float(speeds.max()) ** 2 / (GRAVITY_MPS2 * radius)))
            finite(f"route turn_radius_m is {radius:g} at {speeds.max():g} m/s: its bank", bank, maximum=MAX_BANK_DEG)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "speeds", np.broadcast_to(speeds, len(points) - 1).copy())

    def radius_m(self, speed_mps: float) -> float:
        """Radius of a turn at this speed [m]: v^2 / (g tan(bank)), or as given."""
        if self.turn_radius_m is not None:
            return self.turn_radius_m
        return speed_mps**2 / (GRAVITY_MPS2 * math.tan(math.radians(self.bank_deg)))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Position, velocity and attitude against time: a truth, or what an INS makes of it.

    Attributes
    ----------
    time_s : (n,) increasing [s]
    lat_deg, lon_deg, alt_m : (n,) [deg], [deg], [m]
    velocity_mps : (n, 3) north, east, down [m/s]
    attitude_deg : (n, 3) roll, pitch, heading in [0, 360) [deg]
    """

    time_s: FloatArray
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_m: FloatArray
    velocity_mps: FloatArray
    attitude_deg: FloatArray

    def __len__(self) -> int:
        return int(self.time_s.size)

    def every(self, step: int) -> Trajectory:
        """Each `step`-th sample, from the first."""
        return Trajectory(*(getattr(self, entry.name)[::step] for entry in fields(self)))

    def columns(self) -> dict[str, FloatArray]:
        """The recording columns of an indicated trajectory."""
        return {
            "time_s": self.time_s,
            "lat_deg": self.lat_deg,
            "lon_deg": self.lon_deg,
            "alt_m": self.alt_m,
            **dict(zip(("vn_mps", "ve_mps", "vd_mps"), self.velocity_mps.T, strict=True)),
            **dict(zip(("roll_deg", "pitch_deg", "heading_deg"), self.attitude_deg.T, strict=True)),
        }

    def truth(self) -> dict[str, FloatArray]:
        """The recording columns of a true trajectory."""
        return {"true_lat_deg": self.lat_deg, "true_lon_deg": self.lon_deg, "true_alt_m": self.alt_m}


def fly(route: Route, rate_hz: float = 50.0) -> Trajectory:
    """Fly a route from its first waypoint to its last.

    Parameters
    ----------
    route : Route
    rate_hz : float
        Samples a second [Hz], > 0.

    Returns
    -------
    Trajectory
        From time 0, at equal steps; the last sample is less than a step before the last waypoint.

    Raises
    ------
    ConfigError
        When a turn does not fit between its legs (naming the waypoint and the largest radius that fits), or a change of
        speed into its leg.
    """
    step_s = 1.0 / finite("rate_hz", rate_hz, above=0.0)
    plane = _plane_about(route.points)
    x, y = plane(route.points[:, 1], route.points[:, 0])
    path = _draw(route, np.stack([x, y], axis=1))
    lon, lat = _geographic(plane, path.xy)
    scale = np.asarray(plane.get_factors(lon, lat).meridional_scale, dtype=np.float64)
    # metres over the ellipsoid along the path, and back to the plane
    ground = np.concatenate([[0.0], np.cumsum(np.diff(path.along) * 0.5 * (1.0 / scale[1:] + 1.0 / scale[:-1]))])
    along_of = CubicHermiteSpline(ground, path.along, scale)
    at_waypoint, after_turn = (np.interp(at, path.along, ground) for at in (path.at_waypoint, path.after_turn))

    travelled, end_s = _schedule(route, after_turn, ground[-1])
    time = np.arange(math.floor(end_s / step_s * (1.0 + 1e-12)) + 1, dtype=np.float64) * step_s
    distance, speed = travelled(time)
    along = np.asarray(along_of(distance), dtype=np.float64)
    lon, lat = _geographic(plane, np.asarray(CubicHermiteSpline(path.along, path.xy, path.tangent)(along), np.float64))
    course = CubicHermiteSpline(path.along, path.course, path.curvature)
    heading = course(along) + np.radians(plane.get_factors(lon, lat).meridian_convergence)
    height = PchipInterpolator(at_waypoint, route.points[:, 2])
    alt = np.asarray(height(distance), dtype=np.float64)

    north, east = speed * np.cos(heading), speed * np.sin(heading)
    meridian, prime_vertical = _radii(lat)
    velocity = np.stack(
        [north * (1.0 + alt / meridian), east * (1.0 + alt / prime_vertical), -height(distance, 1) * speed],
        axis=1,
        dtype=np.float64,
    )
    horizontal = np.hypot(velocity[:, 0], velocity[:, 1])
    attitude = np.stack(
        [
            np.arctan(speed**2 * course(along, 1) / GRAVITY_MPS2),
            np.arctan2(-velocity[:, 2], horizontal),
            np.arctan2(velocity[:, 1], velocity[:, 0]) % (2.0 * np.pi),
        ],
        axis=1,
        dtype=np.float64,
    )
    return Trajectory(time, lat, wrap_longitude(lon), alt, velocity, np.degrees(attitude))


@dataclass(frozen=True)
class _Path:
    """Nodes of the path on the plane (x east, y north), dense enough for cubic Hermite interpolation."""

    along: FloatArray  # (m,) plane metres from the start
    xy: FloatArray  # (m, 2)
    course: FloatArray  # (m,) clockwise from grid north, unwrapped [rad]
    curvature: FloatArray  # (m,) [rad/m]
    at_waypoint: list[float]  # along at each waypoint's passing
    after_turn: list[float]  # along where the straight part of each leg begins

    @property
    def tangent(self) -> FloatArray:
        """(m, 2) unit vectors."""
        return np.stack([np.sin(self.course), np.cos(self.course)], axis=1)


@dataclass(frozen=True)
class _Turn:
    """A turn in the frame of its entry: nodes ahead and to the right, and how far before the corner it begins."""

    along: FloatArray
    ahead: FloatArray
    right: FloatArray
    course: FloatArray
    curvature: FloatArray
    tangent_m: float


def _turn(angle: float, radius_m: float, ramp_m: float) -> _Turn:
    """A turn by `angle` [rad, clockwise], with curvature ramps of length ramp_m."""
    if abs(angle) < 1e-9:
        zero = np.zeros(1)
        return _Turn(zero, zero, zero, zero, zero, 0.0)
    peak = math.copysign(min(1.0 / radius_m, abs(angle) / ramp_m), angle)
    length = angle / peak + ramp_m
    along = np.linspace(0.0, length, _NODES_PER_TURN)
    rise, fall = np.clip(along / ramp_m, 0.0, 1.0), np.clip((length - along) / ramp_m, 0.0, 1.0)
    curvature = peak * (_ease(rise) + _ease(fall) - 1.0)
    flat = np.clip(along, ramp_m, length - ramp_m) - ramp_m
    course = peak * (ramp_m * (_ease_sum(rise) + 0.5 - _ease_sum(fall)) + flat)
    ahead, right = (
        _integral(along, np.cos(course), -np.sin(course) * curvature),
        _integral(along, np.sin(course), np.cos(course) * curvature),
    )
    return _Turn(along, ahead, right, course, curvature, right[-1] / math.sin(angle))


def _draw(route: Route, corners: FloatArray) -> _Path:
    """Lay legs and turns through the corners (n, 2) on the plane."""
    legs = np.diff(corners, axis=0)
    lengths, courses = np.hypot(*legs.T), np.arctan2(legs[:, 0], legs[:, 1])
    angles = (np.diff(courses) + np.pi) % (2.0 * np.pi) - np.pi
    turns = _fitting_turns(route, lengths, angles)
    nodes: list[tuple[FloatArray, ...]] = []
    along, course = 0.0, float(courses[0])
    at_waypoint, after_turn = [0.0], [0.0]
    for i, length in enumerate(lengths.tolist()):
        unit = legs[i] / length
        start = turns[i - 1].tangent_m if i else 0.0
        stop = length - (turns[i].tangent_m if i < len(turns) else 0.0)
        count = max(2, math.ceil((stop - start) / _NODE_SPACING_M) + 1)
        on_leg = np.linspace(start, stop, count)
        nodes.append(
            (along + on_leg - start, corners[i] + on_leg[:, None] * unit, np.full(count, course), np.zeros(count))
        )
        along += stop - start
        if i < len(turns):
            turn, right = turns[i], np.array([unit[1], -unit[0]])
            xy = corners[i] + stop * unit + turn.ahead[:, None] * unit + turn.right[:, None] * right
            nodes.append((along + turn.along, xy, course + turn.course, turn.curvature))
            at_waypoint.append(along + 0.5 * turn.along[-1])
            along, course = along + turn.along[-1], course + float(angles[i])
            after_turn.append(along)
    at_waypoint.append(along)
    stacked = [np.concatenate(parts) for parts in zip(*nodes, strict=True)]
    fresh = np.concatenate([[True], np.diff(stacked[0]) > 1e-9])
    at, xy, heading, curvature = (part[fresh] for part in stacked)
    return _Path(at, xy, heading, curvature, at_waypoint, after_turn)


def _fitting_turns(route: Route, lengths: FloatArray, angles: FloatArray) -> list[_Turn]:
    """The turns at the inner waypoints, or ConfigError for the first that does not fit."""

    def turns(limit_m: float = math.inf) -> list[_Turn]:
        pairs = zip(angles.tolist(), route.speeds[:-1].tolist(), strict=True)
        return [_turn(a, min(route.radius_m(v), limit_m), v * route.roll_in_s) for a, v in pairs]

    def too_long(tried: list[_Turn], leg: int) -> bool:
        taken = [0.0, *(turn.tangent_m for turn in tried), 0.0]
        return taken[leg] + taken[leg + 1] > float(lengths[leg])

    for i, angle in enumerate(angles.tolist()):
        if abs(angle) > math.radians(179.0):
            raise ConfigError(f"route reverses its course at waypoint {i + 2}, expected a turn of less than 179 deg")
    planned = turns()
    for i in range(len(planned)):
        if not (too_long(planned, i) or too_long(planned, i + 1)):
            continue
        wanted = route.radius_m(float(route.speeds[i]))
        low, high = 0.0, wanted
        for _ in range(40):
            middle = 0.5 * (low + high)
            trial = turns(max(middle, 1e-6))
            low, high = (low, middle) if too_long(trial, i) or too_long(trial, i + 1) else (middle, high)
        fits = (
            f"the largest radius that fits is {math.floor(low)} m" if low >= 1.0 else "rolling in alone takes more room"
        )
        raise ConfigError(
            f"route turn at waypoint {i + 2} with radius {wanted:.0f} m does not fit between its legs: {fits}"
        )
    return planned


def _schedule(
    route: Route, after_turn: FloatArray, length_m: float
) -> tuple[Callable[[FloatArray], tuple[FloatArray, FloatArray]], float]:
    """Distance and speed as a function of time, and the time at the end; speeds change where legs begin."""
    spans: list[tuple[float, float, float]] = []  # duration, speed before and after
    speeds = route.speeds.tolist()
    for i, (start, stop) in enumerate(pairwise([*after_turn.tolist(), length_m])):
        before, speed = speeds[max(i - 1, 0)], speeds[i]
        duration = 1.5 * abs(speed - before) / route.accel_mps2  # 3 u^2 - 2 u^3 is steepest in its middle: 1.5
        needed = 0.5 * (before + speed) * duration
        if needed > stop - start:
            raise ConfigError(
                f"route leg {i + 1} is too short to go from {before:g} to {speed:g} m/s at {route.accel_mps2:g} m/s^2: "
                f"{needed:.0f} m needed, {stop - start:.0f} m there"
            )
        spans += [(duration, before, speed), ((stop - start - needed) / speed, speed, speed)]
    duration_s, before_mps, after_mps = np.array([span for span in spans if span[0] > 0.0]).T
    starts_s = np.concatenate([[0.0], np.cumsum(duration_s)])
    starts_m = np.concatenate([[0.0], np.cumsum(duration_s * 0.5 * (before_mps + after_mps))])

    def travelled(time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        k = np.clip(np.searchsorted(starts_s, time_s, side="right") - 1, 0, duration_s.size - 1)
        u = (time_s - starts_s[k]) / duration_s[k]
        gain = after_mps[k] - before_mps[k]
        distance = starts_m[k] + duration_s[k] * (before_mps[k] * u + gain * _ease_sum(u))
        return np.minimum(distance, length_m), before_mps[k] + gain * _ease(u)

    return travelled, float(starts_s[-1])


def _numbers(key: str, value: ArrayLike) -> FloatArray:
    """A new float64 array, or ConfigError."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"route {key} is {value!r}, expected numbers in rows of one length") from None


def _ease(u: FloatArray) -> FloatArray:
    """From 0 to 1 with level ends."""
    return u * u * (3.0 - 2.0 * u)


def _ease_sum(u: FloatArray) -> FloatArray:
    """Integral of `_ease` from 0."""
    return u**3 * (1.0 - 0.5 * u)


def _integral(at: FloatArray, value: FloatArray, slope: FloatArray) -> FloatArray:
    """Running integral by the trapezoid with its end correction (Euler-Maclaurin), exact for cubics."""
    h = np.diff(at)
    steps = 0.5 * h * (value[1:] + value[:-1]) + h**2 / 12.0 * (slope[:-1] - slope[1:])
    return np.concatenate([[0.0], np.cumsum(steps)])


def _radii(lat_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Meridian and prime-vertical radii of curvature [m]."""
    per_lat, per_lon = metres_per_degree(lat_deg)
    return np.degrees(per_lat), np.degrees(per_lon) / np.cos(np.radians(lat_deg))


def _geographic(plane: Proj, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Longitude and latitude [deg] of plane positions (m, 2)."""
    lon, lat = plane(xy[:, 0], xy[:, 1], inverse=True)
    return np.asarray(lon, dtype=np.float64), np.asarray(lat, dtype=np.float64)


def _plane_about(points: FloatArray) -> Proj:
    """Conformal plane about the middle of the route, on WGS-84."""
    north, east = offset_m(points[0, 0], points[0, 1], points[:, 0], points[:, 1])
    lat, lon = shift(points[0, 0], points[0, 1], 0.5 * (north.min() + north.max()), 0.5 * (east.min() + east.max()))
    return Proj(proj="tmerc", lat_0=float(lat), lon_0=float(lon), ellps="WGS84")

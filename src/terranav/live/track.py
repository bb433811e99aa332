"""The indicated track: where the vehicle's own reckoning puts it, at any time of the last few seconds.

By velocity (or airspeed, heading and wind) the track is the sum of velocities, trapezoid by trapezoid, from a start. By
position it is the vehicle's own position; a leap that no vehicle makes is none of the vehicle's, and left out of the
sum for good, so that the error of the track stays a slow one.

A silence that is longer than allowed leaves more room than the navigator was told of: a `Break` says how much. Over T
seconds between two known velocities an acceleration of at most a leads the vehicle astray by at most a T^2 / 4.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from terranav.core.earth import offset_of, shifted

ACCEL_MPS2 = 5.0  # half of g: what a vehicle may do unseen
_SHARPEST_MPS2, _SLACK_MPS = 60.0, 15.0  # no velocity changes faster
_LEAP_M = 100.0  # no position leaps further beyond its velocity
_CLIMB_MPS, _CLIMB_SLACK_M = 150.0, 60.0
_INSIST_S = 1.0  # who keeps saying the impossible for so long is believed
KEPT_S = 5.0
REACH_S = 0.5  # beyond the newest node the track is drawn out by so much at most
START_SLACK_M = 200.0

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Node:
    """The indicated track at one time."""

    time_s: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    velocity_mps: Triple


@dataclass(frozen=True, slots=True)
class Break:
    """A silence [s], and by how much the track may be off since, per axis [m]."""

    gap_s: float
    spread_m: float


@dataclass(slots=True)
class Track:
    """Built node by node; see the module.

    Attributes
    ----------
    by_position : bool
        Nodes follow the vehicle's positions; else the sum of its velocities.
    max_gap_s, max_speed_mps : float
    nodes : deque of Node
        Of the last seconds, oldest first; empty before the start.
    alt_m : float
        Latest altitude told; NaN before any.
    offset_m : (north, east)
        Leaps left out so far: what the vehicle's position is ahead of the track.
    restarted : bool
        The next node does not follow the last.
    doubtful_s : float
        Nodes since then were made of velocities that hung; NaN when none were [s].
    """

    by_position: bool
    max_gap_s: float
    max_speed_mps: float
    nodes: deque[Node] = field(default_factory=deque)
    alt_m: float = math.nan
    offset_m: tuple[float, float] = (0.0, 0.0)
    restarted: bool = False
    doubtful_s: float = math.nan
    _alt_s: float = math.nan
    _doubt_s: dict[str, float] = field(default_factory=dict)  # what was refused -> since when

    @property
    def newest_s(self) -> float:
        """Time of the newest node."""
        return self.nodes[-1].time_s if self.nodes else -math.inf

    def begin(self, time_s: float, place: tuple[float, float], velocity: Triple) -> None:
        """Start here; whatever was before is forgotten."""
        self.nodes.clear()
        self.offset_m, self.restarted, self.doubtful_s = (0.0, 0.0), False, math.nan
        self.nodes.append(Node(time_s, *place, self.alt_m, velocity))

    def moved(self, lat_deg: float, lon_deg: float) -> None:
        """Put the newest node elsewhere and forget those before: the start of a track after a break."""
        last = self.nodes[-1]
        north, east = offset_of(last.lat_deg, last.lon_deg, lat_deg, lon_deg)
        self.offset_m = self.offset_m[0] - north, self.offset_m[1] - east
        self.nodes.clear()
        self.nodes.append(Node(last.time_s, lat_deg, lon_deg, last.alt_m, last.velocity_mps))

    def altitude(self, time_s: float, alt_m: float) -> str:
        """Hear an altitude; why it is refused, or nothing."""
        if math.isfinite(self.alt_m):
            passed = max(time_s - self._alt_s, 0.0)
            if abs(alt_m - self.alt_m) > _CLIMB_SLACK_M + _CLIMB_MPS * passed and not self._insisted(
                "altitude", time_s
            ):
                return f"altitude leaps from {self.alt_m:.0f} to {alt_m:.0f} m"
        self._doubt_s.pop("altitude", None)
        if not time_s < self._alt_s:
            self.alt_m, self._alt_s = alt_m, time_s
        return ""

    def velocity(self, time_s: float, velocity: Triple) -> tuple[Break | None, str]:
        """Sum up to a velocity; what broke, and why it is refused, or nothing."""
        last = self.nodes[-1]
        step = time_s - last.time_s
        if step <= 0.0:
            return None, ""
        change = math.dist(velocity, last.velocity_mps)
        if math.hypot(*velocity) > self.max_speed_mps:
            return None, f"velocity of {math.hypot(*velocity):.0f} m/s, expected at most {self.max_speed_mps:g} m/s"
        leaps = change > _SLACK_MPS + _SHARPEST_MPS2 * step
        if leaps and not self._insisted("velocity", time_s):
            return None, f"velocity leaps by {change:.0f} m/s in {step:.2f} s"
        self._doubt_s.pop("velocity", None)
        lat, lon = self._carried(last, step, velocity)
        self._append(Node(time_s, lat, lon, self._alt_at(last, time_s, velocity), velocity))
        hung = math.isfinite(self.doubtful_s)
        if step <= self.max_gap_s and not self.restarted and not leaps and not hung:
            return None, ""
        step = max(step, time_s - self.doubtful_s) if hung else step
        self.restarted, self.doubtful_s = False, math.nan
        speed = max(math.hypot(*velocity[:2]), math.hypot(*last.velocity_mps[:2]))
        return Break(step, max(min(0.25 * ACCEL_MPS2 * step**2, speed * step), 1.0)), ""

    def position(self, time_s: float, place: tuple[float, float], velocity: Triple | None) -> tuple[Break | None, str]:
        """Follow the vehicle's position; what broke, and why it is refused, or nothing."""
        last = self.nodes[-1]
        step = time_s - last.time_s
        if step <= 0.0:
            return None, ""
        lat, lon = shifted(*place, -self.offset_m[0], -self.offset_m[1])
        north, east = offset_of(last.lat_deg, last.lon_deg, lat, lon)
        moving = velocity if velocity is not None else (north / step, east / step, 0.0)
        mean = [0.5 * (one + other) for one, other in zip(moving, last.velocity_mps, strict=True)]
        room = _LEAP_M + 0.5 * math.hypot(*mean[:2]) * step + 0.25 * ACCEL_MPS2 * step**2
        leap = math.hypot(north - mean[0] * step, east - mean[1] * step)
        if math.hypot(north, east) > self.max_speed_mps * step + _LEAP_M:
            leap = math.inf
        if leap <= room and not self.restarted:
            self._doubt_s.pop("position", None)
            self._append(Node(time_s, lat, lon, self._alt_at(last, time_s, moving), moving))
            return None, ""
        if not self.restarted and not self._insisted("position", time_s):
            return None, f"position leaps by {math.hypot(north, east):.0f} m in {step:.2f} s"
        self._doubt_s.pop("position", None)
        self.restarted = False
        moving = velocity if velocity is not None else last.velocity_mps
        carried = self._carried(last, step, moving)
        jump = offset_of(*carried, lat, lon)
        self.offset_m = self.offset_m[0] + jump[0], self.offset_m[1] + jump[1]
        self._append(Node(time_s, *carried, self._alt_at(last, time_s, moving), moving))
        speed = math.hypot(*moving[:2])
        return Break(step, max(min(0.25 * ACCEL_MPS2 * step**2, speed * step), 1.0)), ""

    def at(self, time_s: float) -> Node | None:
        """The track at a time: between its nodes, or a little beyond the newest; None where it does not reach."""
        nodes = self.nodes
        if not nodes or not nodes[0].time_s <= time_s <= nodes[-1].time_s + REACH_S:
            return None
        if time_s >= nodes[-1].time_s:
            last = nodes[-1]
            ahead = time_s - last.time_s
            lat, lon = self._carried(last, ahead, last.velocity_mps)
            return Node(time_s, lat, lon, last.alt_m - last.velocity_mps[2] * ahead, last.velocity_mps)
        after = next(i for i, node in enumerate(nodes) if node.time_s > time_s)
        one, other = nodes[after - 1], nodes[after]
        share = (time_s - one.time_s) / (other.time_s - one.time_s)
        north, east = offset_of(one.lat_deg, one.lon_deg, other.lat_deg, other.lon_deg)
        lat, lon = shifted(one.lat_deg, one.lon_deg, share * north, share * east)
        mixed = [a + share * (b - a) for a, b in zip(one.velocity_mps, other.velocity_mps, strict=True)]
        alt = one.alt_m + share * (other.alt_m - one.alt_m)
        return Node(time_s, lat, lon, alt, (mixed[0], mixed[1], mixed[2]))

    def _carried(self, last: Node, step: float, velocity: Triple) -> tuple[float, float]:
        """A node carried on by the mean of its velocity and another."""
        north = 0.5 * (last.velocity_mps[0] + velocity[0]) * step
        east = 0.5 * (last.velocity_mps[1] + velocity[1]) * step
        return shifted(last.lat_deg, last.lon_deg, north, east)

    def _alt_at(self, last: Node, time_s: float, velocity: Triple) -> float:
        """The altitude told, carried on by the climb where it is older."""
        if not math.isfinite(self.alt_m):
            return last.alt_m - 0.5 * (last.velocity_mps[2] + velocity[2]) * (time_s - last.time_s)
        return self.alt_m - velocity[2] * min(max(time_s - self._alt_s, 0.0), self.max_gap_s)

    def _append(self, node: Node) -> None:
        self.nodes.append(node)
        while node.time_s - self.nodes[0].time_s > KEPT_S and len(self.nodes) > 2:
            self.nodes.popleft()

    def _insisted(self, what: str, time_s: float) -> bool:
        """Whether the impossible has been said for long enough to be believed."""
        since = self._doubt_s.setdefault(what, time_s)
        return time_s - since > _INSIST_S

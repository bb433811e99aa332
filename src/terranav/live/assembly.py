"""From what is heard to epochs: readings meet the indicated position and attitude of their own time.

- An altimeter's reading makes an epoch at its own time. It waits until position and attitude have come as far, or for
  `lag_s` at the most; then they are drawn out to it. So what is late by less costs nothing, what is later is left out.
- While nothing is measured there is an epoch every half second, `lag_s` behind the newest.
- The barometer is set to the indicated altitude over the first 5 s (`live.barometer`).
- Of several sensors of one quantity one is heard; a laser before a radar.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

from terranav.core.earth import offset_of
from terranav.core.records import Epoch, Measurement
from terranav.live.barometer import CLIMBED_M, Barometer
from terranav.live.heard import (
    AirData,
    Altitude,
    Attitude,
    Depth,
    Ground,
    Position,
    Pressure,
    Range,
    Velocity,
    Word,
)
from terranav.live.settings import LiveSettings
from terranav.live.sources import Choice, Hang, turned
from terranav.live.track import KEPT_S, REACH_S, START_SLACK_M, Break, Node, Track

IDLE_S = 0.5  # between epochs while nothing is measured
OLD_S = 2.0  # the latest heading, airspeed, ... is used for so long
_TOGETHER_S = 0.02  # readings of one epoch
_RANKS = {"GLOBAL_POSITION_INT": 0, "SCALED_PRESSURE": 0, "HIGHRES_IMU": 1, "LOCAL_POSITION_NED": 1, "VBW": 1}
_LAST_RANK = 2
#: velocities are summed up, so that one that hangs does harm soon: the same for a while as the nose turns is enough
_VEERED_DEG, _VELOCITY_HANGS_S = 5.0, 2.0
_SLOW_MPS = 2.0  # below it a course says nothing
_MOST_PENDING, _MOST_SENSORS = 200, 64
_MOVED_M, _TURNED_DEG = 50.0, 20.0  # what a sensor that does not hang must notice

Angles = tuple[float, float, float]


class _Angle(NamedTuple):
    time_s: float
    angles: Angles
    whole: bool


@dataclass(slots=True)
class Assembly:
    """Hears words, gives epochs. All of it is plain data that pickles.

    Attributes
    ----------
    settings : LiveSettings
    track : Track
    barometer : Barometer
    last_epoch_s : float
        Time of the latest epoch.
    broken : Break or None
        What the track broke by since the latest epoch; who reads it clears it.
    notes : list of (key, text)
        What was refused, and why; who reads them clears them.
    counts : dict
        Readings used, late, thinned.
    heard_s : dict
        When each sensor last said something that can be used [s].
    """

    settings: LiveSettings
    track: Track = field(init=False)
    barometer: Barometer = field(init=False)
    last_epoch_s: float = -math.inf
    broken: Break | None = None
    notes: list[tuple[str, str]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    _attitudes: deque[_Angle] = field(default_factory=deque)
    _air: tuple[float, AirData] | None = None
    _pending: list[tuple[float, Measurement]] = field(default_factory=list)
    _first: tuple[float, float, float] | None = None
    _velocity: tuple[float, tuple[float, float, float]] | None = None
    heard_s: dict[str, float] = field(default_factory=dict)
    _odometer_m: float = 0.0
    _heading_deg: float = math.nan
    _course_deg: float = math.nan
    _choices: dict[str, Choice] = field(default_factory=dict)
    _hangs: dict[str, Hang] = field(default_factory=dict)

    def __post_init__(self) -> None:
        told = self.settings
        self.barometer = Barometer(Hang(told.frozen_s, CLIMBED_M))
        self.track = Track(told.ins_source == "position", told.max_gap_s, told.max_speed_mps)

    @property
    def started(self) -> bool:
        """Whether there is a track."""
        return bool(self.track.nodes)

    def hear(self, time_s: float, word: Word) -> None:
        """Hear one word of a time [s]."""
        if isinstance(word, Position):
            self._hear_position(time_s, word)
        elif isinstance(word, Velocity):
            if self._choice("velocity", 1.0).hears(word.source, time_s, _RANKS.get(word.source, _LAST_RANK)):
                self._hear_velocity(time_s, (word.north_mps, word.east_mps, word.down_mps))
        elif isinstance(word, Attitude):
            self._hear_attitude(time_s, word)
        elif isinstance(word, Pressure):
            self._hear_pressure(time_s, word)
        elif isinstance(word, Range):
            self._hear_range(time_s, word)
        elif isinstance(word, Altitude):
            if self._choice("altitude", OLD_S).hears("apart", time_s, 1):
                self._refused("altitude", self.track.altitude(time_s, word.alt_m))
        elif isinstance(word, AirData):
            self._air = time_s, word
        elif isinstance(word, Ground):
            self._hear_ground(time_s, word)
        elif isinstance(word, Depth):
            self._alive("echo sounder", time_s)
            if not word.from_surface:
                text = "the depth of the transducer is not told: depths count from it, not from the surface"
                self._refused("depth of transducer", text)
            self._read(time_s, Measurement("bathymetry", -word.depth_m, self.settings.sigma_of("depth_m")))

    def missing(self) -> str:
        """What a track needs and has not been told, in words."""
        needs = {
            "a position, or to be told the start": self._first is None and self.settings.start_deg is None,
            "an altitude": not math.isfinite(self.track.alt_m),
            "a velocity": self.settings.ins_source == "velocity" and self._velocity is None,
            "an airspeed": self.settings.ins_source == "airspeed" and self._air is None,
            "a heading": self.settings.ins_source == "airspeed" and not self._attitudes,
        }
        return ", ".join(need for need, lacks in needs.items() if lacks) or "two positions that agree"

    def epochs(self, newest_s: float) -> list[Epoch]:
        """The epochs that can be made now, `newest_s` being the latest time that was heard."""
        made: list[Epoch] = []
        if not self.started:
            return made
        while self._pending:
            time_s = self._pending[0][0]
            if not self._waited(time_s, newest_s):
                break
            node = self.track.at(time_s)
            if node is None:
                if newest_s - time_s <= OLD_S and time_s > self.track.nodes[0].time_s:
                    break
                self._pending.pop(0)
                self._count("readings without position")
                continue
            near = [one for one in self._pending if one[0] - time_s <= _TOGETHER_S]
            del self._pending[: len(near)]
            made.append(self._epoch(node, tuple({one.kind: one for _, one in near}.values())))
            self._count("readings used", len(near))
        idle_s = newest_s - self.settings.lag_s
        if not self._pending and idle_s - self.last_epoch_s >= IDLE_S:
            node = self.track.at(min(idle_s, self.track.newest_s))
            if node is not None and node.time_s - self.last_epoch_s >= IDLE_S:
                made.append(self._epoch(node, ()))
        return made

    def restart_clock(self) -> None:
        """The sender started again: what was measured before is not followed by what comes."""
        self.track.restarted = True
        self._pending.clear()
        self._attitudes.clear()
        self.barometer.forget()
        self._air = self._velocity = None

    def _waited(self, time_s: float, newest_s: float) -> bool:
        """Whether a reading of this time has what it needs, or waited long enough."""
        if newest_s - time_s >= self.settings.lag_s:
            return True
        turned_s = self._attitudes[-1].time_s if self._attitudes else math.inf
        return self.track.newest_s >= time_s and turned_s >= time_s

    def _epoch(self, node: Node, readings: tuple[Measurement, ...]) -> Epoch:
        """The epoch of a time."""
        self.last_epoch_s = node.time_s
        value = self.barometer.at(node.time_s, node.alt_m)
        if value is not None:
            readings = (*readings, Measurement("baro_altitude", value, self.settings.sigma_of("baro_altitude_m")))
        attitude = self._attitude_at(node.time_s)
        return Epoch(node.time_s, node.lat_deg, node.lon_deg, node.alt_m, node.velocity_mps, attitude, tuple(readings))

    def _attitude_at(self, time_s: float) -> Angles | None:
        """Attitude between the two that were told next, or the latest for a while; None where roll or pitch is not."""
        angles = self._attitudes
        if not angles or not angles[-1].whole or time_s - angles[-1].time_s > REACH_S:
            return None
        after = next((i for i, one in enumerate(angles) if one.time_s >= time_s), None)
        if after is None or after == 0:
            near = angles[-1 if after is None else 0]
            return near.angles if abs(near.time_s - time_s) <= REACH_S else None
        one, other = angles[after - 1], angles[after]
        share = (time_s - one.time_s) / (other.time_s - one.time_s)
        roll, pitch, heading = (
            a + share * ((b - a + 180.0) % 360.0 - 180.0) for a, b in zip(one.angles, other.angles, strict=True)
        )
        return (roll + 180.0) % 360.0 - 180.0, pitch, heading % 360.0

    def _hear_position(self, time_s: float, word: Position) -> None:
        if word.alt_m is not None and self._choice("altitude", OLD_S).hears("position", time_s, 0):
            self._refused("altitude", self.track.altitude(time_s, word.alt_m))
        place = word.lat_deg, word.lon_deg
        if not self.started:
            self._begin(time_s, place)
        elif self.track.by_position:
            if self._hang("position", _MOVED_M).hangs(place, time_s, self._odometer_m):
                self._refused("position hangs", "the vehicle's position does not change although it moves")
                return
            fresh = self._velocity is not None and time_s - self._velocity[0] <= OLD_S
            velocity = self._velocity[1] if fresh and self._velocity is not None else None
            self._follow(*self.track.position(time_s, place, velocity), "position")

    def _begin(self, time_s: float, place: tuple[float, float]) -> None:
        """Start where two positions in a row agree, or where the user said."""
        before, self._first = self._first, (time_s, *place)
        if before is None or not math.isfinite(self.track.alt_m):
            return
        passed = time_s - before[0]
        away = math.hypot(*offset_of(*before[1:], *place))
        if 0.0 < passed <= 10.0 and away <= START_SLACK_M + self.settings.max_speed_mps * passed:
            velocity = self._velocity[1] if self._velocity is not None else None
            if self.settings.ins_source == "airspeed":
                fresh = self._air is not None and self._attitudes
                velocity = self._by_air(self._heading_deg, self._air[1]) if fresh and self._air is not None else None
            if velocity is None and not self.track.by_position:
                return
            told = self.settings.start_deg if not self.track.by_position else None
            self.track.begin(time_s, told or place, velocity or (0.0, 0.0, 0.0))

    def _hear_velocity(self, time_s: float, velocity: tuple[float, float, float]) -> None:
        speed = math.hypot(*velocity[:2])
        if self._velocity is not None and 0.0 < time_s - self._velocity[0] <= OLD_S:
            self._odometer_m += speed * (time_s - self._velocity[0])
        if self._velocity is None or time_s > self._velocity[0]:
            self._velocity = time_s, velocity
        hang = self._hang("velocity", _VEERED_DEG, _VELOCITY_HANGS_S)
        if hang.hangs(velocity, time_s, self._heading_deg) and speed > _SLOW_MPS:
            if not math.isfinite(self.track.doubtful_s):
                self.track.doubtful_s = hang.since_s
            self._refused("velocity hangs", "the vehicle's velocity does not change although it turns")
            return
        self._alive("velocity", time_s)
        if self.settings.ins_source == "velocity":
            self._reckon(time_s, velocity)

    def _reckon(self, time_s: float, velocity: tuple[float, float, float]) -> None:
        """Carry the track on by a velocity, from the told start if it is the first."""
        if self.started:
            self._follow(*self.track.velocity(time_s, velocity), "velocity")
        elif self.settings.start_deg is not None and math.isfinite(self.track.alt_m):
            self.track.begin(time_s, self.settings.start_deg, velocity)

    def _hear_ground(self, time_s: float, word: Ground) -> None:
        """Speed over ground along the ship, turned by its heading."""
        if not self._attitudes or abs(time_s - self._attitudes[-1].time_s) > OLD_S:
            return
        heading = math.radians(self._attitudes[-1].angles[2])
        north = word.along_mps * math.cos(heading) - word.across_mps * math.sin(heading)
        east = word.along_mps * math.sin(heading) + word.across_mps * math.cos(heading)
        self.hear(time_s, Velocity(north, east, 0.0, "VBW"))

    def _hear_attitude(self, time_s: float, word: Attitude) -> None:
        angles = word.roll_deg or 0.0, word.pitch_deg or 0.0, word.heading_deg
        if self._attitudes and time_s <= self._attitudes[-1].time_s:
            return
        if self._attitude_hangs(time_s, angles):
            return
        self._alive("attitude", time_s)
        self._heading_deg = turned(self._heading_deg, word.heading_deg)
        self._attitudes.append(_Angle(time_s, angles, word.roll_deg is not None and word.pitch_deg is not None))
        while time_s - self._attitudes[0].time_s > KEPT_S:
            self._attitudes.popleft()
        if self.settings.ins_source == "airspeed" and self._air is not None and time_s - self._air[0] <= OLD_S:
            self._reckon(time_s, self._by_air(word.heading_deg, self._air[1]))

    def _attitude_hangs(self, time_s: float, angles: Angles) -> bool:
        """Whether the attitude stays as it is although the vehicle's course over ground turns."""
        velocity = self._velocity
        if velocity is not None and time_s - velocity[0] <= OLD_S and math.hypot(*velocity[1][:2]) > _SLOW_MPS:
            course = math.degrees(math.atan2(velocity[1][1], velocity[1][0]))
            self._course_deg = turned(self._course_deg, course)
        if not self._hang("attitude", _TURNED_DEG).hangs(angles, time_s, self._course_deg):
            return False
        self._refused("attitude hangs", "the vehicle's attitude does not change although it turns")
        return True

    def _by_air(self, heading_deg: float, air: AirData) -> tuple[float, float, float]:
        """Velocity over ground by airspeed, heading and wind; true airspeed by the standard atmosphere's density."""
        speed = air.speed_mps
        if air.calibrated and math.isfinite(self.track.alt_m):
            share = max(1.0 - min(self.track.alt_m, 11000.0) / 44330.77, 0.1)
            speed /= math.sqrt(share**4.2559)
        heading = math.radians(heading_deg)
        north, east = self.settings.wind_mps
        north += speed * math.cos(heading) - air.across_mps * math.sin(heading)
        east += speed * math.sin(heading) + air.across_mps * math.cos(heading)
        down = self._velocity[1][2] if self._velocity is not None else 0.0
        return north, east, down

    def _hear_pressure(self, time_s: float, word: Pressure) -> None:
        if not self._choice("pressure", OLD_S).hears(word.source, time_s, _RANKS.get(word.source, _LAST_RANK)):
            return
        node = self.track.at(time_s)
        if node is None:
            return
        done = self.barometer.hear(time_s, word.source, word.altitude_m, node.alt_m)
        if done == "hangs":
            self._refused("barometer hangs", f"{word.source} repeats one pressure although the vehicle climbs or sinks")
        elif done == "heard":
            self._alive("barometer", time_s)

    def _hear_range(self, time_s: float, word: Range) -> None:
        if word.range_m is None:
            self._count("ranges out of reach")
            return
        if self._hang(word.sensor, _MOVED_M).hangs((word.range_m,), time_s, self._odometer_m):
            self._refused(
                "altimeter hangs",
                f"{word.sensor} repeats {word.range_m:g} m although the vehicle moves; its readings are left out",
            )
            return
        self._alive("altimeter", time_s)
        if not self._choice("range", OLD_S).hears(word.sensor, time_s, 0 if word.kind == "laser" else 1):
            return
        sigma = self.settings.sigma_of(f"{word.kind}_altitude_m")
        self._read(time_s, Measurement(f"{word.kind}_altitude", word.range_m, sigma))

    def _read(self, time_s: float, reading: Measurement) -> None:
        """Keep a reading until its epoch is made."""
        step_s = 1.0 / (1.5 * self.settings.rate_hz)
        if time_s <= self.last_epoch_s + 1e-9:
            self._count("readings late")
        elif (
            len(self._pending) >= _MOST_PENDING
            or time_s - self.last_epoch_s < step_s
            or any(kept.kind == reading.kind and abs(at - time_s) < step_s for at, kept in self._pending)
        ):
            self._count("readings thinned")
        else:
            self._pending.append((time_s, reading))
            self._pending.sort(key=lambda one: one[0])

    def _follow(self, broken: Break | None, refused: str, what: str) -> None:
        """What a new node of the track brings with it."""
        self._refused(what, refused)
        if broken is not None:
            self.broken = broken
            since = self.track.newest_s
            self._pending = [one for one in self._pending if one[0] >= since]

    def _alive(self, sensor: str, time_s: float) -> None:
        self.heard_s[sensor] = max(time_s, self.heard_s.get(sensor, -math.inf))

    def _choice(self, what: str, silent_s: float) -> Choice:
        return self._choices.setdefault(what, Choice(silent_s))

    def _hang(self, what: str, change: float, after_s: float | None = None) -> Hang:
        if len(self._hangs) >= _MOST_SENSORS and what not in self._hangs:
            self._hangs.pop(next(iter(self._hangs)))
        return self._hangs.setdefault(what, Hang(self.settings.frozen_s if after_s is None else after_s, change))

    def _refused(self, key: str, text: str) -> None:
        if text:
            self.notes.append((key, text))

    def _count(self, what: str, number: int = 1) -> None:
        self.counts[what] = self.counts.get(what, 0) + number

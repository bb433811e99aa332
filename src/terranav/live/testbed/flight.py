"""One flight, tick by tick: packets out, fixes in; no clock, no socket, no file."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator
from typing import Any, NamedTuple

import numpy as np

from terranav.core.errors import StateError
from terranav.core.recording import Recording
from terranav.live.signing import Checker
from terranav.live.testbed.aircraft import STEP_HZ, Aircraft
from terranav.live.testbed.autopilot import Autopilot, Felt
from terranav.live.testbed.course import plan_course
from terranav.live.testbed.fusion import Fix
from terranav.live.testbed.guidance import Guidance
from terranav.live.testbed.inbox import Inbox
from terranav.live.testbed.navigation import Known, Navigation
from terranav.live.testbed.records import Rows
from terranav.live.testbed.score import Score
from terranav.live.testbed.senses import RATE_HZ, Ground, Ranges, winds
from terranav.live.testbed.settings import FlightSettings
from terranav.live.testbed.telemetry import Telemetry, Told, signing_stamp
from terranav.maps.map import Map

_TICK_US = 1_000_000 // RATE_HZ
_STEERED = 4  # times a tick


class Sent(NamedTuple):
    """One frame that the vehicle sends, and when [us since 1970]."""

    time_us: int
    data: bytes


class Flight:
    """An aircraft that flies a course by its own navigation.

    Iterate over it for what it sends: `for time_us, data in flight`. Bytes that are meant for it go to `take` at any
    time in between; they act from the next tick on. Same settings, same map and same bytes taken at the same ticks give
    the same packets, to the bit.

    Parameters
    ----------
    chart : Map
        Of terrain, to fly over.
    settings : FlightSettings, optional
    record : bool
        Keep truth and readings of every tick, for `recording`.

    Raises
    ------
    DataError
        The map cannot be flown over.
    ConfigError
        jsbsim or pymavlink is not installed.
    """

    def __init__(self, chart: Map, settings: FlightSettings | None = None, *, record: bool = False) -> None:
        told = FlightSettings() if settings is None else settings
        self.settings, self.chart = told, chart
        self.ticks = round(told.duration_s * RATE_HZ) + 1
        route, ground, radar, barometer, gnss, ins, air = (
            np.random.default_rng(child) for child in np.random.SeedSequence(told.seed).spawn(7)
        )
        length = told.duration_s * (told.airspeed_mps + 1.3 * told.wind_mps) + 2000.0
        self.course = plan_course(chart, length, told.clearance_m, route)
        self._ground = Ground(chart, ground)
        self._ranges = Ranges(told.altimeter, self.ticks, radar)
        self.navigation = Navigation(told, self.ticks, ins=ins, gnss=gnss, barometer=barometer)
        self._wind = winds(told, self.ticks, air)
        self._guidance = Guidance(self.course, told.airspeed_mps)
        start, height = self.course.places[0], self.course.height(0.0)[0]
        self._aircraft = Aircraft(*start, height, self.course.leg(0, start)[0], told.airspeed_mps)
        self._autopilot = Autopilot(self._aircraft.trim_pitch_deg, self._aircraft.trim_throttle)
        self.truth = self._aircraft.state
        self.score = Score(math.ceil(told.duration_s))
        self.telemetry = Telemetry(told, (*start, height), self._ranges.limits_m)
        checker = None if told.sign_key is None else Checker(told.sign_key, self._signing_now)
        self.inbox = Inbox(self.telemetry, self, self.course, told.autopilot, start, told.start_us, checker)
        self._tick = 0
        self._known: Known | None = None
        self._told: Told | None = None
        self._rows = Rows() if record else None

    def __iter__(self) -> Iterator[Sent]:
        while not self.over:
            yield from self.tick()

    @property
    def over(self) -> bool:
        """Whether the flight is at its end."""
        return self._tick >= self.ticks

    @property
    def time_us(self) -> int:
        """Of the last tick, since the start of the flight [us]."""
        return max(self._tick - 1, 0) * _TICK_US

    def tick(self) -> list[Sent]:
        """Fly a tenth of a second and return what the vehicle sends at its end; nothing after the last."""
        if self.over:
            return []
        if self._tick:
            self._fly()
        self._told = self._sense()
        self._tick += 1
        date = self.settings.start_us + self.time_us
        # answers were packed before: counters and stamps of signatures only rise, as a receiver insists
        return [*self.answers(), *(Sent(date, frame) for frame in self.telemetry.due(self._told))]

    def answers(self) -> list[Sent]:
        """What the vehicle answers to what it took since the last tick; `tick` gives that too."""
        return [Sent(self.settings.start_us + self.time_us, frame) for frame in self.inbox.answers()]

    def take(self, data: bytes, peer: Hashable = 0) -> None:
        """Bytes for the vehicle, whole frames or parts of them; those of different peers are not joined."""
        self.inbox.take(data, peer)

    @property
    def reckons_dead(self) -> bool:
        """Whether neither GNSS nor a fix was used for five seconds."""
        return self.navigation.reckons_dead

    def fuse(self, fix: Fix) -> bool:
        """Give a fix to the vehicle's filter; False where it is not used."""
        return self.navigation.fuse(fix)

    def message(self, name: str) -> bytes | None:
        """A message of telemetry as of the last tick; None for one that the vehicle does not have."""
        return self.telemetry.one(name, self._told) if self._told is not None else None

    @property
    def own_error_m(self) -> float:
        """How far the vehicle's own position is off at the last tick; NaN before the first [m]."""
        return math.nan if self._known is None else self.navigation.errors_m(self._known, self.truth)[0]

    def facts(self) -> dict[str, Any]:
        """How it goes, or went: numbers and counts for a summary; errors since GNSS was lost or went wrong [m]."""
        told, navigation = self.settings, self.navigation
        since = min(told.gnss_off_s, told.jam_at_s, told.spoof_at_s)
        since = since if since < self.time_us * 1e-6 else 0.0
        own, without, across = (self.score.of(name, since) for name in ("own", "without", "across"))
        return {
            "flown_s": self.time_us * 1e-6,
            "since_s": since,
            "own_p95_m": own.p95_m,
            "own_max_m": own.max_m,
            "own_last_m": own.last_m,
            "without_fixes_p95_m": without.p95_m,
            "without_fixes_last_m": without.last_m,
            "off_track_p95_m": across.p95_m,
            "off_track_last_m": across.last_m,
            "lowest_m": self.score.lowest_m,
            "gnss": self._told is not None and self._told.gnss is not None,
            "fixes_used": navigation.used,
            "fixes_rejected": navigation.rejected,
            "fix_resets": navigation.resets,
            "heard": dict(self.inbox.heard),
            "ignored": dict(self.inbox.ignored),
        }

    def recording(self) -> Recording:
        """Truth, free INS and readings so far; StateError for a flight that was not recorded."""
        if self._rows is None:
            raise StateError("the flight was not recorded, expected Flight(..., record=True)")
        return self._rows.recording(self.settings, self.chart)

    def _signing_now(self) -> int:
        return signing_stamp(self.settings.start_us + self.time_us)

    def _fly(self) -> None:
        """The aircraft through one tick, steered by what the vehicle believes."""
        known, told = self._known, self._told
        assert known is not None
        assert told is not None
        self._aircraft.blow(*self._wind[self._tick - 1].tolist())
        wrong = [known.own.velocity_mps[i] - self.truth.velocity_mps[i] for i in (0, 1)]
        wrong_alt = known.alt_m - self.truth.alt_m
        wanted = self._guidance.wanted(known.own, known.alt_m, told.range_m)
        for _ in range(_STEERED):
            now = self._aircraft.state
            v = (now.velocity_mps[0] + wrong[0], now.velocity_mps[1] + wrong[1], now.velocity_mps[2])
            felt = Felt(v, now.attitude_deg, now.rates_radps, now.alt_m + wrong_alt, now.airspeed_mps)
            self._aircraft.steer(*self._autopilot.controls(wanted, felt, 1.0 / (RATE_HZ * _STEERED)))
            self._aircraft.step(STEP_HZ // (RATE_HZ * _STEERED))
        self.truth = self._aircraft.state

    def _sense(self) -> Told:
        """All sensors at this tick, and what the vehicle makes of them."""
        tick, truth = self._tick, self.truth
        known = self.navigation.step(tick, truth)
        clearance = truth.alt_m - self._ground.height(truth.lat_deg, truth.lon_deg)
        shown = known.own if self.settings.reports == "own" else known.ins
        told = Told(
            tick * _TICK_US,
            shown,
            known.alt_m,
            *self.navigation.inertial.sensed(truth),
            known.pressure_alt_m,
            self._ranges.read(tick, clearance),
            known.gnss,
            known.gnss_fresh,
            truth,
        )
        self._known = known
        if tick % RATE_HZ == 0:
            off_track = self._guidance.off_track_m(truth.lat_deg, truth.lon_deg)
            self.score.add(tick / RATE_HZ, *self.navigation.errors_m(known, truth), off_track, clearance)
        if self._rows is not None:
            self._rows.add(tick / RATE_HZ, known, told, truth)
        return told

"""Where fixes go: each output takes every fix, lets the gate decide, and counts what it sent and what it held, and why.

Rates unless told otherwise: GLOBAL_POSITION_SENSOR 1 Hz, ODOMETRY and GPS_INPUT 5 Hz (ArduPilot asks for 4 Hz or more),
resets every 10 s, NMEA 1 Hz, JSON every fix. Where the engine gives fewer fixes than ODOMETRY needs, the last one is
carried on by its velocity, within the age limit.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Protocol

from terranav.core.errors import ConfigError
from terranav.live.autopilot import Autopilot
from terranav.live.mavlink_out import Encoder
from terranav.live.nmea_out import sentences
from terranav.live.outgoing import Offer, Pace, offer
from terranav.live.recorder import as_line, gnss_of
from terranav.live.records import Fix
from terranav.live.wires import Wire

#: message to send -> fixes a second
RATES_HZ = {"px4": 1.0, "ardupilot": 5.0, "gps-input": 5.0, "reset": 0.1}
RESET_MAX_AGE_S = 5.0
_BEAT_US = 1_000_000
_ASK_US = 5_000_000

#: is told which output sent what, and when
Sent = Callable[[str, int, bytes], None]


class Output(Protocol):
    """One place that fixes go to.

    Attributes
    ----------
    name : str
        As typed.
    sent : int
    held : Counter
        Reasons, and how often.
    """

    name: str
    sent: int
    held: Counter[str]

    def send(self, fix: Fix, now_us: int) -> bool:
        """Take one fix; whether anything of it left."""
        ...

    def tick(self, now_us: int) -> None:
        """Do what is due without a fix: heartbeats, questions."""
        ...

    def close(self) -> None:
        """Write what is left."""
        ...


class MavlinkOutput:
    """Fixes to an autopilot.

    Parameters
    ----------
    name : str
    wire : callable
        Gives the wire to send over, None while there is none.
    autopilot : Autopilot
    encoder : Encoder
    what : str, optional
        A key of RATES_HZ; else what the autopilot takes.
    max_age_s : float
    rate_hz : float, optional
        Instead of the one of RATES_HZ.
    correlation_s : float
        See `Pace`.
    on_sent : callable
    """

    def __init__(
        self,
        name: str,
        wire: Callable[[], Wire | None],
        autopilot: Autopilot,
        encoder: Encoder,
        *,
        what: str | None,
        max_age_s: float,
        rate_hz: float | None,
        correlation_s: float,
        on_sent: Sent,
    ) -> None:
        self.name, self.sent, self.held = name, 0, Counter[str]()
        self._wire, self._autopilot, self._encoder, self._on_sent = wire, autopilot, encoder, on_sent
        self._what, self._max_age_s, self._rate_hz = what, max_age_s, rate_hz
        self._correlation_s = correlation_s
        self._pace: Pace | None = None
        self._beat_us = self._ask_us = -_ASK_US
        self._newest: Offer | None = None
        self._newest_us = 0

    @property
    def what(self) -> str | None:
        """What is sent, None where that is not known."""
        kind = self._autopilot.kind
        return self._what or (kind if kind in RATES_HZ else None)

    def send(self, fix: Fix, now_us: int) -> bool:
        """Offer a fix to the autopilot."""
        what = self.what
        if what is None or self._autopilot.system is None:
            self.held["no autopilot heard" if self._autopilot.kind is None else "autopilot not known"] += 1
            return False
        made = offer(fix, now_us, RESET_MAX_AGE_S if what == "reset" else self._max_age_s)
        if isinstance(made, str):
            self.held[made] += 1
            return False
        self._newest, self._newest_us = made, now_us
        return self._paced(what, made, now_us)

    def _paced(self, what: str, made: Offer, now_us: int) -> bool:
        """Send an offer if one is due."""
        if self._pace is None:
            self._pace = Pace(self._rate_hz or RATES_HZ[what], self._correlation_s)
        if not self._pace.due(made.stamp_us):
            self.held["sent a moment ago"] += 1
            return False
        reason = self._lacking(what, made)
        if reason:
            self.held[reason] += 1
            return False
        if not self._write(self._encoded(what, made.widened(self._pace.taken(made.stamp_us))), now_us):
            self.held["nobody is connected"] += 1
            return False
        self.sent += 1
        return True

    def _lacking(self, what: str, made: Offer) -> str:
        """What this message needs and has not, empty for nothing."""
        if what != "ardupilot":
            return ""
        if self._autopilot.origin is None:
            return "origin of the autopilot not known"
        return "" if made.attitude_deg is not None else "no attitude"

    def _encoded(self, what: str, made: Offer) -> bytes:
        """The message."""
        target = self._autopilot.system or 1
        self._encoder.system = target
        if what == "px4":
            return self._encoder.global_position(made)
        if what == "gps-input":
            return self._encoder.gps_input(made)
        if what == "reset":
            return self._encoder.reset(made, target)
        assert self._autopilot.origin is not None
        return self._encoder.odometry(made, self._autopilot.origin)

    def _write(self, frame: bytes, now_us: int) -> bool:
        wire = self._wire()
        if wire is None or not wire.write(frame):
            return False
        self._on_sent(self.name, now_us, frame)
        return True

    def tick(self, now_us: int) -> None:
        """Heartbeat, the question for the origin, the answer to a question for our time, a fix carried on."""
        if self._autopilot.system is None:
            return
        self._encoder.system = self._autopilot.system
        if not 0 <= now_us - self._beat_us < _BEAT_US:
            self._beat_us = now_us
            self._write(self._encoder.heartbeat(), now_us)
        what = self.what
        asks = what == "ardupilot" and not self._autopilot.told_origin
        if asks and not 0 <= now_us - self._ask_us < _ASK_US:
            self._ask_us = now_us
            self._write(self._encoder.origin_request(self._autopilot.system), now_us)
        self._answer_time(now_us)
        if what == "ardupilot" and self._newest is not None and self._pace is not None:
            carried = self._newest.carried(now_us - self._newest_us, self._max_age_s)
            if carried is not None and self._pace.due(carried.stamp_us):
                self._paced(what, carried, now_us)

    def _answer_time(self, now_us: int) -> None:
        """The vehicle's own time, as the newest fix has it: the clock that the stamps of our messages count on."""
        asked, self._autopilot.asked_ns = self._autopilot.asked_ns, []
        if self._newest is None:
            return
        ahead_us = 0 if self._newest.boot_us is None else self._newest.boot_us - self._newest.stamp_us
        for asked_ns in asked:
            self._write(self._encoder.timesync(now_us + ahead_us, asked_ns), now_us)

    def close(self) -> None:
        """Nothing is left to write."""


class NmeaOutput:
    """GGA and RMC over a wire."""

    def __init__(self, name: str, wire: Wire, *, max_age_s: float, rate_hz: float | None, on_sent: Sent) -> None:
        self.name, self.sent, self.held = name, 0, Counter[str]()
        self._wire, self._max_age_s, self._on_sent = wire, max_age_s, on_sent
        self._pace = Pace(rate_hz or 1.0, 0.0)

    def send(self, fix: Fix, now_us: int) -> bool:
        """Write the sentences of a fix."""
        made = offer(fix, now_us, self._max_age_s)
        if isinstance(made, str) or not self._pace.due(made.stamp_us):
            self.held[made if isinstance(made, str) else "sent a moment ago"] += 1
            return False
        lines = sentences(made)
        if not self._wire.write(lines):
            self.held["nobody is connected"] += 1
            return False
        self._pace.taken(made.stamp_us)
        for line in lines.splitlines():
            self._on_sent(self.name, now_us, line)
        self.sent += 1
        return True

    def tick(self, now_us: int) -> None:
        """Nothing is due."""

    def close(self) -> None:
        """Nothing is left to write."""


class JsonOutput:
    """A line of JSON for every fix: with the position where it may leave, else with the reasons alone.

    Parameters
    ----------
    name : str
    write : callable
        Takes one line; whether anybody got it.
    max_age_s : float
    close : callable, optional
    """

    def __init__(
        self, name: str, write: Callable[[bytes], bool], *, max_age_s: float, close: Callable[[], None] | None = None
    ) -> None:
        self.name, self.sent, self.held = name, 0, Counter[str]()
        self._write, self._max_age_s, self._close = write, max_age_s, close

    def send(self, fix: Fix, now_us: int) -> bool:
        """Write the line of a fix."""
        made = offer(fix, now_us, self._max_age_s)
        if isinstance(made, str):
            self.held[made] += 1
            told = {"stamp_us": fix.stamp_us, "usable": False, "status": str(fix.estimate.status)}
            self._write(as_line({**told, "withheld": list(fix.withheld) or [made], **gnss_of(fix)}))
            return False
        if not self._write(as_line({**position(made), **gnss_of(fix)})):
            self.held["nobody is connected"] += 1
            return False
        self.sent += 1
        return True

    def tick(self, now_us: int) -> None:
        """Nothing is due."""

    def close(self) -> None:
        """Close what is written to."""
        if self._close is not None:
            self._close()


def position(made: Offer) -> dict[str, object]:
    """What a JSON output says of a fix."""
    return {
        "stamp_us": made.stamp_us,
        "boot_us": made.boot_us,
        "age_ms": round(made.age_us / 1000.0, 3),
        "usable": True,
        "status": made.status,
        "lat_deg": made.lat_deg,
        "lon_deg": made.lon_deg,
        "alt_m": made.alt_m,
        "sigma_m": made.sigma_m,
        "protection_m": made.protection_m,
        "velocity_mps": made.velocity_mps,
        "attitude_deg": made.attitude_deg,
    }


def json_file(name: str, path: Path | None, max_age_s: float) -> JsonOutput:
    """JSON lines into a file that begins anew, or to stdout for None; ConfigError where it cannot be written."""
    if path is None:
        return JsonOutput(name, _line_to(sys.stdout.buffer), max_age_s=max_age_s)
    try:
        file = path.open("wb")
    except OSError as problem:
        raise ConfigError(f"--out {name}: {path} cannot be written ({problem.strerror})") from None
    return JsonOutput(name, _line_to(file), max_age_s=max_age_s, close=file.close)


def _line_to(file: BinaryIO) -> Callable[[bytes], bool]:
    """A writer that says whether a line was taken; a reader that went away or a full disk costs the line alone."""

    def write(line: bytes) -> bool:
        try:
            file.write(line)
            file.flush()
        except (OSError, ValueError):
            return False
        return True

    return write

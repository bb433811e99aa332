"""One MAVLink frame into what it says; decoded by pymavlink, meanings and scales as in `terranav.io.logs.tlog`.

Beyond the messages that are read there:

- LOCAL_POSITION_NED: vx, vy, vz [m/s]. VFR_HUD: airspeed [m/s, calibrated]; it has no time of its own.
- ALTITUDE: altitude_amsl [m, above mean sea level], altitude_monotonic [m, by the barometer]. HIGHRES_IMU: pressure_alt
  [m], where fields_updated says so.
- SYSTEM_TIME: time_unix_usec. Times in microseconds count from the start-up, or from 1970: these are no boot clock.

A field that is not finite, or that no vehicle on Earth can have, is left out and named.
"""

from __future__ import annotations

import importlib
import math
import struct
from collections.abc import Callable, Iterator
from typing import Any

from terranav.core.errors import ConfigError
from terranav.core.recording import LIMITS
from terranav.io.logs.found import pressure_altitude_m
from terranav.io.logs.opening import STAMPS_US
from terranav.live.heard import (
    AirData,
    Altitude,
    Attitude,
    Beat,
    Gnss,
    Heard,
    Position,
    Pressure,
    Range,
    UnixTime,
    Velocity,
    Word,
)

MARKERS = (0xFE, 0xFD)
_DOWN = 25
_ROLES = {0: "laser", 1: "radar", 2: "laser", 3: "radar"}
_GROUND_STATION, _NO_AUTOPILOT = 6, 8
_UPDATED_PRESSURE_ALT = 1 << 11
_UNKNOWN_16, _UNKNOWN_32 = 0xFFFF, 0x7FFFFFFF
_INVALID_SIGNAL = 1
_FASTEST_MPS, _LEAST_HPA, _MOST_HPA = 1000.0, 1.0, 1200.0

Reader = Callable[[Any, "_Fields"], Iterator[Word]]


def dialect() -> Any:
    """pymavlink's messages; ConfigError, saying how to get it, where it is not installed."""
    try:
        return importlib.import_module("pymavlink.dialects.v20.ardupilotmega")
    except ImportError:
        raise ConfigError(
            "MAVLink needs pymavlink, which is not installed: pip install 'terranav[live]' (or pymavlink)"
        ) from None


class MavlinkIn:
    """Decodes frames; holds no state between them."""

    def __init__(self) -> None:
        self._dialect = dialect()
        self._link = self._dialect.MAVLink(None)

    def heard(self, frame: bytes) -> Heard | None:
        """What a whole frame says; None where it is damaged."""
        number = message_number(frame)
        if number is None:
            return None
        if number not in _READERS:
            return Heard(str(number), *_sender(frame)) if _complete(frame) else None
        name, clock, reader = _READERS[number]
        try:
            message = self._link.decode(bytearray(frame))
        except (self._dialect.MAVError, AttributeError, IndexError, TypeError, ValueError, struct.error):
            return None
        fields = _Fields(message)
        words = tuple(reader(message, fields))
        steady = clock == "time_boot_ms"
        return Heard(name, *_sender(frame), _clock_s(message, clock), steady, words, tuple(fields.rejected))


def message_number(frame: bytes) -> int | None:
    """The number of the message in a frame, None where it is too short to have one."""
    if len(frame) < 8 or frame[0] not in MARKERS:
        return None
    if frame[0] == 0xFE:
        return frame[5]
    return frame[7] | frame[8] << 8 | frame[9] << 16 if len(frame) >= 12 else None


def _sender(frame: bytes) -> tuple[tuple[int, int], int]:
    """System and component, and the sequence number."""
    if frame[0] == 0xFE:
        return (frame[3], frame[4]), frame[2]
    return (frame[5], frame[6]), frame[4]


def _complete(frame: bytes) -> bool:
    """Whether a frame is as long as its header says."""
    if frame[0] == 0xFE:
        return len(frame) == frame[1] + 8
    return len(frame) == frame[1] + 12 + (13 if frame[2] & 1 else 0)


def _clock_s(message: Any, field: str) -> float | None:
    """The sender's clock in a message [s], None where it has none."""
    if field == "time_boot_ms":
        return float(message.time_boot_ms) * 1e-3
    if field == "time_usec" and 0 < message.time_usec < STAMPS_US[0]:
        return float(message.time_usec) * 1e-6
    return None


class _Fields:
    """Reads the fields of one message and remembers those that cannot be."""

    def __init__(self, message: Any) -> None:
        self.message = message
        self.rejected: list[str] = []

    def number(self, name: str, scale: float, low: float, high: float) -> float | None:
        """A field times a scale, None where it is not finite or outside of its limits."""
        value = float(getattr(self.message, name)) * scale
        if math.isfinite(value) and low <= value <= high:
            return value
        self.rejected.append(f"{self.message.get_type()} {name} is {value:g}, expected {low:g} to {high:g}")
        return None

    def three(self, names: tuple[str, str, str], scale: float, limit: float) -> tuple[float, float, float] | None:
        """Three fields of one kind, None where one of them cannot be."""
        first, second, third = (self.number(name, scale, -limit, limit) for name in names)
        return None if first is None or second is None or third is None else (first, second, third)

    def place(self) -> tuple[float, float] | None:
        """Latitude and longitude [deg]; None where not known (both 0, or the largest integer)."""
        lat, lon = self.message.lat, self.message.lon
        if (lat == 0 and lon == 0) or _UNKNOWN_32 in (lat, lon):
            return None
        # divided as in a log's reader, so that both give the same bits
        if abs(lat) > 900_000_000 or abs(lon) > 1_800_000_000:
            self.rejected.append(f"{self.message.get_type()} lat, lon are {lat / 1e7:g}, {lon / 1e7:g} degrees")
            return None
        return lat / 1e7, lon / 1e7


def _global_position(message: Any, fields: _Fields) -> Iterator[Word]:
    alt = fields.number("alt", 1e-3, *LIMITS["alt_m"])
    place = fields.place()
    if place is not None:
        yield Position(*place, alt)
    elif alt is not None and alt != 0.0:
        yield Altitude(alt)
    velocity = fields.three(("vx", "vy", "vz"), 0.01, _FASTEST_MPS)
    if velocity is not None:
        yield Velocity(*velocity, "GLOBAL_POSITION_INT")


def _local_position(message: Any, fields: _Fields) -> Iterator[Word]:
    velocity = fields.three(("vx", "vy", "vz"), 1.0, _FASTEST_MPS)
    if velocity is not None:
        yield Velocity(*velocity, "LOCAL_POSITION_NED")


def _attitude(message: Any, fields: _Fields) -> Iterator[Word]:
    angles = fields.three(("roll", "pitch", "yaw"), 180.0 / math.pi, 360.0)
    if angles is not None:
        yield Attitude(angles[0], angles[1], angles[2] % 360.0)


def _pressure(message: Any, fields: _Fields) -> Iterator[Word]:
    hpa = fields.number("press_abs", 1.0, _LEAST_HPA, _MOST_HPA)
    if hpa is not None:
        yield Pressure(float(pressure_altitude_m(hpa)), "SCALED_PRESSURE")


def _imu(message: Any, fields: _Fields) -> Iterator[Word]:
    if message.fields_updated & _UPDATED_PRESSURE_ALT:
        alt = fields.number("pressure_alt", 1.0, *LIMITS["alt_m"])
        if alt is not None:
            yield Pressure(alt, "HIGHRES_IMU")


def _altitude(message: Any, fields: _Fields) -> Iterator[Word]:
    alt = fields.number("altitude_amsl", 1.0, *LIMITS["alt_m"])
    if alt is not None:
        yield Altitude(alt)
    monotonic = fields.number("altitude_monotonic", 1.0, *LIMITS["alt_m"])
    if monotonic is not None:
        yield Pressure(monotonic, "ALTITUDE")


def _distance(message: Any, fields: _Fields) -> Iterator[Word]:
    if message.orientation != _DOWN:
        return
    current, low, high = (
        value / 100.0 for value in (message.current_distance, message.min_distance, message.max_distance)
    )
    # as in a log's reader: at its upper limit an autopilot reports the limit itself
    good = current > 0 and (high <= low or low <= current < high)
    good = good and message.signal_quality != _INVALID_SIGNAL
    kind = _ROLES.get(message.type, "laser")
    yield Range(kind, f"{kind} {message.get_srcComponent()}.{message.id}", current if good else None)


def _hud(message: Any, fields: _Fields) -> Iterator[Word]:
    speed = fields.number("airspeed", 1.0, 0.0, _FASTEST_MPS)
    if speed is not None:
        yield AirData(speed)


def _gps(message: Any, fields: _Fields) -> Iterator[Word]:
    fix, place = int(message.fix_type), fields.place()
    if place is None:
        yield Gnss(min(fix, 1), math.nan, math.nan, None, None, None)
        return
    alt = fields.number("alt", 1e-3, *LIMITS["alt_m"])
    sigma = message.h_acc / 1e3 if 0 < message.h_acc < 2**32 - 1 else None
    velocity = None
    if _UNKNOWN_16 not in (message.vel, message.cog):
        course = math.radians(message.cog / 100.0)
        velocity = message.vel / 100.0 * math.cos(course), message.vel / 100.0 * math.sin(course)
    yield Gnss(fix, *place, alt, sigma, velocity)


def _time(message: Any, fields: _Fields) -> Iterator[Word]:
    if STAMPS_US[0] < message.time_unix_usec < STAMPS_US[1]:
        yield UnixTime(int(message.time_unix_usec))


def _beat(message: Any, fields: _Fields) -> Iterator[Word]:
    if message.type != _GROUND_STATION and message.autopilot != _NO_AUTOPILOT:
        yield Beat(int(message.autopilot), int(message.type))


#: number of a message -> its name, the field with the sender's clock, and what reads it
_READERS: dict[int, tuple[str, str, Reader]] = {
    0: ("HEARTBEAT", "", _beat),
    2: ("SYSTEM_TIME", "time_boot_ms", _time),
    24: ("GPS_RAW_INT", "time_usec", _gps),
    29: ("SCALED_PRESSURE", "time_boot_ms", _pressure),
    30: ("ATTITUDE", "time_boot_ms", _attitude),
    32: ("LOCAL_POSITION_NED", "time_boot_ms", _local_position),
    33: ("GLOBAL_POSITION_INT", "time_boot_ms", _global_position),
    74: ("VFR_HUD", "", _hud),
    105: ("HIGHRES_IMU", "time_usec", _imu),
    132: ("DISTANCE_SENSOR", "time_boot_ms", _distance),
    141: ("ALTITUDE", "time_usec", _altitude),
}

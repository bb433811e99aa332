"""One NMEA 0183 sentence into what it says; decoded by pynmeagps, meanings as in `terranav.io.logs.nmea`.

GGA, RMC: position (GGA with altitude), and the same as a receiver's word for monitors. HDT, THS: true heading. PASHR:
attitude. VTG: course and speed over ground. VBW: speed through the water and over ground along and across the ship.
DPT, DBT: depth. Times of day are not read: most sentences have none. A sentence without a right checksum says nothing.
"""

from __future__ import annotations

import importlib
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

from terranav.core.errors import ConfigError
from terranav.core.recording import LIMITS
from terranav.live.heard import AirData, Attitude, Depth, Gnss, Ground, Heard, Position, Velocity, Word

KNOT_MPS = 1852.0 / 3600.0
_SENTENCE = re.compile(rb"[$!][A-Z][A-Z0-9]{1,8},[\x20-\x7e]{0,200}\*[0-9A-Fa-f]{2}\s*\Z", re.ASCII)
_FASTEST_MPS, _DEEPEST_M = 1000.0, 12000.0
#: GGA quality -> MAVLink fix type: 6 dead reckoning, 7 manual and 8 simulator are no fix of a receiver
_FIXES = {1: 3, 2: 4, 3: 3, 4: 6, 5: 5, 9: 3}


class NmeaIn:
    """Parses sentences; holds no state between them."""

    def __init__(self) -> None:
        try:
            self._library = importlib.import_module("pynmeagps")
        except ImportError:
            raise ConfigError(
                "NMEA needs pynmeagps, which is not installed: pip install 'terranav[live]' (or pynmeagps)"
            ) from None

    def heard(self, line: bytes) -> Heard | None:
        """What a sentence says; None where it is damaged."""
        if not _SENTENCE.match(line):
            return None
        try:
            parsed = self._library.NMEAReader.parse(line.strip() + b"\r\n")
            kind = str(parsed.msgID)
            rejected: list[str] = []
            reader = _READERS.get(kind)
            words = tuple(reader(parsed, rejected)) if reader is not None else ()
        except Exception:  # noqa: BLE001 - pynmeagps raises what the damaged text leads it to
            return None
        return Heard(kind, words=words, rejected=tuple(rejected))


def _number(parsed: Any, rejected: list[str], name: str, low: float, high: float) -> float | None:
    """A field, None where it is empty or cannot be; of the latter is told."""
    value = getattr(parsed, name, None)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    if math.isfinite(value) and low <= value <= high:
        return float(value)
    rejected.append(f"{parsed.msgID} {name} is {value:g}, expected {low:g} to {high:g}")
    return None


def _place(parsed: Any, rejected: list[str]) -> tuple[float, float] | None:
    lat = _number(parsed, rejected, "lat", *LIMITS["lat_deg"])
    lon = _number(parsed, rejected, "lon", *LIMITS["lon_deg"])
    return None if lat is None or lon is None or (lat == 0.0 and lon == 0.0) else (lat, lon)


def _gga(parsed: Any, rejected: list[str]) -> Iterator[Word]:
    place = _place(parsed, rejected)
    alt = _number(parsed, rejected, "alt", *LIMITS["alt_m"])
    quality = parsed.quality if isinstance(parsed.quality, int) else 0
    if place is not None and quality:
        yield Position(*place, alt if alt is not None else 0.0)
        if quality in _FIXES:
            yield Gnss(_FIXES[quality], *place, alt, None, None)


def _rmc(parsed: Any, rejected: list[str]) -> Iterator[Word]:
    place = _place(parsed, rejected)
    if place is None or parsed.status != "A":
        return
    yield Position(*place, None)
    velocity = _over_ground(parsed, rejected, "spd", "cog")
    if velocity is not None:
        yield Velocity(*velocity, 0.0, "RMC")


def _vtg(parsed: Any, rejected: list[str]) -> Iterator[Word]:
    velocity = _over_ground(parsed, rejected, "sogn", "cogt")
    if velocity is not None:
        yield Velocity(*velocity, 0.0, "VTG")


def _over_ground(parsed: Any, rejected: list[str], speed: str, course: str) -> tuple[float, float] | None:
    """North and east velocity [m/s]."""
    knots = _number(parsed, rejected, speed, 0.0, _FASTEST_MPS / KNOT_MPS)
    degrees = _number(parsed, rejected, course, 0.0, 360.0)
    if knots is None or degrees is None:
        return None
    angle = math.radians(degrees)
    return knots * KNOT_MPS * math.cos(angle), knots * KNOT_MPS * math.sin(angle)


def _vbw(parsed: Any, rejected: list[str]) -> Iterator[Word]:
    limit = _FASTEST_MPS / KNOT_MPS
    for along, across, status, word in (
        ("longgroundspd", "transgroundspd", "groundspdstatus", Ground),
        ("longwaterspd", "transwaterspd", "waterspdstatus", AirData),
    ):
        ahead = _number(parsed, rejected, along, -limit, limit)
        aside = _number(parsed, rejected, across, -limit, limit)
        if ahead is None or getattr(parsed, status, "") != "A":
            continue
        speeds = ahead * KNOT_MPS, (aside or 0.0) * KNOT_MPS
        yield Ground(*speeds) if word is Ground else AirData(*speeds, calibrated=False)


def _heading(parsed: Any, rejected: list[str]) -> Iterator[Word]:
    name = "headingT" if parsed.msgID == "HDT" else "headt"
    heading = _number(parsed, rejected, name, -360.0, 360.0)
    if heading is not None:
        yield Attitude(None, None, heading % 360.0)


def _pashr(parsed: Any, rejected: list[str]) -> Iterator[Word]:
    angles = [_number(parsed, rejected, name, -360.0, 360.0) for name in ("roll", "pitch", "trueHdg")]
    if angles[2] is not None:
        yield Attitude(angles[0], angles[1], angles[2] % 360.0)


def _dpt(parsed: Any, rejected: list[str]) -> Iterator[Word]:
    depth = _number(parsed, rejected, "depth", 0.0, _DEEPEST_M)
    offset = _number(parsed, rejected, "offset", -100.0, 100.0) or 0.0
    if depth is not None and depth > 0.0:
        yield Depth(depth + max(offset, 0.0), offset > 0.0)


def _dbt(parsed: Any, rejected: list[str]) -> Iterator[Word]:
    depth = _number(parsed, rejected, "depthm", 0.0, _DEEPEST_M)
    if depth is not None and depth > 0.0:
        yield Depth(depth, False)


_READERS: dict[str, Callable[[Any, list[str]], Iterator[Word]]] = {
    "GGA": _gga,
    "RMC": _rmc,
    "VTG": _vtg,
    "VBW": _vbw,
    "HDT": _heading,
    "THS": _heading,
    "ASHR": _pashr,
    "DPT": _dpt,
    "DBT": _dbt,
}

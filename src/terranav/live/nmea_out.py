"""Fixes as NMEA 0183 sentences: GGA and RMC, for anything that takes a receiver's output.

The quality in GGA is 6, 'estimated (dead reckoning)', and RMC's mode E: no satellite stands behind the position, and a
plotter shows so. The horizontal dilution is the larger sigma over 5 m, since plotters take that for a measure of error.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor

from terranav.live.outgoing import Offer

_KN_MPS = 1852.0 / 3600.0
_USER_ERROR_M = 5.0
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def sentences(offer: Offer, talker: str = "GP") -> bytes:
    """GGA and RMC of one fix, each with its checksum and line end; the time is the measurement's, UTC of the host."""
    when = _EPOCH + timedelta(microseconds=offer.stamp_us)
    clock = f"{when:%H%M%S}.{when.microsecond // 10_000:02d}"
    lat, lon = _angle(offer.lat_deg, 2, "NS"), _angle(offer.lon_deg, 3, "EW")
    dilution = min(99.9, max(0.1, offer.horizontal_m / _USER_ERROR_M))
    gga = f"{talker}GGA,{clock},{lat},{lon},6,00,{dilution:.1f},{offer.alt_m:.1f},M,,M,,"
    rmc = f"{talker}RMC,{clock},A,{lat},{lon},{_course(offer)},{when:%d%m%y},,,E"
    return b"".join(_whole(body) for body in (gga, rmc))


def _whole(body: str) -> bytes:
    """A sentence with its checksum: the exclusive or of all between $ and *."""
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode()


def _angle(degrees: float, width: int, sides: str) -> str:
    """Degrees and minutes as NMEA writes them, ddmm.mmmmm, rounded before they are split."""
    units = round(abs(degrees) * 60 * 1e5)
    whole, rest = divmod(units, 60 * 100_000)
    return f"{whole:0{width}d}{rest // 100_000:02d}.{rest % 100_000:05d},{sides[degrees < 0]}"


def _course(offer: Offer) -> str:
    """Speed over ground [kn] and course [deg], empty where no velocity is known."""
    if offer.velocity_mps is None:
        return ","
    north, east, _ = offer.velocity_mps
    course = math.degrees(math.atan2(east, north)) % 360.0
    return f"{math.hypot(north, east) / _KN_MPS:.2f},{course % 359.995:.2f}"

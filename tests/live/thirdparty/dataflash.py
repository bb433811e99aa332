"""The test bed's telemetry as a DataFlash log, and streamed as ArduPilot streams one over MAVLink."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Iterable
from typing import Any

from benchmarks.replay_flight import MESSAGES, fmt, message

from terranav.io.logs.found import pressure_altitude_m
from terranav.live.mavlink_in import dialect
from terranav.live.testbed.telemetry import BOOT_US
from tests.live.thirdparty.scene import Bed

BLOCK_BYTES = 200
_WITHOUT = ("IMU", "ARSP")
#: RNGFND1_TYPE of a radar; XKF4's flag that GNSS is used; a GPS week
_RADAR, _USES_GPS, _WEEK, _GOOD, _FAR = 30.0, 1 << 13, 2400, 4, 3
_HEAD = (b"RNGFND1_TYPE", _RADAR), (b"RNGFND1_MIN_CM", 100.0), (b"RNGFND1_MAX_CM", 65000.0)


def dataflash(frames: Iterable[bytes]) -> bytes:
    """What ArduPlane would have logged of what it sent."""
    link = dialect().MAVLink(None)
    out = [fmt(name) for name in MESSAGES if name not in _WITHOUT]
    out.append(message("MSG", BOOT_US, b"ArduPlane V4.6.0"))
    out += [message("PARM", BOOT_US, name, value, 0.0) for name, value in _HEAD]
    for frame in frames:
        sent = link.decode(bytearray(frame))
        us = getattr(sent, "time_usec", 0) or 1000 * getattr(sent, "time_boot_ms", 0)
        out += [message(name, us, *values) for name, values in _rows(sent, us).items()]
    return b"".join(out)


def _rows(m: Any, us: int) -> dict[str, tuple[Any, ...]]:
    """What a message of telemetry is in a log."""
    kind = m.get_type()
    if kind == "GPS_RAW_INT" and m.fix_type >= 3:
        down = 0.0
        return {"GPS": (0, 3, us // 1000, _WEEK, 14, 0.8, *_place(m), m.vel / 100.0, m.cog / 100.0, down)}
    if kind == "GLOBAL_POSITION_INT":
        velocity = m.vx / 100.0, m.vy / 100.0, m.vz / 100.0
        return {"POS": _place(m), "XKF1": (0, *velocity), "XKF4": (0, _USES_GPS, 0)}
    if kind == "ATTITUDE":
        return {"ATT": (math.degrees(m.roll), math.degrees(m.pitch), math.degrees(m.yaw) % 360.0)}
    if kind == "SCALED_PRESSURE":
        return {"BARO": (0, float(pressure_altitude_m(m.press_abs)))}
    if kind == "DISTANCE_SENSOR":
        good = m.current_distance < m.max_distance
        return {"RFND": (0, m.current_distance / 100.0 if good else 0.0, _GOOD if good else _FAR, 25)}
    return {}


def _place(m: Any) -> tuple[float, float, float]:
    """Latitude, longitude, altitude."""
    return m.lat / 1e7, m.lon / 1e7, m.alt / 1e3


async def stream(bed: Bed, log: bytes, ends_s: float) -> int:
    """Send a log while the bed flies, all of it until `ends_s` [s] of the flight, once a recorder has asked for it.

    The last block is filled up with zeros, and one of zeros follows: a recorder writes a block out when the next comes.

    Returns
    -------
    int
        How many bytes were sent.
    """
    d = dialect()
    blocks = -(-len(log) // BLOCK_BYTES) + 1
    sent = 0
    while sent < blocks:
        await asyncio.sleep(0.02)
        if "REMOTE_LOG_BLOCK_STATUS" not in bed.heard | bed.ignored:
            continue
        while sent < min(blocks, blocks * bed.flight.time_us * 1e-6 / ends_s):
            data = log[sent * BLOCK_BYTES : (sent + 1) * BLOCK_BYTES].ljust(BLOCK_BYTES, b"\0")
            block = d.MAVLink_remote_log_data_block_message(255, 230, sent, data)
            bed.front.wires[0].write(bed.flight.telemetry.pack(bed.flight.time_us, block))
            sent += 1
    return blocks * BLOCK_BYTES

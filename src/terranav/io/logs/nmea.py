"""NMEA 0183 text, as receivers, echo sounders and gyro compasses write it; decoded by pynmeagps.

Sentences and their units: GGA (GNS) time of day, position, altitude [m, above mean sea level], quality 0 is no fix, 6
dead reckoning, 7 manual, 8 simulator (none of these is taken for true); RMC time, date, position, speed [kn], course
[deg]; ZDA date; HDT, THS true heading [deg]; PASHR roll, pitch, heading [deg]; DPT depth below the transducer [m] and
its offset (positive: to the water line); DBT depth below the transducer [m].

A sentence without a time gets that of the last one before it that has one: talkers send what belongs together in one
burst, the time first. The checksum must be right; sentences without any are taken only where the file has none at all.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterator
from datetime import UTC, date, datetime, time
from functools import reduce
from itertools import islice
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np

from terranav.core.errors import DataError
from terranav.core.recording import FloatArray
from terranav.io.logs.found import NO_HEIGHT, SEA_LEVEL, Found, Series, series, velocity_from_course
from terranav.io.logs.raw import GIVE_UP_BYTES, library, mapped

_KN_MPS = 1852.0 / 3600.0
_DAY_S = 86400.0
_SENTENCE = re.compile(
    rb"\$(?:[A-Z]{2}(?:GGA|GNS|RMC|ZDA|HDT|THS|DPT|DBT)|PASHR),[\x20-\x7e]{0,120}?(?:\*[0-9A-Fa-f]{2}|\Z)", re.ASCII
)
#: a sentence of another kind, a line of text that is none, or nothing but zeros
_OTHER = re.compile(rb"\A\0*\Z|\A[\t\x20-\x23\x25-\x7e]*(?:[$!][\x20-\x7e]*\*[0-9A-Fa-f]{2}[\t\x20-\x7e]*)?\Z")
_LINE = re.compile(rb"[^\r\n]{1,4096}")
#: GGA quality of a position that a receiver measured
_MEASURED = (1, 2, 3, 4, 5, 9)
_MAX_LINES = 50_000_000


class _Sentences:
    """The sentences of a file by kind: place in the file, time of day [s, NaN for none], and the parsed fields."""

    def __init__(self) -> None:
        self.rows: dict[str, list[tuple[float, ...]]] = {}
        self.stamps: list[tuple[int, float]] = []
        self.first_date: date | None = None
        self.bad = self.last_good = self.unread = 0

    def take(self, at: int, parsed: Any) -> None:
        """Keep what one sentence says."""
        kind = str(parsed.msgID)
        stamp = _seconds(getattr(parsed, "time", getattr(parsed, "utctime", None)))
        if np.isfinite(stamp):
            self.stamps.append((at, stamp))
        if self.first_date is None:
            self.first_date = _date(parsed)
        fields = _fields(kind, parsed)
        if fields is not None:
            self.rows.setdefault("HDT" if kind == "THS" else kind, []).append((float(at), *fields))

    def table(self, kind: str) -> tuple[FloatArray, FloatArray]:
        """Places (n,) and fields (n, k) of one kind; none where there is no such sentence."""
        rows = np.array(self.rows.get(kind, []), dtype=np.float64)
        return (rows[:, 0], rows[:, 1:]) if len(rows) else (np.empty(0), np.empty((0, 5)))

    def clock(self) -> tuple[FloatArray, FloatArray]:
        """Places and times of day of the sentences that have one, midnights carried on [s]."""
        stamps = np.array(self.stamps, dtype=np.float64).reshape(-1, 2)
        return stamps[:, 0], np.unwrap(stamps[:, 1], period=_DAY_S)


def read(path: Path) -> Found:
    """Read a file of NMEA sentences.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Found

    Raises
    ------
    DataError
        When no sentence with a time is whole.
    ConfigError
        When pynmeagps is not installed.
    """
    library("pynmeagps", path, "a file of NMEA sentences")
    with mapped(path) as (data, zeros):
        found = _parsed(data, path)
    places, times = found.clock()
    if not places.size:
        raise DataError(f"{path}: no NMEA sentence with a time (GGA, GNS, RMC) is whole")
    remarks = [f"{found.bad} damaged sentences were left out"] if found.bad else []
    if found.unread:
        remarks.append(f"the file is damaged: its last {found.unread} bytes hold no sentence that is read")
    if zeros:
        remarks.append(f"the last {zeros} bytes of the file are zero and were not read")
    parts = [part for part in _parts(found, places, times, remarks) if part is not None and len(part)]
    start = datetime.combine(found.first_date, time(), UTC) if found.first_date else None
    if start is None:
        remarks.append("no date is logged (RMC, ZDA): times are times of day")
    return Found(path, "NMEA 0183 text", parts, {}, start, remarks, not found.bad)


def _parsed(data: mmap.mmap, path: Path) -> _Sentences:
    """Every sentence of the wanted kinds whose checksum is right."""
    reader = library("pynmeagps", path, "a file of NMEA sentences")
    found = _Sentences()
    checked = data.find(b"*") >= 0
    for line in islice(_LINE.finditer(data), _MAX_LINES):
        match = _SENTENCE.search(line.group())
        if match is None or (checked and b"*" not in match.group()):
            found.bad += not _OTHER.search(line.group()) or match is not None
            if line.start() - found.last_good > GIVE_UP_BYTES:
                found.unread = len(data) - found.last_good
                break
            continue
        at, text = line.start(), match.group()
        try:
            whole = text if checked else text.rstrip() + b"*%02X" % reduce(xor, text.rstrip()[1:])
            parsed = reader.NMEAReader.parse(whole + b"\r\n")
            found.take(at, parsed)
            found.last_good = at
        except Exception:  # noqa: BLE001 - pynmeagps raises what the damaged text leads it to
            found.bad += 1
    return found


def _seconds(value: Any) -> float:
    """Time of day in seconds, NaN for none."""
    if not isinstance(value, time):
        return float("nan")
    return value.hour * 3600.0 + value.minute * 60.0 + value.second + value.microsecond * 1e-6


def _date(parsed: Any) -> date | None:
    """The date a sentence says, or None."""
    if parsed.msgID == "RMC" and isinstance(parsed.date, date):
        return parsed.date
    if parsed.msgID == "ZDA":
        try:
            return date(int(parsed.year), int(parsed.month), int(parsed.day))
        except (TypeError, ValueError):
            return None
    return None


def _number(value: Any) -> float:
    """A field as a number, NaN for none."""
    return float(value) if isinstance(value, (int, float)) else float("nan")


def _fields(kind: str, parsed: Any) -> tuple[float, ...] | None:
    """The numbers of one sentence, None where it has nothing to tell."""
    if kind in ("GGA", "GNS"):
        if kind == "GGA" and parsed.quality not in _MEASURED:
            return None
        if kind == "GNS" and not set(str(parsed.posMode)) & set("ADPRF"):
            return None
        return _number(parsed.lat), _number(parsed.lon), _number(parsed.alt)
    if kind == "RMC":
        fields = (_number(parsed.lat), _number(parsed.lon), _number(parsed.spd), _number(parsed.cog))
        return fields if parsed.status == "A" else None
    if kind == "HDT":
        return (_number(parsed.headingT),)
    if kind == "THS":
        return (_number(parsed.headt),)
    if kind == "ASHR":
        return _number(parsed.roll), _number(parsed.pitch), _number(parsed.trueHdg)
    if kind == "DPT":
        return _number(parsed.depth), _number(parsed.offset)
    return (_number(parsed.depthm),) if kind == "DBT" else None


def _parts(found: _Sentences, places: FloatArray, times: FloatArray, remarks: list[str]) -> Iterator[Series | None]:
    """Every series of the file."""

    def when(at: FloatArray) -> FloatArray:
        return np.asarray(times[np.clip(np.searchsorted(places, at, side="right") - 1, 0, None)])

    for kind in ("GGA", "GNS", "RMC"):
        at, fields = found.table(kind)
        if at.size:
            alt = fields[:, 2] if kind != "RMC" else np.zeros(at.size)
            values = {"lat_deg": fields[:, 0], "lon_deg": fields[:, 1], "alt_m": alt}
            height = SEA_LEVEL if kind != "RMC" else NO_HEIGHT
            yield series("gnss", kind, when(at), values, at, height=height, uses_gnss=True)
            break
    at, fields = found.table("RMC")
    north, east = velocity_from_course(fields[:, 2] * _KN_MPS, fields[:, 3])
    yield series("velocity", "RMC", when(at), {"vn_mps": north, "ve_mps": east}, at, uses_gnss=True)
    yield _attitude(found, when(found.table("ASHR")[0]), when(found.table("HDT")[0]))
    yield _depth(found, when, remarks)


def _attitude(found: _Sentences, ashr_s: FloatArray, hdt_s: FloatArray) -> Series | None:
    """Attitude by PASHR, or the heading alone."""
    at, fields = found.table("ASHR")
    if at.size:
        values = {"roll_deg": fields[:, 0], "pitch_deg": fields[:, 1], "heading_deg": fields[:, 2] % 360.0}
        return series("attitude", "PASHR", ashr_s, values, at)
    at, fields = found.table("HDT")
    if not at.size:
        return None
    none = np.full(at.size, np.nan)
    values = {"roll_deg": none, "pitch_deg": none, "heading_deg": fields[:, 0] % 360.0}
    return series("attitude", "HDT / THS", hdt_s, values, at, uses_gnss=False)


def _depth(found: _Sentences, when: Any, remarks: list[str]) -> Series | None:
    """Depth below the surface where the transducer's is told, else below the transducer."""
    at, fields = found.table("DPT")
    if at.size:
        offset = np.where(fields[:, 1] > 0, fields[:, 1], 0.0)
        if not (offset > 0).any():
            remarks.append("DPT tells no depth of the transducer: depth_m counts from it, not from the surface")
        return series("depth", "DPT", when(at), {"depth_m": fields[:, 0] + offset}, at, uses_gnss=False)
    at, fields = found.table("DBT")
    if not at.size:
        return None
    remarks.append("DBT tells no depth of the transducer: depth_m counts from it, not from the surface")
    return series("depth", "DBT", when(at), {"depth_m": fields[:, 0]}, at, uses_gnss=False)

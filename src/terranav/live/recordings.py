"""What live mode recorded, as packets: its own container, a .tlog, or NMEA text.

The container (`received.tnrec`): the line `terranav-received 1`, a line of JSON (the links, by number), then records of
stamp [us since 1970] u64, link u8, length u16, CRC-32 of these and the data u32 (little-endian), and the data: one
MAVLink frame or one line of NMEA. A file that was cut or damaged reads up to there.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, BinaryIO

from terranav.core.errors import DataError
from terranav.io.files import existing_file
from terranav.io.logs.opening import STAMPS_US, frame_bytes
from terranav.live.records import Packet

MAGIC = b"terranav-received 1\n"
_HEAD = struct.Struct("<QBH")
_CRC = struct.Struct("<I")
_RECORD_BYTES = _HEAD.size + _CRC.size
_WHAT = "a recording of terranav live, a .tlog, or NMEA text"
_LOOK_BYTES = 1 << 16
_BLOCK_BYTES = 1 << 20
_NMEA = re.compile(rb"[$!][A-Z]{1,2}[A-Z0-9]{2,3}[A-Z],", re.ASCII)
_MOST_LINE = 4096


@dataclass
class Opened:
    """A recording that is read from its start.

    Attributes
    ----------
    path : Path
    kind : str
        'received', 'tlog' or 'nmea'.
    links : tuple of str
        What was recorded, by link number; one unnamed link for what is not our own.
    remarks : list of str
        What was found wrong, filled as it is read.
    """

    path: Path
    kind: str
    links: tuple[str, ...]
    remarks: list[str]
    start: int = 0

    def packets(self) -> Iterator[Packet]:
        """Every packet in its order; DataError where the file cannot be read on."""
        reader = {"received": received, "tlog": _tlog, "nmea": _nmea}[self.kind]
        try:
            with self.path.open("rb") as stream:
                stream.seek(self.start)
                yield from reader(stream, self.remarks)
        except OSError as problem:
            raise DataError(f"{self.path}: cannot be read ({problem.strerror}), expected {_WHAT}") from None


def opened(path: str | Path) -> Opened:
    """Tell what a file is by what is in it; DataError for anything but a recording."""
    file = existing_file(path, _WHAT)
    try:
        with file.open("rb") as stream:
            head = stream.read(_LOOK_BYTES)
    except OSError as problem:
        raise DataError(f"{file}: cannot be read ({problem.strerror}), expected {_WHAT}") from None
    if head.startswith(MAGIC[:18]):
        links, start = _own_header(file, head)
        return Opened(file, "received", links, [], start)
    if any(_stamped_frame(head, at) for at in range(min(len(head), 4096))):
        return Opened(file, "tlog", ("",), [])
    if _NMEA.search(head):
        return Opened(file, "nmea", ("",), [])
    shown = "only zeros" if not head.strip(b"\0") else f"{head[:8]!r}"
    raise DataError(f"{file}: begins with {shown}, expected {_WHAT}")


def header(links: tuple[str, ...]) -> bytes:
    """The first two lines of a container."""
    return MAGIC + json.dumps({"links": links}).encode() + b"\n"


def record(packet: Packet) -> bytes:
    """One record of a container."""
    head = _HEAD.pack(packet.stamp_us, packet.link, len(packet.data))
    return head + _CRC.pack(zlib.crc32(packet.data, zlib.crc32(head))) + packet.data


def _own_header(file: Path, head: bytes) -> tuple[tuple[str, ...], int]:
    """The links, and where the records begin."""
    if not head.startswith(MAGIC):
        raise DataError(f"{file}: is a recording of another version, expected {MAGIC.decode().strip()!r}")
    end = head.find(b"\n", len(MAGIC))
    try:
        told: Any = json.loads(head[len(MAGIC) : end]) if end > 0 else {}
        links = tuple(str(link) for link in told["links"])
    except (ValueError, TypeError, KeyError):
        raise DataError(f"{file}: its second line does not name the links, expected {_WHAT}") from None
    return links, end + 1


def received(stream: BinaryIO, remarks: list[str]) -> Iterator[Packet]:
    """The packets from here to the end of a container, or to where it is cut."""
    for packet, _ in walk(stream, remarks):
        yield packet


def walk(stream: BinaryIO, remarks: list[str]) -> Iterator[tuple[Packet, int]]:
    """The packets from here on, each with the place in the file one past its end."""
    place = stream.tell()
    while head := stream.read(_RECORD_BYTES):
        if len(head) == _RECORD_BYTES:
            stamp_us, link, length = _HEAD.unpack_from(head)
            data = stream.read(length)
            (crc,) = _CRC.unpack_from(head, _HEAD.size)
            if len(data) == length and crc == zlib.crc32(data, zlib.crc32(head[: _HEAD.size])):
                place += _RECORD_BYTES + length
                yield Packet(stamp_us, link, data), place
                continue
        remarks.append(f"is cut or damaged after {place} bytes, and read up to there")
        return


def _stamped_frame(data: bytes, at: int) -> bool:
    """Whether a stamp of these decades and the beginning of a frame stand here."""
    if at + 17 > len(data) or data[at + 8] not in (0xFD, 0xFE):
        return False
    (stamp,) = struct.unpack_from(">Q", data, at)
    return bool(STAMPS_US[0] < stamp < STAMPS_US[1])


def _tlog(stream: BinaryIO, remarks: list[str]) -> Iterator[Packet]:
    """Stamp [us, big-endian] and frame, one after the other; what is neither is skipped and counted."""
    data, skipped, last = b"", 0, False
    while data or not last:
        block = b"" if last else stream.read(_BLOCK_BYTES)
        last = last or not block
        data, at = data + block, 0
        # a whole frame and the beginning of the next one, unless the file ends
        while len(data) - at >= (17 if last else 400):
            length = 8 + frame_bytes(data, at + 8) if _stamped_frame(data, at) else 0
            if length and at + length <= len(data) and _goes_on(data, at + length):
                (stamp,) = struct.unpack_from(">Q", data, at)
                yield Packet(stamp, 0, data[at + 8 : at + length])
                at += length
            else:
                at += 1
                skipped += 1
        if last:
            skipped += len(data) - at
            break
        data = data[at:]
    if skipped:
        remarks.append(f"{skipped} bytes between messages that are whole were left out")


def _goes_on(data: bytes, at: int) -> bool:
    """Whether another message can begin here, or the data ends."""
    return at + 9 > len(data) or data[at + 8] in (0xFD, 0xFE) or not any(data[at : at + 9])


def _nmea(stream: BinaryIO, remarks: list[str]) -> Iterator[Packet]:
    """Line by line; a line without a time came with the one before it."""
    day, clock_s, unknown = datetime(1970, 1, 2, tzinfo=UTC), 0.0, 0
    while line := stream.readline(_MOST_LINE):
        text = line.strip()
        if not _NMEA.match(text):
            unknown += bool(text)
            continue
        fields = text.split(b",")
        seconds = _clock_s(fields)
        if seconds is not None:
            if seconds < clock_s - 43200.0:
                day += timedelta(days=1)
            clock_s = seconds
        date = _date(fields)
        if date is not None:
            day = date
        stamp = (day + timedelta(seconds=clock_s) - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1)
        yield Packet(stamp, 0, text)
    if unknown:
        remarks.append(f"{unknown} lines that are no NMEA sentence were left out")


def _clock_s(fields: list[bytes]) -> float | None:
    """Time of day that a sentence tells [s]."""
    if fields[0][-3:] not in (b"GGA", b"RMC", b"GNS", b"ZDA") or len(fields) < 2:
        return None
    found = re.fullmatch(rb"(\d\d)(\d\d)(\d\d(?:\.\d*)?)", fields[1])
    return None if found is None else float(int(found[1]) * 3600 + int(found[2]) * 60 + float(found[3]))


def _date(fields: list[bytes]) -> datetime | None:
    """The date that a sentence tells."""
    written: Any = fields[9] if fields[0].endswith(b"RMC") and len(fields) > 9 else b""
    try:
        return datetime.strptime(written.decode("ascii"), "%d%m%y").replace(tzinfo=UTC)
    except ValueError:
        return None

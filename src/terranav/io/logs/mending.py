"""A bag that was cut or never closed, so that rosbags can read what is whole of it: a view with another end.

MCAP (mcap.dev/spec): records of an opcode, a length of 8 bytes and a content; the file ends with a footer and the
magic. rosbags reads a file whose footer tells of no index by scanning it, so a cut file is shown up to its last whole
record, and then such a footer.

ROS 1 (wiki.ros.org/Bags/Format/2.0): records of a header and data, each after its length of 4 bytes; chunks of
messages, each followed by its index records; at the end every connection and a summary of every chunk. A cut file is
shown up to its last whole chunk, then an end written anew from the connections and index records before it.
"""

from __future__ import annotations

import bz2
import importlib
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from terranav.core.errors import DataError

MCAP = b"\x89MCAP0\r\n"
BAG = b"#ROSBAG V2.0\n"
_FOOTER, _END_OF_DATA = 0x02, 0x0F
#: footer record: no summary, no offsets, no checksum
_NO_SUMMARY = struct.pack("<BQQQI", _FOOTER, 20, 0, 0, 0) + MCAP
_CHUNK, _INDEX, _CONNECTION, _CHUNK_INFO = 0x05, 0x04, 0x07, 0x06
_MAX_HEADER = 1 << 20
_MAX_CHUNK = 1 << 28


class Shown:
    """A file under another suffix, and where needed with another start and end; what rosbags asks of a path."""

    def __init__(self, path: Path, suffix: str, end: int | None = None, tail: bytes = b"", start: bytes = b"") -> None:
        self.path, self.suffix, self.end, self.tail, self.start = path, suffix, end, tail, start
        self.stem, self.name = path.stem, path.name

    def __str__(self) -> str:
        return str(self.path)

    def exists(self) -> bool:
        """Whether the file is there."""
        return self.path.exists()

    def is_dir(self) -> bool:
        """A file is none."""
        return False

    def stat(self, **more: Any) -> Any:
        """The file's own."""
        return self.path.stat(**more)

    def open(self, *_: Any, **__: Any) -> BinaryIO:
        """The file, or its whole part between the new start and the new end."""
        if self.end is None:
            return self.path.open("rb")
        return io.BufferedReader(_Ended(self), 1 << 16)


class _Ended(io.RawIOBase):
    """The file's bytes up to `end`, the first of them replaced by `start`, then `tail`."""

    def __init__(self, shown: Shown) -> None:
        self.stream, self.start, self.end, self.tail = shown.path.open("rb"), shown.start, shown.end or 0, shown.tail
        self.at = 0

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """Move as in a file."""
        self.at = offset + (0, self.at, self.end + len(self.tail))[whence]
        if self.at < 0:
            raise OSError("seek before the start")
        return self.at

    def tell(self) -> int:
        """The place."""
        return self.at

    def readinto(self, buffer: Any, /) -> int:
        """Fill a buffer as far as the part at this place reaches."""
        wanted = len(buffer)
        if self.at < len(self.start):
            got = self.start[self.at :][:wanted]
        elif self.at < self.end:
            self.stream.seek(self.at)
            got = self.stream.read(min(wanted, self.end - self.at))
        else:
            got = self.tail[self.at - self.end :][:wanted]
        buffer[: len(got)] = got
        self.at += len(got)
        return len(got)

    def close(self) -> None:
        """Close the file as well."""
        self.stream.close()
        super().close()


def mended(path: Path, remarks: list[str]) -> Any:
    """What to hand to rosbags for a file: known by its content, ended properly where it was cut or never closed.

    Raises
    ------
    DataError
        When nothing of the file is whole.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(len(BAG))
        if head == BAG:
            shown = _mended_bag(path, stream, size)
        elif head.startswith(MCAP):
            shown = _mended_mcap(path, stream, size)
        else:
            return path if path.suffix == ".db3" else Shown(path, ".db3")
    if shown.end is not None:
        remarks.append(f"the file is cut: its last {size - shown.end} bytes hold no whole record and were not read")
    return shown


def _mended_mcap(path: Path, stream: BinaryIO, size: int) -> Shown:
    """An MCAP file, cut after its last whole record where it has no proper end."""
    stream.seek(max(0, size - len(_NO_SUMMARY)))
    last = stream.read()
    if last.endswith(MCAP) and last[:9] == _NO_SUMMARY[:9]:
        return Shown(path, ".mcap")
    at = len(MCAP)
    while at + 9 <= size:
        stream.seek(at)
        kind, length = struct.unpack("<BQ", stream.read(9))
        if kind in (0, _FOOTER) or kind >= _END_OF_DATA or at + 9 + length > size:
            break
        at += 9 + length
    if at == len(MCAP):
        raise DataError(f"{path}: is cut before its first record, expected an MCAP file")
    return Shown(path, ".mcap", at, _NO_SUMMARY)


def _mended_bag(path: Path, stream: BinaryIO, size: int) -> Shown:
    """A ROS 1 bag, with a new end after its last whole chunk where it has no proper one."""
    first = next(_records(stream, len(BAG), size), None)
    if first is None or not {b"index_pos", b"conn_count", b"chunk_count"} <= first[2].keys():
        raise DataError(f"{path}: is cut before its first record, expected a ROS 1 bag")
    _, after, fields = first
    index = int.from_bytes(fields[b"index_pos"], "little")
    if after <= index <= size:
        ends = [end for _, end, _ in _records(stream, index, size)]
        if ends and ends[-1] == size:
            return Shown(path, ".bag")
    end, connections, chunks = _whole_chunks(stream, after, size)
    if not chunks:
        raise DataError(f"{path}: is cut before the end of its first chunk of messages")
    stream.seek(0)
    start = bytearray(stream.read(after))
    for name, value, width in (
        (b"index_pos=", end, 8),
        (b"conn_count=", len(connections), 4),
        (b"chunk_count=", len(chunks), 4),
    ):
        place = start.find(name) + len(name)
        start[place : place + width] = value.to_bytes(width, "little")
    return Shown(path, ".bag", end, b"".join((*connections.values(), *chunks)), bytes(start))


def _records(stream: Any, at: int, size: int) -> Iterator[tuple[int, int, dict[bytes, bytes]]]:
    """Place, end and header of the whole records from a place on."""
    while at + 8 <= size:
        stream.seek(at)
        (header_bytes,) = struct.unpack("<I", stream.read(4))
        if header_bytes > _MAX_HEADER or at + 8 + header_bytes > size:
            return
        fields = _fields(stream.read(header_bytes))
        (data_bytes,) = struct.unpack("<I", stream.read(4))
        end = at + 8 + header_bytes + data_bytes
        if len(fields.get(b"op", b"")) != 1 or end > size:
            return
        yield at, end, fields
        at = end


def _fields(header: bytes) -> dict[bytes, bytes]:
    """The fields of a record's header; none where it is damaged."""
    fields, at = {}, 0
    while at + 4 <= len(header):
        (length,) = struct.unpack_from("<I", header, at)
        name, sign, value = header[at + 4 : at + 4 + length].partition(b"=")
        if not sign or at + 4 + length > len(header):
            return {}
        fields[name] = value
        at += 4 + length
    return fields


def _whole_chunks(stream: BinaryIO, at: int, size: int) -> tuple[int, dict[bytes, bytes], list[bytes]]:
    """Where the last chunk with all of its index ends, every connection's record, and every chunk's summary."""
    end, connections, chunks = at, dict[bytes, bytes](), list[bytes]()
    place, counts, stamps = -1, dict[bytes, int](), list[tuple[int, int]]()
    pending: dict[bytes, bytes] = {}
    for start, after, fields in _records(stream, at, size):
        kind = fields[b"op"][0]
        if kind == _CHUNK:
            place, counts, stamps, pending = start, {}, [], {}
            inside = _unpacked(stream, start, after, fields)
            for a, b, inner in _records(io.BytesIO(inside), 0, len(inside)):
                if inner[b"op"][0] == _CONNECTION and b"conn" in inner:
                    pending[inner[b"conn"]] = inside[a:b]
        elif kind == _INDEX and place >= 0 and {b"conn", b"count"} <= fields.keys():
            counts[fields[b"conn"]] = int.from_bytes(fields[b"count"], "little")
            stream.seek(after - 12 * counts[fields[b"conn"]])
            rows = stream.read(12 * counts[fields[b"conn"]])
            stamps += [struct.unpack_from("<II", rows, i) for i in range(0, len(rows) - 11, 12)]
            if sum(counts.values()) and counts.keys() <= (connections | pending).keys():
                summary = _summary(place, counts, stamps)
                chunks = [*(chunks if end <= place else chunks[:-1]), summary]
                connections |= pending
                end = after
        elif kind in (_CONNECTION, _CHUNK_INFO):
            break
    return end, connections, chunks


def _unpacked(stream: BinaryIO, start: int, after: int, fields: dict[bytes, bytes]) -> bytes:
    """The records of a chunk; none where it cannot be unpacked."""
    stream.seek(start)
    (header_bytes,) = struct.unpack("<I", stream.read(4))
    stream.seek(start + 8 + header_bytes)
    data = stream.read(min(after - start - 8 - header_bytes, _MAX_CHUNK))
    how = fields.get(b"compression", b"none")
    try:
        if how == b"bz2":
            return bz2.decompress(data)
        if how == b"lz4":
            return bytes(importlib.import_module("lz4.frame").decompress(data))
    except (OSError, ValueError, RuntimeError, ImportError):
        return b""
    return data if how == b"none" else b""


def _summary(place: int, counts: dict[bytes, int], stamps: list[tuple[int, int]]) -> bytes:
    """The record that sums up one chunk."""
    first, last = min(stamps, default=(0, 0)), max(stamps, default=(0, 0))
    fields = {
        b"op": bytes([_CHUNK_INFO]),
        b"ver": struct.pack("<I", 1),
        b"chunk_pos": struct.pack("<Q", place),
        b"start_time": struct.pack("<II", *first),
        b"end_time": struct.pack("<II", *last),
        b"count": struct.pack("<I", len(counts)),
    }
    parts = [name + b"=" + value for name, value in fields.items()]
    header = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    data = b"".join(conn + struct.pack("<I", count) for conn, count in counts.items())
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data

"""From the bytes of a link to whole messages: MAVLink frames and NMEA lines. What is no message is counted and dropped.

A frame is whole when its checksum is right (CRC-16/MCRF4XX with the message's own extra byte). Messages that the
dialect does not know have an unknown extra byte: they pass where another frame or nothing follows them.
Whether a frame is signed as it should be is `live.signing`'s to say.
"""

from __future__ import annotations

import binascii
from dataclasses import dataclass, field
from typing import Any

from terranav.live.mavlink_in import dialect

_V1, _V2 = 0xFE, 0xFD
_SIGNED, _SIGNATURE = 1, 13
_LONGEST_LINE = 1024
_MIRROR = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def crc(data: bytes, extra: int) -> int:
    """CRC-16/MCRF4XX of data and one more byte: CRC-CCITT with every byte mirrored, which the standard library has."""
    mirrored = binascii.crc_hqx(data.translate(_MIRROR) + _MIRROR[extra : extra + 1], 0xFFFF)
    return _MIRROR[mirrored & 0xFF] << 8 | _MIRROR[mirrored >> 8]


@dataclass
class Deframer:
    """MAVLink frames out of bytes; holds at most one unfinished frame.

    Attributes
    ----------
    garbage : int
        Bytes that belonged to no frame.
    """

    garbage: int = 0
    _rest: bytes = field(default=b"", repr=False)
    _extras: dict[int, int] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        known: Any = dialect().mavlink_map
        self._extras = {number: message.crc_extra for number, message in known.items()}

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that these bytes complete, in order."""
        frames: list[bytes] = []
        rest = self._rest + bytes(data)
        at = 0
        while True:
            start = _next_marker(rest, at)
            self.garbage += start - at
            at = start
            length = _length(rest, at)
            if length is None or at + length > len(rest):
                break
            frame = rest[at : at + length]
            if not self._whole(frame, rest[at + length : at + length + 1]):
                self.garbage += 1
                at += 1
                continue
            at += length
            frames.append(frame)
        self._rest = rest[at:]
        return frames

    def _whole(self, frame: bytes, after: bytes) -> bool:
        """Whether the checksum is right; for an unknown message, whether it may be a frame."""
        second = frame[0] == _V2
        number = frame[7] | frame[8] << 8 | frame[9] << 16 if second else frame[5]
        if second and frame[2] & ~_SIGNED:
            return False
        extra = self._extras.get(number)
        if extra is None:
            return not after or after[0] in (_V1, _V2)
        end = len(frame) - (_SIGNATURE if second and frame[2] & _SIGNED else 0)
        told = frame[end - 2] | frame[end - 1] << 8
        return told == crc(frame[1 : end - 2], extra)


@dataclass
class LineDeframer:
    """Lines of NMEA out of bytes; holds at most one unfinished line.

    Attributes
    ----------
    garbage : int
        Bytes of lines that were too long, or empty of what a sentence begins with.
    """

    garbage: int = 0
    _rest: bytes = field(default=b"", repr=False)

    def feed(self, data: bytes) -> list[bytes]:
        """The sentences that these bytes complete: from '$' or '!' to before the end of the line."""
        lines = (self._rest + bytes(data)).replace(b"\r", b"\n").split(b"\n")
        self._rest = lines.pop()
        if len(self._rest) > _LONGEST_LINE:
            self.garbage += len(self._rest)
            self._rest = b""
        sentences: list[bytes] = []
        for line in lines:
            starts = [at for at in (line.rfind(b"$"), line.rfind(b"!")) if at >= 0]
            if not starts or len(line) > _LONGEST_LINE:
                self.garbage += len(line)
                continue
            self.garbage += max(starts)
            sentences.append(line[max(starts) :])
        return sentences


def _next_marker(data: bytes, at: int) -> int:
    """Where the next frame may begin; the end where none does."""
    found = [place for place in (data.find(_V1, at), data.find(_V2, at)) if place >= 0]
    return min(found, default=len(data))


def _length(data: bytes, at: int) -> int | None:
    """The length of the frame that may begin here, None where too little of it is there to tell."""
    if len(data) - at < 3:
        return None
    if data[at] == _V1:
        return data[at + 1] + 8
    return data[at + 1] + 12 + (_SIGNATURE if data[at + 2] & _SIGNED else 0)

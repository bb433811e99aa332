"""Signatures of MAVLink 2: reading a key, checking what comes in, signing what goes out.

A signature is the first 6 bytes of the SHA-256 of key and frame; before it stand the number of the link and a time
stamp in units of 10 us since 2015 (the guide to message signing of MAVLink). A stamp that is no later than the last one
of its stream is refused, so that nothing recorded can be played back. pymavlink's own check stores the stamp before it
compares the signature, so that one forged frame with a late stamp would lock the true sender out: this one compares
first.
"""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Callable
from pathlib import Path

from terranav.core.errors import DataError
from terranav.io.files import existing_file

#: 2015-01-01 UTC [s since 1970]
_EPOCH_S = 1_420_070_400
#: a stream that is heard for the first time may be so far behind (1 minute) [10 us]
_LATE = 6_000_000
_SIGNED = 0x01
_MOST_STREAMS = 1024
_KEY = "a MAVLink signing key: 32 bytes, or 64 hexadecimal digits"


def read_key(path: str | Path) -> bytes:
    """Return the 32 bytes of a key; DataError where the file holds anything else."""
    file = existing_file(path, _KEY)
    try:
        with file.open("rb") as stream:
            data = stream.read(4096)
    except OSError as problem:
        raise DataError(f"{file}: cannot be read ({problem.strerror}), expected {_KEY}") from None
    if len(data) == 32:
        return data
    try:
        key = bytes.fromhex(data.decode("ascii").strip())
    except ValueError:
        key = b""
    if len(key) != 32:
        raise DataError(f"{file}: holds {len(data)} bytes that are no key, expected {_KEY}")
    return key


def clock() -> int:
    """The time as signatures count it [10 us since 2015]."""
    return max(0, int((time.time() - _EPOCH_S) * 100_000))


class Checker:
    """Tells frames that the key signed, each once, from all others.

    Parameters
    ----------
    key : bytes
    now : callable, optional
        The time [10 us since 2015]; the host's unless given.
    """

    def __init__(self, key: bytes, now: Callable[[], int] = clock) -> None:
        self._key, self._now = key, now
        self._last: dict[tuple[int, int, int], int] = {}
        self.unsigned = self.wrong = self.late = 0

    def __call__(self, frame: bytes) -> bool:
        """Whether a whole frame is signed with the key and later than all before it of its stream."""
        if len(frame) < 25 or frame[0] != 0xFD or not frame[2] & _SIGNED:
            self.unsigned += 1
            return False
        digest = hashlib.sha256(self._key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(digest, frame[-6:]):
            self.wrong += 1
            return False
        stamp = int.from_bytes(frame[-12:-6], "little")
        stream = (frame[-13], frame[5], frame[6])
        newest = self._last.get(stream, self._now() - _LATE - 1)
        if stamp <= newest or (stream not in self._last and len(self._last) >= _MOST_STREAMS):
            self.late += 1
            return False
        self._last[stream] = stamp
        return True


def sign_with(mavlink: object, key: bytes, link: int = 0) -> None:
    """Have a MAVLink object of pymavlink sign all that it packs; `tick` keeps its time."""
    signing = mavlink.signing  # type: ignore[attr-defined]
    signing.secret_key, signing.link_id, signing.sign_outgoing = key, link, True
    signing.timestamp = clock()


def tick(mavlink: object) -> None:
    """Set the stamp of the next signature: the host's time, and later than the last one."""
    signing = mavlink.signing  # type: ignore[attr-defined]
    if signing.sign_outgoing:
        signing.timestamp = max(signing.timestamp, clock())

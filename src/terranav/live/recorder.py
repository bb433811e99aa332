"""The files of a live run: all that came in, every fix, every remark, all that went out.

    received.tnrec    every packet with stamp and link: replays to the same bits (`recordings`)
    link0.tlog        the MAVLink frames of link 0, as any ground station reads them; link0.nmea for NMEA
    fixes.jsonl       a line of JSON a fix, usable or not, with the number of the packet it came of
    remarks.jsonl     what the operator was told
    sent.tlog         the MAVLink messages that were sent; sent.jsonl what else was

Everything is handed to the system after each batch of packets, so that a killed process loses nothing that was worked
on, and to the disk with each checkpoint.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from terranav.core.errors import DataError
from terranav.live.recordings import header, record
from terranav.live.records import Fix, Packet, Remark

RECEIVED, FIXES, REMARKS, SENT = "received.tnrec", "fixes.jsonl", "remarks.jsonl", "sent"
_STAMP = struct.Struct(">Q")
_FIX = struct.Struct("<qq5d?")
_VERDICT = struct.Struct("<3d")
_TAIL_BYTES = 1 << 16


def as_line(data: Mapping[str, Any]) -> bytes:
    """One line of JSON that every parser takes: NaN and infinity become null."""
    return json.dumps(_plain(data), separators=(",", ":"), allow_nan=False, ensure_ascii=False).encode() + b"\n"


def _plain(value: Any) -> Any:
    """The value in the types that JSON has."""
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def facts_of(fix: Fix) -> dict[str, Any]:
    """Everything a fix says, by plain names."""
    estimate = fix.estimate
    return {
        "stamp_us": fix.stamp_us,
        "boot_us": fix.boot_us,
        "lat_deg": float(fix.lat_deg),
        "lon_deg": float(fix.lon_deg),
        "alt_m": float(fix.alt_m),
        "sigma_m": [float(sigma) for sigma in fix.sigma_m],
        "protection_m": float(estimate.protection_m),
        "status": str(estimate.status),
        "usable": bool(fix.usable),
        "withheld": list(fix.withheld),
        "ins_error_m": [float(error) for error in estimate.ins_error_m],
        "velocity_mps": None if fix.velocity_mps is None else [float(speed) for speed in fix.velocity_mps],
        **gnss_of(fix),
    }


def gnss_of(fix: Fix) -> dict[str, Any]:
    """What the GNSS monitor says with a fix, under the name 'gnss'; nothing without a monitor."""
    said = fix.gnss
    if said is None:
        return {}
    return {"gnss": {"status": str(said.status), "difference_m": said.difference_m, "threshold_m": said.threshold_m}}


def chained(digest: bytes, fix: Fix) -> bytes:
    """The digest of all fixes up to this one, from the digest up to the one before: SHA-256 over it and the bits.

    What the GNSS monitor says belongs to them, where there is one.
    """
    boot_us = -1 if fix.boot_us is None else fix.boot_us
    numbers = (fix.lat_deg, fix.lon_deg, fix.alt_m, *fix.sigma_m)
    told = _FIX.pack(fix.stamp_us, boot_us, *numbers, fix.usable)
    if fix.gnss is not None:
        said = fix.gnss
        told += said.status.encode() + _VERDICT.pack(said.since_s, said.difference_m, said.threshold_m)
    return hashlib.sha256(digest + told).digest()


class Recorder:
    """Writes the files of one run.

    Parameters
    ----------
    folder : Path
        Made where it is not there.
    links : tuple of str
        The input links by number, as typed.
    resume_bytes : int, optional
        Go on with a recording whose last whole record ends there; else begin anew.

    Raises
    ------
    DataError
        When the folder or a file in it cannot be written.
    """

    def __init__(self, folder: Path, links: tuple[str, ...], resume_bytes: int | None = None) -> None:
        self.folder = folder
        self._files: dict[str, BinaryIO] = {}
        self._dirty: set[str] = set()
        self.failed = ""
        self._written_to, self._received = -1, resume_bytes or 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if resume_bytes is None:
                for old in (*folder.glob("link*.tlog"), *folder.glob("link*.nmea"), *folder.glob(f"{SENT}.*")):
                    old.unlink()
                for name in (RECEIVED, FIXES, REMARKS):
                    (folder / name).write_bytes(b"")
                self._write(RECEIVED, header(links))
            else:
                os.truncate(folder / RECEIVED, resume_bytes)
                self._written_to = _last_packet(folder / FIXES)
        except OSError as problem:
            raise DataError(f"{folder}: cannot be written ({problem.strerror}), expected a folder") from None

    def packet(self, packet: Packet) -> None:
        """One packet that came in."""
        self._write(RECEIVED, record(packet))
        self.frame(packet)

    def frame(self, packet: Packet) -> None:
        """The same in the log of its link alone."""
        if not packet.data:
            return  # the word that time passes
        if packet.data[:1] in (b"\xfd", b"\xfe"):
            self._write(f"link{packet.link}.tlog", _STAMP.pack(packet.stamp_us) + packet.data)
        else:
            self._write(f"link{packet.link}.nmea", packet.data.rstrip(b"\r\n") + b"\r\n")

    def fix(self, number: int, fix: Fix) -> None:
        """One fix that came of packet `number`; left out where it was written before a crash."""
        if number > self._written_to:
            self._write(FIXES, as_line({"packet": number, **facts_of(fix)}))

    def remark(self, remark: Remark) -> None:
        """One remark."""
        told = {"stamp_us": remark.stamp_us, "level": remark.level, "key": remark.key, "text": remark.text}
        self._write(REMARKS, as_line(told))

    def sent(self, output: str, stamp_us: int, data: bytes) -> None:
        """One message that went out at this time."""
        if data[:1] in (b"\xfd", b"\xfe"):
            self._write(f"{SENT}.tlog", _STAMP.pack(stamp_us) + data)
        else:
            told = {"stamp_us": stamp_us, "output": output, "text": data.decode("utf-8", "replace").strip()}
            self._write(f"{SENT}.jsonl", as_line(told))

    def _write(self, name: str, data: bytes) -> None:
        """Append; after a failure (a full disk) nothing more is written, and the run goes on."""
        if self.failed:
            return
        try:
            if name not in self._files:
                self._files[name] = (self.folder / name).open("ab")
            self._files[name].write(data)
            self._dirty.add(name)
            self._received += len(data) if name == RECEIVED else 0
        except (OSError, ValueError) as problem:
            self._fail(name, problem)

    def _fail(self, name: str, problem: Exception) -> None:
        reason = getattr(problem, "strerror", None) or problem
        self.failed = f"{self.folder / name}: cannot be written ({reason}); nothing is recorded from here on"

    def flush(self) -> None:
        """Hand all that was written to the system."""
        for name in sorted(self._dirty):
            try:
                self._files[name].flush()
            except (OSError, ValueError) as problem:
                self._fail(name, problem)
        self._dirty.clear()

    @property
    def received_bytes(self) -> int:
        """How long the container is, all of it flushed."""
        self.flush()
        return self._received

    def close(self) -> None:
        """Flush and close everything."""
        self.flush()
        for file in self._files.values():
            try:
                file.close()
            except OSError as problem:
                self._fail(file.name, problem)
        self._files.clear()


def _last_packet(path: Path) -> int:
    """The packet of the last whole line of the fixes, -1 for none; half a line behind it is cut off."""
    if not path.is_file():
        return -1
    with path.open("rb+") as stream:
        size = stream.seek(0, os.SEEK_END)
        start = max(0, size - _TAIL_BYTES)
        stream.seek(start)
        tail = stream.read()
        whole = tail.rfind(b"\n") + 1
        stream.truncate(start + whole)
    for line in reversed(tail[:whole].splitlines()):
        try:
            return int(json.loads(line)["packet"])
        except (ValueError, KeyError, TypeError):
            continue
    return -1

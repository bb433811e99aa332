"""open_log: any log there is a reader for, known by what is in it and not by its name."""

from __future__ import annotations

import importlib
import re
import struct
import warnings
from pathlib import Path

from terranav.core.checks import finite
from terranav.core.errors import DataError, DataWarning
from terranav.io.files import existing_file
from terranav.io.logs.assembly import Log, assembled
from terranav.io.logs.found import Found

FORMATS = "ArduPilot .BIN, MAVLink .tlog, PX4 .ulg, ROS bag (.bag, .db3, .mcap or a folder), NMEA text, phone CSV"
_WHAT = f"a log ({FORMATS})"
_HEAD_BYTES = 65536
_MAGIC = {
    b"\x55\x4c\x6f\x67\x01\x12\x35": "ulog",
    b"#ROSBAG V": "rosbag",
    b"\x89MCAP0\r\n": "rosbag",
    b"SQLite format 3\0": "rosbag",
}
_WITH_IMU = ("dataflash", "ulog")
_NMEA = re.compile(rb"[$!][A-Z]{1,2}[A-Z0-9]{2}[A-Z],[^\r\n]*", re.ASCII)
#: a tlog's stamps lie in the years 2000 to 2100 [us since 1970]
STAMPS_US = (946_684_800_000_000, 4_102_444_800_000_000)


def open_log(path: str | Path, *, rate_hz: float = 10.0, imu: bool = False) -> Log:
    """Read the log of an autopilot, a robot, a receiver or a phone.

    Parameters
    ----------
    path : str or Path
        ArduPilot DataFlash .BIN, MAVLink .tlog, PX4 .ulg, ROS 1 or 2 bag (a folder with metadata.yaml, .bag, .db3 or
        .mcap), NMEA 0183 text, or a phone's sensor CSV. What it is, is told by its content.
    rate_hz : float
        Epochs are thinned to this rate where the log has more than one and a half times as many [Hz], > 0.
    imu : bool
        Also read the inertial sensors where the log has them (DataFlash, ULog): they are most of such a log.

    Returns
    -------
    Log
        `recording`: epochs of the autopilot's own position (of the GNSS receiver where it logged none), the truth
        (GNSS) in the columns true_*; `facts` and `remarks`: what was found, what GNSS went into, what is missing;
        `beside`: airspeed and, if asked for, inertial sensors.

    Raises
    ------
    DataError
        When the file is no log of these, is damaged so that nothing is left, or holds no position.
    ConfigError
        When the library that reads the format is not installed (extra 'logs'), or rate_hz is impossible.

    Warns
    -----
    DataWarning
        When part of the file could not be read; `remarks` says which.
    """
    finite("open_log rate_hz", rate_hz, above=0.0)
    file = Path(path)
    if file.is_dir():
        if not (file / "metadata.yaml").is_file():
            raise DataError(f"{file}: is a folder without metadata.yaml, expected {_WHAT}")
        kind = "rosbag"
    else:
        kind = format_of(existing_file(file, _WHAT))
    found = _read(kind, file, imu)
    log = assembled(found, float(rate_hz))
    if not found.whole:
        warnings.warn(f"{file}: {found.remarks[0]}", DataWarning, stacklevel=2)
    return log


def _read(kind: str, file: Path, imu: bool) -> Found:
    """Read with the module of this kind of log."""
    more = {"imu": True} if imu and kind in _WITH_IMU else {}
    found: Found = importlib.import_module(f"terranav.io.logs.{kind}").read(file, **more)
    return found


def format_of(file: Path) -> str:
    """Tell 'ulog', 'rosbag', 'dataflash', 'tlog', 'nmea' or 'phone' from a file's content; DataError otherwise."""
    try:
        with file.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError as problem:
        raise DataError(f"{file}: cannot be read ({problem.strerror}), expected {_WHAT}") from None
    for magic, kind in _MAGIC.items():
        if head.startswith(magic):
            return kind
    flash, frames = head[:4096].find(b"\xa3\x95\x80"), _tlog_begins(head)
    if frames >= 0 and not 0 <= flash < frames:  # a telemetry log may hold a DataFlash log that was streamed
        return "tlog"
    if flash >= 0:
        return "dataflash"
    if _NMEA.search(head):
        return "nmea"
    if b"\0" not in head:
        names = {
            name.strip().strip('"').lower() for name in head.split(b"\n", 1)[0].decode("utf-8", "replace").split(",")
        }
        if {"latitude", "longitude"} <= names:
            return "phone"
    if head.startswith(b"FMT, "):
        raise DataError(f"{file}: is a DataFlash log as text (.log), expected the binary one (.BIN)")
    shown = "only zeros" if not head.strip(b"\0") else f"{head[:8]!r}"
    raise DataError(f"{file}: begins with {shown}, expected {_WHAT}; for any other table: terranav convert")


def _tlog_begins(head: bytes) -> int:
    """Where in the head MAVLink frames, each after a time stamp, begin to follow one another; -1 where they do not."""
    for start in range(min(len(head), 4096) - 17):
        if head[start + 8] not in (0xFD, 0xFE):
            continue
        (stamp,) = struct.unpack_from(">Q", head, start)
        if not STAMPS_US[0] < stamp < STAMPS_US[1]:
            continue
        after = start + 8 + frame_bytes(head, start + 8)
        if after + 9 > len(head) or head[after + 8] in (0xFD, 0xFE):
            return start
    return -1


def frame_bytes(data: bytes, at: int) -> int:
    """The length of the MAVLink frame (version 1 or 2) whose header begins at `at` [bytes]."""
    if data[at] == 0xFE:
        return data[at + 1] + 8
    return data[at + 1] + 12 + (13 if data[at + 2] & 1 else 0)

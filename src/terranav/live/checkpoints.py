"""Checkpoints of a live run: the newest two, each whole or not there.

A file is the line `terranav-checkpoint 1`, a line of JSON (what of the recording it stands for), 32 bytes of SHA-256
over all that follows and that line, and the engine's own bytes. It is written beside its name, flushed to the disk and
renamed. The engine's bytes are a pickle: a folder of checkpoints is to be trusted like a program.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from terranav.io.files import replacing

_MAGIC = b"terranav-checkpoint 1\n"
_KEPT = 2
_PATTERN = "checkpoint-*.tncp"


def write(folder: Path, facts: Mapping[str, Any], engine: bytes) -> Path:
    """Write a checkpoint and remove all but the newest two.

    Parameters
    ----------
    folder : Path
    facts : mapping
        'packets': how many packets it stands for; it names the file, and must grow.
    engine : bytes

    Raises
    ------
    DataError
        When it cannot be written.
    """
    path = folder / f"checkpoint-{facts['packets']:012d}.tncp"
    told = json.dumps(facts).encode() + b"\n"
    with replacing(path) as aside, aside.open("wb") as stream:
        stream.write(_MAGIC + told + hashlib.sha256(told + engine).digest() + engine)
        stream.flush()
        os.fsync(stream.fileno())
    for old in _newest_first(folder)[_KEPT:]:
        with suppress(OSError):
            old.unlink()
    return path


def remove_all(folder: Path) -> None:
    """Remove the checkpoints of an earlier run."""
    for old in _newest_first(folder):
        with suppress(OSError):
            old.unlink()


def usable(folder: Path, remarks: list[str]) -> Iterator[tuple[dict[str, Any], bytes]]:
    """What is read of each checkpoint that is whole, the newest first; of others a remark says what is wrong."""
    for path in _newest_first(folder):
        try:
            data = path.read_bytes()
        except OSError as problem:
            remarks.append(f"{path.name}: cannot be read ({problem.strerror}), the one before it is taken")
            continue
        end = data.find(b"\n", len(_MAGIC)) + 1
        told, digest, engine = data[len(_MAGIC) : end], data[end : end + 32], data[end + 32 :]
        if not data.startswith(_MAGIC) or not end or hashlib.sha256(told + engine).digest() != digest:
            remarks.append(f"{path.name}: is broken or no checkpoint, the one before it is taken")
            continue
        yield json.loads(told), engine


def _newest_first(folder: Path) -> list[Path]:
    """The checkpoints of a folder."""
    return sorted(folder.glob(_PATTERN), reverse=True) if folder.is_dir() else []

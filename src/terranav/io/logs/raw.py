"""What every reader of a binary log does with the file: the library it needs, the bytes, and where they end."""

from __future__ import annotations

import importlib
import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from terranav.core.errors import ConfigError, DataError

#: after so many bytes without a whole message the rest of a file is not read
GIVE_UP_BYTES = 64 << 20
_BLOCK = 1 << 20
_ZEROS = bytes(_BLOCK)
#: so many zeros at the end of a file may belong to its last message
SPARE_BYTES = 512


def library(module: str, path: Path, what: str) -> Any:
    """Import a library of the extra 'logs'; ConfigError, saying how to get it, where it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        name = module.split(".", maxsplit=1)[0]
        raise ConfigError(f"{path}: {what} needs {name}, which is not installed: pip install terranav[logs]") from None


@contextmanager
def mapped(path: Path) -> Iterator[tuple[mmap.mmap, int]]:
    """Map a file without the zeros at its end, and say how many those are; DataError where it holds nothing else."""
    try:
        with path.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            end = _end(stream, size)
            if end == 0:
                raise DataError(f"{path}: all of its {size} bytes are zero, expected a log")
            end = min(size, end + SPARE_BYTES)
            data = mmap.mmap(stream.fileno(), end, access=mmap.ACCESS_READ)
    except OSError as problem:
        raise DataError(f"{path}: cannot be read ({problem.strerror or problem}), expected a log") from None
    try:
        yield data, size - end
    finally:
        data.close()


def _end(stream: Any, size: int) -> int:
    """One past the last byte that is not zero."""
    end = size
    while end > 0:
        start = max(0, end - _BLOCK)
        stream.seek(start)
        block = stream.read(end - start)
        if block != _ZEROS[: len(block)]:
            return start + len(block.rstrip(b"\0"))
        end = start
    return 0


@contextmanager
def silent() -> Iterator[None]:
    """Keep what a library prints from the terminal; what matters is said in the remarks."""
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield

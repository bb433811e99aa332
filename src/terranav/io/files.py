"""What every reader and writer of io does with a file: the first checks, and replacing it in one go."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from terranav.core.errors import DataError, TerranavError


def existing_file(path: str | Path, what: str, error: type[TerranavError] = DataError) -> Path:
    """Return `path` when it is a file with something in it, or raise `error` saying that `what` was expected."""
    file = Path(path)
    try:
        if file.is_dir():
            raise error(f"{file}: is a folder, expected {what}")
        if not file.exists():
            raise error(f"{file}: no such file, expected {what}")
        if file.stat().st_size == 0:
            raise error(f"{file}: the file is empty, expected {what}")
    except OSError as problem:
        raise error(f"{file}: cannot be read ({problem.strerror}), expected {what}") from None
    return file


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a name beside `path` to write to, and rename it to `path` when all went well.

    Who reads `path` meanwhile sees the old file or the new one, never a part; a failed write leaves nothing behind.

    Raises
    ------
    DataError
        When the folder does not exist or cannot be written, or `path` is a folder.
    """
    file = Path(path)
    if file.is_dir():
        raise DataError(f"{file}: is a folder, expected the name of a file to write")
    if not file.parent.is_dir():
        raise DataError(f"{file}: cannot be written, {file.parent} is not a folder")
    aside = file.with_name(f".{file.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        yield aside
        aside.replace(file)
    except OSError as problem:
        raise DataError(f"{file}: cannot be written ({problem.strerror or problem})") from None
    finally:
        with suppress(OSError):
            aside.unlink(missing_ok=True)


def read_parquet(path: str | Path, what: str) -> Any:
    """Return the pyarrow table in a Parquet file; DataError, saying that `what` was expected, for any other file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = existing_file(path, what)
    try:
        with pq.ParquetFile(file) as parquet:
            return parquet.read()
    except (pa.ArrowException, OSError) as problem:
        reason = next(iter(str(problem).splitlines()), type(problem).__name__)
        raise DataError(f"{path}: is not a readable Parquet file ({reason}), expected {what}") from None

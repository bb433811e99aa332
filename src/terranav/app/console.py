"""The terminal: results on stdout, everything else one line each on stderr, and exit statuses.

0: done. 1: done, but something was left out (a picture failed, the disk is full).
2: wrong use or wrong input. 130: stopped.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import sys
import warnings
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any

from terranav.core.errors import DataWarning

if TYPE_CHECKING:
    from rich.console import RenderableType

OK, INCOMPLETE, WRONG, STOPPED = 0, 1, 2, 130


def one_line(text: object) -> str:
    """Any message as one line."""
    return " ".join(str(text).split())


def complain(text: object, level: str = "error") -> None:
    """Write one line to stderr: 'terranav: error: ...'."""
    sys.stderr.write(f"terranav: {level}: {one_line(text)}\n")


def width() -> int:
    """Columns of the terminal; wide enough for every table where stdout is none."""
    return shutil.get_terminal_size((100, 24)).columns if sys.stdout.isatty() else 120


def show(*parts: RenderableType) -> None:
    """Print tables and text to stdout, in colour only on a terminal."""
    from rich.console import Console

    console = Console(file=sys.stdout, width=width(), highlight=False)
    for part in parts:
        console.print(part)


def show_pairs(pairs: Iterable[tuple[str, str]]) -> None:
    """Print one line for each name and text."""
    from rich.text import Text

    show(*[Text.assemble((f"{name:<11}", "dim"), one_line(text)) for name, text in pairs])


def show_json(data: Any) -> None:
    """Print one JSON document to stdout."""
    sys.stdout.write(as_json(data) + "\n")


def as_json(data: Any) -> str:
    """JSON that every parser takes: NaN and infinity become null, numpy values plain ones."""
    return json.dumps(_plain(data), indent=2, allow_nan=False, ensure_ascii=False)


def _plain(value: Any) -> Any:
    """The value in the types that JSON has."""
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


@contextlib.contextmanager
def data_warnings() -> Iterator[None]:
    """Show each distinct DataWarning once, as one line on stderr; leave other warnings to Python."""
    seen: set[str] = set()
    with warnings.catch_warnings():
        python_shows = warnings.showwarning

        def shown(message: Warning | str, category: type[Warning], *where: Any, **rest: Any) -> None:
            if not issubclass(category, DataWarning):
                python_shows(message, category, *where, **rest)
            elif str(message) not in seen:
                seen.add(str(message))
                complain(message, "warning")

        warnings.showwarning = shown
        warnings.simplefilter("always", DataWarning)
        yield


@contextlib.contextmanager
def working(what: str) -> Iterator[None]:
    """Show a spinner with the time it takes on stderr while something runs; nothing when stderr is no terminal."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(file=sys.stderr), transient=True) as progress:
        progress.add_task(what)
        yield


def silence_broken_pipe() -> None:
    """After a reader went away: keep the interpreter from complaining once more when it flushes stdout at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())

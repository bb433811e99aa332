"""terranav bench: how fast terranav is here, beside its peers and the machine's limits."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from terranav.app.commands import options


def bench(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="These benchmarks alone, such as pointmass.")
    ] = None,
    *,
    growth: Annotated[
        bool, typer.Option("--growth", help="Instead: how time grows with cells, particles, epochs, maps and runs.")
    ] = False,
    as_json: options.Json = False,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the JSON document to this file, too.")] = None,
) -> int:
    """Measure speed: time, ratio to each peer and distance to the machine's limit, one line each.

    Peers are what is installed of numpy, scipy, contourpy, stonesoup and filterpy. Exit status 1 when a ratio falls
    below what it is held to.
    """
    from terranav.core.errors import ConfigError

    if out is not None and not out.absolute().parent.is_dir():
        raise ConfigError(f"--out is {str(out)!r}, expected a file in a folder that exists")
    if growth and names:
        raise ConfigError(f"--growth is a table of its own, expected no name beside it, not {names[0]!r}")
    table = _benchmarks()
    known = table.names()
    for name in names or ():
        if name not in known:
            raise ConfigError(f"no benchmark {name!r}, expected of {', '.join(known)}")
    chosen = ["growth"] if growth else names or known
    status: int = table.printed(chosen, as_json=as_json, out=out)
    return status


def _benchmarks() -> ModuleType:
    """The package `benchmarks`: beside src in a checkout, within terranav where it is installed."""
    here = Path(__file__).resolve().parents[2]
    for folder in (here / "_benchmarks", here.parents[1]):
        if (folder / "benchmarks" / "table.py").is_file():
            sys.path.append(str(folder))
            return import_module("benchmarks.table")
    from terranav.core.errors import StateError

    raise StateError(
        "this installation of terranav lacks the folder benchmarks, expected it beside src or in the wheel"
    )

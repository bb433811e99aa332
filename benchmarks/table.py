"""The table of all benchmarks: as lines of text, as JSON, and what falls short of what it is held to."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Iterable, Iterator
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from benchmarks.timing import Limit, Peer, Row

LIBRARIES = ("numpy", "scipy", "numba", "stonesoup", "filterpy", "contourpy")


def printed(chosen: Iterable[str], *, as_json: bool = False, out: Path | None = None) -> int:
    """Run benchmarks and print each as soon as it is done; 1 when a ratio falls below what it is held to, else 0.

    Parameters
    ----------
    chosen : names of benchmarks
    as_json : one JSON document on stdout at the end instead of the table
    out : file for that document, written after each benchmark
    """
    done: list[Row] = []
    for name in chosen:
        for row in rows_of(name):
            done.append(row)
            if not as_json:
                print(*lines(row), sep="\n", flush=True)
            if out is not None:
                out.write_text(document(done) + "\n")
    if as_json:
        print(document(done))
    lost = [line for row in done for line in short(row)]
    for line in lost:
        print(f"below what it is held to: {line}", file=sys.stderr)
    return 1 if lost else 0


def names() -> list[str]:
    """Benchmarks by name: the modules beside this one that have rows()."""
    here = import_module(__package__)
    found = sorted(module.name for module in iter_modules(here.__path__) if module.name not in ("__main__", "growth"))
    return [name for name in found if hasattr(import_module(f"{__package__}.{name}"), "rows")]


def rows_of(name: str) -> Iterator[Row]:
    """Run one benchmark; each row comes as soon as it is measured, where the benchmark yields them."""
    yield from import_module(f"{__package__}.{name}").rows()


def lines(row: Row) -> list[str]:
    """A row as text: a line for each peer and one for the machine's limit."""
    said = [f"{row.work:62}{time_said(row.ns):>11} per {row.per}"]
    for peer in row.peers:
        said.append(f"    {peer.ns / row.ns:7.1f}x  {peer.name}, {time_said(peer.ns)}{_goal(peer)}")
    if row.limit is not None:
        limit = row.limit
        said.append(
            f"    {row.ns / limit.ns:7.2f}x  above the limit, {limit.name}, {time_said(limit.ns)}{_goal(limit)}"
        )
    return said


def _goal(beside: Peer | Limit) -> str:
    if not beside.goal:
        return ""
    return f"  (goal {beside.goal:g}x, not reached)" if beside.reached else f"  (goal {beside.goal:g}x)"


def time_said(ns: float) -> str:
    """A time in the unit that suits it."""
    for unit, size in (("s", 1e9), ("ms", 1e6), ("us", 1e3)):
        if ns >= size:
            return f"{ns / size:.3g} {unit}"
    return f"{ns:.3g} ns"


def short(row: Row) -> list[str]:
    """What a row falls short of, beyond the slack."""
    lost = [
        f"{row.work}: {peer.ns / row.ns:.1f}x {peer.name}, held to {peer.held_to:.1f}x"
        for peer in row.peers
        if peer.ns / row.ns < peer.held_to
    ]
    limit = row.limit
    if limit is not None and limit.goal and row.ns / limit.ns > limit.held_to:
        lost.append(f"{row.work}: {row.ns / limit.ns:.2f}x the limit, held to {limit.held_to:.2f}x")
    return lost


def document(rows: Iterable[Row]) -> str:
    """Rows with the machine and the libraries that they were measured with."""
    return json.dumps({"machine": machine(), "rows": [_entry(row) for row in rows]}, indent=1)


def machine() -> dict[str, Any]:
    """Processor, cores, interpreter and libraries."""
    libraries = {}
    for name in LIBRARIES:
        try:
            libraries[name] = version(name)
        except PackageNotFoundError:
            libraries[name] = "not installed"
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "libraries": libraries,
    }


def _processor() -> str:
    described = Path("/proc/cpuinfo")
    if described.is_file():
        for line in described.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _entry(row: Row) -> dict[str, Any]:
    entry: dict[str, Any] = {"work": row.work, "per": row.per, "ns": row.ns, "peers": []}
    for peer in row.peers:
        entry["peers"].append(
            {"name": peer.name, "ns": peer.ns, "ratio": peer.ns / row.ns, "goal": peer.goal, "held_to": peer.held_to}
        )
    if row.limit is not None:
        limit = row.limit
        times, held_to = row.ns / limit.ns, limit.held_to
        entry["limit"] = {"name": limit.name, "ns": limit.ns, "times": times, "goal": limit.goal, "held_to": held_to}
    return entry

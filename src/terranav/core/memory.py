"""How much memory there is, asked before much of it is taken."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from terranav.core.errors import ConfigError

SMALL = 64 * 2**20  # what is asked for below this is not worth a look
_CGROUP = Path("/sys/fs/cgroup")


def need(size: float, what: str) -> None:
    """Refuse work whose arrays do not fit into the memory that is left.

    Parameters
    ----------
    size : float
        What it will take [bytes].
    what : str
        What for, and with which figures: the message begins with it.

    Raises
    ------
    ConfigError
        It names the memory needed, the memory left, and what sets that.
    """
    if size < SMALL:
        return
    left, why = available()
    if size > left:
        raise ConfigError(f"{what}: needs {_said(size)} of memory, but {_said(max(left, 0.0))} is left ({why})")


def available() -> tuple[float, str]:
    """The least of what the limits on this process and the machine leave [bytes], and which of them it is."""
    return min(_limits(), default=(float("inf"), "no limit known"))


def _limits() -> list[tuple[float, str]]:
    found = [(_address_space(), "limit on the address space, ulimit -v"), (_cgroup(), "limit of the control group")]
    found.append((_machine(), "memory of the machine"))
    return [(left, why) for left, why in found if left < float("inf")]


def _address_space() -> float:
    if sys.platform == "win32":
        return float("inf")
    import resource

    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return float("inf")
    used = _first_number(Path("/proc/self/statm"))
    return limit - used * os.sysconf("SC_PAGE_SIZE") if used < float("inf") else float(limit)


def _cgroup() -> float:
    """What the control group of a container leaves; files cached in memory can go, and do not count as used."""
    limit, used = _first_number(_CGROUP / "memory.max"), _first_number(_CGROUP / "memory.current")
    cached = _named(_CGROUP / "memory.stat", "inactive_file")
    return limit - (used - cached) if max(limit, used) < float("inf") else float("inf")


def _machine() -> float:
    left = _named(Path("/proc/meminfo"), "MemAvailable:")
    if left > 0.0:
        return 1024.0 * left
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):  # not known on this system
        return float("inf")


def _first_number(file: Path) -> float:
    """The first word of a file; infinite where there is none or it is not a number ('max')."""
    try:
        return float(file.read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return float("inf")


def _named(file: Path, name: str) -> float:
    """The number after a name at the start of a line; zero where there is none."""
    try:
        lines = file.read_text().splitlines()
    except OSError:
        return 0.0
    return next(
        (float(line.split()[1]) for line in lines if line.startswith(f"{name} ") or line.startswith(f"{name}\t")), 0.0
    )


def _said(size: float) -> str:
    return f"{size / 2**30:.1f} GiB" if size >= 2**30 else f"{size / 2**20:.0f} MiB"

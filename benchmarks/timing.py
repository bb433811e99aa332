"""Interleaved repeats, the least time of each: what is left when other processes disturb least."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    work: str
    per: str
    ours_ns: float
    peer: str
    peer_ns: float
    least_ratio: float

    @property
    def ratio(self) -> float:
        return self.peer_ns / self.ours_ns


def least_ns(calls: Mapping[str, Callable[[], object]], units: int, repeats: int = 9) -> dict[str, float]:
    """Nanoseconds per unit of each call, the least of interleaved repeats; each runs once before."""
    for call in calls.values():
        call()
    least = dict.fromkeys(calls, float("inf"))
    for _ in range(repeats):
        for name, call in calls.items():
            start = time.perf_counter_ns()
            call()
            least[name] = min(least[name], float(time.perf_counter_ns() - start))
    return {name: value / units for name, value in least.items()}

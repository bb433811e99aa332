"""Interleaved repeats, the least time of each: what is left when other processes disturb least."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

SLACK = 0.7  # a ratio may fall to this share of what is meant on a busy machine before it counts as lost


@dataclass(frozen=True)
class Peer:
    """Another program that did the same work in the same process.

    Attributes
    ----------
    name : str
    ns : float
        Its time per unit of work [ns].
    goal : float
        How many times faster terranav means to be; 0 where nothing is claimed.
    reached : float
        How many times faster it can be so far, where that is below the goal: the ratio is held to this one.
    """

    name: str
    ns: float
    goal: float = 0.0
    reached: float = 0.0

    @property
    def held_to(self) -> float:
        """The least ratio before the row counts as lost."""
        return SLACK * (self.reached or self.goal)


@dataclass(frozen=True)
class Limit:
    """The least time that the machine allows for the work, from figures measured in the same run (`limits`).

    Attributes
    ----------
    name : str
        What sets it.
    ns : float
        Per unit of work [ns].
    goal : float
        How many times longer terranav means to take at most; 0 where nothing is claimed.
    reached : float
        As of a peer, where that is above the goal.
    """

    name: str
    ns: float
    goal: float = 0.0
    reached: float = 0.0

    @property
    def held_to(self) -> float:
        """The largest multiple before the row counts as lost."""
        return (self.reached or self.goal) / SLACK


@dataclass(frozen=True)
class Row:
    """One line of the table: terranav beside its peers and beside the machine.

    Attributes
    ----------
    work : str
    per : str
        The unit of work: 'cell', 'particle', 'point'.
    ns : float
        terranav's time per unit [ns].
    peers : tuple of Peer
        Empty where none is installed.
    limit : Limit or None
    """

    work: str
    per: str
    ns: float
    peers: tuple[Peer, ...] = ()
    limit: Limit | None = None


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

"""What a study is: cases, one run of a case, and what the runs of all cases say, with intervals and verdicts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from terranav.experiment.montecarlo import Interval
from terranav.experiment.papers.outcome import Table

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Setup:
    """What a study is asked to look at.

    Attributes
    ----------
    data : Path or None
        Folder with real maps and recordings; None: only what is always at hand, the sample DEM.
    maps : tuple of Path
        More terrain maps.
    tracks : int or None
        Tracks on each map, where a study draws tracks; None is the study's own number.
    seed : int
        Of the tracks and of every run.
    only : tuple of str
        Leave out cases whose name contains none of these; empty for all.
    settings : mapping
        Of the estimator, other than its defaults.
    """

    data: Path | None = None
    maps: tuple[Path, ...] = ()
    tracks: int | None = None
    seed: int = 0
    only: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)


class Case(Protocol):
    """One case: a small picklable description from which a process makes what it needs."""

    @property
    def name(self) -> str:
        """A name of its own within the study."""
        ...

    def facts(self) -> Mapping[str, Any]:
        """All that its figures depend on besides the program, as plain JSON values."""
        ...


@dataclass(frozen=True)
class CaseRuns:
    """The runs of one case.

    Attributes
    ----------
    case : Case
    figures : mapping of name to (runs,) array
        Of the runs that went well, in their order; a figure that a run lacks is NaN.
    failed : int
    first_error : str
    """

    case: Any
    figures: Mapping[str, FloatArray]
    failed: int = 0
    first_error: str = ""

    @property
    def runs(self) -> int:
        """How many went well."""
        return len(next(iter(self.figures.values()), ()))

    def __getitem__(self, name: str) -> FloatArray:
        """(runs,) values of a figure; NaN where no run has it."""
        return self.figures.get(name, np.full(self.runs, math.nan))


@dataclass(frozen=True)
class Verdict:
    """One figure that was asked for: what, the limit, ours with its interval, and whether it is met (None: no data)."""

    text: str
    asked: str
    measured: str
    met: bool | None


@dataclass(frozen=True)
class Report:
    """What a study says.

    Attributes
    ----------
    tables : sequence of Table
    verdicts : sequence of Verdict
    notes : sequence of str
        What was left out and why, and how the figures are made: one line each.
    figures : sequence of mapping
        The rows of the tables as plain numbers, for programs; intervals as [value, low, high].
    """

    tables: Sequence[Table]
    verdicts: Sequence[Verdict] = ()
    notes: Sequence[str] = ()
    figures: Sequence[Mapping[str, Any]] = ()


@dataclass(frozen=True)
class Plan:
    """The cases of a study, and what was left out of it and why."""

    cases: Sequence[Case]
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Study:
    """A study; the functions are those of modules, so that it can be sent to other processes.

    Attributes
    ----------
    name : str
        Of the command.
    title : str
        What it asks, in one line.
    plan : callable
        Setup -> Plan. Checks what it is given: ConfigError, DataError.
    run : callable
        (case, seed of the run) -> flat dict of name to float. It may raise: the run is then counted as failed.
    report : callable
        Runs of all cases -> Report.
    runs : int
        Of each case, unless asked otherwise.
    chunk : int
        Runs in one file: what a kill can cost.
    family : str
        Studies of one family are summaries of the same runs and share a folder; by default the name.
    """

    name: str
    title: str
    plan: Callable[[Setup], Plan]
    run: Callable[[Any, SeedSequence], Mapping[str, float]]
    report: Callable[[Sequence[CaseRuns]], Report]
    runs: int = 100
    chunk: int = 5
    family: str = ""

    @property
    def of_runs(self) -> str:
        """Name of the family."""
        return self.family or self.name


def shown(interval: Interval, digits: int = 2, unit: str = "", scale: float = 1.0) -> str:
    """An interval as text: '1.04 (1.02..1.06)', a dash where there is no figure."""
    if not math.isfinite(interval.value):
        return "–"
    return interval.text(digits, scale) + (f" {unit}" if unit else "")


def plain(interval: Interval) -> list[float | None]:
    """[value, low, high] for JSON."""
    return [value if math.isfinite(value) else None for value in (interval.value, interval.low, interval.high)]

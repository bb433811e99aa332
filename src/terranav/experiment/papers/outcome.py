"""What a reproduction says: tables, claims with verdicts, and the data of the redrawn figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from terranav.experiment.montecarlo import Executor, Failure
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
Verdict = Literal["holds", "holds in part", "does not hold"]


@dataclass(frozen=True)
class Setup:
    """How a paper is to be reproduced.

    Attributes
    ----------
    runs : int
        Monte Carlo runs of each case, >= 2.
    seed : int
    maps : tuple of Map
        Maps given by the user in place of the default ones; empty for the defaults.
    executor : Executor or None
    on_run : callable or None
        Called with (done, all) while it works.
    """

    runs: int = 50
    seed: int = 0
    maps: tuple[Map, ...] = ()
    executor: Executor | None = None
    on_run: Callable[[int, int], None] | None = None


@dataclass(frozen=True)
class Claim:
    """One claim of the paper: its words, its figure, ours with the 95 % interval, the verdict and its reason."""

    text: str
    paper: str
    ours: str
    verdict: Verdict
    why: str


@dataclass(frozen=True)
class Table:
    """A table as printed: title, column heads, rows of text."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Series:
    """One line, cloud or histogram of a figure; x and y are (n,), y may have NaN."""

    label: str
    x: FloatArray
    y: FloatArray
    low: FloatArray | None = None
    high: FloatArray | None = None


@dataclass(frozen=True)
class Figure:
    """A redrawn figure: drawn by the app, so that no study knows a plotting library.

    `kind`: 'lines' (with a band where a series has low and high), 'points', or 'bars' (x: centres, y: heights).
    """

    name: str
    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    kind: Literal["lines", "points", "bars"] = "lines"
    log_y: bool = False


@dataclass(frozen=True)
class Reproduction:
    """The outcome for one paper.

    Attributes
    ----------
    paper : str
        '000' .. '004'.
    title : str
        The method, and where it was published.
    scenario : str
        What was run, in a few sentences, with the choices made where the paper leaves one open.
    runs : int
    tables, claims, figures : sequences
    failures : sequence of Failure
    """

    paper: str
    title: str
    scenario: str
    runs: int
    tables: Sequence[Table]
    claims: Sequence[Claim]
    figures: Sequence[Figure] = ()
    failures: Sequence[Failure] = field(default_factory=tuple)

"""What the monitor remembers beside the state of the estimator that it watches."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.records import Epoch, Innovation, Prior, Status
from terranav.integrity.protection import Tail
from terranav.integrity.rivals import Rivals, Standing
from terranav.integrity.windows import Window

FloatArray = NDArray[np.float64]
Counted = tuple[str, float, float, float]  # kind, time [s], latitude, longitude [deg]


@dataclass(frozen=True, slots=True)
class Anchor:
    """An INS error that was known: after how many readings, when, and how well [m], [m^2]."""

    readings: int
    time_s: float
    mean_m: FloatArray
    cov_m2: FloatArray


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A kind whose readings move nothing.

    Attributes
    ----------
    kind : str
    reason : str
    since : int
        Count of readings of all kinds when it was left out.
    stuck : bool
        Because the sensor repeats one value; else because readings and map contradict each other.
    trial : bool
        To see whether the position is found without it.
    strikes : int
        How often it was left out before: it has to agree for longer each time.
    """

    kind: str
    reason: str
    since: int
    stuck: bool = False
    strikes: int = 0
    trial: bool = False


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is said of the estimate; the fields are those of `Estimate`."""

    status: Status = Status.SEARCHING
    nis: float = math.nan
    protection_m: float = math.inf
    usable: bool = False
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class MonitorState:
    """State of `Monitored`.

    Attributes
    ----------
    inner : state of the estimator that is watched
    prior : Prior
        Of the start.
    epoch : Epoch or None
        The latest.
    start_s : float
        Time of the first epoch [s].
    windows : tuple of Window, one a map kind
    readings : int
        Compared with a map since the start.
    since : int
        Of these, since the estimator last started anew.
    last_s : float
        Time of the latest [s].
    gap_s : float
        Typical time between two of them [s].
    silence_s : float
        Length of the latest outage, until the position is found again; else 0 [s].
    off_map : int
        How many epochs in a row had readings of which the map says nothing.
    mean_m, sigma_m : (2,), float
        The estimated INS error and its largest axis [m].
    spread_m : float
        Largest sigma since the estimator last started: how far rivals are looked for [m].
    rivals : Rivals or None
        Since the fix; None before.
    standing : Standing or None
    tail : Tail
    fixed : bool
        Whether there was a fix that proved itself, since the start or since it was last lost.
    lost : str
        Why the position is lost, empty when it is not.
    attempt : int
        How many times it was searched anew since.
    doubted : int
        Count of readings when they began to contradict the map, -1 when they do not.
    anchors : tuple of Anchor, oldest first
    left_out : tuple of LeftOut
    factors : tuple of (kind, float)
        How many times larger the sigmas of a kind's readings are taken than told.
    innovations : tuple of Innovation
        Of the latest epoch's readings that count.
    counted : tuple of Counted
        The latest reading of each kind that counted.
    """

    inner: Any
    prior: Prior
    epoch: Epoch | None = None
    start_s: float = 0.0
    windows: tuple[Window, ...] = ()
    readings: int = 0
    since: int = 0
    last_s: float = math.nan
    gap_s: float = math.nan
    silence_s: float = 0.0
    off_map: int = 0
    mean_m: FloatArray = field(default_factory=lambda: np.zeros(2))
    sigma_m: float = math.inf
    spread_m: float = 0.0
    rivals: Rivals | None = None
    standing: Standing | None = None
    tail: Tail = field(default_factory=Tail)
    fixed: bool = False
    lost: str = ""
    attempt: int = 0
    doubted: int = -1
    anchors: tuple[Anchor, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    factors: tuple[tuple[str, float], ...] = ()
    innovations: tuple[Innovation, ...] = ()
    counted: tuple[Counted, ...] = ()
    verdict: Verdict = field(default_factory=Verdict)

    @property
    def silent(self) -> frozenset[str]:
        """Kinds that are left out."""
        return frozenset(one.kind for one in self.left_out)

    def factor(self, kind: str) -> float:
        """How many times larger this kind's sigmas are taken than told."""
        return dict(self.factors).get(kind, 1.0)

"""What an estimate is worth: one rule of status for every estimator.

Two things are judged: how wide the estimate is (its largest 1-sigma axis) and whether the readings agree with it (the
normalised innovation squared, NIS, smoothed over the latest readings).

For readings as noisy as told one NIS is chi-square with 1 degree of freedom (Bar-Shalom, Li and Kirubarajan, Estimation
with Applications to Tracking and Navigation, 2001, section 5.4), mean 1 and variance 2. Their exponential average of
memory n has variance 2/(2n - 1), so it is close to chi-square with 2n - 1 degrees of freedom over that number. With n =
16 (31 degrees of freedom) it exceeds 1.97 once in 1e3 readings and 2.7 once in 1e6. Told sigmas are seldom that good,
hence the two limits: 4 is past the once-in-1e3 level even when the readings are 1.4 times as noisy as told, and 9 even
when they are 2.1 times as noisy: beyond it, not the noise but the place is wrong.
One NIS counts for at most four times the upper limit, so that a single gross outlier never crosses the lower one: it
adds 36/16 = 2.25.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.errors import ConfigError
from terranav.core.records import Status

HYSTERESIS = 2.0  # a fix is given up at twice the sigma at which it is granted
CAP = 4.0  # one NIS counts for at most this many times nis_lost


@dataclass(frozen=True, slots=True)
class Judge:
    """Limits between one status and the next.

    Attributes
    ----------
    converged_sigma_m : float
        A fix is an estimate whose largest 1-sigma axis is at most this [m].
    nis_degraded, nis_lost : float
        Smoothed NIS above which an estimate is degraded, or lost (see the module docstring for the choice).
    memory : int
        Readings over which the NIS is smoothed, >= 2; nothing is called lost before that many readings.

    Raises
    ------
    ConfigError
        When a limit is not positive or nis_lost is below nis_degraded.
    """

    converged_sigma_m: float = 100.0
    nis_degraded: float = 4.0
    nis_lost: float = 9.0
    memory: int = 16

    def __post_init__(self) -> None:
        finite("converged_sigma_m", self.converged_sigma_m, above=0.0)
        finite("nis_degraded", self.nis_degraded, above=0.0)
        finite("nis_lost", self.nis_lost, minimum=self.nis_degraded)
        if isinstance(self.memory, bool) or not isinstance(self.memory, int) or self.memory < 2:
            raise ConfigError(f"memory is {self.memory!r}, expected a whole number of readings >= 2")


@dataclass(frozen=True, slots=True)
class Judgement:
    """What has been judged so far: part of an estimator's state.

    Attributes
    ----------
    status : Status
    nis : float
        Smoothed NIS, NaN before any reading.
    readings : int
        How many readings it has seen.
    fixed : bool
        Whether there was a fix since the start or since the estimate was last lost.
    off_map : bool
        Whether the map said nothing at the latest reading.
    """

    status: Status = Status.SEARCHING
    nis: float = float("nan")
    readings: int = 0
    fixed: bool = False
    off_map: bool = False


def largest_sigma_m(cov_m2: NDArray[np.float64]) -> float:
    """1-sigma along the longest axis of a (2, 2) covariance [m]."""
    north, cross, east = float(cov_m2[0, 0]), float(cov_m2[0, 1]), float(cov_m2[1, 1])
    return math.sqrt(0.5 * (north + east) + math.hypot(0.5 * (north - east), cross))


def judge(
    settings: Judge,
    before: Judgement,
    sigma_m: float,
    *,
    nis: float = float("nan"),
    readings: int = 1,
    off_map: bool | None = None,
) -> Judgement:
    """Judge an estimate after one more epoch.

    Parameters
    ----------
    settings : Judge
    before : Judgement
        Of the epoch before; Judgement() at the start.
    sigma_m : float
        `largest_sigma_m` of the estimate now [m].
    nis : float
        NIS per reading of this epoch (the mean, when there were several), NaN when there was nothing to compare.
    readings : int
        How many readings that NIS is the mean of.
    off_map : bool or None
        Whether the map says nothing where the latest readings were taken; None when there were none.

    Returns
    -------
    Judgement
        SEARCHING until sigma first comes down to the limit with a passable NIS; then CONVERGED while sigma stays within
        twice the limit and the NIS is passable, DEGRADED otherwise; LOST, from any of them, while the NIS is beyond the
        upper limit and until it is passable again; OFF_MAP as long as the map says nothing.
    """
    smoothed, seen = _smoothed(settings, before, nis, readings)
    if off_map is None:
        off_map = before.off_map
    poor = smoothed > settings.nis_degraded  # NaN: nothing speaks against it
    lost = seen >= settings.memory and smoothed > settings.nis_lost
    if lost or (before.status is Status.LOST and poor):
        return Judgement(Status.OFF_MAP if off_map else Status.LOST, smoothed, seen, False, off_map)
    limit = settings.converged_sigma_m * (HYSTERESIS if before.status is Status.CONVERGED else 1.0)
    fixed = before.fixed or (sigma_m <= limit and not poor and not off_map)
    if off_map:
        status = Status.OFF_MAP
    elif not fixed:
        status = Status.SEARCHING
    else:
        status = Status.CONVERGED if sigma_m <= limit and not poor else Status.DEGRADED
    return Judgement(status, smoothed, seen, fixed, off_map)


def started_over(before: Judgement) -> Judgement:
    """The judgement of an estimator that has thrown its estimate away: still lost, but the next NIS counts afresh."""
    return replace(before, readings=0)


def _smoothed(settings: Judge, before: Judgement, nis: float, readings: int) -> tuple[float, int]:
    """Smoothed NIS and the readings seen: a plain mean at first, exponential once the memory is full."""
    if math.isnan(nis) or readings < 1:
        return before.nis, before.readings
    capped = min(nis, CAP * settings.nis_lost)
    seen = before.readings + readings
    gain = max(1.0 - (1.0 - 1.0 / settings.memory) ** readings, readings / seen)
    return capped if before.readings == 0 else before.nis + gain * (capped - before.nis), seen

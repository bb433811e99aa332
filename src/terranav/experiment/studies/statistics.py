"""Intervals for figures over runs within cases: 95 %, by bootstrap unless said otherwise."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from terranav.experiment.montecarlo import Interval

FloatArray = NDArray[np.float64]
Statistic = Callable[..., FloatArray]

DRAWS = 2000
NOTHING = Interval(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class PerCase:
    """A figure of each case, and its bootstrap replicas over the case's runs.

    Attributes
    ----------
    values : (cases,)
    replicas : (cases, DRAWS)
    """

    values: FloatArray
    replicas: FloatArray

    def interval(self, case: int) -> Interval:
        """Of one case, its runs drawn."""
        return _interval(float(self.values[case]), self.replicas[case])

    def over_cases(self, statistic: Statistic, chosen: NDArray[np.bool_] | None = None) -> Interval:
        """A statistic (taking `axis`) of some cases, all by default; cases and, within each, its runs are drawn."""
        kept = np.flatnonzero(np.isfinite(self.values) & (True if chosen is None else chosen))
        if not kept.size:
            return NOTHING
        drawn = np.random.default_rng(1).choice(kept, (kept.size, DRAWS))
        return _interval(
            float(statistic(self.values[kept], axis=0)), statistic(self.replicas[drawn, np.arange(DRAWS)], axis=0)
        )


def per_case(samples: Sequence[FloatArray], statistic: Statistic) -> PerCase:
    """A statistic of the runs of each case.

    Parameters
    ----------
    samples : sequence of (runs,) or (runs, k) arrays
        The runs of each case, as many runs as it has.
    statistic : callable
        Takes (..., runs) or (..., runs, k) and gives (...).
    """
    values, replicas = [], []
    for number, runs in enumerate(samples):
        if not len(runs):
            values.append(math.nan)
            replicas.append(np.full(DRAWS, math.nan))
            continue
        drawn = np.random.default_rng([2, number]).integers(0, len(runs), (DRAWS, len(runs)))
        values.append(float(statistic(runs)))
        replicas.append(statistic(runs[drawn]))
    return PerCase(np.array(values), np.array(replicas).reshape(-1, DRAWS))


def over_runs(samples: Sequence[FloatArray], statistic: Statistic) -> Interval:
    """A statistic of all runs together, drawn within each case: for cases that are fixed, not a sample.

    Parameters
    ----------
    samples : sequence of (runs,) arrays
        NaN is left out.
    statistic : callable
        Takes an array and `axis`.
    """
    known = [runs[np.isfinite(runs)] for runs in samples]
    known = [runs for runs in known if runs.size]
    if not known:
        return NOTHING
    rng = np.random.default_rng(3)
    drawn = [runs[rng.integers(0, runs.size, (DRAWS, runs.size))] for runs in known]
    return _interval(float(statistic(np.concatenate(known), axis=0)), statistic(np.concatenate(drawn, axis=1), axis=1))


def clopper_pearson(count: int, of: int, confidence: float = 0.95) -> Interval:
    """A share with its exact two-sided interval (Clopper and Pearson, Biometrika 26, 1934)."""
    if not of:
        return NOTHING
    tail = 0.5 * (1.0 - confidence)
    low = float(beta.ppf(tail, count, of - count + 1)) if count else 0.0
    high = float(beta.ppf(1.0 - tail, count + 1, of - count)) if count < of else 1.0
    return Interval(count / of, low, high)


def _interval(value: float, replicas: FloatArray) -> Interval:
    low, high = np.percentile(replicas, [2.5, 97.5])
    return Interval(value, float(low), float(high))

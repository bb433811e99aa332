"""Figures of several methods over the same runs, as a flat dict with the method's name in front; and their summary."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.records import Status
from terranav.experiment.montecarlo import Interval
from terranav.experiment.result import Result
from terranav.experiment.studies.statistics import over_runs
from terranav.experiment.studies.study import CaseRuns, plain, shown

FloatArray = NDArray[np.float64]

LOST_M = 1000.0
OFFERED = (Status.CONVERGED.value, Status.DEGRADED.value)  # a status that offers a position

p95 = partial(np.percentile, q=95.0)


def losses(result: Result, first: int) -> dict[str, float]:
    """Whether a run is lost.

    Parameters
    ----------
    result : Result
    first : int
        Epoch from which on it counts.

    Returns
    -------
    dict
        lost: 1 when it ends beyond 1 km. unsaid: 1 when it is beyond 1 km at any epoch from `first` on with a status
        that offers a position ('converged' or 'degraded').
    """
    distance = np.hypot(*result.error_m.T)
    offered = np.isin(result.status, OFFERED)
    return {
        "lost": float(distance[-1] > LOST_M),
        "unsaid": float(bool((offered & (distance > LOST_M))[first:].any())),
    }


def second_half(results: Mapping[str, Result]) -> dict[str, float]:
    """Figures of each method over the second half of the time, each name with the method's and a colon in front."""
    out: dict[str, float] = {}
    for label, result in results.items():
        half = 0.5 * float(result.time_s[-1] - result.time_s[0])
        first = int(np.searchsorted(result.time_s - result.time_s[0], half))
        metrics = result.metrics(since_s=half)
        figures = {key: metrics[key] for key in ("drms_m", "contained_95", "nees_per_axis", "available", "misleading")}
        figures |= {"first_fix_s": metrics["first_fix_s"], **losses(result, first)}
        out |= {f"{label}:{key}": float(value) for key, value in figures.items()}
    return out


def count(cases: Sequence[CaseRuns], name: str) -> int:
    """How many runs have a figure of 1."""
    return int(sum(np.nansum(one[name]) for one in cases))


def of_runs(cases: Sequence[CaseRuns], name: str, statistic: Any) -> Interval:
    """A statistic of a figure over all runs of some cases."""
    return over_runs([one[name] for one in cases], statistic)


HEADS = ("DRMS, median [m]", "95th pct. [m]", "in 95 % [%]", "NEES per axis", "lost", "unsaid")


def row(cases: Sequence[CaseRuns], label: str) -> tuple[tuple[str, ...], dict[str, Any]]:
    """A method's texts under HEADS, and the same as numbers."""
    middle, high = (of_runs(cases, f"{label}:drms_m", which) for which in (np.median, p95))
    within = of_runs(cases, f"{label}:contained_95", np.mean)
    nees = of_runs(cases, f"{label}:nees_per_axis", np.median)
    lost, unsaid = count(cases, f"{label}:lost"), count(cases, f"{label}:unsaid")
    texts = (shown(middle, 0), shown(high, 0), shown(within, 1, scale=100.0), shown(nees), str(lost), str(unsaid))
    facts = {
        "method": label, "drms_median_m": plain(middle), "drms_p95_m": plain(high), "contained_95": plain(within),
        "nees_per_axis": plain(nees), "lost": lost, "unsaid": unsaid,
    }  # fmt: skip
    return texts, facts


def bound_row(cases: Sequence[CaseRuns], name: str) -> tuple[str, ...]:
    """The bound's texts under HEADS: the median over cases of its DRMS."""
    values = [one[name][0] for one in cases if one.runs and math.isfinite(one[name][0])]
    return (f"{np.median(values):.0f}" if values else "–", *[""] * (len(HEADS) - 1))

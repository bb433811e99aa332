"""Bound: how close the navigator comes to the Cramer-Rao bound on informative tracks with matched models.

Of a track: the root of the mean squared distance from the truth, over runs and over the epochs that count
(`terranav.experiment.studies.tracks`), over the root of the mean trace of the bound there. A run that never
called itself converged has no such epochs and is counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.experiment.papers.outcome import Table
from terranav.experiment.studies import matched
from terranav.experiment.studies.statistics import PerCase, per_case
from terranav.experiment.studies.study import CaseRuns, Report, Study, Verdict, plain, shown

ASKED_MEDIAN, ASKED_P90 = 1.08, 1.25
ASKED_TRACKS, ASKED_MAPS = 40, 6

FloatArray = NDArray[np.float64]


def ratio(squared: FloatArray) -> FloatArray:
    """RMSE over bound of runs (..., runs, 2) of mean squared error and mean trace of the bound."""
    mean = squared.mean(axis=-2)
    return np.asarray(np.sqrt(mean[..., 0] / mean[..., 1]))


p90 = partial(np.percentile, q=90.0)


def report(cases: Sequence[CaseRuns]) -> Report:
    """Ratios by map and over all tracks."""
    ratios = per_case([matched.after_convergence(one, "mse_m2", "bound_m2") for one in cases], ratio)
    maps = np.array([one.case.map_name for one in cases])
    rows, facts = [], []
    for name in [*dict.fromkeys(maps.tolist()), "all"]:
        mine = maps == name if name != "all" else np.ones(len(cases), dtype=bool)
        text, fact = _row(name, [one for one, chosen in zip(cases, mine, strict=True) if chosen], ratios, mine)
        rows.append(text)
        facts.append(fact)
    columns = (
        "map",
        "tracks",
        "runs",
        "bound, drms [m]",
        "median ratio",
        "90th percentile",
        "worst track",
        "no fix",
        "lost",
    )
    table = Table("RMSE over the Cramer-Rao bound after convergence, 95 % intervals", columns, tuple(rows))
    tracks = [
        {"track": one.case.name, "runs": one.runs, "ratio": plain(ratios.interval(i))} for i, one in enumerate(cases)
    ]
    return Report([table], _verdicts(cases, ratios, len(set(maps.tolist()))), figures=[*facts, *tracks])


def _row(
    name: str, cases: Sequence[CaseRuns], ratios: PerCase, mine: NDArray[np.bool_]
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """One map."""
    middle, high = ratios.over_cases(np.median, mine), ratios.over_cases(p90, mine)
    bounds = np.sqrt([np.nanmean(one["bound_m2"]) for one in cases if one["fixed"].any()])
    worst = float(np.nanmax(ratios.values[mine]))
    runs = sum(one.runs for one in cases)
    lost, never = (int(sum(one[key].sum() for one in cases)) for key in ("lost", "fixed"))
    never = runs - never
    span = f"{bounds.min():.0f} to {bounds.max():.0f}" if len(bounds) else "–"
    text = (name, str(len(cases)), str(runs), span, shown(middle), shown(high), f"{worst:.2f}", str(never), str(lost))
    fact = {"map": name, "tracks": len(cases), "runs": runs, "median_ratio": plain(middle), "p90_ratio": plain(high)}
    return text, {**fact, "worst_ratio": worst, "no_fix": never, "lost": lost}


def _verdicts(cases: Sequence[CaseRuns], ratios: PerCase, maps: int) -> list[Verdict]:
    """What the navigator is asked."""
    middle, high = ratios.over_cases(np.median), ratios.over_cases(p90)
    enough = len(cases) >= ASKED_TRACKS and maps >= ASKED_MAPS
    return [
        Verdict("RMSE over bound, median of tracks", f"<= {ASKED_MEDIAN}", shown(middle), middle.value <= ASKED_MEDIAN),
        Verdict("RMSE over bound, 90th percentile", f"<= {ASKED_P90}", shown(high), high.value <= ASKED_P90),
        Verdict("tracks, maps", f">= {ASKED_TRACKS}, >= {ASKED_MAPS}", f"{len(cases)} tracks over {maps} maps", enough),
    ]


STUDY = Study(
    "bound",
    "How close does the navigator come to the Cramer-Rao bound?",
    matched.plan,
    matched.run_case,
    report,
    family="matched",
)

"""Consistency: does the navigator mean the covariance that it claims? The same tracks and runs as `bound`.

NEES is e' P^-1 e of the horizontal error e and the claimed covariance P. If P is right, the sum over n independent runs
is chi-square with 2 n degrees of freedom (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, section 5.4). Runs are independent, the epochs of one are not: errors persist. So the mean over runs
is tested at single epochs, TESTED of them spread evenly over those that count, and the tests of one track are not taken
for independent: the interval of the share that passes is over tracks. An honest filter passes 95 % of the tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from terranav.experiment.papers.outcome import Table
from terranav.experiment.studies import matched
from terranav.experiment.studies.statistics import DRAWS, PerCase, per_case
from terranav.experiment.studies.study import CaseRuns, Report, Study, Verdict, plain, shown

ASKED_SHARE, ASKED_LOW, ASKED_HIGH = 0.90, 0.93, 0.97

FloatArray = NDArray[np.float64]
_NAMES = [f"nees_{i}" for i in range(matched.TESTED)]


def band(runs: int) -> tuple[float, float]:
    """Limits between which the mean NEES of so many runs lies with probability 0.95."""
    low, high = chi2.ppf([0.025, 0.975], 2 * runs) / runs
    return float(low), float(high)


def inside(nees: FloatArray) -> FloatArray:
    """Share of the tested epochs whose mean NEES over runs lies in the band, of (..., runs, epochs)."""
    low, high = band(nees.shape[-2])
    mean = nees.mean(axis=-2)
    return np.asarray(np.mean((mean >= low) & (mean <= high), axis=-1))


def report(cases: Sequence[CaseRuns]) -> Report:
    """NEES tests and containment by map and over all tracks."""
    nees = [matched.after_convergence(one, *_NAMES) for one in cases]
    passed = np.array([inside(one) if len(one) else np.nan for one in nees])
    last = np.array([inside(one[:, -1:]) if len(one) else np.nan for one in nees])
    # drawing the runs again would widen the means beyond the band: the share's interval is over tracks only
    shares = [PerCase(values, np.repeat(values[:, None], DRAWS, axis=1)) for values in (passed, last)]
    contained, means = (
        per_case([matched.after_convergence(one, key)[:, 0] for one in cases], lambda runs: runs.mean(axis=-1))
        for key in ("contained_95", "nees")
    )
    maps = np.array([one.case.map_name for one in cases])
    rows, facts = [], []
    for name in [*dict.fromkeys(maps.tolist()), "all"]:
        mine = maps == name if name != "all" else np.ones(len(cases), dtype=bool)
        runs = sum(one.runs for one, chosen in zip(cases, mine, strict=True) if chosen)
        figures = [one.over_cases(np.mean, mine) for one in (*shares, means, contained)]
        text = [shown(figures[i], 0, scale=100.0) for i in (0, 1)] + [shown(figures[2])]
        rows.append((name, str(int(mine.sum())), str(runs), *text, shown(figures[3], 1, scale=100.0)))
        keys = ("share_in_band", "share_in_band_at_the_end", "nees", "contained_95")
        facts.append({"map": name, "runs": runs, **{key: plain(x) for key, x in zip(keys, figures, strict=True)}})
    columns = (
        "map",
        "tracks",
        "runs",
        f"in band, {matched.TESTED} epochs [%]",
        "last epoch [%]",
        "NEES",
        "in 95 % [%]",
    )
    table = Table("NEES (2 is honest) and 95 % regions after convergence, 95 % intervals", columns, tuple(rows))
    tracks: list[dict[str, Any]] = [
        {
            "track": one.case.name,
            "runs": one.runs,
            "nees_at_epochs": values.mean(axis=0).tolist(),
            "band": band(one.runs),
        }
        for one, values in zip(cases, nees, strict=True)
        if one.runs
    ]
    return Report([table], _verdicts(shares, contained), _notes(cases), [*facts, *tracks])


def _verdicts(shares: Sequence[PerCase], contained: PerCase) -> list[Verdict]:
    """What the navigator is asked."""
    every, last = (one.over_cases(np.mean) for one in shares)
    within = contained.over_cases(np.mean)
    asked = f">= {100 * ASKED_SHARE:.0f} %"
    return [
        Verdict(f"mean NEES of a track in its 95 % band, {text}", asked, shown(share, 0, "%", 100.0), met)
        for text, share, met in (
            (f"{matched.TESTED} epochs", every, every.value >= ASKED_SHARE),
            ("last epoch", last, last.value >= ASKED_SHARE),
        )
    ] + [
        Verdict(
            "95 % regions contain the truth",
            f"{100 * ASKED_LOW:.0f} to {100 * ASKED_HIGH:.0f} %",
            shown(within, 1, "%", 100.0),
            ASKED_LOW <= within.value <= ASKED_HIGH,
        )
    ]


def _notes(cases: Sequence[CaseRuns]) -> list[str]:
    """The band."""
    runs = max(one.runs for one in cases)
    low, high = band(runs)
    return [f"the 95 % band of the mean NEES of {runs} runs is {low:.2f} to {high:.2f}"]


STUDY = Study(
    "consistency",
    "Does the navigator mean the covariance that it claims?",
    matched.plan,
    matched.run_case,
    report,
    family="matched",
)

"""What the study `monitor` says: pulls by ground, sudden attacks, false alarms an hour."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from terranav.experiment.papers.outcome import Table
from terranav.experiment.studies.monitor_world import FROM_START, MAP_ALONE, PULLS, SUDDEN
from terranav.experiment.studies.statistics import clopper_pearson, over_runs
from terranav.experiment.studies.study import CaseRuns, Report, Verdict, plain, shown

FloatArray = NDArray[np.float64]

NEAR_M = 300.0
SOON_S = 60.0
ASKED_PER_100_H = 1.0
ASKED_PULL = "2 m/s"
ROUGH = ("synthetic rough", "sample")

_p95 = partial(np.percentile, q=95.0)


def report(cases: Sequence[CaseRuns]) -> Report:
    """Three tables and two verdicts."""
    grounds = list(dict.fromkeys((one.case.ground, one.case.factor) for one in cases))
    groups = {key: [one for one in cases if (one.case.ground, one.case.factor) == key] for key in grounds}
    pulls, pull_facts = _pulls(groups)
    sudden, sudden_facts = _sudden(cases)
    alarms, alarm_facts = _alarms(groups, cases)
    return Report([pulls, sudden, alarms], _verdicts(groups, cases), _NOTES, [*pull_facts, *sudden_facts, *alarm_facts])


_NOTES = (
    f"before {NEAR_M:g} m: share of the runs flagged while GNSS was less than that off (Clopper and Pearson); metres "
    "and seconds since the pull began: of the runs that were flagged, 95 % intervals by bootstrap over runs",
    "map alone: the monitor compares GNSS with the map only; from the start: GNSS was never honest",
    "false alarms: 'spoofed' or 'jammed' although GNSS was honest; upper bound: one-sided 95 %, Poisson",
)


def upper_per_100_h(alarms: float, hours: float, confidence: float = 0.95) -> float:
    """One-sided upper bound of a Poisson rate, in events per 100 hours."""
    return 100.0 * 0.5 * float(chi2.ppf(confidence, 2.0 * (alarms + 1.0))) / hours if hours > 0.0 else math.inf


def _pulls(groups: Mapping[tuple[str, float], Sequence[CaseRuns]]) -> tuple[Table, list[dict[str, Any]]]:
    """A row for each ground, INS and pull."""
    rows, facts = [], []
    for (ground, factor), some in groups.items():
        for attack in (*PULLS, MAP_ALONE, FROM_START):
            off, taken = (np.concatenate([one[f"{attack.name}:{what}"] for one in some]) for what in "ms")
            near, flagged = int(np.sum(off < NEAR_M)), int(np.sum(np.isfinite(off)))
            share = clopper_pearson(near, len(off))
            middle, late, seconds = over_runs([off], np.median), over_runs([off], _p95), over_runs([taken], np.median)
            rows.append(
                (ground, f"{factor:g}", attack.name, str(len(off)), str(flagged), shown(share, 0, scale=100.0),
                 shown(middle, 0), shown(late, 0), shown(seconds, 0))
            )  # fmt: skip
            facts.append(
                {"ground": ground, "ins_factor": factor, "attack": attack.name, "runs": len(off), "flagged": flagged,
                 "before_300_m": plain(share), "median_m": plain(middle), "p95_m": plain(late),
                 "median_s": plain(seconds)}
            )  # fmt: skip
    heads = (
        "ground", "INS x", "GNSS pulled at", "runs", "flagged", f"before {NEAR_M:g} m [%]", "median [m]",
        "95th pct. [m]", "median [s]",
    )  # fmt: skip
    return Table("GNSS pulled away: how far off it was when it was flagged", heads, tuple(rows)), facts


def _sudden(cases: Sequence[CaseRuns]) -> tuple[Table, list[dict[str, Any]]]:
    """A row for each sudden attack, over all grounds with readings each second, and over the survey's every 20 s."""
    rows, facts = [], []
    each = [one for one in cases if not _survey(one)]
    for label, some in (("1 s", each), ("20 s", [one for one in cases if _survey(one)])):
        for attack in SUDDEN if some else ():
            taken = np.concatenate([one[f"{attack.name}:s"] for one in some])
            soon, flagged = int(np.sum(taken <= SOON_S)), int(np.sum(np.isfinite(taken)))
            share, middle, late = (
                clopper_pearson(soon, len(taken)), over_runs([taken], np.median), over_runs([taken], _p95)
            )  # fmt: skip
            rows.append(
                (attack.name, label, str(len(taken)), str(flagged), shown(share, 1, scale=100.0), shown(middle, 0),
                 shown(late, 0))
            )  # fmt: skip
            facts.append(
                {"attack": attack.name, "every": label, "runs": len(taken), "flagged": flagged,
                 "within_60_s": plain(share), "median_s": plain(middle), "p95_s": plain(late)}
            )  # fmt: skip
    heads = ("GNSS", "readings every", "runs", "flagged", f"within {SOON_S:g} s [%]", "median [s]", "95th pct. [s]")
    return Table("GNSS suddenly false, over all grounds and both INS", heads, tuple(rows)), facts


def _alarms(
    groups: Mapping[tuple[str, float], Sequence[CaseRuns]], cases: Sequence[CaseRuns]
) -> tuple[Table, list[dict[str, Any]]]:
    """A row for each ground and INS, and sums."""
    rows, facts = [], []
    sums = {f"INS x {factor:g}": [one for one in cases if one.case.factor == factor] for factor in _factors(cases)}
    named = [((ground, f"{factor:g}"), some) for (ground, factor), some in groups.items()]
    named += [(("all", name.removeprefix("INS x ")), some) for name, some in sums.items()] + [(("all", "all"), cases)]
    for (ground, factor), some in named:
        hours, alarms = _total(some, "hours"), _total(some, "false_alarms")
        bound = upper_per_100_h(alarms, hours)
        shares = [over_runs([one[f"share:{what}"] for one in some], np.mean) for what in _SHOWN]
        rows.append(
            (ground, factor, f"{hours:.0f}", f"{alarms:.0f}", f"{bound:.2f}",
             *[shown(share, 1, scale=100.0) for share in shares])
        )  # fmt: skip
        facts.append(
            {"ground": ground, "ins_factor": factor, "hours": hours, "false_alarms": alarms,
             "upper_per_100_h": bound, **{what: plain(share) for what, share in zip(_SHOWN, shares, strict=True)}}
        )  # fmt: skip
    heads = ("ground", "INS x", "hours", "false alarms", "at most per 100 h", *[f"{what} [%]" for what in _SHOWN])
    return Table("GNSS honest", heads, tuple(rows)), facts


_SHOWN = ("consistent", "suspect", "unknown")


def _verdicts(groups: Mapping[tuple[str, float], Sequence[CaseRuns]], cases: Sequence[CaseRuns]) -> list[Verdict]:
    """What the monitor is asked."""
    verdicts = []
    for (ground, factor), some in groups.items():
        if ground not in ROUGH:
            continue
        for name in (ASKED_PULL, MAP_ALONE.name):
            off = np.concatenate([one[f"{name}:m"] for one in some])
            near = int(np.sum(off < NEAR_M))
            share = shown(clopper_pearson(near, len(off)), 1, "%", 100.0)
            text = f"pulled at {name}, {ground}, INS x {factor:g}: flagged before {NEAR_M:g} m"
            verdicts.append(Verdict(text, "all", f"{near} of {len(off)}: {share}", near == len(off)))
    hours, alarms = _total(cases, "hours"), _total(cases, "false_alarms")
    bound = upper_per_100_h(alarms, hours)
    measured = f"{100.0 * alarms / hours:.2f}, at most {bound:.2f} ({alarms:.0f} in {hours:.0f} h)" if hours else "–"
    met = bound <= ASKED_PER_100_H if hours else None
    verdicts.append(Verdict("false alarms in 100 h: 95 % upper bound", f"<= {ASKED_PER_100_H:g}", measured, met))
    return verdicts


def _total(cases: Sequence[CaseRuns], name: str) -> float:
    return float(sum(np.nansum(one[name]) for one in cases))


def _factors(cases: Sequence[CaseRuns]) -> list[float]:
    return sorted({float(one.case.factor) for one in cases})


def _survey(one: CaseRuns) -> bool:
    """Whether its readings come every 20 s."""
    return bool(one.case.ground == "helicopter survey")

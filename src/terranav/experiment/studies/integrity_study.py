"""The study `integrity` as cases, runs and a report: one case a terrain; what is flown stands in `integrity`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import SeedSequence

from terranav.experiment.papers.outcome import Table
from terranav.experiment.registry import make_estimator
from terranav.experiment.studies import integrity
from terranav.experiment.studies.statistics import over_runs
from terranav.experiment.studies.study import CaseRuns, Plan, Report, Setup, Study, Verdict, plain, shown

ASKED_AVAILABLE = 0.90
ROUGH = "rough"


@dataclass(frozen=True)
class TerrainCase:
    """A kind of ground."""

    name: str
    settings: tuple[tuple[str, Any], ...] = ()

    def facts(self) -> Mapping[str, Any]:
        """What its figures depend on besides the program."""
        return {"name": self.name, "settings": dict(self.settings), "risk": integrity.RISK}


def plan(setup: Setup) -> Plan:
    """The terrains; ConfigError for a setting that the navigator does not have."""
    make_estimator("marginalized", (integrity.ground(ROUGH, 0),), integrity.INS, **setup.settings)
    settings = tuple(sorted(setup.settings.items()))
    return Plan([TerrainCase(name, settings) for name in integrity.TERRAINS])


def run_case(case: TerrainCase, seeds: SeedSequence) -> dict[str, float]:
    """One flight: see `integrity.run_case`."""
    return integrity.run_case(case.name, seeds, **dict(case.settings))


def report(cases: Sequence[CaseRuns]) -> Report:
    """A row a terrain, and all of them."""
    rows = {one.case.name: _rows(one) for one in cases}
    rows["all"] = [row for some in list(rows.values()) for row in some]
    sums = {name: integrity.summary(some) for name, some in rows.items()}
    shares = {one.case.name: over_runs([one["usable_share"]], np.mean) for one in cases}
    shares["all"] = over_runs([one["usable_share"] for one in cases], np.mean)
    texts = tuple(
        (
            name, f"{one['runs']:.0f}", f"{one['offered']:.0f}", f"{one['beyond']:.0f}", _rate(one["rate"]),
            _rate(one["upper_95"]), shown(shares[name], 0, scale=100.0), _metres(one["error_m"]),
            _metres(one["protection_m"]), f"{one['ever_beyond']:.0f}", f"{one['unannounced']:.0f}",
        )
        for name, one in sums.items()
    )  # fmt: skip
    heads = (
        "terrain", "runs", "fixes", "beyond", "rate", "95 % bound", "available [%]", "error [m]", "level [m]", "ever",
        "unsaid",
    )  # fmt: skip
    table = Table(f"Fixes beyond their protection level at a declared risk of {integrity.RISK:g}", heads, texts)
    facts = [{"terrain": name, **one, "available": plain(shares[name])} for name, one in sums.items()]
    return Report([table], _verdicts(sums, shares), _NOTES, facts)


_NOTES = (
    "fixes: offered as usable at one time of each run, drawn from its second half; beyond: farther off than the "
    "protection level; bound: one-sided, Clopper and Pearson",
    "available: share of the second half, with its 95 % interval; error, level: medians of the fixes; ever: runs with "
    "any usable fix beyond its level; unsaid: runs beyond 1 km with the status converged or degraded",
)


def _rows(one: CaseRuns) -> list[dict[str, float]]:
    """The runs of a case as `integrity.run_case` gave them."""
    return [{key: float(values[k]) for key, values in one.figures.items()} for k in range(one.runs)]


def _verdicts(sums: Mapping[str, Mapping[str, float]], shares: Mapping[str, Any]) -> list[Verdict]:
    """What the monitor is asked."""
    risk = integrity.RISK
    verdicts = []
    for name, one in sums.items():
        some = one["offered"] > 0
        text = f"fixes beyond their level, {name}: 95 % upper bound"
        measured = f"{_rate(one['upper_95'])} ({one['beyond']:.0f} of {one['offered']:.0f})"
        met = one["upper_95"] <= risk if some else None
        verdicts.append(Verdict(text, f"<= {risk:g}", measured if some else "no fix offered", met))
    if ROUGH in shares:
        share = shares[ROUGH]
        met = share.value > ASKED_AVAILABLE
        verdicts.append(Verdict("available on rough terrain", "> 90 %", shown(share, 1, "%", 100.0), met))
    return verdicts


def _rate(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "–"


def _metres(value: float) -> str:
    return f"{value:.0f}" if math.isfinite(value) else "–"


STUDY = Study(
    "integrity",
    "Is the error of a fix that is offered within its protection level, at the declared risk?",
    plan,
    run_case,
    report,
    runs=10_000,
    chunk=100,
)

"""Studies that take no time: their functions are a module's, so that other processes can have them."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import SeedSequence

from terranav.experiment.papers.outcome import Table
from terranav.experiment.studies.statistics import over_runs
from terranav.experiment.studies.study import CaseRuns, Plan, Report, Setup, Study, Verdict, plain, shown


@dataclass(frozen=True)
class Draw:
    name: str
    mean: float = 0.0

    def facts(self) -> Mapping[str, Any]:
        return {"name": self.name, "mean": self.mean}


def plan(setup: Setup) -> Plan:
    return Plan([Draw("calm", 1.0), Draw("wild", 5.0)], ["drawn, not flown"])


def run(case: Draw, seeds: SeedSequence) -> dict[str, float]:
    value = float(np.random.default_rng(seeds).normal(case.mean))
    return {"value": value, **({"extra": 1.0} if case.name == "wild" else {})}


def run_brittle(case: Draw, seeds: SeedSequence) -> dict[str, float]:
    if case.name == "wild" and np.random.default_rng(seeds).random() < 0.5:
        raise ValueError("no\nluck")
    return run(case, seeds)


def run_broken(case: Draw, seeds: SeedSequence) -> dict[str, float]:
    raise ValueError("never")


def run_slow(case: Draw, seeds: SeedSequence) -> dict[str, float]:
    time.sleep(0.05)
    return run(case, seeds)


def run_killed(case: Draw, seeds: SeedSequence) -> dict[str, float]:
    os.kill(os.getpid(), signal.SIGKILL)
    return {}


def report(cases: Sequence[CaseRuns]) -> Report:
    mean = over_runs([one["value"] for one in cases], np.mean)
    table = Table("Draws", ("case", "runs"), tuple((one.case.name, str(one.runs)) for one in cases))
    return Report([table], [Verdict("mean", "<= 9", shown(mean), True)], figures=[{"mean": plain(mean)}])


def study(run_one: Any = run, **changes: Any) -> Study:
    return Study("draws", "What is drawn?", plan, run_one, report, **{"runs": 6, "chunk": 2, **changes})


def nap(folder: Path, seconds: int) -> int:
    time.sleep(seconds)
    (folder / f"{seconds}").touch()
    return seconds

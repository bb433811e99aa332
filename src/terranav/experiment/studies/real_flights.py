"""The four helicopter days of a real survey, the first hour of each, with the drift of an INS added.

Errors count over the second half of the hour. The survey: U.S. Geological Survey, airborne magnetic survey of
north-east Wisconsin, 2021, doi:10.5066/P93SY9LI; a laser altimeter reading every 20 s and a map of 100 m cells.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import SeedSequence

from terranav.core.errors import DataWarning
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.experiment.compare import compare
from terranav.experiment.papers.outcome import Table
from terranav.experiment.studies.ensemble import HEADS, bound_row, count, of_runs, p95, row, second_half
from terranav.experiment.studies.sources import MapSource
from terranav.experiment.studies.study import CaseRuns, Verdict, shown
from terranav.ins.drift import add_drift
from terranav.io.tables import convert_table
from terranav.planning.bound import bound

FOLDER, MAP_FILE = "wisconsin_helicopter", "land_surface_100m.tif"
COLUMNS = Path(__file__).with_name("wisconsin_helicopter.toml")
INS = InsGrade(position_sigma_m=500.0, velocity_sigma_mps=0.5, position_walk_m_per_sqrt_s=1.0)
HOUR_S, MAP_SIGMA_M = 3600.0, 3.0
METHODS = ("marginalized", "pointmass", "ins")

ASKED_MEDIAN_M, ASKED_P95_M = 60.0, 105.0
ASKED_NEES, ASKED_INSIDE = (0.7, 1.3), (0.93, 0.97)


@dataclass(frozen=True)
class FlightCase:
    """One day of the survey."""

    path: Path
    settings: tuple[tuple[str, Any], ...] = ()

    @property
    def ins(self) -> InsGrade:
        """What is told of the INS."""
        return INS

    @property
    def name(self) -> str:
        """'flight 20210120'."""
        return self.path.stem.replace("_", " ")

    @property
    def source(self) -> MapSource:
        """The survey's map."""
        return MapSource(self.path.with_name(MAP_FILE), (("kind", "terrain"), ("sigma", MAP_SIGMA_M)))

    def facts(self) -> Mapping[str, Any]:
        """What its figures depend on."""
        track = true_track(self.path)
        readings = float(np.nansum(track.columns["terrain_m"]) + track.lat_deg.sum() + track.lon_deg.sum())
        return {
            "name": self.name, "settings": dict(self.settings), "map": self.source.facts(), "ins": repr(INS),
            "readings": readings,
        }  # fmt: skip

    def fly(self, seeds: SeedSequence) -> dict[str, float]:
        """One drift, by every method; see `ensemble.second_half`, and bound_m: DRMS of the bound over that half."""
        drift, methods = (int(child.generate_state(1)[0]) for child in seeds.spawn(2))
        rec = add_drift(true_track(self.path), INS, drift)
        wanted = {name: (name, dict(self.settings) if name == "marginalized" else {}) for name in METHODS}
        results = compare(wanted, rec, [self.source.open()], seed=methods)
        return {**second_half(results), "bound_m": bound_m(self)}


@lru_cache(maxsize=8)
def true_track(path: Path) -> Recording:
    """The first hour of a day, its position true."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        whole = convert_table(path, COLUMNS)
    return whole.between(0.0, HOUR_S)


@lru_cache(maxsize=8)
def bound_m(case: FlightCase) -> float:
    """DRMS of the bound over the second half [m], were everything as told."""
    track = true_track(case.path)
    lowest = bound(track, [case.source.open()], INS, outlier_share=0.0)
    later = track.time_s - track.time_s[0] >= 0.5 * (track.time_s[-1] - track.time_s[0])
    return float(np.sqrt(np.mean(lowest.drms_m[later] ** 2)))


def flight_cases(data: Path, settings: Mapping[str, Any]) -> tuple[list[FlightCase], list[str]]:
    """A case a day, or why there is none."""
    paths = sorted((data / FOLDER).glob("flight_*.csv"))
    if not paths or not (data / FOLDER / MAP_FILE).is_file():
        return [], [f"{data / FOLDER}: holds no flight_*.csv beside {MAP_FILE}; the helicopter days are left out"]
    return [FlightCase(path, tuple(sorted(settings.items()))) for path in paths], []


def flight_table(cases: Sequence[CaseRuns]) -> tuple[Table, list[dict[str, Any]]]:
    """Every method over all days, and the navigator by day."""
    rows, facts = [], []
    for label in METHODS:
        texts, fact = row(cases, label)
        rows.append((label, "all", *texts))
        facts.append({"flights": "all", **fact})
    rows.append(("bound", "all", *bound_row(cases, "bound_m")))
    for one in cases:
        texts, fact = row([one], METHODS[0])
        rows.append((METHODS[0], one.case.name.removeprefix("flight "), *texts))
        facts.append({"flights": one.case.name, **fact})
        rows.append(("bound", one.case.name.removeprefix("flight "), *bound_row([one], "bound_m")))
    ins = f"{INS.position_sigma_m:g} m, {INS.velocity_sigma_mps:g} m/s, {INS.position_walk_m_per_sqrt_s:g} m/sqrt(s)"
    title = f"Helicopter, first hour of {len(cases)} days, second half counts; INS {ins}; 95 % intervals over runs"
    return Table(title, ("method", "day", *HEADS), tuple(rows)), facts


def flight_verdicts(cases: Sequence[CaseRuns]) -> list[Verdict]:
    """What the navigator is asked."""
    name = METHODS[0]
    middle, high = (of_runs(cases, f"{name}:drms_m", which) for which in (np.median, p95))
    nees = of_runs(cases, f"{name}:nees_per_axis", np.median)
    within = of_runs(cases, f"{name}:contained_95", np.mean)
    unsaid = count(cases, f"{name}:unsaid")
    (low_nees, high_nees), (low_in, high_in) = ASKED_NEES, ASKED_INSIDE
    asked_in = f"{100 * low_in:.0f} to {100 * high_in:.0f} %"
    return [
        Verdict("helicopter: DRMS, median of runs", f"<= {ASKED_MEDIAN_M:g} m", shown(middle, 0, "m"),
                middle.value <= ASKED_MEDIAN_M),
        Verdict("helicopter: DRMS, 95th percentile of runs", f"<= {ASKED_P95_M:g} m", shown(high, 0, "m"),
                high.value <= ASKED_P95_M),
        Verdict("helicopter: runs lost without saying so", "0", str(unsaid), unsaid == 0),
        Verdict("helicopter: NEES per axis, median of runs", f"{low_nees} to {high_nees}", shown(nees),
                low_nees <= nees.value <= high_nees),
        Verdict("helicopter: 95 % regions contain the truth", asked_in, shown(within, 1, "%", 100.0),
                low_in <= within.value <= high_in),
    ]  # fmt: skip

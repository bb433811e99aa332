"""A real cruise: depth and gravity of R/V Maurice Ewing EW0007 in pieces of 24 h, with the drift of an INS added.

The INS drifts by one nautical mile an hour: 0.514 m/s root mean square, 0.364 m/s per axis. Errors count over the
second half of each piece. The relief was partly made from such soundings, so the depth is optimistic; the gravity map
is derived from a geoid, which lacks its long wavelengths.
"""

from __future__ import annotations

import math
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
from terranav.experiment.papers.outcome import Table
from terranav.experiment.run import run
from terranav.experiment.studies.ensemble import HEADS, bound_row, row, second_half
from terranav.experiment.studies.sources import MapSource
from terranav.experiment.studies.study import CaseRuns
from terranav.ins.drift import add_drift
from terranav.io.tables import convert_table
from terranav.planning.bound import bound

TRACK = Path("ship_ew0007") / "ew0007_first_half.csv"
COLUMNS = Path(__file__).with_name("ship_ew0007.toml")
DEPTH_MAP = Path("ship_ew0007") / "relief15s_45-48N_46-41W.nc"
GRAVITY_MAP = Path("gravity") / "egm2008_2p5min_n_atlantic_ew0007.nc"
NAUTICAL_MILE_PER_H = 1852.0 / 3600.0
INS = InsGrade(
    position_sigma_m=500.0,
    velocity_sigma_mps=NAUTICAL_MILE_PER_H / math.sqrt(2.0),
    position_walk_m_per_sqrt_s=1.0,
)
DAY_S = 86400.0
FEWEST_ROWS, LONGEST_GAP_S, LEAST_COVER = 700, 1800.0, 0.95
SETS = {"depth": ("bathymetry",), "gravity": ("gravity",), "both": ("bathymetry", "gravity")}


@dataclass(frozen=True)
class CruiseCase:
    """One piece of the cruise, by its number from 0."""

    data: Path
    piece: int
    settings: tuple[tuple[str, Any], ...] = ()

    @property
    def ins(self) -> InsGrade:
        """What is told of the INS."""
        return INS

    @property
    def name(self) -> str:
        """'ship day 3'."""
        return f"ship day {self.piece}"

    @property
    def sources(self) -> dict[str, MapSource]:
        """Its maps by kind."""
        variable = ("variable", "gravity_disturbance_approx")
        return {
            "bathymetry": MapSource(self.data / DEPTH_MAP, (("kind", "bathymetry"),)),
            "gravity": MapSource(self.data / GRAVITY_MAP, (("kind", "gravity"), variable)),
        }

    def facts(self) -> Mapping[str, Any]:
        """What its figures depend on."""
        columns = piece(self).columns
        readings = float(sum(np.nansum(columns[key]) for key in ("lat_deg", "lon_deg", "depth_m", "gravity_mgal")))
        maps = {kind: source.facts() for kind, source in self.sources.items()}
        return {
            "name": self.name, "settings": dict(self.settings), "maps": maps, "ins": repr(INS), "readings": readings,
        }  # fmt: skip

    def fly(self, seeds: SeedSequence) -> dict[str, float]:
        """One drift, with each set of maps; see `ensemble.second_half`, and 'SET:bound_m'."""
        drift, method = (int(child.generate_state(1)[0]) for child in seeds.spawn(2))
        rec = add_drift(piece(self), INS, drift)
        sources, settings = self.sources, dict(self.settings)
        results = {
            label: run("marginalized", rec, [sources[kind].open() for kind in kinds], seed=method, **settings)
            for label, kinds in SETS.items()
        }
        results["ins"] = run("ins", rec, seed=method)
        return {**second_half(results), **{f"{label}:bound_m": bound_m(self, label) for label in SETS}}


@lru_cache(maxsize=2)
def cruise(data: Path) -> Recording:
    """The whole cruise, its position true."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return convert_table(data / TRACK, COLUMNS)


def piece(case: CruiseCase) -> Recording:
    """A day of it."""
    whole = cruise(case.data)
    start = float(whole.time_s[0]) + case.piece * DAY_S
    return whole.between(start, start + DAY_S - 1.0)


@lru_cache(maxsize=64)
def bound_m(case: CruiseCase, label: str) -> float:
    """DRMS of the bound over the second half [m] with a set of maps, were everything as told."""
    track = piece(case)
    lowest = bound(track, [case.sources[kind].open() for kind in SETS[label]], INS, outlier_share=0.0)
    later = track.time_s - track.time_s[0] >= 0.5 * (track.time_s[-1] - track.time_s[0])
    return float(np.sqrt(np.mean(lowest.drms_m[later] ** 2)))


def cruise_cases(data: Path, settings: Mapping[str, Any]) -> tuple[list[CruiseCase], list[str]]:
    """A case for each piece that can be used, and why the others are left out."""
    missing = [path for path in (TRACK, DEPTH_MAP, GRAVITY_MAP) if not (data / path).is_file()]
    if missing:
        return [], [f"{data / missing[0]}: not there; the cruise is left out"]
    whole = cruise(data)
    cases, notes = [], []
    for number in range(int((whole.time_s[-1] - whole.time_s[0]) // DAY_S) + 1):
        case = CruiseCase(data, number, tuple(sorted(settings.items())))
        wrong = _unfit(case)
        if wrong:
            notes.append(f"{case.name}: left out, {wrong}")
        else:
            cases.append(case)
    return cases, notes


def _unfit(case: CruiseCase) -> str:
    """Why a piece is left out; empty when it is not."""
    track = piece(case)
    if len(track) < FEWEST_ROWS:
        return f"{len(track)} rows, expected at least {FEWEST_ROWS} of 1440"
    gap = float(np.diff(track.time_s).max())
    if gap > LONGEST_GAP_S:
        return f"a gap of {gap / 60.0:.0f} min, expected at most {LONGEST_GAP_S / 60.0:.0f}"
    for kind, source in case.sources.items():
        cover = float(np.mean(np.isfinite(source.open().sample(track.lat_deg, track.lon_deg))))
        if cover < LEAST_COVER:
            return f"the {kind} map covers {100.0 * cover:.0f} % of it, expected at least {100.0 * LEAST_COVER:.0f} %"
    return ""


def cruise_table(cases: Sequence[CaseRuns]) -> tuple[Table, list[dict[str, Any]]]:
    """Each set of maps, its bound, and the INS alone, over all pieces and by piece."""
    rows, facts = [], []
    groups = [("all", cases), *[(one.case.name.removeprefix("ship "), [one]) for one in cases]]
    for name, group in groups:
        for label in (*SETS, "ins"):
            texts, fact = row(group, label)
            rows.append((name, label, *texts))
            facts.append({"cruise": name, **fact})
            if label in SETS:
                rows.append((name, f"bound, {label}", *bound_row(group, f"{label}:bound_m")))
    title = f"Ship, {len(cases)} pieces of 24 h, second half counts; INS of 1 nmi/h; 95 % intervals over runs"
    return Table(title, ("piece", "maps", *HEADS), tuple(rows)), facts

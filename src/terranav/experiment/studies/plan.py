"""Plan: is the 1-sigma that the planner promises for a leg what the navigator then has at its end?

Legs are drawn by the seed, so many on every terrain map at hand, whatever the ground: the start anywhere, any heading,
DISTANCE_M long, taken when the map has no edge and no void within REACH_SIGMAS of the INS error about the leg. Nothing
is asked of the terrain, so legs over plains, where the map teaches nothing, are among them.

Promised is what `planning.forecast` has for the leg's end. Beside it stand the Cramer-Rao bound of the very leg, and
what `planning.suitability`, with HEADINGS headings over the map about the leg, has for the end and the heading
(`Suitability.at`): quicker, but a bound, and that of legs near by.

Against them stands the root mean square error at the leg's end, over many flights in a world that is as the navigator
is told (`terranav.experiment.studies.world`), along the longest axis of the errors' second moment, as the 1-sigmas are
along the longest axis of their covariance. From few runs of a round error that is too large by chance: by 8 % from 60,
by 6 % from 100.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray
from scipy.stats import norm

from terranav.core.earth import shift
from terranav.core.records import Status
from terranav.experiment.montecarlo import Interval
from terranav.experiment.papers.outcome import Table
from terranav.experiment.registry import make_estimator
from terranav.experiment.run import run
from terranav.experiment.studies.matched import ESTIMATOR, TOLD
from terranav.experiment.studies.sources import MapSource, data_folder, terrain_sources
from terranav.experiment.studies.statistics import PerCase, per_case
from terranav.experiment.studies.study import CaseRuns, Plan, Report, Setup, Study, Verdict, plain, shown
from terranav.experiment.studies.tracks import CANDIDATES, INS, MATCHED, REACH_SIGMAS, SENSOR_SIGMA_M, Clear, Leg, Track
from terranav.experiment.studies.world import flown
from terranav.planning.bound import bound
from terranav.planning.forecast import forecast
from terranav.planning.suitability import TRUSTED_CELLS, LegSettings, suitability

FloatArray = NDArray[np.float64]

LEGS = 5  # on each map
SPEED_MPS, INTERVAL_S, DISTANCE_M = 60.0, 1.0, 10_000.0
HEADINGS = 16
SETTINGS = LegSettings(SENSOR_SIGMA_M, 1.0 / INTERVAL_S, SPEED_MPS, DISTANCE_M, HEADINGS)
AGREES = 0.25  # largest difference of the RMSE from what was promised, as a share of that
ASKED_SHARE, ASKED_LEGS, ASKED_MAPS = 0.90, 40, 4
FAR_SIGMAS = 5.0  # of what is promised: beyond them a run has found another place, or none
ABOUT_M = 2_500.0  # about a leg: so far its neighbours of the nearest headings begin from it


@dataclass(frozen=True)
class LegCase:
    """A leg, and what is promised of its end: by the forecast, and by the map of suitability [m]."""

    track: Track
    promised_m: float
    mapped_m: float
    settings: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """The leg's."""
        return self.track.name

    @property
    def map_name(self) -> str:
        """The map's."""
        return self.track.source.name

    def facts(self) -> Mapping[str, Any]:
        """What its figures depend on."""
        promised_m = {"promised_m": round(self.promised_m, 3), "mapped_m": round(self.mapped_m, 3)}
        told = {**promised_m, "settings": dict(self.settings), "ins": repr(INS)}
        return {**self.track.facts(), **told}


def plan(setup: Setup) -> Plan:
    """Draw the legs of every terrain map at hand, and ask the planner about each.

    Raises
    ------
    ConfigError
        A setting that the estimator does not have, or a map that is not there.
    """
    settings = {**TOLD, **setup.settings}
    wanted = LEGS if setup.tracks is None else setup.tracks
    data = data_folder(setup.data)
    cases: list[LegCase] = []
    notes = []
    for source in terrain_sources(data, setup.maps):
        tracks = drawn_legs(source, wanted, setup.seed)
        if tracks and not cases:
            make_estimator(ESTIMATOR, (tracks[0].chart,), INS, **settings)
        if len(tracks) < wanted:
            notes.append(
                f"{source.name}: {len(tracks)} of {wanted} legs, no more among {CANDIDATES} candidates have the map "
                f"whole within {REACH_SIGMAS:g} sigma"
            )
        kept = tuple(sorted(settings.items()))
        cases += [LegCase(track, promised_m(track), mapped_m(track), kept) for track in tracks]
    if data is None and not setup.maps:
        notes.append("only the sample DEM is at hand: name a folder of terrain maps (--data DIR) or maps (--map FILE)")
    return Plan(cases, notes)


def drawn_legs(source: MapSource, count: int, seed: int) -> list[Track]:
    """The first `count` random legs about which the map is whole."""
    chart = source.open()
    south, west, north, east = chart.bounds_deg
    rng = np.random.default_rng(SeedSequence([seed, int(chart.checksum[:8], 16), 1]))
    clear = Clear(chart)
    found: list[Track] = []
    for _ in range(CANDIDATES):
        up, right, course = rng.random(3).tolist()
        lat, lon, duration = south + up * (north - south), west + right * (east - west), DISTANCE_M / SPEED_MPS
        leg = Leg(lat, lon, 360.0 * course, 0.0, SPEED_MPS, duration, INTERVAL_S)
        if clear.around(leg):
            found.append(Track(f"{source.name}-{len(found) + 1:02d}", source, leg))
            if len(found) == count:
                break
    return found


def promised_m(track: Track) -> float:
    """1-sigma at the end of a leg by the forecast [m]."""
    told = forecast(track.true_recording(), [track.chart], INS, blur_cells=MATCHED.blur_cells)
    return math.sqrt(float(np.linalg.eigvalsh(told.cov_m2[-1])[-1]))


def mapped_m(track: Track) -> float:
    """1-sigma at the end of a leg by the planner's grids over the map about it [m]."""
    leg = track.leg
    heading = math.radians(leg.heading_deg)
    ends = shift(leg.lat_deg, leg.lon_deg, *(DISTANCE_M * np.outer((math.cos(heading), math.sin(heading)), (0.0, 1.0))))
    (south, west), (north, east) = (
        shift(side(ends[0]), side(ends[1]), away, away) for side, away in ((np.min, -ABOUT_M), (np.max, ABOUT_M))
    )
    about = track.chart.crop(float(south), float(west), float(north), float(east))
    return suitability(about, INS, SETTINGS).at(float(ends[0][1]), float(ends[1][1]), leg.heading_deg)


@lru_cache(maxsize=64)
def leg_bound_m(track: Track) -> float:
    """Cramer-Rao bound at the end of the very leg, along its longest axis [m]."""
    lowest = bound(track.true_recording(), [track.chart], INS, blur_cells=MATCHED.blur_cells)
    return math.sqrt(float(np.linalg.eigvalsh(lowest.cov_m2[-1])[-1]))


def run_case(case: LegCase, seeds: SeedSequence) -> dict[str, float]:
    """One flight over a leg.

    Returns
    -------
    dict
        north_m, east_m: the error at its end. claimed_m: the navigator's own 1-sigma there, along its longest axis.
        converged: 1 when it ends so. bound_m: of the leg.
    """
    world, estimator = seeds.spawn(2)
    rec = flown(case.track, MATCHED, np.random.default_rng(world)).rec
    seed = int(estimator.generate_state(1)[0])
    result = run(ESTIMATOR, rec, [case.track.chart], seed=seed, **dict(case.settings))
    north, east = result.error_m[-1].tolist()
    claimed = math.sqrt(float(np.linalg.eigvalsh(result.cov_m2[-1])[-1]))
    converged = float(result.status[-1] == Status.CONVERGED.value)
    told = {"claimed_m": claimed, "converged": converged, "bound_m": leg_bound_m(case.track)}
    return {"north_m": north, "east_m": east, **told}


def rmse(errors: FloatArray) -> FloatArray:
    """Root mean square along the longest axis of errors (..., runs, 2) north, east."""
    north, east = errors[..., 0], errors[..., 1]
    nn, ee, ne = ((one * other).mean(axis=-1) for one, other in ((north, north), (east, east), (north, east)))
    return np.asarray(np.sqrt(0.5 * (nn + ee + np.hypot(nn - ee, 2.0 * ne))))


def wilson(count: int, of: int, confidence: float = 0.95) -> Interval:
    """A share with its score interval (Wilson, J. American Statistical Association 22, 1927)."""
    if not of:
        return Interval(math.nan, math.nan, math.nan)
    z2 = float(norm.ppf(0.5 + 0.5 * confidence)) ** 2
    share, room = count / of, 1.0 + z2 / of
    middle = (share + 0.5 * z2 / of) / room
    half = math.sqrt(z2 * (share * (1.0 - share) / of + 0.25 * z2 / of**2)) / room
    return Interval(share, max(middle - half, 0.0), min(middle + half, 1.0))


def agree(values: FloatArray, promised_m: FloatArray) -> NDArray[np.bool_]:
    """Whether an RMSE lies within AGREES of what was promised."""
    return np.asarray(np.abs(values / promised_m - 1.0) <= AGREES)


def report(cases: Sequence[CaseRuns]) -> Report:
    """Every leg, and the share that agrees, by map and in all."""
    errors = [np.stack([one["north_m"], one["east_m"]], axis=1) for one in cases]
    told = np.array([one.case.promised_m for one in cases])
    near = [np.hypot(*run.T) <= FAR_SIGMAS * one for run, one in zip(errors, told.tolist(), strict=True)]
    kept = np.array([rmse(run[one]) if one.any() else math.inf for run, one in zip(errors, near, strict=True)])
    legs = _Legs(
        cases,
        per_case(errors, rmse),
        told,
        np.array([one["bound_m"][0] for one in cases]),
        np.array([one.case.mapped_m for one in cases]),
        [int((~one).sum()) for one in near],
    )
    head = ("leg", "heading", "map [m]", "bound [m]", "promised [m]", "RMSE [m]", "RMSE/promised", "far off", "agrees")
    by_map = ("map", "legs", "within 25 %", "promised/bound", "RMSE/bound", "RMSE/promised")
    sums, shares = list(legs.sums()), list(legs.shares(kept))
    tables = [
        Table("1-sigma at the end of a leg, promised and had", head, tuple(legs.rows())),
        Table("Share of legs that agree; ratios: median, least to largest", by_map, tuple(row for row, _ in sums)),
        Table(
            "Share of legs within 25 %",
            ("RMSE against", "all legs", f"promised within {TRUSTED_CELLS:g} cells"),
            tuple(row for row, _ in shares),
        ),
    ]
    note = (
        f"legs of {DISTANCE_M / 1000:g} km at {SPEED_MPS:g} m/s, a reading every {INTERVAL_S:g} s; "
        f"far off: runs beyond {FAR_SIGMAS:g} sigmas of what is promised"
    )
    return Report(tables, legs.verdicts(), [note], [*(fact for _, fact in (*sums, *shares)), *legs.facts()])


@dataclass(frozen=True)
class _Legs:
    """All legs with their figures; arrays (legs,)."""

    cases: Sequence[CaseRuns]
    found: PerCase
    promised: FloatArray
    bound: FloatArray
    mapped: FloatArray
    far: list[int]

    @property
    def fine(self) -> NDArray[np.bool_]:
        """Which agree."""
        return agree(self.found.values, self.promised)

    def rows(self) -> Iterator[tuple[str, ...]]:
        """One for each leg."""
        for i, one in enumerate(self.cases):
            yield (
                one.case.name, f"{one.case.track.leg.heading_deg:.0f}", f"{self.mapped[i]:.0f}",
                f"{self.bound[i]:.0f}", f"{self.promised[i]:.0f}", shown(self.found.interval(i), 0),
                f"{self.found.values[i] / self.promised[i]:.2f}", f"{self.far[i]} of {one.runs}",
                "yes" if self.fine[i] else "no",
            )  # fmt: skip

    def facts(self) -> Iterator[dict[str, Any]]:
        """The same as numbers."""
        for i, one in enumerate(self.cases):
            told = {"promised_m": self.promised, "bound_m": self.bound, "mapped_m": self.mapped}
            numbers = {"far": self.far[i], **{key: float(values[i]) for key, values in told.items()}}
            shares = {"converged": float(one["converged"].mean()), "claimed_m": float(np.median(one["claimed_m"]))}
            interval = plain(self.found.interval(i))
            yield {"leg": one.case.name, "runs": one.runs, "rmse_m": interval, **numbers, **shares}

    def sums(self) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
        """One for each map, and one for all."""
        maps = np.array([one.case.map_name for one in self.cases])
        pairs = ((self.promised, self.bound), (self.found.values, self.bound), (self.found.values, self.promised))
        for name in [*dict.fromkeys(maps.tolist()), "all"]:
            mine = maps == name if name != "all" else np.ones(len(maps), dtype=bool)
            share = wilson(int(self.fine[mine].sum()), int(mine.sum()))
            ratios = [(above[mine] / below[mine]) for above, below in pairs]
            spans = [f"{np.median(one):.2f} ({one.min():.2f}..{one.max():.2f})" for one in ratios]
            row = (name, str(int(mine.sum())), shown(share, 0, "%", scale=100.0), *spans)
            yield row, {"map": name, "legs": int(mine.sum()), "share_within": plain(share)}

    def shares(self, kept: FloatArray) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
        """How many legs agree with each of the three; `kept` (legs,) is the RMSE without runs far off [m]."""
        every = np.ones(len(self.cases), dtype=bool)
        trusted = self.promised <= TRUSTED_CELLS * np.array([one.case.track.chart.cell_m for one in self.cases])
        for text, values, against in (
            ("the forecast of the leg: promised", self.found.values, self.promised),
            ("the same, without runs that are far off", kept, self.promised),
            ("the bound of the leg", self.found.values, self.bound),
            ("the same, without runs that are far off", kept, self.bound),
            ("the map of suitability", self.found.values, self.mapped),
            ("the same, without runs that are far off", kept, self.mapped),
        ):
            fine = agree(values, against)
            found = [wilson(int(fine[mine].sum()), int(mine.sum())) for mine in (every, trusted)]
            counts = [f"{int(fine[mine].sum())} of {int(mine.sum())}" for mine in (every, trusted)]
            texts = [f"{n}: {shown(one, 0, '%', scale=100.0)}" for n, one in zip(counts, found, strict=True)]
            yield (text, *texts), {"against": text, "all_legs": plain(found[0]), "trusted_legs": plain(found[1])}

    def verdicts(self) -> list[Verdict]:
        """What the planner is asked."""
        maps = len({one.case.map_name for one in self.cases})
        enough = len(self.cases) >= ASKED_LEGS and maps >= ASKED_MAPS
        said = []
        for name, told in (("forecast of the leg", self.promised), ("map of suitability", self.mapped)):
            fine = agree(self.found.values, told)
            share = wilson(int(fine.sum()), len(self.cases))
            text = f"RMSE within {100 * AGREES:.0f} % of the 1-sigma by the {name}, share of legs"
            met = share.value >= ASKED_SHARE
            said.append(Verdict(text, f">= {100 * ASKED_SHARE:.0f} %", shown(share, 0, "%", scale=100.0), met))
        asked = f">= {ASKED_LEGS}, >= {ASKED_MAPS}"
        return [*said, Verdict("legs, maps", asked, f"{len(self.cases)} legs over {maps} maps", enough)]


STUDY = Study(
    "plan",
    "Is the 1-sigma that the planner promises for a leg what the navigator has at its end?",
    plan,
    run_case,
    report,
    runs=200,
    chunk=20,
)

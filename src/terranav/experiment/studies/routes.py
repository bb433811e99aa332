"""Routes: is the route that the planner gives better located than the straight line, and does a navigator find it so?

Pairs of places are drawn by the seed, so many on each of the maps MAPS that are at hand: both at least INSIDE_M inside
the map's edges, at least half of the shorter side of what is left apart, and the straight line between them without a
void. Nothing is asked of the terrain. The rule for every pair, set before any was looked at: the lowest largest 1-sigma
for at most EXTRA more length, with the planner's other defaults but for the studies' sensor (3 m, every 2 s), from a
start known to START_M (the satellites end there). The plan is made on the map inside that margin, so that no route
follows an edge.

Flown are both, route and straight line, by the navigator, in a world that is as it is told
(`terranav.experiment.studies.world`): the same seeds for the drift, the readings and the navigator. The figure of a
line is the largest, over PARTS equal parts of it, of the root mean square error over the runs and over the epochs of
that part. Straight over route is bootstrapped over the runs, both lines of a run together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree, offset_m
from terranav.core.recording import Recording
from terranav.experiment.papers.outcome import Table
from terranav.experiment.registry import make_estimator
from terranav.experiment.run import run
from terranav.experiment.studies.matched import ESTIMATOR, TOLD
from terranav.experiment.studies.sources import MapSource, data_folder, terrain_sources
from terranav.experiment.studies.statistics import PerCase, clopper_pearson, per_case
from terranav.experiment.studies.study import CaseRuns, Plan, Report, Setup, Study, Verdict, plain, shown
from terranav.experiment.studies.tracks import INTERVAL_S, MATCHED, SENSOR_SIGMA_M, Track
from terranav.experiment.studies.world import flown
from terranav.ins.drift import add_drift
from terranav.ins.grades import grade_named
from terranav.maps.map import Map
from terranav.planning._route_judge import Line
from terranav.planning.route import Route, RouteSettings, plan_route, recording_of

FloatArray = NDArray[np.float64]

MAPS = ("sample", "N48E009", "s36_e149_3arc_v2")
PAIRS = 10  # on each
INSIDE_M = 2000.0
EXTRA, ASKED_EXTRA = 0.15, 0.20
START_M = 10.0
SETTINGS = RouteSettings(extra=EXTRA, start_sigma_m=START_M, sensor_sigma=SENSOR_SIGMA_M, rate_hz=1.0 / INTERVAL_S)
INS = replace(grade_named("tactical"), position_sigma_m=START_M)
PARTS = 40
ASKED_SHARE = 25 / 30
CANDIDATES = 2000


@dataclass(frozen=True)
class RouteCase:
    """A pair of places on a map, and the settings of the navigator."""

    name: str
    source: MapSource
    start: tuple[float, float]
    end: tuple[float, float]
    settings: tuple[tuple[str, Any], ...] = ()

    def facts(self) -> Mapping[str, Any]:
        """What its figures depend on."""
        return {
            "name": self.name, "map": self.source.facts(), "start": self.start, "end": self.end,
            "settings": dict(self.settings), "route": repr(SETTINGS), "ins": repr(INS),
        }  # fmt: skip


@dataclass(frozen=True)
class _Along:
    """A line over a map, as `flown` takes a track."""

    chart: Map
    rec: Recording
    kind: str = "terrain"

    def true_recording(self) -> Recording:
        return self.rec


def plan(setup: Setup) -> Plan:
    """Draw the pairs.

    Raises
    ------
    ConfigError
        A setting that the navigator does not have, or a map that is not there.
    """
    wanted = PAIRS if setup.tracks is None else setup.tracks
    settings = {**TOLD, **setup.settings}
    sources = {source.name: source for source in terrain_sources(data_folder(setup.data), setup.maps)}
    given = {path.stem for path in setup.maps}
    cases: list[RouteCase] = []
    for name, source in sources.items():
        if name in MAPS or name in given:
            cases += _drawn(source, wanted, setup.seed, tuple(sorted(settings.items())))
    if cases:
        make_estimator(ESTIMATOR, (cases[0].source.open(),), INS, **settings)
    missing = [name for name in MAPS if name not in sources]
    notes = [f"{name}: not at hand, its pairs are left out (--data DIR)" for name in missing]
    return Plan(cases, notes)


def _drawn(source: MapSource, count: int, seed: int, settings: tuple[tuple[str, Any], ...]) -> list[RouteCase]:
    """The first pairs that meet the criteria in the head of this module."""
    inner = inside(source)
    south, west, north, east = inner.bounds_deg
    per_lat, per_lon = (float(value) for value in metres_per_degree(0.5 * (south + north)))
    least = 0.5 * min((north - south) * per_lat, (east - west) * per_lon)
    rng = np.random.default_rng(SeedSequence([seed, int(inner.checksum[:8], 16), 7]))
    found: list[RouteCase] = []
    for _ in range(CANDIDATES):
        lat, lon = south + rng.random(2) * (north - south), west + rng.random(2) * (east - west)
        apart = math.hypot(*(float(axis) for axis in offset_m(lat[0], lon[0], lat[1], lon[1])))
        part = np.linspace(0.0, 1.0, max(2, round(4.0 * apart / inner.cell_m)))
        line = lat[0] + part * (lat[1] - lat[0]), lon[0] + part * (lon[1] - lon[0])
        if apart >= least and np.isfinite(inner.sample(*line)).all():
            ends = [(float(lat[i]), float(lon[i])) for i in (0, 1)]
            found.append(RouteCase(f"{source.name}-{len(found) + 1:02d}", source, ends[0], ends[1], settings))
            if len(found) == count:
                break
    return found


@lru_cache(maxsize=8)
def inside(source: MapSource) -> Map:
    """A map without what lies within INSIDE_M of its edges."""
    chart = source.open()
    south, west, north, east = chart.bounds_deg
    per_lat, per_lon = (INSIDE_M / float(value) for value in metres_per_degree(0.5 * (south + north)))
    return chart.crop(south + per_lat, west + per_lon, north - per_lat, east - per_lon)


@lru_cache(maxsize=64)
def planned(case: RouteCase) -> Route:
    """The route of a pair; made once in each process."""
    return plan_route(inside(case.source), case.start, case.end, SETTINGS, INS)


def run_case(case: RouteCase, seeds: SeedSequence) -> dict[str, float]:
    """One flight of the route and one of the straight line, with the same draws.

    Returns
    -------
    dict
        route_m, straight_m: largest 1-sigma by the bound; extra: share of more length; length_m: of the straight line;
        r_00 .., s_00 ..: mean squared error in each part of the route and of the straight line [m^2].
    """
    route, chart = planned(case), case.source.open()
    told = {
        "route_m": route.line.top_m, "straight_m": route.straight.top_m,
        "extra": route.extra, "length_m": route.straight.length_m,
    }  # fmt: skip
    state = seeds.generate_state(2).tolist()
    for letter, line in (("r", route.line), ("s", route.straight)):
        squared = _squared(case, chart, line, state)
        told |= {f"{letter}_{i:02d}": float(part.mean()) for i, part in enumerate(np.array_split(squared, PARTS))}
    return told


def _squared(case: RouteCase, chart: Map, line: Line, state: Sequence[int]) -> FloatArray:
    """(n,) squared distance from the truth along a line [m^2]."""
    world = np.random.default_rng(state[0])
    track = _Along(chart, recording_of(line, chart, SETTINGS, INS))
    rec = flown(cast("Track", track), MATCHED, world).rec  # all that it asks of a track
    true = {key: rec.columns[f"true_{key}"] for key in ("lat_deg", "lon_deg")}
    rec = add_drift(replace(rec.with_columns(**true), ins=INS), INS, world)
    result = run(ESTIMATOR, rec, [chart], seed=int(state[1]), **dict(case.settings))
    return np.asarray(np.sum(result.error_m**2, axis=1))


def largest(squared: FloatArray) -> FloatArray:
    """Largest over parts of the RMSE of runs: (..., runs, parts) to (...)."""
    return np.asarray(np.sqrt(squared.mean(axis=-2).max(axis=-1)))


def gain(both: FloatArray) -> FloatArray:
    """Straight over route of runs (..., runs, 2 parts), the route's parts first."""
    return np.asarray(largest(both[..., PARTS:]) / largest(both[..., :PARTS]))


def report(cases: Sequence[CaseRuns]) -> Report:
    """A row a pair, and what was asked."""
    samples = [_parts(one) for one in cases]
    gains = per_case(samples, gain)
    lines = [per_case([one[:, part] for one in samples], largest) for part in (slice(0, PARTS), slice(PARTS, None))]
    rows, facts = [], []
    for i, one in enumerate(cases):
        length, route, straight, extra = (float(one[key][0]) for key in ("length_m", "route_m", "straight_m", "extra"))
        simulated = [line.interval(i) for line in lines]
        rows.append(
            (
                one.case.name, f"{length / 1000:.1f}", f"{100 * extra:.1f}", f"{straight:.1f}", f"{route:.1f}",
                shown(simulated[1], 1), shown(simulated[0], 1), shown(gains.interval(i)),
            )
        )  # fmt: skip
        facts.append(
            {
                "pair": one.case.name, "runs": one.runs, "length_m": length, "extra": extra, "straight_m": straight,
                "route_m": route, "rmse_straight_m": plain(simulated[1]), "rmse_route_m": plain(simulated[0]),
                "gain": plain(gains.interval(i)),
            }
        )  # fmt: skip
    columns = (
        "pair", "straight [km]", "extra [%]", "1-sigma straight [m]", "route [m]",
        "RMSE straight [m]", "route [m]", "straight / route",
    )  # fmt: skip
    title = "Largest along the way: 1-sigma by the bound, and RMSE of the navigator; 95 % intervals"
    return Report([Table(title, columns, tuple(rows))], _verdicts(cases, gains), [_NOTE], facts)


_NOTE = (
    "the bound's 1-sigma is along the longest axis, the RMSE that of the horizontal distance: up to 1.41 times it; "
    f"its largest is over {PARTS} parts of the way"
)


def _parts(one: CaseRuns) -> FloatArray:
    """(runs, 2 parts) mean squared errors, the route's first."""
    return np.stack([one[f"{letter}_{i:02d}"] for letter in "rs" for i in range(PARTS)], axis=1)


def _verdicts(cases: Sequence[CaseRuns], gains: PerCase) -> list[Verdict]:
    """What was asked of the pairs."""
    asked = math.ceil(ASKED_SHARE * len(cases) - 1e-9)
    better = [bool(one["route_m"][0] < one["straight_m"][0] and one["extra"][0] < ASKED_EXTRA) for one in cases]
    seen = [good and bool(gains.values[i] > 1.0) for i, good in enumerate(better)]
    sure = [good and bool(gains.interval(i).low > 1.0) for i, good in enumerate(better)]
    worse = sum(bool(gains.interval(i).high < 1.0) for i in range(len(cases)))
    middle = gains.over_cases(np.median)
    of = f"of {len(cases)}"
    return [
        _counted("pairs with a lower largest 1-sigma, less than 20 % longer", better, asked),
        _counted("of these with a lower largest RMSE flown", seen, asked),
        _counted("of these beyond the interval", sure, None),
        Verdict("pairs with a larger RMSE beyond the interval", f"0 {of}", f"{worse} {of}", worse == 0),
        Verdict("RMSE straight / route, median of pairs", "> 1", shown(middle), bool(middle.low > 1.0)),
    ]


def _counted(text: str, found: Sequence[bool], asked: int | None) -> Verdict:
    """A count with the interval of its share."""
    count, of = sum(found), len(found)
    share = clopper_pearson(count, of)
    measured = f"{count} of {of} ({100 * share.low:.0f} to {100 * share.high:.0f} %)"
    return Verdict(
        text, "–" if asked is None else f">= {asked} of {of}", measured, None if asked is None else count >= asked
    )


STUDY = Study(
    "routes", "Is a planned route better located than the straight line?", plan, run_case, report, runs=20, chunk=5
)

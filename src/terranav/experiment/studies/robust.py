"""Robust: what the navigator does where it is told something wrong, or something happens that it was not told of.

On the first tracks of each map that `bound` flies, with the navigator's defaults; errors count as there. In each run
the flights that are compared have the same draws.

- bias: the barometer is off by 30 m, or, over the same relief taken for a seabed, the tide by 3 m, against no bias;
- wrong model: the sensor is twice as noisy as told; 5 % of its readings are off by 200 m; the walk of the INS is three
  times what is told;
- kidnapped: in the middle of the flight, with a reading a second, the INS jumps 5 km in a direction that keeps it on
  the map;
- smoothing: the smoother against the filter before the filter's first fix.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence

from terranav.core.earth import shift
from terranav.core.errors import DataError, StateError
from terranav.core.recording import Recording
from terranav.core.records import Status
from terranav.experiment.inputs import prepare
from terranav.experiment.registry import make_estimator
from terranav.experiment.result import Result
from terranav.experiment.run import rng_of, run
from terranav.experiment.smooth import smooth
from terranav.experiment.stream import states
from terranav.experiment.studies.ensemble import losses
from terranav.experiment.studies.matched import ESTIMATOR, informative_tracks
from terranav.experiment.studies.robust_report import report
from terranav.experiment.studies.study import Plan, Setup, Study
from terranav.experiment.studies.tracks import INS, Track, World, settled_index, track_bound
from terranav.experiment.studies.world import Flown, flown

TRACKS = 2  # on each map
BIASES = {"barometer 30 m": ("terrain", 30.0), "tide 3 m": ("bathymetry", 3.0)}
WRONG = {
    "noise x 2": World(noise_factor=2.0),
    "5 % off by 200 m": World(gross_share=0.05, gross_size=200.0),
    "INS walk x 3": World(walk_factor=3.0),
}
KIDNAPPED, SMOOTHING = "kidnapped by 5 km", "smoothing"
JUMP_M, DIRECTIONS = 5000.0, 64
FOUND_CELLS = 3.0


@dataclass(frozen=True)
class RobustCase:
    """One track and what is wrong over it."""

    track: Track
    what: str
    settings: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """'sample-01, noise x 2'."""
        return f"{self.track.name}, {self.what}"

    def facts(self) -> Mapping[str, Any]:
        """What its figures depend on."""
        return {**self.track.facts(), "what": self.what, "settings": dict(self.settings), "ins": repr(INS)}


def plan(setup: Setup) -> Plan:
    """The tracks, each with everything that can be wrong.

    Raises
    ------
    ConfigError
        A setting that the navigator does not have, or a map that is not there.
    """
    tracks, notes = informative_tracks(setup, TRACKS)
    settings = tuple(sorted(setup.settings.items()))
    if tracks:
        make_estimator(ESTIMATOR, (tracks[0].chart,), INS, **setup.settings)
    whats = (*BIASES, *WRONG, KIDNAPPED, SMOOTHING)
    return Plan([RobustCase(_for(track, what), what, settings) for what in whats for track in tracks], notes)


def _for(track: Track, what: str) -> Track:
    """The track as a case wants it: its relief as another kind of map, its readings more often."""
    kind = BIASES[what][0] if what in BIASES else track.kind
    leg = replace(track.leg, interval_s=1.0) if what == KIDNAPPED else track.leg
    return Track(track.name, track.source, leg, kind)


def run_case(case: RobustCase, seeds: SeedSequence) -> dict[str, float]:
    """One run of a case; the names of its figures are said at `biased`, `wrong`, `kidnapped` and `smoothed`."""
    world, estimator = seeds.spawn(2)
    seed = int(estimator.generate_state(1)[0])
    if case.what in BIASES:
        return biased(case, world, seed)
    if case.what in WRONG:
        return wrong(case, world, seed)
    return kidnapped(case, world, seed) if case.what == KIDNAPPED else smoothed(case, world, seed)


def biased(case: RobustCase, world: SeedSequence, seed: int) -> dict[str, float]:
    """plain_m2, biased_m2: mean squared distance without and with the bias; bias_off: its estimate at the end minus the
    truth, in sigmas that the navigator claims.
    """
    value = BIASES[case.what][1]
    first, figures = _first(case), {}
    for name, bias in (("plain", 0.0), ("biased", value)):
        flight = _flown(case, World(bias_sigma=0.0, bias=bias), world)
        error, mean, sigma = _with_bias(case, flight, seed)
        figures[f"{name}_m2"] = float(np.mean(np.sum(error[first:] ** 2, axis=1)))
        figures["bias_off"] = (mean - float(flight.bias[-1])) / sigma
    return figures


def wrong(case: RobustCase, world: SeedSequence, seed: int) -> dict[str, float]:
    """mse_m2, nees (2 degrees of freedom), contained_95, lost, unsaid (`ensemble.losses`), usable, misleading."""
    first = _first(case)
    rec = _flown(case, WRONG[case.what], world).rec
    result = _run(case, rec, seed)
    metrics = result.metrics(since_s=float(result.time_s[first] - result.time_s[0]))
    kept = {key: metrics[key] for key in ("nees", "contained_95", "available", "misleading")}
    return {"mse_m2": metrics["drms_m"] ** 2, **kept, **losses(result, first)}


def kidnapped(case: RobustCase, world: SeedSequence, seed: int) -> dict[str, float]:
    """declared_s: from the jump to the status 'lost', infinite when it never comes. near: 1 when it ends within
    FOUND_CELLS cells of the truth; found: 1 when besides it ends with a status that offers a position; found_s: from
    the jump to the first such epoch after 'lost'. unsaid: 1 when it is beyond 1 km with such a status later than 60 s
    after the jump.
    """
    rng = np.random.default_rng(world)
    rec = flown(case.track, World(), rng).rec
    jump = len(rec) // 2
    result = _run(case, _jumped(rec, case, jump, rng), seed)
    since = result.time_s - result.time_s[jump]
    lost = np.flatnonzero((result.status == Status.LOST.value) & (since >= 0.0))
    offered = np.isin(result.status, (Status.CONVERGED.value, Status.DEGRADED.value))
    near = np.hypot(*result.error_m.T) <= FOUND_CELLS * case.track.chart.cell_m
    right = offered & near
    again = np.flatnonzero(right & (np.arange(len(rec)) > (lost[0] if lost.size else len(rec))))
    late = int(np.searchsorted(since, 60.0, side="right"))
    return {
        "declared_s": float(since[lost[0]]) if lost.size else math.inf,
        "near": float(near[-1]),
        "found": float(right[-1]),
        "found_s": float(since[again[0]]) if again.size else math.inf,
        "unsaid": losses(result, late)["unsaid"],
    }


def smoothed(case: RobustCase, world: SeedSequence, seed: int) -> dict[str, float]:
    """filter_m2, smoother_m2: sums of squared distances before the filter's first fix, over before_fix epochs (0 when
    it has none).
    """
    rec = _flown(case, World(), world).rec
    settings = dict(case.settings)
    forward = _run(case, rec, seed)
    backward = smooth(ESTIMATOR, rec, [case.track.chart], seed=seed, **settings)
    fix_s = forward.metrics()["first_fix_s"]
    if math.isnan(fix_s):
        return {"before_fix": 0.0, "filter_m2": 0.0, "smoother_m2": 0.0}
    before = forward.time_s - forward.time_s[0] < fix_s
    sums = [float(np.sum(result.error_m[before] ** 2)) for result in (forward, backward)]
    return {"before_fix": float(before.sum()), "filter_m2": sums[0], "smoother_m2": sums[1]}


def _first(case: RobustCase) -> int:
    """The first epoch that counts."""
    first = settled_index(track_bound(Track(case.track.name, case.track.source, case.track.leg)))
    if first is None:
        raise StateError(f"{case.name}: the bound does not come down")
    return first


def _flown(case: RobustCase, world: World, seeds: SeedSequence) -> Flown:
    """A flight of the case's track: the same draws for the same seeds, whatever the world."""
    return flown(case.track, world, np.random.default_rng(seeds.generate_state(4)))


def _run(case: RobustCase, rec: Recording, seed: int) -> Result:
    return run(ESTIMATOR, rec, [case.track.chart], seed=seed, **dict(case.settings))


def _with_bias(case: RobustCase, flight: Flown, seed: int) -> tuple[np.ndarray[Any, Any], float, float]:
    """Errors (n, 2) [m], and the estimate of the bias at the end with its sigma [unit]."""
    inputs = prepare(flight.rec, [case.track.chart], None, None, needs_maps=True)
    navigator = make_estimator(ESTIMATOR, inputs.maps, inputs.ins, **dict(case.settings))
    run_of = list(states(navigator, inputs.prior, inputs.epochs, rng_of(ESTIMATOR, seed)))
    result = Result.from_estimates(ESTIMATOR, [navigator.estimate(state) for state in run_of], flight.rec)
    inner = getattr(run_of[-1], "inner", run_of[-1])  # of the monitor, or the navigator's own
    index = inner.model.bias_index(case.track.kind)
    return result.error_m, float(inner.mean[index]), math.sqrt(float(inner.cov[index, index]))


def _jumped(rec: Recording, case: RobustCase, jump: int, rng: Generator) -> Recording:
    """The recording whose INS is 5 km off from epoch `jump` on, in a direction that keeps it on the map."""
    lat, lon = rec.lat_deg.copy(), rec.lon_deg.copy()
    for angle in rng.uniform(0.0, 2.0 * math.pi, DIRECTIONS).tolist():
        away = shift(lat[jump:], lon[jump:], JUMP_M * math.cos(angle), JUMP_M * math.sin(angle))
        if np.isfinite(case.track.chart.sample(*away)).all():
            lat[jump:], lon[jump:] = away
            return rec.with_columns(lat_deg=lat, lon_deg=lon)
    raise DataError(f"{case.name}: no jump of {JUMP_M:g} m stays on the map")


STUDY = Study("robust", "What does the navigator do where it is told something wrong?", plan, run_case, report, runs=20)

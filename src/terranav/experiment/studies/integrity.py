"""Integrity: is the error of a fix that is offered within its protection level, at the declared risk?

Flights of 150 readings, one a second, over three kinds of ground in a world that is what the navigator assumes: map
error correlated along the track, a bias of the barometer, an INS on position level. 'flat' teaches nothing: no fix may
be offered. 'self-similar' is one tile of rough ground repeated every 500 m, with as little beside it as the altimeter's
noise: places look alike, and a fix is offered only where the readings tell them apart. On 'rough' ground a fix should
be offered nearly always.

What is counted, of each run: at one time drawn from its second half, whether a fix is offered and whether its error is
beyond the protection level. Runs are independent, so these are Bernoulli trials, and the upper bound of the rate is
Clopper and Pearson's (Biometrika 26, 1934). Beside it stands whether any offered fix of a run was ever beyond.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence
from scipy.stats import beta

from terranav.core.earth import shift
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS
from terranav.core.records import Epoch, Estimate, Measurement, Prior, Status
from terranav.experiment.registry import make_estimator
from terranav.experiment.stream import stream
from terranav.ins.drift import draw_drift
from terranav.maps.fields import gaussian_map
from terranav.maps.map import FloatArray, Map

TERRAINS = ("flat", "rough", "self-similar")
RISK = 1e-3
READINGS = 150
SPEED_MPS = 60.0
SIGMA_M = 3.0  # of a reading
MAP_SIGMA_M = 2.0
CELLS, CELL_M = 400, 50.0
PERIOD_CELLS = 10
GROUNDS = 8  # different maps of each terrain
INS = InsGrade(position_sigma_m=250.0, velocity_sigma_mps=0.5, position_walk_m_per_sqrt_s=1.0)


def run_case(terrain: str, seed: SeedSequence, **settings: Any) -> dict[str, float]:
    """Fly once.

    Parameters
    ----------
    terrain : 'flat', 'rough' or 'self-similar'
    seed : SeedSequence
        Of the run.
    **settings
        Of the navigator and its monitor.

    Returns
    -------
    dict
        usable and beyond (0 or 1, at the drawn time), error_m and protection_m there (NaN when no fix is offered),
        usable_share (of the second half), ever_beyond (0 or 1, any time), lost (0 or 1, whether it was ever lost),
        unannounced (0 or 1: beyond 1 km with the status 'converged' or 'degraded' at any time).
    """
    rng = np.random.default_rng(seed)
    chart = ground(terrain, int(rng.integers(GROUNDS)))
    epochs, error_m = flight(chart, rng)
    navigator = make_estimator("marginalized", [chart], INS, risk=RISK, **settings)
    estimates = list(stream(navigator, Prior.from_ins(INS), epochs, rng))
    return _figures(estimates, error_m, int(rng.integers(READINGS // 2, READINGS)))


def flight(chart: Map, rng: Generator) -> tuple[list[Epoch], FloatArray]:
    """A straight flight across a map from its middle, and the true INS error (n, 2) [m]."""
    time_s = np.arange(READINGS, dtype=np.float64)
    heading, side = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-2000.0, 2000.0, 2)
    along = SPEED_MPS * (time_s - 0.5 * READINGS)
    lat, lon = shift(*chart.centre_deg, side[0] + along * math.cos(heading), side[1] + along * math.sin(heading))
    error_m, velocity_mps = draw_drift(time_s, INS, rng)
    ins_lat, ins_lon = shift(lat, lon, *error_m.T)
    value = chart.sample(lat, lon) + _common_error(chart, rng) + rng.normal(0.0, SIGMA_M, READINGS)
    speed = SPEED_MPS * np.array([math.cos(heading), math.sin(heading)]) + velocity_mps
    epochs = [
        Epoch(
            float(t), float(ins_lat[i]), float(ins_lon[i]), 1500.0, (float(speed[i, 0]), float(speed[i, 1]), 0.0), None,
            (Measurement(chart.kind, float(value[i]), SIGMA_M),),
        )
        for i, t in enumerate(time_s)
    ]  # fmt: skip
    return epochs, error_m


@lru_cache(maxsize=len(TERRAINS) * GROUNDS)
def ground(terrain: str, number: int) -> Map:
    """One of the maps of a terrain."""
    rng = np.random.default_rng([TERRAINS.index(terrain), number])
    std, length_m = {"flat": (0.3, 2000.0), "rough": (60.0, 500.0), "self-similar": (SIGMA_M, 1000.0)}[terrain]
    chart = gaussian_map(rng, std=std, correlation_m=length_m, cells=CELLS, cell_m=CELL_M, sigma=MAP_SIGMA_M)
    if terrain != "self-similar":
        return chart
    tile = gaussian_map(rng, std=60.0, correlation_m=125.0, cells=PERIOD_CELLS, cell_m=CELL_M).values
    times = CELLS // PERIOD_CELLS
    values = chart.values + np.tile(tile, (times, times))
    return Map(values, chart.transform, sigma=MAP_SIGMA_M, source="synthetic", name=terrain)


def summary(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Counts, rates and bounds of the runs of one terrain, or of all.

    Returns
    -------
    dict
        runs, offered, beyond, rate (beyond over offered), upper_95 (of that), upper_95_per_run (beyond over runs),
        ever_beyond (runs), available (mean share of the second half), lost, unannounced (runs), error_m and
        protection_m (medians of offered fixes).
    """
    offered = sum(row["usable"] for row in rows)
    beyond = sum(row["beyond"] for row in rows)
    return {
        "runs": len(rows),
        "offered": offered,
        "beyond": beyond,
        "rate": beyond / offered if offered else math.nan,
        "upper_95": upper_bound(int(beyond), int(offered)),
        "upper_95_per_run": upper_bound(int(beyond), len(rows)),
        "ever_beyond": sum(row["ever_beyond"] for row in rows),
        "available": float(np.mean([row["usable_share"] for row in rows])) if rows else math.nan,
        "lost": sum(row["lost"] for row in rows),
        "unannounced": sum(row["unannounced"] for row in rows),
        "error_m": _median([row["error_m"] for row in rows]),
        "protection_m": _median([row["protection_m"] for row in rows]),
    }


def upper_bound(events: int, trials: int, confidence: float = 0.95) -> float:
    """One-sided upper confidence bound of a probability (Clopper and Pearson); 1 without trials."""
    return float(beta.ppf(confidence, events + 1, trials - events)) if events < trials else 1.0


def _common_error(chart: Map, rng: Generator) -> FloatArray:
    """Error that neighbouring readings share: a constant bias, and the map's, first-order Markov along the track."""
    step = math.exp(-SPEED_MPS / chart.error_length_m)
    white, error = rng.standard_normal(READINGS), np.empty(READINGS)
    error[0] = white[0]
    for i in range(1, READINGS):
        error[i] = step * error[i - 1] + math.sqrt(1.0 - step * step) * white[i]
    return chart.sigma * error + rng.normal(0.0, KINDS[chart.kind].bias_sigma)


def _figures(estimates: Sequence[Estimate], error_m: FloatArray, drawn: int) -> dict[str, float]:
    """What is kept of a run."""
    off = np.hypot(*(np.array([one.ins_error_m for one in estimates]) - error_m).T)
    level = np.array([one.protection_m for one in estimates])
    usable = np.array([one.usable for one in estimates])
    status = np.array([one.status.value for one in estimates])
    offered = bool(usable[drawn])
    return {
        "usable": float(offered),
        "beyond": float(offered and off[drawn] > level[drawn]),
        "error_m": float(off[drawn]) if offered else math.nan,
        "protection_m": float(level[drawn]) if offered else math.nan,
        "usable_share": float(usable[READINGS // 2 :].mean()),
        "ever_beyond": float((usable & (off > level)).any()),
        "lost": float((status == Status.LOST.value).any()),
        "unannounced": float((np.isin(status, (Status.CONVERGED.value, Status.DEGRADED.value)) & (off > 1000.0)).any()),
    }


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return float(np.median(known)) if known else math.nan

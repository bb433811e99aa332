"""The flights of papers/001: Gauss-Markov terrain and motion, under each reading of what the text leaves open."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree, shift
from terranav.core.errors import DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior
from terranav.experiment.registry import make_estimator
from terranav.experiment.stream import stream
from terranav.maps.gauss_markov import GaussMarkov, gauss_markov_map
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

SPEED_MPS = 140.0
START_M = 10.0
ALTITUDE_M = 200.0
SECONDS = 50  # one sample a second, the first at the start
RADAR_SIGMA_M = 1.0
MOTION = GaussMarkov(10.0, 0.51)
SIDE = 5001  # cells of 1 m
HEIGHTS_M = (35.0, 80.0)

#: 1-sigma of the change of the motion process over one second: what a random walk has to make up for
WALK_M = math.sqrt(2.0 * float(MOTION.autocorrelation(0.0) - MOTION.autocorrelation(1.0)))

TERRAINS = ("sigma 20 m", "heights 35..80 m")
MOTIONS = ("nominal motion known", "displacement known")

_PRINTED: dict[str, Any] = {
    "min_cell_m": 1.0,
    "max_cell_m": 1.0,
    "band": 1.0,
    "likelihood_var_m2": 25.0,
    "outlier_share": 0.0,
    "interpolation": "bicubic",
    "point": "peak",
}


@dataclass(frozen=True, slots=True)
class Contestant:
    """A method with its settings; whether it is told of process noise, and starts from a uniform prior."""

    label: str
    method: str
    settings: dict[str, Any]
    process_noise: bool = True
    uniform: bool = False


PRINTED = Contestant("bayes_grid, as printed", "bayes_grid", _PRINTED, process_noise=False, uniform=True)
LINEAR = replace(PRINTED, label="bayes_grid, as printed, linear", settings={**_PRINTED, "interpolation": "bilinear"})
NOISY = replace(PRINTED, label="bayes_grid, eq. 7 noise", process_noise=True)
MEAN = replace(NOISY, label="bayes_grid, eq. 7 noise, mean", settings={**_PRINTED, "point": "mean"})
RIVALS = (
    Contestant("EKF (sitan)", "sitan", {}),
    Contestant("UKF", "ukf", {}),
    Contestant("particle", "particle", {}),
    Contestant("pointmass", "pointmass", {}),
)
IDLE = Contestant("no aiding", "ins", {})
CONTESTANTS = (
    PRINTED,
    LINEAR,
    NOISY,
    MEAN,
    Contestant("bayes_grid, defaults", "bayes_grid", {}),
    *RIVALS,
    IDLE,
)


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight: the map, what the navigator gets, and the error of what it is told of its position (n, 2) [m]."""

    chart: Map
    epochs: tuple[Epoch, ...]
    error_m: FloatArray
    ins: InsGrade


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of one contestant on one flight.

    Attributes
    ----------
    error_m : (n, 2) [m]
        Estimated minus true position, x (east) and y (north).
    nees : (n,)
        Squared error over the told covariance, 2 on average when that is honest.
    """

    error_m: FloatArray
    nees: FloatArray


def terrains(maps: tuple[Map, ...]) -> tuple[str, ...]:
    """Names of the terrains that are flown over: the paper's two readings, or the map given."""
    return (f"map {maps[0].name!r}",) if maps else TERRAINS


def flights(seed: SeedSequence, maps: tuple[Map, ...]) -> Iterator[tuple[str, str, Flight]]:
    """The same motion and the same noise over each terrain, for each reading of the motion."""
    for_terrain, for_motion, for_noise = (np.random.default_rng(child) for child in seed.spawn(3))
    deviation = np.stack([MOTION.profile(for_motion, SECONDS, 1.0, from_rest=True)[:, 0] for _ in range(2)], axis=1)
    start = for_motion.normal(0.0, MOTION.sigma, 2)
    noise = for_noise.normal(0.0, RADAR_SIGMA_M, SECONDS)
    for terrain, chart, origin in _charts(for_terrain, maps):
        for motion in MOTIONS:
            yield terrain, motion, _flown(chart, origin, motion, (deviation, start, noise))


def fly(contestant: Contestant, flight: Flight, seed: SeedSequence) -> Outcome:
    """Run one method over one flight."""
    ins = flight.ins if contestant.process_noise else replace(flight.ins, position_walk_m_per_sqrt_s=0.0)
    prior = Prior.from_ins(ins, "uniform" if contestant.uniform else "gaussian")
    estimator = make_estimator(contestant.method, [flight.chart], ins, **contestant.settings)
    said = list(stream(estimator, prior, flight.epochs, np.random.default_rng(seed)))
    miss = np.array([one.ins_error_m for one in said]) - flight.error_m
    inverse = np.linalg.inv(np.array([one.cov_m2 for one in said]))
    nees = np.einsum("ki,kij,kj->k", miss, inverse, miss)
    return Outcome(-miss[:, ::-1], nees)


def _charts(rng: Generator, maps: tuple[Map, ...]) -> Iterator[tuple[str, Map, tuple[float, float]]]:
    """Name of each terrain, its map, and latitude and longitude of its corner x = y = 0."""
    if maps:
        chart = replace(maps[0], sigma=0.0)  # the flight is simulated over the map as it is
        half = 0.5 * (2.0 * START_M + SPEED_MPS * math.sqrt(0.5) * SECONDS)
        corner = shift(*chart.centre_deg, -half, -half)
        yield terrains(maps)[0], chart, (float(corner[0]), float(corner[1]))
        return
    # centred so that the corner cell lies at latitude and longitude zero, where degrees are metres
    half_lat, half_lon = (0.5 * (SIDE - 1) / float(v) for v in metres_per_degree(0.0))
    chart = gauss_markov_map(rng, shape=(SIDE, SIDE), centre_deg=(half_lat, half_lon))
    yield TERRAINS[0], chart, (0.0, 0.0)
    low, high = float(chart.values.min()), float(chart.values.max())
    scale = (HEIGHTS_M[1] - HEIGHTS_M[0]) / (high - low)
    yield TERRAINS[1], replace(chart, values=HEIGHTS_M[0] + scale * (chart.values - low)), (0.0, 0.0)


def _flown(
    chart: Map, origin: tuple[float, float], motion: str, drawn: tuple[FloatArray, FloatArray, FloatArray]
) -> Flight:
    """One flight over one map; `drawn` are deviation, error at the start and radar noise."""
    deviation, start, noise = drawn
    nominal = START_M + SPEED_MPS * math.sqrt(0.5) * np.arange(SECONDS)[:, None] * np.ones(2)
    true = nominal + deviation
    known = motion == MOTIONS[1]
    error = np.tile(start, (SECONDS, 1)) if known else -deviation
    lat, lon = shift(*origin, true[:, 0], true[:, 1])
    told_lat, told_lon = shift(*origin, *(true + error).T)
    height = chart.sample(lat, lon, "bicubic") + noise
    if np.isfinite(height).mean() < 0.9:
        raise DataError(f"{chart.name}: the flight of 7 km leaves the map, expected a map of 5 km x 5 km without voids")
    speed = SPEED_MPS * math.sqrt(0.5)
    epochs = tuple(
        Epoch(
            float(k),
            float(told_lat[k]),
            float(told_lon[k]),
            ALTITUDE_M,
            (speed, speed, 0.0),
            measurements=(Measurement(chart.kind, float(height[k]), RADAR_SIGMA_M),) if np.isfinite(height[k]) else (),
        )
        for k in range(SECONDS)
    )
    walk = 0.0 if known else WALK_M
    ins = InsGrade(position_sigma_m=MOTION.sigma, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=walk)
    return Flight(chart, epochs, error, ins)

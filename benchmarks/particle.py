"""A step of the particle filter through its public estimator: spread, sample, weigh, moments, resample."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from importlib import import_module
from itertools import count as counted
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from benchmarks.limits import byte_ns, fetch_ns, multiply_add_ns
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior
from terranav.filters.particle import Particle
from terranav.maps.frame import LocalFrame
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map

FloatArray = NDArray[np.float64]
Call = Callable[[], tuple[FloatArray, FloatArray]]

PRIOR_M, WALK_M, SIGMA_M = 600.0, 20.0, 20.0
STEPS = 10
OPERATIONS = 310  # on each particle: normal numbers 132, their sums 50, the place 24, bilinear 32, two 2^x 30, sums 42
FETCHES = 10  # four of the map; the order takes three, the copies a weight, a place and two coordinates, by twos
STREAMED = 200  # bytes read and written in order, over all passes
NUMPY, STONE_SOUP = (
    4.7,
    19.0,
)  # times faster than these so far, where more was meant: the order of the copies costs a quarter

SOUP = {  # its modules
    "nonlinear": "models.measurement.nonlinear",
    "linear": "models.transition.linear",
    "predictor": "predictor.particle",
    "updater": "updater.particle",
    "resampler": "resampler.particle",
    "array": "types.array",
    "detection": "types.detection",
    "hypothesis": "types.hypothesis",
    "state": "types.state",
}


@dataclass(frozen=True)
class Case:
    """What all peers are given: a cloud, a map in its local frame, one reading."""

    chart: Map
    frame: LocalFrame
    cloud: FloatArray  # (2, m)
    value: float

    def heights(self, cloud: FloatArray) -> FloatArray:
        """Map values at the true places of INS errors (2, m)."""
        at = self.frame.cells(-cloud[0], -cloud[1])
        return np.asarray(map_coordinates(self.chart.values, at, order=1, output=np.float64, mode="nearest"))


def rows() -> list[Row]:
    return [_row(100_000, 25.0, 6.0), _row(10_000, 0.0, 0.0)]


def _row(count: int, over_stonesoup: float, over_numpy: float) -> Row:
    chart = sample_map()
    lat, lon = chart.centre_deg
    value = float(chart.sample(lat, lon)) + 3.0
    ins = InsGrade(position_sigma_m=PRIOR_M, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=WALK_M)
    filter_ = Particle((chart,), ins, particles=count, resample_share=1.0, roughening=0.0, outlier_share=0.0)
    rng = np.random.default_rng(1)
    reading = (Measurement("terrain", value, math.sqrt(SIGMA_M**2 - chart.sigma**2)),)
    start = filter_.step(filter_.init(Prior.from_ins(ins), rng), Epoch(0.0, lat, lon, 2000.0), rng)
    epoch = Epoch(1.0, lat, lon, 2000.0, measurements=reading)

    def ours() -> tuple[FloatArray, FloatArray]:
        state = filter_.step(start, epoch, rng)
        return state.mean_m, state.cov_m2

    case = Case(chart, chart.local_frame(lat, lon), np.stack([start.north_m, start.east_m]), value)
    calls: dict[str, Call] = {"ours": ours, "numpy and scipy, no order": lambda: _in_numpy(case, rng)}
    try:
        calls["Stone Soup, no order"] = _stonesoup(case)
    except ImportError:
        over_stonesoup = 0.0
    mean, cov = ours()
    for name, call in calls.items():  # each draws its own noise, so that they agree to the noise of a cloud this large
        other_mean, other_cov = call()
        sigma = math.sqrt(float(np.trace(cov)))
        np.testing.assert_allclose(other_mean, mean, atol=6.0 * sigma / math.sqrt(count), err_msg=name)
        np.testing.assert_allclose(other_cov, cov, atol=10.0 * sigma**2 / math.sqrt(count), err_msg=name)
    least = least_ns({name: _in_a_row(call) for name, call in calls.items()}, STEPS * count, repeats=8)
    goals = {"numpy and scipy, no order": (over_numpy, NUMPY), "Stone Soup, no order": (over_stonesoup, STONE_SOUP)}
    peers = tuple(
        Peer(name, least[name], goals[name][0], goals[name][1] if goals[name][0] else 0.0)
        for name in calls
        if name != "ours"
    )
    side = int(math.sqrt(chart.values.size))
    moved = STREAMED * byte_ns(60 * count)
    limit = FETCHES * fetch_ns(side, side / 8.0) + moved + 0.5 * OPERATIONS * multiply_add_ns()
    return Row(
        f"particle step, {count:,} with resampling",
        "particle",
        least["ours"],
        peers,
        Limit("operations, fetches, bytes", limit, 1.7 if over_numpy else 0.0),
    )


def _in_a_row(call: Call) -> Callable[[], object]:
    """Several steps, as a run takes them, each finding its code and memory as the one before left them."""
    return lambda: [call() for _ in range(STEPS)]


def _in_numpy(case: Case, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """The textbook's step on whole arrays."""
    m = case.cloud.shape[1]
    cloud = case.cloud + WALK_M * rng.standard_normal((2, m))
    weight = np.exp(-0.5 * ((case.heights(cloud) - case.value) / SIGMA_M) ** 2)
    weight /= weight.sum()
    mean = cloud @ weight
    away = cloud - mean[:, None]
    cov = (away * weight) @ away.T
    chosen = np.searchsorted(np.cumsum(weight), (np.arange(m) + rng.random()) / m)
    np.take(cloud, np.minimum(chosen, m - 1), axis=1)
    return mean, cov


def _stonesoup(case: Case) -> Call:
    """Stone Soup's predictor, updater and resampler; its measurement model is ours, for it has none of terrain."""
    soup = {name: import_module(f"stonesoup.{path}") for name, path in SOUP.items()}

    class Terrain(soup["nonlinear"].NonLinearGaussianMeasurement):  # type: ignore[misc]
        """Height below the true place."""

        @property
        def ndim_meas(self) -> int:
            return 1

        def function(self, state: Any, noise: bool = False, **_: Any) -> Any:
            return soup["array"].StateVectors(case.heights(np.asarray(state.state_vector, dtype=np.float64))[None, :])

    m = case.cloud.shape[1]
    model = Terrain(ndim_state=2, mapping=(0, 1), noise_covar=np.array([[SIGMA_M**2]]))
    axis = soup["linear"].RandomWalk(WALK_M**2)
    predictor = soup["predictor"].ParticlePredictor(soup["linear"].CombinedLinearGaussianTransitionModel([axis, axis]))
    updater = soup["updater"].ParticleUpdater(model, soup["resampler"].SystematicResampler())
    cloud, even = soup["array"].StateVectors(case.cloud), np.full(m, -math.log(m))
    prior = soup["state"].ParticleState(cloud, log_weight=even, timestamp=datetime(2026, 1, 1))
    micros = counted()  # else the prediction would come from its cache

    def call() -> tuple[FloatArray, FloatArray]:
        at = prior.timestamp + timedelta(seconds=1, microseconds=next(micros))
        predicted = predictor.predict(prior, timestamp=at)
        seen = soup["detection"].Detection(
            soup["array"].StateVector([[case.value]]), timestamp=at, measurement_model=model
        )
        cloud = np.asarray(
            updater.update(soup["hypothesis"].SingleHypothesis(predicted, seen)).state_vector, dtype=np.float64
        )
        return cloud.mean(axis=1), np.cov(cloud)

    return call

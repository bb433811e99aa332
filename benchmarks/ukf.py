"""A step of the unscented Kalman filter through the estimator, beside filterpy's with the same sigma points."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.growth import epoch, ground
from benchmarks.timing import Peer, Row, least_ns
from terranav.core.earth import shift
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Prior
from terranav.filters.ukf import Ukf
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma

FloatArray = NDArray[np.float64]
Moments = tuple[FloatArray, FloatArray]

INS = InsGrade(20.0, 0.0, 1.0)
STEPS, SIGMA = 100, 5.0


def rows() -> list[Row]:
    chart = ground(1201)
    flight = tuple(epoch(2 * k, (chart,), SIGMA) for k in range(STEPS))  # 100 m apart: no two readings meet one hill
    filter_, prior, rng = Ukf((chart,), INS), Prior.from_ins(INS), np.random.default_rng(0)

    def ours() -> Moments:
        state = filter_.init(prior, rng)
        for one in flight:
            state = filter_.step(state, one, rng)
        return state.mean_m, state.cov_m2

    calls = {"ours": ours}
    try:
        kalman = import_module("filterpy.kalman")
        calls["filterpy"] = lambda: _filterpy(kalman, chart, flight, filter_, prior)
        for mine, theirs in zip(ours(), calls["filterpy"](), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-9)
    except ImportError:
        pass
    least = least_ns(calls, STEPS, repeats=5)
    peers = (Peer("filterpy", least["filterpy"], 1.0),) if "filterpy" in least else ()
    return [Row("unscented Kalman filter, step of the estimator", "step", least["ours"], peers)]


def _filterpy(kalman: Any, chart: Map, flight: tuple[Epoch, ...], like: Ukf, prior: Prior) -> Moments:
    points = kalman.MerweScaledSigmaPoints(2, like.alpha, like.beta, like.kappa)
    here: dict[str, Epoch] = {}

    def height(error: FloatArray) -> FloatArray:
        return np.atleast_1d(chart.sample(*shift(here["at"].lat_deg, here["at"].lon_deg, -error[0], -error[1])))

    other = kalman.UnscentedKalmanFilter(2, 1, 1.0, hx=height, fx=lambda error, dt: error, points=points)
    other.x, other.P = prior.mean_m.copy(), prior.cov_m2.copy()
    last: Epoch | None = None
    for one in flight:
        here["at"] = one
        dt = 0.0 if last is None else one.time_s - last.time_s
        other.Q = np.eye(2) * like.ins.position_growth_m2(0.0, dt)
        other.R = np.array([[reading_sigma(one.measurements[0], chart, last, one) ** 2]])
        other.predict()
        other.update(np.array([one.measurements[0].value]))
        last = one
    return other.x, other.P

"""HMMTEM against a dense hidden Markov model, and what the paper leaves open."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import laplace, norm, t

from terranav.core.earth import shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Estimate, Measurement, Prior
from terranav.experiment.stream import states, stream
from terranav.filters.viterbi import NOISES, Viterbi, ViterbiState
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
RNG = np.random.default_rng(0)
SIGMA = 4.0
STILL = InsGrade(position_sigma_m=100.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.0)
SLOW = InsGrade(position_sigma_m=100.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=4.0)
FLAT_START = Prior.from_ins(STILL, "uniform")


@cache
def hills(sigma: float = 0.0) -> Map:
    return gaussian_map(np.random.default_rng(8), std=40.0, correlation_m=300.0, cells=200, cell_m=50.0, sigma=sigma)


def flight(chart: Map, error_m: FloatArray, *, dt_s: float = 1.0, seed: int = 0, every: int = 1) -> list[Epoch]:
    """To and fro within 4 km of the centre at 30 m/s, turning slowly, with errors (n, 2) of the INS."""
    rng = np.random.default_rng(seed)
    way, course = 30.0 * dt_s * np.arange(len(error_m)), 0.64 + 2e-4 * dt_s * np.arange(len(error_m))
    along = np.abs((way + 2000.0) % 16000.0 - 8000.0) - 4000.0
    lat, lon = shift(*chart.centre_deg, along * np.cos(course), along * np.sin(course))
    told = shift(lat, lon, *error_m.T)
    height = chart.sample(lat, lon) + rng.normal(0.0, SIGMA, len(error_m))
    return [
        Epoch(
            dt_s * k, float(told[0][k]), float(told[1][k]), 900.0,
            measurements=(Measurement("terrain", float(height[k]), SIGMA),) if k % every == 0 else (),
        )
        for k in range(len(error_m))
    ]  # fmt: skip


def run(filter_: Viterbi, epochs: list[Epoch], prior: Prior) -> ViterbiState:
    *_, state = states(filter_, prior, epochs, RNG)
    return state


def log_b(noise: str, v: FloatArray) -> FloatArray:
    """Measurement probabilities by scipy, up to a constant."""
    scale = SIGMA
    if noise == "integral_gaussian":
        upper, lower = norm.logsf((np.abs(v) - scale) / scale), norm.logsf((np.abs(v) + scale) / scale)
        return np.asarray(upper + np.log(-np.expm1(lower - upper)))
    if noise == "gaussian":
        return np.asarray(norm.logpdf(v, scale=scale))
    if noise == "laplace":
        return np.asarray(laplace.logpdf(v, scale=scale / np.sqrt(2.0)))
    if noise == "student_t":
        return np.asarray(t.logpdf(v, 4.0, scale=scale * np.sqrt(0.5)))
    parts = [np.log(0.95) + norm.logpdf(v, scale=scale), np.log(0.05) + norm.logpdf(v, scale=5.0 * scale)]
    return np.asarray(logsumexp(parts, axis=0))


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("p", [0.05, 0.6, 0.95])
def test_it_is_the_dense_hidden_markov_model(noise: str, p: float) -> None:
    """Path, score and posterior of a brute-force search over all N x N transitions."""
    walk = np.cumsum(np.random.default_rng(3).normal(0.0, 9.0, (14, 2)), axis=0) + np.array([60.0, -80.0])
    epochs = flight(hills(), walk)
    filter_ = Viterbi((hills(),), SLOW, cell_m=40.0, stay=p, noise=noise, cell_noise=False)
    state = run(filter_, epochs, FLAT_START)

    axis = 40.0 * np.arange(-7, 8)
    assert state.score.shape == (15, 15)
    cells = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    apart = np.abs(cells[:, None] - cells[None]).max(axis=-1) / 40.0
    with np.errstate(divide="ignore"):
        log_a = np.log(np.where(apart == 0, p, np.where(apart == 1, (1.0 - p) / 8.0, 0.0)))
    score = forward = np.full(225, -np.log(225.0))
    back = []
    for k, epoch in enumerate(epochs):
        if k:
            ways = score[:, None] + log_a
            back.append(ways.argmax(axis=0))
            score, forward = ways.max(axis=0), np.asarray(logsumexp(forward[:, None] + log_a, axis=0))
        for reading in epoch.measurements:
            at = shift(epoch.lat_deg, epoch.lon_deg, -cells[:, 0], -cells[:, 1])
            b = log_b(noise, reading.value - hills().sample(*at))
            score, forward = score + b, forward + b
    path = [int(score.argmax())]
    for pointers in back[::-1]:
        path.append(int(pointers[path[-1]]))
    found = filter_.backtrace(state)
    np.testing.assert_allclose(found, cells[path[::-1]], atol=1e-9)
    np.testing.assert_allclose(state.score.ravel(), score - score.max(), rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(np.exp(forward - logsumexp(forward)), state.probability.ravel(), rtol=1e-3, atol=1e-9)
    if noise == "integral_gaussian":  # the other densities leave their constants out
        assert state.log_best == pytest.approx(score.max(), rel=1e-5, abs=1e-3)


def test_a_constant_error_is_found_to_its_cell_and_the_path_is_straight() -> None:
    error = np.array([100.0, -75.0])
    filter_ = Viterbi((hills(),), replace(STILL, position_walk_m_per_sqrt_s=0.5))
    state = run(filter_, flight(hills(), np.tile(error, (150, 1))), FLAT_START)
    np.testing.assert_allclose(filter_.estimate(state).ins_error_m, error)
    np.testing.assert_allclose(filter_.backtrace(state), np.tile(error, (150, 1)))


def test_the_whole_path_is_better_than_the_estimates_as_they_came() -> None:
    walk = np.cumsum(np.random.default_rng(5).normal(0.0, 4.0, (250, 2)), axis=0)
    filter_ = Viterbi((hills(),), SLOW)
    said: list[Estimate] = []
    for state in states(filter_, FLAT_START, flight(hills(), walk), RNG):
        said.append(filter_.estimate(state))
    path = filter_.backtrace(state)
    np.testing.assert_array_equal(path[-1], said[-1].ins_error_m)
    assert np.abs(np.diff(path, axis=0)).max() <= state.cell_m + 1e-9
    came = np.array([one.ins_error_m for one in said])
    assert np.hypot(*(path - walk).T).mean() < 0.8 * np.hypot(*(came - walk).T).mean()


@pytest.mark.parametrize("shape", ["gaussian", "uniform"])
def test_the_covariance_is_meant(shape: Any) -> None:
    """Mean NEES per axis over 24 flights, all epochs after the first: at most a little above 1, and not far below."""
    ins = InsGrade(position_sigma_m=120.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=2.0)
    chart, rng, nees = hills(1.0), np.random.default_rng(11), []
    for seed in range(24):
        prior = Prior.from_ins(ins, shape)
        start = rng.normal(0.0, 120.0, 2) if shape == "gaussian" else rng.uniform(-360.0, 360.0, 2)
        walk = start + np.cumsum(rng.normal(0.0, 2.0, (120, 2)), axis=0)
        filter_ = Viterbi((chart,), ins, noise="gaussian")
        for k, one in enumerate(stream(filter_, prior, flight(chart, walk, seed=seed), rng)):
            if k % 10 == 9:
                miss = one.ins_error_m - walk[k]
                nees.append(0.5 * miss @ np.linalg.solve(one.cov_m2, miss))
    assert 0.5 < np.mean(nees) < 1.3


def test_long_steps_move_several_cells_and_the_path_follows() -> None:
    """Readings every 20 s and a drift of 3 m/s: sixty metres an epoch on cells of 25 m."""
    ins = InsGrade(position_sigma_m=100.0, velocity_sigma_mps=2.0, position_walk_m_per_sqrt_s=1.0)
    error = np.arange(30)[:, None] * 20.0 * np.array([2.0, -2.3])
    filter_ = Viterbi((hills(),), ins)
    epochs = flight(hills(), error, dt_s=20.0)
    epochs = [replace(epoch, measurements=epoch.measurements) for epoch in epochs[5:25]]
    prior = Prior(error[5], np.eye(2) * 100.0**2)
    state = run(filter_, epochs, prior)
    assert state.history.newest[-1].pointers.shape[0] > 1
    assert np.abs(np.diff(filter_.backtrace(state), axis=0)).max() > 1.5 * state.cell_m
    assert np.hypot(*(filter_.estimate(state).ins_error_m - error[24])) < 75.0


def test_memory_is_stated_before_it_is_taken_and_kept_to_in_flight() -> None:
    chart = plane_map(0.25, 0.0)
    with pytest.raises(ConfigError, match=r"needs 3\d\d\d\.\d MB, max_memory_mb is 10; expected cell_m >= 17\.\d"):
        Viterbi((chart,), STILL, cell_m=1.0, max_memory_mb=10.0).init(
            Prior(np.zeros(2), np.eye(2) * 1250.0**2, "uniform"), RNG
        )
    ins = replace(SLOW, velocity_sigma_mps=1.0)
    walk = np.tile([50.0, 25.0], (700, 1))
    roomy, tight = Viterbi((hills(),), ins), Viterbi((hills(),), ins, max_memory_mb=1.0)
    epochs = flight(hills(), walk)
    whole, part = run(roomy, epochs, FLAT_START), run(tight, epochs, FLAT_START)
    assert len(roomy.backtrace(whole)) == 700
    assert part.history.held_bytes <= 1e6
    assert part.history.given_up > 0
    assert len(tight.backtrace(part)) == 700 - part.history.given_up
    held = sum(one.pointers.nbytes for block in (*part.history.blocks, part.history.newest) for one in block)
    assert held == part.history.held_bytes
    assert 56 * part.score.size <= 1e6


def test_a_long_history_pickles() -> None:
    filter_ = Viterbi((hills(),), SLOW)
    state = run(filter_, flight(hills(), np.zeros((1500, 2))), FLAT_START)
    again = pickle.loads(pickle.dumps(state))
    np.testing.assert_array_equal(filter_.backtrace(again), filter_.backtrace(state))
    assert len(filter_.backtrace(state)) == 1500


def test_no_path_before_the_first_epoch() -> None:
    filter_ = Viterbi((hills(),), STILL)
    with pytest.raises(StateError, match="no path before the first epoch"):
        filter_.backtrace(filter_.init(FLAT_START, RNG))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"stay": 0.0}, "viterbi stay is 0.0, expected"),
        ({"stay": 1.0}, r"viterbi stay is 1.0, expected a probability in \(0, 1\)"),
        ({"stay": float("nan")}, "viterbi stay is nan, expected"),
        ({"cell_m": 0.0}, "viterbi cell_m is 0.0, expected a finite number and > 0"),
        ({"noise": "laplas"}, "unknown viterbi noise 'laplas' .did you mean 'laplace'"),
        ({"degrees_of_freedom": 2.0}, "viterbi degrees_of_freedom is 2.0, expected"),
        ({"outlier_share": 0.7}, "viterbi outlier_share is 0.7, expected"),
        ({"outlier_scale": 1.0}, "viterbi outlier_scale is 1.0, expected"),
        ({"max_memory_mb": -1.0}, "viterbi max_memory_mb is -1.0, expected"),
        ({"maps": ()}, "viterbi maps are of kinds"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Viterbi(**{"maps": (plane_map(0.0, 0.0),), "ins": STILL, **settings})


def test_a_cell_as_large_as_the_search_area_is_refused() -> None:
    with pytest.raises(ConfigError, match="viterbi cell_m is 700 with a search area of 600 m, expected at most"):
        Viterbi((hills(),), STILL, cell_m=700.0).init(FLAT_START, RNG)

"""The navigator with an INS that has no random walk: the positions tell its velocity, and what moves that, exactly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior, Status
from terranav.experiment.stream import states
from terranav.filters.marginalized import Marginalized
from terranav.kernels.matrices import conditioned
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map
from tests.filters.test_marginalized import LINEAR, kalman, track
from tests.filters.test_marginalized_numpy import flown

FloatArray = NDArray[np.float64]

WALKLESS = InsGrade(500.0, 0.5, 0.0, 0.0)
SCHULER = InsGrade(300.0, 0.3, 0.0, 0.0, attitude_sigma_deg=0.02, gyro_bias_sigma_deg_per_h=0.1)
STRAPDOWN = InsGrade(
    300.0, 0.3, 0.0, 0.0,
    attitude_sigma_deg=0.02, heading_sigma_deg=0.1, gyro_bias_sigma_deg_per_h=0.1, accel_bias_sigma_ug=100.0,
)  # fmt: skip


def least_eigenvalue(cov: FloatArray) -> float:
    """Of a covariance scaled to unit variances: below zero by more than rounding it is none."""
    variance = np.diag(cov)
    sigma = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    return float(np.linalg.eigvalsh(cov / np.outer(sigma, sigma))[0])


def to_and_fro(chart: Map, seed: int, count: int) -> tuple[list[Epoch], FloatArray]:
    """Readings once a second at 20 m/s over the middle of a map, and the true INS error (count, 2) at each [m]."""
    rng, time = np.random.default_rng(seed), np.arange(count, dtype=float)
    along = 18_000.0 * (np.abs(time / 900.0 % 2.0 - 1.0) - 0.5)
    lat, lon = shift(*chart.centre_deg, 0.8 * along, 0.6 * along)
    start = rng.normal(0.0, WALKLESS.position_sigma_m, 2)
    error = start + np.outer(time, rng.normal(0.0, WALKLESS.velocity_sigma_mps, 2))
    value = chart.sample(lat, lon) + rng.normal(0.0, 3.0, count)
    told = zip(time.tolist(), *(one.tolist() for one in (*shift(lat, lon, *error.T), value)), strict=True)
    return [Epoch(at, north, east, 2000.0, measurements=(Measurement(chart.kind, read, 3.0),))
            for at, north, east, read in told], error  # fmt: skip


@pytest.fixture(scope="module")
def hills() -> Map:
    return gaussian_map(np.random.default_rng(2), std=120.0, correlation_m=900.0, cells=513, cell_m=100.0, sigma=1.0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("level", ["position", "schuler", "strapdown"])
def test_what_is_left_given_the_positions_is_a_covariance(hills: Map, level: str, seed: int) -> None:
    ins = {"position": WALKLESS, "schuler": SCHULER, "strapdown": STRAPDOWN}[level]
    filter_ = Marginalized((hills,), ins, particles=2000, least_particles=1000)
    for state in states(filter_, Prior.from_ins(ins), flown(hills, 200, level), np.random.default_rng(seed)):
        assert state.cloud is not None
        assert least_eigenvalue(state.cloud.common) > -1e-9
        assert least_eigenvalue(state.cov) > -1e-9


@pytest.mark.parametrize("seed", [4, 6, 7])
def test_to_and_fro_every_reading_counts_and_the_bias_stays_known(seed: int) -> None:
    chart = sample_map()
    epochs, error = to_and_fro(chart, seed, 450)
    filter_ = Marginalized((chart,), WALKLESS, particles=8000, least_particles=4000)
    least, most = math.inf, 0.0
    for state in states(filter_, Prior.from_ins(WALKLESS), epochs, np.random.default_rng(seed)):
        assert state.cloud is not None
        least = min(least, float(state.cloud.common[4, 4]))
        most = max(most, float(state.cov[4, 4]))
        assert [one.used for one in state.innovations] == [True]
        assert filter_.estimate(state).status is not Status.OFF_MAP
    assert least > 0.0
    assert most < 2.0 * 15.0**2  # twice the prior's
    assert filter_.estimate(state).status is Status.CONVERGED
    assert np.hypot(*(state.mean[:2] - error[-1])) < chart.cell_m


def test_on_a_plane_it_is_the_kalman_filter() -> None:
    chart = plane_map(0.25, -0.125, cells=513, cell_m=64.0, sigma=3.0)
    epochs = track([chart], 3, count=80, ins=WALKLESS).epochs
    filter_, prior = Marginalized((chart,), WALKLESS, least_particles=16000, **LINEAR), Prior.from_ins(WALKLESS)
    mean, cov = kalman(filter_, epochs, prior)[-1]
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    ran = [list(states(filter_, prior, epochs, np.random.default_rng(seed)))[-1] for seed in range(4)]
    assert np.sqrt(np.mean([(whiten @ (state.mean - mean)) ** 2 for state in ran])) < 0.05
    np.testing.assert_allclose(np.mean([whiten @ state.cov @ whiten.T for state in ran], axis=0), np.eye(6), atol=0.06)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_state_that_the_positions_tell_is_left_no_variance(compiled: bool) -> None:
    """The position moves by 0.1 of state 2 and 0.7 of state 3; 4 has to do with both, and 5 is 0.3 of 4."""
    kernel: Any = conditioned if compiled else conditioned.py_func
    phi, common = np.eye(6), np.zeros((6, 6))
    phi[0, 2], phi[1, 3] = 0.1, 0.7
    common[2:5, 2:5] = [[0.3, 0.0, 0.2], [0.0, 0.9, 0.1], [0.2, 0.1, 2.0]]
    common[5], common[:, 5] = 0.3 * common[4], 0.3 * common[:, 4]
    common[5, 5] = 0.09 * common[4, 4]
    spread, after = kernel(phi, np.zeros((6, 6)), common)
    np.testing.assert_array_equal(after[2:4], 0.0)
    np.testing.assert_array_equal(after[:, 2:4], 0.0)
    left = 2.0 - 0.2**2 / 0.3 - 0.1**2 / 0.9
    np.testing.assert_allclose(after[4:, 4:], left * np.array([[1.0, 0.3], [0.3, 0.09]]), rtol=1e-13)
    np.testing.assert_allclose(spread @ spread.T + after, phi @ common @ phi.T, rtol=1e-12, atol=1e-14)
    again = kernel(phi, np.zeros((6, 6)), after)
    np.testing.assert_array_equal(again[0], 0.0)
    np.testing.assert_allclose(again[1], after, rtol=1e-14)

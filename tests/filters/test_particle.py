"""Particle filter: converges to the Kalman filter on a plane as 1/sqrt(N)."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.errors import ConfigError, StateError
from terranav.core.records import Prior
from terranav.experiment.stream import states
from terranav.filters.particle import Particle
from tests.filters.test_pointmass import INS, flight, kalman, plane

FloatArray = NDArray[np.float64]


def test_converges_to_the_kalman_filter_on_a_plane_as_one_over_root_n() -> None:
    slope = np.array([0.25, -0.125])
    chart = plane(slope[0], slope[1])
    prior = Prior.from_ins(INS)
    epochs = flight(chart, np.array([150.0, -220.0]), 12, 8.0, np.random.default_rng(1))
    mean, cov = kalman(chart, slope, epochs, prior)
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    sizes, rms, spread = (400, 1600, 6400), [], []
    for count in sizes:
        filter_ = Particle((chart,), INS, particles=count, outlier_share=0.0)
        misses = []
        for seed in range(16):
            *_, state = states(filter_, prior, epochs, np.random.default_rng(seed))
            misses.append(whiten @ (state.mean_m - mean))
            spread.append(np.trace(whiten @ state.cov_m2 @ whiten.T) / 2.0)
        rms.append(float(np.sqrt(np.mean(np.square(misses)))))
    rate = np.polyfit(np.log(sizes), np.log(rms), 1)[0]
    assert -0.75 < rate < -0.35  # 1/sqrt(N) is -0.5; the ordered, moment-matched draws may do a little better
    assert rms[-1] < 0.06
    assert np.mean(spread[-16:]) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("shape", ["gaussian", "uniform"])
def test_the_cloud_starts_with_the_moments_of_the_prior(shape: str) -> None:
    cov = np.array([[900.0, 200.0], [200.0, 400.0]]) if shape == "gaussian" else np.diag([900.0, 400.0])
    prior = Prior(np.array([10.0, -20.0]), cov, shape)  # type: ignore[arg-type]
    state = Particle((plane(0.0, 0.0),), INS).init(prior, np.random.default_rng(1))
    np.testing.assert_allclose(state.mean_m, prior.mean_m, atol=1e-9)
    np.testing.assert_allclose(state.cov_m2, cov if shape == "gaussian" else 3.0 * cov, rtol=1e-6, atol=1e-9)
    if shape == "uniform":
        assert np.abs(state.north_m - 10.0).max() < 3.1 * 30.0
        assert np.abs(state.east_m + 20.0).max() < 3.1 * 20.0


def test_roughening_tells_copies_apart() -> None:
    slope = 0.25
    chart = plane(slope, slope)
    epochs = flight(chart, np.array([150.0, -220.0]), 8, 1.0, np.random.default_rng(1))
    still = INS.__class__(position_sigma_m=300.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.0)
    distinct = []
    for roughening in (0.0, 0.2):
        filter_ = Particle((chart,), still, particles=2000, roughening=roughening)
        *_, state = states(filter_, Prior.from_ins(still), epochs, np.random.default_rng(2))
        distinct.append(len(np.unique(state.north_m + 1j * state.east_m)))
    assert distinct[0] < 200
    assert distinct[1] > 1000


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("particles", 99),
        ("particles", 1e4),
        ("resample_share", 0.0),
        ("roughening", -0.1),
        ("outlier_share", 0.6),
        ("outlier_scale", 1.0),
        ("converged_sigma_m", -1.0),
    ],
)
def test_settings_out_of_range_are_named(setting: str, value: float) -> None:
    with pytest.raises(ConfigError, match=setting):
        Particle((plane(0.0, 0.0),), INS, **{setting: value})  # type: ignore[arg-type]


def test_two_maps_of_one_kind_and_an_early_estimate_are_refused() -> None:
    chart = plane(0.0, 0.0)
    with pytest.raises(ConfigError, match="one map of each kind"):
        Particle((chart, chart), INS)
    filter_ = Particle((chart,), INS)
    with pytest.raises(StateError, match="before the first epoch"):
        filter_.estimate(filter_.init(Prior.from_ins(INS), np.random.default_rng(0)))

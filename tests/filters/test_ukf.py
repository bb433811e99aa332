"""Unscented Kalman filter: the Kalman filter on planes, the textbook transform on hills, its settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from terranav.core.earth import shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.records import Epoch, Measurement, Prior, Status
from terranav.experiment.stream import stream
from terranav.filters.ukf import Ukf
from terranav.maps.fields import gaussian_map
from tests.filters.test_sitan import WALKING, eastward, equator, slope

RNG = np.random.default_rng(0)
scaled = pytest.mark.parametrize(("alpha", "beta", "kappa"), [(1.0, 2.0, 1.0), (1e-2, 2.0, 0.0), (0.7, 0.0, 3.0)])


@scaled
def test_on_planes_it_is_the_kalman_filter(alpha: float, beta: float, kappa: float) -> None:
    slopes = {"terrain": (3.5, -2.25), "gravity": (0.5, 4.125)}
    charts = tuple(equator(*slopes[kind], kind=kind) for kind in slopes)
    epochs = eastward(charts, np.array([21.0, -13.0]), 90)
    filter_ = Ukf(charts, WALKING, alpha=alpha, beta=beta, kappa=kappa)
    said = list(stream(filter_, Prior.from_ins(WALKING), epochs, RNG))

    mean, cov = np.zeros(2), np.eye(2) * 30.0**2
    for k, epoch in enumerate(epochs):
        if k:
            cov = cov + np.eye(2) * 1.5**2 * 0.5
        for chart, reading in zip(charts, epoch.measurements):
            h = slope(*slopes[chart.kind])
            at = float(chart.sample(epoch.lat_deg, epoch.lon_deg)) + float(h @ mean)
            # the map's error is shared by the readings within one of its cells; here they lie further apart
            spread = float(h @ cov @ h) + reading.sigma**2 + chart.sigma**2
            gain = cov @ h / spread
            mean, cov = mean + gain * (reading.value - at), cov - np.outer(gain, gain) * spread
        tolerance = 1e-9 if alpha == 1.0 else 1e-6  # a small alpha divides differences of heights by its square
        np.testing.assert_allclose(said[k].ins_error_m, mean, atol=30.0 * tolerance)
        np.testing.assert_allclose(said[k].cov_m2, cov, atol=900.0 * tolerance)


@scaled
def test_sigma_points_carry_mean_and_covariance(alpha: float, beta: float, kappa: float) -> None:
    filter_ = Ukf((equator(1.0, 1.0),), WALKING, alpha=alpha, beta=beta, kappa=kappa)
    mean, cov = np.array([10.0, -4.0]), np.array([[90.0, 35.0], [35.0, 40.0]])
    points = filter_.sigma_points(mean, cov)
    by_mean, by_cov = filter_.weights
    assert by_mean.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(by_mean @ points, mean, atol=1e-8)
    away = points - mean
    np.testing.assert_allclose((away * by_cov[:, None]).T @ away, cov, rtol=1e-9)


def test_one_update_on_hills_is_the_textbook_transform() -> None:
    chart = gaussian_map(np.random.default_rng(2), cells=101, cell_m=50.0, centre_deg=(0.0, 0.0))
    filter_ = Ukf((chart,), WALKING)
    prior = Prior(np.array([30.0, -20.0]), np.array([[2500.0, 400.0], [400.0, 1600.0]]))
    lat, lon = (float(v) for v in shift(0.0, 0.0, 310.0, -170.0))
    epoch = Epoch(0.0, lat, lon, 900.0, measurements=(Measurement("terrain", 520.0, 2.0),))
    state = filter_.step(filter_.init(prior, RNG), epoch, RNG)

    root = np.linalg.cholesky(3.0 * prior.cov_m2)
    points = [prior.mean_m, *(prior.mean_m + sign * root[:, i] for sign in (1, -1) for i in range(2))]
    heights = [float(chart.sample(*shift(lat, lon, -p[0], -p[1]))) for p in points]
    by_mean = np.array([1 / 3, *[1 / 6] * 4])
    by_cov = by_mean + np.array([2.0, 0.0, 0.0, 0.0, 0.0])
    level = by_mean @ heights
    spread = by_cov @ (heights - level) ** 2 + 2.0**2 + chart.sigma**2
    cross = (by_cov * (heights - level)) @ (np.array(points) - prior.mean_m)
    np.testing.assert_allclose(state.mean_m, prior.mean_m + cross / spread * (520.0 - level), rtol=1e-9)
    np.testing.assert_allclose(state.cov_m2, prior.cov_m2 - np.outer(cross, cross) / spread, rtol=1e-9)


def test_a_missing_height_leaves_the_reading_out() -> None:
    chart = equator(3.0, 1.0)
    values = np.array(chart.values)
    values[:, 100:] = np.nan  # east of the middle
    cut = replace(chart, values=values)
    filter_ = Ukf((cut,), WALKING)
    for east_m, off_map in ((-40.0, False), (400.0, True)):
        lat, lon = (float(v) for v in shift(0.0, 0.0, 0.0, east_m))
        epoch = Epoch(0.0, lat, lon, 900.0, measurements=(Measurement("terrain", 1300.0, 2.0),))
        state = filter_.step(filter_.init(Prior.from_ins(WALKING), RNG), epoch, RNG)
        np.testing.assert_array_equal(state.cov_m2, Prior.from_ins(WALKING).cov_m2)
        assert (state.judgement.status is Status.OFF_MAP) is off_map


def test_when_lost_it_starts_over_unless_told_not_to() -> None:
    chart = equator(3.0, -2.0)
    wrong = [
        replace(epoch, measurements=tuple(replace(m, value=m.value + 60.0 * (-1.0) ** k) for m in epoch.measurements))
        for k, epoch in enumerate(eastward((chart,), np.zeros(2), 60))
    ]
    prior = Prior.from_ins(WALKING)
    again, stubborn = (
        list(stream(Ukf((chart,), WALKING, restart=restart), prior, wrong, RNG)) for restart in (True, False)
    )
    assert any(one.status is Status.LOST for one in again)
    assert max(np.trace(one.cov_m2) for one in again[20:]) >= np.trace(prior.cov_m2)
    assert max(np.trace(one.cov_m2) for one in stubborn[20:]) < np.trace(prior.cov_m2)


@pytest.mark.parametrize(
    ("setting", "value"), [("alpha", 0.0), ("alpha", 1.5), ("beta", -1.0), ("kappa", -2.0), ("converged_sigma_m", 0.0)]
)
def test_settings_out_of_range_are_named(setting: str, value: float) -> None:
    with pytest.raises(ConfigError, match=setting):
        Ukf((equator(1.0, 0.0),), WALKING, **{setting: value})  # type: ignore[arg-type]


def test_two_maps_of_one_kind_and_an_early_estimate_are_refused() -> None:
    chart = equator(1.0, 0.0)
    with pytest.raises(ConfigError, match="one map of each kind"):
        Ukf((chart, chart), WALKING)
    filter_ = Ukf((chart,), WALKING)
    with pytest.raises(StateError, match="before the first epoch"):
        filter_.estimate(filter_.init(Prior.from_ins(WALKING), RNG))

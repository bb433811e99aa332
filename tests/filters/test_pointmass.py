"""Point-mass filter against a Kalman filter on a plane, and the laws of its grid."""

from __future__ import annotations

import math
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior
from terranav.filters.pointmass import PointMass, PointMassState, gaussian_taps
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
LAT0, LON0 = 0.3, 9.5  # near the equator the lattice of degrees is nearly square and straight
INS = InsGrade(position_sigma_m=300.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=4.0)
RNG = np.random.default_rng(0)


def plane(north_slope: float, east_slope: float, cell_m: float = 90.0, size: int = 301, sigma: float = 0.0) -> Map:
    """A planar map in UTM metres, centred where UTM is straight to 1e-7."""
    rows, cols = np.mgrid[0:size, 0:size]
    half = 0.5 * (size - 1) * cell_m
    x, y = cols * cell_m - half, half - rows * cell_m
    values = (1000.0 + north_slope * y + east_slope * x).astype(np.float32)
    transform = (cell_m, 0.0, -half - 0.5 * cell_m, 0.0, -cell_m, half + 0.5 * cell_m)
    crs = f"+proj=aeqd +lat_0={LAT0} +lon_0={LON0} +datum=WGS84 +units=m"
    return Map(values=values, transform=transform, crs=crs, kind="terrain", unit="m", sigma=sigma)


def flight(chart: Map, error_m: FloatArray, steps: int, sigma: float, rng: np.random.Generator) -> list[Epoch]:
    """A straight flight over the middle of a map with a constant INS error and Gaussian noise."""
    epochs = []
    for k in range(steps):
        lat, lon = (float(v) for v in shift(LAT0, LON0, 100.0 * (k - steps / 2), 60.0 * (k - steps / 2)))
        value = float(chart.sample(lat, lon)) + sigma * float(rng.standard_normal())
        told = [float(v) for v in shift(lat, lon, error_m[0], error_m[1])]
        epochs.append(Epoch(float(k), told[0], told[1], 2000.0, measurements=(Measurement("terrain", value, sigma),)))
    return epochs


def kalman(chart: Map, slope: FloatArray, epochs: list[Epoch], prior: Prior) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the INS error on a plane, where the filter is exact."""
    x, cov = prior.mean_m.copy(), prior.cov_m2.copy()
    h = -slope[None, :]
    for k, epoch in enumerate(epochs):
        if k:
            dt = epoch.time_s - epochs[k - 1].time_s
            cov = cov + np.eye(2) * INS.position_walk_m_per_sqrt_s**2 * dt
        reading = epoch.measurements[0]
        at_ins = float(chart.sample(epoch.lat_deg, epoch.lon_deg))
        s = float((h @ cov @ h.T)[0, 0]) + reading.sigma**2
        gain = (cov @ h.T)[:, 0] / s
        x = x + gain * (reading.value - (at_ins + float((h @ x)[0])))
        cov = cov - np.outer(gain, gain) * s
    return x, cov


def last(filter_: PointMass, epochs: list[Epoch], prior: Prior) -> PointMassState:
    state = filter_.init(prior, RNG)
    for epoch in epochs:
        state = filter_.step(state, epoch, RNG)
    return state


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("steps", [1, 5, 40])
def test_agrees_with_the_kalman_filter_on_a_plane(seed: int, steps: int) -> None:
    slope = np.array([0.25, -0.125])
    chart = plane(slope[0], slope[1])
    rng = np.random.default_rng(seed)
    prior = Prior.from_ins(INS)
    epochs = flight(chart, rng.normal(0.0, 200.0, 2), steps, 8.0, rng)
    mean, cov = kalman(chart, slope, epochs, prior)
    got = PointMass((chart,), INS, outlier_share=0.0).estimate(
        last(PointMass((chart,), INS, outlier_share=0.0), epochs, prior)
    )
    sigma = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(got.ins_error_m / sigma, mean / sigma, atol=2e-3)
    np.testing.assert_allclose(got.cov_m2 / np.outer(sigma, sigma), cov / np.outer(sigma, sigma), atol=1e-3)


def test_answer_converges_as_the_grid_is_refined() -> None:
    slope = np.array([0.25, -0.125])
    chart = plane(slope[0], slope[1])
    rng = np.random.default_rng(4)
    prior = Prior.from_ins(INS)
    epochs = flight(chart, np.array([150.0, -220.0]), 12, 2.0, rng)
    mean, cov = kalman(chart, slope, epochs, prior)
    errors = []
    for cells in (900, 10_000, 160_000):
        state = last(PointMass((chart,), INS, outlier_share=0.0, max_cells=cells), epochs, prior)
        along = slope / np.linalg.norm(slope)
        errors.append(
            abs(along @ (state.mean_m - mean))
            + abs(math.sqrt(along @ state.cov_m2 @ along) - math.sqrt(along @ cov @ along))
        )
    assert errors[0] > errors[2]
    assert errors[1] > errors[2]
    assert errors[2] < 0.02 * math.sqrt(np.trace(cov))


def test_flat_land_never_shrinks_the_covariance() -> None:
    chart = plane(0.0, 0.0)
    prior = Prior.from_ins(INS)
    epochs = flight(chart, np.array([10.0, 20.0]), 50, 3.0, np.random.default_rng(5))
    filter_ = PointMass((chart,), INS)
    state = filter_.init(prior, RNG)
    before = np.diag(state.cov_m2)
    np.testing.assert_allclose(before, np.diag(prior.cov_m2), rtol=1e-3)
    for k, epoch in enumerate(epochs):
        state = filter_.step(state, epoch, RNG)
        expected = np.diag(prior.cov_m2) + INS.position_walk_m_per_sqrt_s**2 * k
        np.testing.assert_allclose(np.diag(state.cov_m2), expected, rtol=2e-3)


def test_a_gross_outlier_does_not_move_a_converged_filter() -> None:
    rng = np.random.default_rng(6)
    rows, cols = np.mgrid[0:301, 0:301]
    chart = replace(plane(0.0, 0.0), values=(200.0 * np.sin(rows / 5.0) * np.cos(cols / 7.0)).astype(np.float32))
    error = np.array([120.0, -90.0])
    epochs = flight(chart, error, 60, 3.0, rng)
    filter_ = PointMass((chart,), INS)
    state = last(filter_, epochs[:-1], Prior.from_ins(INS))
    wrong = replace(epochs[-1], measurements=(Measurement("terrain", 5000.0, 3.0),))
    after = filter_.step(state, wrong, RNG)
    assert np.abs(state.mean_m - error).max() < 30.0
    assert np.abs(after.mean_m - error).max() < 30.0
    assert filter_.estimate(after).status == "converged"


def test_finds_errors_of_kilometres_on_rough_land() -> None:
    rng = np.random.default_rng(7)
    rows, cols = np.mgrid[0:401, 0:401]
    land = 200.0 * np.sin(rows / 9.0) * np.cos(cols / 7.0) + 150.0 * np.sin(rows / 23.0 + cols / 31.0)
    chart = replace(plane(0.0, 0.0, size=401), values=land.astype(np.float32))
    ins = replace(INS, position_sigma_m=2500.0)
    error = np.array([3100.0, -2700.0])
    filter_ = PointMass((chart,), ins)
    state = last(filter_, flight(chart, error, 120, 5.0, rng), Prior.from_ins(ins))
    assert np.abs(state.mean_m - error).max() < 60.0
    assert filter_.estimate(state).status == "converged"


def test_a_gap_of_an_hour_widens_the_density_and_keeps_its_moments() -> None:
    chart = plane(0.25, 0.125)
    filter_ = PointMass((chart,), INS)
    prior = Prior(np.zeros(2), np.eye(2) * 20.0**2)
    first = Epoch(0.0, LAT0, LON0, 2000.0)
    state = filter_.step(filter_.init(prior, RNG), first, RNG)
    state = filter_.step(state, replace(first, time_s=3600.0), RNG)
    expected = 400.0 + INS.position_walk_m_per_sqrt_s**2 * 3600.0
    np.testing.assert_allclose(np.diag(state.cov_m2), expected, rtol=5e-3)
    np.testing.assert_allclose(state.mean_m, 0.0, atol=0.5)


@pytest.mark.parametrize("variance", [0.0, 1e-6, 0.2, 0.5, 0.51, 0.9, 3.0, 40.0])
def test_taps_have_exactly_the_variance_asked(variance: float) -> None:
    taps = gaussian_taps(variance)
    steps = np.arange(taps.size) - taps.size // 2
    assert taps.sum() == pytest.approx(1.0, abs=1e-14)
    assert (taps * steps**2).sum() == pytest.approx(variance, rel=2e-3, abs=1e-15)


def test_states_are_left_as_they_were_and_runs_on_threads_give_the_same_bits() -> None:
    rng = np.random.default_rng(10)
    rows, cols = np.mgrid[0:301, 0:301]
    values = (200.0 * np.sin(rows / 5.0) * np.cos(cols / 7.0)).astype(np.float32)
    values[rng.random(values.shape) < 0.002] = np.nan
    chart = replace(plane(0.0, 0.0), values=values)
    ins = replace(INS, velocity_sigma_mps=0.5)
    filter_ = PointMass((chart,), ins)
    start = filter_.init(Prior.from_ins(ins), RNG)
    epochs = flight(chart, np.array([120.0, -90.0]), 25, 3.0, rng)
    epochs = [e for e in epochs if np.isfinite(e.measurements[0].value)]

    def run(_: int) -> list[PointMassState]:
        states = [start]
        for epoch in epochs:
            kept = states[-1].grid.density.copy()
            states.append(filter_.step(states[-1], epoch, RNG))
            assert np.array_equal(states[-2].grid.density, kept)
        return states

    alone = run(0)
    with ThreadPoolExecutor(4) as pool:
        for states in pool.map(run, range(4)):
            for one, other in zip(states, alone, strict=True):
                assert one.grid.density.tobytes() == other.grid.density.tobytes()
                assert one.mean_m.tobytes() == other.mean_m.tobytes()
    again = filter_.step(pickle.loads(pickle.dumps(alone[-2])), epochs[-1], RNG)
    assert again.grid.density.tobytes() == alone[-1].grid.density.tobytes()


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("outlier_share", -0.1),
        ("outlier_scale", 1.0),
        ("max_cells", 3),
        ("min_cell_m", 0.0),
        ("converged_sigma_m", -1.0),
    ],
)
def test_settings_out_of_range_are_named(setting: str, value: float) -> None:
    with pytest.raises(ConfigError, match=setting):
        PointMass((plane(0.0, 0.0),), INS, **{setting: value})  # type: ignore[arg-type]


def test_two_maps_of_one_kind_and_an_early_estimate_are_refused() -> None:
    chart = plane(0.0, 0.0)
    with pytest.raises(ConfigError, match="one map of each kind"):
        PointMass((chart, chart), INS)
    filter_ = PointMass((chart,), INS)
    with pytest.raises(StateError, match="before the first epoch"):
        filter_.estimate(filter_.init(Prior.from_ins(INS), RNG))

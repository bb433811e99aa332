"""Bayes grid: the paper's sums by brute force, the still grid against a moving window, honesty over many flights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior, Status
from terranav.experiment.stream import states
from terranav.filters.bayes_grid import BayesGrid, peak
from terranav.filters.pointmass import PointMassState
from terranav.maps.gauss_markov import gauss_markov_map
from terranav.maps.map import Map
from tests.filters.test_pointmass import plane

FloatArray = NDArray[np.float64]
STILL = InsGrade(position_sigma_m=10.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.0)
DRIFTING = replace(STILL, position_walk_m_per_sqrt_s=2.0)
RNG = np.random.default_rng(0)


def terrain(seed: int) -> Map:
    return gauss_markov_map(np.random.default_rng(seed), shape=(701, 701), omega_rad_per_m=0.02)


def flight(chart: Map, seed: int, ins: InsGrade, count: int = 20) -> tuple[list[Epoch], FloatArray]:
    """A diagonal flight by whole cells, and the INS's error at each epoch."""
    rng = np.random.default_rng(seed)
    steps = ins.position_walk_m_per_sqrt_s * rng.standard_normal((count, 2))
    error = rng.normal(0.0, 10.0, 2) + np.cumsum(steps, axis=0)
    epochs = []
    for k in range(count):
        lat, lon = shift(0.0, 0.0, 20.0 * k - 200.0, 15.0 * k - 150.0)
        height = float(chart.sample(lat, lon)) + float(rng.standard_normal())
        told = shift(lat, lon, *error[k])
        epochs.append(
            Epoch(float(k), float(told[0]), float(told[1]), 200.0, measurements=(Measurement("terrain", height, 1.0),))
        )
    return epochs, error


def as_printed(chart: Map, ins: InsGrade) -> BayesGrid:
    """The paper's settings: cells of 1 m, a band of 1 m, P = 25 I."""
    return BayesGrid(
        (chart,), ins, min_cell_m=1.0, max_cell_m=1.0, band=1.0, likelihood_var_m2=25.0, outlier_share=0.0, point="peak"
    )


def test_one_reading_is_the_paper_s_sum_over_the_candidates() -> None:
    chart = terrain(1)
    epochs, _ = flight(chart, 1, STILL)
    filter_ = as_printed(chart, STILL)
    prior = Prior.from_ins(STILL, "uniform")
    before = filter_.init(prior, RNG).grid
    after = filter_.step(filter_.init(prior, RNG), epochs[0], RNG).grid
    assert before.cell_m == after.cell_m == 1.0

    n, e = (axis.ravel() for axis in np.meshgrid(before.north_m, before.east_m, indexing="ij"))
    heights = chart.sample(*shift(epochs[0].lat_deg, epochs[0].lon_deg, -n, -e))
    candidates = np.abs(heights - epochs[0].measurements[0].value) <= 1.0
    gauss = np.exp(-0.5 * ((n[:, None] - n) ** 2 + (e[:, None] - e) ** 2) / 25.0)
    expected = gauss[:, candidates].sum(axis=1) / gauss.sum(axis=1)
    expected = (expected / expected.sum()).reshape(before.density.shape)
    inside = [np.isin(np.round(axis, 6), np.round(other, 6)) for axis, other in
              ((before.north_m, after.north_m), (before.east_m, after.east_m))]  # fmt: skip
    assert after.density.shape == before.density.shape
    assert all(axis.all() for axis in inside)
    np.testing.assert_allclose(after.density, expected, atol=2e-3 * expected.max())
    np.testing.assert_allclose(peak(after), [n[expected.argmax()], e[expected.argmax()]], atol=1.0)


def test_the_still_error_grid_equals_a_window_that_moves_over_the_map() -> None:
    """The paper's way: a window of map cells is moved by the vehicle's known, whole-cell displacement."""
    chart = terrain(2)
    rows, cols = chart.shape
    epochs = []
    for k in range(6):
        lat, lon = (float(v) for v in shift(0.0, 0.0, 20.0 * k - 200.0, 15.0 * k - 150.0))
        epochs.append(Epoch(float(k), lat, lon, 200.0))
    heights = [float(chart.values[rows // 2 + 200 - 20 * k + 4, cols // 2 - 150 + 15 * k - 7]) for k in range(6)]
    epochs = [
        replace(epoch, measurements=(Measurement("terrain", height, 1.0),)) for epoch, height in zip(epochs, heights)
    ]
    state = list(states(as_printed(chart, STILL), Prior.from_ins(STILL, "uniform"), epochs, RNG))[-1]

    away = np.arange(-30, 31)
    window = np.full((61, 61), 1.0 / 61**2)  # rows from north to south, columns from west to east, round the nominal
    gauss = np.exp(-0.5 * (away[:, None] - away) ** 2 / 25.0)
    for k, height in enumerate(heights):
        row, col = rows // 2 + 200 - 20 * k, cols // 2 - 150 + 15 * k
        below = chart.values[row - 30 : row + 31, col - 30 : col + 31].astype(float)
        inside = (np.abs(below - height) <= 1.0).astype(float)
        window = window * (gauss @ inside @ gauss) / (gauss @ np.ones((61, 61)) @ gauss)
        window = window / window.sum()
    south, east = (float((window.sum(axis=1 - axis) * away).sum()) for axis in (0, 1))
    # a place south of the nominal one is a positive error north: indicated minus true
    np.testing.assert_allclose(state.mean_m, [south, -east], atol=0.05)
    best = np.unravel_index(window.argmax(), window.shape)
    np.testing.assert_allclose(peak(state.grid), [away[best[0]], -away[best[1]]], atol=0.51)


def test_the_covariance_is_honest_over_many_flights() -> None:
    misses = []
    for seed in range(40):
        chart = terrain(seed)
        epochs, error = flight(chart, seed, DRIFTING)
        filter_ = BayesGrid((chart,), DRIFTING)
        for k, state in enumerate(states(filter_, Prior.from_ins(DRIFTING), epochs, RNG)):
            if k % 5 == 4:
                said = filter_.estimate(state)
                miss = said.ins_error_m - error[k]
                misses.append(float(miss @ np.linalg.solve(said.cov_m2, miss)))
    nees = np.array(misses).reshape(40, -1).mean(axis=1)
    assert nees.mean() < 2.0 + 3.0 * nees.std() / np.sqrt(40.0)
    assert np.mean(np.array(misses) < 5.99) > 0.9


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("point", ["mean", "peak"])
def test_finds_the_place_with_every_reading_of_the_text(interpolation: str, point: str) -> None:
    chart = terrain(3)
    epochs, error = flight(chart, 3, STILL)
    filter_ = BayesGrid((chart,), STILL, interpolation=interpolation, point=point)  # type: ignore[arg-type]
    *_, state = states(filter_, Prior.from_ins(STILL, "uniform"), epochs, RNG)
    said = filter_.estimate(state)
    assert np.hypot(*(said.ins_error_m - error[-1])) < 4.0
    assert np.trace(said.cov_m2) < 0.2 * 200.0


def after_one(chart: Map, value: float, sigma: float, **settings: float) -> tuple[PointMassState, PointMassState]:
    filter_ = BayesGrid((chart,), STILL, **settings)  # type: ignore[arg-type]
    before = filter_.init(Prior.from_ins(STILL), RNG)
    epoch = Epoch(0.0, 0.0, 0.0, 200.0, measurements=(Measurement("terrain", value, sigma),))
    return before, filter_.step(before, epoch, RNG)


def test_without_candidates_the_band_is_widened_and_at_last_the_reading_left() -> None:
    chart = terrain(29)  # whose highest place around is 25 m away, where the prior still has some weight
    here = float(chart.sample(0.0, 0.0))
    _, plain = after_one(chart, here, 1.0, band=0.5)
    assert np.trace(plain.cov_m2) < 190.0
    highest = float(chart.values[290:411, 290:411].max())
    before, widened = after_one(chart, highest + 3.0, 1.0, band=1.0, likelihood_var_m2=1.0)
    assert np.abs(widened.mean_m - before.mean_m).max() > 3.0  # drawn to the highest cells within reach
    before, left = after_one(chart, highest + 300.0, 1.0, band=1.0)
    np.testing.assert_allclose(left.mean_m, before.mean_m, atol=1e-3)
    np.testing.assert_allclose(left.cov_m2, before.cov_m2, rtol=1e-3)
    assert left.judgement.nis > 9.0


def test_flat_ground_and_voids_teach_nothing() -> None:
    flat = plane(0.0, 0.0, cell_m=1.0, size=301)
    values = np.array(flat.values)
    values[:150] = np.nan
    for chart in (flat, replace(flat, values=values)):
        filter_ = BayesGrid((chart,), STILL)
        before = filter_.init(Prior.from_ins(STILL), RNG)
        epoch = Epoch(0.0, 0.3, 9.5, 200.0, measurements=(Measurement("terrain", 1000.0, 1.0),))
        after = filter_.step(before, epoch, RNG)
        np.testing.assert_allclose(after.mean_m, before.mean_m, atol=1e-6)
        np.testing.assert_allclose(after.cov_m2, before.cov_m2, atol=1e-6 * before.cov_m2[0, 0])
        assert filter_.estimate(after).status in (Status.CONVERGED, Status.OFF_MAP, Status.SEARCHING)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("band", 0.0),
        ("band_sigmas", -1.0),
        ("likelihood_var_m2", 0.0),
        ("interpolation", "quintic"),
        ("point", "median"),
        ("max_cell_m", 1e-3),
        ("min_cell_m", 0.0),
        ("outlier_share", 0.9),
    ],
)
def test_settings_out_of_range_are_named(setting: str, value: object) -> None:
    with pytest.raises(ConfigError, match=setting):
        BayesGrid((plane(0.0, 0.0),), STILL, **{setting: value})  # type: ignore[arg-type]


def test_an_early_estimate_is_refused() -> None:
    filter_ = BayesGrid((plane(0.0, 0.0),), STILL)
    with pytest.raises(StateError, match="bayes_grid: no estimate before the first epoch"):
        filter_.estimate(filter_.init(Prior.from_ins(STILL), RNG))

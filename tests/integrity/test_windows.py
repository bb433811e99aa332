"""The tests of the innovations: limits, and how often they fail readings that are as told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom, chi2

from terranav.core.records import Epoch, Innovation
from terranav.integrity import windows
from terranav.integrity.windows import LENGTHS, LONGEST, Window, coloured, contradiction, count_limit, excess, nis_limit
from terranav.kernels import integrity as kernels

EPOCH = Epoch(0.0, 45.0, 10.0, 1000.0)
RUNS = 20_000


def filled(residuals: np.ndarray, values: np.ndarray | None = None, variance: float = 1.0) -> Window:
    window = Window("terrain")
    values = residuals if values is None else values
    for residual, value in zip(residuals, values, strict=True):
        innovation = Innovation("terrain", float(residual), variance, variance)
        window = window.plus(innovation, float(value), EPOCH, np.zeros(2), 1e-6)
    return window


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("false_alarm", [1e-2, 1e-6])
def test_limits_are_quantiles(length: int, false_alarm: float) -> None:
    assert chi2.sf(nis_limit(length, false_alarm) * length, length) == pytest.approx(false_alarm)
    count = count_limit(length, false_alarm)
    assert binom.sf(count - 1, length, windows.ALLOWED) <= false_alarm < binom.sf(count - 2, length, windows.ALLOWED)


@pytest.mark.parametrize(("test", "rows"), [(excess, False), (coloured, True)])
def test_false_alarms_are_as_stated(test: Callable[..., object], rows: bool) -> None:
    rng = np.random.default_rng(2)
    stated = 0.01
    alarms = 0
    for _ in range(RUNS // 4):
        z = rng.standard_normal(LONGEST)
        given = np.stack([z, np.ones(LONGEST)], axis=1) if rows else z**2
        alarms += test(given, stated) is not None
    assert binom.cdf(alarms, RUNS // 4, stated) <= 0.999  # no more often than stated


def test_contradiction_is_rarer_than_stated_even_with_outliers() -> None:
    rng = np.random.default_rng(3)
    for share in (0.0, 0.05):
        gross = rng.random((RUNS, LONGEST)) < share
        nis = np.minimum((rng.standard_normal((RUNS, LONGEST)) * np.where(gross, 30.0, 1.0)) ** 2, windows.CAP)
        alarms = sum(contradiction(row, 1e-3) is not None for row in nis)
        assert binom.cdf(alarms, RUNS, 3e-3) <= 0.999  # three windows


def test_a_jump_is_seen_by_the_shortest_window_and_a_small_sigma_by_the_longest() -> None:
    rng = np.random.default_rng(4)
    jump = filled(np.concatenate([rng.standard_normal(52), np.full(8, 9.0)]))
    assert jump.bad is not None
    assert jump.bad.readings == LENGTHS[0]
    small = filled(1.9 * rng.standard_normal(LONGEST))
    assert small.loud is not None
    assert small.loud.figure == pytest.approx(3.0, abs=1.0)


def test_correlated_residuals_are_seen() -> None:
    rng = np.random.default_rng(5)
    walk = np.empty(LONGEST)
    walk[0] = 0.0
    for i in range(1, LONGEST):
        walk[i] = 0.9 * walk[i - 1] + 0.4 * rng.standard_normal()
    found = filled(walk).alike
    assert found is not None
    assert found.figure > found.limit
    assert filled(rng.standard_normal(LONGEST)).alike is None


def test_a_stuck_sensor_is_one_over_ground_that_varies() -> None:
    rng = np.random.default_rng(6)
    ground = 50.0 * np.sin(np.arange(20.0))
    alive = filled(rng.standard_normal(20), ground)
    assert windows.stuck(alive) == 0
    assert windows.stuck(filled(100.0 - ground, np.full(20, 100.0))) == 20
    assert windows.stuck(filled(100.0 - ground[:7], np.full(7, 100.0))) == 0  # too few
    assert windows.stuck(filled(rng.standard_normal(20), np.full(20, 100.0))) == 0  # flat ground may repeat itself


def test_the_noise_factor_minds_no_outliers() -> None:
    rng = np.random.default_rng(7)
    nis = (3.0 * rng.standard_normal(60)) ** 2
    nis[::12] = windows.CAP
    assert windows.noise_factor(nis, 60) == pytest.approx(3.0, rel=0.35)
    assert windows.noise_factor(0.1 * nis[:20] / 9.0) == 1.0
    assert windows.noise_factor(nis[:5]) == 1.0


def test_a_window_forgets() -> None:
    window = filled(np.arange(70.0))
    assert len(window) == LONGEST
    assert window.rows[0, windows.RESIDUAL] == 10.0
    assert len(window.cleared()) == 0
    assert window.cleared().seen
    assert np.isnan(window.cleared().mean_nis())


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("size", [0, 1, 5, 59, 60])
def test_the_kernels_of_a_window_are_numpys(size: int, compiled: bool) -> None:
    def of(kernel: Any) -> Any:
        return kernel if compiled else kernel.py_func

    rng = np.random.default_rng(size)
    rows, row = np.abs(rng.normal(0.0, 3.0, (size, 8))) + 0.1, np.arange(8.0) + 1.0
    after, nis = of(kernels.appended)(rows, row, LONGEST, 100.0)
    expected = np.vstack([rows[1 - LONGEST :], row])
    np.testing.assert_array_equal(after, expected)
    np.testing.assert_allclose(nis, np.minimum(expected[:, 0] ** 2 / expected[:, 1], 100.0), rtol=1e-14)
    mean, far = of(kernels.latest)(nis, 8)
    assert mean == pytest.approx(nis[-8:].mean(), rel=1e-12)
    assert far == (nis[-8:] > 4.0).sum()
    assert np.isnan(of(kernels.latest)(nis[:0], 8)[0])
    assert of(kernels.clipped_mean)(nis, 2.0) == pytest.approx(np.minimum(nis, 2.0).mean(), rel=1e-12)
    if size > 4:
        z = np.minimum(after[:, 0] / np.sqrt(after[:, 1]), 3.0)
        lagged = [z[lag:] @ z[:-lag] / (z @ z) for lag in range(1, 5)]
        np.testing.assert_allclose(of(kernels.autocorrelation)(after, 4, 3.0), lagged, rtol=1e-12)


@pytest.mark.parametrize("compiled", [True, False])
def test_the_tail_of_a_cloud_leaves_the_risk_outside(compiled: bool) -> None:
    rng = np.random.default_rng(3)
    north, east, weight = rng.normal(5.0, 30.0, 5000), rng.normal(-2.0, 10.0, 5000), rng.random(5000)
    north[:3] += 2000.0
    weight /= weight.sum()
    kernel = kernels.tail if compiled else kernels.tail.py_func
    core, reach, far, sigma2 = kernel(north, east, weight, np.array([5.0, -2.0]), 0.01)
    distance = np.hypot(north - 5.0, east + 2.0)
    order = np.argsort(distance)
    sums = np.cumsum(weight[order])
    median, quantile = (distance[order][np.searchsorted(sums, share)] for share in (0.5, 0.99))
    assert median <= core <= 1.06 * median
    assert quantile <= reach <= 1.06 * quantile
    assert far == pytest.approx(weight[:3].sum(), rel=1e-9)
    assert sigma2 == pytest.approx(weight @ distance**2, rel=1e-12)

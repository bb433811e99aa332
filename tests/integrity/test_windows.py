"""The tests of the innovations: limits, and how often they fail readings that are as told."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import binom, chi2

from terranav.core.records import Epoch, Innovation
from terranav.integrity import windows
from terranav.integrity.windows import LENGTHS, LONGEST, Window, coloured, contradiction, count_limit, excess, nis_limit

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

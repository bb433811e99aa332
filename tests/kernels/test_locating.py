"""Bounds of the misfit of blocks of placements against plain minimisation and exhaustive search."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from terranav.kernels import locating
from terranav.planning._placements import TOP, tables_of

FloatArray = NDArray[np.float64]


def least(low: FloatArray, high: FloatArray, weight: FloatArray, offset_weight: float) -> float:
    def value(o: float) -> float:
        apart = np.maximum(low - o, 0.0) + np.maximum(o - high, 0.0)
        return float((weight * apart**2).sum() + offset_weight * o * o)

    found = minimize_scalar(value, bounds=(-1e3, 1e3), method="bounded", options={"xatol": 1e-9})
    return float(found.fun)


@pytest.mark.parametrize("offset_weight", [0.0, 1e-3, 0.7])
def test_a_limit_is_exceeded_just_where_the_least_sum_is_above_it(offset_weight: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(60):
        n = int(rng.integers(1, 12))
        low = rng.normal(30.0, 50.0, n)
        high = low + rng.exponential(20.0, n)
        weight = rng.random(n) + 0.01
        value = least(low, high, weight, offset_weight)
        assert not locating.exceeds(low, high, weight, n, offset_weight, value * 1.0001 + 1e-6)
        if value > 1e-3:
            assert locating.exceeds(low, high, weight, n, offset_weight, value * 0.999)
            plain = getattr(locating.exceeds, "py_func", locating.exceeds)  # without numba it is one already
            assert plain(low, high, weight, n, offset_weight, value * 0.999)


def test_points_of_which_nothing_is_known_exclude_nothing() -> None:
    nothing = np.full(4, np.inf)
    assert not locating.exceeds(-nothing, nothing, np.ones(4), 4, 0.0, 0.0)
    low, high = np.array([-np.inf, 0.0, 10.0]), np.array([np.inf, 1.0, 11.0])
    assert locating.exceeds(low, high, np.ones(3), 3, 0.0, 40.0)  # 2 x 4.5^2 = 40.5
    assert not locating.exceeds(low, high, np.ones(3), 3, 0.0, 41.0)


@pytest.mark.parametrize("shape", [(2, 2), (7, 150), (90, 61)])
def test_tables_hold_the_least_and_the_greatest_of_every_window(shape: tuple[int, int]) -> None:
    values = np.random.default_rng(2).normal(size=shape).astype(np.float32)
    if values.size > 100:
        values[3, 20:23] = np.nan
        values[1:7, 40:49] = np.nan
    (lows, highs, somes), spans = tables_of(values)
    assert len(lows) == TOP + 1
    assert [int(block) for block in spans[:, 2]] == [2**level for level in range(TOP + 1)]
    for low, high, some, (width, stride, block) in zip(lows, highs, somes, spans):
        assert width >= block + 2
        for i in range(low.shape[0]):
            for j in range(low.shape[1]):
                window = values[i * stride : i * stride + width, j * stride : j * stride + width]
                void = bool(np.isnan(window).any())
                assert low[i, j] == (-np.inf if void else window.min())
                assert high[i, j] == (np.inf if void else window.max())
                assert some[i, j] == (not np.isnan(window).all())


@pytest.mark.parametrize("voids", [False, True])
def test_no_block_is_excluded_that_holds_a_placement_within_the_limit(voids: bool) -> None:
    rng = np.random.default_rng(3)
    values = np.cumsum(np.cumsum(rng.normal(size=(70, 80)), axis=0), axis=1).astype(np.float32)
    if voids:
        values[10:40, 20:60] = np.nan
        values[55, 11] = np.nan
    tables, spans = tables_of(values)
    n = 20
    down, right = np.linspace(-12.0, 12.0, n), 8.0 * np.sin(np.arange(n))
    heights, weight = rng.normal(0.0, 30.0, n), np.full(n, 0.04)
    low, high = np.empty(n), np.empty(n)
    checked = 0
    for level in range(TOP + 1):
        block = int(spans[level, 2])
        ends = tuple(
            np.array(edge).astype(np.int64)
            for at in (down, right)
            for edge in (np.floor(at - 0.5 - 1e-4), np.ceil(at - 0.5 + 1e-4))
        )
        for _ in range(40):
            i, j = int(rng.integers(0, 70)), int(rng.integers(0, 80))
            inside = [
                locating.misfit_at(values, i + u, j + v, down, right, heights, weight, 0.0, 9.0)[0]
                for u, v in rng.uniform(-0.5, block - 0.5, (200, 2))
            ]
            if np.isfinite(min(inside)):
                checked += 1
                data = (heights, weight, 0.0, *values.shape, 9.0)
                span = (spans[level, 0], spans[level, 1], spans[level, 2])
                limit = min(inside) * (1.0 + 1e-9)
                own = (tables[0][level], tables[1][level], tables[2][level])
                assert not locating.excluded(own, span, (i, j), ends, data, limit, low, high)[0]
    assert checked > 100


def test_the_misfit_of_a_placement_is_that_of_plain_numpy() -> None:
    rng = np.random.default_rng(4)
    values = rng.normal(size=(9, 9)).astype(np.float32)
    down, right = np.arange(-2.0, 3.0), np.arange(-2.0, 3.0)
    heights, weight = rng.normal(size=5), np.full(5, 2.0)
    d = heights - np.diag(values)[2:7]
    misfit, offset = locating.misfit_at(values, 4.0, 4.0, down, right, heights, weight, 0.0, 9.0)
    assert offset == pytest.approx(d.mean())
    assert misfit == pytest.approx(2.0 * ((d - d.mean()) ** 2).sum())
    values[4, 4] = np.nan
    d = np.delete(d, 2)
    misfit, _ = locating.misfit_at(values, 4.0, 4.0, down, right, heights, weight, 0.0, 9.0)
    assert misfit == pytest.approx(2.0 * ((d - d.mean()) ** 2).sum() + 9.0)
    assert locating.misfit_at(values, 1.0, 4.0, down, right, heights, weight, 0.0, 9.0)[0] == np.inf

"""Misfits of placements and the way down to the least one, against plain numpy and scipy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from terranav.kernels import locating, placing

FloatArray = NDArray[np.float64]
FRAME = np.array([[0.0, -0.011, 0.0002, 1e-9, 2e-9, 0.0], [0.0, 0.0004, 0.0135, 0.0, 3e-9, 1e-9]])


def world(seed: int) -> tuple[NDArray[np.float32], FloatArray, FloatArray, FloatArray, FloatArray]:
    """A smooth field, a track, heights along it at a known placement, weights, and that placement."""
    rng = np.random.default_rng(seed)
    row, col = np.mgrid[0:90, 0:110]
    values = 60.0 * np.sin(row / 9.0 + col / 31.0) + 50.0 * np.cos(col / 8.0 - row / 23.0)
    along = np.linspace(-1500.0, 1500.0, 40)
    points = np.array([0.8 * along, 0.6 * along + 200.0 * np.sin(along / 400.0)])
    true = np.array([44.3, 55.6, 0.11, 1.015])
    weight = rng.uniform(0.02, 0.06, along.size)
    where = at_cells(points, true)
    heights = sampled(values, *where) + 17.0 + rng.normal(0.0, 0.3, along.size)
    return values.astype(np.float32), points, heights, weight, true


def at_cells(points: FloatArray, at: FloatArray) -> FloatArray:
    """Rows and columns of a placement, term by term."""
    cos, sin = at[3] * np.cos(at[2]), at[3] * np.sin(at[2])
    n, e = points[0] * cos - points[1] * sin, points[0] * sin + points[1] * cos
    terms = np.array([0.0 * n, n, e, n * n, n * e, e * e])
    cells: FloatArray = at[:2, None] + FRAME @ terms
    return cells


def sampled(values: FloatArray, row: FloatArray, col: FloatArray) -> FloatArray:
    i, j = np.floor(row).astype(int), np.floor(col).astype(int)
    u, v = row - i, col - j
    upper = (1.0 - v) * values[i, j] + v * values[i, j + 1]
    lower = (1.0 - v) * values[i + 1, j] + v * values[i + 1, j + 1]
    height: FloatArray = (1.0 - u) * upper + u * lower
    return height


def residuals(at: FloatArray, data: tuple[NDArray[Any], ...], offset_weight: float) -> FloatArray:
    """Weighted, the offset eliminated; their squares sum to the misfit."""
    values, points, heights, weight = data
    d = heights - sampled(values.astype(np.float64), *at_cells(points, at))
    offset = float(weight @ d) / float(weight.sum() + offset_weight)
    return np.append(np.sqrt(weight) * (d - offset), np.sqrt(offset_weight) * offset)


@pytest.mark.parametrize("offset_weight", [0.0, 0.05])
def test_misfits_are_those_of_plain_numpy(offset_weight: float) -> None:
    values, points, heights, weight, true = world(1)
    at = true + np.random.default_rng(2).normal(0.0, [2.0, 2.0, 0.03, 0.01], (30, 4))
    out = np.empty(30)
    placing.misfits(values, at, points, FRAME, (heights, weight, offset_weight, 9.0), out)
    data = (values, points, heights, weight)
    np.testing.assert_allclose(out, [(residuals(one, data, offset_weight) ** 2).sum() for one in at], rtol=1e-6)
    away = np.array([[2.0, 55.0, 0.0, 1.0]])
    placing.misfits(values, away, points, FRAME, (heights, weight, offset_weight, 9.0), out[:1])
    assert out[0] == np.inf


@pytest.mark.parametrize("free", [(0, 1), (0, 1, 2), (0, 1, 3), (0, 1, 2, 3)])
def test_a_descent_ends_where_scipy_does(free: tuple[int, ...]) -> None:
    values, points, heights, weight, true = world(3)
    known = np.array(free)
    starts = np.tile(true, (12, 1))
    starts[:, known] += np.random.default_rng(4).uniform(-1.0, 1.0, (12, 4))[:, known] * [
        [1.2, 1.2, 0.02, 0.01][k] for k in free
    ]
    at, out = starts.copy(), np.empty(12)
    data = (values, points, heights, weight)
    placing.descend(values, at, points, FRAME, (heights, weight, 0.0, 9.0), np.array([0.2, 0.1]), known, 25, out)
    kept = np.setdiff1d(np.arange(4), known)
    np.testing.assert_array_equal(at[:, kept], starts[:, kept])
    for end, misfit in zip(at, out, strict=True):
        least = least_squares(
            lambda part, end=end: residuals(_with(end, known, part), data, 0.0), end[known], x_scale="jac"
        )
        assert misfit == pytest.approx((residuals(end, data, 0.0) ** 2).sum(), rel=1e-6)
        assert misfit <= 2.0 * least.cost + placing.GAIN
        np.testing.assert_allclose(end[:2], true[:2], atol=0.2)


def _with(at: FloatArray, known: NDArray[np.int64], part: FloatArray) -> FloatArray:
    changed = at.copy()
    changed[known] = part
    return changed


def test_a_descent_stays_within_the_ranges() -> None:
    values, points, heights, weight, true = world(5)
    at, out = np.array([[true[0], true[1], 0.0, 1.0]]), np.empty(1)
    ranges, data = np.array([0.05, 0.01]), (heights, weight, 0.0, 9.0)
    placing.descend(values, at, points, FRAME, data, ranges, np.arange(4), 25, out)
    assert at[0, 2] == pytest.approx(0.05)
    assert at[0, 3] == pytest.approx(1.01)


def test_a_descent_over_a_void_and_at_the_edge_is_finite() -> None:
    values, points, heights, weight, true = world(6)
    values[40:44, 50:60] = np.nan
    at, out = np.array([true, [2.0, 2.0, 0.0, 1.0]]), np.empty(2)
    data = (heights, weight, 0.0, 9.0)
    placing.descend(values, at, points, FRAME, data, np.array([0.2, 0.1]), np.arange(4), 10, out)
    assert np.isfinite(at).all()
    assert np.isfinite(out[0])
    assert out[1] == np.inf


def test_the_cells_of_a_shape_hold_the_points_of_all_its_headings_and_factors() -> None:
    rng = np.random.default_rng(7)
    points = rng.uniform(-4000.0, 4000.0, (2, 25))
    corners = FRAME + np.array([1e-4, -1e-4])[:, None, None] * np.array([[0, 1, 1, 0, 0, 0], [0, 1, 1, 0, 0, 0]])
    mids = np.column_stack([rng.uniform(-3.0, 3.0, 20), rng.uniform(0.9, 1.1, 20)])
    halves = np.column_stack([rng.uniform(0.0, 0.5, 20), rng.uniform(0.0, 0.1, 20)])
    ends, places = np.empty((4, 20, 25), np.int32), np.empty((2, 20, 25))
    locating.lie(points, mids, halves, FRAME, corners, ends, places)
    for h, ((psi, factor), (a, b)) in enumerate(zip(mids, halves, strict=True)):
        np.testing.assert_allclose(places[:, h], at_cells(points, np.array([0.0, 0.0, psi, factor])), atol=1e-9)
        for _ in range(40):
            at = np.array([0.0, 0.0, psi + a * rng.uniform(-1, 1), factor * (1.0 + b * rng.uniform(-1, 1))])
            row, col = at_cells(points, at) + rng.uniform(-0.5, 0.5)  # the middle anywhere in its cell
            assert (np.floor(row) >= ends[0, h]).all()
            assert (np.ceil(row) <= ends[1, h] + 1).all()
            assert (np.floor(col) >= ends[2, h]).all()
            assert (np.ceil(col) <= ends[3, h] + 1).all()

"""Nearest contour points against contourpy, the cost by hand, the simplex on a surface with a known answer."""

from __future__ import annotations

import math

import contourpy
import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.kernels.contours import nearest_on_contour, nearest_points, optimise, trace, trace_cost

METRIC = np.array([[-92.0, 3.0], [1.0, 74.0]])
REACH_M = 1e5


def rough(voids: bool = False) -> NDArray[np.float32]:
    """Rougher than any terrain: many saddles."""
    rng = np.random.default_rng(0)
    values = rng.normal(0.0, 10.0, (24, 31))
    values += np.roll(values, 1, 0) + np.roll(values, 1, 1)
    if voids:
        values[rng.random(values.shape) < 0.1] = np.nan
    return values.astype(np.float32)


def by_contourpy(values: NDArray[np.float32], row: float, col: float, level: float) -> float:
    """Distance to all the lines that contourpy draws."""
    drawn = contourpy.contour_generator(
        z=np.ma.masked_invalid(values.astype(np.float64)), name="serial", corner_mask=False
    ).lines(level)
    best = math.inf
    for line in drawn:
        points = (np.asarray(line)[:, ::-1] - [row, col]) @ METRIC.T
        a, b = points[:-1], np.diff(points, axis=0)
        t = np.clip(-np.sum(a * b, axis=1) / np.maximum(np.sum(b * b, axis=1), 1e-300), 0.0, 1.0)
        best = min(best, float(np.hypot(*(a + t[:, None] * b).T).min()))
    return best


@pytest.mark.parametrize("voids", [False, True])
def test_nearest_contour_point_is_that_of_contourpy(voids: bool) -> None:
    values, rng = rough(voids), np.random.default_rng(1)
    found = 0
    for _ in range(250):
        row, col, level = rng.uniform(-3.0, 27.0), rng.uniform(-3.0, 34.0), rng.normal(0.0, 15.0)
        distance, r, c = nearest_on_contour(values, row, col, level, METRIC, REACH_M)
        truth = by_contourpy(values, row, col, level)
        if math.isinf(truth):
            assert math.isnan(distance)
            continue
        found += 1
        assert distance == pytest.approx(truth, abs=1e-9)
        assert np.hypot(*(METRIC @ [r - row, c - col])) == pytest.approx(distance, abs=1e-9)
    assert found > 200


def test_the_compiled_kernel_is_the_written_one() -> None:
    values, rng = rough(), np.random.default_rng(2)
    for _ in range(20):
        args = (values, rng.uniform(0.0, 23.0), rng.uniform(0.0, 30.0), rng.normal(0.0, 15.0), METRIC, 500.0)
        np.testing.assert_allclose(nearest_on_contour(*args), nearest_on_contour.py_func(*args), rtol=1e-12)


def test_contours_beyond_reach_off_the_map_and_on_level_ground_are_not_seen() -> None:
    ramp = np.repeat(np.arange(20.0, dtype=np.float32)[:, None], 20, axis=1)
    metric = np.eye(2) * 10.0
    assert nearest_on_contour(ramp, 5.0, 5.0, 9.5, metric, 45.5)[0] == pytest.approx(45.0)
    assert math.isnan(nearest_on_contour(ramp, 5.0, 5.0, 9.5, metric, 44.5)[0])
    assert math.isnan(nearest_on_contour(np.full_like(ramp, 7.0), 5.0, 5.0, 7.0, metric, 1e4)[0])
    assert math.isnan(nearest_on_contour(ramp, math.nan, 5.0, 9.5, metric, 1e4)[0])
    assert math.isnan(nearest_on_contour(ramp, 1e9, 5.0, 9.5, metric, 1e4)[0])
    out = np.empty((2, 3))
    nearest_points(ramp, np.array([5.0, 5.0]), np.array([5.0, 5.0]), np.array([9.5, 99.0]), metric, 1e4, out)
    np.testing.assert_allclose(out[0], [45.0, 9.5, 5.0])
    assert np.isnan(out[1]).all()


def test_a_trace_steps_with_velocity_and_course_errors() -> None:
    first, steps = np.array([100.0, 0.0]), np.array([[0.0, 400.0], [0.0, 400.0]])
    out = np.empty((3, 2))
    trace(np.array([1.0, 2.0, 0.1, 0.0]), first, steps, out)  # one velocity error for all
    np.testing.assert_allclose(out, [[101.0, 2.0], [101.0, 442.0], [101.0, 882.0]])
    trace(np.array([0.0, 0.0, 0.0, math.pi / 2.0, -0.5, 0.0]), first, steps, out)  # of each step its own
    np.testing.assert_allclose(out, [[100.0, 0.0], [-300.0, 0.0], [-300.0, 200.0]], atol=1e-9)


def planes() -> tuple[NDArray[np.float32], tuple[NDArray[np.float64], ...]]:
    """A bowl, and a frame of 10 m cells whose origin is its middle; rows run south."""
    at = (np.arange(101.0) - 50.0) * 10.0
    bowl = np.hypot(at[:, None] - 31.0, 2.0 * at - 8.0).astype(np.float32)
    row = np.array([50.0, -0.1, 0.0, 0.0, 0.0, 0.0])
    col = np.array([50.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    return bowl, (row, col, np.array([[-10.0, 0.0], [0.0, 10.0]]))


def test_the_target_value_is_that_of_eqs_1_to_4() -> None:
    ramp = np.repeat(np.arange(101.0, dtype=np.float32)[:, None], 101, axis=1)  # a metre a row, southwards
    frame = planes()[1]
    first, steps = np.zeros(2), np.array([[0.0, 300.0], [0.0, 200.0]])
    level = np.array([50.0, 52.0, 49.5])  # contours through 0, 20 m south and 5 m north
    p = np.array([0.0, -100.0, 0.03, 0.04, 0.0, 0.0])
    points = np.empty((3, 2))
    total, contours = trace_cost(ramp, frame, level, first, steps, p, 2.0, 1e4, points)
    turned_north = 309.0 * math.sin(0.04)  # course errors turn from north to east: towards -north here is +sin * east
    heights = [0.0, abs(-points[1, 0] / 10.0 - 2.0) * 10.0, abs(points[2, 0] - 5.0)]
    assert points[1, 0] == pytest.approx(-turned_north)
    assert contours == pytest.approx(sum(heights), abs=1e-4)
    assert total - contours == pytest.approx(2.0 * 300.0 * 0.05)  # K |a_i - a_(i-1)| sqrt(alpha^2 + eps^2)
    far = trace_cost(ramp, frame, level + 1000.0, first, steps, p, 2.0, 77.0, points)[1]
    assert far == 3 * 77.0  # no contour: as one at the reach


def test_the_simplex_finds_a_trace_and_stops_as_told() -> None:
    bowl, frame = planes()
    first, steps = np.zeros(2), np.array([[60.0, 40.0], [-30.0, 90.0], [-80.0, 20.0], [10.0, -150.0]])
    true = np.empty((5, 2))
    trace(np.array([37.0, -21.0, 0.0, 0.0]), first, steps, true)
    row, col = 50.0 - 0.1 * true[:, 0], 50.0 + 0.1 * true[:, 1]
    i, j = row.astype(int), col.astype(int)
    u, v = row - i, col - j
    level = sum(
        bowl[i + a, j + b].astype(float) * (u if a else 1 - u) * (v if b else 1 - v) for a in (0, 1) for b in (0, 1)
    )
    starts, size = np.zeros((3, 4)), np.array([20.0, 20.0, 0.01, 0.01])
    out, score = np.empty((3, 4)), np.empty((3, 3))
    optimise(bowl, frame, level, first, steps, starts, size, (1.0, 1e4, 0.0, 500.0), out, score)
    np.testing.assert_allclose(out[:, :2], [[37.0, -21.0]] * 3, atol=1.0)  # marching squares cut the bowl's curves
    assert score[0, 0] < 2.0
    optimise(bowl, frame, level, first, steps, starts, size, (1.0, 1e4, 0.0, 7.0), out, score)
    assert (score[:, 2] == 7).all()
    worse = score[0, 0]
    optimise(bowl, frame, level, first, steps, starts, size, (1.0, 1e4, worse + 5.0, 500.0), out, score)
    assert worse <= score[0, 0] < worse + 5.0  # E_min ends it early
    assert score[0, 2] <= 7

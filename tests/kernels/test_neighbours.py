"""The order of particles along strips: whole, near on the ground, of equal weight, and slow to change."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.kernels.neighbours import LEVELS, extent, neighbours_together

FloatArray = NDArray[np.float64]
SIZES = [1, 2, 5, 100, 511, 512, 513, 1300, 40_000]


def ordered(north: FloatArray, east: FloatArray, weight: FloatArray) -> NDArray[np.int32]:
    scratch = np.full((4, len(north) + 1), -1, np.int32)
    neighbours_together(north, east, weight, scratch)
    return scratch[0, :-1]


def cloud(count: int, seed: int = 3) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    weight = rng.random(count)
    return rng.normal(-70.0, 300.0, count), rng.normal(4000.0, 90.0, count), weight / weight.sum()


@pytest.mark.parametrize("count", SIZES)
def test_extent(count: int) -> None:
    north, east, _ = cloud(count)
    for values in (north, east, np.sort(east), np.sort(-north)):
        assert extent(values) == (values.min(), values.max())


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("kind", ["normal", "one place", "on a line", "one far away", "all the weight on one"])
def test_every_particle_once(count: int, kind: str) -> None:
    north, east, weight = cloud(count)
    if kind == "one place":
        north[:], east[:] = -3.0, 1e6
    elif kind == "on a line":
        north[:] = 5.0
    elif kind == "one far away":
        east[count // 2] = -1e9
    elif kind == "all the weight on one":
        weight[:] = 0.0
        weight[count // 2] = 1.0
    np.testing.assert_array_equal(np.sort(ordered(north, east, weight)), np.arange(count))


def test_strips_of_equal_weight_to_and_fro() -> None:
    count = 40_000
    north, east, weight = cloud(count)
    order = ordered(north, east, weight)
    side = int(np.sqrt(count))
    strip = (np.cumsum(weight[order]) * side).astype(int)
    means = np.array([north[order][strip == s].mean() for s in range(side)])
    assert (np.diff(means) > 0.0).all()  # from south to north
    level = np.ptp(east) / (LEVELS / 2.0)
    heading = []
    for s in range(20, side - 20):
        middle = east[order[strip == s]][20:-20]  # a strip may begin or end a few particles off
        onward = 1.0 if middle[-1] > middle[0] else -1.0
        assert (onward * np.diff(middle) > -level).all()
        heading.append(onward)
    assert (np.diff(heading) != 0.0).all()
    step = np.hypot(np.diff(north[order]) / 300.0, np.diff(east[order]) / 90.0)
    assert np.median(step) < 0.05  # where particles taken at random are 1.7 apart


def test_one_particle_more_to_the_side_leaves_the_others_in_their_order() -> None:
    north, east, weight = cloud(10_000)
    before = ordered(north, east, weight)
    east[77] += 500.0  # beyond all others
    after = ordered(north, east, weight)
    np.testing.assert_array_equal(before[before != 77], after[after != 77])


def test_the_same_without_compilation() -> None:
    north, east, weight = cloud(700)
    plain = np.empty((4, 701), np.int32)
    neighbours_together.py_func(north, east, weight, plain)
    np.testing.assert_array_equal(plain[0, :-1], ordered(north, east, weight))

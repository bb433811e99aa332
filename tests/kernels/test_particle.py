"""The particle filter's kernels against plain numpy, compiled and not."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.kernels import particle as kernels
from terranav.kernels.neighbours import neighbours_together
from terranav.kernels.random import normals
from terranav.kernels.sampling import BLOCK
from terranav.maps.fields import gaussian_map, plane_map

FloatArray = NDArray[np.float64]
SIZES = [100, BLOCK, BLOCK + 1, 2 * BLOCK + 37]
CENTRE = np.array([3.0, -5.0])


def some_cloud(count: int, seed: int = 4, power: float = 1.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    weight = rng.random(count) ** power
    return rng.uniform(-900.0, 900.0, count), rng.uniform(-900.0, 900.0, count), weight / weight.sum()


def in_numpy(north: FloatArray, east: FloatArray, weight: FloatArray) -> list[float]:
    mean = [np.average(north, weights=weight), np.average(east, weights=weight)]
    cov = np.cov(np.stack([north, east]), aweights=weight, ddof=0)
    return [*mean, cov[0, 0], cov[0, 1], cov[1, 1]]


@pytest.mark.parametrize("count", SIZES)
def test_moments(count: int) -> None:
    cloud = some_cloud(count, power=4.0)
    np.testing.assert_allclose(kernels.moments(*cloud, CENTRE), in_numpy(*cloud), rtol=1e-9)


@pytest.mark.parametrize("count", SIZES)
def test_noise_is_moment_matched_normal_noise(count: int) -> None:
    """The same as in numpy, with its solvers: out of the noise what it shares with the cloud, then whitened."""
    north, east, weight = some_cloud(count, power=2.0)
    growth, key = np.array([50.0, 200.0]), np.uint64(77)
    out_n, out_e = np.empty(count), np.empty(count)
    kernels.spread(north, east, weight, growth, CENTRE, key, out_n, out_e)

    cloud, noise = np.stack([north, east], axis=1), np.empty(2 * count)
    normals(key, noise)
    away = cloud - weight @ cloud
    weighted = away * weight[:, None]
    drawn = noise.reshape(count, 2) - away @ np.linalg.solve(weighted.T @ away, weighted.T @ noise.reshape(count, 2))
    drawn -= weight @ drawn
    own = np.linalg.cholesky((drawn * weight[:, None]).T @ drawn)
    expected = cloud + drawn @ np.linalg.inv(own).T * np.sqrt(growth)
    np.testing.assert_allclose(np.stack([out_n, out_e], axis=1), expected, rtol=1e-9, atol=1e-9)

    before, after = in_numpy(north, east, weight), in_numpy(out_n, out_e, weight)
    np.testing.assert_allclose(after, np.add(before, [0.0, 0.0, growth[0], 0.0, growth[1]]), rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("kind", ["all in one place", "on a line", "all the weight on one"])
def test_noise_of_a_degenerate_cloud(kind: str) -> None:
    count = 3000
    north, east, weight = some_cloud(count)
    if kind == "all in one place":
        north[:], east[:] = 12.0, -7.0
    elif kind == "on a line":
        east = 2.0 * north
    else:
        weight[:] = 0.0
        weight[5] = 1.0
    out_n, out_e = np.empty(count), np.empty(count)
    kernels.spread(north, east, weight, np.array([100.0, 100.0]), CENTRE, np.uint64(1), out_n, out_e)
    for moved in (out_n - north, out_e - east):
        assert np.var(moved) == pytest.approx(100.0, rel=0.15)
    if kind == "all in one place":
        np.testing.assert_allclose(in_numpy(out_n, out_e, weight), [12.0, -7.0, 100.0, 0.0, 100.0], atol=1e-9)


def numpy_weights(
    height: FloatArray, weight: FloatArray, reading: FloatArray, outliers: FloatArray
) -> tuple[FloatArray, float, float]:
    there = np.isfinite(height)
    r2 = ((height - reading[0]) / reading[1]) ** 2
    likely = (1.0 - outliers[0]) * np.exp(-0.5 * r2) + outliers[0] / outliers[1] * np.exp(-0.5 * r2 / outliers[1] ** 2)
    likely[~there] = (weight * likely)[there].sum() / weight[there].sum()
    away, known = (height - reading[0])[there], weight[there].sum()
    mean = np.average(away, weights=weight[there])
    nis = mean**2 / (reading[1] ** 2 + np.average((away - mean) ** 2, weights=weight[there]))
    return weight * likely / (weight * likely).sum(), known, nis


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("void_from", [25, 41])
def test_weights_equal_bayes_rule_and_voids_are_neutral(count: int, void_from: int) -> None:
    chart = gaussian_map(np.random.default_rng(4), cells=41, cell_m=50.0)
    values = np.array(chart.values)
    values[:, void_from:] = np.nan
    north, east, weight = some_cloud(count)
    frame = chart.local_frame(*chart.centre_deg)
    row, col = frame.cells(-north, -east)
    told, outliers, out = np.array([500.0, 40.0]), np.array([0.1, 5.0]), np.empty(count)
    known, nis, effective, found = kernels.weigh_cloud(
        values, np.stack([frame.row, frame.col]), told, outliers, north, east, weight, CENTRE, out
    )
    i, j = np.floor(row).astype(int), np.floor(col).astype(int)
    u, v = row - i, col - j
    tall = values.astype(np.float64)
    height = (1 - u) * ((1 - v) * tall[i, j] + v * tall[i, j + 1]) + u * (
        (1 - v) * tall[i + 1, j] + v * tall[i + 1, j + 1]
    )
    expected, share, ratio = numpy_weights(height, weight, told, outliers)
    assert (share < 0.9) == (void_from < 41)
    np.testing.assert_allclose(out, expected, rtol=1e-9)
    assert known == pytest.approx(share, rel=1e-12)
    assert nis == pytest.approx(ratio, rel=1e-9)
    assert effective == pytest.approx(1.0 / np.sum(expected**2), rel=1e-9)
    np.testing.assert_allclose(found, in_numpy(north, east, expected), rtol=1e-8)


def weighed_on(values: FloatArray, reading: list[float]) -> tuple[FloatArray, FloatArray, tuple[float, ...]]:
    chart = plane_map(0.0, 0.0, cells=21)
    frame = chart.local_frame(0.0, 0.0)
    north, east, weight = some_cloud(50)
    out = np.empty(50)
    said = kernels.weigh_cloud(
        values.astype(np.float32),
        np.stack([frame.row, frame.col]),
        np.array(reading),
        np.array([0.0, 2.0]),
        0.1 * north,
        0.1 * east,
        weight,
        CENTRE,
        out,
    )
    np.testing.assert_allclose(said[3], in_numpy(0.1 * north, 0.1 * east, out), rtol=1e-9)
    return out, weight, said


def test_a_reading_that_contradicts_all_changes_nothing() -> None:
    out, weight, (known, nis, effective, _) = weighed_on(np.zeros((21, 21)), [1e6, 1.0])
    np.testing.assert_array_equal(out, weight)
    assert known == pytest.approx(1.0)
    assert nis > 1e9
    assert effective == pytest.approx(1.0 / np.sum(weight**2))


def test_a_map_that_says_nothing_changes_nothing() -> None:
    out, weight, (known, nis, _, _) = weighed_on(np.full((21, 21), np.nan), [0.0, 1.0])
    np.testing.assert_array_equal(out, weight)
    assert known == 0.0
    assert np.isnan(nis)


def test_a_reading_that_all_but_contradicts_keeps_its_digits() -> None:
    """Squares of weights would underflow."""
    steps = np.tile(np.arange(21.0)[:, None], 21)
    out, _, (_, _, effective, _) = weighed_on(steps, [-22.0, 1.0])
    assert out.sum() == pytest.approx(1.0)
    assert effective == pytest.approx(1.0 / np.sum(out**2))
    assert effective < 40.0


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("power", [1.0, 8.0, 60.0])
def test_resampling_equals_the_search_in_the_cumulative_sum(count: int, power: float) -> None:
    north, east, weight = some_cloud(count, power=power)
    weight[:3], weight[-2:] = 0.0, 0.0
    weight /= weight.sum()
    offset = float(np.random.default_rng(1).random())
    out_n, out_e = np.empty(count), np.empty(count)
    scratch = np.empty((4, count + 1), np.int32)
    kernels.resample(north, east, weight, offset, scratch, out_n, out_e)
    neighbours_together(north, east, weight, scratch)
    order = scratch[0, :-1]
    expected = order[np.searchsorted(np.cumsum(weight[order]), (np.arange(count) + offset) / count, side="right")]
    np.testing.assert_array_equal(out_n, north[expected])
    np.testing.assert_array_equal(out_e, east[expected])
    copies = np.bincount(np.searchsorted(np.sort(north), out_n), minlength=count)
    assert (np.abs(copies - count * weight[np.argsort(north)]) < 1.0).all()


@pytest.mark.parametrize("offset", [0.0, 1.0 - 1e-9])
def test_all_the_weight_on_one_gives_copies_of_that_one(offset: float) -> None:
    for chosen in (0, 57, 99):
        north, east, weight = some_cloud(100)
        weight[:] = 0.0
        weight[chosen] = 1.0
        out_n, out_e = np.empty(100), np.empty(100)
        kernels.resample(north, east, weight, offset, np.empty((4, 101), np.int32), out_n, out_e)
        assert (out_n == north[chosen]).all()
        assert (out_e == east[chosen]).all()


SCRIPT = """
import numpy as np
from terranav.kernels import particle as kernels
rng = np.random.default_rng(2)
values = rng.normal(100.0, 30.0, (20, 30)).astype(np.float32)
values[5:8, 5:9] = np.nan
north, east, weight = rng.normal(0.0, 40.0, 260), rng.normal(0.0, 50.0, 260), np.full(260, 1.0 / 260)
frame = np.array([[9.5, -0.08, 0.01, 1e-5, 0.0, 0.0], [14.5, 0.01, 0.09, 0.0, 1e-5, 0.0]])
centre, out, n, e = np.zeros(2), np.empty(260), np.empty(260), np.empty(260)
kernels.spread(north, east, weight, np.array([4.0, 9.0]), centre, np.uint64(9), n, e)
reading, outliers = np.array([100.0, 20.0]), np.array([0.02, 10.0])
said = kernels.weigh_cloud(values, frame, reading, outliers, n, e, weight, centre, out)
print(*np.concatenate([n, e, 1e3 * out, said[:3], said[3]]).round(7) + 0.0)
kernels.resample(n, e, out, 0.4, np.empty((4, 261), np.int32), north, east)
print(*north.round(7), *east.round(7))
"""


def test_kernels_say_the_same_without_compilation() -> None:
    said = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env={**os.environ, "NUMBA_DISABLE_JIT": off},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for off in ("0", "1")
    ]
    assert said[0] == said[1]

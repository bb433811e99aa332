"""The fused step of the point-mass filter against plain numpy and scipy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from terranav.filters.pointmass import gaussian_taps
from terranav.kernels.density import border, diffused, measured, support
from terranav.kernels.lattice import bilinear_lattice
from terranav.kernels.pointmass import advance

FloatArray = NDArray[np.float64]
CELL = 40.0


def spread(density: FloatArray, growth: tuple[float, float]) -> FloatArray:
    """The density after a normalised convolution."""
    once = ndimage.convolve1d(density, gaussian_taps(growth[0]), axis=0, mode="constant")
    out = ndimage.convolve1d(once, gaussian_taps(growth[1]), axis=1, mode="constant")
    return np.asarray(out / out.sum())


def bayes(
    prior: FloatArray, field: FloatArray, value: float, sigma: float, settings: tuple[float, float, float]
) -> tuple[float, float, float, FloatArray]:
    """Share on the map, NIS, slope and posterior, straight from the formulas."""
    resolve, share, scale = settings
    edged = np.pad(field, 1, mode="edge")
    east, north = 0.5 * (edged[1:-1, 2:] - edged[1:-1, :-2]), 0.5 * (edged[2:, 1:-1] - edged[:-2, 1:-1])
    slope2 = np.nan_to_num(east**2) + np.nan_to_num(north**2)
    variance = np.maximum(sigma**2, resolve**2 * slope2)
    away = np.nan_to_num(field - value)
    with np.errstate(under="ignore"):
        like = (1.0 - share) * np.exp(-0.5 * away**2 / variance)
        like += share / scale * np.exp(-0.5 * away**2 / variance / scale**2)
    solid = np.isfinite(field)
    likely = np.where(solid, prior * like / np.sqrt(variance), 0.0)
    known = prior[solid].sum()
    if known == 0.0:
        return 0.0, math.nan, 0.0, prior
    mean = (prior * away)[solid].sum() / known
    nis = mean**2 / (sigma**2 + (prior * away**2)[solid].sum() / known - mean**2)
    if likely.sum() <= 1e-290:
        return known, nis, 0.0, prior
    post = np.where(solid, likely, likely.sum() / known * prior)
    return known, nis, math.sqrt((likely * slope2).sum() / likely.sum()), post / post.sum()


def described(density: FloatArray, south: float, west: float) -> list[float]:
    """Moments, local width and support."""
    rows, cols = density.sum(axis=1), density.sum(axis=0)
    north, east = south + CELL * np.arange(rows.size), west + CELL * np.arange(cols.size)
    mean = [rows @ north, cols @ east]
    var = [rows @ (north - mean[0]) ** 2, (north - mean[0]) @ density @ (east - mean[1]), cols @ (east - mean[1]) ** 2]
    steps = max((np.diff(density, axis=0) ** 2).sum(), (np.diff(density, axis=1) ** 2).sum())
    width = math.sqrt((density**2).sum() / (2.0 * steps + 1e-300))
    ends = [end for mass in (rows, cols) for end in supported(mass)]
    return [*mean, *var, width, *ends]


def supported(mass: FloatArray) -> tuple[int, int]:
    share = mass / mass.sum()
    return int(np.flatnonzero(np.cumsum(share) > 1e-7)[0]), int(np.flatnonzero(np.cumsum(share[::-1])[::-1] > 1e-7)[-1])


def land(rng: np.random.Generator, voids: float) -> NDArray[np.float32]:
    """A rough map of 60 x 70 cells, part of it void."""
    smooth = ndimage.gaussian_filter(rng.normal(0.0, 300.0, (60, 70)), 2.0)
    chart = np.asarray(smooth, dtype=np.float32)
    chart[rng.random(chart.shape) < voids] = np.nan
    return chart


def run(density: FloatArray, chart: NDArray[Any], growth: tuple[float, float], reading: tuple[float, ...]) -> Any:
    """The kernel's answer and posterior, beside the map at the cells; a cell of the map is 90 m."""
    south, west = -CELL * (density.shape[0] // 2) + 7.0, -CELL * (density.shape[1] // 2) - 11.0
    row6, col6 = np.array([30.2, 1 / 90.0, 1e-4, 0.0, 1e-9, 0.0]), np.array([35.1, -2e-4, 1 / 90.0, 0.0, 0.0, 1e-9])
    north, east = south + CELL * np.arange(density.shape[0]), west + CELL * np.arange(density.shape[1])
    field, out, kept = np.empty_like(density), np.full_like(density, np.nan), density.copy()
    bilinear_lattice(chart, row6, col6, -north, -east, field)
    got = advance(density, *growth, (south, west, CELL), chart, (row6, col6), reading, out)
    assert np.array_equal(density, kept)
    return got, out, field, (south, west)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (7, 9), (33, 31), (48, 95), (101, 64)])
@pytest.mark.parametrize("voids", [0.0, 0.003, 0.3])
@pytest.mark.parametrize("growth", [(0.0, 0.0), (0.3, 0.2), (0.6, 0.9), (5.0, 0.0)])
@pytest.mark.parametrize("settings", [(0.6, 0.02, 10.0), (0.6, 0.0, 10.0), (0.0, 0.1, 3.5)])
def test_equals_bayes_rule_in_plain_numpy(
    shape: tuple[int, int], voids: float, growth: tuple[float, float], settings: tuple[float, float, float]
) -> None:
    rng = np.random.default_rng(shape[0])
    density = rng.random(shape) ** 4
    density /= density.sum()
    chart = land(rng, voids)
    got, out, field, corner = run(density, chart, growth, (15.0, 6.0, *settings))
    known, nis, slope, post = bayes(spread(density, growth), field, 15.0, 6.0, settings)
    np.testing.assert_allclose(got[:3], [known, nis, slope], rtol=1e-11)
    np.testing.assert_allclose(out, post, rtol=2e-11, atol=1e-200)
    assert out.sum() == pytest.approx(1.0, abs=1e-12)
    want = described(post, *corner)
    np.testing.assert_allclose(got[3:5], want[:2], rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(got[5:8], want[2:5], rtol=1e-9, atol=1e-7)
    if min(shape) > 2:
        np.testing.assert_allclose(got[8], want[5], rtol=1e-9)
    assert list(got[9:]) == want[6:]


def test_the_sums_differ_where_they_should() -> None:
    """The reference would notice a posterior that ignores voids, outliers, slope or diffusion."""
    rng = np.random.default_rng(3)
    density = rng.random((33, 31)) ** 4
    density /= density.sum()
    chart = land(rng, 0.1)
    _, out, field, _ = run(density, chart, (0.6, 0.6), (15.0, 6.0, 0.6, 0.02, 10.0))
    prior = spread(density, (0.6, 0.6))
    others = [
        bayes(density, field, 15.0, 6.0, (0.6, 0.02, 10.0)),
        bayes(prior, np.nan_to_num(field), 15.0, 6.0, (0.6, 0.02, 10.0)),
        bayes(prior, field, 15.0, 6.0, (0.6, 0.0, 10.0)),
        bayes(prior, field, 15.0, 6.0, (0.0, 0.02, 10.0)),
    ]
    for *_, other in others:
        assert np.abs(out - other).max() > 1e-4 * out.max()


@pytest.mark.parametrize("share", [0.0, 0.02])
def test_a_reading_that_contradicts_every_cell_leaves_the_diffused_density(share: float) -> None:
    rng = np.random.default_rng(5)
    density = rng.random((30, 41))
    density /= density.sum()
    got, out, _, corner = run(density, land(rng, 0.0), (0.6, 0.3), (1e7, 1.0, 0.6, share, 10.0))
    np.testing.assert_allclose(out, spread(density, (0.6, 0.3)), rtol=1e-12)
    assert got[0] == pytest.approx(1.0)
    assert got[1] > 1e6
    assert got[2] == 0.0
    np.testing.assert_allclose(got[3:8], described(out, *corner)[:5], rtol=1e-9)


def test_a_reading_far_away_is_weighed_where_squares_of_it_vanish() -> None:
    rng = np.random.default_rng(6)
    density = rng.random((30, 41))
    density /= density.sum()
    chart = land(rng, 0.0)
    got, out, field, corner = run(density, chart, (0.0, 0.0), (field_max(chart) + 130.0, 5.0, 0.0, 0.0, 10.0))
    known, nis, slope, post = bayes(density, field, field_max(chart) + 130.0, 5.0, (0.0, 0.0, 10.0))
    likely = density * np.exp(-0.5 * ((field - field_max(chart) - 130.0) / 5.0) ** 2) / 5.0
    assert 1e-290 < likely.sum() < 1e-150
    np.testing.assert_allclose(got[:3], [known, nis, slope], rtol=1e-10)
    np.testing.assert_allclose(out, post, rtol=1e-10, atol=1e-90)  # the exponential is held at its least
    np.testing.assert_allclose(got[3:9], described(post, *corner)[:6], rtol=1e-9)


def field_max(chart: NDArray[Any]) -> float:
    return float(np.nanmax(chart))


def test_off_the_map_only_the_diffusion_remains() -> None:
    rng = np.random.default_rng(7)
    density = rng.random((12, 9))
    density /= density.sum()
    chart = np.full((60, 70), np.nan, dtype=np.float32)
    got, out, _, _ = run(density, chart, (0.6, 0.6), (10.0, 5.0, 0.6, 0.02, 10.0))
    assert got[0] == 0.0
    assert math.isnan(got[1])
    assert got[2] == 0.0
    np.testing.assert_allclose(out, spread(density, (0.6, 0.6)), rtol=1e-13)


def test_the_edge_of_the_map_is_a_void() -> None:
    rng = np.random.default_rng(8)
    density = rng.random((150, 170))
    density /= density.sum()
    got, out, field, _ = run(density, land(rng, 0.0), (0.3, 0.6), (20.0, 5.0, 0.6, 0.02, 10.0))
    assert 0.1 < np.isnan(field).mean() < 0.9
    known, nis, slope, post = bayes(spread(density, (0.3, 0.6)), field, 20.0, 5.0, (0.6, 0.02, 10.0))
    np.testing.assert_allclose(got[:3], [known, nis, slope], rtol=1e-11)
    np.testing.assert_allclose(out, post, rtol=2e-11, atol=1e-200)


def test_the_same_without_compilation() -> None:
    rng = np.random.default_rng(9)
    density = rng.random((9, 11))
    density /= density.sum()
    chart = land(rng, 0.0)
    place, frame = (
        (-3 * CELL, -2 * CELL, CELL),
        (np.array([30.0, 0.01, 0, 0, 0, 0]), np.array([30.0, 0, 0.01, 0, 0, 0])),
    )
    reading = (10.0, 5.0, 0.6, 0.02, 10.0)
    out, plain = np.empty_like(density), np.empty_like(density)
    got = advance(density, 0.6, 0.3, place, chart, frame, reading, out)
    with np.errstate(over="ignore"):
        same = advance.py_func(density, 0.6, 0.3, place, chart, frame, reading, plain)
    np.testing.assert_allclose(got, same, rtol=1e-10)
    np.testing.assert_allclose(out, plain, rtol=1e-10)


def test_diffusion_and_summary_of_any_sum() -> None:
    density = np.random.default_rng(10).random((21, 30))
    out = np.empty_like(density)
    got = diffused(density, 0.6, 3.0, (-200.0, 100.0, CELL), out)
    np.testing.assert_allclose(out, spread(density, (0.6, 3.0)), rtol=1e-12)
    np.testing.assert_allclose(got, described(out, -200.0, 100.0), rtol=1e-10)
    np.testing.assert_allclose(measured(7.0 * out, (-200.0, 100.0, CELL)), got, rtol=1e-12)


def test_moments_and_local_width_of_a_gaussian() -> None:
    north, east = np.arange(-40.0, 41.0), np.arange(-30.0, 31.0)
    density = np.exp(-0.5 * ((north[:, None] / 6.0) ** 2 + (east[None, :] / 4.0) ** 2))
    got = measured(density, (-40.0, -30.0, 1.0))
    np.testing.assert_allclose(got[:5], [0.0, 0.0, 36.0, 0.0, 16.0], atol=1e-6)
    assert got[5] == pytest.approx(4.0, rel=0.02)
    assert got[6:8] == (40 - 31, 40 + 31)  # 5.2 sigma
    assert got[8:] == (30 - 21, 30 + 21)


@pytest.mark.parametrize("mass", [[1.0], [0.0, 1.0, 0.0], [1e-8, 0.4, 0.6, 1e-8, 0.0], [1e-3, 1.0, 1e-9, 1e-8, 1e-3]])
def test_support_holds_all_but_the_tails(mass: list[float]) -> None:
    assert support(np.array(mass)) == supported(np.array(mass))


def test_border_masses() -> None:
    density = np.random.default_rng(11).random((12, 17))
    for band in (1, 3, 12):
        wanted = [density[:band].sum(), density[-band:].sum(), density[:, :band].sum(), density[:, -band:].sum()]
        np.testing.assert_allclose(border(density, band), wanted, rtol=1e-13)

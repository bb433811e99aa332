"""TERCOM against plain numpy, on smooth terrain, over voids, and its covariance against its errors."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.protocols import Matcher
from terranav.core.records import Candidates, Epoch, Measurement, Prior, Profile
from terranav.maps.map import Map
from terranav.matchers.tercom import Tercom

FloatArray = NDArray[np.float64]
LAT0, LON0 = 47.0, 11.0
CRS = f"+proj=aeqd +lat_0={LAT0} +lon_0={LON0} +datum=WGS84 +units=m"
CELL = 50.0


def hills(x: FloatArray, y: FloatArray) -> FloatArray:
    """Smooth hills with slopes of about 0.1 in every direction."""
    return np.asarray(
        800.0
        + 60.0 * np.sin(x / 700.0 + 0.4) * np.cos(y / 900.0)
        + 45.0 * np.sin((x + 1.7 * y) / 800.0)
        + 30.0 * np.cos((1.3 * x - y) / 450.0 + 1.0)
    )


def terrain(size: int = 241, sigma: float = 0.0) -> Map:
    """The hills on a grid in azimuthal metres."""
    half = 0.5 * (size - 1) * CELL
    rows, cols = np.mgrid[0:size, 0:size]
    values = hills(cols * CELL - half, half - rows * CELL).astype(np.float32)
    transform = (CELL, 0.0, -half - 0.5 * CELL, 0.0, -CELL, half + 0.5 * CELL)
    return Map(values=values, transform=transform, crs=CRS, sigma=sigma)


CHART = terrain()


def flown(
    chart: Map, error_m: FloatArray, *, n: int = 40, sigma: float = 2.0, heading: float = 0.7, seed: int | None = None
) -> Profile:
    """A straight profile of n readings, 80 m apart, about the middle of the map."""
    along = 80.0 * (np.arange(n) - 0.5 * n)
    lat, lon = shift(LAT0, LON0, along * np.cos(heading), along * np.sin(heading))
    value = chart.sample(lat, lon)
    if seed is not None:
        value = value + sigma * np.random.default_rng(seed).standard_normal(n)
    lat, lon = shift(lat, lon, error_m[0], error_m[1])
    epochs = [
        Epoch(float(k), float(lat[k]), float(lon[k]), 2000.0, measurements=(Measurement("terrain", float(v), sigma),))
        for k, v in enumerate(value)
    ]
    return Profile(tuple(epochs), "terrain")


def whole(found: Candidates) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance over all candidates."""
    p = found.probability
    mean = p @ found.ins_error_m
    off = found.ins_error_m - mean
    return mean, np.einsum("k,kij->ij", p, found.cov_m2) + np.einsum("k,ki,kj->ij", p, off, off)


PRIOR = Prior(np.array([40.0, -30.0]), np.diag([150.0**2, 110.0**2]))
ERROR = np.array([123.4, -87.6])


@pytest.mark.parametrize("metric", ["msd", "mad"])
@pytest.mark.parametrize("remove_mean", [False, True])
def test_the_surface_is_that_of_plain_numpy(metric: Any, remove_mean: bool) -> None:
    profile = flown(CHART, ERROR, n=12, seed=1)
    # readings of two kinds of quality, so that the weights matter
    told = [replace(m, sigma=s) for e, s in zip(profile.epochs, np.tile([1.0, 4.0], 6)) for m in e.measurements]
    profile = Profile(tuple(replace(e, measurements=(m,)) for e, m in zip(profile.epochs, told)), "terrain")
    surface = Tercom((CHART,), metric=metric, remove_mean=remove_mean, extent_sigma=2.0).surface(PRIOR, profile)

    n, e = np.meshgrid(surface.north_m, surface.east_m, indexing="ij")
    radius = float(np.hypot(np.abs(n).max(), np.abs(e).max()))
    frames = [CHART.local_frame(lat, lon, radius) for lat, lon in zip(profile.lat_deg, profile.lon_deg)]
    cells = [frame.cells(-n, -e) for frame in frames]
    values = CHART.values.astype(np.float64)
    expected = []
    for row, col in cells:
        i, j = np.floor(row).astype(int), np.floor(col).astype(int)
        u, v = row - i, col - j
        low = (1 - v) * values[i, j] + v * values[i, j + 1]
        high = (1 - v) * values[i + 1, j] + v * values[i + 1, j + 1]
        expected.append((1 - u) * low + u * high)
    difference = profile.value[:, None, None] - np.array(expected)
    weight = profile.sigma ** (-2.0 if metric == "msd" else -1.0)
    if remove_mean:
        difference = difference - np.average(difference, axis=0, weights=weight)
    cost = difference**2 if metric == "msd" else np.abs(difference)
    np.testing.assert_allclose(surface.score, np.average(cost, axis=0, weights=weight), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("metric", ["msd", "mad"])
@pytest.mark.parametrize("error", [(123.4, -87.6), (-12.0, 26.0), (3.1, 210.0)])
def test_without_noise_the_fix_is_within_a_hundredth_of_a_cell(metric: Any, error: tuple[float, float]) -> None:
    found = Tercom((CHART,), metric=metric).match(
        Prior(np.zeros(2), np.eye(2) * 200.0**2), flown(CHART, np.array(error), sigma=0.5)
    )
    assert np.abs(found.ins_error_m[0] - error).max() < 0.01 * CELL
    assert found.probability[0] > 0.999
    assert found.nis < 1e-2


def test_sub_cell_refines_what_the_grid_alone_gives() -> None:
    prior = Prior(np.zeros(2), np.eye(2) * 200.0**2)
    profile = flown(CHART, ERROR, seed=1)
    fine, grid = (Tercom((CHART,), sub_cell=flag).match(prior, profile) for flag in (True, False))
    assert np.hypot(*(fine.ins_error_m[0] - ERROR)) < 0.2 * CELL
    assert np.hypot(*(grid.ins_error_m[0] - ERROR)) < CELL
    assert np.linalg.eigvalsh(grid.cov_m2[0])[0] >= CELL**2 / 12.0 - 1e-9
    assert np.linalg.eigvalsh(fine.cov_m2[0])[1] < CELL**2 / 12.0


@pytest.mark.parametrize(("metric", "low", "high"), [("msd", 0.6, 1.25), ("mad", 0.45, 1.25)])
@pytest.mark.parametrize("sigma", [0.5, 5.0, 25.0])
def test_the_covariance_is_that_of_the_errors(metric: Any, low: float, high: float, sigma: float) -> None:
    """Mean NEES per axis of 60 fixed seeds: chi-square with 120 degrees of freedom, 99.9 % within 0.64 .. 1.46.

    It lies below one by design: residuals above the told sigma widen the covariance, residuals below do not narrow it.
    """
    rng = np.random.default_rng(42)
    matcher, nees = Tercom((CHART,), metric=metric), []
    for seed in range(60):
        error = rng.normal(0.0, 150.0, 2)
        profile = flown(CHART, error, n=30, sigma=sigma, heading=rng.uniform(0.0, 2 * np.pi), seed=seed)
        mean, cov = whole(matcher.match(Prior(np.zeros(2), np.eye(2) * 150.0**2), profile))
        off = mean - error
        nees.append(off @ np.linalg.solve(cov, off) / 2.0)
    assert low < np.mean(nees) < high


def test_readings_noisier_than_told_widen_the_covariance() -> None:
    prior = Prior(np.zeros(2), np.eye(2) * 150.0**2)
    profile = flown(CHART, ERROR, sigma=6.0, seed=2)
    quiet = [replace(e, measurements=(replace(e.measurements[0], sigma=2.0),)) for e in profile.epochs]
    honest = Tercom((CHART,)).match(prior, profile)
    misled = Tercom((CHART,)).match(prior, Profile(tuple(quiet), "terrain"))
    assert misled.nis == pytest.approx(9.0 * honest.nis, rel=0.05)
    assert np.trace(misled.cov_m2[0]) == pytest.approx(np.trace(honest.cov_m2[0]), rel=0.2)


def test_flat_ground_returns_the_prior() -> None:
    flat = replace(CHART, values=np.full(CHART.shape, 100.0))
    found = Tercom((flat,)).match(PRIOR, flown(flat, ERROR, seed=4))
    mean, cov = whole(found)
    np.testing.assert_allclose(mean, PRIOR.mean_m, atol=1.0)
    np.testing.assert_allclose(np.diag(cov), np.diag(PRIOR.cov_m2), rtol=0.01)


def test_terrain_that_repeats_gives_two_candidates_and_a_wide_whole() -> None:
    size, period = 201, 600.0
    rows, cols = np.mgrid[0:size, 0:size]
    x, y = cols * CELL, rows * CELL
    values = 500.0 + 50.0 * np.sin(2 * np.pi * x / period) * np.cos(2 * np.pi * y / period)
    half = 0.5 * (size - 1) * CELL
    chart = Map(values, (CELL, 0.0, -half - 0.5 * CELL, 0.0, -CELL, half + 0.5 * CELL), crs=CRS, sigma=0.0)
    found = Tercom((chart,)).match(Prior(np.zeros(2), np.eye(2) * 300.0**2), flown(chart, np.array([30.0, 20.0])))
    assert len(found.probability) >= 3
    assert found.probability[0] < 0.9
    assert np.isclose(found.probability.sum(), 1.0)
    assert (np.diff(found.probability) <= 0.0).all()
    away = found.ins_error_m[:, None] - found.ins_error_m[None]
    assert (np.abs(away).max(axis=2) + 1e3 * np.eye(len(away)) > 2.9 * CELL).all()
    assert np.sqrt(np.trace(whole(found)[1])) > 100.0


def test_an_offset_of_height_is_harmless_once_the_mean_is_removed() -> None:
    profile = flown(CHART, ERROR, seed=3)
    raised = [
        replace(e, measurements=(replace(m, value=m.value + 40.0),)) for e in profile.epochs for m in e.measurements
    ]
    matcher = Tercom((CHART,), remove_mean=True)
    prior = Prior(np.zeros(2), np.eye(2) * 150.0**2)
    level, high = matcher.match(prior, profile), matcher.match(prior, Profile(tuple(raised), "terrain"))
    np.testing.assert_allclose(high.ins_error_m[0], level.ins_error_m[0], atol=1e-5)
    np.testing.assert_allclose(high.cov_m2[0], level.cov_m2[0], rtol=1e-5)
    assert np.hypot(*(high.ins_error_m[0] - ERROR)) < 0.2 * CELL


def test_a_few_voids_do_no_harm_and_too_many_exclude_a_place() -> None:
    values = CHART.values.copy()
    profile = flown(CHART, ERROR, sigma=0.5)
    rows, cols = CHART.cells(*shift(profile.lat_deg, profile.lon_deg, -ERROR[0], -ERROR[1]))
    for k in (5, 20, 33):  # under the true track
        values[int(rows[k]), int(cols[k])] = np.nan
    prior = Prior(np.zeros(2), np.eye(2) * 150.0**2)
    holed = Tercom((replace(CHART, values=values),))
    assert np.abs(holed.match(prior, profile).ins_error_m[0] - ERROR).max() < 0.02 * CELL
    values[:, : CHART.shape[1] // 2] = np.nan  # the western half
    surface = Tercom((replace(CHART, values=values),)).surface(prior, flown(CHART, np.zeros(2), heading=0.0))
    assert np.isnan(surface.score[:, surface.east_m > 2 * CELL]).all()
    assert np.isfinite(surface.score[:, surface.east_m < -2 * CELL]).all()


def test_off_the_map_there_is_no_candidate() -> None:
    found = Tercom((CHART,)).match(PRIOR, flown(CHART, np.array([20_000.0, 0.0])))
    assert len(found.probability) == 0
    assert found.ins_error_m.shape == (0, 2)
    assert found.cov_m2.shape == (0, 2, 2)
    assert np.isnan(found.nis)


def test_the_posterior_is_a_distribution_about_the_fix() -> None:
    found = Tercom((CHART,)).match(PRIOR, flown(CHART, ERROR, sigma=20.0, seed=9))
    drawn = found.posterior
    assert drawn is not None
    assert drawn.weight.shape == (drawn.north_m.size, drawn.east_m.size)
    assert drawn.weight.sum() == pytest.approx(1.0)
    centre = [drawn.weight.sum(axis=1) @ drawn.north_m, drawn.weight.sum(axis=0) @ drawn.east_m]
    np.testing.assert_allclose(centre, whole(found)[0], atol=0.1 * CELL)


def test_a_uniform_prior_is_searched_over_its_rectangle() -> None:
    prior = Prior(np.zeros(2), np.diag([100.0**2, 200.0**2]), "uniform")
    surface = Tercom((CHART,)).surface(prior, flown(CHART, ERROR))
    np.testing.assert_allclose(surface.north_m[[0, -1]], [-300.0, 300.0])
    np.testing.assert_allclose(surface.east_m[[0, -1]], [-600.0, 600.0])


def test_a_search_area_beyond_the_limit_is_searched_in_coarser_steps() -> None:
    prior = Prior(np.zeros(2), np.eye(2) * 400.0**2)
    matcher = Tercom((CHART,), max_cells=1500)
    profile = flown(CHART, ERROR, seed=8)
    surface = matcher.surface(prior, profile)
    assert surface.score.size <= 1500
    assert surface.step_m > 1.5 * CELL
    assert np.hypot(*(matcher.match(prior, profile).ins_error_m[0] - ERROR)) < 0.2 * CELL


def test_the_same_profile_gives_the_same_bits_and_pickles() -> None:
    matcher, profile = Tercom((CHART,)), flown(CHART, ERROR, seed=1)
    assert isinstance(matcher, Matcher)
    once, again = matcher.match(PRIOR, profile), pickle.loads(pickle.dumps(matcher)).match(PRIOR, profile)
    assert once.ins_error_m.tobytes() == again.ins_error_m.tobytes()
    assert once.cov_m2.tobytes() == again.cov_m2.tobytes()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"metric": "mse"}, "unknown tercom metric 'mse' .did you mean 'msd'"),
        ({"cell_m": 0.0}, "tercom cell_m is 0.0, expected a finite number and > 0"),
        ({"extent_sigma": 0.5}, "tercom extent_sigma is 0.5, expected"),
        ({"max_cells": 10}, "tercom max_cells is 10, expected"),
        ({"maps": ()}, "tercom maps is empty"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Tercom(**{"maps": (CHART,), **settings})


def test_a_profile_that_cannot_be_matched_is_named() -> None:
    with pytest.raises(DataError, match="the profile has 3 readings, expected at least 4"):
        Tercom((CHART,)).match(PRIOR, flown(CHART, ERROR, n=3))
    with pytest.raises(ConfigError, match="maps are of kind terrain, expected one of the profile's kind 'gravity'"):
        Tercom((CHART,)).match(PRIOR, Profile((), "gravity"))

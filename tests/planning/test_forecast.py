"""The forecast: the bound over a plane, and the best estimator by brute force where the ground is none."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import ConfigError, DataError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.core.records import Prior
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map
from terranav.planning.bound import bound
from terranav.planning.forecast import Forecast, forecast

FloatArray = NDArray[np.float64]

INS = InsGrade(400.0, 0.5, 1.0)
STILL = InsGrade(150.0, 0.0, 0.0)  # an INS error that does not change


def flight(chart: Map, epochs: int, sigma: float) -> Recording:
    """A straight flight over the middle of a map, its position true, oblique to its cells."""
    away = 100.0 * (np.arange(epochs) - 0.5 * epochs)
    lat, lon = shift(*chart.centre_deg, 0.83 * away, 0.56 * away)
    columns = {
        "time_s": 2.0 * np.arange(epochs), "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(epochs, 2000.0),
        "true_lat_deg": lat, "true_lon_deg": lon, "true_alt_m": np.full(epochs, 2000.0),
        "terrain_m": chart.sample(lat, lon),
    }  # fmt: skip
    return Recording(columns, sigma={"terrain_m": sigma}, name="flight")


def largest(cov_m2: FloatArray) -> float:
    return math.sqrt(float(np.linalg.eigvalsh(cov_m2)[-1]))


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_is_the_bound_over_a_plane(share: float) -> None:
    """Bias and its walk, patch, drift and the cost of outliers included."""
    chart = plane_map(0.25, -0.125, cells=401, cell_m=90.0, sigma=3.0, centre_deg=(20.0, 10.0))
    rec = flight(chart, 80, 4.0)
    told: dict[str, Any] = {"outlier_share": share, "bias_sigma": {"terrain": 5.0}}
    found, lowest = (ask(rec, chart, INS, **told) for ask in (forecast, bound))
    assert isinstance(found, Forecast)
    assert len(found) == len(rec)
    up = np.array([0.25, -0.125]) / math.hypot(0.25, 0.125)
    ratio = np.einsum("i,nij,j->n", up, found.cov_m2, up) / np.einsum("i,nij,j->n", up, lowest.cov_m2, up)
    np.testing.assert_allclose(np.sqrt(ratio[1:]), 1.0, atol=0.06)  # the first reading may be the outlier
    assert found.drms_m[-1] == pytest.approx(lowest.drms_m[-1], rel=0.05)


def by_brute_force(chart: Map, rec: Recording, sigma: float, draws: int) -> FloatArray:
    """Mean posterior covariance (2, 2) of a constant INS error: a fine grid, many draws of errors and readings."""
    rng = np.random.default_rng(8)
    s = STILL.position_sigma_m
    side = np.arange(-4.2 * s, 4.2 * s, s / 12.0)
    away = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)  # guess less true error
    lat, lon = shift(rec.lat_deg[:, None], rec.lon_deg[:, None], -away[:, 0], -away[:, 1])
    misfit = (chart.sample(lat, lon) - chart.sample(rec.lat_deg, rec.lon_deg)[:, None]) / sigma
    cov = np.zeros((2, 2))
    for _ in range(draws):
        error, noise = rng.normal(0.0, s, 2), rng.standard_normal(len(rec))
        exponent = noise @ misfit - 0.5 * np.sum(misfit**2, axis=0) - 0.5 * np.sum((away + error) ** 2, axis=1) / s**2
        weight = np.exp(exponent - exponent.max())
        weight /= weight.sum()
        about = away - weight @ away
        cov += (weight[:, None] * about).T @ about / draws
    return cov


def ground(kind: str) -> Map:
    """Rolling hills, fine rough ground, or hills that repeat themselves every 400 m to the east."""
    if kind != "repeating":
        length = {"rolling": 500.0, "rough": 150.0}[kind]
        return gaussian_map(np.random.default_rng(5), std=40.0, correlation_m=length, cell_m=40.0, cells=301, sigma=0.0)
    chart = gaussian_map(np.random.default_rng(6), std=40.0, correlation_m=300.0, cell_m=40.0, cells=301, sigma=0.0)
    return replace(chart, values=np.tile(chart.values[:, :10], (1, 31))[:, :301])


@pytest.mark.parametrize(
    ("kind", "sigma", "epochs", "within"),
    [("rolling", 40.0, 25, 0.06), ("rough", 60.0, 40, 0.25), ("repeating", 30.0, 25, 0.06)],
)
def test_is_the_error_of_the_best_estimator(kind: str, sigma: float, epochs: int, within: float) -> None:
    """Where the bound is too low; on the rough ground some draws find another place, of which too few are foreseen."""
    chart = ground(kind)
    rec = flight(chart, epochs, sigma)
    told: dict[str, Any] = {"outlier_share": 0.0, "blur_cells": 0.0, "bias_sigma": {"terrain": 0.0}}
    best = by_brute_force(chart, rec, sigma, 150)
    found, lowest = (ask(rec, chart, STILL, **told) for ask in (forecast, bound))
    assert largest(found.cov_m2[-1]) == pytest.approx(largest(best), rel=within)
    assert largest(lowest.cov_m2[-1]) < 0.9 * largest(best)


def test_the_same_seed_gives_the_same_and_flat_land_teaches_nothing() -> None:
    chart = plane_map(0.0, 0.0, cells=201, cell_m=90.0, sigma=3.0, centre_deg=(20.0, 10.0))
    rec = flight(chart, 20, 4.0)
    first, again, other = (forecast(rec, chart, INS, seed=seed, repeats=1) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.cov_m2, again.cov_m2)
    assert not np.array_equal(first.cov_m2, other.cov_m2)
    unaided = bound(rec, chart, INS)
    np.testing.assert_allclose(first.sigma_m, unaided.sigma_m, rtol=0.05)
    narrow = forecast(rec, chart, INS, prior=Prior(np.array([90.0, 0.0]), np.diag([30.0**2, 60.0**2])), repeats=1)
    np.testing.assert_allclose(narrow.sigma_m[0], [30.0, 60.0], rtol=0.02)


def test_a_map_across_the_antimeridian() -> None:
    """The part that is kept of it reaches over it too."""
    told = []
    for lon in (10.0, 180.0):
        chart = plane_map(0.2, 0.1, cells=301, cell_m=90.0, sigma=3.0, centre_deg=(-17.0, lon))
        told.append(forecast(flight(chart, 30, 4.0), chart, INS, repeats=1).drms_m[-1])
    assert told[0] == pytest.approx(told[1], rel=0.01)


def test_wrong_use_is_one_line() -> None:
    chart = plane_map(0.2, 0.1, cells=201, cell_m=90.0, sigma=3.0, centre_deg=(20.0, 10.0))
    rec = flight(chart, 10, 4.0)
    blind = Recording(
        {key: rec.columns[key] for key in ("time_s", "lat_deg", "lon_deg", "alt_m", "terrain_m")}, name="x"
    )
    with pytest.raises(StateError, match=r"^x: the forecast needs the true track"):
        forecast(blind, chart, INS)
    with pytest.raises(DataError, match="no map is given"):
        forecast(rec, [], INS)
    wrongs: tuple[dict[str, Any], ...] = (
        {"outlier_share": 0.7},
        {"blur_cells": -1.0},
        {"repeats": 0},
        {"repeats": True},
        {"seed": -1},
    )
    for wrong in wrongs:
        with pytest.raises(ConfigError, match=f"forecast {next(iter(wrong))} is"):
            forecast(rec, chart, INS, **wrong)

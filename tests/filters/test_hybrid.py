"""The hybrid's weights against hand-worked cases, and its limits: one map, equal maps, a map without readings."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior, Status
from terranav.experiment.stream import states
from terranav.filters.hybrid import (
    Hybrid,
    HybridState,
    _mixed,
    mixed_moments,
    normalised,
    position_kurtosis,
    value_kurtosis,
)
from terranav.filters.pointmass import Grid, PointMass
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map

INS = InsGrade(position_sigma_m=200.0, velocity_sigma_mps=0.1, position_walk_m_per_sqrt_s=0.3)
PRIOR = Prior.from_ins(INS)
ERROR_M = np.array([130.0, -170.0])
TERRAIN = gaussian_map(np.random.default_rng(1), std=60.0, correlation_m=500.0, cells=201, cell_m=60.0, sigma=3.0)
GRAVITY = gaussian_map(
    np.random.default_rng(2),
    std=15.0,
    correlation_m=4000.0,
    mean=0.0,
    cells=41,
    cell_m=400.0,
    kind="gravity",
    sigma=0.3,
)
SIGMA = {"terrain": 3.0, "gravity": 0.5}


def flight(maps: tuple[Map, ...], steps: int = 80) -> list[Epoch]:
    rng, epochs = np.random.default_rng(7), []
    for k in range(steps):
        lat, lon = shift(*TERRAIN.centre_deg, -1500.0 + 40.0 * k, -1200.0 + 30.0 * k)
        told = shift(lat, lon, *ERROR_M)
        readings = tuple(
            Measurement(m.kind, float(m.sample(lat, lon)) + SIGMA[m.kind] * rng.standard_normal(), SIGMA[m.kind])
            for m in maps
        )
        epochs.append(Epoch(float(k), float(told[0]), float(told[1]), 1500.0, measurements=readings))
    return epochs


def flown(hybrid: Hybrid, epochs: list[Epoch]) -> list[HybridState]:
    return list(states(hybrid, PRIOR, epochs, np.random.default_rng(0)))


def gaussian(sigma_north: float, sigma_east: float, cell_m: float = 2.0, half: int = 100) -> Grid:
    at = cell_m * np.arange(-half, half + 1)
    density = np.exp(-0.5 * (at[:, None] / sigma_north) ** 2 - 0.5 * (at / sigma_east) ** 2)
    return Grid(-half * cell_m, -half * cell_m, cell_m, density / density.sum())


def test_kurtosis_by_hand() -> None:
    """A 2 x 2 grid with all in one cell: mean 1/4, deviations 3/4 and three times -1/4, sigma^2 = (12/16)/3 = 1/4."""
    peaked = np.array([[1.0, 0.0], [0.0, 0.0]])
    assert value_kurtosis(peaked, 4) == pytest.approx((81 + 3) / 256 / 4 / (1 / 16))  # 1.3125
    # (1/2, 1/2, 0, 0): deviations +-1/4, sigma^2 = (4/16)/3 = 1/12
    broad = np.array([[0.5, 0.5], [0.0, 0.0]])
    assert value_kurtosis(broad, 4) == pytest.approx(1 / 256 / (1 / 144))  # 0.5625
    np.testing.assert_allclose(normalised([1.3125, 0.5625]), [0.7, 0.3])
    assert value_kurtosis(broad[:1], 4) == value_kurtosis(broad, 4)  # cells beyond the grid hold zero


def test_uniform_density_has_the_least_kurtosis() -> None:
    assert value_kurtosis(np.full((5, 7), 1 / 35), 35) == 1.0


@pytest.mark.parametrize("sigmas", [(20.0, 20.0), (10.0, 40.0), (15.0, 8.0)])
def test_kurtosis_of_a_gaussian_is_area_over_its_ellipse(sigmas: tuple[float, float]) -> None:
    area_m2 = 4000.0**2
    found = value_kurtosis(gaussian(*sigmas).density, area_m2 / 2.0**2)
    assert found == pytest.approx(area_m2 / (2.0 * math.pi * sigmas[0] * sigmas[1]), rel=0.01)
    assert position_kurtosis(gaussian(*sigmas)) == pytest.approx(3.0, rel=0.02)


def test_mixed_moments_hold_the_spread() -> None:
    mean, cov = mixed_moments(
        np.array([0.25, 0.75]), [np.array([0.0, 0.0]), np.array([40.0, 0.0])], [np.eye(2) * 4.0, np.eye(2) * 8.0]
    )
    np.testing.assert_allclose(mean, [30.0, 0.0])
    np.testing.assert_allclose(cov, [[7.0 + 0.25 * 900.0 + 0.75 * 100.0, 0.0], [0.0, 7.0]])


def test_mixed_density_has_the_mixed_moments() -> None:
    near, far = gaussian(12.0, 8.0), replace(gaussian(25.0, 30.0, cell_m=3.0), south_m=-220.0)
    grid = _mixed(np.array([0.3, 0.7]), [near, far], 40_000)
    mean, _ = mixed_moments(np.array([0.3, 0.7]), [np.zeros(2), np.array([80.0, 0.0])], [np.eye(2), np.eye(2)])
    assert grid.density.sum() == pytest.approx(1.0)
    assert grid.density.sum(axis=1) @ grid.north_m == pytest.approx(mean[0], abs=0.1)
    assert grid.density.sum(axis=0) @ grid.east_m == pytest.approx(0.0, abs=0.1)


def test_a_peak_between_two_cells_is_not_lost() -> None:
    needle = Grid(1.0, 1.0, 0.01, np.array([[0.2, 0.2, 0.0], [0.2, 0.4, 0.0]]))
    grid = _mixed(np.array([0.5, 0.5]), [gaussian(50.0, 50.0, cell_m=10.0), needle], 400)
    assert grid.density.max() > 0.5
    assert grid.density.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("feedback", [False, True])
def test_with_one_map_it_is_pointmass(feedback: bool) -> None:
    epochs = flight((TERRAIN,), 40)
    hybrid, plain = Hybrid((TERRAIN,), INS, feedback=feedback), PointMass((TERRAIN,), INS)
    mixed = flown(hybrid, epochs)
    for state, own in zip(mixed, states(plain, PRIOR, epochs, np.random.default_rng(0)), strict=True):
        one, other = hybrid.estimate(state), plain.estimate(own)
        assert one.ins_error_m.tolist() == other.ins_error_m.tolist()
        assert one.cov_m2.tolist() == other.cov_m2.tolist()
        assert (one.status, state.weights.tolist()) == (other.status, [1.0])


@pytest.mark.parametrize("settings", [{}, {"kurtosis": "own"}, {"kurtosis": "position"}, {"feedback": True}])
def test_two_maps_find_the_error(settings: dict[str, Any]) -> None:
    hybrid = Hybrid((TERRAIN, GRAVITY), INS, **settings)
    last = flown(hybrid, flight((TERRAIN, GRAVITY)))
    for state in last:
        assert state.weights.sum() == pytest.approx(1.0)
        assert np.linalg.eigvalsh(state.cov_m2)[0] > 0.0
    estimate = hybrid.estimate(last[-1])
    assert np.hypot(*(estimate.ins_error_m - ERROR_M)) < 3.0 * np.sqrt(np.trace(estimate.cov_m2))
    assert np.hypot(*(estimate.ins_error_m - ERROR_M)) < 120.0
    shown = hybrid.posterior(last[-1])
    assert shown.weight.sum() == pytest.approx(1.0)
    north = float(shown.weight.sum(axis=1) @ shown.north_m)
    assert north == pytest.approx(estimate.ins_error_m[0], abs=0.2 * math.sqrt(estimate.cov_m2[0, 0]))


def test_the_sharper_posterior_weighs_more() -> None:
    hybrid = Hybrid((TERRAIN, GRAVITY), INS)
    last = flown(hybrid, flight((TERRAIN, GRAVITY)))[-1]
    dets: NDArray[np.float64] = np.array([np.linalg.det(part.cov_m2) for part in last.parts])
    assert np.argmax(last.weights) == np.argmin(dets)


def test_a_map_without_readings_does_not_count() -> None:
    hybrid, plain = Hybrid((TERRAIN, GRAVITY), INS), PointMass((TERRAIN,), INS)
    epochs = flight((TERRAIN,), 30)
    states_ = flown(hybrid, epochs)
    *_, own = states(plain, PRIOR, epochs, np.random.default_rng(0))
    assert states_[-1].weights.tolist() == [1.0, 0.0]
    np.testing.assert_allclose(states_[-1].mean_m, own.mean_m, atol=1e-9)


def test_off_both_maps_is_off_map() -> None:
    hybrid = Hybrid((TERRAIN, GRAVITY), INS)
    away = [
        replace(epoch, lat_deg=epoch.lat_deg + 3.0, measurements=epoch.measurements)
        for epoch in flight((TERRAIN, GRAVITY), 5)
    ]
    assert hybrid.estimate(flown(hybrid, away)[-1]).status is Status.OFF_MAP


@pytest.mark.parametrize(
    ("maps", "settings", "words"),
    [
        ((), {}, "hybrid maps are of kinds"),
        ((TERRAIN, TERRAIN), {}, "one map of each kind"),
        ((TERRAIN,), {"kurtosis": "commn"}, "did you mean 'common'"),
        ((TERRAIN,), {"feedback": 1}, "true or false"),
        ((TERRAIN,), {"outlier_share": -0.1}, "outlier_share"),
        ((plane_map(0.1, 0.0),), {"max_cells": 3}, "max_cells"),
    ],
)
def test_impossible_settings(maps: tuple[Map, ...], settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Hybrid(maps, INS, **settings)

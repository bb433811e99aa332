"""Smoothers against the Rauch-Tung-Striebel smoother on a plane, and the laws of looking back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Estimate, Measurement, Prior, Status
from terranav.filters._replay import flown
from terranav.filters._smoothing import Smoothed, can_be_smoothed, smooth_epochs
from terranav.filters.marginalized import Marginalized, MarginalizedState
from terranav.filters.pointmass import PointMass
from terranav.filters.sitan import Sitan
from terranav.ins.error_state import ErrorModel
from terranav.kernels.backward import trace_back
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
SLOPE = np.array([0.25, -0.125])
SIGMA_M = 4.0
#: what is linear and Gaussian in the navigator, and nothing more
LINEAR: dict[str, Any] = {
    "outlier_share": 0.0,
    "blur_cells": 0.0,
    "registration_cells": 0.0,
    "adapt_noise": False,
    "adapt_walk": False,
    "least_particles": 8000,
}


def track(
    chart: Map, error_m: FloatArray, time_s: FloatArray, read: Sequence[bool] | NDArray[np.bool_], rng: Generator
) -> list[Epoch]:
    """A straight flight over the middle of a map at 50 m/s whose INS is off by `error_m` (n, 2)."""
    along = 40.0 * (time_s - time_s.mean())
    lat, lon = shift(*chart.centre_deg, along, 0.7 * along)
    told = shift(lat, lon, *error_m.T)
    value = chart.sample(lat, lon) + SIGMA_M * rng.standard_normal(time_s.size)
    return [
        Epoch(
            float(t), float(a), float(o), 2000.0, measurements=(Measurement("terrain", float(v), SIGMA_M),) if r else ()
        )
        for t, a, o, v, r in zip(time_s, *told, value, read, strict=True)
    ]


def both(estimator: Any, epochs: Sequence[Epoch], prior: Prior, seed: int = 0) -> Smoothed:
    rng, back = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
    return smooth_epochs(estimator, prior, epochs, rng, backward_rng=back)


def moments(estimates: Sequence[Estimate]) -> tuple[FloatArray, FloatArray]:
    return np.array([one.ins_error_m for one in estimates]), np.array([one.cov_m2 for one in estimates])


def rauch_tung_striebel(
    x: FloatArray, cov: FloatArray, h: FloatArray, steps: list[tuple[FloatArray, FloatArray]], seen: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Smoothed means (n, d) and covariances (n, d, d); `seen` (n,) are the readings, NaN where there is none."""
    past, ahead = [], []
    for k, value in enumerate(seen):
        if k:
            phi, q = steps[k - 1]
            x, cov = phi @ x, phi @ cov @ phi.T + q
        ahead.append((x, cov))
        if np.isfinite(value):
            gain = cov @ h / (h @ cov @ h + SIGMA_M**2)
            x, cov = x + gain * (value - h @ x), cov - np.outer(gain, h @ cov)
        past.append((x, cov))
    found = [past[-1]]
    for k in reversed(range(len(seen) - 1)):
        (m, p), (m1, p1), (x, cov) = past[k], ahead[k + 1], found[0]
        gain = p @ steps[k][0].T @ np.linalg.pinv(p1, rcond=1e-13, hermitian=True)
        found.insert(0, (m + gain @ (x - m1), p + gain @ (cov - p1) @ gain.T))
    return np.array([m for m, _ in found]), np.array([p for _, p in found])


def agrees(found: Smoothed, mean: FloatArray, cov: FloatArray, of_mean: float, of_sigma: float) -> None:
    """Means within a share of the sigma, along each axis of the covariance; sigmas within a share."""
    got, claimed = moments(found.smoothed)
    for k in range(len(got)):
        values, axes = np.linalg.eigh(cov[k])
        off = axes.T @ (got[k] - mean[k]) / np.sqrt(values)
        ratio = np.sqrt(np.diag(axes.T @ claimed[k] @ axes) / values)
        assert np.abs(off).max() < of_mean, (k, off, ratio)
        assert np.abs(ratio - 1.0).max() < of_sigma, (k, off, ratio)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_pointmass_is_the_rts_smoother_on_a_plane(seed: int) -> None:
    ins = InsGrade(200.0, 0.0, 4.0)
    rng, chart = np.random.default_rng(seed), plane_map(*SLOPE, cells=301, cell_m=90.0, sigma=0.0)
    time_s = np.cumsum(rng.choice([0.5, 1.0, 2.0, 20.0], 40, p=[0.2, 0.5, 0.25, 0.05]))
    steps = [(np.eye(2), np.eye(2) * 16.0 * dt) for dt in np.diff(time_s)]
    error = rng.normal(0.0, 200.0, 2) + np.cumsum(rng.normal(0.0, 4.0, (40, 2)), axis=0)
    epochs = track(chart, error, time_s, rng.random(40) < 0.6, rng)
    found = both(PointMass((chart,), ins, outlier_share=0.0), epochs, Prior.from_ins(ins))
    mean, cov = rauch_tung_striebel(np.zeros(2), np.eye(2) * 200.0**2, -SLOPE, steps, seen(chart, epochs))
    agrees(found, mean, cov, of_mean=0.05, of_sigma=0.02)


@pytest.mark.parametrize("map_sigma", [0.0, 3.0])
@pytest.mark.parametrize("ins", [InsGrade(200.0, 0.5, 1.0), InsGrade(200.0, 0.5, 3.0, 0.02), InsGrade(200.0, 0.0, 2.0)])
def test_marginalized_is_the_rts_smoother_on_a_plane(ins: InsGrade, map_sigma: float) -> None:
    rng, chart = np.random.default_rng(5), plane_map(*SLOPE, cells=301, cell_m=90.0, sigma=map_sigma)
    time_s = np.cumsum(rng.choice([1.0, 2.0, 20.0], 40, p=[0.6, 0.3, 0.1]))
    error = rng.normal(0.0, 200.0, 2) + time_s[:, None] * rng.normal(0.0, 0.4, 2)
    epochs = track(chart, error, time_s, rng.random(40) < 0.6, rng)
    settings = {**LINEAR, "bias_sigma": {"terrain": 5.0}}
    found = both(Marginalized((chart,), ins, **settings), epochs, Prior.from_ins(ins))
    model = ErrorModel(ins, (chart,), "position", {"terrain": 5.0})
    links = [model.transition(a, b) for a, b in pairwise(epochs)]
    mean, cov = rauch_tung_striebel(
        np.zeros(6),
        model.initial_covariance(np.eye(2) * 200.0**2),
        np.array([*-SLOPE, 0.0, 0.0, 1.0, 1.0]),
        [(one.phi, one.q) for one in links],
        seen(chart, epochs),
    )
    agrees(found, mean[:, :2], cov[:, :2, :2], of_mean=0.3, of_sigma=0.15)  # 8000 particles


def seen(chart: Map, epochs: Sequence[Epoch]) -> FloatArray:
    """Readings less the map at the indicated position, NaN where there is none."""
    return np.array(
        [
            one.measurements[0].value - chart.sample(one.lat_deg, one.lon_deg) if one.measurements else np.nan
            for one in epochs
        ],
        dtype=np.float64,
    )


def rough() -> Map:
    return gaussian_map(np.random.default_rng(3), std=60.0, correlation_m=400.0, cells=241, cell_m=50.0, sigma=1.0)


def smoothers(chart: Map, ins: InsGrade) -> list[Any]:
    return [Marginalized((chart,), ins, particles=6000, least_particles=1000), PointMass((chart,), ins)]


@pytest.mark.parametrize("which", [0, 1])
def test_an_error_that_stands_still_is_the_same_at_every_epoch(which: int) -> None:
    """Nothing moves, so what is known at the end was true from the start: the covariance of a step is singular."""
    ins, chart, rng = InsGrade(200.0, 0.0, 0.0), rough(), np.random.default_rng(2)
    error = np.broadcast_to([130.0, -90.0], (40, 2))
    epochs = track(chart, error, np.arange(40.0), np.arange(40) % 2 == 0, rng)
    found = both(smoothers(chart, ins)[which], epochs, Prior.from_ins(ins))
    mean, cov = moments(found.smoothed)
    last = np.sqrt(np.diag(moments(found.filtered)[1][-1]))
    assert np.abs(mean - error).max() < 25.0
    assert np.abs((mean - mean[-1]) / last).max() < 0.5
    assert np.abs(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)) / last - 1.0).max() < 0.3


@pytest.mark.parametrize("which", [0, 1])
def test_from_the_last_reading_on_it_is_the_filter(which: int) -> None:
    ins, chart, rng = InsGrade(200.0, 0.3, 1.0), rough(), np.random.default_rng(2)
    error = np.array([100.0, 50.0]) + np.arange(50.0)[:, None] * [0.2, -0.1]
    epochs = track(chart, error, np.arange(50.0), np.arange(50) <= 40, rng)
    found = both(smoothers(chart, ins)[which], epochs, Prior.from_ins(ins))
    same = [np.array_equal(a.cov_m2, b.cov_m2) for a, b in zip(found.filtered, found.smoothed)]
    assert not any(same[:40])
    assert same[-1]
    if which == 0:  # in closed form; on a grid the same to the rounding of a convolution
        assert all(same[40:])
    later, before = moments(found.smoothed[40:]), moments(found.filtered[40:])
    assert np.allclose(later[0], before[0], atol=0.02)
    assert np.allclose(later[1], before[1], rtol=2e-3, atol=0.05)


@pytest.mark.parametrize("which", [0, 1])
def test_one_reading_only(which: int) -> None:
    ins, chart, rng = InsGrade(200.0, 0.3, 1.0), rough(), np.random.default_rng(2)
    epochs = track(chart, np.zeros((20, 2)), np.arange(20.0), np.arange(20) == 10, rng)
    found = both(smoothers(chart, ins)[which], epochs, Prior.from_ins(ins))
    mean, cov = moments(found.smoothed)
    assert np.isfinite(mean).all()
    spread = np.sqrt(np.linalg.det(cov))
    assert np.ptp(spread[:10]) < 0.03 * spread[10]  # an error that hardly moves in 10 s is known as well before
    one = both(smoothers(chart, ins)[which], epochs[10:11], Prior.from_ins(ins))
    assert np.array_equal(one.smoothed[0].cov_m2, one.filtered[0].cov_m2)


@pytest.mark.parametrize("which", [0, 1])
def test_flat_land_teaches_nothing(which: int) -> None:
    ins, chart, rng = InsGrade(200.0, 0.3, 1.0), plane_map(0.0, 0.0, cells=201, cell_m=90.0), np.random.default_rng(2)
    epochs = track(chart, np.zeros((60, 2)), np.arange(60.0), [True] * 60, rng)
    found = both(smoothers(chart, ins)[which], epochs, Prior.from_ins(ins))
    mean, cov = moments(found.smoothed)
    expected = moments(found.filtered)[1]
    assert np.abs(mean).max() < 25.0  # 1/8 sigma
    ratio = np.sqrt(np.diagonal(cov, axis1=1, axis2=2) / np.diagonal(expected, axis1=1, axis2=2))
    assert ratio.min() > 0.9
    assert ratio.max() < 1.1


@pytest.mark.parametrize("which", [0, 1])
def test_off_the_map_it_is_bridged(which: int) -> None:
    """Readings over a void in the middle: the smoothed error there is held by both ends."""
    ins, chart, rng = InsGrade(200.0, 0.5, 1.0), rough(), np.random.default_rng(2)
    error = np.array([100.0, 50.0]) + np.arange(120.0)[:, None] * [0.4, -0.3]
    epochs = track(chart, error, np.arange(120.0), [True] * 120, rng)
    values = np.array(chart.values)
    values[105:135, :] = np.nan
    holed = replace(chart, values=values)
    found = both(smoothers(holed, ins)[which], epochs, Prior.from_ins(ins))
    assert any(one.status is Status.OFF_MAP for one in found.smoothed)
    (_, before), (mean, after) = moments(found.filtered), moments(found.smoothed)
    assert np.isfinite(mean).all()
    assert (np.trace(after[40:80], axis1=1, axis2=2) <= 1.1 * np.trace(before[40:80], axis1=1, axis2=2)).all()
    assert np.hypot(*(mean - error).T).max() < 60.0


@dataclass(frozen=True)
class Watching:
    """Starts the navigator anew at one time, as an integrity monitor does."""

    estimator: Marginalized
    at_s: float

    def init(self, prior: Prior, rng: Generator) -> Watched:
        return Watched(self.estimator.init(prior, rng))

    def step(self, state: Watched, epoch: Epoch, rng: Generator) -> Watched:
        inner = self.estimator.step(state.inner, epoch, rng)
        if epoch.time_s == self.at_s:
            inner = self.estimator.restarted(inner, Prior(np.zeros(2), np.eye(2) * 1000.0**2), rng)
        return Watched(inner)

    def estimate(self, state: Watched) -> Estimate:
        return self.estimator.estimate(state.inner)


@dataclass(frozen=True)
class Watched:
    inner: MarginalizedState


def test_a_restart_breaks_the_chain() -> None:
    """The INS jumps by 1 km and the filter is started anew: what comes after says nothing of what was before."""
    ins, chart, rng = InsGrade(200.0, 0.3, 1.0), rough(), np.random.default_rng(2)
    error = np.full((100, 2), 80.0)
    error[50:] += [800.0, -700.0]
    epochs = track(chart, error, np.arange(100.0), [True] * 100, rng)
    method = Marginalized((chart,), ins, particles=20_000, least_particles=1000)
    found = both(Watching(method, 50.0), epochs, Prior.from_ins(ins))
    before, after = found.filtered[49], found.smoothed[49]
    assert np.array_equal(before.cov_m2, after.cov_m2)
    mean, cov = moments(found.smoothed)
    away = np.hypot(*(mean - error).T)
    assert away[:50].max() < 60.0
    assert away[51:].max() < 60.0
    assert np.linalg.det(cov[20]) < np.linalg.det(found.filtered[20].cov_m2)


def test_backwards_gives_the_same_states_again() -> None:
    ins, chart, rng = InsGrade(200.0, 0.3, 1.0), rough(), np.random.default_rng(2)
    epochs = track(chart, np.zeros((23, 2)), np.arange(23.0), [True] * 23, rng)
    for estimator in smoothers(chart, ins):
        flight = flown(estimator, Prior.from_ins(ins), epochs, np.random.default_rng(3), lambda done: None)
        again = list(flight.backwards())
        assert [k for k, _ in again] == list(reversed(range(23)))
        for k, state in again:
            assert np.array_equal(estimator.estimate(state).cov_m2, flight.estimates[k].cov_m2)


def test_traced_back_as_in_plain_numpy() -> None:
    rng = np.random.default_rng(4)
    weight, rows = rng.dirichlet(np.ones(50)), rng.standard_normal((50, 4))
    ahead, later = 2.0 * rng.standard_normal((50, 3)), 2.0 * rng.standard_normal((2000, 3))
    later[1000:] = later[0]
    chosen, mean, passed = np.empty(2000, np.int64), np.empty((2000, 4)), np.empty(50)
    nearest = trace_back(
        weight,
        rows,
        np.ascontiguousarray(ahead.T),
        later,
        (np.arange(2000) % 1000 + 0.5) / 1000.0,
        chosen,
        mean,
        passed,
    )
    squared = np.sum((ahead[None] - later[:, None]) ** 2, axis=2)
    share = weight * np.exp(-0.5 * squared)
    share /= share.sum(axis=1, keepdims=True)
    assert np.allclose(nearest, squared.min(axis=1))
    assert np.allclose(mean, share @ rows, atol=1e-5)
    assert np.allclose(passed, share.mean(axis=0), atol=1e-6)
    assert np.abs(np.bincount(chosen[1000:], minlength=50) / 1000.0 - share[0]).max() < 2e-3


def test_what_can_be_smoothed() -> None:
    chart, ins = rough(), InsGrade()
    assert all(can_be_smoothed(one) for one in smoothers(chart, ins))
    assert can_be_smoothed(Watching(Marginalized((chart,), ins), 1.0))
    assert not can_be_smoothed(Sitan((chart,), ins))

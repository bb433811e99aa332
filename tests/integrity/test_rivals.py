"""Rival places: refuted by ground that tells places apart, and by nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from terranav.core.records import Innovation
from terranav.integrity import rivals
from terranav.integrity.rivals import Rivals, Standing
from terranav.integrity.windows import Window
from terranav.kernels import integrity as kernels
from terranav.maps.map import Map
from tests.integrity.worlds import Flight, changed, flat, flight, ground

BUDGET = 5e-4


def after(chart: Map, trip: Flight, away_m: Sequence[float] = (0.0, 0.0)) -> tuple[Rivals, Standing]:
    """The rivals of a place that lies `away_m` from the truth."""
    field = Rivals.within(1200.0, 30.0)
    for epoch, error in zip(trip.epochs, trip.error_m, strict=True):
        centre = error + np.array(away_m)
        field = rivals.weighed(field, epoch, epoch.measurements[0], chart, centre, factor=1.0, budget=BUDGET)
    return field, rivals.standing(field, BUDGET, 0.0)


def test_rough_ground_refutes_all_rivals_of_the_truth() -> None:
    _, standing = after(ground(), flight([ground()], 1, readings=80))
    assert standing.reach_m == 0.0
    assert standing.share < BUDGET
    assert standing.readings == 80


def test_flat_ground_refutes_none() -> None:
    field, standing = after(flat(), flight([flat()], 1, readings=200))
    assert np.abs(field.odds).max() < 1e-6
    assert standing.reach_m == pytest.approx(1200.0, rel=0.02)


def test_the_truth_beats_a_wrong_place() -> None:
    field, standing = after(ground(), flight([ground()], 2, readings=80), (350.0, -200.0))
    assert standing.best > 20.0
    off = standing.best_m + np.array([350.0, -200.0])
    assert np.hypot(*off) < 3.0 * field.spacing_m
    assert standing.reach_m > 300.0


def test_a_constant_bias_speaks_for_no_place() -> None:
    trip = flight([ground()], 3, readings=60)
    raised = changed(trip, "terrain", range(60), lambda _, value: value + 40.0)
    assert after(ground(), raised)[1].reach_m == after(ground(), trip)[1].reach_m == 0.0


def test_off_the_map_nothing_is_said() -> None:
    trip = flight([ground()], 4, readings=5)
    far = Flight(tuple(replace(epoch, lat_deg=20.0) for epoch in trip.epochs), trip.error_m)
    field, _ = after(ground(), far)
    assert (field.odds == 0.0).all()


def test_the_rank_tells_noise_from_a_wrong_place() -> None:
    trip = flight([ground()], 5, readings=20, noise=5.0)
    field = Rivals.within(1200.0, 30.0)

    def ranked(away_m: Sequence[float]) -> float:
        window = Window("terrain")
        for epoch, error in zip(trip.epochs, trip.error_m, strict=True):
            value = epoch.measurements[0].value
            window = window.plus(Innovation("terrain", 1.0, 1.0, 1.0), value, epoch, error + np.array(away_m), 1e-6)
        return rivals.rank(field, window, ground(), 20)

    assert ranked((0.0, 0.0)) < 0.005
    assert ranked((500.0, 500.0)) > 0.05


def test_the_kernels_are_the_same_without_a_compiler() -> None:
    rng = np.random.default_rng(6)
    chart, trip = ground(), flight([ground()], 6, readings=1)
    epoch, n = trip.epochs[0], 40
    frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg)
    node = rng.normal(0.0, 300.0, (2, n))
    node[:, 0] = 0.0
    arrays = rng.normal(0.0, 5.0, (2, n)), rng.normal(0.0, 5.0, n), rng.normal(0.0, 1.0, n), rng.normal(0.0, 1.0, n)
    numbers = np.array([epoch.measurements[0].value, 9.0, 100.0, 50.0, 30.0, -20.0, 0.97])
    results = []
    for kernel in (kernels.weigh_rivals, kernels.weigh_rivals.py_func):
        out = np.empty((5, n))
        kernel(chart.values, np.stack([frame.row, frame.col]), trip.error_m[0], node, *arrays, numbers, out)
        results.append(out)
    np.testing.assert_allclose(results[0], results[1], rtol=1e-9)
    frames = np.stack([np.stack([frame.row, frame.col])] * 3)
    scattered = []
    for kernel in (kernels.scatter, kernels.scatter.py_func):
        out_one = np.empty(n)
        kernel(chart.values, frames, np.zeros((3, 2)), np.array([1.0, 5.0, 9.0]), node.T.copy(), out_one)
        scattered.append(out_one)
    np.testing.assert_allclose(scattered[0], scattered[1], rtol=1e-9)
    distance = np.sort(np.hypot(*node))
    odds = rng.normal(-3.0, 3.0, n)
    both = [
        kernel(distance, odds, 0.01, 100.0) for kernel in (kernels.reach_of_rivals, kernels.reach_of_rivals.py_func)
    ]
    assert both[0] == pytest.approx(both[1])


@pytest.mark.parametrize("off_the_map", [False, True])
def test_weigh_rivals_is_a_kalman_filter_of_the_bias_at_every_place(off_the_map: bool) -> None:
    """In plain numpy, over more places than a block holds, some of them where the map is silent."""
    rng, chart, n = np.random.default_rng(8), ground(), 2500
    epoch = flight([ground()], 6, readings=1).epochs[0]
    frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg)
    node, shift = rng.normal(0.0, 20_000.0, (2, n)), rng.normal(0.0, 5.0, (2, n))
    node[:, 0], shift[:, 0] = (9e5 if off_the_map else 0.0), 0.0
    bias, odds, recent = rng.normal(0.0, 5.0, n), rng.normal(0.0, 1.0, n), rng.normal(0.0, 1.0, n)
    value, white, common, cell2, tether, least, fading = epoch.measurements[0].value, 9.0, 100.0, 50.0, 6.0, -2.0, 0.97
    out, about = np.empty((5, n)), np.array([value, white, common, cell2, tether, least, fading])
    rows = np.stack([frame.row, frame.col])
    kernels.weigh_rivals(chart.values, rows, np.zeros(2), node, shift, bias, odds, recent, about, out)
    row, col = frame.cells(-node[0] - shift[0], -node[1] - shift[1])
    there = (row >= 0) & (row <= chart.shape[0] - 1) & (col >= 0) & (col <= chart.shape[1] - 1)
    i, j = np.clip(row.astype(int), 0, chart.shape[0] - 2), np.clip(col.astype(int), 0, chart.shape[1] - 2)
    u, v = row - i, col - j
    one, two, three, four = (chart.values[i + a, j + b].astype(float) for a in (0, 1) for b in (0, 1))
    h = (1 - u) * ((1 - v) * one + v * two) + u * ((1 - v) * three + v * four)
    by_row, by_col = (1 - v) * (three - one) + v * (four - two), (1 - u) * (two - one) + u * (four - three)
    slope = np.stack([by_row * frame.row[k] + by_col * frame.col[k] for k in (1, 2)])
    left, variance = value - h - bias, white + common + (slope**2).sum(axis=0) * cell2
    against = 0.5 * np.minimum(left**2 / variance, kernels.CLIP)
    gain = np.sign(left) * np.minimum(np.abs(left) / variance, np.sqrt(kernels.CLIP / variance))
    first = against[0] if there[0] else 0.0
    moved = np.clip(shift - gain * cell2 * slope, -tether, tether)
    moved[:, 0] = 0.0
    shift = np.clip(shift, -tether, tether)
    np.testing.assert_allclose(out[:2], np.where(there, moved, shift), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(out[2], np.where(there, bias + common * gain, bias), rtol=1e-9, atol=1e-9)
    expected = np.where(there, np.maximum(odds + first - against, least), odds)
    expected[0] = 0.0
    np.testing.assert_allclose(out[3], expected, rtol=1e-9, atol=1e-9)
    expected = np.where(there, fading * recent + first - against, recent)
    expected[0] = 0.0
    np.testing.assert_allclose(out[4], expected, rtol=1e-9, atol=1e-9)
    assert 0.1 < there.mean() < 0.9


@pytest.mark.parametrize("lift", [-30.0, 0.0, 900.0])
def test_the_reach_of_rivals_leaves_the_budget_beyond(lift: float) -> None:
    rng, n, budget, near = np.random.default_rng(9), 500, 0.03, 60.0
    distance, odds = np.sort(rng.uniform(0.0, 300.0, n)), rng.normal(-6.0, 3.0, n) + lift
    distance[0], odds[0] = 0.0, 0.0
    far = distance > near
    likely = np.where(far, np.exp(odds - max(lift, 0.0)), 0.0)
    total = likely.sum() + np.exp(-max(lift, 0.0))
    beyond = np.cumsum(likely[::-1])[::-1]
    reach, share, best = kernels.reach_of_rivals(distance, odds, budget, near)
    assert share == pytest.approx(likely.sum() / total, rel=1e-10)
    assert best == np.argmax(np.where(far, odds, -np.inf))
    assert reach == (distance[beyond > budget * total].max() if likely.sum() > budget * total else 0.0)
    assert kernels.reach_of_rivals(distance, odds, budget, 300.0) == (0.0, 0.0, 0)

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
    node = rng.normal(0.0, 300.0, (n, 2))
    node[0] = 0.0
    arrays = rng.normal(0.0, 5.0, (n, 2)), rng.normal(0.0, 5.0, n), rng.normal(0.0, 1.0, n), rng.normal(0.0, 1.0, n)
    numbers = np.array([epoch.measurements[0].value, 9.0, 100.0, 50.0, 30.0, -20.0, 0.97])
    results = []
    for kernel in (kernels.weigh_rivals, kernels.weigh_rivals.py_func):
        out = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
        kernel(chart.values, np.stack([frame.row, frame.col]), trip.error_m[0], node, *arrays, numbers, out)
        results.append(np.concatenate([one.ravel() for one in out]))
    np.testing.assert_allclose(results[0], results[1], rtol=1e-9)
    frames = np.stack([np.stack([frame.row, frame.col])] * 3)
    scattered = []
    for kernel in (kernels.scatter, kernels.scatter.py_func):
        out_one = np.empty(n)
        kernel(chart.values, frames, np.zeros((3, 2)), np.array([1.0, 5.0, 9.0]), node, out_one)
        scattered.append(out_one)
    np.testing.assert_allclose(scattered[0], scattered[1], rtol=1e-9)
    distance = np.hypot(*node.T)
    order = np.argsort(-distance)
    odds = rng.normal(-3.0, 3.0, n)
    both = [
        kernel(distance, order, odds, 0.01, 100.0)
        for kernel in (kernels.reach_of_rivals, kernels.reach_of_rivals.py_func)
    ]
    assert both[0] == pytest.approx(both[1])

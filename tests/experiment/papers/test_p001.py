"""The reproduction of papers/001: its flights, and a small slice of the study over a given map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import SeedSequence

from terranav.core.earth import offset_m
from terranav.core.errors import StateError
from terranav.experiment.montecarlo import Threads
from terranav.experiment.papers._p001_flights import (
    CONTESTANTS,
    MOTIONS,
    NOISY,
    PRINTED,
    SECONDS,
    TERRAINS,
    WALK_M,
    Outcome,
    flights,
    fly,
)
from terranav.experiment.papers.outcome import Reproduction, Setup
from terranav.experiment.papers.p001 import BANDS_M, TITLE, one_run, reproduce, within
from terranav.maps.gauss_markov import gauss_markov_map
from terranav.maps.map import Map

RUNS = 3


@pytest.fixture(scope="module")
def given() -> Map:
    """The paper's terrain on cells of 10 m: as long, and quick to make."""
    return gauss_markov_map(np.random.default_rng(0), shape=(561, 561), spacing_m=10.0)


@pytest.fixture(scope="module")
def study(given: Map) -> Reproduction:
    return reproduce(Setup(runs=RUNS, seed=1, maps=(given,), executor=Threads(2)))


def test_the_flights_are_the_paper_s() -> None:
    seen = {}
    for terrain, motion, flight in flights(SeedSequence(4), ()):
        seen[terrain, motion] = flight
        assert flight.chart.cell_m == pytest.approx(1.0, rel=1e-6)
        assert len(flight.epochs) == SECONDS
        assert {reading.sigma for epoch in flight.epochs for reading in epoch.measurements} == {1.0}
    assert list(seen) == [(terrain, motion) for terrain in TERRAINS for motion in MOTIONS]
    by_sigma, stretched = seen[TERRAINS[0], MOTIONS[0]], seen[TERRAINS[1], MOTIONS[0]]
    assert by_sigma.chart.values.std() == pytest.approx(20.0, rel=0.1)
    assert (stretched.chart.values.min(), stretched.chart.values.max()) == (pytest.approx(35.0), pytest.approx(80.0))
    first, later = by_sigma.epochs[0], by_sigma.epochs[10]
    north, east = offset_m(0.0, 0.0, first.lat_deg, first.lon_deg)
    np.testing.assert_allclose([north, east], 10.0, atol=1e-3)
    along = offset_m(first.lat_deg, first.lon_deg, later.lat_deg, later.lon_deg)
    assert np.hypot(*along) == pytest.approx(1400.0, abs=0.1)  # the nominal motion, 140 m/s
    known = seen[TERRAINS[0], MOTIONS[1]]
    assert np.ptp(known.error_m, axis=0).max() == 0.0
    assert np.ptp(by_sigma.error_m, axis=0).min() > 10.0
    # the truth is the same under every reading
    lat, lon = known.epochs[7].lat_deg, known.epochs[7].lon_deg
    told_lat, told_lon = by_sigma.epochs[7].lat_deg, by_sigma.epochs[7].lon_deg
    apart = np.array(offset_m(told_lat, told_lon, lat, lon))
    np.testing.assert_allclose(apart, known.error_m[7] - by_sigma.error_m[7], atol=1e-3)


def test_the_walk_is_the_change_of_the_deviation_in_one_second() -> None:
    """R(1 s) by hand: 100 exp(-a)(cos a + sin a), a = 0.51 / sqrt 2."""
    a = 0.51 / np.sqrt(2.0)
    np.testing.assert_allclose(WALK_M, np.sqrt(200.0 * (1.0 - np.exp(-a) * (np.cos(a) + np.sin(a)))))


def test_errors_are_estimated_minus_true(given: Map) -> None:
    (_, _, flight), *_ = flights(SeedSequence(2), (given,))
    idle = fly(CONTESTANTS[-1], flight, SeedSequence(0))
    np.testing.assert_allclose(idle.error_m, flight.error_m[:, ::-1], atol=1e-9)  # x is east
    assert idle.nees.shape == (SECONDS,)


def test_bands_are_those_of_the_paper() -> None:
    error = np.array([[[8.0, 12.0], [-5.0, -8.0]], [[8.1, 0.0], [0.0, -8.1]]])
    np.testing.assert_array_equal(within(error, "x"), [[True, True], [False, True]])
    np.testing.assert_array_equal(within(error, "y"), [[True, True], [True, False]])
    assert BANDS_M == {"x": (-5.0, 8.0), "y": (-8.0, 12.0)}


def test_the_study_has_a_table_a_reading_and_a_row_a_method(study: Reproduction) -> None:
    assert (study.paper, study.title, study.runs) == ("001", TITLE, RUNS)
    assert not study.failures
    assert len(study.tables) == len(MOTIONS)
    for table in study.tables:
        assert [row[0] for row in table.rows] == [one.label for one in CONTESTANTS]
        assert all(len(row) == len(table.columns) for row in table.rows)
    assert [claim.text.split()[0] for claim in study.claims] == ["x", "y", "cubic", "EKF,"]
    for figure in study.figures:
        assert figure.kind == "lines"
        assert all(series.x.shape == series.y.shape == (SECONDS,) for series in figure.series)
    assert len({figure.name for figure in study.figures}) == 2 * len(MOTIONS)


def test_runs_do_not_depend_on_the_workers(given: Map, study: Reproduction) -> None:
    alone = reproduce(Setup(runs=RUNS, seed=1, maps=(given,), executor=Threads(1)))
    assert alone.tables == study.tables
    assert alone.claims == study.claims


def test_process_noise_is_what_follows_the_deviation(given: Map) -> None:
    """The printed recursion takes the error for constant; with the noise of eq. 7 it follows, and is honest."""
    terrain = f"map {given.name!r}"
    errors: dict[str, list[Outcome]] = {PRINTED.label: [], NOISY.label: []}
    for seed in SeedSequence(3).spawn(4):
        run = one_run(seed, Setup(runs=2, maps=(given,)))
        for label, outcomes in errors.items():
            outcomes.append(run[terrain, MOTIONS[0], label])
    printed, noisy = (np.sqrt(np.mean([one.error_m**2 for one in errors[key]])) for key in errors)
    assert noisy < 0.9 * printed
    assert np.median([one.nees for one in errors[NOISY.label]]) < 3.0
    assert np.median([one.nees for one in errors[PRINTED.label]]) > 6.0


def test_a_map_too_small_is_named(given: Map) -> None:
    small = replace(given, values=given.values[:200, :200])
    with pytest.raises(StateError, match="leaves the map"):
        reproduce(Setup(runs=2, maps=(small,)))

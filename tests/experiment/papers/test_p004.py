"""papers/004: the study's bare methods are the library's, its flights keep to the search area, its figures repeat."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from terranav.core.earth import shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior, Profile
from terranav.experiment.montecarlo import Threads
from terranav.experiment.papers import _p004_flights as flights
from terranav.experiment.papers import p004
from terranav.experiment.papers.outcome import Reproduction, Setup
from terranav.experiment.papers.registry import reproduce
from terranav.experiment.stream import states
from terranav.filters.fading_memory import FadingMemory
from terranav.maps.fields import plane_map
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map
from terranav.matchers.tercom import Tercom

BOX = Prior(np.zeros(2), np.eye(2) * 1000.0**2, "uniform")  # +-3 km


@cache
def land() -> Map:
    return flights.resampled(sample_map())


@cache
def flight() -> flights.Flight:
    return flights.draw(land(), np.random.default_rng(3))


@cache
def small() -> Reproduction:
    return reproduce("004", Setup(runs=2, executor=Threads(2)))


def epochs(reading: str) -> list[Epoch]:
    lat, lon = shift(flight().lat_deg, flight().lon_deg, *flight().error_m[reading].T)
    height = flights.measured(land(), flight())
    return [
        Epoch(k / 4.0, *place, 3000.0, measurements=(Measurement("terrain", float(height[k]), flights.NOISE_M),))
        for k, place in enumerate(zip(lat.tolist(), lon.tolist(), strict=True))
    ]


def test_the_land_is_the_map_at_60_m() -> None:
    assert land().cell_m == pytest.approx(60.0, rel=1e-4)
    lat, lon = shift(*land().centre_deg, np.linspace(-9e3, 9e3, 50), np.linspace(8e3, -8e3, 50))
    difference = land().sample(lat, lon) - sample_map().sample(lat, lon)
    assert np.std(difference) < 0.1 * np.std(sample_map().sample(lat, lon))
    half = flights.relieved(land(), 0.5)
    assert np.std(half.values) == pytest.approx(0.5 * np.std(land().values), rel=1e-3)


def test_errors_stay_within_the_search_area_and_drift_as_each_reading_says() -> None:
    for seed in range(20):
        drawn = flights.draw(land(), np.random.default_rng(seed)).error_m
        assert all(np.abs(error).max() < flights.HALF_M for error in drawn.values())
        assert len({tuple(error[0]) for error in drawn.values()}) == 1
        assert np.ptp(drawn["none"], axis=0).max() == 0.0
        np.testing.assert_allclose(drawn["constant"][-1] - drawn["constant"][0], 5.0 * 191 / 4.0)


@pytest.mark.parametrize("reading", ["none", "constant"])
def test_the_bare_methods_are_those_of_the_library(reading: str) -> None:
    """The study leaves out all that the estimators add to the papers' algorithms: the same fixes come out."""
    seen = flights.indicated(land(), flight(), reading)
    height, error = flights.measured(land(), flight()), flight().error_m[reading]
    given = epochs(reading)
    score = Tercom((land(),), cell_m=60.0).surface(BOX, Profile(tuple(given[48:96]), "terrain"))
    i, j = np.unravel_index(np.argmin(score.score), score.score.shape)
    miss = np.hypot(score.north_m[i] - error[95, 0], score.east_m[j] - error[95, 1])
    assert flights.tercom_misses(land(), seen, height)[0] == pytest.approx(miss, abs=1e-6)
    still = InsGrade(1000.0, 0.0, 0.0)
    fading = FadingMemory((land(),), still, cell_m=60.0, sub_cell=False)
    *_, state = states(fading, BOX, given[:96], np.random.default_rng(0))
    i, j = np.unravel_index(np.argmin(state.memory.surface), state.memory.surface.shape)
    assert state.memory.surface.shape == (101, 101)
    miss = np.hypot(state.memory.north_m[i] - error[95, 0], state.memory.east_m[j] - error[95, 1])
    assert flights.fading_misses(land(), seen, height)[0] == pytest.approx(miss, abs=1e-6)


def test_a_constant_drift_puts_the_fix_behind() -> None:
    """Over full relief, without noise: by 5 m/s times the mean age of the memory, 16 s, on each axis."""
    quiet = replace(flight(), noise_m=np.zeros(flights.EPOCHS))
    seen = flights.indicated(land(), quiet, "constant")
    misses = flights.fading_misses(land(), seen, flights.measured(land(), quiet))
    assert 60.0 < misses.mean() < 190.0
    still = flights.fading_misses(land(), flights.indicated(land(), quiet, "none"), flights.measured(land(), quiet))
    assert (still < 60.0).all()


def test_the_reproduction_has_the_papers_tables_claims_and_figures() -> None:
    outcome = small()
    assert outcome.paper == "004"
    assert outcome.failures == []
    assert [len(table.rows) for table in outcome.tables] == [10, 3]
    assert all(len(row) == len(table.columns) for table in outcome.tables for row in table.rows)
    assert len(outcome.claims) == 5
    assert {claim.verdict for claim in outcome.claims} <= {"holds", "holds in part", "does not hold"}
    bars = [figure for figure in outcome.figures if figure.kind == "bars"]
    assert len(bars) == 4
    for figure in bars:
        for series in figure.series:
            assert series.y.sum() == pytest.approx(100.0)


def test_the_same_seed_gives_the_same_figures_for_any_workers() -> None:
    again = reproduce("004", Setup(runs=2, executor=Threads(1)))
    assert again.tables[0] == small().tables[0]
    assert [claim.verdict for claim in again.claims] == [claim.verdict for claim in small().claims]


def test_maps_that_will_not_do_are_one_line() -> None:
    tiny = plane_map(0.0, 0.0, cells=100, cell_m=60.0)
    with pytest.raises(DataError, match="the map is 6 x 6 km, expected at least 23 km each way"):
        p004.reproduce(Setup(runs=2, maps=(tiny,)))
    gravity = plane_map(0.0, 0.0, kind="gravity")
    with pytest.raises(ConfigError, match="given maps of kind gravity, expected one of kind terrain"):
        p004.reproduce(Setup(runs=2, maps=(gravity,)))

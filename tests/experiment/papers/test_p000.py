"""A small slice of the reproduction of papers/000: that it flies what it says, and says what it flew."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from terranav.core.errors import ConfigError, DataError
from terranav.experiment.montecarlo import Threads
from terranav.experiment.papers import _p000_flights as flights
from terranav.experiment.papers.outcome import Reproduction, Setup
from terranav.experiment.papers.p000 import METHODS, NOISES, SIGMAS_M, TITLE, reproduce
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map


@cache
def small_map() -> Map:
    """Land whose west is flat; a track of 60 s has room."""
    field = gaussian_map(np.random.default_rng(2), std=1.0, correlation_m=500.0, cells=256, cell_m=45.0, sigma=2.0)
    height = np.where(np.arange(256) < 98, 2.0, 60.0)
    return replace(field, values=300.0 + height * field.values, name="small")


@cache
def outcome(workers: int) -> Reproduction:
    return reproduce(Setup(runs=2, seed=3, maps=(small_map(),), executor=Threads(workers)))


def test_the_outcome_has_a_table_a_case_and_a_verdict_a_claim() -> None:
    told = outcome(2)
    assert (told.paper, told.title, told.runs, list(told.failures)) == ("000", TITLE, 2, [])
    assert len(told.tables) == len(SIGMAS_M) + 2
    for table in told.tables:
        assert {len(row) for row in table.rows} == {len(table.columns)}
    for table in told.tables[:2]:
        assert [row[0] for row in table.rows] == ["papers/000: HMMTEM", *METHODS]
        assert table.rows[0][1:3] == ("50.16", "32.73")
    assert [row[0] for row in told.tables[2].rows] == list(NOISES)
    assert {claim.verdict for claim in told.claims} <= {"holds", "holds in part", "does not hold"}
    assert all(claim.why and claim.ours and claim.paper for claim in told.claims)
    assert len(told.claims) == 9


def test_the_figures_are_finite_lines_of_every_method() -> None:
    profile, *drms = outcome(2).figures
    assert profile.name == "terrain_profile"
    for figure in drms:
        assert [line.label for line in figure.series] == list(METHODS)
        for line in figure.series:
            assert line.x.shape == line.y.shape
            assert np.isfinite(line.y).all()


def test_the_same_seed_gives_the_same_outcome_for_any_number_of_workers() -> None:
    assert outcome(1).tables == outcome(2).tables
    assert outcome(1).claims == outcome(2).claims


def test_the_track_starts_flat_and_is_the_flattest_start_there_is() -> None:
    chart = replace(small_map(), sigma=0.0)
    track = flights.flattest_start(chart, 300.0)
    assert track.slope_flat < 0.2 * track.slope_rough
    height = chart.sample(track.lat_deg, track.lon_deg)
    third = height.size // 3
    assert height[:third].std() < 10.0
    assert height[third:].std() > 40.0
    assert np.diff(track.time_s).tolist() == pytest.approx([0.25] * (height.size - 1))


def test_the_generated_field_is_flat_under_the_first_third() -> None:
    chart, track = flights.generated(0)
    height = chart.sample(track.lat_deg, track.lon_deg)
    third = height.size // 3
    assert height[: int(0.9 * third)].std() < 10.0
    assert height[third:].std() > 40.0


@pytest.mark.parametrize("kind", NOISES)
def test_every_noise_has_the_sigma_that_is_told(kind: str) -> None:
    noise = flights.noise_m(kind, 200_000, np.random.default_rng(1))
    wide = np.sqrt(1.0 + flights.OUTLIER_SHARE * (flights.OUTLIER_SCALE**2 - 1.0)) if kind == "mixture" else 1.0
    assert noise.std() == pytest.approx(flights.SIGMA_H_M * wide, rel=0.05)
    assert abs(noise.mean()) < 0.2


def test_a_flight_drifts_and_reads_the_map() -> None:
    chart = replace(small_map(), sigma=0.0)
    case = flights.Case("x", chart, flights.flattest_start(chart, 300.0), 100.0)
    rec = flights.flown(case, "gaussian", np.random.default_rng(4))
    off = rec.columns["terrain_m"] - chart.sample(rec.columns["true_lat_deg"], rec.columns["true_lon_deg"])
    assert off.std() == pytest.approx(flights.SIGMA_H_M, rel=0.2)
    assert rec.ins == case.ins
    np.testing.assert_allclose(rec.columns["true_lat_deg"], case.track.lat_deg)
    assert np.hypot(*(rec.ins_error_m()[-1] - rec.ins_error_m()[0])) > 5.0


def test_maps_that_do_not_do_are_refused() -> None:
    gravity = gaussian_map(np.random.default_rng(0), kind="gravity", cells=64)
    with pytest.raises(ConfigError, match="paper 000: the maps given are of kind gravity, expected a terrain map"):
        reproduce(Setup(runs=2, maps=(gravity,)))
    tiny = gaussian_map(np.random.default_rng(0), cells=64, cell_m=50.0)
    with pytest.raises(DataError, match="3200 m wide, expected a map with room for a flight of 60 s"):
        reproduce(Setup(runs=2, maps=(tiny,)))

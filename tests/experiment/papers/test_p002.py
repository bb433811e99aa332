"""A small slice of the reproduction of papers/002: same bits, paired runs, and the errors that bad maps give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from numpy.random import SeedSequence

import terranav as tn
from terranav.core.errors import ConfigError, DataError
from terranav.core.recording import Recording
from terranav.experiment.montecarlo import Threads, bootstrap
from terranav.experiment.papers import p002
from terranav.experiment.papers._p002_cases import (
    GRAVITY,
    JOINT,
    MIX,
    MODES,
    READINGS,
    TERRAIN,
    Case,
    Terms,
    cases,
    fly,
)
from terranav.experiment.papers.outcome import Reproduction, Setup
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map


def gravity_map(centre_deg: tuple[float, float]) -> Map:
    return gaussian_map(
        np.random.default_rng(4),
        std=20.0,
        correlation_m=12_000.0,
        mean=0.0,
        cells=60,
        cell_m=926.0,
        centre_deg=centre_deg,
        kind="gravity",
    )


@cache
def default_cases() -> tuple[Case, Case]:
    return cases((), 0)


def shortened(maps: Sequence[Map], seed: int) -> tuple[Case, Case]:
    """The default cases, their tracks cut to their first 12 s: the study has dozens of flights."""
    rough, flat = (replace(case, lat_deg=case.lat_deg[:13], lon_deg=case.lon_deg[:13]) for case in default_cases())
    return rough, flat


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(p002, "cases", shortened)
    monkeypatch.setattr(p002, "bootstrap", partial(bootstrap, draws=100))


@cache
def small() -> Reproduction:
    return p002.reproduce(Setup(runs=2, seed=3, executor=Threads(2)))


def test_says_everything_it_should() -> None:
    out = small()
    assert (out.paper, out.runs, len(out.failures)) == ("002", 8, 0)
    assert [claim.verdict in ("holds", "holds in part", "does not hold") for claim in out.claims] == [True] * 4
    assert [figure.name for figure in out.figures] == ["case_a", "case_b"]
    for figure in out.figures:
        assert [series.label for series in figure.series] == list(MODES)
        for series in figure.series:
            assert series.x.shape == series.y.shape == (13,)
            assert np.isfinite(series.y).all()
    for table in out.tables:
        assert all(len(row) == len(table.columns) for row in table.rows)
    assert "61.24" in str(out.tables[0].rows)
    assert "58.17" in str(out.tables[1].rows)
    assert "5 ug/sqrt(Hz)" in out.scenario


def test_progress_ends_at_all_of_it() -> None:
    seen: list[tuple[int, int]] = []
    out = p002.reproduce(Setup(runs=2, seed=3, executor=Threads(1), on_run=lambda done, of: seen.append((done, of))))
    assert [done for done, _ in seen] == list(range(1, len(seen) + 1))
    assert seen[-1] == (len(seen), len(seen))
    assert out.tables == small().tables  # whatever the number of workers
    assert out.claims == small().claims


def test_flat_is_flatter_and_the_cases_differ() -> None:
    rough, flat = default_cases()
    slopes = [np.hypot(*case.terrain.gradient(case.lat_deg, case.lon_deg)).mean() for case in (rough, flat)]
    assert slopes[0] > 10.0 * slopes[1]


def test_modes_share_truth_and_noise() -> None:
    """The same seed gives the same errors, with and without the other readings of the mix."""
    rough, _ = default_cases()
    plain, more = (fly(rough, Terms(), SeedSequence(5), readings=readings) for readings in (False, True))
    assert set(more.error_m) == {*MODES, *READINGS}
    for mode in MODES:
        np.testing.assert_array_equal(plain.error_m[mode], more.error_m[mode])
    assert ((plain.weight_terrain >= 0.0) & (plain.weight_terrain <= 1.0)).all()
    # a weighted mean of two positions is never farther from the truth than the worse of them
    worse = np.maximum(plain.error_m[TERRAIN], plain.error_m[GRAVITY])
    assert (plain.error_m[MIX] <= worse + 1e-9).all()
    assert plain.error_m[JOINT][-50:].mean() < 50.0


@pytest.mark.parametrize("noise_in", ["map", "reading"])
def test_noise_of_either_reading_is_told_to_the_filters(noise_in: str) -> None:
    flown = fly(default_cases()[0], Terms(noise_in=noise_in), SeedSequence(1))
    assert all(np.isfinite(error).all() for error in flown.error_m.values())
    assert flown.error_m[TERRAIN][-50:].mean() < 60.0


def test_given_maps_replace_the_default_ones() -> None:
    terrain = tn.sample_map()
    gravity = gravity_map(terrain.centre_deg)
    rough, flat = cases((gravity, terrain), 0)
    assert rough.terrain is terrain is flat.terrain
    assert rough.gravity is gravity is flat.gravity
    assert rough.true_maps(np.random.default_rng(0))[1] is gravity
    assert "jacksboro" in rough.land


def test_maps_that_do_not_go_together() -> None:
    terrain = tn.sample_map()
    with pytest.raises(DataError, match="overlaps the terrain map"):
        cases((terrain, gravity_map((10.0, 20.0))), 0)
    with pytest.raises(DataError, match="kind magnetic"):
        cases((replace(terrain, kind="magnetic", unit="nT"),), 0)
    with pytest.raises(DataError, match="straight track of 20 km"):
        cases((terrain.crop(36.5, -84.3, 36.6, -84.2),), 0)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("terrain_sigma_m", -10.0),
        ("gravity_sigma_mgal", 0.0),
        ("gravity_sigma_mgal", float("nan")),
        ("noise_in", "air"),
    ],
)
def test_impossible_terms(key: str, value: float | str) -> None:
    with pytest.raises(ConfigError, match=key):
        Terms(**{key: value})  # type: ignore[arg-type]


def test_negative_walk_is_refused() -> None:
    with pytest.raises(ConfigError, match="accel_walk"):
        Terms(accel_walk_mps_per_sqrt_h=-1.0).ins()


def terrain_only(chart: Map) -> Recording:
    lat, lon = np.linspace(36.5, 36.6, 20), np.full(20, -84.25)
    columns = {"time_s": np.arange(20.0), "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(20, 2000.0)}
    heights = chart.sample(lat, lon)
    return Recording({**columns, "terrain_m": heights}, ins=tn.InsGrade(100.0), sigma={"terrain_m": 3.0}, name="hop")


def test_gravity_asked_of_a_terrain_only_recording() -> None:
    terrain = tn.sample_map()
    gravity = gravity_map(terrain.centre_deg)
    with pytest.raises(DataError, match="readings of kind terrain, but the maps are of kind gravity"):
        tn.run("hybrid", terrain_only(terrain), maps=[gravity])
    mixed = tn.run("hybrid", terrain_only(terrain), maps=[terrain, gravity])
    plain = tn.run("hybrid", terrain_only(terrain), maps=[terrain])
    np.testing.assert_allclose(mixed.ins_error_m, plain.ins_error_m, atol=0.5)


def test_maps_that_do_not_overlap_the_recording() -> None:
    terrain = tn.sample_map()
    away = gravity_map((10.0, 20.0))
    with pytest.raises(DataError, match="which no map covers"):
        tn.run("hybrid", replace(terrain_only(terrain), name="hop"), maps=[replace(away, kind="terrain", unit="m")])
    rec = terrain_only(terrain).with_columns(gravity_mgal=np.zeros(20))
    rec = replace(rec, sigma={"terrain_m": 3.0, "gravity_mgal": 1.0})
    with pytest.raises(DataError, match="which the gravity map does not cover"):
        tn.run("hybrid", rec, maps=[terrain, away])

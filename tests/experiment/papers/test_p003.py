"""Paper 003: a slice of the study; the judges replayed on stored optimisations are those of the estimator."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from terranav.core.earth import metres_per_degree, offset_m
from terranav.core.errors import ConfigError
from terranav.core.records import Prior
from terranav.experiment.papers import p003
from terranav.experiment.papers._p003_matches import MATCHES, RULES, Case, estimator, fly
from terranav.experiment.papers._p003_world import DEGREE_M, INS, Land, field, flight, lands, track
from terranav.experiment.papers.outcome import Reproduction, Setup
from terranav.experiment.stream import states
from terranav.maps.fields import gaussian_map, plane_map
from terranav.sensors.barometer import Barometer


@cache
def found() -> Reproduction:
    return p003.reproduce(Setup(runs=2, seed=4, maps=(field(0.25, 31), replace(field(0.1, 32), name="mild"))))


def test_tables_claims_and_figures_are_whole() -> None:
    outcome = found()
    assert outcome.paper == "003"
    assert not outcome.failures
    assert len(outcome.claims) == 4
    for table in outcome.tables:
        assert table.rows
        assert all(len(row) == len(table.columns) for row in table.rows)
    for figure in outcome.figures:
        for series in figure.series:
            assert series.x.shape == series.y.shape
            assert np.isfinite(series.y).all()
    assert len({figure.name for figure in outcome.figures}) == len(outcome.figures)
    cloud = next(figure for figure in outcome.figures if figure.name == "errors_pdaf").series[0]
    assert cloud.y.size == 2 * MATCHES
    assert all(claim.verdict in ("holds", "holds in part", "does not hold") for claim in outcome.claims)


def test_a_map_alone_gives_the_same_rows_and_progress_reaches_the_end() -> None:
    """The seed of a run depends on nothing else that is run."""
    seen: list[tuple[int, int]] = []
    setup = Setup(runs=2, seed=4, maps=(field(0.25, 31),), on_run=lambda done, of: seen.append((done, of)))
    alone = p003.reproduce(setup)
    for one, whole in zip(alone.tables, found().tables, strict=True):
        assert set(one.rows) <= set(whole.rows)
    assert seen[-1] == (10, 10)
    assert seen == sorted(seen)


def test_replayed_judges_are_those_of_the_estimator() -> None:
    """With the search around the INS trace the optimisations are the same whatever the judge."""
    land = Land("field", field(0.25, 31))
    replayed = fly(land, Case("open"), np.random.SeedSequence(8))
    way = track(land, MATCHES + 2)
    world, search = (np.random.SeedSequence(8, spawn_key=(i,)) for i in range(2))
    run = flight(way, np.random.default_rng(world))
    for rule in RULES:
        steps = states(
            estimator(land, Case("open"), rule.judge),
            Prior.from_ins(INS),
            run.epochs,
            np.random.default_rng(search),
        )
        after = list(steps)[2:]
        accepted = [state.latest is not None and state.latest.decision.accepted for state in after]
        np.testing.assert_array_equal(replayed[rule.name][1], accepted)
        lat, lon = run.true_deg[-1]
        north, east = offset_m(lat, lon, run.epochs[-1].lat_deg, run.epochs[-1].lon_deg)
        per_degree = metres_per_degree(lat)
        off = (after[-1].mean_m - [float(north), float(east)]) / np.array([float(part) for part in per_degree])
        assert replayed[rule.name][0][-1] == pytest.approx(np.hypot(*off), rel=1e-9)


def test_the_conditions_are_those_of_table_1() -> None:
    land = Land("field", field(0.25, 31))
    way = track(land, 33)
    run = flight(way, np.random.default_rng(0))
    step = np.hypot(*(np.diff(run.true_deg, axis=0) * [DEGREE_M, DEGREE_M]).T)
    assert len(run.epochs) == 33
    assert np.ptp([epoch.time_s for epoch in run.epochs]) == 64.0
    assert step.std() < 0.01 * step.mean()
    first = run.epochs[0]
    assert first.lat_deg - run.true_deg[0, 0] == pytest.approx(0.003, rel=1e-3)
    assert first.lon_deg - run.true_deg[0, 1] == pytest.approx(0.003, rel=1e-3)
    last = run.epochs[-1]
    drift = np.array([last.lat_deg - run.true_deg[-1, 0], last.lon_deg - run.true_deg[-1, 1]]) - 0.003
    assert np.abs(drift).max() * DEGREE_M < 15.0  # an IMU of that grade moves metres in a minute
    sigma = Barometer.from_table({"preset": "paper_003"}).sigma([500.0, 2000.0, 5001.0])
    np.testing.assert_allclose(sigma, [1.5, 8.0, np.nan])


def test_the_field_has_the_slope_it_is_named_for() -> None:
    chart = field(0.25, 31)
    lat, lon = (np.linspace(low, high, 40) for low, high in ((44.95, 45.05), (9.93, 10.07)))
    slope = np.hypot(*chart.gradient(lat[:, None], lon))
    assert slope.mean() == pytest.approx(0.25, rel=0.1)


def test_maps_that_do_not_serve_get_their_line() -> None:
    gravity = gaussian_map(np.random.default_rng(0), cells=32, kind="gravity")
    with pytest.raises(ConfigError, match="paper 003: the maps given are of kind gravity, expected terrain"):
        lands(Setup(maps=(gravity,)))
    with pytest.raises(ConfigError, match="paper 003: map small has no values along a trace of 12800 m"):
        track(Land("small", plane_map(0.1, 0.0, cells=21)), 33)

"""The monitored navigator when all is well, and when something goes wrong that it was not told of."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from terranav.core.earth import shift
from terranav.core.errors import ConfigError
from terranav.core.records import Prior
from terranav.experiment.registry import estimator_name, make_estimator, own_maps
from terranav.experiment.stream import states
from terranav.filters.marginalized import Marginalized
from terranav.integrity.monitored import Monitored
from tests.contract.test_estimators import bits
from tests.integrity.worlds import (
    INS,
    PRIOR,
    Flight,
    changed,
    flat,
    flight,
    flown,
    gravity,
    ground,
    navigator_for,
)

JUMP = 150


def test_healthy_flights_are_offered_and_never_lost() -> None:
    """12 flights of 300 readings: no alarm where the stated rate is 1e-6 a window."""
    for seed in range(12):
        chart = ground(seed % 4)
        run = flown([chart], flight([chart], seed), seed)
        assert "lost" not in run.status
        assert not run.beyond().any()
        assert run.usable[150:].mean() > 0.9
        assert np.isfinite(run.level_m).all()


@pytest.mark.parametrize("rate_hz", [10, 25])
def test_readings_that_share_a_map_cell_are_one_witness(rate_hz: int) -> None:
    """A sensor many times as fast: the fix is found, offered and kept as with one reading a second."""
    for seed in range(3):
        chart = ground(seed)
        run = flown([chart], flight([chart], seed, readings=200 * rate_hz, rate_s=1.0 / rate_hz), seed)
        assert "lost" not in run.status
        assert not run.beyond().any()
        assert run.usable[120 * rate_hz :].mean() > 0.9
        assert run.off_m[-1] < 60.0


def test_a_vehicle_that_hovers_hears_its_sensor() -> None:
    """Readings of one place count every half minute: often enough that the map is not thought to be silent."""
    chart = ground()
    moving = flight([chart], 0)
    last = moving.epochs[-1]
    hover = tuple(replace(last, time_s=last.time_s + 1.0 + i) for i in range(400))
    error_m = np.concatenate([moving.error_m, np.repeat(moving.error_m[-1:], 400, axis=0)])
    run = flown([chart], Flight((*moving.epochs, *hover), error_m), 0)
    counted = [state.readings for state in run.states[-400:]]
    assert counted[-1] - counted[0] == 13
    assert run.states[-1].silence_s == 0.0
    assert not run.beyond().any()


def test_a_fix_is_on_probation_before_it_is_offered() -> None:
    run = flown([ground()], flight([ground()], 1, readings=120))
    first = int(np.argmax(run.usable))
    assert run.said("on probation: 3 of 20 readings since the fix")
    assert run.said("not converged: sigma")
    standing = run.states[first].standing
    assert standing is not None
    assert standing.readings >= 20
    assert set(run.status[:first]) == {"searching"}


@pytest.mark.parametrize("seed", range(4))
def test_a_kidnapped_ins_is_lost_within_a_minute_and_found_again(seed: int) -> None:
    way = 5000.0 * np.array([np.cos(1.3 * seed), np.sin(1.3 * seed)])
    run = flown([ground()], flight([ground()], seed, readings=450, jump=(JUMP, way[0], way[1])), seed)
    assert run.status[JUMP - 1] == "converged"
    declared = JUMP + int(np.argmax(run.status[JUMP:] == "lost"))
    assert run.status[declared] == "lost"
    assert declared - JUMP <= 60
    assert not run.unannounced()[declared:].any()
    assert run.status[-1] == "converged"
    assert run.off_m[-1] < 60.0
    assert not run.beyond()[JUMP + 10 :].any()


@pytest.mark.parametrize("sigmas", [4.0, 6.0, 10.0])
def test_a_prior_without_the_truth_is_lost_widened_and_mended(sigmas: float) -> None:
    for seed in range(3):
        start = 300.0 * sigmas * np.array([np.cos(seed), np.sin(seed)])
        run = flown([ground()], flight([ground()], seed, start_m=(start[0], start[1])), seed)
        assert not run.beyond().any()
        assert not run.unannounced(300.0).any()
        assert run.off_m[-1] < 60.0
        assert run.usable[-1]


def test_a_gravity_map_of_other_ground_is_named_and_left_out() -> None:
    for seed in range(2):
        run = flown([ground(), gravity(1)], flight([ground(), gravity(0)], seed), seed)
        last = run.estimates[-1]
        assert run.states[-1].silent == {"gravity"}
        assert any(
            reason.startswith("gravity left out: gravity readings contradict the map") for reason in last.reasons
        )
        assert last.usable
        assert run.off_m[-1] < 60.0
        assert not run.beyond().any()


def test_a_terrain_map_of_other_ground_is_left_out() -> None:
    for seed in range(2):
        run = flown([ground(1), gravity(0)], flight([ground(), gravity(0)], seed, readings=350), seed)
        assert run.states[-1].silent == {"terrain"}
        assert run.said("terrain left out: ")
        assert run.off_m[-1] < 100.0
        assert not run.beyond().any()


def test_a_gravity_map_that_lies_20_km_away_is_left_out() -> None:
    chart = gravity(0)
    north, east = shift(*chart.centre_deg, 0.0, 8_000.0)
    assert north is not None
    a, b, c, d, e, f = chart.transform
    moved = replace(chart, transform=(a, b, c + float(east) - chart.centre_deg[1], d, e, f))
    run = flown([ground(), moved], flight([ground(), chart], 3), 3)
    assert run.states[-1].silent == {"gravity"}
    assert run.off_m[-1] < 60.0


def test_a_kind_that_agrees_again_is_taken_in() -> None:
    trip = flight([ground(), gravity()], 5, readings=450)
    wrong = changed(trip, "gravity", range(100, 160), lambda i, value: value + 30.0 * np.sin(2.1 * i))
    run = flown([ground(), gravity()], wrong, 5)
    assert any(state.silent == {"gravity"} for state in run.states)
    assert run.states[-1].silent == frozenset()
    assert not run.beyond().any()


@pytest.mark.parametrize(("factor", "degraded"), [(2.0, False), (4.0, True)])
def test_sigmas_that_are_too_small_are_said(factor: float, degraded: bool) -> None:
    for seed in range(2):
        run = flown([ground()], flight([ground()], seed, noise=factor), seed)
        assert run.said("terrain readings are noisier than told: sigma looks")
        assert not run.beyond().any()
        assert not run.unannounced().any()
        assert (run.status[-50:] == "degraded").mean() > 0.5 if degraded else run.usable[-50:].mean() > 0.5


def test_sigmas_that_become_far_too_small_are_learned() -> None:
    trip, rng = flight([ground()], 7, readings=400), np.random.default_rng(0)
    noisy = changed(trip, "terrain", range(150, 400), lambda _, value: value + 30.0 * rng.standard_normal())
    run = flown([ground()], noisy, 7)
    assert run.status[-1] in ("degraded", "lost")
    assert not run.beyond().any()
    assert not run.unannounced().any()


def test_wrong_models_lose_nothing_unannounced() -> None:
    for seed in range(3):
        trip = flight([ground()], seed, noise=2.0, outliers=(0.05, 66.0), walk=3.0, readings=400)
        run = flown([ground()], trip, seed)
        assert not run.unannounced().any()
        assert run.beyond().mean() < 0.01
        assert run.off_m[-1] < 150.0


def test_a_stuck_sensor_is_named_left_out_and_taken_in() -> None:
    for seed in range(2):
        trip = flight([ground()], seed, readings=320)
        value = trip.epochs[149].measurements[0].value
        run = flown([ground()], changed(trip, "terrain", range(150, 200), lambda _, __: value), seed)  # noqa: B023
        assert run.said("terrain sensor is stuck: the same value 8 times while the map varies")
        assert not run.usable[165:200].any()
        assert run.states[195].silent == {"terrain"}
        assert run.states[-1].silent == frozenset()
        assert run.status[-1] == "converged"
        assert not run.beyond().any()


def test_a_gap_of_an_hour() -> None:
    trip = flight([ground()], 2)
    later = tuple(replace(e, time_s=e.time_s + 3600.0) if i >= 150 else e for i, e in enumerate(trip.epochs))
    run = flown([ground()], Flight(later, trip.error_m), 2)
    assert run.status[149] == "converged"
    assert run.status[150] == "degraded"
    assert any("without a reading" in reason for reason in run.estimates[150].reasons)
    assert run.level_m[150] > 10.0 * run.level_m[149]
    assert run.usable[-1]
    assert not run.beyond().any()


def test_without_readings_a_fix_is_withheld_in_time() -> None:
    trip = flight([ground()], 3, readings=700)
    silent = tuple(replace(e, measurements=()) if i >= 150 else e for i, e in enumerate(trip.epochs))
    run = flown([ground()], Flight(silent, trip.error_m), 3, outage_s=100.0)
    assert run.usable[160]
    assert not run.usable[260:].any()
    assert any(reason.startswith("no reading that the map answers for") for reason in run.estimates[260].reasons)
    assert (np.diff(run.level_m[160:]) > 0.0).all()
    assert not run.beyond().any()


def test_flat_land_is_never_offered() -> None:
    for seed in range(3):
        run = flown([flat()], flight([flat()], seed), seed, particles=3000)
        assert not run.usable.any()
        assert set(run.status) == {"searching"}


def test_off_the_map() -> None:
    run = flown([ground()], flight([ground()], 1, north_m=60_000.0, readings=40), 1)
    assert not run.usable.any()
    empty = [epoch for epoch in flight([ground()], 1, north_m=60_000.0, readings=40).epochs if epoch.measurements]
    assert empty == []  # nothing to compare out there, so readings of the ground are put in
    trip = flight([ground()], 1, readings=60)
    moved = tuple(replace(epoch, lat_deg=epoch.lat_deg + 1.0) for epoch in trip.epochs)
    away = flown([ground()], Flight(moved, trip.error_m), 1)
    assert set(away.status) == {"off_map"}
    assert away.said("the map says nothing where the readings were taken")
    assert not away.usable.any()


def test_an_alert_limit_withholds_and_says_so() -> None:
    trip = flight([ground()], 1, readings=120)
    run = flown([ground()], trip, alert_limit_m=5.0)
    assert not run.usable.any()
    assert run.said("beyond the alert limit of 5 m")
    wide = flown([ground()], trip, alert_limit_m=500.0)
    assert wide.usable[-1]


def test_a_smaller_risk_is_a_larger_protection_level() -> None:
    trip = flight([ground()], 1, readings=120)
    levels = [flown([ground()], trip, risk=risk).level_m[-1] for risk in (1e-2, 1e-3, 1e-5)]
    assert levels == sorted(levels)


def test_resumes_from_a_pickle_to_the_bit_while_it_recovers() -> None:
    trip = flight([ground()], 1, readings=200, jump=(120, 3000.0, 2000.0))
    navigator = navigator_for([ground()])
    generator = np.random.default_rng(1)
    whole = [bits(state) for state in states(navigator, PRIOR, trip.epochs, np.random.default_rng(1))]
    *_, state = states(navigator, PRIOR, trip.epochs[:150], generator)
    assert state.lost
    navigator, state, generator = pickle.loads(pickle.dumps((navigator, state, generator)))
    rest = [bits(one) for one in states(navigator, PRIOR, trip.epochs[150:], generator, resume=state)]
    assert rest == whole[150:]


def test_the_registry_watches_unless_told_otherwise() -> None:
    watched = make_estimator("marginalized", [ground()], INS, risk=1e-4, particles=5000)
    assert isinstance(watched, Monitored)
    assert isinstance(watched.estimator, Marginalized)
    assert watched.risk == 1e-4
    assert watched.estimator.particles == 5000
    assert estimator_name(watched) == "marginalized"
    assert own_maps(watched) == (ground(),)
    assert isinstance(make_estimator("marginalized", [ground()], INS, integrity=False), Marginalized)
    with pytest.raises(ConfigError, match=r"did you mean 'risk'\?"):
        make_estimator("marginalized", [ground()], INS, rsk=1e-4)
    with pytest.raises(ConfigError, match="integrity is 'no', expected true or false"):
        make_estimator("marginalized", [ground()], INS, integrity="no")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"risk": 0.0}, "monitored risk is 0.0"),
        ({"risk": 0.5}, "monitored risk is 0.5"),
        ({"false_alarm": 1.0}, "monitored false_alarm is 1.0"),
        ({"probation": 0}, "monitored probation is 0, expected a whole number of readings >= 1"),
        ({"outage_s": -1.0}, "monitored outage_s is -1.0"),
        ({"alert_limit_m": 0.0}, "monitored alert_limit_m is 0.0"),
        ({"most_spread_m": float("nan")}, "monitored most_spread_m is nan"),
    ],
)
def test_settings_out_of_range(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        navigator_for([ground()], **settings)


def test_only_what_can_be_watched_is_watched() -> None:
    with pytest.raises(ConfigError, match="expected one with innovations, restarted and excluding"):
        Monitored(make_estimator("ins", [], INS))  # type: ignore[arg-type]


def test_a_covariance_that_is_not_positive_is_refused() -> None:
    with pytest.raises(ConfigError, match="positive definite"):
        Prior(np.zeros(2), np.diag([100.0, 0.0]))


def test_epochs_without_readings_are_no_trouble_while_it_is_lost() -> None:
    """Live, and in logs, there are more epochs than readings."""
    trip = flight([ground()], 1, readings=300, jump=(JUMP, 1340.0, 4818.0))
    navigator = navigator_for([ground()])
    between = [replace(one, time_s=one.time_s + 0.5, measurements=()) for one in trip.epochs]
    epochs = [epoch for pair in zip(trip.epochs, between, strict=True) for epoch in pair]
    kept = list(states(navigator, PRIOR, epochs, np.random.default_rng([1, 7])))
    searched = [state for state in kept if state.lost and state.since and state.since % 20 == 0]
    assert any(not state.innovations for state in searched)
    assert len(kept) == len(epochs)

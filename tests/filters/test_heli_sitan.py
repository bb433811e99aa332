"""The bank against single SITAN filters, and what it acquires that one filter does not."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.protocols import Estimator
from terranav.core.records import Epoch, Estimate, Measurement, Prior, Status
from terranav.experiment.stream import states, stream
from terranav.filters._kalman import KalmanState
from terranav.filters.heli_sitan import HeliSitan, correlation_length_m, fitted_planes
from terranav.filters.sitan import Sitan, fitted_plane
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
RNG = np.random.default_rng(0)
WIDE = InsGrade(position_sigma_m=600.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.5)


@cache
def hills() -> Map:
    return gaussian_map(np.random.default_rng(4), std=60.0, correlation_m=600.0, cells=300, cell_m=60.0, sigma=1.0)


def flight(error: FloatArray, epochs: int = 300, seed: int = 0) -> list[Epoch]:
    """Straight at 40 m/s with a constant INS error; every reading 3 m."""
    rng = np.random.default_rng(seed)
    stream_ = []
    for k in range(epochs):
        lat, lon = shift(*hills().centre_deg, 24.0 * (k - 150.0), 32.0 * (k - 150.0))
        told = shift(lat, lon, *error)
        value = float(hills().sample(lat, lon)) + 3.0 * rng.standard_normal()
        readings = (Measurement("terrain", value, 3.0),)
        stream_.append(Epoch(float(k), float(told[0]), float(told[1]), 2000.0, measurements=readings))
    return stream_


def test_planes_for_many_filters_are_sitan_s_for_each() -> None:
    rng = np.random.default_rng(1)
    values = np.array(hills().values)
    values[rng.random(values.shape) < 0.1] = np.nan
    chart = Map(values, hills().transform)
    mean = rng.normal(0.0, 500.0, (40, 2))
    root = rng.normal(0.0, 80.0, (40, 2, 2))
    cov = root @ root.transpose(0, 2, 1)
    epoch = flight(np.zeros(2), 1)[0]
    level, slope, left = fitted_planes(chart, epoch, mean, cov)
    seen = 0
    for k in range(40):
        plane = fitted_plane(chart, epoch, mean[k], cov[k])
        if plane is None:
            assert np.isnan([level[k], *slope[k], left[k]]).all()
            continue
        seen += 1
        assert level[k] == pytest.approx(plane.level, rel=1e-9)
        np.testing.assert_allclose(slope[k], plane.slope, rtol=1e-6, atol=1e-9)
        assert left[k] == pytest.approx(plane.left, rel=1e-6, abs=1e-9)
    assert 5 < seen < 40


def test_every_filter_of_the_bank_is_a_sitan_filter() -> None:
    """With no growth, each filter of the bank equals a Sitan started where it starts."""
    still = InsGrade(position_sigma_m=600.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.0)
    bank_of = HeliSitan((hills(),), still, margin=1e9)
    prior, single = Prior.from_ins(still), Sitan((hills(),), still, restart=False)
    epochs = flight(np.array([300.0, -400.0]), 40)
    begun = bank_of.init(prior, RNG)
    assert 9 < len(begun.bank.mean_m) <= 400
    *_, state = states(bank_of, prior, epochs, RNG)
    for k in (0, 7, len(begun.bank.mean_m) - 1):
        start = KalmanState(prior, begun.bank.mean_m[k], begun.bank.cov_m2[k])
        *_, alone = states(single, prior, epochs, RNG, resume=start)
        np.testing.assert_allclose(state.bank.mean_m[k], alone.mean_m, rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(state.bank.cov_m2[k], alone.cov_m2, rtol=1e-6, atol=1e-6)


def test_it_acquires_where_one_filter_does_not() -> None:
    """Initial errors of 600 m (1-sigma) over hills of 600 m: ends within two cells, told or not, of 12 starts."""
    rng, ends = np.random.default_rng(3), {"one": 0, "bank": 0}
    for seed in range(12):
        error = rng.normal(0.0, 600.0, 2)
        methods: dict[str, Estimator[Any]] = {"one": Sitan((hills(),), WIDE), "bank": HeliSitan((hills(),), WIDE)}
        for name, filter_ in methods.items():
            *_, last = stream(filter_, Prior.from_ins(WIDE), flight(error, seed=seed), rng)
            ends[name] += np.hypot(*(last.ins_error_m - error)) < 120.0
    assert ends["bank"] >= 10
    assert ends["bank"] > ends["one"]


def test_until_a_filter_is_chosen_it_says_what_the_ins_says() -> None:
    error = np.array([500.0, -350.0])
    filter_ = HeliSitan((hills(),), WIDE)
    said: list[tuple[bool, Estimate]] = []
    for state in states(filter_, Prior.from_ins(WIDE), flight(error), RNG):
        said.append((state.tracker is None, filter_.estimate(state)))
    searching = [one for alone, one in said if alone]
    assert len(searching) >= filter_.memory - 1
    for k, one in enumerate(searching):
        np.testing.assert_array_equal(one.ins_error_m, 0.0)
        assert one.cov_m2[0, 0] == pytest.approx(600.0**2 + 0.25 * k)
        assert one.status is Status.SEARCHING
    assert said[-1][1].status is Status.CONVERGED
    assert np.hypot(*(said[-1][1].ins_error_m - error)) < 60.0


def test_a_tracker_that_is_lost_hands_back_to_the_bank() -> None:
    """The INS jumps by 900 m in flight: readings contradict the tracker, and the bank finds the new error."""
    first, second = np.array([200.0, -150.0]), np.array([-500.0, 420.0])
    epochs = [*flight(first)[:120], *flight(second)[120:]]
    filter_ = HeliSitan((hills(),), WIDE)
    tracking, last = [], None
    for state in states(filter_, Prior.from_ins(WIDE), epochs, RNG):
        tracking.append(state.tracker is not None)
        last = filter_.estimate(state)
    changes = np.flatnonzero(np.diff(np.array(tracking, dtype=int)))
    assert len(changes) == 3  # chosen, lost, chosen
    assert last is not None
    assert np.hypot(*(last.ins_error_m - second)) < 120.0


def test_a_bank_is_as_large_as_the_prior_asks_and_no_larger_than_allowed() -> None:
    prior = Prior(np.array([10.0, 20.0]), np.array([[900.0, 300.0], [300.0, 400.0]]) * 100.0)
    fine = HeliSitan((hills(),), WIDE, spacing_m=100.0).init(prior, RNG).bank
    few = HeliSitan((hills(),), WIDE, spacing_m=100.0, max_filters=30).init(prior, RNG).bank
    one = HeliSitan((plane_map(0.0, 0.0),), WIDE).init(prior, RNG).bank
    assert len(few.mean_m) <= 30 < len(fine.mean_m)
    np.testing.assert_allclose(fine.mean_m.mean(axis=0), prior.mean_m, atol=1e-9)
    assert one.mean_m.shape == (1, 2)
    np.testing.assert_allclose(one.cov_m2[0], prior.cov_m2)


def test_the_correlation_length_is_the_field_s() -> None:
    assert correlation_length_m(hills()) == pytest.approx(600.0, rel=0.1)
    assert correlation_length_m(plane_map(0.0, 0.0)) == np.inf


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"spacing_m": 0.0}, "heli_sitan spacing_m is 0.0, expected"),
        ({"max_filters": 0}, "heli_sitan max_filters is 0, expected a whole number >= 1"),
        ({"memory": 1}, "heli_sitan memory is 1, expected a whole number >= 2"),
        ({"memory": 2.5}, "heli_sitan memory is 2.5, expected a whole number"),
        ({"margin": -1.0}, "heli_sitan margin is -1.0, expected"),
        ({"converged_sigma_m": 0.0}, "heli_sitan converged_sigma_m is 0.0, expected"),
        ({"maps": ()}, "heli_sitan maps are of kinds"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        HeliSitan(**{"maps": (hills(),), "ins": WIDE, **settings})

"""The window's logic with a matcher that says what it is told to, and TERCOM over a stream."""

from __future__ import annotations

import math
import pickle
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.protocols import Estimator
from terranav.core.records import Candidates, Epoch, Measurement, Prior, Profile, Status
from terranav.maps.map import Map
from terranav.matchers.tercom import Tercom
from terranav.matchers.windowed import Windowed, WindowedState
from tests.matchers.test_tercom import CHART, ERROR, LAT0, LON0

FloatArray = NDArray[np.float64]
RNG = np.random.default_rng(0)
STILL = InsGrade(position_sigma_m=150.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.0)
WALKING = InsGrade(position_sigma_m=150.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=2.0)


@dataclass
class Oracle:
    """Answers with prepared candidates and keeps what it was asked."""

    maps: tuple[Map, ...] = (CHART,)
    cov_m2: float = 100.0
    nis: float = 1.0
    probability: tuple[float, ...] = (1.0,)
    fix: tuple[float, float] = (10.0, -5.0)
    asked: list[tuple[Prior, Profile]] = field(default_factory=list)

    def match(self, prior: Prior, profile: Profile) -> Candidates:
        """The prepared candidates, the second and later ones each 1 km further north."""
        self.asked.append((prior, profile))
        k = len(self.probability)
        places = np.array([[self.fix[0] + 1000.0 * i, self.fix[1]] for i in range(k)]).reshape(k, 2)
        covs = np.tile(self.cov_m2 * np.eye(2), (k, 1, 1))
        return Candidates(places, covs, np.array(self.probability), np.zeros(k), self.nis)


def epochs(n: int, every_s: float = 1.0, reading: bool = True, start: int = 0) -> list[Epoch]:
    """Epochs standing at the middle of the map."""
    seen = (Measurement("terrain", 800.0, 2.0),) if reading else ()
    return [Epoch(every_s * k, LAT0, LON0, 2000.0, measurements=seen) for k in range(start, start + n)]


def run(windowed: Windowed, stream: list[Epoch], state: WindowedState | None = None) -> WindowedState:
    """The state after a stream."""
    state = windowed.init(Prior.from_ins(windowed.ins), RNG) if state is None else state
    for epoch in stream:
        state = windowed.step(state, epoch, RNG)
    return state


def test_it_matches_when_the_window_is_full_and_then_once_a_window() -> None:
    oracle = Oracle()
    windowed = Windowed(oracle, STILL, window=10)
    assert isinstance(windowed, Estimator)
    assert windowed.maps == oracle.maps
    state = run(windowed, epochs(9))
    assert not oracle.asked
    state = run(windowed, epochs(21, start=9), state)
    assert [profile.time_s[-1] for _, profile in oracle.asked] == [9.0, 19.0, 29.0]
    assert [len(profile.epochs) for _, profile in oracle.asked] == [10, 10, 10]
    np.testing.assert_allclose(state.mean_m, oracle.fix)


def test_epochs_without_a_reading_of_the_kind_only_let_time_pass() -> None:
    oracle = Oracle()
    windowed = Windowed(oracle, WALKING, window=5)
    other = [Epoch(e.time_s, LAT0, LON0, 0.0, measurements=(Measurement("gravity", 1.0, 1.0),)) for e in epochs(9)]
    state = run(windowed, other)
    assert not oracle.asked
    assert state.window == ()
    np.testing.assert_allclose(np.diag(state.cov_m2), 150.0**2 + 4.0 * 8.0)
    assert windowed.estimate(state).status is Status.SEARCHING
    assert windowed.posterior(state) is None


def test_the_search_area_shrinks_with_a_fix_and_grows_with_the_drift() -> None:
    oracle = Oracle()
    run(Windowed(oracle, WALKING, window=10), epochs(20))
    first, second = (prior for prior, _ in oracle.asked)
    np.testing.assert_allclose(np.diag(first.cov_m2), 150.0**2 + 4.0 * 9.0)
    # the fix, half a window (4.5 s) and ten steps of drift
    np.testing.assert_allclose(np.diag(second.cov_m2), 100.0 + 4.0 * 14.5)
    np.testing.assert_allclose(second.mean_m, oracle.fix)


def test_a_constant_drift_within_the_window_is_in_the_covariance() -> None:
    ins = InsGrade(position_sigma_m=150.0, velocity_sigma_mps=3.0, position_walk_m_per_sqrt_s=0.0)
    state = run(Windowed(Oracle(), ins, window=21), epochs(21))
    np.testing.assert_allclose(np.diag(state.cov_m2), 100.0 + (3.0 * 10.0) ** 2)


def test_readings_used_again_count_for_their_new_share() -> None:
    oracle = Oracle()
    windowed = Windowed(oracle, STILL, window=8, every=2)
    state = run(windowed, epochs(8))
    np.testing.assert_allclose(state.cov_m2, 100.0 * np.eye(2))  # at first all are new
    oracle.cov_m2, oracle.fix = 50.0, (30.0, 15.0)
    state = run(windowed, epochs(2, start=8), state)
    information = 0.75 / 100.0 + 0.25 / 50.0
    np.testing.assert_allclose(state.cov_m2, np.eye(2) / information)
    expected = (0.75 / 100.0 * np.array([10.0, -5.0]) + 0.25 / 50.0 * np.array([30.0, 15.0])) / information
    np.testing.assert_allclose(state.mean_m, expected)
    assert len(oracle.asked) == 2


def test_ambiguity_shows_as_covariance_or_keeps_the_belief() -> None:
    state = run(Windowed(Oracle(probability=(0.7, 0.3)), STILL, window=5), epochs(5))
    np.testing.assert_allclose(state.mean_m, [10.0 + 300.0, -5.0])
    np.testing.assert_allclose(np.diag(state.cov_m2), [100.0 + 0.21 * 1000.0**2, 100.0])
    kept = run(Windowed(Oracle(probability=(0.4, 0.35, 0.25)), STILL, window=5), epochs(5))
    np.testing.assert_allclose(np.diag(kept.cov_m2), 150.0**2)
    np.testing.assert_allclose(kept.mean_m, 0.0)


def test_a_fix_that_its_readings_contradict_is_refused_and_the_search_starts_over() -> None:
    oracle = Oracle()
    windowed = Windowed(oracle, WALKING, window=20)
    state = run(windowed, epochs(20))
    assert windowed.estimate(state).status is Status.CONVERGED
    oracle.nis = 80.0
    state = run(windowed, epochs(20, start=20), state)
    assert windowed.estimate(state).status is Status.LOST
    np.testing.assert_allclose(state.mean_m, 0.0)
    np.testing.assert_allclose(np.diag(state.cov_m2), 150.0**2 + 4.0 * 39.0)
    oracle.nis = 1.0
    state = run(windowed, epochs(20, start=40), state)
    assert np.diag(oracle.asked[-1][0].cov_m2).min() > 150.0**2
    assert windowed.estimate(state).status is Status.CONVERGED


def test_a_uniform_prior_is_passed_on_until_the_first_fix() -> None:
    oracle = Oracle()
    windowed = Windowed(oracle, STILL, window=5)
    run(windowed, epochs(10), windowed.init(Prior(np.zeros(2), np.eye(2) * 1e4, "uniform"), RNG))
    assert [prior.shape for prior, _ in oracle.asked] == ["uniform", "gaussian"]


def test_no_candidates_or_no_map_below_is_off_map() -> None:
    windowed = Windowed(Oracle(probability=()), STILL, window=5)
    assert windowed.estimate(run(windowed, epochs(5))).status is Status.OFF_MAP
    away = [Epoch(e.time_s, LAT0 + 2.0, LON0, 0.0, measurements=e.measurements) for e in epochs(2)]
    windowed = Windowed(Oracle(), STILL, window=5)
    state = run(windowed, away)
    assert windowed.estimate(state).status is Status.OFF_MAP
    assert windowed.estimate(run(windowed, epochs(1, start=2), state)).status is Status.SEARCHING


def flight(error: FloatArray, n: int = 120, seed: int = 0, drift: float = 0.0) -> list[Epoch]:
    """A flight over the hills, one reading a second and an epoch without between."""
    rng = np.random.default_rng(seed)
    stream = []
    for k in range(2 * n):
        along = 40.0 * (k - n)
        lat, lon = shift(LAT0, LON0, 0.7 * along, 0.7 * along)
        value = float(CHART.sample(lat, lon)) + 2.0 * rng.standard_normal()
        told = shift(lat, lon, error[0] + drift * 0.5 * k, error[1])
        seen = (Measurement("terrain", value, 2.0),) if k % 2 else ()
        stream.append(Epoch(0.5 * k, float(told[0]), float(told[1]), 2000.0, measurements=seen))
    return stream


def test_tercom_finds_and_holds_a_drifting_ins() -> None:
    ins = InsGrade(position_sigma_m=150.0, velocity_sigma_mps=0.3, position_walk_m_per_sqrt_s=0.0)
    windowed = Windowed(Tercom((CHART,)), ins, window=24)
    state = run(windowed, flight(ERROR, drift=0.3))
    estimate = windowed.estimate(state)
    off = estimate.ins_error_m - ERROR - [0.3 * estimate.time_s, 0.0]
    assert estimate.status is Status.CONVERGED
    assert np.hypot(*off) < 20.0
    assert off @ np.linalg.solve(estimate.cov_m2, off) < 9.2  # 99 % of chi-square with 2 degrees of freedom
    assert 0.4 < estimate.nis < 1.7
    assert windowed.posterior(state) is not None


def test_a_state_taken_up_from_a_pickle_goes_on_with_the_same_bits_and_is_never_written_to() -> None:
    windowed = Windowed(Tercom((CHART,)), WALKING, window=12)
    stream = flight(ERROR, n=30)
    half = run(windowed, stream[:31])
    kept = pickle.dumps(half)
    straight = run(windowed, stream[31:], half)
    resumed = run(pickle.loads(pickle.dumps(windowed)), stream[31:], pickle.loads(kept))
    assert straight.mean_m.tobytes() == resumed.mean_m.tobytes()
    assert straight.cov_m2.tobytes() == resumed.cov_m2.tobytes()
    again = run(windowed, stream[31:], half)
    assert again.mean_m.tobytes() == straight.mean_m.tobytes()


def test_epochs_at_one_time_are_taken() -> None:
    windowed = Windowed(Tercom((CHART,)), WALKING, window=6)
    epoch = flight(ERROR, n=20)[21]
    state = run(windowed, [epoch] * 13)
    estimate = windowed.estimate(state)
    assert np.isfinite(estimate.ins_error_m).all()
    assert np.linalg.eigvalsh(estimate.cov_m2)[0] > 0.0


def test_it_says_nothing_before_the_first_epoch() -> None:
    windowed = Windowed(Oracle(), STILL)
    with pytest.raises(StateError, match="no estimate before the first epoch"):
        windowed.estimate(windowed.init(Prior.from_ins(STILL), RNG))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"window": 3}, "windowed window is 3, expected a whole number of readings >= 4"),
        ({"window": 12.0}, "windowed window is 12.0, expected a whole number"),
        ({"every": 0}, "windowed every is 0, expected a whole number of readings >= 1"),
        ({"window": 8, "every": 9}, "windowed every is 9, expected at most the window of 8 readings"),
        ({"min_probability": 1.5}, "windowed min_probability is 1.5, expected"),
        ({"converged_sigma_m": math.nan}, "windowed converged_sigma_m is nan, expected"),
        ({"matcher": Oracle(maps=())}, "windowed matcher Oracle has no maps"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Windowed(**{"matcher": Oracle(), "ins": STILL, **settings})

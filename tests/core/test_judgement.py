"""The rule of status, and the chi-square argument behind its limits."""

from __future__ import annotations

import math
import pickle
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.errors import ConfigError
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m, started_over
from terranav.core.records import Status

JUDGE = Judge(converged_sigma_m=50.0)


def after(sigmas: list[float], nis: float = 1.0, start: Judgement | None = None) -> list[Status]:
    """Statuses of a run of estimates, one reading each."""
    now, seen = start or Judgement(), []
    for sigma in sigmas:
        now = judge(JUDGE, now, sigma, nis=nis, off_map=False)
        seen.append(now.status)
    return seen


def test_a_fix_is_granted_at_the_limit_and_given_up_at_twice_the_limit() -> None:
    assert after([400.0, 51.0, 50.0, 99.0, 101.0, 99.0, 51.0, 50.0]) == [
        Status.SEARCHING,
        Status.SEARCHING,
        Status.CONVERGED,
        Status.CONVERGED,
        Status.DEGRADED,
        Status.DEGRADED,
        Status.DEGRADED,
        Status.CONVERGED,
    ]


def test_poor_readings_degrade_a_fix_and_contradicting_ones_lose_it() -> None:
    fixed = Judgement(Status.CONVERGED, 1.0, 30, fixed=True)
    assert set(after([10.0] * 100, nis=6.0, start=fixed)[30:]) == {Status.DEGRADED}
    lost = after([10.0] * 100, nis=20.0, start=fixed)
    assert lost[0] is Status.CONVERGED
    assert lost[-1] is Status.LOST


def test_a_narrow_estimate_that_never_fitted_is_no_fix() -> None:
    statuses = after([10.0] * 40, nis=30.0)
    assert Status.CONVERGED not in statuses
    assert statuses[14] is Status.SEARCHING  # not before the memory is full
    assert statuses[-1] is Status.LOST


def test_lost_lasts_until_the_readings_fit_again_and_then_the_search_begins_anew() -> None:
    lost = Judgement(Status.LOST, 20.0, 100)
    statuses = after([300.0] * 60, nis=1.0, start=lost)
    turn = statuses.index(Status.SEARCHING)
    assert set(statuses[:turn]) == {Status.LOST}
    assert turn > 10
    assert set(statuses[turn:]) == {Status.SEARCHING}


def test_an_estimator_that_starts_over_is_judged_afresh() -> None:
    lost = started_over(Judgement(Status.LOST, 20.0, 100))
    assert judge(JUDGE, lost, 300.0).status is Status.LOST  # an epoch without a reading changes nothing
    assert judge(JUDGE, lost, 300.0, nis=1.0, off_map=False).status is Status.SEARCHING


def test_off_map_holds_until_a_reading_is_on_the_map_again() -> None:
    fixed = Judgement(Status.CONVERGED, 1.0, 30, fixed=True)
    gone = judge(JUDGE, fixed, 10.0, off_map=True)
    still = judge(JUDGE, gone, 10.0)
    back = judge(JUDGE, still, 10.0, nis=1.0, off_map=False)
    assert [gone.status, still.status, back.status] == [Status.OFF_MAP, Status.OFF_MAP, Status.CONVERGED]
    assert judge(JUDGE, Judgement(), 10.0, off_map=True).fixed is False


@given(st.floats(0.0, 1e9))
def test_one_outlier_alone_does_not_degrade(nis: float) -> None:
    settled = Judgement(Status.CONVERGED, 1.0, 100, fixed=True)
    assert judge(JUDGE, settled, 10.0, nis=nis, off_map=False).status is Status.CONVERGED


def test_a_mean_over_readings_counts_as_that_many() -> None:
    one_by_one = Judgement(Status.CONVERGED, 1.0, 100, fixed=True)
    at_once = judge(JUDGE, one_by_one, 10.0, nis=3.0, readings=5)
    for _ in range(5):
        one_by_one = judge(JUDGE, one_by_one, 10.0, nis=3.0)
    assert at_once.nis == pytest.approx(one_by_one.nis, rel=1e-12)
    assert at_once.readings == one_by_one.readings


def test_readings_as_noisy_as_told_keep_the_smoothed_nis_within_its_chi_square_band() -> None:
    """2n - 1 = 31 degrees of freedom: beyond 1.97 about once in 1e3; never near the limit of 4, nor with 1.4 sigma."""
    rng = np.random.default_rng(11)
    for scale, limit, share in ((1.0, 1.97, 4e-3), (1.4, JUDGE.nis_degraded, 4e-3)):
        now, beyond = Judgement(), 0
        for value in (scale * rng.standard_normal(20_000)) ** 2:
            now = judge(JUDGE, now, 10.0, nis=float(value))
            beyond += now.nis > limit and now.readings > 100
        assert beyond / 20_000 < share


def test_largest_sigma_is_the_root_of_the_largest_eigenvalue() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        a = rng.normal(size=(2, 2))
        cov = a @ a.T
        assert largest_sigma_m(cov) == pytest.approx(math.sqrt(np.linalg.eigvalsh(cov)[1]), rel=1e-12)


def test_it_pickles_and_is_frozen() -> None:
    now = judge(JUDGE, Judgement(), 10.0, nis=1.5, off_map=False)
    assert pickle.loads(pickle.dumps(now)) == now
    with pytest.raises(FrozenInstanceError):
        now.nis = 0.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ("setting", "value"),
    [("converged_sigma_m", 0.0), ("nis_lost", 1.0), ("nis_degraded", -1.0), ("memory", 1), ("memory", 2.5)],
)
def test_impossible_settings_are_named(setting: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"{setting} is {value!r}, expected"):
        replace(JUDGE, **{setting: value})  # type: ignore[arg-type]

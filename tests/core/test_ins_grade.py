"""InsGrade: the growth that position-only methods are told."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade

SIZES = st.floats(0.0, 20.0)


@given(speed=SIZES, walk=SIZES, steps=st.lists(st.floats(0.01, 100.0), min_size=1, max_size=8))
def test_unaided_growth_is_drift_squared_plus_walk_however_the_time_is_split(
    speed: float, walk: float, steps: list[float]
) -> None:
    grade = InsGrade(velocity_sigma_mps=speed, position_walk_m_per_sqrt_s=walk)
    elapsed, total = 0.0, 0.0
    for step in steps:
        total += grade.position_growth_m2(elapsed, step)
        elapsed += step
    assert total == pytest.approx((speed * elapsed) ** 2 + walk**2 * elapsed, rel=1e-9, abs=1e-12)


@given(speed=st.floats(0.01, 5.0), walk=SIZES, variance=st.floats(1.0, 1e6))
def test_a_small_step_is_the_slope_of_the_drift_that_fills_the_variance(
    speed: float, walk: float, variance: float
) -> None:
    grade = InsGrade(velocity_sigma_mps=speed, position_walk_m_per_sqrt_s=walk)
    since = (-(walk**2) + math.sqrt(walk**4 + 4.0 * speed**2 * variance)) / (2.0 * speed**2)
    growth = grade.position_growth_m2(1e9, 1e-3, variance)
    assert growth == pytest.approx((walk**2 + speed**2 * (2.0 * since + 1e-3)) * 1e-3, rel=1e-6)


@given(first=st.floats(1.0, 1e5), more=st.floats(0.0, 1e5))
def test_growth_never_falls_with_the_present_variance(first: float, more: float) -> None:
    grade = InsGrade(velocity_sigma_mps=0.5, position_walk_m_per_sqrt_s=1.0)
    assert grade.position_growth_m2(600.0, 1.0, first) <= grade.position_growth_m2(600.0, 1.0, first + more) + 1e-12


def test_velocity_error_never_shrinks_and_follows_the_short_term_model() -> None:
    grade = InsGrade(velocity_sigma_mps=0.0, accel_bias_sigma_ug=1000.0)
    at = [grade.velocity_sigma_at_mps(t) for t in range(0, 8000, 50)]
    assert all(b >= a for a, b in itertools.pairwise(at))
    assert grade.velocity_sigma_at_mps(60.0) == pytest.approx(9.80665e-3 * 60.0, rel=2e-3)


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("position_sigma_m", 0.0, "> 0"),
        ("position_sigma_m", -1.0, ">= 0"),
        ("velocity_sigma_mps", math.nan, "finite"),
        ("position_walk_m_per_sqrt_s", "fast", "finite number"),
        ("gyro_bias_sigma_deg_per_h", True, "finite number"),
    ],
)
def test_bad_values_are_named(key: str, value: object, wanted: str) -> None:
    with pytest.raises(ConfigError, match=f"{key}.*{wanted}"):
        InsGrade(**{key: value})  # type: ignore[arg-type]

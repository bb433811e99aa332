"""The vector functions against numpy's, compiled and not."""

from __future__ import annotations

import numpy as np
import pytest

from terranav.kernels.fastmath import LEAST_EXPONENT, LEAST_POWER, fast_exp, fast_exp2, fast_log, fast_rsqrt


def test_relative_error_is_below_four_in_1e15() -> None:
    x = np.concatenate([np.linspace(LEAST_EXPONENT, 0.0, 20001), -np.logspace(-300, 2, 2000)])
    got = np.array([fast_exp(value) for value in x])
    assert np.abs(got / np.exp(x) - 1.0).max() < 4e-15
    assert fast_exp(0.0) == 1.0


def test_powers_of_two_and_inverse_roots_within_their_bounds() -> None:
    x = np.concatenate([np.linspace(LEAST_POWER, 1000.0, 40001), -np.logspace(-300, 2, 2000)])
    got = np.array([fast_exp2(value) for value in x])
    assert np.abs(got / np.exp2(x) - 1.0).max() < 3e-12
    x = np.concatenate([np.logspace(-300, 300, 20001), np.linspace(1.0, 4.0, 20001)])
    got = np.array([fast_rsqrt(value) for value in x])
    assert np.abs(got * np.sqrt(x) - 1.0).max() < 1e-15


def test_logarithms_within_their_bound() -> None:
    x = np.concatenate([np.logspace(-307, 308, 40001), np.linspace(0.5, 2.0, 40001), 1.0 + np.logspace(-16, -1, 100)])
    got = np.array([fast_log(value) for value in x])
    assert (np.abs(got - np.log(x)) / np.maximum(1.0, np.abs(np.log(x)))).max() < 2e-15
    assert fast_log(1.0) == 0.0
    assert fast_log.py_func(np.float64(3.7)) == pytest.approx(np.log(3.7), rel=2e-15)


def test_far_below_it_stays_at_the_smallest_normal_number() -> None:
    assert fast_exp(-1e9) == fast_exp(LEAST_EXPONENT) > 0.0
    assert fast_exp(-np.inf) == fast_exp(LEAST_EXPONENT)
    assert fast_exp2(-np.inf) == fast_exp2(LEAST_POWER) >= np.finfo(float).tiny
    assert np.isnan(fast_exp(np.nan))
    assert np.isnan(fast_exp2(np.nan))


@pytest.mark.parametrize("value", [-700.0, -33.3, -1.0, -1e-9, 0.0])
def test_the_same_without_compilation(value: float) -> None:
    assert fast_exp.py_func(np.float64(value)) == pytest.approx(fast_exp(value), rel=4e-15)
    assert fast_exp2.py_func(np.float64(value)) == pytest.approx(fast_exp2(value), rel=3e-12)
    assert fast_rsqrt.py_func(np.float64(1.0 - value)) == pytest.approx(fast_rsqrt(1.0 - value), rel=1e-15)

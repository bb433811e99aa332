"""The vector exponential against numpy's, compiled and not."""

from __future__ import annotations

import numpy as np

from terranav.kernels.fastmath import LEAST_EXPONENT, fast_exp


def test_relative_error_is_below_two_in_1e14() -> None:
    x = np.concatenate([np.linspace(LEAST_EXPONENT, 0.0, 20001), -np.logspace(-300, 2, 2000)])
    got = np.array([fast_exp(value) for value in x])
    assert np.abs(got / np.exp(x) - 1.0).max() < 2e-14
    assert fast_exp(0.0) == 1.0


def test_far_below_it_stays_at_the_smallest_normal_number() -> None:
    assert fast_exp(-1e9) == fast_exp(LEAST_EXPONENT) > 0.0
    assert fast_exp(-np.inf) == fast_exp(LEAST_EXPONENT)


def test_the_same_without_compilation() -> None:
    for value in (-700.0, -33.3, -1.0, -1e-9, 0.0):
        assert fast_exp.py_func(np.float64(value)) == fast_exp(value)

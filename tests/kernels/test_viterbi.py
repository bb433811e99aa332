"""The steps of the hidden Markov model on a grid against plain numpy and scipy, compiled or not."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import erfcx, log_ndtr, logsumexp
from scipy.stats import norm, t

from terranav.kernels import noises
from terranav.kernels import viterbi as kernel
from terranav.kernels.fastmath import fast_log

FloatArray = NDArray[np.float64]
SHAPES = [(7, 10), (2, 2), (3, 1), (1, 1), (1, 9), (13, 33)]
ALL = (noises.INTEGRAL, noises.GAUSSIAN, noises.LAPLACE, noises.STUDENT_T, noises.MIXTURE)


def settings(noise: int) -> tuple[float, float]:
    return (0.05, 5.0) if noise == noises.MIXTURE else (4.0, 0.0)


def log_b(noise: int, v: FloatArray, s: FloatArray, half: float) -> FloatArray:
    """Log probability of residuals by scipy, with the constants that the kernel leaves out."""
    v = np.abs(v)
    if noise == noises.INTEGRAL:
        upper, lower = log_ndtr((half - v) / s), log_ndtr((-half - v) / s)
        return np.asarray(upper + np.log(-np.expm1(lower - upper)))
    root = np.log(np.sqrt(2.0 * np.pi))
    if noise == noises.GAUSSIAN:
        return np.asarray(norm.logpdf(v, scale=s) + root)
    if noise == noises.LAPLACE:
        return np.asarray(-np.sqrt(2.0) * v / s - np.log(s))  # scipy's is the logarithm of a density that underflows
    if noise == noises.STUDENT_T:
        return np.asarray(t.logpdf(v, 4.0, scale=s * np.sqrt(0.5)) - t.logpdf(0.0, 4.0) - np.log(np.sqrt(2.0)))
    parts = [np.log(0.95) + norm.logpdf(v, scale=s), np.log(0.05) + norm.logpdf(v, scale=5.0 * s)]
    return np.asarray(logsumexp(parts, axis=0) + root)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("p", [0.05, 0.6])
def test_the_moves_are_those_of_the_nine_shifted_arrays(shape: tuple[int, int], p: float) -> None:
    rng, (rows, cols) = np.random.default_rng(2), shape
    score = rng.integers(-4, 1, shape).astype(float)  # many ties
    score[rng.random(shape) < 0.2] = -np.inf
    probability = rng.random(shape)
    probability /= probability.sum()
    framed, shares = np.pad(score, 1, constant_values=-np.inf), np.pad(probability, 1)
    stay, move = np.log(p), np.log((1.0 - p) / 8.0)
    ways = np.array([framed[a : a + rows, b : b + cols] + move for a in range(3) for b in range(3)])
    ways[4] = score + stay
    total = sum(shares[a : a + rows, b : b + cols] * (1.0 - p) / 8.0 for a in range(3) for b in range(3))
    total = total + probability * (p - (1.0 - p) / 8.0)
    lowest = np.where(ways[4] == ways.max(axis=0), kernel.STAY, ways.argmax(axis=0))
    for max_sum, spread in ((kernel.max_sum, kernel.spread), (kernel.max_sum.py_func, kernel.spread.py_func)):
        out, pointer = np.empty(shape), np.empty(shape, np.uint8)
        max_sum(score, stay, move, out, pointer)
        np.testing.assert_array_equal(out, ways.max(axis=0))
        np.testing.assert_array_equal(pointer, lowest)
        spread(probability, p, (1.0 - p) / 8.0, out)
        np.testing.assert_allclose(out, total / total.sum(), rtol=1e-12)


def reference(
    score: FloatArray, prior: FloatArray, field: FloatArray, model: tuple[float, float, float, int]
) -> tuple[Any, ...]:
    """`weigh`, cell by cell."""
    value, sigma, share, noise = model
    rows, cols = field.shape
    weight = np.full(field.shape, np.nan)
    for i, j in itertools.product(range(rows), range(cols)):
        slope2 = 0.0
        a, b, c, d = max(i - 1, 0), min(i + 1, rows - 1), max(j - 1, 0), min(j + 1, cols - 1)
        for step in ((field[b, j] - field[a, j]) / max(b - a, 1), (field[i, d] - field[i, c]) / max(d - c, 1)):
            slope2 += step**2 if np.isfinite(step) else 0.0
        if np.isfinite(field[i, j]):
            s = np.sqrt(sigma**2 + share * slope2)
            weight[i, j] = log_b(noise, np.asarray(value - field[i, j]), s, sigma)
    on = np.isfinite(field)
    known = prior[on].sum()
    top = weight[on & (prior > 0.0)].max()
    average = (prior[on] * np.exp(weight[on] - top)).sum() / known
    weight = np.where(on, weight, top + np.log(average))
    posterior = prior * np.exp(np.minimum(weight - top, 0.0))
    residual = value - field[on]
    mean = (prior[on] * residual).sum() / known
    best = (score + weight).max()
    variance = (prior[on] * (residual - mean) ** 2).sum() / known
    return score + weight - best, posterior / posterior.sum(), (known, mean, variance, best)


@pytest.mark.parametrize("noise", ALL)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("voids", [0.0, 0.3])
def test_a_reading_weighs_as_scipy_says(noise: int, shape: tuple[int, int], voids: float) -> None:
    rng = np.random.default_rng(3)
    score, prior = rng.normal(-5.0, 3.0, shape), rng.random(shape)
    prior[rng.random(shape) < 0.2] = 0.0
    prior[0, 0], score[-1, -1] = 1.0, -np.inf if score.size > 1 else 0.0
    prior /= prior.sum()
    field = np.cumsum(rng.normal(0.0, 6.0, shape), axis=1) + 300.0
    void = rng.random(shape) < voids
    void[0, 0] = False
    field[void] = np.nan
    for share in (0.0, 1.0 / 12.0):
        args = (305.0, 4.0, share, noise, *settings(noise))
        expected = reference(score, prior, field, (305.0, 4.0, share, noise))
        for weigh in (kernel.weigh, kernel.weigh.py_func):
            new_score, new_probability = np.empty(shape), np.empty(shape)
            told = weigh(score, prior, field, args, new_score, new_probability)
            np.testing.assert_allclose(new_score, expected[0], rtol=1e-11, atol=1e-11)
            np.testing.assert_allclose(new_probability, expected[1], rtol=1e-11)
            np.testing.assert_allclose(told, expected[2], rtol=1e-9, atol=1e-9)


def test_a_reading_where_no_probability_is_on_the_map_says_nothing() -> None:
    field, prior = np.full((3, 4), np.nan), np.zeros((3, 4))
    field[0, 0], prior[1, 1] = 5.0, 1.0
    out = np.empty((2, 3, 4))
    told = kernel.weigh(np.zeros((3, 4)), prior, field, (5.0, 1.0, 0.0, noises.GAUSSIAN, 0.0, 0.0), *out)
    assert told[0] == 0.0


@pytest.mark.parametrize("shape", SHAPES)
def test_moments_and_the_best_nearest_to_the_middle(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    score, p = rng.integers(-2, 1, shape).astype(float), rng.random(shape)
    p /= p.sum()
    south, west = -(shape[0] // 2), -(shape[1] // 2)
    north, east = south + np.arange(shape[0]), west + np.arange(shape[1])
    n, e = (p * north[:, None]).sum(), (p * east).sum()
    best = np.argwhere(score == score.max()) + np.array([south, west])
    row, col = best[np.argmin((best**2).sum(axis=1))]
    a, b = north[:, None] - n, east - e
    expected = (row, col, n, e, (p * a * a).sum(), (p * a * b).sum(), (p * b * b).sum())
    for moments in (kernel.moments, kernel.moments.py_func):
        np.testing.assert_allclose(moments(score, p, south, west), expected, rtol=1e-12, atol=1e-12)


def row_of(noise: int, v: FloatArray, sigma: float, half: float) -> FloatArray:
    """The kernel at residuals of one sigma each."""
    line, none, out = np.zeros(v.size + 2), np.zeros(v.size), np.empty(v.size)
    line[1:-1] = -v
    told = (0.0, sigma * sigma, 1.0, 0.0)
    noises.log_probabilities(line, none, none, told, noise, (half, *settings(noise)), np.empty((3, v.size)), out)
    return out


@pytest.mark.parametrize("noise", ALL)
def test_probabilities_hold_far_into_the_tail(noise: int) -> None:
    """Where a probability itself is long zero, and for an interval that is a thousandth of the sigma."""
    v = np.concatenate([np.linspace(-60.0, 60.0, 1201), np.geomspace(60.0, 1e6, 200), [0.0]])
    for sigma, half in ((4.0, 4.0), (4.0, 0.3), (3e3, 3.0)):
        expected = log_b(noise, v, np.asarray(sigma), half)
        error = np.abs(row_of(noise, v, sigma, half) - expected) / np.maximum(np.abs(expected), 1.0)
        assert error.max() < 2e-14 * max(sigma / half if noise == noises.INTEGRAL else 1.0, 1.0) * 5.0


def test_the_elementary_functions_err_as_little_as_they_say() -> None:
    rng = np.random.default_rng(5)
    x = np.concatenate([np.exp(rng.uniform(-700.0, 700.0, 2000)), 1.0 + rng.normal(0.0, 1e-6, 500), [1.0]])
    log = np.array([fast_log(one) for one in x])
    np.testing.assert_allclose(log, np.log(x), rtol=1e-14, atol=1e-300)
    x = np.concatenate([np.linspace(-np.sqrt(0.5), 12.0, 3000), np.geomspace(12.0, 1e7, 500)])
    scaled = np.array([noises._scaled_erfc(one) for one in 1.0 / (x + noises._SHIFT)])
    np.testing.assert_allclose(scaled, erfcx(x), rtol=2e-14)

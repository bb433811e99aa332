"""The small matrices of a step against numpy, compiled and not, and where they are singular."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.kernels import matrices as kernels
from terranav.kernels.reading import learned

FloatArray = NDArray[np.float64]
BOTH = pytest.mark.parametrize("compiled", [True, False])


def of(kernel: Any, compiled: bool) -> Callable[..., Any]:
    return kernel if compiled else kernel.py_func  # type: ignore[no-any-return]


def drawn(n: int, seed: int = 1) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A transition with zeros, and two covariances."""
    rng = np.random.default_rng(seed)
    phi = np.eye(n) + np.where(rng.random((n, n)) < 0.3, rng.normal(size=(n, n)), 0.0)
    one, two = rng.normal(size=(2, n, n))
    return phi, one @ one.T, two @ two.T


@BOTH
@pytest.mark.parametrize("n", [2, 6, 15])
def test_products_and_predictions_are_numpys(n: int, compiled: bool) -> None:
    phi, q, cov = drawn(n)
    out = np.empty((n, n))
    of(kernels.product, compiled)(phi, q, out)
    np.testing.assert_allclose(out, phi @ q, rtol=1e-12, atol=1e-12)
    of(kernels.congruent, compiled)(phi, cov, out)
    np.testing.assert_allclose(out, phi @ cov @ phi.T, rtol=1e-12, atol=1e-12)
    both, noise = of(kernels.then, compiled)(phi, q, phi.T.copy(), cov)
    np.testing.assert_allclose(both, phi.T @ phi, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(noise, phi.T @ q @ phi + cov, rtol=1e-12, atol=1e-12)
    mean, first, second = of(kernels.predicted, compiled)(phi, q, np.arange(n) + 1.0, cov, q)
    np.testing.assert_allclose(mean, phi @ (np.arange(n) + 1.0), rtol=1e-12)
    np.testing.assert_allclose(first, phi @ cov @ phi.T + q, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(second, phi @ q @ phi.T + q, rtol=1e-12, atol=1e-12)


@BOTH
@pytest.mark.parametrize(
    "matrix", [[4.0, 1.5, 2.0], [2.0, -1.0, 7.0], [3.0, 0.0, 3.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0], [1e-9, 0.0, 4.0]]
)
def test_eigenvalues_and_vectors_of_two_by_two(matrix: list[float], compiled: bool) -> None:
    a, b, c = matrix
    whole = np.array([[a, b], [b, c]])
    values, vectors = of(kernels.eigen2, compiled)(a, b, c)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(whole), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(vectors @ vectors.T, np.eye(2), atol=1e-14)
    np.testing.assert_allclose((vectors * values) @ vectors.T, whole, atol=1e-14)


@BOTH
def test_conditioning_splits_the_covariance(compiled: bool) -> None:
    """What is drawn and what is left are together what the transition makes of it."""
    phi, q, common = drawn(6)
    common[:2], common[:, :2] = 0.0, 0.0
    spread, after = of(kernels.conditioned, compiled)(phi, q, common)
    np.testing.assert_allclose(spread @ spread.T + after, phi @ common @ phi.T + q, rtol=1e-10, atol=1e-10)
    assert not after[:2].any()
    assert not after[:, :2].any()
    np.testing.assert_array_equal(after, after.T)


@BOTH
def test_where_no_position_moves_nothing_is_drawn(compiled: bool) -> None:
    common = np.diag([0.0, 0.0, 1.0, 2.0])
    spread, after = of(kernels.conditioned, compiled)(np.eye(4), np.zeros((4, 4)), common)
    np.testing.assert_array_equal(spread, 0.0)
    np.testing.assert_array_equal(after, common)
    one_way = np.diag([4.0, 0.0, 0.0, 0.0])
    spread, _ = of(kernels.conditioned, compiled)(np.eye(4), one_way, common)
    np.testing.assert_allclose(spread @ spread.T, one_way, atol=1e-14)


@BOTH
def test_a_kernel_has_its_share_of_the_covariance(compiled: bool) -> None:
    _, cov, _ = drawn(6)
    common, width = np.diag([0.0, 0.0, 1.0, 2.0, 3.0, 4.0]), 0.2
    spread, after = of(kernels.kernel_of, compiled)(cov, common, width, 0.0)
    np.testing.assert_allclose(spread @ spread.T + after - common, width**2 * cov, rtol=1e-10, atol=1e-12)


@BOTH
def test_bayes_rule_and_the_chain_of_scales(compiled: bool) -> None:
    prior, likelihood = np.array([0.5, 0.3, 0.2]), np.array([0.0, 2.0, 1.0])
    after = of(kernels.bayes, compiled)(prior, likelihood)
    np.testing.assert_allclose(after, np.array([0.0, 0.6, 0.2]) / 0.8, atol=1e-11)
    assert after[0] > 0.0  # no single reading rules a hypothesis out for good
    np.testing.assert_array_equal(of(kernels.bayes, compiled)(prior, np.zeros(3)), prior)
    stays = of(learned, compiled)(prior, np.ones(3), 0.01)
    np.testing.assert_allclose(stays, [0.98 * 0.5 + 0.008, 0.98 * 0.3 + 0.007, 0.98 * 0.2 + 0.005], rtol=1e-10)

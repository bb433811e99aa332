"""Protection levels against plain numpy, and the coverage that they promise."""

from __future__ import annotations

import numpy as np
import pytest

from terranav.core.records import Posterior
from terranav.integrity.protection import Tail, protection_level, tail_of
from terranav.kernels import integrity as kernels


def cloud(points: np.ndarray, weight: np.ndarray | None = None) -> Posterior:
    count = len(points)
    return Posterior(
        points[:, 0].copy(), points[:, 1].copy(), np.full(count, 1.0 / count) if weight is None else weight
    )


def test_a_normal_error_stays_within_at_the_risk() -> None:
    rng = np.random.default_rng(1)
    cov = np.array([[400.0, 120.0], [120.0, 100.0]])
    root = np.linalg.cholesky(cov)
    sigma = float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))
    off = np.hypot(*(root @ rng.standard_normal((2, 400_000))))
    for risk in (1e-2, 1e-3):
        level = protection_level(sigma, Tail(), risk, 1.0)
        assert np.mean(off > level) <= risk


def test_it_grows_with_sigma_scale_and_falls_with_the_risk() -> None:
    levels = [protection_level(10.0, Tail(), risk, 1.0) for risk in (1e-2, 1e-3, 1e-5)]
    assert levels == sorted(levels)
    assert protection_level(10.0, Tail(), 1e-3, 2.0) == pytest.approx(2.0 * levels[1])
    assert protection_level(20.0, Tail(), 1e-3, 1.0) == pytest.approx(2.0 * levels[1])
    assert levels[1] > 10.0 * np.sqrt(-2.0 * np.log(1e-3))


def test_a_longer_tail_counts() -> None:
    rng = np.random.default_rng(2)
    points = 10.0 * rng.standard_normal((2000, 2))
    one = tail_of(cloud(points), np.zeros(2), 5e-4)
    assert one.far == 0.0
    points[:10, 0] += 900.0
    two = tail_of(cloud(points), np.zeros(2), 5e-4)
    assert two.far == pytest.approx(0.005)
    assert two.reach_m > 850.0
    assert protection_level(two.sigma_m, two, 5e-4, 1.0) >= 850.0


@pytest.mark.parametrize("outside", [0.3, 0.05, 0.002])
def test_the_tail_is_the_quantile_to_five_percent(outside: float) -> None:
    rng = np.random.default_rng(3)
    points = rng.standard_t(4, (3000, 2)) * np.array([30.0, 8.0]) + 5.0
    weight = rng.random(3000)
    weight /= weight.sum()
    centre = np.array([4.0, 6.0])
    distance = np.hypot(*(points - centre).T)
    order = np.argsort(distance)
    wanted = distance[order][np.searchsorted(np.cumsum(weight[order]), 1.0 - outside)]
    core, reach, _, sigma2 = kernels.tail(points[:, 0].copy(), points[:, 1].copy(), weight, centre, outside)
    assert wanted <= reach <= 1.06 * wanted
    assert sigma2 == pytest.approx(float(weight @ distance**2))
    plain = kernels.tail.py_func(points[:, 0].copy(), points[:, 1].copy(), weight, centre, outside)
    assert plain == pytest.approx((core, reach, plain[2], sigma2))


def test_a_cloud_in_one_point_is_no_exception() -> None:
    assert tail_of(cloud(np.zeros((100, 2))), np.zeros(2), 1e-3).reach_m < 1e-3

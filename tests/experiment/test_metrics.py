"""Figures against cases worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from terranav.core.records import Status
from terranav.experiment import metrics

ERRORS = np.array([[3.0, 4.0], [0.0, 10.0], [np.nan, np.nan], [-6.0, 8.0], [0.0, 0.0]])  # distances 5, 10, -, 10, 0


def test_accuracy_by_hand() -> None:
    assert metrics.accuracy(ERRORS, match_m=5.0) == {
        "n": 4,
        "drms_m": 7.5,  # sqrt((25 + 100 + 100 + 0) / 4)
        "cep_m": 7.5,  # between 5 and 10
        "r95_m": 10.0,
        "mean_m": 6.25,
        "max_m": 10.0,
        "final_m": 0.0,
        "match_rate": 0.5,  # 5 and 0: the limit itself counts
    }


def test_accuracy_without_truth_is_nan() -> None:
    figures = metrics.accuracy(np.full((3, 2), np.nan), match_m=5.0)
    assert figures.pop("n") == 0
    assert all(math.isnan(value) for value in figures.values())


def test_consistency_by_hand() -> None:
    error = np.array([[2.0, 0.0], [0.0, 3.0], [4.0, 4.0]])
    cov = np.array([np.diag([1.0, 9.0]), np.diag([1.0, 9.0]), [[8.0, 4.0], [4.0, 8.0]]])
    # 4/1; 9/9; (16*8 + 16*8 - 2*16*4) / (64 - 16) = 128/48
    expected = (4.0 + 1.0 + 128.0 / 48.0) / 3.0
    figures = metrics.consistency(error, cov)
    assert figures["nees"] == pytest.approx(expected)
    assert figures["nees_per_axis"] == pytest.approx(expected / 2.0)
    assert figures["contained_95"] == 1.0
    assert metrics.consistency(error, cov / 2.0)["contained_95"] == pytest.approx(2.0 / 3.0)  # 8 > 5.991


def test_nees_agrees_with_the_matrix_inverse() -> None:
    rng = np.random.default_rng(0)
    error, root = rng.normal(size=(50, 2)), rng.normal(size=(50, 2, 2))
    cov = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    expected = np.mean([e @ np.linalg.inv(c) @ e for e, c in zip(error, cov)])
    assert metrics.consistency(error, cov)["nees"] == pytest.approx(expected, rel=1e-9)


def test_normal_errors_are_contained_as_they_should() -> None:
    rng = np.random.default_rng(0)
    cov = np.array([[9.0, 3.0], [3.0, 4.0]])
    error = rng.multivariate_normal([0.0, 0.0], cov, 40_000)
    figures = metrics.consistency(error, np.broadcast_to(cov, (40_000, 2, 2)))
    assert figures["contained_95"] == pytest.approx(0.95, abs=0.004)
    assert figures["nees"] == pytest.approx(2.0, abs=0.05)


def test_consistency_edges() -> None:
    nothing = metrics.consistency(np.full((2, 2), np.nan), np.ones((2, 2, 2)))
    assert all(math.isnan(value) for value in nothing.values())
    certain = metrics.consistency(np.ones((1, 2)), np.zeros((1, 2, 2)))
    assert certain["nees"] == math.inf
    assert certain["contained_95"] == 0.0


def test_integrity_by_hand() -> None:
    protection = np.array([6.0, 9.0, 20.0, 30.0, np.nan])  # against distances 5, 10, -, 10, 0
    usable = np.array([True, True, True, False, False])
    assert metrics.integrity(ERRORS, protection, usable) == {
        "available": 0.6,
        "protection_m": 9.0,
        "misleading": 0.5,  # the second; the third is not known, the fourth was withheld
    }
    blind = metrics.integrity(np.full((5, 2), np.nan), protection, usable)
    assert (blind["available"], blind["protection_m"]) == (0.6, 9.0)
    assert math.isnan(blind["misleading"])


def test_integrity_edges() -> None:
    withheld = metrics.integrity(ERRORS, np.full(5, 7.0), np.zeros(5, dtype=bool))
    assert withheld["available"] == 0.0
    assert math.isnan(withheld["protection_m"])
    assert math.isnan(withheld["misleading"])
    unwatched = metrics.integrity(ERRORS, np.full(5, np.nan), np.zeros(5, dtype=bool))
    assert all(math.isnan(value) for value in unwatched.values())
    endless = metrics.integrity(ERRORS, np.full(5, np.inf), np.ones(5, dtype=bool))
    assert endless == {"available": 1.0, "protection_m": math.inf, "misleading": 0.0}
    nothing = metrics.integrity(np.empty((0, 2)), np.empty(0), np.empty(0, dtype=bool))
    assert all(math.isnan(value) for value in nothing.values())


def test_times_by_hand() -> None:
    time_s = np.array([10.0, 11.0, 13.0, 16.0, 20.0])
    status = np.array(["searching", "lost", "converged", "lost", "lost"])
    assert metrics.first_fix_s(time_s, status) == 3.0
    assert math.isnan(metrics.first_fix_s(time_s, np.full(5, "searching")))
    assert metrics.time_with_status_s(time_s, status, Status.LOST) == 2.0 + 4.0  # the last epoch lasts no time

"""Intervals against what is known: coverage, exact shares, and cases that have no runs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binom, chi2

from terranav.experiment.studies.consistency import band, inside
from terranav.experiment.studies.statistics import clopper_pearson, over_runs, per_case


def test_clopper_pearson_is_exact() -> None:
    share = clopper_pearson(3, 50)
    assert share.value == 0.06
    assert binom.cdf(3, 50, share.high) == pytest.approx(0.025)
    assert binom.sf(2, 50, share.low) == pytest.approx(0.025)
    assert clopper_pearson(0, 10).low == 0.0
    assert clopper_pearson(10, 10).high == 1.0
    assert math.isnan(clopper_pearson(0, 0).value)


def test_intervals_cover_the_mean_about_95_times_in_100() -> None:
    covered = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        interval = over_runs([rng.normal(3.0, 1.0, 40), rng.normal(3.0, 2.0, 40)], np.mean)
        covered += interval.low <= 3.0 <= interval.high
    assert 88 <= covered <= 99


def test_intervals_over_cases_are_wider_than_over_their_runs() -> None:
    rng = np.random.default_rng(1)
    samples = [rng.normal(mean, 1.0, 200) for mean in rng.normal(0.0, 5.0, 12)]
    means = per_case([*samples, np.empty(0)], lambda runs: runs.mean(axis=-1))
    assert math.isnan(means.values[-1])
    over_cases, of_runs = means.over_cases(np.mean), over_runs(samples, np.mean)
    assert over_cases.value == pytest.approx(of_runs.value)
    assert over_cases.high - over_cases.low > 5.0 * (of_runs.high - of_runs.low)
    one = means.interval(0)
    assert one.high - one.low == pytest.approx(2 * 1.96 / math.sqrt(200), rel=0.2)
    assert math.isnan(means.over_cases(np.mean, np.zeros(13, dtype=bool)).value)


def test_the_band_holds_the_mean_nees_of_an_honest_filter() -> None:
    low, high = band(100)
    assert chi2.cdf(100 * high, 200) - chi2.cdf(100 * low, 200) == pytest.approx(0.95)
    honest = np.random.default_rng(2).chisquare(2.0, (100, 2000))
    assert inside(honest) == pytest.approx(0.95, abs=0.02)
    assert inside(1.5 * honest) < 0.1

"""A slice of the integrity study: its figures hold, and its sums are right."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import SeedSequence
from scipy.stats import binom

from terranav.experiment.studies import integrity


@pytest.mark.parametrize(("terrain", "runs", "least", "most"), [
    ("rough", 60, 0.9, 1.0), ("flat", 12, 0.0, 0.0), ("self-similar", 30, 0.0, 0.1),
])  # fmt: skip
def test_no_offered_fix_is_beyond_its_protection_level(terrain: str, runs: int, least: float, most: float) -> None:
    rows = [integrity.run_case(terrain, seed) for seed in SeedSequence(77).spawn(runs)]
    found = integrity.summary(rows)
    assert found["runs"] == runs
    assert found["beyond"] == found["ever_beyond"] == found["unannounced"] == 0
    assert least <= found["available"] <= most
    assert found["lost"] <= 0.05 * runs  # an INS error in the tail of the prior is lost at first, and rightly


def test_a_run_depends_on_its_seed_only() -> None:
    seed = SeedSequence(3)
    assert integrity.run_case("rough", seed) == integrity.run_case("rough", SeedSequence(3))


def test_the_upper_bound_is_clopper_pearson() -> None:
    for events, trials in ((0, 3000), (4, 10_000), (1, 50)):
        bound = integrity.upper_bound(events, trials)
        assert binom.cdf(events, trials, bound) == pytest.approx(0.05)
    assert integrity.upper_bound(0, 3000) < 1e-3 < integrity.upper_bound(5, 10_000)
    assert integrity.upper_bound(0, 0) == 1.0


def test_sums_of_nothing() -> None:
    found = integrity.summary([])
    assert found["runs"] == 0
    assert np.isnan(found["rate"])
    assert np.isnan(found["available"])

"""The engine of studies: same figures for any number of workers, failures recorded, intervals that cover."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import SeedSequence

from terranav.core.errors import ConfigError, StateError
from terranav.experiment.montecarlo import Failure, Threads, bootstrap, monte_carlo


def draw(_: int, seed: SeedSequence) -> float:
    return float(np.random.default_rng(seed).normal())


def test_figures_do_not_depend_on_the_workers() -> None:
    one, _ = monte_carlo(draw, 20, seed=3, executor=Threads(1))
    many, _ = monte_carlo(draw, 20, seed=3, executor=Threads(7))
    assert one == many
    assert len(set(one)) == 20


def test_a_failed_run_is_recorded_and_the_rest_goes_on() -> None:
    def work(k: int, seed: SeedSequence) -> int:
        if k == 2:
            raise ValueError("no map here")
        return k

    seen: list[tuple[int, int]] = []
    results, failures = monte_carlo(work, 5, on_run=lambda done, total: seen.append((done, total)))
    assert results == [0, 1, 3, 4]
    assert failures == [Failure(2, "ValueError: no map here")]
    assert seen == [(k, 5) for k in range(1, 6)]


def test_when_all_fail_the_first_error_is_named() -> None:
    def work(k: int, seed: SeedSequence) -> int:
        raise ValueError(f"run {k}")

    with pytest.raises(StateError, match="all 3 runs failed, the first with ValueError: run 0"):
        monte_carlo(work, 3)
    with pytest.raises(ConfigError, match="runs is 0"):
        monte_carlo(draw, 0)


def test_bootstrap_interval_covers_the_mean_about_95_times_in_100() -> None:
    rng = np.random.default_rng(5)
    hits = 0
    for _ in range(200):
        interval = bootstrap(rng.normal(2.0, 1.0, 40), draws=400)
        hits += interval.low <= 2.0 <= interval.high
    assert 178 <= hits <= 199


def test_bootstrap_draws_the_samples_of_a_run_together() -> None:
    runs = np.repeat(np.random.default_rng(6).normal(size=(30, 1)), 50, axis=1)  # 50 equal samples a run
    together, alone = bootstrap(runs), bootstrap(runs[:, 0])
    assert together.low == pytest.approx(alone.low)
    assert together.high == pytest.approx(alone.high)
    assert together.text(1).count("..") == 1

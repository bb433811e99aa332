"""Many independent runs of one function: the engine below every study and campaign.

Run k gets child k of the seed's SeedSequence, so the figures are the same for any number of workers and any executor.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.errors import StateError

T = TypeVar("T")
FloatArray = NDArray[np.float64]


class Executor(Protocol):
    """Where runs are carried out: threads here, or a cluster's scheduler behind the same method."""

    def unordered(self, work: Callable[[int], T], items: Iterable[int]) -> Iterator[tuple[int, T]]:
        """(item, work(item)) for every item, in the order in which they finish; `work` never raises."""
        ...


@dataclass(frozen=True)
class Threads:
    """Threads of this process: kernels release the GIL.

    Attributes
    ----------
    workers : int or None
        How many; None is one a core.
    """

    workers: int | None = None

    def unordered(self, work: Callable[[int], T], items: Iterable[int]) -> Iterator[tuple[int, T]]:
        """(item, work(item)) in the order in which they finish."""
        count = os.cpu_count() or 1 if self.workers is None else self.workers
        with ThreadPoolExecutor(max(count, 1)) as pool:
            futures = {pool.submit(work, item): item for item in items}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            finally:
                pool.shutdown(cancel_futures=True)


@dataclass(frozen=True, slots=True)
class Failure:
    """A run that raised: its number and what it said."""

    run: int
    error: str


def monte_carlo(
    work: Callable[[int, SeedSequence], T],
    runs: int,
    *,
    seed: int = 0,
    executor: Executor | None = None,
    on_run: Callable[[int, int], None] | None = None,
) -> tuple[list[T], list[Failure]]:
    """Call `work(k, seed_of_run_k)` for k = 0 .. runs - 1.

    Parameters
    ----------
    work : callable
        One run; gets its number and a SeedSequence of its own. An exception is recorded and the rest goes on.
    runs : int, >= 1
    seed : int
    executor : Executor, optional
        Threads() by default.
    on_run : callable, optional
        Called with (runs done, runs) after each.

    Returns
    -------
    results : list
        Of the runs that succeeded, in their order.
    failures : list of Failure

    Raises
    ------
    StateError
        When every run failed; it names the first error.
    """
    count = int(finite("runs", runs, minimum=1))
    children = SeedSequence(seed).spawn(count)

    def one(k: int) -> T | Failure:
        try:
            return work(k, children[k])
        except Exception as error:  # noqa: BLE001  a failed run is a result of the study
            return Failure(k, f"{type(error).__name__}: {error}")

    done: dict[int, T | Failure] = {}
    for k, outcome in (executor or Threads()).unordered(one, range(count)):
        done[k] = outcome
        if on_run is not None:
            on_run(len(done), count)
    outcomes = [done[k] for k in range(count)]
    failures = [outcome for outcome in outcomes if isinstance(outcome, Failure)]
    results = [outcome for outcome in outcomes if not isinstance(outcome, Failure)]
    if not results:
        raise StateError(f"all {count} runs failed, the first with {failures[0].error}")
    return results, failures


@dataclass(frozen=True, slots=True)
class Interval:
    """A figure over runs with its 95 % interval."""

    value: float
    low: float
    high: float

    def text(self, digits: int = 0, scale: float = 1.0) -> str:
        """'value (low..high)' with so many digits after the point."""
        return "{:.{d}f} ({:.{d}f}..{:.{d}f})".format(*(scale * x for x in (self.value, self.low, self.high)), d=digits)


def bootstrap(
    values: FloatArray, statistic: Callable[..., FloatArray] = np.mean, *, draws: int = 4000, seed: int = 0
) -> Interval:
    """A statistic over runs with its 95 % bootstrap interval (percentile method, whole runs drawn).

    Parameters
    ----------
    values : (runs,) or (runs, k)
        One figure a run, or k samples a run, which are drawn together.
    statistic : callable
        Takes an array and `axis`; for (runs, k) it is taken over all samples of the drawn runs.
    """
    data = np.asarray(values, dtype=np.float64)
    rng = np.random.default_rng(seed)
    axis = tuple(range(data.ndim))
    chosen = rng.integers(0, data.shape[0], (draws, data.shape[0]))
    replicas = np.array([float(statistic(data[index], axis=axis)) for index in chosen])
    low, high = np.percentile(replicas, [2.5, 97.5])
    return Interval(float(statistic(data, axis=axis)), float(low), float(high))

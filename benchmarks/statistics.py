"""What a table of runs says, with its 95 % interval."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def median_with_interval(values: FloatArray, draws: int = 4000) -> tuple[float, float, float]:
    """Median and its 95 % bootstrap interval over runs (percentile method, fixed seed)."""
    return with_interval(values, lambda sample: np.median(sample, axis=-1), draws)


def with_interval(
    values: FloatArray, statistic: Callable[[FloatArray], FloatArray], draws: int = 4000
) -> tuple[float, float, float]:
    """A statistic of runs (n,) and its 95 % bootstrap interval."""
    rng = np.random.default_rng(0)
    samples = rng.choice(values, (draws, values.size))
    low, high = np.percentile(statistic(samples), [2.5, 97.5])
    return float(statistic(values)), float(low), float(high)

"""What the fading memory remembers: its surface over a grid of INS errors, and the sums that fade with it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LEAST_VALID = 0.8  # share of a cell's memory that must lie on the map


@dataclass(frozen=True, slots=True)
class Memory:
    """What is remembered of the readings: a surface, and sums that fade as it does."""

    south_m: float  # INS error of the first cell
    west_m: float
    cell_m: float
    surface: FloatArray  # (p, q), aSD over variance
    missing: FloatArray | None = None  # (p, q), weight of the readings without a map value; None where there are none
    readings: int = 0
    weight: float = 0.0  # W
    weight2: float = 0.0  # W2
    time_s: float = 0.0  # sum of the readings' times since the start
    gained_m2: float = 0.0  # sum of the variance that the unaided INS had gained
    residual: float = 0.0  # the latest at the fix, over its 1-sigma
    residual2: float = 0.0  # sum of its square
    lagged: float = 0.0  # sum of its product with the one before
    judged: float = 0.0  # sum of the weights of the residuals
    slope2: FloatArray = field(default_factory=lambda: np.zeros(2))  # sum of the map's squared slopes at the estimate
    slope2_time: FloatArray = field(default_factory=lambda: np.zeros(2))  # the same times the readings' times

    def mean_time_s(self) -> FloatArray:
        """(2,) time since the start of which the surface tells the error north and east.

        The mean over the readings, or over what the ground under them told, if that is older.
        """
        mean, told = self.time_s / self.weight, self.slope2 > 0.0
        by_slope = np.where(told, self.slope2_time / np.where(told, self.slope2, 1.0), mean)
        return np.minimum(by_slope, mean)

    @property
    def north_m(self) -> FloatArray:
        """(p,) errors north [m]."""
        return self.south_m + self.cell_m * np.arange(self.surface.shape[0], dtype=np.float64)

    @property
    def east_m(self) -> FloatArray:
        """(q,) errors east [m]."""
        return self.west_m + self.cell_m * np.arange(self.surface.shape[1], dtype=np.float64)

    def scores(self) -> FloatArray:
        """(p, q) the surface as if every reading had a map value, NaN where too few had."""
        if self.missing is None:
            return self.surface
        known = self.weight - self.missing
        valid = known >= LEAST_VALID * self.weight - 1e-9
        return np.where(valid, self.surface * self.weight / np.where(valid, known, 1.0), np.nan)


def reframed(memory: Memory, by: NDArray[np.int64], shape: NDArray[np.int64]) -> Memory:
    """The memory on a grid of another shape whose first cell lies `by` (rows, cols) on; new cells know no reading."""
    surface, missing = np.zeros(shape), np.full(shape, memory.weight)
    old = [slice(max(b, 0), max(min(n, b + s), 0)) for b, n, s in zip(by, memory.surface.shape, shape, strict=True)]
    new = [slice(o.start - b, max(o.stop, o.start) - b) for o, b in zip(old, by, strict=True)]
    surface[new[0], new[1]] = memory.surface[old[0], old[1]]
    missing[new[0], new[1]] = 0.0 if memory.missing is None else memory.missing[old[0], old[1]]
    south, west = np.array([memory.south_m, memory.west_m]) + by * memory.cell_m
    return replace(memory, south_m=float(south), west_m=float(west), surface=surface, missing=missing)

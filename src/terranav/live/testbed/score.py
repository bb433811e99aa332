"""How far off the vehicle was: its own position with and without fixes, and the planned track."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Spread:
    """95th percentile, largest and last of distances [m]; NaN of none."""

    p95_m: float
    max_m: float
    last_m: float


class Score:
    """Distances once a second.

    Parameters
    ----------
    seconds : int
        At most so many.
    """

    NAMES = ("own", "without", "across", "clearance")

    def __init__(self, seconds: int) -> None:
        self._values = np.full((seconds + 2, len(self.NAMES)), np.nan)
        self._time = np.full(seconds + 2, np.nan)
        self._count = 0

    def add(self, time_s: float, own_m: float, without_m: float, across_m: float, clearance_m: float) -> None:
        """Position error of the vehicle, what it would be without fixes, distance from the leg, height above ground."""
        if self._count < len(self._time):
            self._time[self._count] = time_s
            self._values[self._count] = own_m, without_m, abs(across_m), clearance_m
            self._count += 1

    def of(self, name: str, since_s: float = -math.inf) -> Spread:
        """Spread of one of `NAMES` from a time on."""
        values = self._values[: self._count, self.NAMES.index(name)][self._time[: self._count] >= since_s]
        values = values[np.isfinite(values)]
        if not values.size:
            return Spread(math.nan, math.nan, math.nan)
        return Spread(float(np.percentile(values, 95.0)), float(values.max()), float(values[-1]))

    @property
    def lowest_m(self) -> float:
        """Least height above ground; NaN where it was never known [m]."""
        values = self._values[: self._count, self.NAMES.index("clearance")]
        return float(np.nanmin(values)) if np.isfinite(values).any() else math.nan

"""Reasons in words: one line each, with the figure, what it was measured over, and its limit."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from terranav.integrity.windows import Finding

_POINTS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


def metres(value: float) -> str:
    """'40 m' or '1.2 km'."""
    return f"{value:.0f} m" if value < 1000.0 else f"{value / 1000.0:.1f} km"


def lasting(seconds: float) -> str:
    """'40 s', '12 min' or '1.5 h'."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def bearing(offset_m: NDArray[np.float64]) -> str:
    """Point of the compass of an offset (north, east)."""
    return _POINTS[round(math.degrees(math.atan2(float(offset_m[1]), float(offset_m[0]))) / 45.0) % 8]


def contradicts(kind: str, found: Finding) -> str:
    """Readings and map do not go together here."""
    return (
        f"{kind} readings contradict the map: NIS {found.figure:.2g} over the last {found.readings} readings "
        f"(limit {found.limit:.2g})"
    )


def noisy(kind: str, factor: float) -> str:
    """The readings scatter more than their sigma."""
    return f"{kind} readings are noisier than told: sigma looks {factor:.1f} times too small"


def alike(kind: str, found: Finding) -> str:
    """Successive residuals are correlated."""
    return (
        f"successive {kind} readings err alike: correlation {found.figure:.2f} over the last {found.readings} "
        f"(limit {found.limit:.2f})"
    )


def elsewhere(offset_m: NDArray[np.float64], probability: float) -> str:
    """A rival is not refuted; the offset is that of the vehicle, not of the INS error."""
    where = f"{metres(float(np.hypot(*offset_m)))} {bearing(offset_m)}"
    return f"the readings also fit {where} of here (probability {probability:.2g})"


def repeats(kind: str, times: int) -> str:
    """A sensor hangs."""
    return f"{kind} sensor is stuck: the same value {times} times while the map varies"

"""Barometric altimeter: the height above sea level, with noise and the slow error of the weather."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.sensors.bands import Band, HeightSensor

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Barometer(HeightSensor):
    """Error model of a barometric altimeter; the further attributes are those of `HeightSensor`.

    Attributes
    ----------
    drift_sigma_m : float
        1-sigma of a slowly varying error, a stationary first-order Gauss-Markov process [m].
    drift_correlation_s : float
        Its correlation time [s], > 0.
    """

    drift_sigma_m: float = 0.0
    drift_correlation_s: float = 1000.0

    label: ClassVar[str] = "barometer"
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        # papers/003, Table 1, barometer altitude error: taken for 1-sigma, which the paper does not say
        "paper_003": {
            "bands": (
                Band(1000.0, sigma_m=1.0, sigma_fraction=0.001),
                Band(5000.0, sigma_m=2.0, sigma_fraction=0.003),
            )
        }
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        finite("barometer drift_sigma_m", self.drift_sigma_m, minimum=0.0)
        finite("barometer drift_correlation_s", self.drift_correlation_s, above=0.0)

    @property
    def column(self) -> str:
        """The recording column of its readings."""
        return "baro_altitude_m"

    def _drift(self, time_s: FloatArray, rng: Generator) -> FloatArray | float:
        """The Gauss-Markov error (n,) [m], sampled exactly: b' = f b + sqrt(1 - f^2) sigma n, f = exp(-dt / tau)."""
        if self.drift_sigma_m == 0.0:
            return 0.0
        keep = np.exp(-np.diff(time_s, prepend=-np.inf) / self.drift_correlation_s)
        fresh = self.drift_sigma_m * np.sqrt(1.0 - keep**2) * rng.standard_normal(time_s.size)
        drift, value = np.empty(time_s.size), 0.0
        for i, (factor, step) in enumerate(zip(keep.tolist(), fresh.tolist(), strict=True)):
            value = factor * value + step
            drift[i] = value
        return drift

"""A reading against the map at every particle of a cloud."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.records import Epoch, Measurement
from terranav.filters._cloud import Cloud
from terranav.filters._noise_scale import SCALES
from terranav.ins.error_state import ErrorModel
from terranav.kernels import marginalized as kernels
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

GROUND = 1.0 / 12.0  # variance of the place within the square that a particle stands for [its side squared]


@dataclass(frozen=True, slots=True)
class Seen:
    """A reading at every particle.

    Attributes
    ----------
    number : int
        Of its map.
    bias : int
        Index of the map's bias in the state; its patch is the next.
    residual, slope2 : (m,) [unit], [unit^2/m^2]
        As of `kernels.marginalized.compare`.
    told : (2,) [unit^2], [m^2]
        Variance of the noise as told: constant, and by squared slope.
    gain : (d,)
        Covariance of the linear states with bias + patch.
    reach : float
        Half width of the density of outliers [unit].
    """

    number: int
    bias: int
    residual: FloatArray
    slope2: FloatArray
    told: FloatArray
    gain: FloatArray
    reach: float

    @property
    def common(self) -> float:
        """Variance of bias + patch, equal for all particles [unit^2]."""
        return float(self.gain[self.bias] + self.gain[self.bias + 1])


def compared(
    cloud: Cloud, model: ErrorModel, chart: Map, epoch: Epoch, reading: Measurement, *, blur2: float, reach: float
) -> Seen:
    """Compare a reading with its map; `blur2` [m^2] and `reach` [unit] as in `Seen.told` and `Seen.reach`."""
    bias = model.bias_index(chart.kind)
    radius = float(np.abs(cloud.rows[:, :2]).max()) * math.sqrt(2.0)
    frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg, max(radius, chart.cell_m))
    coefficients = np.stack([frame.row, frame.col])
    residual, slope2 = np.empty(len(cloud.rows)), np.empty(len(cloud.rows))
    kernels.compare(chart.values, coefficients, cloud.rows, np.array([reading.value, bias]), residual, slope2)
    gain = cloud.common[:, bias] + cloud.common[:, bias + 1]
    number = model.maps.index(chart)
    return Seen(number, bias, residual, slope2, np.array([reading.sigma**2, blur2]), gain, reach)


def likelihoods(cloud: Cloud, seen: Seen, factor: float) -> FloatArray:
    """Likelihood of a reading under each of SCALES; `factor` is the one that the patch's variance has now."""
    out = np.empty(SCALES.size)
    patch = float(cloud.common[seen.bias + 1, seen.bias + 1])
    told = np.array([seen.told[0], seen.told[1] + GROUND * cloud.spacing_m**2 / factor])
    parts, bad = np.array([seen.common - patch, patch / factor]), np.ascontiguousarray(cloud.bad[:, seen.number])
    kernels.evidence(cloud.weight, seen.residual, seen.slope2, bad, told, parts, seen.reach, SCALES, out)
    return out

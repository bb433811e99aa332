"""A reading against the map at every particle of a cloud."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.records import Epoch, Measurement
from terranav.filters._cloud import Cloud
from terranav.filters._noise_scale import SCALES, SWITCH
from terranav.ins.error_state import ErrorModel
from terranav.kernels import reading as kernels

FloatArray = NDArray[np.float64]

GROUND = 1.0 / 12.0  # variance of the place within the square that a particle stands for [its side squared]


@dataclass(slots=True)
class Seen:
    """A reading at every particle.

    Attributes
    ----------
    number : int
        Of its map.
    bias : int
        Index of the map's bias in the state; its patch is the next.
    residual, slope2 : (m,) [unit], [unit^2/m^2]
        As of `kernels.reading.compare`.
    known, mean, variance, mean_slope2 : float
        Share of the weight where the map says something; mean and variance of the residual and mean of slope2 there.
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
    known: float
    mean: float
    variance: float
    mean_slope2: float
    told: tuple[float, float]
    gain: FloatArray
    reach: float

    @property
    def common(self) -> float:
        """Variance of bias + patch, equal for all particles [unit^2]."""
        return float(self.gain[self.bias] + self.gain[self.bias + 1])

    def noise(self, factor: float, spacing_m: float = 0.0) -> FloatArray:
        """Variance of the white noise (2,) as in `told`, times a factor; ground that a particle stands for on top."""
        return np.array((factor * self.told[0], factor * self.told[1] + GROUND * spacing_m**2))


def compared(
    cloud: Cloud, model: ErrorModel, number: int, epoch: Epoch, reading: Measurement, *, blur2: float, reach: float
) -> Seen:
    """Compare a reading with map `number`; `blur2` [m^2] and `reach` [unit] as in `Seen.told` and `Seen.reach`."""
    chart, bias = model.maps[number], model.inertial + 2 * number
    radius = kernels.reach_of(cloud.rows) * math.sqrt(2.0)
    land = chart.around(epoch.lat_deg, epoch.lon_deg, max(radius, chart.cell_m))
    frame = land.local_frame(epoch.lat_deg, epoch.lon_deg, max(radius, chart.cell_m))
    residual, slope2 = np.empty_like(cloud.weight), np.empty_like(cloud.weight)
    known, mean, variance, steep = kernels.compare(
        land.values, np.array((frame.row, frame.col)), cloud.rows, cloud.weight, reading.value, bias, residual, slope2
    )
    gain = cloud.common[bias] + cloud.common[bias + 1]
    told = reading.sigma**2, blur2
    return Seen(number, bias, residual, slope2, known, mean, variance, steep, told, gain, reach)


def learned(cloud: Cloud, seen: Seen, probability: FloatArray, factor: float) -> FloatArray:
    """Probability of each of SCALES after a reading; `factor` is the one that the patch's variance has now."""
    likelihood = np.empty(SCALES.size)
    patch = float(cloud.common[seen.bias + 1, seen.bias + 1])
    told = np.array((seen.told[0], seen.told[1] + GROUND * cloud.spacing_m**2 / factor))
    parts, bad = np.array((seen.common - patch, patch / factor)), cloud.bad[seen.number]
    kernels.evidence(cloud.weight, seen.residual, seen.slope2, bad, told, parts, seen.reach, SCALES, likelihood)
    return np.asarray(kernels.learned(probability, likelihood, SWITCH))


def weighed(cloud: Cloud, seen: Seen, mean: FloatArray, noise: FloatArray) -> tuple[Cloud, FloatArray, float] | None:
    """The cloud after a reading, covariance (d, d) of all states, and the effective number of particles.

    None where the reading contradicts every particle. The rows and regimes of the given cloud are written to, and
    `seen.residual` becomes that of the new rows.

    Parameters
    ----------
    cloud : Cloud
        Made in this step, so that nobody else has its arrays.
    seen : Seen
    mean : (d,)
        About the mean of the cloud.
    noise : (2,)
        `Seen.noise`.
    """
    weight = np.empty_like(cloud.weight)
    likely, effective, reduction, centre, cov = kernels.weigh(
        cloud.rows, cloud.weight, cloud.bad[seen.number], seen.residual, seen.slope2, noise, seen.common, seen.reach,
        seen.gain, mean, weight,
    )  # fmt: skip
    if likely <= 0.0:
        return None
    common, whole = kernels.settled(cloud.common, reduction, seen.gain, cov)
    return Cloud(cloud.rows, weight, cloud.bad, common, centre, cov, cloud.spacing_m), whole, effective

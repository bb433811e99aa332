"""The frozen records that travel through the house: epochs in, estimates out.

Frames and signs: navigation frame north-east-down; position error = indicated minus true, metres north and east; the
corrected position is the indicated one shifted by minus the error. Elevation is up-positive, the seabed is negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import covariance, finite
from terranav.core.earth import shifted
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade

FloatArray = NDArray[np.float64]


class Status(StrEnum):
    """What an estimate is worth."""

    SEARCHING = "searching"  # no fix yet: the prior, or little more
    CONVERGED = "converged"  # a fix, and the readings agree with it
    DEGRADED = "degraded"  # there was a fix; its uncertainty has grown or the readings fit it poorly
    LOST = "lost"  # the readings contradict the estimate
    OFF_MAP = "off_map"  # the map says nothing here


@dataclass(frozen=True, slots=True)
class Measurement:
    """One reading at one epoch.

    Attributes
    ----------
    kind : str
        A map kind ('terrain', 'bathymetry', 'gravity', 'magnetic') for a value that compares with a map, or a raw
        reading ('radar_altitude', 'laser_altitude', 'baro_altitude') that `sensors.ready` turns into one.
    value : float
        In the kind's unit and the map's sign: elevation up-positive [m], seabed negative [m], [mGal], [nT]; raw [m].
    sigma : float
        1-sigma of the reading, same unit, > 0; the map's own error is not part of it.
    """

    kind: str
    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Epoch:
    """One time: what the INS says, and the measurements that arrived.

    Attributes
    ----------
    time_s : float
    lat_deg, lon_deg, alt_m : float
        INS-indicated position.
    velocity_mps : (north, east, down) or None [m/s]
    attitude_deg : (roll, pitch, heading) or None [deg]
    measurements : tuple of Measurement
        Zero or more.
    """

    time_s: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    velocity_mps: tuple[float, float, float] | None = None
    attitude_deg: tuple[float, float, float] | None = None
    measurements: tuple[Measurement, ...] = ()


@dataclass(frozen=True)
class Prior:
    """Initial distribution of the INS position error.

    Attributes
    ----------
    mean_m : (2,) [m] north, east
    cov_m2 : (2, 2) [m^2]
    shape : 'gaussian' or 'uniform'
        'uniform' is flat over the rectangle of +-3 sigma per axis (papers/000 eq. 7).
    """

    mean_m: FloatArray
    cov_m2: FloatArray
    shape: Literal["gaussian", "uniform"] = "gaussian"

    def __post_init__(self) -> None:
        mean = np.asarray(self.mean_m, dtype=np.float64)
        if mean.shape != (2,) or not np.isfinite(mean).all():
            raise ConfigError(f"prior mean_m is {self.mean_m!r}, expected two finite numbers (north, east)")
        if self.shape not in ("gaussian", "uniform"):
            raise ConfigError(f"prior shape is {self.shape!r}, expected 'gaussian' or 'uniform'")
        object.__setattr__(self, "mean_m", mean)
        cov = covariance("prior cov_m2", self.cov_m2, 2)
        if np.linalg.eigvalsh(cov)[0] <= 0.0:
            raise ConfigError(f"prior cov_m2 is {cov.tolist()}, expected a positive definite matrix")
        object.__setattr__(self, "cov_m2", cov)

    @classmethod
    def from_ins(cls, ins: InsGrade, shape: Literal["gaussian", "uniform"] = "gaussian") -> Prior:
        """Zero mean, and the grade's initial position sigma on both axes."""
        sigma = finite("ins position_sigma_m", ins.position_sigma_m, above=0.0)
        return cls(np.zeros(2), np.eye(2) * sigma**2, shape)


@dataclass(frozen=True, slots=True)
class Posterior:
    """A distribution of the INS position error for pictures: a grid, or a cloud of particles.

    Attributes
    ----------
    north_m : (rows,) or (m,) [m]
    east_m : (cols,) or (m,) [m]
    weight : (rows, cols) for a grid, (m,) for particles; sums to one
    """

    north_m: FloatArray
    east_m: FloatArray
    weight: FloatArray


@dataclass(frozen=True, slots=True)
class Estimate:
    """What an estimator says at one epoch.

    Attributes
    ----------
    time_s : float
    lat_deg, lon_deg, alt_m : float
        Corrected position; the altitude is the indicated one.
    ins_error_m : (2,) [m]
        Estimated INS position error, north and east.
    cov_m2 : (2, 2) [m^2]
        Covariance of that error, symmetric positive definite.
    status : Status
    nis : float
        Normalised innovation squared per reading, averaged over the latest readings; 1 when they are as noisy as told,
        NaN before any. Not every method has it.
    protection_m : float
        Horizontal protection level: the error exceeds it with at most the declared risk [m]; NaN where no integrity
        monitor watches.
    usable : bool
        Whether the integrity monitor offers this position as a fix; False where none watches.
    reasons : tuple of str
        Why the status is what it is, and why a fix is withheld, in words.
    """

    time_s: float
    lat_deg: float
    lon_deg: float
    alt_m: float
    ins_error_m: FloatArray
    cov_m2: FloatArray
    status: Status
    nis: float = float("nan")
    protection_m: float = float("nan")
    usable: bool = False
    reasons: tuple[str, ...] = ()

    @classmethod
    def at(
        cls,
        epoch: Epoch,
        ins_error_m: FloatArray,
        cov_m2: FloatArray,
        status: Status,
        nis: float = float("nan"),
    ) -> Estimate:
        """The estimate that corrects the indicated position of `epoch` by an estimated INS error."""
        lat, lon = shifted(epoch.lat_deg, epoch.lon_deg, -float(ins_error_m[0]), -float(ins_error_m[1]))
        return cls(epoch.time_s, lat, lon, epoch.alt_m, ins_error_m, cov_m2, status, nis)


@dataclass(frozen=True, slots=True)
class Innovation:
    """What one reading was against what was expected of it: the raw material of integrity.

    Attributes
    ----------
    kind : str
        Of the map it was compared with.
    residual : float
        Reading minus its predicted mean [the kind's unit].
    variance : float
        Predicted variance of that, the spread of the position included [unit^2].
    noise : float
        Part of the variance that is sensor and map, without the position's spread and the bias [unit^2].
    known : float
        Share of the predicted positions where the map says something; below one half nothing was compared.
    used : bool
        Whether the reading was allowed to move the estimate.
    scale : float
        How many times noisier than told the readings of this kind have proved (sigma over told sigma).
    """

    kind: str
    residual: float
    variance: float
    noise: float
    known: float = 1.0
    used: bool = True
    scale: float = 1.0

    @property
    def nis(self) -> float:
        """Normalised innovation squared: 1 on average when the reading is as noisy as told."""
        return self.residual**2 / self.variance


@dataclass(frozen=True)
class Profile:
    """The recent epochs that a batch method matches at once; each carries a measurement of `kind`.

    Attributes
    ----------
    epochs : tuple of Epoch, oldest first
    kind : str
        The map kind that is matched.
    """

    epochs: tuple[Epoch, ...]
    kind: str

    @cached_property
    def time_s(self) -> FloatArray:
        """(n,) [s]."""
        return np.array([epoch.time_s for epoch in self.epochs])

    @cached_property
    def lat_deg(self) -> FloatArray:
        """(n,) indicated latitude [deg]."""
        return np.array([epoch.lat_deg for epoch in self.epochs])

    @cached_property
    def lon_deg(self) -> FloatArray:
        """(n,) indicated longitude [deg]."""
        return np.array([epoch.lon_deg for epoch in self.epochs])

    @cached_property
    def _readings(self) -> FloatArray:
        readings = [next(m for m in epoch.measurements if m.kind == self.kind) for epoch in self.epochs]
        return np.array([(m.value, m.sigma) for m in readings]).reshape(-1, 2)

    @cached_property
    def value(self) -> FloatArray:
        """(n,) measured values [the kind's unit]."""
        return self._readings[:, 0].copy()

    @cached_property
    def sigma(self) -> FloatArray:
        """(n,) 1-sigma of the readings [the kind's unit]."""
        return self._readings[:, 1].copy()


@dataclass(frozen=True, slots=True)
class Candidates:
    """Where a batch method thinks the vehicle may be: errors of the INS at the profile's last epoch, best first.

    Attributes
    ----------
    ins_error_m : (k, 2) [m] north, east
    cov_m2 : (k, 2, 2) [m^2]
    probability : (k,)
        Of each candidate among all that the search area holds; the sum may be below one.
    score : (k,)
        The method's own figure of merit (smaller is better), for tables.
    nis : float
        Mean squared residual of the best candidate over its told variance, NaN where the method has none.
    posterior : Posterior or None
    """

    ins_error_m: FloatArray
    cov_m2: FloatArray
    probability: FloatArray
    score: FloatArray
    nis: float = float("nan")
    posterior: Posterior | None = None

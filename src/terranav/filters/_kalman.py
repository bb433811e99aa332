"""What SITAN and the UKF share: a Kalman filter of the INS error whose map is made linear over the error's region.

A linearisation gives the map's level z at the mean m, its slope g per metre of error, and the mean square r of what the
plane z + g (x - m) leaves. A reading y then updates mean and covariance P as in a Kalman filter, in Joseph's form:

    S = g P g' + R,  R = sensor^2 + map^2 + r,  K = P g' / S,  m + K (y - z),  (I - K g) P (I - K g)' + K R K'

What a plane leaves is no white noise along the track: readings closer together than the region is wide meet the same
hill. So r counts once for all readings within one sigma of the error on the ground.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import offset_of
from terranav.core.errors import StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m, started_over
from terranav.core.records import Epoch, Estimate, Measurement, Prior, Status
from terranav.filters._maps import one_map_a_kind
from terranav.maps.map import Map
from terranav.maps.noise import MOST_REPEATED, reading_sigma

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Plane:
    """The map over the region of the error: level at the mean, slope, and mean square of what the plane leaves."""

    level: float
    slope: FloatArray  # (2,) per metre of error north, east
    left: float


@dataclass(frozen=True, slots=True)
class KalmanState:
    """Mean and covariance after an epoch, and the variance that an INS without corrections has gained per axis."""

    prior: Prior
    mean_m: FloatArray
    cov_m2: FloatArray
    unaided_m2: float = 0.0
    judgement: Judgement = field(default_factory=Judgement)
    start_s: float = math.nan
    epoch: Epoch | None = None
    last_reading: Epoch | None = None


@dataclass(frozen=True)
class Linearised:
    """The filter but for how the map is made linear; the attributes are those of SITAN and the UKF."""

    name: ClassVar[str]

    maps: tuple[Map, ...]
    ins: InsGrade
    gate_sigma: float | None = None
    restart: bool = True
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        for key in ("gate_sigma", "converged_sigma_m"):
            if getattr(self, key) is not None:
                finite(f"{self.name} {key}", getattr(self, key), above=0.0)
        one_map_a_kind(self.name, self.maps)

    @abstractmethod
    def linearised(self, chart: Map, epoch: Epoch, mean_m: FloatArray, cov_m2: FloatArray) -> tuple[Plane | None, bool]:
        """The map over the region of the error, None where it says too little; and whether that is off the map."""

    def init(self, prior: Prior, rng: Generator) -> KalmanState:
        """Mean and covariance of the prior, whatever its shape."""
        return KalmanState(prior, prior.mean_m, prior.cov_m2)

    def step(self, state: KalmanState, epoch: Epoch, rng: Generator) -> KalmanState:
        """Grow the covariance by the INS's drift since the last epoch, then use the readings one by one."""
        state = self._drifted(state, epoch)
        nis: list[float] = []
        off_map: list[bool] = []
        for reading in epoch.measurements:
            for chart in self.maps:
                if chart.kind == reading.kind:
                    plane, off = self.linearised(chart, epoch, state.mean_m, state.cov_m2)
                    off_map.append(off)
                    if plane is not None:
                        sigma = reading_sigma(reading, chart, state.last_reading, epoch)
                        state, innovation2 = self._updated(state, reading, plane, sigma)
                        nis.append(innovation2)
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(state.cov_m2),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=all(off_map) if off_map else None,
        )
        state = replace(state, judgement=judgement, last_reading=epoch if off_map else state.last_reading)
        return _started_over(state) if self.restart and judgement.status is Status.LOST else state

    def estimate(self, state: KalmanState) -> Estimate:
        """Mean and covariance."""
        if state.epoch is None:
            raise StateError(f"{self.name}: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    @property
    def _judge(self) -> Judge:
        limit = self.converged_sigma_m
        return Judge(converged_sigma_m=min(chart.cell_m for chart in self.maps) if limit is None else limit)

    def _drifted(self, state: KalmanState, epoch: Epoch) -> KalmanState:
        """The state at the time of `epoch`, before its readings."""
        if state.epoch is None:
            return replace(state, epoch=epoch, start_s=epoch.time_s)
        elapsed, dt = state.epoch.time_s - state.start_s, epoch.time_s - state.epoch.time_s
        growth = [self.ins.position_growth_m2(elapsed, dt, float(v)) for v in np.diag(state.cov_m2)]
        unaided = state.unaided_m2 + self.ins.position_growth_m2(elapsed, dt)
        return replace(state, epoch=epoch, cov_m2=state.cov_m2 + np.diag(growth), unaided_m2=unaided)

    def _updated(
        self, state: KalmanState, reading: Measurement, plane: Plane, sigma: float
    ) -> tuple[KalmanState, float]:
        """The state after one reading, and the NIS of that reading."""
        g, P = plane.slope, state.cov_m2
        noise = sigma**2 + plane.left * _alike(state)
        innovation = reading.value - plane.level
        spread = float(g @ P @ g) + noise
        nis = innovation**2 / spread
        if self.gate_sigma is not None and nis > self.gate_sigma**2:
            return state, nis
        gain = P @ g / spread
        keep = np.eye(2) - np.outer(gain, g)
        cov = keep @ P @ keep.T + noise * np.outer(gain, gain)
        return replace(state, mean_m=state.mean_m + gain * innovation, cov_m2=0.5 * (cov + cov.T)), nis


def _started_over(state: KalmanState) -> KalmanState:
    """The state as if there had never been a reading."""
    cov = state.prior.cov_m2 + state.unaided_m2 * np.eye(2)
    return replace(state, mean_m=state.prior.mean_m, cov_m2=cov, judgement=started_over(state.judgement))


def _alike(state: KalmanState) -> float:
    """Readings that share what the plane leaves: those within one sigma of the error on the ground."""
    if state.last_reading is None or state.epoch is None:
        return 1.0
    last, now = state.last_reading, state.epoch
    spacing = math.hypot(*offset_of(last.lat_deg, last.lon_deg, now.lat_deg, now.lon_deg))
    return min(max(1.0, largest_sigma_m(state.cov_m2) / max(spacing, 1e-9)), MOST_REPEATED)

"""UKF: an unscented Kalman filter of the two horizontal INS position errors.

Julier and Uhlmann, Proc. IEEE 92 (2004); scaled sigma points of Wan and van der Merwe (2000); named as future work in
papers/001 and used for terrain navigation in its reference 5. With n = 2 states and l = alpha^2 (n + kappa) - n, the
sigma points of mean m and covariance P = L L' are

    X_0 = m,  X_i = m +- sqrt(n + l) L_i
    w_0 = l / (n + l),  w_i = 1 / (2 (n + l)),  and for covariances w_0 + 1 - alpha^2 + beta

With h_i the map at the indicated position less X_i: z = sum w h, S_h = sum w_c (h - z)^2, C = sum w_c (X - m)(h - z).
Written as a statistical linearisation, slope g = P^-1 C and rest r = S_h - g' P g >= 0, the update is a Kalman filter's
with noise R + r (the same gain and covariance; Joseph's form keeps it positive). On a plane r is zero, and this is the
Kalman filter.

What a slope leaves, r, is no white noise along the track: readings closer together than the region is wide meet the
same hill. As in `sitan` it counts once for all readings within one sigma of the error on the ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import offset_m, shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m, started_over
from terranav.core.records import Epoch, Estimate, Measurement, Prior, Status
from terranav.maps.map import Map
from terranav.maps.noise import MOST_REPEATED, reading_sigma

FloatArray = NDArray[np.float64]

STATES = 2


@dataclass(frozen=True, slots=True)
class UkfState:
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
class Ukf:
    """Unscented Kalman filter of the two horizontal INS position errors.

    It tracks; it does not acquire: one Gaussian cannot hold several hills. When the readings contradict it, it is
    'lost' and starts over from the initial prior and the drift since. A reading is left out where the map lacks a
    value at one of its sigma points.

    Attributes
    ----------
    maps : tuple of Map
        One a kind; readings of several kinds at one epoch are used one after the other.
    ins : InsGrade
        How fast the position error grows (`InsGrade.position_growth_m2`).
    alpha : float
        Spread of the sigma points, in (0, 1].
    beta : float
        Weight of the middle point in covariances, >= 0; 2 for a Gaussian.
    kappa : float
        Second scaling, > -2; with alpha = 1 the points lie at sqrt(2 + kappa) sigma, and kappa = 1 matches the fourth
        moment of a Gaussian.
    restart : bool
        Start over when lost; without, the filter stays where it is and goes on.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the finest map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, or two maps of one kind.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 1.0
    restart: bool = True
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        finite("ukf alpha", self.alpha, above=0.0, maximum=1.0)
        finite("ukf beta", self.beta, minimum=0.0)
        finite("ukf kappa", self.kappa, above=-STATES)
        if self.converged_sigma_m is not None:
            finite("ukf converged_sigma_m", self.converged_sigma_m, above=0.0)
        kinds = [chart.kind for chart in self.maps]
        if not kinds or len(set(kinds)) != len(kinds):
            raise ConfigError(f"ukf maps are of kinds {kinds}, expected one map of each kind that is measured")

    def init(self, prior: Prior, rng: Generator) -> UkfState:
        """Mean and covariance of the prior, whatever its shape."""
        return UkfState(prior, prior.mean_m, prior.cov_m2)

    def step(self, state: UkfState, epoch: Epoch, rng: Generator) -> UkfState:
        """Grow the covariance by the INS's drift since the last epoch, then use the readings one by one."""
        state = self._drifted(state, epoch)
        nis: list[float] = []
        off_map: list[bool] = []
        for reading in epoch.measurements:
            for chart in self.maps:
                if chart.kind == reading.kind:
                    points = self.sigma_points(state.mean_m, state.cov_m2)
                    heights = chart.sample(*shift(epoch.lat_deg, epoch.lon_deg, -points[:, 0], -points[:, 1]))
                    known = np.isfinite(heights)
                    off_map.append(int(known.sum()) <= STATES)
                    if known.all():
                        sigma = reading_sigma(reading, chart, state.last_reading, epoch)
                        state, innovation2 = self._updated(state, reading, heights, points, sigma)
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

    def estimate(self, state: UkfState) -> Estimate:
        """Mean and covariance."""
        if state.epoch is None:
            raise StateError("ukf: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    def sigma_points(self, mean_m: FloatArray, cov_m2: FloatArray) -> FloatArray:
        """(5, 2) the mean, then the points on both sides of it along the columns of the Cholesky factor [m]."""
        reach = self.alpha * math.sqrt(STATES + self.kappa) * np.linalg.cholesky(cov_m2).T
        return np.asarray(mean_m + np.concatenate([np.zeros((1, STATES)), reach, -reach]))

    @property
    def weights(self) -> tuple[FloatArray, FloatArray]:
        """(5,) weights of the sigma points in means, and in covariances."""
        scale = self.alpha**2 * (STATES + self.kappa)
        mean = np.full(2 * STATES + 1, 0.5 / scale)
        mean[0] = 1.0 - STATES / scale
        middle = np.zeros_like(mean)
        middle[0] = 1.0 - self.alpha**2 + self.beta
        return mean, mean + middle

    @property
    def _judge(self) -> Judge:
        limit = self.converged_sigma_m
        return Judge(converged_sigma_m=min(chart.cell_m for chart in self.maps) if limit is None else limit)

    def _drifted(self, state: UkfState, epoch: Epoch) -> UkfState:
        """The state at the time of `epoch`, before its readings."""
        if state.epoch is None:
            return replace(state, epoch=epoch, start_s=epoch.time_s)
        elapsed, dt = state.epoch.time_s - state.start_s, epoch.time_s - state.epoch.time_s
        growth = [self.ins.position_growth_m2(elapsed, dt, float(v)) for v in np.diag(state.cov_m2)]
        unaided = state.unaided_m2 + self.ins.position_growth_m2(elapsed, dt)
        return replace(state, epoch=epoch, cov_m2=state.cov_m2 + np.diag(growth), unaided_m2=unaided)

    def _updated(
        self, state: UkfState, reading: Measurement, heights: FloatArray, points: FloatArray, sigma: float
    ) -> tuple[UkfState, float]:
        """The state after one reading, and the NIS of that reading."""
        by_mean, by_cov = self.weights
        P = state.cov_m2
        # sums of differences from the middle point: with a small alpha the weights are huge and cancel
        level = float(heights[0] + by_mean @ (heights - heights[0]))
        away = heights - level
        slope = np.linalg.solve(P, (by_cov * away) @ (points - state.mean_m))
        left = max(float(by_cov @ away**2 - slope @ P @ slope), 0.0)
        noise = sigma**2 + left * _alike(state)
        spread = float(slope @ P @ slope) + noise
        innovation = reading.value - level
        gain = P @ slope / spread
        keep = np.eye(STATES) - np.outer(gain, slope)
        cov = keep @ P @ keep.T + noise * np.outer(gain, gain)
        state = replace(state, mean_m=state.mean_m + gain * innovation, cov_m2=0.5 * (cov + cov.T))
        return state, innovation**2 / spread


def _started_over(state: UkfState) -> UkfState:
    """The state as if there had never been a reading."""
    cov = state.prior.cov_m2 + state.unaided_m2 * np.eye(STATES)
    return replace(state, mean_m=state.prior.mean_m, cov_m2=cov, judgement=started_over(state.judgement))


def _alike(state: UkfState) -> float:
    """Readings that share what the slope leaves: those within one sigma of the error on the ground."""
    if state.last_reading is None or state.epoch is None:
        return 1.0
    last, now = state.last_reading, state.epoch
    north, east = offset_m(last.lat_deg, last.lon_deg, now.lat_deg, now.lon_deg)
    spacing = math.hypot(float(north), float(east))
    return min(max(1.0, largest_sigma_m(state.cov_m2) / max(spacing, 1e-9)), MOST_REPEATED)

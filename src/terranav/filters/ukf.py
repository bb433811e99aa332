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
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import shift
from terranav.core.records import Epoch
from terranav.filters._kalman import Linearised, Plane
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

STATES = 2


@dataclass(frozen=True)
class Ukf(Linearised):
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
    gate_sigma : float or None
        Readings beyond so many sigmas of what was expected are left out; None uses all.
    restart : bool
        Start over when lost; without, the filter stays where it is and goes on.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the finest map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, or two maps of one kind.
    """

    name = "ukf"

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 1.0

    def __post_init__(self) -> None:
        finite("ukf alpha", self.alpha, above=0.0, maximum=1.0)
        finite("ukf beta", self.beta, minimum=0.0)
        finite("ukf kappa", self.kappa, above=-STATES)
        super().__post_init__()

    def linearised(self, chart: Map, epoch: Epoch, mean_m: FloatArray, cov_m2: FloatArray) -> tuple[Plane | None, bool]:
        """Statistical linearisation over the sigma points; None unless the map has a value at each of them."""
        points = self.sigma_points(mean_m, cov_m2)
        heights = chart.sample(*shift(epoch.lat_deg, epoch.lon_deg, -points[:, 0], -points[:, 1]))
        known = np.isfinite(heights)
        if not known.all():
            return None, int(known.sum()) <= STATES
        by_mean, by_cov = self.weights
        # sums of differences from the middle point: with a small alpha the weights are huge and cancel
        level = float(heights[0] + by_mean @ (heights - heights[0]))
        away = heights - level
        slope: FloatArray = np.asarray(np.linalg.solve(cov_m2, (by_cov * away) @ (points - mean_m)), dtype=np.float64)
        return Plane(level, slope, max(float(by_cov @ away**2 - slope @ cov_m2 @ slope), 0.0)), False

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

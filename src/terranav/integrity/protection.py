"""Horizontal protection level: how far off a position is at most, at a declared risk.

Half of the risk is for what the posterior says, half for rivals that it does not hold (`terranav.integrity.rivals`).

For a normal error whose larger axis is sigma, P(|e| > R) <= exp(-R^2 / 2 sigma^2). How well sigma is known is limited
by the readings that confirm it: if it is scaled by the mean NIS of nu of them, the error is Student's t with nu degrees
of freedom in two dimensions, and

    P(|e| > R) <= (1 + R^2 / (nu sigma^2))^(-nu/2)

(the radial part of the multivariate t; Groves, Principles of GNSS, Inertial, and Multisensor Integrated Navigation
Systems, 2nd ed., section 17.5, for protection levels from a scaled covariance). A posterior with a longer tail than
that is taken as it is: the distance that leaves no more than the risk of its weight outside.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.records import Posterior
from terranav.kernels import integrity as kernels

FREEDOM = 12.0  # as if so many readings confirmed the covariance: the filter approximates, too
FAR = 1e-9


@dataclass(frozen=True, slots=True)
class Tail:
    """How far the cloud reaches from its mean at the latest reading.

    Attributes
    ----------
    reach_m : float
        Leaves no more than the risk outside [m].
    far : float
        Weight that lies beyond what one mode explains: seven times the median distance.
    sigma_m : float
        Root of the mean square per axis [m].
    """

    reach_m: float = 0.0
    far: float = 0.0
    sigma_m: float = 0.0


def tail_of(posterior: Posterior, mean_m: NDArray[np.float64], risk: float) -> Tail:
    """Measure a cloud of particles."""
    _, reach, far, sigma2 = kernels.tail(posterior.north_m, posterior.east_m, posterior.weight, mean_m, risk)
    return Tail(reach, far, math.sqrt(0.5 * sigma2))


def protection_level(sigma_m: float, tail: Tail, risk: float, scale: float) -> float:
    """Distance that the error exceeds with at most this risk, if the posterior is right.

    Parameters
    ----------
    sigma_m : float
        Largest 1-sigma axis now [m].
    tail : Tail
    risk : float
    scale : float
        How many times larger the errors may be than the covariance says, >= 1.
    """
    normal = scale * sigma_m * math.sqrt(FREEDOM * (risk ** (-2.0 / FREEDOM) - 1.0))
    grown = max(sigma_m / tail.sigma_m, 1.0) if tail.sigma_m > 0.0 else 1.0
    return max(normal, scale * tail.reach_m * min(grown, 10.0))

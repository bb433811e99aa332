"""How much the INS really wanders: a discrete distribution over factors of its told process noise.

Multiple-model estimation (Magill, IEEE Trans. Automatic Control 10, 1965): a bank of Kalman filters that differ in the
process noise alone, on the map made a plane over the particles. A reading's likelihood under each of them tells which
one follows. The bank runs while the position is known to about a cell, since only there a plane serves; elsewhere the
distribution stays as it is. The factor is a hidden Markov chain that moves slowly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from terranav.ins.error_state import Transition
from terranav.kernels import walk_scale as kernels

FloatArray = NDArray[np.float64]

FACTORS = np.array([1.0, 4.0, 16.0])  # of the variance of the process noise
START = np.array([0.95, 0.03, 0.02])  # an INS is mostly as good as told; less than told is never assumed
FORGET = 0.005  # chance a reading that the INS is another from here on
FORGET_START = FORGET * START


@dataclass(frozen=True, slots=True)
class WalkScale:
    """The distribution over FACTORS (L,), and the bank: means (L, d) and covariances (L, d, d), empty while idle."""

    probability: FloatArray
    mean: FloatArray
    cov: FloatArray

    @property
    def idle(self) -> bool:
        """Whether the bank is not running."""
        return self.mean.size == 0

    @property
    def expected(self) -> float:
        """Expected factor of the process noise."""
        return float(self.probability @ FACTORS)


def told(adapt: bool) -> WalkScale:
    """Before any reading; without adaptation the INS is as told for good."""
    return WalkScale(START if adapt else np.array([1.0, 0.0, 0.0]), np.zeros((0, 0)), np.zeros((0, 0, 0)))


def stopped(bank: WalkScale) -> WalkScale:
    """The distribution kept, the bank idle."""
    return bank if bank.idle else replace(bank, mean=np.zeros((0, 0)), cov=np.zeros((0, 0, 0)))


def stepped(bank: WalkScale, passed: Transition, inertial: int) -> WalkScale:
    """The bank after a step of told noise, whose first `inertial` states are those of the INS."""
    if bank.idle:
        return bank
    mean, cov = kernels.stepped(bank.mean, bank.cov, passed.phi, passed.q, inertial, FACTORS)
    return WalkScale(bank.probability, mean, cov)


def weighed(
    bank: WalkScale, plane: FloatArray, bias: int, noise: float, outlier: tuple[float, float], *, use: bool
) -> WalkScale:
    """The bank and the distribution after a reading of the map as a plane (`kernels.walk_scale.linearised`).

    Parameters
    ----------
    bank : WalkScale
    plane : (6,)
    bias : int
        Index of the bias in the state; the patch is the next.
    noise : float
        Variance of reading and plane [unit^2].
    outlier : probability of an outlier, and the half width of its Cauchy density [unit]
    use : bool
        Whether it may correct the filters.
    """
    value = float(plane[2] + plane[3] * plane[0] + plane[4] * plane[1])
    prior = (1.0 - FORGET) * bank.probability + FORGET_START
    found = kernels.corrected(bank.mean, bank.cov, plane[3:5], bias, value, noise, *outlier, use, prior)
    return WalkScale(*found)


def started(bank: WalkScale, mean: FloatArray, cov: FloatArray) -> WalkScale:
    """The bank running, every filter from the same mean (d,) and covariance (d, d)."""
    return replace(bank, mean=np.tile(mean, (FACTORS.size, 1)), cov=np.tile(cov, (FACTORS.size, 1, 1)))

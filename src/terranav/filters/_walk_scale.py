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

from terranav.filters._noise_scale import bayes
from terranav.ins.error_state import Transition
from terranav.kernels import walk_scale as kernels

FloatArray = NDArray[np.float64]

FACTORS = np.array([1.0, 4.0, 16.0])  # of the variance of the process noise
START = np.array([0.95, 0.03, 0.02])  # an INS is mostly as good as told; less than told is never assumed
FORGET = 0.005  # chance a reading that the INS is another from here on


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
    mean, cov = np.empty_like(bank.mean), np.empty_like(bank.cov)
    kernels.stepped(bank.mean, bank.cov, passed.phi, passed.q, inertial, FACTORS, mean, cov)
    return replace(bank, mean=mean, cov=cov)


def weighed(
    bank: WalkScale, row: FloatArray, value: float, noise: float, outlier: tuple[float, float], *, use: bool
) -> WalkScale:
    """The bank and the distribution after a reading value = row x + noise; `outlier` as in the kernel."""
    mean, cov, likelihood = np.empty_like(bank.mean), np.empty_like(bank.cov), np.empty(len(bank.mean))
    kernels.corrected(bank.mean, bank.cov, row, value, noise, np.array(outlier), use, mean, cov, likelihood)
    moved = (1.0 - FORGET) * bank.probability + FORGET * START
    return WalkScale(bayes(moved, likelihood), mean, cov)


def started(bank: WalkScale, mean: FloatArray, cov: FloatArray) -> WalkScale:
    """The bank running, every filter from the same mean (d,) and covariance (d, d)."""
    return replace(bank, mean=np.tile(mean, (FACTORS.size, 1)), cov=np.tile(cov, (FACTORS.size, 1, 1)))

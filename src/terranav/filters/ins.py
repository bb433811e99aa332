"""No aiding: the INS as it is, the baseline that every other method is shown against.

The covariance is that of an unaided INS. Its velocity error is nearly constant over a run (Schuler period 84 min), so
it integrates into a position error that is fully correlated in time, beside the initial error and the random walk:

    P(t) = P0 + [ (integral of sigma_v dt)^2 + walk^2 t ] I,    t from the first epoch
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from terranav.core.errors import StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Estimate, Prior, Status
from terranav.maps.map import Map

#: nodes on [0, 1] and weights of the three-point Gauss-Legendre rule
_NODES = 0.5 + np.sqrt(0.15) * np.array([-1.0, 0.0, 1.0])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


@dataclass(frozen=True, slots=True)
class InsState:
    """The prior, the latest epoch, and what has been integrated since the first one."""

    prior: Prior
    epoch: Epoch | None = None
    start_s: float = 0.0
    drift_m: float = 0.0


@dataclass(frozen=True)
class InsOnly:
    """The INS without aiding: the prior's mean error, and a covariance that only grows.

    Attributes
    ----------
    maps : tuple of Map
        Not used; every estimator has it.
    ins : InsGrade
        What is known of the INS; says how the covariance grows.
    """

    maps: tuple[Map, ...]
    ins: InsGrade

    def init(self, prior: Prior, rng: Generator) -> InsState:
        """State before the first epoch; `rng` is not used."""
        return InsState(prior)

    def step(self, state: InsState, epoch: Epoch, rng: Generator) -> InsState:
        """State after one more epoch: time passes, measurements are ignored."""
        if state.epoch is None:
            return InsState(state.prior, epoch, epoch.time_s)
        before, dt = state.epoch.time_s - state.start_s, epoch.time_s - state.epoch.time_s
        speeds = [self.ins.velocity_sigma_at_mps(float(before + node * dt)) for node in _NODES]
        return InsState(state.prior, epoch, state.start_s, state.drift_m + dt * float(_WEIGHTS @ speeds))

    def estimate(self, state: InsState) -> Estimate:
        """The indicated position corrected by the prior's mean; the status is always 'searching'."""
        if state.epoch is None:
            raise StateError("ins: there is no estimate before the first epoch")
        walk_m2 = self.ins.position_walk_m_per_sqrt_s**2 * (state.epoch.time_s - state.start_s)
        cov = state.prior.cov_m2 + (state.drift_m**2 + walk_m2) * np.eye(2)
        return Estimate.at(state.epoch, state.prior.mean_m, cov, Status.SEARCHING)

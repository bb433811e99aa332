"""What the INS alone lets expect of GNSS: predictions of its error from several times ago that saw no GNSS since.

The error of an INS grows as its grade says (`terranav.ins.error_state`). GNSS says what that error is now: indicated
minus GNSS. A prediction from h seconds ago, made of what was known then, tells how far the two may have gone apart in h
seconds; a GNSS that is pulled away leaves that bound, and the slower the pull, the older the prediction that shows it.
So each is a generalised likelihood ratio for a pull of any direction and speed that began h seconds ago (Willsky and
Jones, IEEE Trans. Automatic Control 21, 1976), over a bank of onsets. Rows of the bank:

    0      follows GNSS, a Kalman filter of the states above
    1      the latest usable fix of the map, before the first one the prior: it holds no position of GNSS
    2, 3   copies of row 0 for the first horizon h: one is h to 2 h old, a younger one takes its place after that
    4, 5   ... and so on for each horizon

All rows take the same step; nothing but row 0 sees a reading, and only one that is above suspicion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.frozen import changed
from terranav.core.judgement import largest_sigma_m
from terranav.core.records import Prior
from terranav.ins.error_state import POSITION, VELOCITY, ErrorModel, Transition

FloatArray = NDArray[np.float64]

FOLLOWING, GROUNDED, COPIES = 0, 1, 2
EXACT_M = 0.1  # no estimate of an INS error is better


@dataclass(frozen=True, slots=True)
class Bank:
    """Predictions of the INS error, as of one time.

    Attributes
    ----------
    mean : (n, d)
        States of `ErrorModel`; position error [m] and velocity error [m/s], north and east, come first.
    cov : (n, d, d)
    since_s : (n,)
        When each was last told something [s].
    """

    mean: FloatArray
    cov: FloatArray
    since_s: FloatArray


def started(model: ErrorModel, prior: Prior, horizons: int, time_s: float, factor: float) -> Bank:
    """Every row the prior; `factor`: how many times worse than told the INS may be."""
    rows = COPIES + 2 * horizons
    mean = np.zeros((rows, model.size))
    mean[:, POSITION] = prior.mean_m
    cov = factor**2 * model.initial_covariance(prior.cov_m2)
    return Bank(mean, np.repeat(cov[None], rows, axis=0), np.full(rows, time_s))


def passed(bank: Bank, step: Transition, factor: float) -> Bank:
    """After a step of the INS."""
    phi = step.phi
    return changed(bank, mean=bank.mean @ phi.T, cov=phi @ bank.cov @ phi.T + factor**2 * step.q)


def followed(bank: Bank, error_m: FloatArray, variance_m2: float, time_s: float) -> Bank:
    """Row 0 after a reading of GNSS: the INS error (2,) it means, and the variance of one axis of it [m^2]."""
    mean, cov = bank.mean.copy(), bank.cov.copy()
    x, p = mean[FOLLOWING], cov[FOLLOWING]
    north, cross, east = float(p[0, 0]) + variance_m2, float(p[0, 1]), float(p[1, 1]) + variance_m2
    inverse = np.array(((east, -cross), (-cross, north))) / (north * east - cross * cross)
    gain = p[:, POSITION] @ inverse
    mean[FOLLOWING] = x + gain @ (error_m - x[POSITION])
    kept = np.eye(len(x))
    kept[:, POSITION] -= gain
    cov[FOLLOWING] = kept @ p @ kept.T + variance_m2 * (gain @ gain.T)  # Joseph's form stays positive definite
    since = bank.since_s.copy()
    since[FOLLOWING] = time_s
    return Bank(mean, cov, since)


def grounded(bank: Bank, error_m: FloatArray, cov_m2: FloatArray, time_s: float) -> Bank:
    """Row 1 anew: position error and covariance from the map, everything else from row 0, unrelated to it."""
    return _placed(bank, GROUNDED, error_m, cov_m2, time_s)


def restarted(bank: Bank, error_m: FloatArray, variance_m2: float, time_s: float) -> Bank:
    """All rows but the map's anew about a reading of GNSS; the velocity error is that of row 1."""
    rows = bank.mean.shape[0]
    source = changed(bank, mean=bank.mean.copy(), cov=bank.cov.copy())
    source.mean[FOLLOWING], source.cov[FOLLOWING] = bank.mean[GROUNDED], bank.cov[GROUNDED]
    source = _placed(source, FOLLOWING, error_m, variance_m2 * np.eye(2), time_s)
    index = np.array([FOLLOWING, GROUNDED, *[FOLLOWING] * (rows - COPIES)])
    return Bank(source.mean[index], source.cov[index], source.since_s[index])


def renewed(bank: Bank, horizons_s: tuple[float, ...], time_s: float) -> Bank:
    """Copies of row 0 where the young one of a horizon has become old enough."""
    due = [COPIES + 2 * i for i, h in enumerate(horizons_s) if time_s - bank.since_s[COPIES + 2 * i + 1] >= h]
    if not due:
        return bank
    mean, cov, since = bank.mean.copy(), bank.cov.copy(), bank.since_s.copy()
    for old in due:
        mean[old], cov[old], since[old] = mean[old + 1], cov[old + 1], since[old + 1]
        mean[old + 1], cov[old + 1], since[old + 1] = mean[FOLLOWING], cov[FOLLOWING], time_s
    return Bank(mean, cov, since)


def position_tests(bank: Bank, error_m: FloatArray, variance_m2: float) -> FloatArray:
    """(n,) squared distance of a reading from each prediction, in sigmas of both: chi-square of 2 when all is well."""
    return squared(error_m - bank.mean[:, POSITION], bank.cov[:, POSITION, POSITION], variance_m2)


def velocity_tests(bank: Bank, error_mps: FloatArray, variance: float) -> FloatArray:
    """(n,) the same of velocities: the INS's error (2,) as GNSS has it [m/s], and the variance of one axis of it."""
    return squared(error_mps - bank.mean[:, VELOCITY], bank.cov[:, VELOCITY, VELOCITY], variance)


def squared(away: FloatArray, cov: FloatArray, variance: float) -> FloatArray:
    """away' (cov + variance I)^-1 away for (..., 2) and (..., 2, 2)."""
    a, b, c = cov[..., 0, 0] + variance, cov[..., 0, 1], cov[..., 1, 1] + variance
    north, east = away[..., 0], away[..., 1]
    return np.asarray((c * north**2 - 2.0 * b * north * east + a * east**2) / (a * c - b * b))


def reach_m(away: FloatArray, cov: FloatArray, variance: float, limit: float) -> float:
    """How far off in the direction of `away` (2,) the squared distance is `limit`; the farthest where it has none."""
    length = math.hypot(*away.tolist())
    if length > 0.0:
        return math.sqrt(limit / float(squared(away / length, cov, variance)))
    return math.sqrt(limit * (largest_sigma_m(cov) ** 2 + variance))


def _placed(bank: Bank, row: int, error_m: FloatArray, cov_m2: FloatArray, time_s: float) -> Bank:
    """A row at a position that is known, its other states those of row 0."""
    mean, cov, since = bank.mean.copy(), bank.cov.copy(), bank.since_s.copy()
    mean[row], cov[row], since[row] = mean[FOLLOWING], cov[FOLLOWING], time_s
    mean[row, POSITION] = error_m
    cov[row, POSITION, :], cov[row, :, POSITION] = 0.0, 0.0
    cov[row, POSITION, POSITION] = cov_m2 + EXACT_M**2 * np.eye(2)
    return Bank(mean, cov, since)

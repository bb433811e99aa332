"""Figures of a run from plain arrays: how far off, how honest, how soon.

Accuracy figures are of the horizontal error e = estimate minus truth (north, east); epochs without truth are left out,
and a figure that has no epoch to stand on is NaN.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.records import Status

FloatArray = NDArray[np.float64]

#: 95 % quantile of chi-square with two degrees of freedom, -2 ln 0.05
CHI2_95_2DOF = -2.0 * float(np.log(0.05))


def accuracy(error_m: FloatArray, match_m: float) -> dict[str, float]:
    """How far off the estimates are.

    Parameters
    ----------
    error_m : (n, 2) [m]
        Estimate minus truth, north and east; NaN where the truth is unknown.
    match_m : float
        An error of at most this counts as a match (papers/004: sqrt(2) cells of the map) [m].

    Returns
    -------
    dict
        n (epochs with truth), drms_m (root of the mean squared distance), cep_m (median), r95_m (95th percentile),
        mean_m, max_m, final_m (last epoch), match_rate (share of matches).
    """
    known = _known(error_m)
    distance = np.hypot(error_m[known, 0], error_m[known, 1])
    if distance.size == 0:
        names = ("drms_m", "cep_m", "r95_m", "mean_m", "max_m", "final_m", "match_rate")
        return {"n": 0, **dict.fromkeys(names, float("nan"))}
    return {
        "n": int(distance.size),
        "drms_m": float(np.sqrt(np.mean(distance**2))),
        "cep_m": float(np.median(distance)),
        "r95_m": float(np.percentile(distance, 95.0)),
        "mean_m": float(distance.mean()),
        "max_m": float(distance.max()),
        "final_m": float(distance[-1]),
        "match_rate": float(np.mean(distance <= match_m)),
    }


def consistency(error_m: FloatArray, cov_m2: FloatArray) -> dict[str, float]:
    """Whether the claimed covariance is meant.

    Parameters
    ----------
    error_m : (n, 2) [m]
    cov_m2 : (n, 2, 2) [m^2]

    Returns
    -------
    dict
        nees (mean of e^T P^-1 e: 2 when the covariance is right, more when it is too small), nees_per_axis (half of
        it: 1 when right), contained_95 (share of errors inside the claimed 95 % ellipse).
    """
    known = _known(error_m) & np.isfinite(cov_m2).all(axis=(1, 2))
    if not known.any():
        return dict.fromkeys(("nees", "nees_per_axis", "contained_95"), float("nan"))
    (north, east), cov = error_m[known].T, cov_m2[known]
    det = cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] * cov[:, 1, 0]
    scaled = north**2 * cov[:, 1, 1] + east**2 * cov[:, 0, 0] - north * east * (cov[:, 0, 1] + cov[:, 1, 0])
    squared = np.divide(scaled, det, out=np.full(det.size, np.inf), where=det > 0.0)  # certainty cannot be right
    nees = float(squared.mean())
    return {"nees": nees, "nees_per_axis": nees / 2.0, "contained_95": float(np.mean(squared <= CHI2_95_2DOF))}


def integrity(error_m: FloatArray, protection_m: FloatArray, usable: NDArray[np.bool_]) -> dict[str, float]:
    """Whether the fixes that were offered could be relied on.

    Parameters
    ----------
    error_m : (n, 2) [m]
    protection_m : (n,) [m]
        NaN everywhere when no integrity monitor watched; then every figure is NaN.
    usable : (n,) bool

    Returns
    -------
    dict
        available (share of epochs with a usable fix), protection_m (median protection level of those), misleading (of
        those with truth, the share whose error exceeds the protection level).
    """
    if np.isnan(protection_m).all():
        return dict.fromkeys(("available", "protection_m", "misleading"), math.nan)
    offered = usable & ~np.isnan(protection_m)
    judged = offered & _known(error_m)
    beyond = np.hypot(error_m[judged, 0], error_m[judged, 1]) > protection_m[judged]
    return {
        "available": float(np.mean(usable)),
        "protection_m": float(np.median(protection_m[offered])) if offered.any() else math.nan,
        "misleading": float(np.mean(beyond)) if judged.any() else math.nan,
    }


def first_fix_s(time_s: FloatArray, status: NDArray[Any]) -> float:
    """Seconds from the first epoch to the first 'converged' one; NaN when there is none."""
    fixed = np.flatnonzero(status == Status.CONVERGED.value)
    return float(time_s[fixed[0]] - time_s[0]) if fixed.size else float("nan")


def time_with_status_s(time_s: FloatArray, status: NDArray[Any], wanted: Status) -> float:
    """Seconds spent in a status; an epoch's status holds until the next epoch."""
    return float(np.diff(time_s)[status[:-1] == wanted.value].sum())


def _known(error_m: FloatArray) -> NDArray[np.bool_]:
    """Epochs whose error is known."""
    return np.isfinite(error_m[:, 0]) & np.isfinite(error_m[:, 1])

"""From a correlation surface to candidates with probabilities and covariances.

The logarithm of the probability is known at the points of a search grid; within a cell it is taken as the quadratic
through 3 x 3 points. A peak can be far narrower than a cell. So the area that matters is searched again on a
finer grid (`zoomed`), and cells that are still too coarse are cut until the probability is smooth over the parts;
sums over the parts are then the moments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from terranav.core.records import Candidates, Posterior
from terranav.kernels.tercom import quadratics

FloatArray = NDArray[np.float64]

MOST_CANDIDATES = 8
TAIL = 20.0  # log-probability below the best at which the search area ends to matter
FINEST = 16  # a cell is cut at most this often per axis
MOST_PARTS = 1_000_000  # of cells that are cut
MOST_POINTS = 100_000  # of a finer grid


@dataclass(frozen=True)
class Surface:
    """How well a profile fits the map at each INS error of a square search grid.

    Attributes
    ----------
    north_m : (p,), east_m : (q,) [m]
        INS errors, in equal steps of both.
    score : (p, q)
        Weighted MSD [unit^2] or MAD [unit]; NaN where too few of the readings have a map value.
    """

    north_m: FloatArray
    east_m: FloatArray
    score: FloatArray

    @property
    def step_m(self) -> float:
        """Step of the search grid [m]."""
        return float(self.north_m[1] - self.north_m[0])


@dataclass(frozen=True)
class _Parts:
    """The cells that matter, each cut into f x f parts."""

    cell: NDArray[np.intp]  # (m, 2) row and column
    top: FloatArray  # (m,) best log-probability within the cell
    north_m: FloatArray  # (m, f * f)
    east_m: FloatArray
    mass: FloatArray  # (m, f * f), sums to one
    floor_m2: float  # least variance: all the mass in one part is not certainty


def best_place(surface: Surface, log_p: FloatArray) -> tuple[float, float]:
    """INS error at the peak of log_p (p, q), located between the points of the grid [m]."""
    i, j = np.unravel_index(int(np.nanargmax(log_p)), log_p.shape)
    slope, bend, _ = _quadratics(log_p[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2])
    u, v = _vertex(slope, bend)
    inner = u.shape == (3, 3)
    north, east = (float(u[1, 1]), float(v[1, 1])) if inner else (0.0, 0.0)
    return float(surface.north_m[i]) + surface.step_m * north, float(surface.east_m[j]) + surface.step_m * east


def zoomed(surface: Surface, log_p: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Points (north, east) [m] of a finer grid over all that matters; None where this one is as fine as need be."""
    _, bend, rise = _quadratics(log_p)
    top = np.where(np.isnan(log_p), -np.inf, log_p + rise)
    cells = np.nonzero(top > top.max() - TAIL)
    first, last = [max(int(c.min()) - 1, 0) for c in cells], [int(c.max()) + 1 for c in cells]
    sides = [min(b, size - 1) - a for a, b, size in zip(first, last, top.shape)]
    cuts = min(_cuts(top, bend), math.isqrt(MOST_POINTS // max(sides[0] * sides[1], 1)))
    if cuts < 2:
        return None
    north, east = [a * 1.0 + np.arange(side * cuts + 1) / cuts for a, side in zip(first, sides)]
    return surface.north_m[0] + surface.step_m * north, surface.east_m[0] + surface.step_m * east


def candidates(surface: Surface, log_p: FloatArray, nis: float, apart_m: float | None) -> Candidates:
    """Distinct peaks, best first, each with the moments and the mass of the parts that lie nearest to it.

    Parameters
    ----------
    surface : Surface
    log_p : (p, q)
        Logarithm of the probability, up to a constant; NaN where it is zero. Not all of it NaN.
    nis : float
        Passed on.
    apart_m : float or None
        A candidate is best within this distance along each axis. None: within three cells, each of which is its centre,
        and the covariance has the step^2/12 of that.
    """
    slope, bend, rise = _quadratics(log_p)
    apart = 3 if apart_m is None else round(apart_m / surface.step_m)
    if apart_m is None:
        slope, bend, rise = np.zeros_like(slope), np.zeros_like(bend), np.zeros_like(rise)
    top = np.where(np.isnan(log_p), -np.inf, log_p + rise)
    parts = _cut(surface, log_p, top, slope, bend)
    inner_m2 = surface.step_m**2 / 12.0 if apart_m is None else parts.floor_m2
    highest = maximum_filter(top, size=2 * apart + 1)[parts.cell[:, 0], parts.cell[:, 1]]
    peaks = np.flatnonzero(parts.top == highest)
    peaks = peaks[np.argsort(-parts.top[peaks], kind="stable")][:MOST_CANDIDATES]
    away = np.sum((parts.cell[:, None, :] - parts.cell[None, peaks, :]) ** 2, axis=2)
    owner = np.argmin(away, axis=1)
    moments = [_moments(parts, owner == k, inner_m2) for k in range(peaks.size)]
    share = np.array([entry[0] for entry in moments])
    best = np.argsort(-share, kind="stable")
    weight = np.zeros(top.shape)
    weight[parts.cell[:, 0], parts.cell[:, 1]] = parts.mass.sum(axis=1)
    at = parts.cell[peaks[best]]
    return Candidates(
        np.array([entry[1] for entry in moments])[best],
        np.array([entry[2] for entry in moments])[best],
        share[best],
        surface.score[at[:, 0], at[:, 1]],
        nis,
        Posterior(surface.north_m, surface.east_m, weight),
    )


def _cut(surface: Surface, log_p: FloatArray, top: FloatArray, slope: FloatArray, bend: FloatArray) -> _Parts:
    """Cut the cells that matter."""
    rows, cols = np.nonzero(top > top.max() - TAIL)
    cuts = min(_cuts(top, bend), max(1, math.isqrt(MOST_PARTS // rows.size)))
    offset = (np.arange(cuts) + 0.5) / cuts - 0.5
    u, v = np.repeat(offset, cuts), np.tile(offset, cuts)
    (gn, ge), (nn, ne, ee) = slope[:, rows, cols, None], bend[:, rows, cols, None]
    value = log_p[rows, cols, None] + u * gn + v * ge + 0.5 * (u * u * nn + v * v * ee) + u * v * ne
    mass = np.exp(value - value.max())
    return _Parts(
        np.stack([rows, cols], axis=1),
        top[rows, cols],
        surface.north_m[rows, None] + surface.step_m * u,
        surface.east_m[cols, None] + surface.step_m * v,
        mass / mass.sum(),
        (0.1 * surface.step_m / cuts) ** 2,
    )


def _cuts(top: FloatArray, bend: FloatArray) -> int:
    """Parts per axis so that the narrowest ridge near the top has a sigma of 0.8 parts."""
    near = top > top.max() - 3.0
    nn, ne, ee = bend[:, near]
    sharpest = max(float(np.max(0.5 * (-nn - ee + np.hypot(nn - ee, 2.0 * ne)))), 0.0)  # 1/sigma^2 [1/cell^2]
    return min(max(math.ceil(0.8 * math.sqrt(sharpest)), 1), FINEST)


def _moments(parts: _Parts, own: NDArray[np.bool_], inner_m2: float) -> tuple[float, FloatArray, FloatArray]:
    """Mass, mean and covariance of some of the parts, each of which has a variance within."""
    mass = parts.mass[own]
    share = float(mass.sum())
    place = np.stack([parts.north_m[own], parts.east_m[own]], axis=-1)
    mean = np.tensordot(mass, place, 2) / share
    off = place - mean
    return share, mean, np.einsum("ij,ijk,ijl->kl", mass, off, off) / share + np.eye(2) * inner_m2


def _quadratics(field: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Slopes, second derivatives and rise of the quadratics through 3 x 3 points (`kernels.tercom.quadratics`)."""
    slope, bend, rise = np.empty((2, *field.shape)), np.empty((3, *field.shape)), np.empty(field.shape)
    quadratics(np.ascontiguousarray(field), slope, bend, rise)
    return slope, bend, rise


def _vertex(slope: FloatArray, bend: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where each quadratic is largest, if that is within half a cell, else its centre [cells]."""
    det = bend[0] * bend[2] - bend[1] ** 2
    peaked = (det > 0.0) & (bend[0] < 0.0)
    safe = np.where(peaked, det, 1.0)
    u = (bend[1] * slope[1] - bend[2] * slope[0]) / safe
    v = (bend[1] * slope[0] - bend[0] * slope[1]) / safe
    inside = peaked & (np.abs(u) <= 0.5) & (np.abs(v) <= 0.5)
    return np.where(inside, u, 0.0), np.where(inside, v, 0.0)

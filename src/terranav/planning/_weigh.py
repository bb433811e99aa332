"""How much of the probability lies at a place, and how far it spreads there: integrals over the cells that were kept.

The likelihood about a place is a narrow peak over rough land and a ridge of many cells over gentle land; a mixture of
points drawn evenly over the kept cells, headings and scales and of points drawn from the Gaussian of the least squares
serves both (balance heuristic; Veach and Guibas, Optimally combining sampling techniques, SIGGRAPH 1995). The points
are those of an additive recurrence, so the same every time.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from terranav.kernels import placing
from terranav.planning._fits import Fit, free_of
from terranav.planning._placements import Search

FloatArray = NDArray[np.float64]

DRAWS = 1024  # of each kind
WIDER = 1.5  # the Gaussian drawn from against the one of the fit
_RATIO = 1.16730397826141868  # positive root of x^5 = x + 1: generalised golden ratio of four dimensions


def weighed(work: Search, weight: FloatArray, fit: Fit, leaves: FloatArray) -> Fit:
    """The fit with its volume and second moments about it by integration over leaves (n, 4), as in `searched`."""
    free = free_of(work)
    evenly, gaussian = _evenly(work, leaves, free), _gaussian(fit, free)
    at = np.concatenate([evenly, gaussian])
    if work.half >= math.pi:
        at[:, 2] = (at[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
    inside = _inside(work, at, leaves)
    at, chosen = at[inside], fit.at
    moved = at - chosen
    moved[:, 2] = (moved[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
    mixture = len(evenly) / (len(leaves) * work.leaf) + len(gaussian) * _density(fit, free, moved)
    share = np.exp(-0.5 * (_misfits(work, weight, fit, at) - fit.misfit)) / mixture
    volume = float(share.sum())
    if not 0.0 < volume < math.inf:
        return fit
    moments: FloatArray = (moved * (share / volume)[:, None]).T @ moved
    return replace(fit, volume=volume, spread=moments)


def _recurrence(count: int) -> FloatArray:
    """(count, 4) points that fill the unit cube evenly."""
    steps = _RATIO ** -np.arange(1.0, 5.0)
    points: FloatArray = (0.5 + np.arange(1.0, count + 1.0)[:, None] * steps) % 1.0
    return points


def _evenly(work: Search, leaves: FloatArray, free: NDArray[np.int64]) -> FloatArray:
    """As many points in each leaf."""
    each = -(-DRAWS // len(leaves))
    size = np.array([1.0, 1.0, *(2.0 * one / part for one, part in zip((work.half, work.stretch), work.parts))])
    spot = np.zeros((each * len(leaves), 4))
    spot[:, free] = ((_recurrence(len(spot)) - 0.5) * size)[:, free]
    points: FloatArray = np.repeat(leaves[:, :4], each, axis=0) + spot
    return points


def _root(fit: Fit, free: NDArray[np.int64]) -> FloatArray:
    """Square root of the covariance that is drawn from."""
    assert fit.spread is not None
    inner = WIDER**2 * fit.spread[np.ix_(free, free)]
    values, ways = np.linalg.eigh(inner)
    root: FloatArray = ways * np.sqrt(np.maximum(values, 1e-12 * float(values[-1])))
    return root


def _gaussian(fit: Fit, free: NDArray[np.int64]) -> FloatArray:
    """Points about the fit."""
    root, at = _root(fit, free), np.tile(fit.at, (DRAWS, 1))
    at[:, free] += ndtri(_recurrence(DRAWS)[:, : root.shape[1]]) @ root.T
    return at


def _density(fit: Fit, free: NDArray[np.int64], moved: FloatArray) -> FloatArray:
    """Of the Gaussian drawn from."""
    root = _root(fit, free)
    apart = np.linalg.solve(root, moved[:, free].T)
    norm = abs(float(np.linalg.det(root))) * (2.0 * math.pi) ** (0.5 * root.shape[0])
    density: FloatArray = np.exp(-0.5 * (apart**2).sum(axis=0)) / norm
    return density


def _numbers(work: Search, at: FloatArray) -> NDArray[np.int64]:
    """One whole number for each leaf; that of the leaf that holds a placement, -1 off all of them."""
    ranges = np.array([work.half, work.stretch])
    part = np.array(work.parts)
    step = (at[:, 2:] - [0.0, 1.0] + ranges) / np.where(ranges > 0.0, 2.0 * ranges, 1.0) * part
    step = np.where(ranges > 0.0, np.floor(step), 0.0)
    cell = np.floor(at[:, :2] + 0.5)
    rows, cols = work.values.shape
    on = ((step >= 0) & (step < part) & (cell >= 0) & (cell < [rows, cols])).all(axis=1)
    number = ((cell[:, 0] * cols + cell[:, 1]) * part[0] + step[:, 0]) * part[1] + step[:, 1]
    return np.where(on, number, -1.0).astype(np.int64)


def _inside(work: Search, at: FloatArray, leaves: FloatArray) -> NDArray[np.bool_]:
    """Which placements lie in the leaves."""
    inside: NDArray[np.bool_] = np.isin(_numbers(work, at), _numbers(work, leaves[:, :4]))
    return inside


def _misfits(work: Search, weight: FloatArray, fit: Fit, at: FloatArray) -> FloatArray:
    """Of each placement (n, 4); infinite where it leaves the map."""
    frame = work.frame(float(fit.at[0]), float(fit.at[1]))
    out = np.empty(len(at))
    data = (work.height, weight, work.offset_weight, work.void_cost)
    placing.misfits(work.values, at, work.points, np.array([frame.row, frame.col]), data, out)
    return out

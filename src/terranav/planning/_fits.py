"""Placements of a track at their least misfit nearby, below the cell, and how well each is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from terranav.kernels import placing, sampling
from terranav.maps.frame import LocalFrame
from terranav.planning._placements import TOP, Search, relative

FloatArray = NDArray[np.float64]

APART_CELLS = 2.5  # places nearer than this are one
APART_ENDS = 2.0  # times that, by which a turn or a stretch may move the ends of one place
ROUNDS = 25  # of a fit
LOWERING = 10  # rounds of a descent from each of all cells and headings that were kept


@dataclass(frozen=True)
class Fit:
    """A placement at its least misfit nearby.

    `at` is row, column, heading [rad] and factor; `points` are rows and columns in the search's order, `residual` is
    NaN over voids. `volume` [cells^2 rad], over the parameters that are not known, is that in which the likelihood is
    about its peak; `spread` (4, 4) is their covariance.
    """

    at: FloatArray
    offset: float
    misfit: float
    points: tuple[FloatArray, FloatArray]
    residual: FloatArray
    volume: float = 0.0
    spread: FloatArray | None = None


def fitted(
    work: Search, weight: FloatArray, kept: FloatArray, margin: float, most: int
) -> tuple[list[Fit], list[FloatArray], FloatArray]:
    """The distinct places among what was kept, each at its least misfit, the best first.

    Parameters
    ----------
    kept : (n, 5), as `searched` gives it
    margin : float
        Places with a misfit so far above the best are left out.
    most : int
        Places.

    Returns
    -------
    fits : list of Fit
    leaves : list of (n, 5)
        What was kept of each.
    left : (n, 5)
        What was kept and leads to a place that is not among them, with the misfit there.
    """
    left, low, misfit = _lowered(work, weight, kept)
    found: list[tuple[Fit, FloatArray]] = []
    while len(left) and len(found) < most:
        if found and misfit[0] > found[0][0].misfit + margin:
            break
        fit = _descended(work, weight, low[0])
        near = same_place(work, left, fit.at) | same_place(work, low, fit.at)
        near[0] = True
        if all(not same_place(work, one.at[None], fit.at)[0] for one, _ in found):
            found.append((fit, left[near]))
        else:
            k = next(k for k, (one, _) in enumerate(found) if same_place(work, one.at[None], fit.at)[0])
            found[k] = min(found[k][0], fit, key=lambda one: one.misfit), np.concatenate([found[k][1], left[near]])
        left, low, misfit = left[~near], low[~near], misfit[~near]
    found.sort(key=lambda one: one[0].misfit)
    limit = found[0][0].misfit + margin if found else math.inf
    rest = np.column_stack([left[:, :4], misfit])[misfit <= limit]
    found = [one for one in found if one[0].misfit <= limit]
    return [fit for fit, _ in found], [leaves for _, leaves in found], rest


def _lowered(work: Search, weight: FloatArray, kept: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What was kept, its placements at about their least misfit nearby (n, 4), and that misfit, the best first."""
    low, misfit = kept[:, :4].copy(), kept[:, 4].copy()
    for k in np.flatnonzero(np.isinf(misfit)):  # the middle is off the map, the rest of the cell is not
        low[k] = _moved_in(work, low[k])
    side, cols = 2**TOP, work.values.shape[1]
    data = (work.height, weight, work.offset_weight, work.void_cost)
    ranges, free = np.array([work.half, work.stretch]), free_of(work)
    part = (kept[:, 0] // side) * (cols // (4 * side) + 1) + kept[:, 1] // (4 * side)
    for number in np.unique(part):
        chosen = np.flatnonzero(part == number)
        frame = work.frame(*(float(one) for one in low[chosen, :2].mean(axis=0)))
        here, there = low[chosen], np.empty(chosen.size)
        placing.descend(
            work.values, here, work.points, np.array([frame.row, frame.col]), data, ranges, free, LOWERING, there
        )
        low[chosen], misfit[chosen] = here, there
    order = np.argsort(misfit, kind="stable")
    return kept[order], low[order], misfit[order]


def _moved_in(work: Search, at: FloatArray) -> FloatArray:
    """A placement moved so that the whole track lies on the map."""
    frame = work.frame(float(at[0]), float(at[1]))
    moved = at.copy()
    for axis, ends in enumerate(relative(frame, *work.turned(float(at[2]), float(at[3])))):
        moved[axis] = min(max(at[axis], -ends.min()), work.values.shape[axis] - 1.0 - ends.max())
    return moved


def free_of(work: Search) -> NDArray[np.int64]:
    """Numbers of the parameters that are not known."""
    return np.flatnonzero([True, True, work.half > 0.0, work.stretch > 0.0])


def same_place(work: Search, several: FloatArray, one: FloatArray) -> NDArray[np.bool_]:
    """Which of several placements count as the same place as one: (n,)."""
    ends = work.reach_m / work.chart.cell_m
    turn = np.abs((several[:, 2] - one[2] + math.pi) % (2.0 * math.pi) - math.pi)
    near: NDArray[np.bool_] = (
        (np.abs(several[:, :2] - one[:2]).max(axis=1) <= APART_CELLS)
        & (ends * turn <= APART_ENDS * APART_CELLS)
        & (ends * np.abs(several[:, 3] - one[3]) <= APART_ENDS * APART_CELLS)
    )
    return near


def _descended(work: Search, weight: FloatArray, start: FloatArray) -> Fit:
    """Levenberg-Marquardt over row, column, heading and factor, the offset eliminated."""
    frame = work.frame(float(start[0]), float(start[1]))
    free = free_of(work)
    best, damping = _placed(work, weight, frame, start), 1e-3
    normal, right = _normal(work, weight, frame, best)
    for _ in range(ROUNDS):
        damped = (normal + damping * np.diag(np.diag(normal) + 1e-12))[np.ix_(free, free)]
        step = np.zeros(4)
        step[free] = np.linalg.lstsq(damped, right[free], rcond=None)[0]
        step *= min(1.0, 1.0 / max(float(np.abs(step[:2]).max()), 1e-12))  # a cell at a time
        tried = _placed(work, weight, frame, _held(work, best.at + step))
        if tried.misfit < best.misfit:
            gained, best, damping = best.misfit - tried.misfit, tried, 0.3 * damping
            normal, right = _normal(work, weight, frame, best)
            if gained < 1e-3:
                break
        else:
            damping *= 10.0
            if damping > 1e4:
                break
    return _spread(work, normal, free, best)


def _held(work: Search, at: FloatArray) -> FloatArray:
    """The placement within the ranges of heading and scale."""
    psi = float(at[2])
    psi = (psi + math.pi) % (2.0 * math.pi) - math.pi if work.half >= math.pi else min(max(psi, -work.half), work.half)
    return np.array([at[0], at[1], psi, min(max(float(at[3]), 1.0 - work.stretch), 1.0 + work.stretch)])


def _spread(work: Search, normal: FloatArray, free: NDArray[np.int64], best: Fit) -> Fit:
    """The fit with its covariance (4, 4) and volume; a heading or scale is known to its range at the least."""
    known = normal + np.diag([1e-9, 1e-9, *(3.0 / one**2 if one > 0.0 else 0.0 for one in (work.half, work.stretch))])
    inner = known[np.ix_(free, free)]
    size = np.sqrt(np.diag(inner))
    values, ways = np.linalg.eigh(inner / np.outer(size, size))
    values = np.maximum(values, 1e-12)
    spread = np.zeros((4, 4))
    spread[np.ix_(free, free)] = (ways / values) @ ways.T / np.outer(size, size)
    volume = float(np.prod(np.sqrt(2.0 * math.pi / values) / size))
    return replace(best, volume=volume, spread=spread)


def _placed(work: Search, weight: FloatArray, frame: LocalFrame, at: FloatArray) -> Fit:
    """The placement at a row, column, heading and factor; infinite misfit where it leaves the map."""
    down, right = relative(frame, *work.turned(float(at[2]), float(at[3])))
    row, col = at[0] + down, at[1] + right
    rows, cols = work.values.shape
    height = np.empty(row.size)
    sampling.bilinear(work.values, row, col, height)
    d = work.height - height
    known = np.isfinite(d)
    total = float(weight[known].sum()) + work.offset_weight
    offset = float((weight[known] * d[known]).sum()) / total if total > 0.0 else 0.0
    misfit = float((weight[known] * (d[known] - offset) ** 2).sum()) + work.offset_weight * offset**2
    misfit += work.void_cost * float((~known).sum())
    if row.min() < -1e-6 or col.min() < -1e-6 or row.max() > rows - 1 + 1e-6 or col.max() > cols - 1 + 1e-6:
        misfit = math.inf
    return Fit(at.astype(np.float64), offset, misfit, (row, col), d - offset)


def _normal(work: Search, weight: FloatArray, frame: LocalFrame, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Normal matrix (4, 4) and right side (4,) of row, column, heading and factor, the offset eliminated."""
    row, col = fit.points
    low, high, slopes = np.empty(row.size), np.empty(row.size), []
    for by_row, by_col in ((0.5, 0.0), (0.0, 0.5)):
        sampling.bilinear(work.values, row - by_row, col - by_col, low)
        sampling.bilinear(work.values, row + by_row, col + by_col, high)
        slopes.append(high - low)
    ways = moves(work, frame, fit.at)
    jacobian = np.column_stack([*slopes, *(slopes[0] * way[0] + slopes[1] * way[1] for way in ways)])
    known = np.isfinite(jacobian).all(axis=1) & np.isfinite(fit.residual)
    j, w, r = jacobian[known], weight[known], fit.residual[known]
    total = max(float(w.sum()) + work.offset_weight, 1e-30)
    mean = (w @ j) / total
    normal = (j * w[:, None]).T @ j - total * np.outer(mean, mean)
    return normal, (j * w[:, None]).T @ r - mean * (w @ r)


def moves(work: Search, frame: LocalFrame, at: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """By how many rows and columns each point moves for a radian of heading, and for a unit of the factor."""
    psi, factor = float(at[2]), float(at[3])
    return [relative(frame, *work.turned(psi + 0.5 * math.pi, factor)), relative(frame, *work.turned(psi))]


def cov_at_end(work: Search, fit: Fit) -> FloatArray:
    """Covariance (2, 2) of the track's last point, north and east [m^2]."""
    frame, last = work.frame(float(fit.at[0]), float(fit.at[1])), int(np.argmax(work.along))
    ways = moves(work, frame, fit.at)
    jacobian = np.column_stack([np.eye(2), *([way[0][last], way[1][last]] for way in ways)])
    to_cells = np.array([frame.row[1:3], frame.col[1:3]])
    to_metres = np.linalg.inv(to_cells) @ jacobian
    assert fit.spread is not None
    cov: FloatArray = to_metres @ fit.spread @ to_metres.T
    return 0.5 * (cov + cov.T)

"""Placements of a track on a map below the cell: their misfits, and the way down to the least one nearby.

A placement is row, column, heading [rad] and factor; its misfit is that of `kernels.locating.misfit_at`.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.locating import misfit_at
from terranav.kernels.sampling import SLACK, bilinear_at

GAIN = 0.1  # of the misfit in a step, below which a descent is at its end


@jit
def misfits(values, at, points, frame, data, out):
    """`misfit_at` of many placements near one place.

    Parameters
    ----------
    values : (rows, cols) float32
    at : (n, 4) float64: row, column, heading [rad] and factor
    points : (2, k) float64, north and east of the middle [m]
    frame : (2, 6) float64: coefficients as in `LocalFrame`, rows and columns; the first of each is left out
    data : (heights (k,), weights (k,), offset weight, void_cost)
    out : (n,) float64, written
    """
    heights, weight, offset_weight, void_cost = data
    down, right = np.empty(heights.size), np.empty(heights.size)
    r, c = frame[0], frame[1]
    for i in range(at.shape[0]):
        cos, sin = at[i, 3] * np.cos(at[i, 2]), at[i, 3] * np.sin(at[i, 2])
        for k in range(heights.size):
            n, e = points[0, k] * cos - points[1, k] * sin, points[0, k] * sin + points[1, k] * cos
            down[k] = n * (r[1] + r[3] * n + r[4] * e) + e * (r[2] + r[5] * e)
            right[k] = n * (c[1] + c[3] * n + c[4] * e) + e * (c[2] + c[5] * e)
        out[i], _ = misfit_at(values, at[i, 0], at[i, 1], down, right, heights, weight, offset_weight, void_cost)


@jit
def _solved(matrix, right, damping, free, step):
    """(matrix + damping diag(matrix)) step = right over the free parameters, by elimination; nought for the others."""
    n = free.size
    a = np.empty((n, n + 1))
    for i in range(n):
        for j in range(n):
            a[i, j] = matrix[free[i], free[j]]
        a[i, i] += damping * a[i, i] + 1e-12
        a[i, n] = right[free[i]]
    for i in range(n):
        for j in range(i + 1, n):
            factor = a[j, i] / a[i, i]
            for k in range(i, n + 1):
                a[j, k] -= factor * a[i, k]
    step[:] = 0.0
    for i in range(n - 1, -1, -1):
        rest = a[i, n]
        for k in range(i + 1, n):
            rest -= a[i, k] * step[free[k]]
        step[free[i]] = rest / a[i, i]


@jit
def _normal_at(values, at, points, frame, data, normal, right):
    """Misfit of a placement, and the normal matrix and right side of its four parameters, the offset eliminated."""
    heights, weight, offset_weight, void_cost = data
    rows, cols = values.shape
    j, mean, slope = np.empty(4), np.zeros(4), np.empty(2)
    normal[:], right[:] = 0.0, 0.0
    total, first, second, known, voids = offset_weight, 0.0, 0.0, offset_weight, 0
    part = 0.0
    cos, sin = at[3] * np.cos(at[2]), at[3] * np.sin(at[2])
    r, c = frame[0], frame[1]
    for k in range(heights.size):
        n, e = points[0, k] * cos - points[1, k] * sin, points[0, k] * sin + points[1, k] * cos
        row = at[0] + n * (r[1] + r[3] * n + r[4] * e) + e * (r[2] + r[5] * e)
        col = at[1] + n * (c[1] + c[3] * n + c[4] * e) + e * (c[2] + c[5] * e)
        if row < -SLACK or col < -SLACK or row > rows - 1.0 + SLACK or col > cols - 1.0 + SLACK:
            return np.inf
        d = heights[k] - bilinear_at(values, row, col)
        if d != d:
            voids += 1
            continue
        w = weight[k]
        total, first, second = total + w, first + w * d, second + w * d * d
        slope[0] = bilinear_at(values, row + 0.5, col) - bilinear_at(values, row - 0.5, col)
        slope[1] = bilinear_at(values, row, col + 0.5) - bilinear_at(values, row, col - 0.5)
        if not (slope[0] == slope[0] and slope[1] == slope[1]):
            continue
        j[0], j[1] = slope[0], slope[1]
        j[2] = slope[0] * (r[2] * n - r[1] * e) + slope[1] * (c[2] * n - c[1] * e)
        j[3] = (slope[0] * (r[1] * n + r[2] * e) + slope[1] * (c[1] * n + c[2] * e)) / at[3]
        known, part = known + w, part + w * d
        for a in range(4):
            mean[a] += w * j[a]
            right[a] += w * j[a] * d
            for b in range(4):
                normal[a, b] += w * j[a] * j[b]
    known = known if known > 0.0 else 1.0
    for a in range(4):
        right[a] -= mean[a] * part / known
        for b in range(4):
            normal[a, b] -= mean[a] * mean[b] / known
    return max(second - (first * first / total if total > 0.0 else 0.0), 0.0) + voids * void_cost


@jit
def descend(values, at, points, frame, data, ranges, free, rounds, out):
    """Take placements to their least misfit nearby by damped least squares; a cell a step at the most.

    Parameters
    ----------
    values : (rows, cols) float32
    at : (n, 4) float64: row, column, heading [rad] and factor, written
    points, frame, data : as in `misfits`
    ranges : (2,) float64: what the heading and the factor may be off at most
    free : whole numbers of those of the four that are not known
    rounds : int
    out : (n,) float64: the misfits there, written
    """
    normal, right = np.empty((4, 4)), np.empty(4)
    new_normal, new_right = np.empty((4, 4)), np.empty(4)
    step, tried = np.zeros(4), np.empty(4)
    for i in range(at.shape[0]):
        best, damping = _normal_at(values, at[i], points, frame, data, normal, right), 1e-3
        for _ in range(rounds):
            _solved(normal, right, damping, free, step)
            longest = max(abs(step[0]), abs(step[1]), 1e-12)
            for a in range(4):
                tried[a] = at[i, a] + step[a] * min(1.0, 1.0 / longest)
            tried[2] = min(max(tried[2], -ranges[0]), ranges[0])
            tried[3] = min(max(tried[3], 1.0 - ranges[1]), 1.0 + ranges[1])
            new = _normal_at(values, tried, points, frame, data, new_normal, new_right)
            if new < best:
                gained, best, damping = best - new, new, 0.3 * damping
                at[i], normal[:], right[:] = tried, new_normal, new_right
                if gained < GAIN:
                    break
            else:
                damping *= 10.0
                if damping > 1e4:
                    break
        out[i] = best

"""The fading-memory recursion over a lattice of INS errors, and the posterior that its surface means."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.lattice import bilinear_lattice

LINES = 8  # of the lattice, sampled at a time
FINEST = 16  # parts per axis into which a cell is cut at most
MOST_PARTS = 400_000  # of all cells that are cut
SUMS = {"contract"}  # a product and a sum in one operation; NaN passes through it like any other


@jit(fastmath=SUMS)
def fade(field, value, weight, alpha, before, after):
    """One reading into the surface: after = alpha * before + weight * (value - field)^2.

    Parameters
    ----------
    field : (n,) float64 or longer
        The map at the place of each cell, NaN where it has no value: such a cell only fades.
    value, weight, alpha : float
    before, after : (n,) float64, after is written

    Returns
    -------
    int
        Cells without a map value.
    """
    unknown = 0
    for j in range(after.size):
        e = value - field[j]
        known = e == e
        after[j] = alpha * before[j] + (weight * (e * e) if known else 0.0)
        unknown += 0 if known else 1
    return unknown


@jit
def recall(values, frame, lattice, reading, alpha, before, after):
    """One reading into the surface, from the map: `fade` with the map under each position error.

    Parameters
    ----------
    values : (rows, cols) float32, NaN where void
    frame : (2, 6) float64
        Row and column coefficients of the LocalFrame at the indicated position.
    lattice : (north (p,), east (q,)) float64 [m]
        Position errors; the true place lies at minus the error.
    reading : (value, weight)
    alpha : float
    before, after : (p, q) float64, after is written

    Returns
    -------
    int
        Cells without a map value.
    """
    north, east, (value, weight), unknown = -lattice[0], -lattice[1], reading, 0
    field = np.empty((LINES, east.size))  # a few lines at a time: they stay in the near cache
    flat, old, new = field.reshape(field.size), before.reshape(before.size), after.reshape(after.size)
    for start in range(0, north.size, LINES):
        stop = min(start + LINES, north.size)
        bilinear_lattice(values, frame[0], frame[1], north[start:stop], east, field[: stop - start])
        part = slice(start * east.size, stop * east.size)
        unknown += fade(flat, value, weight, alpha, old[part], new[part])
    return unknown


@jit
def log_posterior(surface, cost, lattice, prior, out):
    """Logarithm of the posterior, -cost * surface plus that of a Gaussian prior; where it is largest.

    Parameters
    ----------
    surface : (p, q) float64, NaN where nothing is known
    cost : float
    lattice : (north (p,), east (q,)) float64 [m]
    prior : (5,) float64
        Mean north and east, and the precision's nn, ne, ee; a precision of zero is a flat prior.
    out : (p, q) float64, written

    Returns
    -------
    i, j : int
        Row and column of the maximum, -1 where every cell is NaN.
    """
    north, east = lattice
    size = east.size
    highest = np.full(size, -np.inf)  # of each column: that takes no branch, and runs over vector registers
    flat, source = out.reshape(out.size), surface.reshape(surface.size)
    for i in range(north.size):
        _weighed(source, i * size, cost, north[i] - prior[0], east, prior, flat, highest)
    best = -np.inf
    for j in range(size):
        best = max(best, highest[j])
    for i in range(north.size):
        if best > -np.inf and _count_above(flat, i * size, size, best, True) > 0:
            for j in range(size):
                if out[i, j] == best:
                    return i, j
    return -1, -1


@jit(fastmath=SUMS)
def _weighed(surface, at, cost, n, east, prior, out, highest):
    """One line of the logarithm of the posterior, and the highest so far of each column."""
    begin, nn, ne, ee = np.uint64(at), prior[2] * n * n, 2.0 * prior[3] * n, prior[4]
    for j in range(east.size):
        k = begin + np.uint64(j)
        e = east[j] - prior[1]
        p = -cost * surface[k] - 0.5 * (nn + ne * e + ee * (e * e))
        out[k] = p
        highest[j] = p if p > highest[j] else highest[j]


@jit
def _count_above(values, at, size, floor, equal):
    """How many values of a line lie above a floor, or on it."""
    count, begin = 0, np.uint64(at)
    for j in range(size):
        p = values[begin + np.uint64(j)]
        count += 1 if p > floor or (equal and p == floor) else 0
    return count


@jit
def _quadratic(field, i, j):
    """Slopes and second derivatives (n, e, nn, ne, ee) by 3 x 3 points [1/cell]; zero at the rim and beside NaN."""
    rows, cols = field.shape
    if i < 1 or j < 1 or i > rows - 2 or j > cols - 2:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    here = field[i, j]
    n = 0.5 * (field[i + 1, j] - field[i - 1, j])
    e = 0.5 * (field[i, j + 1] - field[i, j - 1])
    nn = field[i + 1, j] - 2.0 * here + field[i - 1, j]
    ee = field[i, j + 1] - 2.0 * here + field[i, j - 1]
    ne = 0.25 * (field[i + 1, j + 1] - field[i + 1, j - 1] - field[i - 1, j + 1] + field[i - 1, j - 1])
    total = n + e + nn + ne + ee
    if total != total:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    return n, e, nn, ne, ee


@jit
def _vertex(field, i, j):
    """Where the quadratic of a cell peaks within it, and how far that lies above its centre; else the centre."""
    n, e, nn, ne, ee = _quadratic(field, i, j)
    det = nn * ee - ne * ne
    if det <= 0.0 or nn >= 0.0:
        return 0.0, 0.0, 0.0
    u, v = (ne * e - ee * n) / det, (ne * n - nn * e) / det
    if abs(u) > 0.5 or abs(v) > 0.5:
        return 0.0, 0.0, 0.0
    return u, v, 0.5 * (u * n + v * e)


@jit
def rise(field, row, col):
    """How far the vertex of a cell's quadratic lies above its centre, where that is within the cell."""
    return _vertex(field, row, col)[2]


@jit
def moments(log_p, row, col, sub_cell, tail):
    """The fix at a peak, and the second moments of the posterior about it [cells].

    Within a cell the logarithm is the quadratic through 3 x 3 points, and cells are cut until the posterior is smooth
    over the parts; without `sub_cell` a cell is its centre, and has the variance of its width.

    Parameters
    ----------
    log_p : (p, q) float64, NaN where the posterior is zero
    row, col : int
        Of the peak.
    sub_cell : bool
    tail : float
        Cells that lie this far below the peak do not count.

    Returns
    -------
    (6,) float64
        Fractional row and column of the fix; second moments nn, ne, ee about it; how far log_p rises above the peak's
        cell.
    """
    rows, cols = log_p.shape
    u0, v0, gain = _vertex(log_p, row, col) if sub_cell else (0.0, 0.0, 0.0)
    top = log_p[row, col] + gain
    floor = log_p[row, col] - 3.0 * tail - 4.0 * gain  # a narrow peak's neighbours share its flank from far below
    count, sharpest, first, last = 0, 0.0, rows, 0
    flat, used = log_p.reshape(log_p.size), np.zeros((rows, cols), dtype=np.bool_)
    for i in range(rows):
        for j in range(cols if _count_above(flat, i * cols, cols, floor, False) > 0 else 0):
            p = log_p[i, j]
            if not p > floor:
                continue
            n, e, nn, ne, ee = _quadratic(log_p, i, j) if sub_cell else (0.0, 0.0, 0.0, 0.0, 0.0)
            rim = p + 0.5 * (abs(n) + abs(e)) + 0.125 * (abs(nn) + abs(ee)) + 0.25 * abs(ne)
            if rim > top - tail:
                used[i, j] = True
                count, first, last = count + 1, min(first, i), i
                if rim > top - 3.0:
                    sharpest = max(sharpest, 0.5 * (-nn - ee + math.hypot(nn - ee, 2.0 * ne)))
    cuts = min(max(math.ceil(0.8 * math.sqrt(sharpest)), 1), FINEST)
    cuts = max(min(cuts, int(math.sqrt(MOST_PARTS / max(count, 1)))), 1)
    mass, s_nn, s_ne, s_ee = 0.0, 0.0, 0.0, 0.0
    for i in range(first, last + 1):
        for j in range(cols):
            if not used[i, j]:
                continue
            n, e, nn, ne, ee = _quadratic(log_p, i, j) if sub_cell else (0.0, 0.0, 0.0, 0.0, 0.0)
            for a in range(cuts):
                u = (a + 0.5) / cuts - 0.5
                for b in range(cuts):
                    v = (b + 0.5) / cuts - 0.5
                    p = log_p[i, j] - top + u * n + v * e + 0.5 * (u * u * nn + v * v * ee) + u * v * ne
                    weight = math.exp(min(p, 0.0))
                    dn, de = i + u - row - u0, j + v - col - v0
                    mass += weight
                    s_nn += weight * dn * dn
                    s_ne += weight * dn * de
                    s_ee += weight * de * de
    within = 0.01 / (cuts * cuts) if sub_cell else 1.0 / 12.0  # all the mass in one part is not certainty
    return np.array([row + u0, col + v0, s_nn / mass + within, s_ne / mass, s_ee / mass + within, gain])

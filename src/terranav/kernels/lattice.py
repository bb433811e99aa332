"""Bilinear values of a map on a lattice of places in metres about an origin, one line of the lattice after another."""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.sampling import bilinear_at


@jit
def _along_a_row(values, row, c0, c1, c2, east, blend, line):
    """Line of a lattice on which the row does not change: the two rows around it are blended once."""
    y = int(row)
    u = row - y
    low, high = values[y], values[y + 1]
    ca, cb = c0 + east[0] * (c1 + east[0] * c2), c0 + east[-1] * (c1 + east[-1] * c2)
    bend = 0.25 * abs(c2) * (east[-1] - east[0]) ** 2
    for x in range(max(int(min(ca, cb) - bend), 0), min(int(max(ca, cb) + bend) + 2, blend.size)):
        blend[x] = (1.0 - u) * low[x] + u * high[x]
    for j in range(east.size):
        col = c0 + east[j] * (c1 + east[j] * c2)
        whole = np.int32(col)
        v, k = col - whole, np.uint32(whole)  # an unsigned index needs no test for a negative one
        line[j] = (1.0 - v) * blend[k] + v * blend[k + np.uint32(1)]


@jit
def _across_rows(values, r0, r1, r2, c0, c1, c2, east, line):
    """Line of a lattice that is oblique to the rows of the map."""
    cols = np.int64(values.shape[1])
    flat = values.reshape(values.size)
    for j in range(east.size):
        e = east[j]
        row, col = r0 + e * (r1 + e * r2), c0 + e * (c1 + e * c2)
        y, x = np.int64(row), np.int64(col)
        u, v = row - y, col - x
        k = np.uint64(y * cols + x)
        below = k + np.uint64(cols)
        low = (1.0 - v) * flat[k] + v * flat[k + np.uint64(1)]
        high = (1.0 - v) * flat[below] + v * flat[below + np.uint64(1)]
        line[j] = (1.0 - u) * low + u * high


@jit
def bilinear_row(values, row6, col6, north, east, blend, line):
    """Bilinear values at the places `north` and east[j] metres from the origin of a local frame.

    Parameters
    ----------
    values, row6, col6, east : as in `bilinear_lattice`
    north : float [m]
    blend : (cols,) float64, room to work in
    line : (q,) float64, written
    """
    rows, cols = values.shape
    n, first, last = north, east[0], east[-1]
    reach = last - first
    row_bend, col_bend = 0.25 * abs(row6[5]) * reach * reach, 0.25 * abs(col6[5]) * reach * reach
    r0, r1, r2 = row6[0] + n * (row6[1] + n * row6[3]), row6[2] + n * row6[4], row6[5]
    c0, c1, c2 = col6[0] + n * (col6[1] + n * col6[3]), col6[2] + n * col6[4], col6[5]
    # a parabola leaves its chord by at most a quarter of its bend: one test admits the whole line
    ra, rb = r0 + first * (r1 + first * r2), r0 + last * (r1 + last * r2)
    ca, cb = c0 + first * (c1 + first * c2), c0 + last * (c1 + last * c2)
    if (
        min(ra, rb) - row_bend >= 0.0
        and max(ra, rb) + row_bend < rows - 1.0
        and min(ca, cb) - col_bend >= 0.0
        and max(ca, cb) + col_bend < cols - 1.0
    ):
        if r1 == 0.0 and r2 == 0.0:
            _along_a_row(values, r0, c0, c1, c2, east, blend, line)
        else:
            _across_rows(values, r0, r1, r2, c0, c1, c2, east, line)
        for j in range(east.size):
            if np.isnan(line[j]):
                e = east[j]
                line[j] = bilinear_at(values, r0 + e * (r1 + e * r2), c0 + e * (c1 + e * c2))
    else:
        for j in range(east.size):
            e = east[j]
            line[j] = bilinear_at(values, r0 + e * (r1 + e * r2), c0 + e * (c1 + e * c2))


@jit
def bilinear_lattice(values, row6, col6, north, east, out):
    """Bilinear values on the lattice of places north[i], east[j] metres from the origin of a local frame.

    Parameters
    ----------
    values : (rows, cols) float32, both sizes >= 2, NaN where void
    row6, col6 : (6,) float64
        Coefficients of [1, n, e, n^2, n e, e^2] that give the fractional row and column [cells], as in LocalFrame.
    north : (p,) float64 [m]
    east : (q,) float64, monotonic [m]
    out : (p, q) float64, written
    """
    blend = np.empty(values.shape[1])
    for i in range(north.size):
        bilinear_row(values, row6, col6, north[i], east, blend, out[i])

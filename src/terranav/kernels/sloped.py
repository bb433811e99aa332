"""The map and its slope at many positions, a block at a time."""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.marginalized import SUMS
from terranav.kernels.sampling import bilinear_at


@jit(fastmath=SUMS)
def sloped(values, frame, north, east, work, found):
    """Bilinear values of a map and their slopes where an INS has these errors.

    Parameters
    ----------
    values : (rows, cols) float32, NaN where void
    frame : (2, 6) float64, row and column coefficients of the LocalFrame at the indicated position
    north, east : (k,) float64, k <= BLOCK, error of the INS [m]; the true place is at (-north, -east)
    work : (BLOCK,) uint64, (4, BLOCK) float32, (3, BLOCK) float64, scratch: cells, their corners, places within them
    found : (3, BLOCK) float64, written: value, NaN off the map and at voids; slope north, east [unit/m], finite
    """
    rows, cols = values.shape
    flat, width, most_row, most_col = values.reshape(values.size), np.uint64(cols), rows - 2.0, cols - 2.0
    r0, r1, r2, r3, r4, r5 = frame[0]
    c0, c1, c2, c3, c4, c5 = frame[1]
    at, corners, place = work
    size = north.size
    down, right, inside = place[0, :size], place[1, :size], place[2, :size]
    for k in range(size):
        n, e = -north[k], -east[k]
        row = r0 + n * (r1 + r3 * n + r4 * e) + e * (r2 + r5 * e)
        col = c0 + n * (c1 + c3 * n + c4 * e) + e * (c2 + c5 * e)
        there = (row >= 0.0) & (row <= most_row + 1.0) & (col >= 0.0) & (col <= most_col + 1.0)
        inside[k] = 0.0 if there else np.nan
        row, col = (row if row > 0.0 else 0.0), (col if col > 0.0 else 0.0)
        y, x = np.floor(row if row < most_row else most_row), np.floor(col if col < most_col else most_col)
        down[k], right[k] = row - y, col - x
        at[k] = np.uint64(np.int64(y * cols + x))
    one, two, three, four = corners[0, :size], corners[1, :size], corners[2, :size], corners[3, :size]
    for k in range(size):  # loads and stores alone, so that the loops around it run on whole registers
        first = at[k]
        one[k], two[k] = flat[first], flat[first + np.uint64(1)]
        three[k], four[k] = flat[first + width], flat[first + width + np.uint64(1)]
    height, rise_n, rise_e = found[0, :size], found[1, :size], found[2, :size]
    silent = 0
    for k in range(size):
        a, c, u, v = np.float64(one[k]), np.float64(three[k]), down[k], right[k]
        top, bottom = np.float64(two[k]) - a, np.float64(four[k]) - c
        a += v * top
        by_row, by_col = c + v * bottom - a, top + u * (bottom - top)
        h = a + u * by_row + inside[k]
        height[k] = h
        silent += 0 if h == h else 1
        north_slope, east_slope = by_row * r1 + by_col * c1, by_row * r2 + by_col * c2
        rise_n[k] = north_slope if north_slope == north_slope else 0.0
        rise_e[k] = east_slope if east_slope == east_slope else 0.0
    if silent > 0:
        for k in range(size):
            if height[k] != height[k]:  # in the slack of the edge, or beside a void that may have no weight
                n, e = -north[k], -east[k]
                row = r0 + n * (r1 + r3 * n + r4 * e) + e * (r2 + r5 * e)
                col = c0 + n * (c1 + c3 * n + c4 * e) + e * (c2 + c5 * e)
                height[k] = bilinear_at(values, row, col)

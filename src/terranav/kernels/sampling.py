"""Values of a grid between its cell centres.

Fractional rows and columns count in cell centres: (0.0, 0.0) is the centre of the first cell. The domain is the hull
of the cell centres with SLACK of a cell around it; outside it, and where a void has a weight above SLACK, the value is
NaN.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit

SLACK = 1e-6


@jit
def _split(position, size):
    """First of the two cells around a position within the hull, and the fraction towards the second."""
    inside = min(max(position, 0.0), size - 1.0)
    first = min(int(inside), size - 2)
    return first, inside - first


@jit
def _in_hull(row, col, rows, cols):
    """Whether a position is on the map; False for NaN."""
    return row >= -SLACK and row <= rows - 1.0 + SLACK and col >= -SLACK and col <= cols - 1.0 + SLACK


@jit
def _beside_void(values, i, j, u, v):
    """Bilinear value where a neighbour is void: voids without weight are left out."""
    total, weights = 0.0, 0.0
    for a in range(2):
        for b in range(2):
            weight = (u if a else 1.0 - u) * (v if b else 1.0 - v)
            if weight > SLACK:
                total += weight * values[i + a, j + b]
                weights += weight
    return total / weights


@jit
def bilinear_at(values, row, col):
    """Bilinear value at one position, NaN off the map."""
    rows, cols = values.shape
    if not _in_hull(row, col, rows, cols):
        return np.nan
    i, u = _split(row, rows)
    j, v = _split(col, cols)
    low = (1.0 - v) * values[i, j] + v * values[i, j + 1]
    high = (1.0 - v) * values[i + 1, j] + v * values[i + 1, j + 1]
    value = (1.0 - u) * low + u * high
    return _beside_void(values, i, j, u, v) if np.isnan(value) else value


@jit
def bilinear(values, row, col, out):
    """Bilinear values at scattered positions.

    Parameters
    ----------
    values : (rows, cols) float32, both sizes >= 2, NaN where void
    row, col : (n,) float64 [cells]
    out : (n,) float64, written
    """
    rows, cols = values.shape
    flat, width = values.reshape(values.size), np.int64(cols)
    top, right = rows - 1.0, cols - 1.0
    for k in range(out.size):  # no branch, so that it runs over vector registers
        r, c = row[k], col[k]
        inside = (r >= -SLACK) & (r <= top + SLACK) & (c >= -SLACK) & (c <= right + SLACK)
        r, c = (r if r > 0.0 else 0.0), (c if c > 0.0 else 0.0)  # NaN becomes 0 too
        r, c = min(r, top), min(c, right)
        y, x = np.int64(min(r, top - 1.0)), np.int64(min(c, right - 1.0))
        u, v = r - y, c - x
        first = np.uint64(y * width + x)
        second = first + np.uint64(width)
        low = (1.0 - v) * flat[first] + v * flat[first + np.uint64(1)]
        high = (1.0 - v) * flat[second] + v * flat[second + np.uint64(1)]
        out[k] = (1.0 - u) * low + u * high if inside else np.nan
    for k in range(out.size):
        if np.isnan(out[k]):
            out[k] = bilinear_at(values, row[k], col[k])


@jit
def _cubic_weights(t, i, size):
    """Weights of the cells i - 1 .. i + 2; a cell beyond the edge is the straight continuation of the two within.

    Catmull-Rom: Keys, IEEE Trans. ASSP-29 (1981), eq. 4 with a = -1/2.
    """
    before = t * (-0.5 + t * (1.0 - 0.5 * t))
    here = 1.0 + t * t * (-2.5 + 1.5 * t)
    after = t * (0.5 + t * (2.0 - 1.5 * t))
    beyond = t * t * (-0.5 + 0.5 * t)
    if i == 0:
        here, after, before = here + 2.0 * before, after - before, 0.0
    if i == size - 2:
        here, after, beyond = here - beyond, after + 2.0 * beyond, 0.0
    return before, here, after, beyond


@jit
def bicubic_at(values, row, col):
    """Bicubic (Catmull-Rom) value at one position, NaN off the map."""
    rows, cols = values.shape
    if not _in_hull(row, col, rows, cols):
        return np.nan
    i, u = _split(row, rows)
    j, v = _split(col, cols)
    by_row = _cubic_weights(u, i, rows)
    by_col = _cubic_weights(v, j, cols)
    total, dropped = 0.0, 0.0
    for a in range(4):
        for b in range(4):
            weight = by_row[a] * by_col[b]
            if weight != 0.0:
                value = values[i - 1 + a, j - 1 + b]
                if np.isnan(value) and abs(weight) <= SLACK:
                    dropped += weight
                else:
                    total += weight * value
    return total / (1.0 - dropped)


@jit
def bicubic(values, row, col, out):
    """Bicubic (Catmull-Rom) values at scattered positions; continuous slopes, exact on planes up to the edge.

    Parameters
    ----------
    values : (rows, cols) float32, both sizes >= 2, NaN where void
    row, col : (n,) float64 [cells]
    out : (n,) float64, written
    """
    for k in range(out.size):
        out[k] = bicubic_at(values, row[k], col[k])

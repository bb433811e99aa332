"""Values of a grid between its cell centres.

Fractional rows and columns count in cell centres: (0.0, 0.0) is the centre of the first cell. The domain is the hull
of the cell centres with SLACK of a cell around it; outside it, and where a void has a weight above SLACK, the value is
NaN.

A cloud is sampled in loops without branches, as if all of it lay well within a map without voids; what that leaves NaN
is sampled again one by one with all cases told apart.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit

SLACK = 1e-6
BLOCK = 2048  # positions worked on at a time, so that what is kept between two loops stays in the nearest cache


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
def _first_cells(row, col, least, most_row, most_col, cols, at):
    """Numbers in the flat map of the first cells around positions, held within bounds; NaN at the least."""
    for k in range(row.size):
        r = row[k] if row[k] > least else least
        c = col[k] if col[k] > least else least
        r, c = (r if r < most_row else most_row), (c if c < most_col else most_col)
        at[k] = np.uint64(np.int64(np.floor(r) * cols + np.floor(c)))


@jit
def _fetch_square(flat, cols, at, corners):
    """The four values of each cell; a loop of loads and stores alone, so that the next one runs on whole registers."""
    right, down, across = np.uint64(1), np.uint64(cols), np.uint64(cols + 1)
    for k in range(at.size):
        first = at[k]
        corners[4 * k], corners[4 * k + 1] = flat[first], flat[first + right]
        corners[4 * k + 2], corners[4 * k + 3] = flat[first + down], flat[first + across]


@jit
def bilinear_block(values, row, col, at, corners, out):
    """`bilinear` at up to BLOCK positions, with scratch of the caller's: (BLOCK,) uint64 and (4 BLOCK,) float32."""
    rows, cols = values.shape
    n, last_row, last_col = out.size, rows - 2.0, cols - 2.0
    _first_cells(row, col, 0.0, last_row, last_col, np.float64(cols), at[:n])
    _fetch_square(values.reshape(values.size), cols, at[:n], corners)
    for k in range(n):
        r, c = row[k], col[k]
        inside = (r >= 0.0) & (r <= last_row + 1.0) & (c >= 0.0) & (c <= last_col + 1.0)
        u, v = r - min(np.floor(r), last_row), c - min(np.floor(c), last_col)
        north, south = np.float64(corners[4 * k]), np.float64(corners[4 * k + 2])
        north += v * (corners[4 * k + 1] - north)
        south += v * (corners[4 * k + 3] - south)
        out[k] = north + u * (south - north) if inside else np.nan
    if _any_nan(out):
        for k in range(n):
            if np.isnan(out[k]):
                out[k] = bilinear_at(values, row[k], col[k])


@jit
def bilinear(values, row, col, out):
    """Bilinear values at scattered positions.

    Parameters
    ----------
    values : (rows, cols) float32, contiguous, both sizes >= 2, NaN where void
    row, col : (n,) float64 [cells]
    out : (n,) float64, written
    """
    at, corners = np.empty(BLOCK, np.uint64), np.empty(4 * BLOCK, np.float32)
    for begin in range(0, out.size, BLOCK):
        part = slice(begin, min(begin + BLOCK, out.size))
        bilinear_block(values, row[part], col[part], at, corners, out[part])


@jit
def _any_nan(values):
    """Whether a value is NaN, without leaving the loop early: it runs over vector registers."""
    count = 0
    for value in values:
        count += 1 if value != value else 0
    return count > 0


@jit(forceinline=True)
def _catmull_rom(t):
    """Weights of the cells i - 1 .. i + 2 at the fraction t (Keys, IEEE Trans. ASSP-29 (1981), eq. 4, a = -1/2)."""
    before = t * (-0.5 + t * (1.0 - 0.5 * t))
    here = 1.0 + t * t * (-2.5 + 1.5 * t)
    after = t * (0.5 + t * (2.0 - 1.5 * t))
    beyond = t * t * (-0.5 + 0.5 * t)
    return before, here, after, beyond


@jit
def _cubic_weights(t, i, size):
    """Weights of the cells i - 1 .. i + 2; a cell beyond the edge is the straight continuation of the two within."""
    before, here, after, beyond = _catmull_rom(t)
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
def _blend_rows(flat, cols, at, by_row, blend):
    """The four columns around each position, each blended from its four rows."""
    down = np.uint64(cols)
    for k in range(at.size):
        first = at[k]
        second, third, fourth = first + down, first + down + down, first + down + down + down
        a, b, c, d = by_row[0, k], by_row[1, k], by_row[2, k], by_row[3, k]
        for j in range(4):
            e = np.uint64(j)
            blend[4 * k + j] = a * flat[first + e] + b * flat[second + e] + (c * flat[third + e] + d * flat[fourth + e])


@jit
def bicubic(values, row, col, out):
    """Bicubic (Catmull-Rom) values at scattered positions; continuous slopes, exact on planes up to the edge.

    Parameters
    ----------
    values : (rows, cols) float32, contiguous, both sizes >= 2, NaN where void
    row, col : (n,) float64 [cells]
    out : (n,) float64, written
    """
    rows, cols = values.shape
    if rows < 4 or cols < 4:
        for k in range(out.size):
            out[k] = bicubic_at(values, row[k], col[k])
        return
    flat, last_row, last_col = values.reshape(values.size), rows - 3.0, cols - 3.0
    at, by_row, blend = np.empty(BLOCK, np.uint64), np.empty((4, BLOCK)), np.empty(4 * BLOCK)
    before = np.uint64(cols + 1)  # from the first cell around a position back to the first that has a weight
    for begin in range(0, out.size, BLOCK):
        part = slice(begin, min(begin + BLOCK, out.size))
        r, c, value = row[part], col[part], out[part]
        _first_cells(r, c, 1.0, last_row, last_col, np.float64(cols), at[: r.size])
        for k in range(r.size):
            at[k] -= before
            by_row[0, k], by_row[1, k], by_row[2, k], by_row[3, k] = _catmull_rom(r[k] - np.floor(r[k]))
        _blend_rows(flat, cols, at[: r.size], by_row, blend)
        for k in range(r.size):
            inside = (r[k] >= 1.0) & (r[k] < last_row + 1.0) & (c[k] >= 1.0) & (c[k] < last_col + 1.0)
            p, q, s, t = _catmull_rom(c[k] - np.floor(c[k]))
            total = p * blend[4 * k] + q * blend[4 * k + 1] + (s * blend[4 * k + 2] + t * blend[4 * k + 3])
            value[k] = total if inside else np.nan
        if _any_nan(value):
            for k in range(r.size):
                if np.isnan(value[k]):
                    value[k] = bicubic_at(values, r[k], c[k])

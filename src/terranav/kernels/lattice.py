"""Bilinear values of a map on a lattice of places in metres about an origin, one line of the lattice after another.

A line takes the shortest of three ways. Which one depends on the map:

- maps in longitude and latitude: the row is constant along a line and the column linear in metres east, so that the two
  rows of the map around the line are blended once and each place fetches two neighbours of the blend;
- where besides the step of the lattice is one column of the map, as on a grid in metres whose axes are north and east:
  neighbours on the line are neighbours on the map, with the same weights all along, and nothing is fetched singly;
- maps in a projection, turned and bent against north: each place fetches its four neighbours.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.sampling import bilinear_at

STRAY = 1e-10  # of a column, by which a place may miss the one that whole steps reach
LERP = {"contract"}  # a product and a sum in one operation; NaN passes through it like any other
ONE = np.uint64(1)  # an unsigned index needs no test for a negative one
OFF, UP, DOWN, ALONG, ACROSS = range(5)  # how a line is sampled


@jit
def _line(row6, col6, north):
    """Of row and column along the line at `north`: constant, slope and half the bend in metres east."""
    row = (row6[0] + north * (row6[1] + north * row6[3]), row6[2] + north * row6[4], row6[5])
    return row, (col6[0] + north * (col6[1] + north * col6[3]), col6[2] + north * col6[4], col6[5])


@jit
def _between(law, west, east):
    """First, last, least and greatest position of a line, or a bound of these: it bends from its chord by a quarter."""
    first, last = law[0] + west * (law[1] + west * law[2]), law[0] + east * (law[1] + east * law[2])
    bend = 0.25 * abs(law[2]) * (east - west) * (east - west)
    return first, last, min(first, last) - bend, max(first, last) + bend


@jit
def whole_steps(slope, east, size):
    """1 or -1 where slope * (east[j] - east[0]) goes by whole steps up or down over `size` places, else 0."""
    west = east[0]
    reach = slope * (east[-1] - west)
    step = 1 if reach > 0.0 else -1
    strays = 1 if size == 0 or abs(reach - step * (size - 1)) > STRAY else 0
    for j in range(0 if strays else size):
        strays += 1 if abs(slope * (east[j] - west) - step * j) > STRAY else 0
    return step if strays == 0 else 0


@jit
def _way(rows, cols, row, col, even, step, size):
    """How to sample a line, from the size of the map, `_between` of rows and columns, and `whole_steps`."""
    if not (row[2] >= 0.0 and row[3] < rows - 1.0 and col[2] >= 0.0 and col[3] < cols - 1.0):
        return OFF
    if not even:
        return ACROSS
    first = int(col[0]) - (size - 1 if step < 0 else 0)
    if step == 0 or first < 0 or first + size >= cols:
        return ALONG
    return UP if step > 0 else DOWN


@jit(fastmath=LERP)
def _up(values, row, first, size, out, at):
    """Line of a lattice whose places are neighbours on a row of the map, from the west; how many are NaN."""
    y, x, begin = np.uint64(int(row)), np.uint64(int(first)), np.uint64(at)
    u, v = row - np.floor(row), first - np.floor(first)
    a, b, c, d = (1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v
    below, missing = y + ONE, 0
    for j in range(size):
        k = x + np.uint64(j)
        value = a * values[y, k] + b * values[y, k + ONE] + c * values[below, k] + d * values[below, k + ONE]
        out[begin + np.uint64(j)] = value
        missing += 1 if value != value else 0
    return missing


@jit(fastmath=LERP)
def _down(values, row, first, size, out, at):
    """`_up` from the east: read upwards and written downwards, so that one value is turned round and not four."""
    y, x, end = np.uint64(int(row)), np.uint64(int(first) - size + 1), np.uint64(at + size - 1)
    u, v = row - np.floor(row), first - np.floor(first)
    a, b, c, d = (1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v
    below, missing = y + ONE, 0
    for j in range(size):
        k = x + np.uint64(j)
        value = a * values[y, k] + b * values[y, k + ONE] + c * values[below, k] + d * values[below, k + ONE]
        out[end - np.uint64(j)] = value
        missing += 1 if value != value else 0
    return missing


@jit(fastmath=LERP)
def _blended(values, row, first, last, blend):
    """The map on one row between two columns, last excluded, into the same columns of `blend`; how many are NaN."""
    y, u, missing = np.uint64(int(row)), row - np.floor(row), 0
    below = y + ONE
    for x in range(first, last):
        k = np.uint64(x)
        value = np.float64(values[y, k])
        value += u * (values[below, k] - value)
        blend[k] = value
        missing += 1 if value != value else 0
    return missing


@jit(fastmath=LERP)
def _along(blend, start, slope, east, out, at):
    """Line of a lattice on which only the column changes, and evenly, from the map blended on its row."""
    begin = np.uint64(at)
    for j in range(east.size):
        i = np.uint64(j)
        col = start + slope * east[i]
        whole = np.floor(col)
        k, v = np.uint64(np.int64(whole)), col - whole
        west = blend[k]
        out[begin + i] = west + v * (blend[k + ONE] - west)


@jit(fastmath=LERP)
def _places(row, col, cols, east, begin, count, blend, number, out, at):
    """Of places across the rows the cell before each in the flat map, and the fractions towards the next ones."""
    r0, r1, r2 = row
    c0, c1, c2 = col
    first, half, to = np.uint64(begin), np.uint64(blend.size // 2), np.uint64(at + begin)
    for j in range(count):
        i = np.uint64(j)
        e = east[first + i]
        r, c = r0 + e * (r1 + e * r2), c0 + e * (c1 + e * c2)
        y, x = np.floor(r), np.floor(c)
        blend[i], out[to + i], number[half + i] = r - y, c - x, np.uint64(np.int64(y * cols + x))


@jit(fastmath=LERP)
def _fetched(flat, cols, begin, count, blend, number, out, at):
    """Values at these places; how many are NaN."""
    half, to, down, missing = np.uint64(blend.size // 2), np.uint64(at + begin), np.uint64(cols), 0
    for j in range(count):
        i = np.uint64(j)
        k, v = number[half + i], out[to + i]
        low, low_east = np.float64(flat[k]), np.float64(flat[k + ONE])
        k += down
        high, high_east = np.float64(flat[k]), np.float64(flat[k + ONE])
        low += v * (low_east - low)
        high += v * (high_east - high)
        value = low + blend[i] * (high - low)
        out[to + i] = value
        missing += 1 if value != value else 0
    return missing


@jit
def _mended(values, row, col, east, out, at, all_of_it):
    """Sample anew, place by place with all cases told apart, what is NaN in a line."""
    r0, r1, r2 = row
    c0, c1, c2 = col
    for j in range(east.size):
        if all_of_it or np.isnan(out[at + j]):
            e = east[j]
            out[at + j] = bilinear_at(values, r0 + e * (r1 + e * r2), c0 + e * (c1 + e * c2))


@jit
def _across(values, row, col, east, blend, out, at):
    """Line of a lattice that is oblique to the rows of the map; how many are NaN."""
    missing, cols, part = 0, values.shape[1], blend.size // 2
    flat, number = values.reshape(values.size), blend.view(np.uint64)
    for begin in range(0, east.size, part):
        count = min(part, east.size - begin)
        _places(row, col, float(cols), east, begin, count, blend, number, out, at)
        missing += _fetched(flat, cols, begin, count, blend, number, out, at)
    return missing


@jit
def bilinear_row(values, row6, col6, north, east, blend, line):
    """Bilinear values at the places `north` and east[j] metres from the origin of a local frame.

    Where several lines are wanted, `bilinear_lattice` takes less time for each.

    Parameters
    ----------
    values, row6, col6, east : as in `bilinear_lattice`
    north : float [m]
    blend : (cols,) float64, room to work in
    line : (q,) float64, written
    """
    rows, cols = values.shape
    size, west, last = line.size, east[0], east[-1]
    row, col = _line(row6, col6, north)
    even = row[1] == 0.0 and row[2] == 0.0 and col[2] == 0.0
    step, ends = whole_steps(col[1], east, size if even else 0), _between(col, west, last)
    way, missing = _way(rows, cols, _between(row, west, last), ends, even, step, size), 0
    if way == UP:
        missing = _up(values, row[0], ends[0], size, line, 0)
    elif way == DOWN:
        missing = _down(values, row[0], ends[0], size, line, 0)
    elif way == ALONG:
        missing = _blended(values, row[0], int(ends[2]), min(int(ends[3]) + 2, cols), blend)
        _along(blend, col[0], col[1], east, line, 0)
    elif way == ACROSS:
        missing = _across(values, row, col, east, blend, line, 0)
    if way == OFF or missing > 0:
        _mended(values, row, col, east, line, 0, way == OFF)


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

    Returns
    -------
    int
        Places on lines that leave the map or meet a void; zero means that all values are known.
    """
    # The loop over `bilinear_row` written out: a function with branches counts references to its arrays when it is
    # entered and left, which takes as long as a quarter of a line.
    rows, cols = values.shape
    size, west, last, blend = east.size, east[0], east[-1], np.empty(values.shape[1])
    flat, number, target, part = values.reshape(values.size), blend.view(np.uint64), out.reshape(out.size), cols // 2
    same_columns = col6[1] == 0.0 and col6[3] == 0.0 and col6[4] == 0.0
    step, ends, doubtful = 0, (0.0, 0.0, 0.0, 0.0), 0
    for i in range(north.size):
        row, col = _line(row6, col6, north[i])
        at, even = i * size, row[1] == 0.0 and row[2] == 0.0 and col[2] == 0.0
        if i == 0 or not same_columns:
            step, ends = whole_steps(col[1], east, size if even else 0), _between(col, west, last)
        way, missing = _way(rows, cols, _between(row, west, last), ends, even, step, size), 0
        if way == UP:
            missing = _up(values, row[0], ends[0], size, target, at)
        elif way == DOWN:
            missing = _down(values, row[0], ends[0], size, target, at)
        elif way == ALONG:
            missing = _blended(values, row[0], int(ends[2]), min(int(ends[3]) + 2, cols), blend)
            _along(blend, col[0], col[1], east, target, at)
        elif way == ACROSS:
            for begin in range(0, size, part):
                count = min(part, size - begin)
                _places(row, col, float(cols), east, begin, count, blend, number, target, at)
                missing += _fetched(flat, cols, begin, count, blend, number, target, at)
        if way == OFF or missing > 0:
            _mended(values, row, col, east, target, at, way == OFF)
            doubtful += size
    return doubtful

"""The correlation surface of a profile: how badly each position error on a lattice fits the readings.

A few lines of the lattice at a time are worked on, so that all that is added up stays in the near caches. Where the
lattice goes by whole columns of a map without voids (`lattice.whole_steps`), nothing is sampled first: the misfit is
added up from the four neighbours of each place, whose weights are the same along a line.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.lattice import bilinear_lattice, whole_steps

LINES = 16  # worked on at a time
KEPT = 80_000  # differences of all points at most, kept for their mean: they stay in the second cache
FREE = {"contract"}  # a product and a sum in one operation; NaN passes through it like any other
ONE = np.uint64(1)  # an unsigned index needs no test for a negative one


@jit
def _common_step(values, frames, north, east):
    """The step of `whole_steps` that all points share, on lines within a part of the map without voids; else 0."""
    rows, cols = values.shape
    common, size = 0, east.size
    top, bottom, left, right = rows, 0, cols, 0
    for k in range(frames.shape[0]):
        row6, col6 = frames[k, 0], frames[k, 1]
        bent = abs(row6[2]) + abs(row6[4]) + abs(row6[5]) + abs(col6[1]) + abs(col6[3]) + abs(col6[4]) + abs(col6[5])
        step = whole_steps(col6[2], east, size if bent == 0.0 else 0)
        common = step if k == 0 or step == common else 0
        first = col6[0] + col6[2] * (east[0] if step > 0 else east[-1])
        least, most = np.inf, -np.inf
        for i in range(north.size):
            row = row6[0] + north[i] * (row6[1] + north[i] * row6[3])
            least, most = min(least, row), max(most, row)
        if not (least >= 0.0 and most < rows - 1.0 and first >= 0.0 and np.floor(first) + size < cols):
            common = 0
        if common == 0:
            return 0
        top, bottom = min(top, int(least)), max(bottom, int(most) + 2)
        left, right = min(left, int(first)), max(right, int(first) + size + 1)
    return common if _voids(values, top, bottom, left, right) == 0 else 0


@jit
def _voids(values, top, bottom, left, right):
    """How many values between these rows and columns are NaN."""
    count = 0
    for i in range(top, bottom):
        y = np.uint64(i)
        for j in range(left, right):
            value = values[y, np.uint64(j)]
            count += 1 if value != value else 0
    return count


@jit(fastmath=FREE)
def _add_in_step(values, row6, north, begin, end, first, size, value, w, absolute, total):
    """Add the weighted misfit of one point on some lines to the total; columns upwards from `first`."""
    x, v = np.uint64(int(first)), first - np.floor(first)
    scale = w if absolute else np.sqrt(w)
    target = scale * value
    for i in range(begin, end):
        row = row6[0] + north[i] * (row6[1] + north[i] * row6[3])
        y, u, at = np.uint64(int(row)), row - np.floor(row), np.uint64((i - begin) * size)
        a, b, c, d = (1.0 - u) * (1.0 - v) * scale, (1.0 - u) * v * scale, u * (1.0 - v) * scale, u * v * scale
        below = y + ONE
        for j in range(size):
            k = np.uint64(j)
            m = x + k
            misfit = (
                target - a * values[y, m] - b * values[y, m + ONE] - c * values[below, m] - d * values[below, m + ONE]
            )
            total[at + k] += abs(misfit) if absolute else misfit * misfit


@jit(fastmath=FREE)
def _differ_in_step(values, row6, north, begin, end, first, size, value, w, kept, own, centre):
    """Keep the differences of one point on some lines, and add up their weighted sum; columns upwards from `first`."""
    x, v = np.uint64(int(first)), first - np.floor(first)
    for i in range(begin, end):
        row = row6[0] + north[i] * (row6[1] + north[i] * row6[3])
        y, u, at = np.uint64(int(row)), row - np.floor(row), np.uint64((i - begin) * size)
        a, b, c, d = (1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v
        to = np.uint64(own) + at
        below = y + ONE
        for j in range(size):
            k = np.uint64(j)
            m = x + k
            misfit = (
                value - a * values[y, m] - b * values[y, m + ONE] - c * values[below, m] - d * values[below, m + ONE]
            )
            kept[to + k] = misfit
            centre[at + k] += w * misfit


@jit(fastmath=FREE)
def _add(field, count, value, w, absolute, total):
    """Add the weighted misfit of one point to the total."""
    for j in range(count):
        d = value - field[j]
        total[j] += w * (abs(d) if absolute else d * d)


@jit(fastmath=FREE)
def _add_known(field, count, value, w, absolute, total, weight, points):
    """`_add` where values may be NaN, and the weight and number of those that are not."""
    for j in range(count):
        d = value - field[j]
        total[j] += w * (abs(d) if absolute else d * d) if d == d else 0.0
        weight[j] += w if d == d else 0.0
        points[j] += 1.0 if d == d else 0.0


@jit(fastmath=FREE)
def _differ(field, count, value, w, kept, own, centre):
    """Keep the differences of one point, from kept[own] on, and add up their weighted sum."""
    for j in range(count):
        d = value - field[j]
        kept[np.uint64(own) + np.uint64(j)] = d
        centre[j] += w * d


@jit(fastmath=FREE)
def _differ_known(field, count, value, w, kept, own, centre, weight, points):
    """`_differ` where values may be NaN, and the weight and number of those that are not."""
    for j in range(count):
        d = value - field[j]
        kept[np.uint64(own) + np.uint64(j)] = d
        centre[j] += w * d if d == d else 0.0
        weight[j] += w if d == d else 0.0
        points[j] += 1.0 if d == d else 0.0


@jit(fastmath=FREE)
def _add_centred(kept, own, count, centre, w, absolute, total):
    """Add the weighted misfit of one point, less the mean of all, to the total."""
    for j in range(count):
        d = kept[np.uint64(own) + np.uint64(j)] - centre[j]
        total[j] += w * (abs(d) if absolute else d * d) if d == d else 0.0


@jit
def _zero(count, total, weight, points, centre):
    """Start anew."""
    for j in range(count):
        total[j], weight[j], points[j], centre[j] = 0.0, 0.0, 0.0, 0.0


@jit
def _mean(count, centre, weight, all_weight):
    """From sums to means."""
    for j in range(count):
        centre[j] /= weight[j] + all_weight


@jit
def _finish(total, weight, points, all_weight, all_points, n, start, stop, mirrored, score, valid):
    """Lines of the result from their sums; those with a map value everywhere have `all_weight` of their own."""
    size = score.shape[1]
    for i in range(start, stop):
        at = (i - start) * size
        for j in range(size):
            k = at + (size - 1 - j if mirrored else j)
            score[i, j] = total[k] / (weight[k] + all_weight)
            valid[i, j] = (points[k] + all_points) / n


@jit
def correlation_surface(values, frames, readings, lattice, absolute, remove_mean, score, valid):
    """Weighted mean squared or absolute difference between a profile and the map at every position error.

    With d[k] = reading[k] - map(place k of this error), over the points that have a map value:
    sum(w d^2) / sum(w), or sum(w |d|) / sum(w); d less its weighted mean when `remove_mean`.

    Parameters
    ----------
    values : (rows, cols) float32, NaN where void
    frames : (n, 2, 6) float64
        Per point of the profile the row and column coefficients of the LocalFrame at its indicated position.
    readings : (n, 2) float64
        Value [unit] and weight of each.
    lattice : (north (p,), east (q,)) float64 [m]
        Position errors; a point's true place lies at minus the error.
    absolute, remove_mean : bool
    score : (p, q) float64, written
        [unit^2], or [unit] when `absolute`; NaN where no point has a map value.
    valid : (p, q) float64, written
        Share of the points that have a map value.
    """
    north, east, n = -lattice[0], -lattice[1], readings.shape[0]
    step, size = _common_step(values, frames, north, east), east.size
    lines = max(min(LINES, KEPT // (n * size)), 1) if remove_mean else LINES
    most = lines * size
    field, kept = np.empty((lines, size)), np.empty(n * most if remove_mean else 1)
    line = field.reshape(most)
    total, weight, points, centre = np.empty(most), np.empty(most), np.empty(most), np.empty(most)
    edge = east[0] if step > 0 else east[-1]
    for start in range(0, north.size, lines):
        stop = min(start + lines, north.size)
        count, all_weight, all_points = (stop - start) * size, 0.0, 0.0
        _zero(count, total, weight, points, centre)
        for k in range(n):
            value, w, row6, col6 = readings[k, 0], readings[k, 1], frames[k, 0], frames[k, 1]
            own, doubtful, first = k * most, 0, col6[0] + col6[2] * edge
            if step == 0:
                doubtful = bilinear_lattice(values, row6, col6, north[start:stop], east, field[: stop - start])
                if remove_mean and doubtful:
                    _differ_known(line, count, value, w, kept, own, centre, weight, points)
                elif remove_mean:
                    _differ(line, count, value, w, kept, own, centre)
                elif doubtful:
                    _add_known(line, count, value, w, absolute, total, weight, points)
                else:
                    _add(line, count, value, w, absolute, total)
            elif remove_mean:
                _differ_in_step(values, row6, north, start, stop, first, size, value, w, kept, own, centre)
            else:
                _add_in_step(values, row6, north, start, stop, first, size, value, w, absolute, total)
            all_weight, all_points = all_weight + (0.0 if doubtful else w), all_points + (0.0 if doubtful else 1.0)
        if remove_mean:
            _mean(count, centre, weight, all_weight)
            for k in range(n):
                _add_centred(kept, k * most, count, centre, readings[k, 1], absolute, total)
        _finish(total, weight, points, all_weight, all_points, n, start, stop, step < 0, score, valid)


@jit(forceinline=True)
def _most_of(slope_n, slope_e, nn, ne, ee):
    """How far the best of a quadratic within a cell lies above its centre: at the vertex or at 8 points of the rim."""
    det = nn * ee - ne * ne
    peaked = (det > 0.0) & (nn < 0.0)
    safe = det if peaked else 1.0
    u, v = (ne * slope_e - ee * slope_n) / safe, (ne * slope_n - nn * slope_e) / safe
    inside = peaked & (abs(u) <= 0.5) & (abs(v) <= 0.5)
    best = 0.5 * (u * slope_n + v * slope_e) if inside else 0.0
    north, east = 0.5 * abs(slope_n) + 0.125 * nn, 0.5 * abs(slope_e) + 0.125 * ee
    best = north if north > best else best
    best = east if east > best else best
    # of two opposite corners the slopes favour one, and the twist lifts one pair and lowers the other
    even, odd = 0.5 * abs(slope_n + slope_e), 0.5 * abs(slope_n - slope_e)
    corner = 0.125 * (nn + ee)
    even, odd = even + corner + 0.25 * ne, odd + corner - 0.25 * ne
    best = even if even > best else best
    return odd if odd > best else best


@jit
def quadratics(field, slope, bend, rise):
    """The quadratic through 3 x 3 points around every point of a grid; all zero at the rim and beside NaN.

    Parameters
    ----------
    field : (p, q) float64
    slope : (2, p, q) float64, written
        North and east [1/cell].
    bend : (3, p, q) float64, written
        Second derivatives nn, ne, ee [1/cell^2].
    rise : (p, q) float64, written
        How far the best of the quadratic within half a cell lies above the point.
    """
    rows, cols = field.shape
    slope[:], bend[:], rise[:] = 0.0, 0.0, 0.0
    for i in range(1, rows - 1):
        y = np.uint64(i)
        south, north = y - ONE, y + ONE
        for j in range(1, cols - 1):
            x = np.uint64(j)
            west, east = x - ONE, x + ONE
            twice = 2.0 * field[y, x]
            n, e = 0.5 * (field[north, x] - field[south, x]), 0.5 * (field[y, east] - field[y, west])
            nn = field[north, x] - twice + field[south, x]
            ee = field[y, east] - twice + field[y, west]
            ne = 0.25 * (field[north, east] - field[north, west] - field[south, east] + field[south, west])
            total = n + e + nn + ne + ee
            known = total == total
            n, e = (n if known else 0.0), (e if known else 0.0)
            nn, ne, ee = (nn if known else 0.0), (ne if known else 0.0), (ee if known else 0.0)
            slope[0, y, x], slope[1, y, x] = n, e
            bend[0, y, x], bend[1, y, x], bend[2, y, x] = nn, ne, ee
            rise[y, x] = _most_of(n, e, nn, ne, ee)

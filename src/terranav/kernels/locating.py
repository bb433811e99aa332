"""Which blocks of placements of a profile on a map can be left out, proven by a lower bound of their misfit.

A placement puts the middle of a track at a (fractional) cell of the map, turned by a heading. Its misfit is

    min over offset o of  sum_k w_k (z_k - h_k - o)^2 + w_o o^2,    h_k the bilinear height under point k.

Over a block of placements h_k lies between the least and the greatest height of a window, so d_k = z_k - h_k lies in
[a_k, b_k], and no placement of the block has less misfit than

    min over o of  sum_k w_k dist(o, [a_k, b_k])^2 + w_o o^2,

which is convex in o: two tangents bound it from below. Any part of the points gives a lower bound as well.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.sampling import SLACK, bilinear_at

SUMS = {"contract", "reassoc"}  # in several lanes, the same ones each time; infinities are clipped before they count
STAGES = (8, 24, 72)  # points looked at before all are
ROUNDS = 40  # tangents tried before a block counts as not excluded


@jit(fastmath=SUMS)
def _misfit_of(low, high, weight, count, o):
    """Value of the bound's sum at an offset, and half its slope."""
    value, slope = 0.0, 0.0
    for k in range(count):
        under, over = low[k] - o, o - high[k]
        under = under if under > 0.0 else 0.0
        over = over if over > 0.0 else 0.0
        value += weight[k] * (under * under + over * over)
        slope += weight[k] * (over - under)
    return value, slope


@jit
def exceeds(low, high, weight, count, offset_weight, limit):
    """Whether min over o of sum_k weight_k dist(o, [low_k, high_k])^2 + offset_weight o^2 is proven above a limit.

    Parameters
    ----------
    low, high, weight : (>= count,) float64, low <= high, infinite where nothing is known
    count : int
    offset_weight, limit : float >= 0

    Returns
    -------
    bool
        False also where that could not be decided.
    """
    left, right = np.inf, -np.inf  # the minimum lies between the least upper and the greatest lower end
    for k in range(count):
        left, right = min(left, high[k]), max(right, low[k])
    if offset_weight > 0.0:
        left, right = min(left, 0.0), max(right, 0.0)
    if left >= right:
        return False
    low_value, low_slope, known_left, known_right = 0.0, 0.0, False, False
    high_value, high_slope = 0.0, 0.0
    o = 0.5 * (left + right)
    for _ in range(ROUNDS):
        value, slope = _misfit_of(low, high, weight, count, o)
        value, slope = value + offset_weight * o * o, 2.0 * (slope + offset_weight * o)
        if value <= limit:
            return False
        if slope >= 0.0:
            right, high_value, high_slope, known_right = o, value, slope, True
        else:
            left, low_value, low_slope, known_left = o, value, slope, True
        if slope == 0.0 or (known_right and not known_left and high_value + high_slope * (left - right) > limit):
            return True
        if known_left and not known_right and low_value + low_slope * (right - left) > limit:
            return True
        if known_left and known_right:
            step = (low_value - high_value + high_slope * (right - left)) / (high_slope - low_slope)
            if low_value + low_slope * step > limit:
                return True
            o = left + step
        else:
            o = 0.5 * (left + right)
        if not left < o < right:
            return False
    return False


@jit
def _start(first, last, width, stride):
    """First window that holds a cell, and the one that holds the last cell too (the same, if it does already)."""
    one = first // stride
    if one * stride + width > last:
        return one, one
    return one, (last - width + stride) // stride


@jit
def excluded(tables, spans, node, ends, data, limit, low, high):
    """Whether no placement of a block can have a misfit within a limit; also how many points that took.

    Parameters
    ----------
    tables : (lows, highs, somes) of this level, (p, q) float32, float32 and uint8
        Least and greatest heights of the windows at every stride, infinite where one holds a void; and whether it
        holds anything else.
    spans : (width, stride, block) of this level [cells]
    node : (row, column) of the block's first cell
    ends : four (k,) of whole numbers
        First row, last row less the block, first column, last column less the block, relative to the block's first
        cell, of what lies under each point.
    data : (heights (k,), weights (k,), offset weight, rows, cols, void_cost)
    low, high : (k,) float64
        Room to work in.
    """
    lows, highs, somes = tables
    width, stride, block = spans
    heights, weight, offset_weight, rows, cols, void_cost = data
    total = heights.size
    done, left = 0, limit  # of the limit, once what lies on voids for certain has its cost
    for stage in range(len(STAGES) + 1):
        upto = min(STAGES[stage], total) if stage < len(STAGES) else total
        for k in range(done, upto):
            top, bottom = max(node[0] + ends[0][k], 0), min(node[0] + block + ends[1][k], rows - 1)
            west, east = max(node[1] + ends[2][k], 0), min(node[1] + block + ends[3][k], cols - 1)
            if top > bottom or west > east:
                return True, k + 1  # off the map wherever in the block
            if max(bottom - top, east - west) >= 2 * (width - stride):
                low[k], high[k] = -np.inf, np.inf  # wider than two windows: nothing is said of it
                continue
            r, r2 = _start(top, bottom, width, stride)
            c, c2 = _start(west, east, width, stride)
            least, most = lows[r, c], highs[r, c]
            if r2 != r:
                least, most = min(least, lows[r2, c]), max(most, highs[r2, c])
            if c2 != c:
                least, most = min(least, lows[r, c2]), max(most, highs[r, c2])
                if r2 != r:
                    least, most = min(least, lows[r2, c2]), max(most, highs[r2, c2])
            low[k], high[k] = heights[k] - most, heights[k] - least
            if least == -np.inf and not (somes[r, c] or somes[r2, c] or somes[r, c2] or somes[r2, c2]):
                left -= void_cost
        if left < 0.0 or exceeds(low, high, weight, upto, offset_weight, left):
            return True, upto
        done = upto
        if upto == total:
            break
    return False, total


@jit
def misfit_at(values, row, col, down, right, heights, weight, offset_weight, void_cost):
    """Misfit of one placement, the offset eliminated, and that offset; infinite where a point is off the map.

    Parameters
    ----------
    values : (rows, cols) float32, NaN where void
    row, col : float, the middle of the track
    down, right : (k,) float64, the points relative to it [cells]
    void_cost : float
        What a point over a void costs.
    """
    rows, cols = values.shape
    total, first, second, voids = offset_weight, 0.0, 0.0, 0
    for k in range(heights.size):
        i, j = row + down[k], col + right[k]
        if i < -SLACK or j < -SLACK or i > rows - 1.0 + SLACK or j > cols - 1.0 + SLACK:
            return np.inf, 0.0
        d = heights[k] - bilinear_at(values, i, j)
        if d == d:
            total, first, second = total + weight[k], first + weight[k] * d, second + weight[k] * d * d
        else:
            voids += 1
    offset = first / total if total > 0.0 else 0.0
    return max(second - first * offset, 0.0) + voids * void_cost, offset


@jit
def lie(points, mids, halves, frame, corners, ends, places):
    """The cells that may lie under each point of a track, for intervals of its heading and scale.

    A point p becomes (1 + ds) R(d) p0, p0 = f R(psi) p, with |d| <= a, |ds| <= b about the shape (psi, f). In a frame
    L p + q(p), with J a quarter turn,

        |L ((1 + ds) R(d) - 1) p0 - d L J p0 - ds L p0| <= (a^2 / 2 + a b) |L| |p0|,
        |q((1 + ds) R(d) p0) - q(p0)| <= |q| (a + b + a b) (2 + b) |p0|^2,

    and what the frames in the corners of a region differ from its middle's is added.

    Parameters
    ----------
    points : (2, k) float64, north and east of the middle [m]
    mids : (n, 2) float64, heading [rad] and factor of each shape
    halves : (n, 2) float64, a and b
    frame, corners : (2, 6) and (m, 2, 6) float64: coefficients as in `LocalFrame`, rows and columns
    ends : (4, n, k) int32, written
        First row, last row less the block, first column, last column less the block, from the block's first cell.
    places : (2, <= n, k) float64, written
        The points in rows and columns at the middle of the first shapes.
    """
    for axis in range(2):
        own = frame[axis]
        norm, bend = np.hypot(own[1], own[2]), abs(own[3]) + abs(own[4]) + abs(own[5])
        tilt = 0.0
        for corner in corners:
            tilt = max(tilt, np.hypot(corner[axis, 1] - own[1], corner[axis, 2] - own[2]))
        for h in range(mids.shape[0]):
            cos, sin = mids[h, 1] * np.cos(mids[h, 0]), mids[h, 1] * np.sin(mids[h, 0])
            a, b = halves[h, 0], halves[h, 1]
            for k in range(points.shape[1]):
                n, e = points[0, k] * cos - points[1, k] * sin, points[0, k] * sin + points[1, k] * cos
                rho = np.hypot(n, e)
                at = n * (own[1] + own[3] * n + own[4] * e) + e * (own[2] + own[5] * e)
                bent = 0.0
                for corner in corners:
                    c = corner[axis]
                    bent = max(bent, abs(n * (c[1] + c[3] * n + c[4] * e) + e * (c[2] + c[5] * e) - at))
                slack = a * abs(own[2] * n - own[1] * e) + b * abs(own[1] * n + own[2] * e)
                slack += (0.5 * a * a + a * b) * norm * rho + bend * (a + b + a * b) * (2.0 + b) * rho * rho
                slack += 1.1 * (bent + (a + b + a * b) * tilt * rho) + 1e-4
                ends[2 * axis, h, k] = np.int32(np.floor(at - 0.5 - slack))
                ends[2 * axis + 1, h, k] = np.int32(np.ceil(at - 0.5 + slack))
                if h < places.shape[1]:
                    places[axis, h, k] = at


@jit
def search(values, tables, spans, shapes, ends, places, data, region, limits, found, counts):
    """Depth first over the blocks of one region of the map; what is not excluded is kept with its middle's misfit.

    Parameters
    ----------
    values : (rows, cols) float32
    tables : three tuples of (p, q) arrays, a level each, the finest first, as in `excluded`
    spans : (levels, 3) int64: width and stride of the windows, and the block, of each level [cells]
    shapes : (levels, 2) int64
        At which row of `ends` each level's headings and scales begin, and how many there are; those of a level divide
        the ones of the next coarser level, in their order.
    ends : (4, all shapes, k) int32, as in `excluded`
    places : (2, finest shapes, k) float64: the points relative to the middle of the track [cells]
    data : as in `excluded`
    region : first row, past row, first column, past column of the middle of the track
    limits : (3,) float64: limit, margin above the best, and the best misfit of a middle: read and written
    found : (most, 4) float64: row, column, number of the shape, misfit of its middle
    counts : (3,) int64: kept, blocks and points looked at: read and written

    Returns
    -------
    bool
        False if there was no room for all that was to be kept.
    """
    heights, weight, offset_weight, _, _, void_cost = data
    lows, highs, somes = tables
    low, high = np.empty(heights.size), np.empty(heights.size)
    top = len(lows) - 1
    room = shapes[top, 1] + 4
    for level in range(top):
        room += 4 * (shapes[level, 1] // shapes[level + 1, 1])
    stack = np.empty((room, 4), np.int64)
    block = spans[top, 2]
    for i0 in range(region[0], region[1], block):
        for j0 in range(region[2], region[3], block):
            size = shapes[top, 1]
            for h in range(size):
                stack[h, 0], stack[h, 1], stack[h, 2], stack[h, 3] = top, h, i0, j0
            while size > 0:
                size -= 1
                level, h, i, j = stack[size]
                at = shapes[level, 0] + h
                gone, looked = excluded(
                    (lows[level], highs[level], somes[level]),
                    (spans[level, 0], spans[level, 1], spans[level, 2]),
                    (i, j),
                    (ends[0, at], ends[1, at], ends[2, at], ends[3, at]),
                    data,
                    limits[0],
                    low,
                    high,
                )
                counts[1] += 1
                counts[2] += looked
                if gone:
                    continue
                if level == 0:
                    if counts[0] == found.shape[0]:
                        return False
                    fit, _ = misfit_at(
                        values, i, j, places[0, h], places[1, h], heights, weight, offset_weight, void_cost
                    )
                    counts[2] += heights.size
                    row = found[counts[0]]
                    row[0], row[1], row[2], row[3] = i, j, h, fit
                    counts[0] += 1
                    if fit < limits[2]:
                        limits[2] = fit
                        limits[0] = min(limits[0], fit + limits[1])
                    continue
                half = spans[level - 1, 2]
                ratio = shapes[level - 1, 1] // shapes[level, 1]
                for a in range(2):
                    for b in range(2):
                        if i + a * half < region[1] and j + b * half < region[3]:
                            for c in range(ratio):
                                stack[size, 0], stack[size, 1] = level - 1, h * ratio + c
                                stack[size, 2], stack[size, 3] = i + a * half, j + b * half
                                size += 1
    return True

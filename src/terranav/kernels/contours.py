"""Nearest points on contours, and the downhill simplex that lays a trace over them (papers/003, sections 2 and 4).

A contour is that of marching squares: within each square of four cell centres straight lines between the points where
the level crosses the square's sides, linearly interpolated; in a saddle the mean of the four corners decides which
corners belong together. A reading's level c has the contour {map = c}; squares with a void have none.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit

TOLERANCE_M = 1e-4  # costs this near to one another are one: the simplex has collapsed


@jit
def _to_segment(ar, ac, br, bc, metric):
    """Squared distance [m^2] from the origin to a segment given in cells, and the nearest point in cells."""
    an, ae = metric[0, 0] * ar + metric[0, 1] * ac, metric[1, 0] * ar + metric[1, 1] * ac
    bn, be = metric[0, 0] * br + metric[0, 1] * bc, metric[1, 0] * br + metric[1, 1] * bc
    dn, de = bn - an, be - ae
    length2 = dn * dn + de * de
    t = 0.0 if length2 == 0.0 else min(max(-(an * dn + ae * de) / length2, 0.0), 1.0)
    n, e = an + t * dn, ae + t * de
    return n * n + e * e, ar + t * (br - ar), ac + t * (bc - ac)


@jit
def _on_side(side, z0, z1, z2, z3, level):
    """Where the level crosses a side of a square: 0 first row, 1 last column, 2 last row, 3 first column."""
    if side == 0:
        return 0.0, (level - z0) / (z1 - z0)
    if side == 1:
        return (level - z1) / (z3 - z1), 1.0
    if side == 2:
        return 1.0, (level - z2) / (z3 - z2)
    return (level - z0) / (z2 - z0), 0.0


@jit
def _lines(above0, above1, above2, above3, middle):
    """How many lines a square has, and the two sides that each joins; corners 0 1 over 2 3."""
    cut0, cut1, cut2 = above0 != above1, above1 != above3, above2 != above3
    if cut0 and cut1 and cut2:  # a saddle: the lines cut off the corners 1 and 2, or else 0 and 3
        return (2, ((0, 1), (2, 3))) if middle == above0 else (2, ((0, 3), (2, 1)))
    one = 0 if cut0 else (1 if cut1 else 2)
    other = 3
    if cut2 and one != 2:
        other = 2
    if cut1 and one == 0:
        other = 1
    return 1, ((one, other), (one, other))


@jit
def nearest_on_contour(values, row, col, level, metric, reach_m):
    """Distance [m] to the nearest point of the contour {map = level}, and that point.

    Squares are visited ring by ring around the position until no farther ring can hold a nearer point.

    Parameters
    ----------
    values : (rows, cols) float32, NaN where void
    row, col : float [cells]
        A position, on the map or beside it.
    level : float [unit]
    metric : (2, 2) float64 [m/cell]
        Metres north and east of a step of one row (first column) and one column (second).
    reach_m : float [m]
        Contours farther away are not seen.

    Returns
    -------
    distance_m, row, col : float
        (NaN, NaN, NaN) where there is no contour within reach.
    """
    rows, cols = values.shape
    # the smaller singular value of the metric: no cell is narrower
    a, b = metric[0, 0] ** 2 + metric[1, 0] ** 2, metric[0, 1] ** 2 + metric[1, 1] ** 2
    c = metric[0, 0] * metric[0, 1] + metric[1, 0] * metric[1, 1]
    narrow = math.sqrt(max(0.5 * (a + b) - math.sqrt(0.25 * (a - b) ** 2 + c * c), 1e-300))
    best, best_row, best_col = reach_m * reach_m, np.nan, np.nan
    if not (row > -rows and row < 2.0 * rows and col > -cols and col < 2.0 * cols):
        return np.nan, np.nan, np.nan
    i0, j0 = math.floor(row), math.floor(col)
    u, v = row - i0, col - j0
    margin = min(u, 1.0 - u, v, 1.0 - v)
    wide2 = narrow * narrow
    for ring in range(int(reach_m / narrow) + 2):
        away = ring - 1 + margin
        if ring > 0 and wide2 * away * away >= best:
            break
        for i in range(max(i0 - ring, 0), min(i0 + ring, rows - 2) + 1):
            across = max(i - row, row - i - 1.0, 0.0)  # rows to the nearest side of these squares
            if wide2 * across * across >= best:
                continue
            whole = i == i0 - ring or i == i0 + ring
            stride = 1 if whole or ring == 0 else 2 * ring
            for j in range(j0 - ring, j0 + ring + 1, stride):
                if j < 0 or j > cols - 2:
                    continue
                z0, z1 = np.float64(values[i, j]), np.float64(values[i, j + 1])
                z2, z3 = np.float64(values[i + 1, j]), np.float64(values[i + 1, j + 1])
                up0, up1, up2, up3 = z0 > level, z1 > level, z2 > level, z3 > level
                if (up0 == up1 and up1 == up2 and up2 == up3) or np.isnan(z0 + z1 + z2 + z3):
                    continue
                p, q = i - row, j - col
                count, ends = _lines(up0, up1, up2, up3, z0 + z1 + z2 + z3 > 4.0 * level)
                for k in range(count):
                    s, t = ends[k]
                    sr, sc = _on_side(s, z0, z1, z2, z3, level)
                    tr, tc = _on_side(t, z0, z1, z2, z3, level)
                    d, r, w = _to_segment(p + sr, q + sc, p + tr, q + tc, metric)
                    if d < best:
                        best, best_row, best_col = d, row + r, col + w
    if np.isnan(best_row):
        return np.nan, np.nan, np.nan
    return math.sqrt(best), best_row, best_col


@jit
def nearest_points(values, row, col, level, metric, reach_m, out):
    """Distance [m], row and column of the nearest contour point of each of n positions with a level of its own.

    `row`, `col`, `level` are (n,), `out` (n, 3) is written; the rest as for `nearest_on_contour`.
    """
    for k in range(row.size):
        out[k, 0], out[k, 1], out[k, 2] = nearest_on_contour(values, row[k], col[k], level[k], metric, reach_m)


@jit
def trace(p, first, steps, out):
    """Points x of the estimated trace (papers/003, section 2).

    Parameters
    ----------
    p : (2 + 2 m,) float64
        The shift of the first point, north and east [m], then pairs (velocity error [1], course error [rad]): one for
        all steps (m = 1), or one for each (m = W - 1).
    first : (2,), steps : (W - 1, 2) float64 [m]
        First point of the INS trace and the steps between its points.
    out : (W, 2) float64, written [m]
    """
    n, e = first[0] + p[0], first[1] + p[1]
    out[0, 0], out[0, 1] = n, e
    common = p.size == 4
    c, s = 1.0, 0.0
    for i in range(steps.shape[0]):
        if i == 0 or not common:
            scale, turn = 1.0 + p[2 + 2 * i], p[3 + 2 * i]
            c, s = scale * math.cos(turn), scale * math.sin(turn)
        n += c * steps[i, 0] - s * steps[i, 1]
        e += s * steps[i, 0] + c * steps[i, 1]
        out[i + 1, 0], out[i + 1, 1] = n, e


@jit
def trace_cost(values, frame, level, first, steps, p, weight, reach_m, points):
    """Target value E of papers/003 eqs. 1-4 [m]: E = E_INS + E_H.

    E_INS = K sum_i |a_i - a_(i-1)| sqrt(velocity error_i^2 + course error_i^2), E_H = sum_i |x_i - y_i|; a point
    without a contour within reach counts as one at that distance.

    Parameters
    ----------
    values : (rows, cols) float32
    frame : (row6, col6, metric)
        Row and column coefficients of a LocalFrame, and its metres per cell.
    level : (W,) float64
    first, steps, p
        As for `trace`.
    weight : float
        K.
    reach_m : float
    points : (W, 2) float64, written: the trace

    Returns
    -------
    total, of_contours : float [m]
        E and E_H.
    """
    row6, col6, metric = frame
    trace(p, first, steps, points)
    of_contours = 0.0
    for i in range(level.size):
        n, e = points[i, 0], points[i, 1]
        row = row6[0] + n * (row6[1] + n * row6[3] + e * row6[4]) + e * (row6[2] + e * row6[5])
        col = col6[0] + n * (col6[1] + n * col6[3] + e * col6[4]) + e * (col6[2] + e * col6[5])
        distance, _, _ = nearest_on_contour(values, row, col, level[i], metric, reach_m)
        of_contours += reach_m if np.isnan(distance) else distance
    of_ins, wrong = 0.0, 0.0
    for i in range(steps.shape[0]):
        if i == 0 or p.size > 4:
            wrong = math.sqrt(p[2 + 2 * i] ** 2 + p[3 + 2 * i] ** 2)
        of_ins += math.sqrt(steps[i, 0] ** 2 + steps[i, 1] ** 2) * wrong
    return of_contours + weight * of_ins, of_contours


@jit
def optimise(values, frame, level, first, steps, starts, size, limits, out, score):
    """Downhill simplex (Nelder and Mead, Computer Journal 7, 1965) from each of several starts.

    The cost has creases, in which a simplex may collapse beside the minimum: a collapsed one starts anew around its
    best point, until that gains nothing.

    Parameters
    ----------
    values, frame, level, first, steps
        As for `trace_cost`.
    starts : (Q, d) float64
        Vectors p.
    size : (d,) float64
        Edges of the first simplex.
    limits : (K, reach_m, E_min, T_max)
        A start ends when its E is below E_min [m] or after T_max iterations.
    out : (Q, d) float64, written: the best p of each
    score : (Q, 3) float64, written: E, E_H [m] and the iterations of each
    """
    weight, reach_m, lowest, most = limits
    d = starts.shape[1]
    simplex, cost = np.empty((d + 1, d)), np.empty(d + 1)
    centre, one, two = np.empty(d), np.empty(d), np.empty(d)
    points = np.empty((level.size, 2))
    for q in range(starts.shape[0]):
        one[:] = starts[q]
        turns, fresh, before = 0, True, np.inf
        while True:
            if fresh:
                for k in range(d + 1):
                    simplex[k] = one
                    if k > 0:
                        simplex[k, k - 1] += size[k - 1]
                    cost[k] = trace_cost(values, frame, level, first, steps, simplex[k], weight, reach_m, points)[0]
                fresh = False
            low, high = np.argmin(cost), np.argmax(cost)
            if turns >= most or cost[low] < lowest:
                break
            turns += 1
            if cost[high] - cost[low] < TOLERANCE_M:
                if before - cost[low] < TOLERANCE_M:
                    break
                before, fresh = cost[low], True
                one[:] = simplex[low]
                continue
            next_high = -np.inf
            centre[:] = 0.0
            for k in range(d + 1):
                if k != high:
                    centre += simplex[k] / d
                    next_high = max(next_high, cost[k])
            one[:] = 2.0 * centre - simplex[high]
            c_one = trace_cost(values, frame, level, first, steps, one, weight, reach_m, points)[0]
            if c_one < cost[low]:  # expand
                two[:] = 3.0 * centre - 2.0 * simplex[high]
                c_two = trace_cost(values, frame, level, first, steps, two, weight, reach_m, points)[0]
                if c_two < c_one:
                    simplex[high], cost[high] = two, c_two
                else:
                    simplex[high], cost[high] = one, c_one
                continue
            if c_one < next_high:
                simplex[high], cost[high] = one, c_one
                continue
            if c_one < cost[high]:  # contract, outside or inside
                two[:] = 0.5 * (centre + one)
            else:
                two[:] = 0.5 * (centre + simplex[high])
            c_two = trace_cost(values, frame, level, first, steps, two, weight, reach_m, points)[0]
            if c_two < min(c_one, cost[high]):
                simplex[high], cost[high] = two, c_two
                continue
            for k in range(d + 1):  # shrink
                if k != low:
                    simplex[k] = 0.5 * (simplex[k] + simplex[low])
                    cost[k] = trace_cost(values, frame, level, first, steps, simplex[k], weight, reach_m, points)[0]
        out[q] = simplex[low]
        score[q, 0], score[q, 1] = trace_cost(values, frame, level, first, steps, out[q], weight, reach_m, points)
        score[q, 2] = turns

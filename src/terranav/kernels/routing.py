"""The search for a route: what the readings of an edge say, labels over a lattice, and a route's covariance.

A label is a place on the lattice, the heading it was reached on, the covariance P of the states there, the length flown
and the largest 1-sigma met so far (`top`). Labels are taken from a heap by (bin of top, length + straight line to the
goal); the bin is 0 up to the limit and grows by BIN of itself beyond, so the first label taken at the goal has a top
that no other can undercut by more than a bin, and among these, and below the limit, the least length. Labels and their
dominance are those of Martins, On a multicriteria shortest path problem, European Journal of Operational Research 16
(1984); the covariance after a leg is monotone in the one before it, so a label that is shorter, with a smaller top and
a smaller P, can never end worse. What is compared of P stands in `_within`.
"""

from __future__ import annotations

import math
from heapq import heappop, heappush

import numpy as np

from terranav.kernels.jit import jit

BIN = 0.01  # of the largest 1-sigma beyond the limit
FOUND, NONE, FULL = 0, 1, 2  # how a search ended


@jit
def edge_information(readings, patch_sigma, keep, out):
    """Information of the readings of each edge about (position north, east, bias), the patch taken out.

    The patch is a Markov process along the edge, stationary at its start; a Kalman filter of it whitens the readings:
    with regressors h = (-slope north, -slope east, 1) and innovations e of variance s, the information is sum e e' / s.

    Parameters
    ----------
    readings : (edges, n, 3)
        Slope north, east [unit/m] and information of the white part [1/unit^2], 0 for no reading.
    patch_sigma : float [unit]
    keep : float
        Correlation of the patch from one reading to the next.
    out : (edges, 6)
        The upper triangle by rows: nn, ne, nb, ee, eb, bb.
    """
    carried, h = np.empty(3), np.empty(3)
    for edge in range(len(readings)):
        variance = patch_sigma * patch_sigma
        carried[:] = 0.0
        out[edge] = 0.0
        for i in range(readings.shape[1]):
            if i:
                variance = keep * keep * variance + (1.0 - keep * keep) * patch_sigma * patch_sigma
                for a in range(3):
                    carried[a] *= keep
            information = readings[edge, i, 2]
            if not information > 0.0:
                continue
            total = variance + 1.0 / information
            gain = variance / total
            h[0], h[1], h[2] = -readings[edge, i, 0], -readings[edge, i, 1], 1.0
            for a in range(3):
                h[a] -= carried[a]
                carried[a] += gain * h[a]
            variance *= 1.0 - gain
            out[edge, 0] += h[0] * h[0] / total
            out[edge, 1] += h[0] * h[1] / total
            out[edge, 2] += h[0] * h[2] / total
            out[edge, 3] += h[1] * h[1] / total
            out[edge, 4] += h[1] * h[2] / total
            out[edge, 5] += h[2] * h[2] / total


@jit
def _propagate(cov, phi, q, half, out):
    """out = phi cov phi' + q; zeros of phi, of which there are many, cost nothing."""
    d = len(cov)
    for i in range(d):
        for k in range(d):
            half[i, k] = 0.0
        for m in range(d):
            factor = phi[i, m]
            if factor != 0.0:
                for k in range(d):
                    half[i, k] += factor * cov[m, k]
    for i in range(d):
        for k in range(i + 1):
            total = q[i, k]
            for m in range(d):
                if phi[k, m] != 0.0:
                    total += half[i, m] * phi[k, m]
            out[i, k] = out[k, i] = total


@jit
def _advance(cov, phi, q, info, half, work, out):
    """out = the covariance after an edge: moved by (phi, q), then told `info` of the first two states and the last."""
    d = len(cov)
    _propagate(cov, phi, q, half, out)
    s00, s01, s02 = out[0, 0], out[0, 1], out[0, d - 1]
    s11, s12, s22 = out[1, 1], out[1, d - 1], out[d - 1, d - 1]
    nn, ne, nb, ee, eb, bb = info[0], info[1], info[2], info[3], info[4], info[5]
    m00, m01, m02 = 1.0 + nn * s00 + ne * s01 + nb * s02, nn * s01 + ne * s11 + nb * s12, nn * s02 + ne * s12 + nb * s22
    m10, m11, m12 = ne * s00 + ee * s01 + eb * s02, 1.0 + ne * s01 + ee * s11 + eb * s12, ne * s02 + ee * s12 + eb * s22
    m20, m21, m22 = nb * s00 + eb * s01 + bb * s02, nb * s01 + eb * s11 + bb * s12, 1.0 + nb * s02 + eb * s12 + bb * s22
    c00, c10, c20 = m11 * m22 - m12 * m21, m12 * m20 - m10 * m22, m10 * m21 - m11 * m20  # of I + J S, S the three's
    c01, c11, c21 = m02 * m21 - m01 * m22, m00 * m22 - m02 * m20, m01 * m20 - m00 * m21
    c02, c12, c22 = m01 * m12 - m02 * m11, m02 * m10 - m00 * m12, m00 * m11 - m01 * m10
    det = m00 * c00 + m01 * c10 + m02 * c20
    w00 = (c00 * nn + c01 * ne + c02 * nb) / det  # w = (I + J S)^-1 J, symmetric
    w01 = (c00 * ne + c01 * ee + c02 * eb) / det
    w02 = (c00 * nb + c01 * eb + c02 * bb) / det
    w11 = (c10 * ne + c11 * ee + c12 * eb) / det
    w12 = (c10 * nb + c11 * eb + c12 * bb) / det
    w22 = (c20 * nb + c21 * eb + c22 * bb) / det
    for i in range(d):
        a, b, c = out[i, 0], out[i, 1], out[i, d - 1]
        half[0, i], half[1, i], half[2, i] = a, b, c
        work[i, 0], work[i, 1], work[i, 2] = (
            a * w00 + b * w01 + c * w02, a * w01 + b * w11 + c * w12, a * w02 + b * w12 + c * w22
        )  # fmt: skip
    for i in range(d):
        for k in range(i + 1):
            out[i, k] -= work[i, 0] * half[0, k] + work[i, 1] * half[1, k] + work[i, 2] * half[2, k]
            out[k, i] = out[i, k]


@jit
def longest(cov):
    """1-sigma along the longest axis of the position error."""
    half, middle = 0.5 * (cov[0, 0] - cov[1, 1]), 0.5 * (cov[0, 0] + cov[1, 1])
    return math.sqrt(max(middle + math.hypot(half, cov[0, 1]), 0.0))


@jit
def _flown(cov, phi, q, info, back, numbers, work, out):
    """out = the covariance after an edge of several pieces, `back` from its last to its first; its largest 1-sigma.

    `numbers`: how many pieces there are, length at the edge's start, length of a piece, length from which sigma counts.
    """
    pieces, length, piece, settle = numbers
    here, top = cov, 0.0
    for i in range(pieces):
        _advance(here, phi, q, info[pieces - 1 - i] if back else info[i], work[3], work[2], work[i % 2])
        here = work[i % 2]
        if length + (i + 1) * piece >= settle:
            top = max(top, longest(here))
    out[:, :] = here
    return top


@jit
def _within(a, b, slack):
    """Whether covariance a is at most (1 + slack) b, judged by each axis pair of two states alike, and the bias."""
    d = len(a)
    for i in range(0, d - 1, 2):
        x = (1.0 + slack) * b[i, i] - a[i, i]
        z = (1.0 + slack) * b[i + 1, i + 1] - a[i + 1, i + 1]
        y = (1.0 + slack) * b[i, i + 1] - a[i, i + 1]
        if x < 0.0 or z < 0.0 or x * z < y * y:
            return False
    return a[d - 1, d - 1] <= (1.0 + slack) * b[d - 1, d - 1]


@jit
def _bin(top, limit):
    return 0 if top <= limit else 1 + math.floor(math.log(top / max(limit, 1e-3)) / math.log1p(BIN))


@jit
def search(moves, lengths, pieces, turns, info, phis, qs, start, goal, cov0, numbers, slack, most, deep):
    """The best label at the goal.

    Parameters
    ----------
    moves : (headings, 2) int
        Rows and columns of the lattice that an edge of each heading goes; the second half are the first reversed.
    lengths : (headings,) [m]
    pieces : (headings,) int
        In how many equal pieces an edge is flown.
    turns : (headings, headings) bool
        Whether an edge of the second heading can follow one of the first.
    info : (headings / 2, rows, cols, most pieces, 6)
        As from `edge_information`, of the edge that begins there; a first value that is NaN bars it.
    phis, qs : (headings, d, d)
        Transition of the states along a piece: position north, east, others in pairs, the bias last.
    start, goal : (2,) int
        Rows and columns.
    cov0 : (d, d)
    numbers : (limit [m], most length [m], length from which sigma counts [m], side of the lattice [m])
    slack : float
        Of dominance: a label is dropped unless it is better by more than this share of variance.
    most, deep : int
        Labels in all, and at one place and heading.

    Returns
    -------
    ended : FOUND, NONE or FULL
    path : (n, 2) int, rows and columns; empty unless FOUND
    length, top : float [m]
    taken : int
        Labels that were followed.
    """
    limit, budget, settle, side = numbers
    headings, rows, cols = len(moves), info.shape[1], info.shape[2]
    d, half = len(cov0), headings // 2
    head = -np.ones((rows, cols, headings + 1), dtype=np.int32)
    count = np.zeros((rows, cols, headings + 1), dtype=np.int16)
    size = 4096
    place, parent, follow = np.empty((size, 3), np.int32), np.empty(size, np.int32), np.empty(size, np.int32)
    flown, tops, covs = np.empty(size), np.empty(size), np.empty((size, d, d))
    cov, trial = np.empty((d, d)), np.empty((d, d))
    work = (np.empty((d, d)), np.empty((d, d)), np.empty((d, 3)), np.empty((d, d)))
    first = longest(cov0) if settle <= 0.0 else 0.0
    ahead = side * math.hypot(goal[0] - start[0], goal[1] - start[1])
    heap = [(_bin(first, limit), ahead, np.int64(-1), np.int64(headings))]
    taken = 0
    while heap:
        _, _, before, k = heappop(heap)
        if before < 0:
            r, c, length, top = start[0], start[1], 0.0, first
            cov[:, :] = cov0
        else:
            r0, c0 = place[before, 0], place[before, 1]
            r, c, length = r0 + moves[k, 0], c0 + moves[k, 1], flown[before] + lengths[k]
            told = info[k, r0, c0] if k < half else info[k - half, r, c]
            part = (pieces[k], flown[before], lengths[k] / pieces[k], settle)
            top = max(tops[before], _flown(covs[before], phis[k], qs[k], told, k >= half, part, work, cov))
        if count[r, c, k] >= deep:
            continue
        other, beaten = head[r, c, k], False
        while other >= 0 and not beaten:
            shorter = flown[other] <= length * (1.0 + 1e-9) and tops[other] <= top * (1.0 + 1e-9)
            beaten = shorter and _within(covs[other], cov, slack)
            other = follow[other]
        if beaten:
            continue
        if taken == most:
            return FULL, np.empty((0, 2), np.int64), math.nan, math.nan, taken
        if taken == size:
            size *= 2
            place, parent, follow = _grown(place), _grown(parent), _grown(follow)
            flown, tops, covs = _grown(flown), _grown(tops), _grown(covs)
        me = taken
        taken += 1
        place[me, 0], place[me, 1], place[me, 2] = r, c, k
        parent[me], follow[me], head[r, c, k] = before, head[r, c, k], me
        flown[me], tops[me] = length, top
        covs[me] = cov
        count[r, c, k] += 1
        if r == goal[0] and c == goal[1]:
            return FOUND, _traced(place, parent, me), length, top, taken
        for n in range(headings):
            if k < headings and not turns[k, n]:
                continue
            r1, c1 = r + moves[n, 0], c + moves[n, 1]
            if r1 < 0 or c1 < 0 or r1 >= rows or c1 >= cols:
                continue
            told = info[n, r, c] if n < half else info[n - half, r1, c1]
            whole = length + lengths[n] + side * math.hypot(goal[0] - r1, goal[1] - c1)
            if told[0, 0] != told[0, 0] or whole > budget or count[r1, c1, n] >= deep:
                continue
            part = (pieces[n], length, lengths[n] / pieces[n], settle)
            after = max(top, _flown(cov, phis[n], qs[n], told, n >= half, part, work, trial))
            heappush(heap, (_bin(after, limit), whole, np.int64(me), np.int64(n)))
    return NONE, np.empty((0, 2), np.int64), math.nan, math.nan, taken


@jit
def _grown(a):
    """Twice the room."""
    return np.concatenate((a, np.empty_like(a)))


@jit
def _traced(place, parent, last):
    """Rows and columns from the start to a label."""
    n, at = 0, last
    while at >= 0:
        n, at = n + 1, parent[at]
    path, at = np.empty((n, 2), np.int64), last
    for i in range(n - 1, -1, -1):
        path[i, 0], path[i, 1] = place[at, 0], place[at, 1]
        at = parent[at]
    return path


@jit
def along(readings, phi, q, bias, cov0, out):
    """Covariance of the position after each of evenly spaced readings, the first one at the start.

    Parameters
    ----------
    readings : (n, 3)
        Slope north, east [unit/m], information of the white part [1/unit^2], 0 for no reading.
    phi, q : (d, d)
        From one reading to the next.
    bias : int
        Index of the bias; the patch comes next.
    cov0 : (d, d)
    out : (n, 3)
        Variance north, covariance, variance east [m^2].
    """
    d = len(cov0)
    cov, after, half, h, ch = cov0.copy(), np.empty((d, d)), np.empty((d, d)), np.zeros(d), np.empty(d)
    h[bias] = h[bias + 1] = 1.0
    for i in range(len(readings)):
        if i:
            _propagate(cov, phi, q, half, after)
            cov[:, :] = after
        if readings[i, 2] > 0.0:
            h[0], h[1] = -readings[i, 0], -readings[i, 1]
            total = 1.0 / readings[i, 2]
            for a in range(d):
                ch[a] = cov[a, 0] * h[0] + cov[a, 1] * h[1] + cov[a, bias] + cov[a, bias + 1]
            total += ch[0] * h[0] + ch[1] * h[1] + ch[bias] + ch[bias + 1]
            for a in range(d):
                for b in range(a + 1):
                    cov[a, b] -= ch[a] * ch[b] / total
                    cov[b, a] = cov[a, b]
        out[i, 0], out[i, 1], out[i, 2] = cov[0, 0], cov[0, 1], cov[1, 1]


@jit
def _apart(ax, ay, bx, by, px, py):
    """Squared distance of a point p from the segment a b."""
    dx, dy = bx - ax, by - ay
    whole = dx * dx + dy * dy
    t = ((px - ax) * dx + (py - ay) * dy) / whole if whole > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    return (ax + t * dx - px) ** 2 + (ay + t * dy - py) ** 2


@jit
def barred(segments, walls, owner, margin, out):
    """Which segments come within `margin` of polygons, or lie inside one (even-odd rule, so holes are outside).

    Parameters
    ----------
    segments : (n, 4) from (x, y) to (x, y) [m]
    walls : (m, 4) sides of all rings
    owner : (m,) int, number of each side's polygon; the sides of a polygon stand together
    margin : float [m]
    out : (n,) int, number of a polygon that bars the segment, -1 for none
    """
    for n in range(len(segments)):
        ax, ay, bx, by = segments[n, 0], segments[n, 1], segments[n, 2], segments[n, 3]
        low_x, high_x = min(ax, bx) - margin, max(ax, bx) + margin
        low_y, high_y = min(ay, by) - margin, max(ay, by) + margin
        out[n] = -1
        odd = False
        for m in range(len(walls)):
            if m and owner[m] != owner[m - 1]:
                odd = False
            px, py, qx, qy = walls[m, 0], walls[m, 1], walls[m, 2], walls[m, 3]
            if (py > ay) != (qy > ay) and ax < (qx - px) * (ay - py) / (qy - py) + px:
                odd = not odd
            if max(px, qx) >= low_x and min(px, qx) <= high_x and max(py, qy) >= low_y and min(py, qy) <= high_y:
                d1 = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
                d2 = (bx - ax) * (qy - ay) - (by - ay) * (qx - ax)
                d3 = (qx - px) * (ay - py) - (qy - py) * (ax - px)
                d4 = (qx - px) * (by - py) - (qy - py) * (bx - px)
                near = min(_apart(ax, ay, bx, by, px, py), _apart(ax, ay, bx, by, qx, qy))
                other = min(_apart(px, py, qx, qy, ax, ay), _apart(px, py, qx, qy, bx, by))
                if min(near, other) <= margin * margin or (d1 * d2 < 0.0 and d3 * d4 < 0.0):
                    out[n] = owner[m]
                    break
            if odd and (m == len(walls) - 1 or owner[m + 1] != owner[m]):  # all its sides to the east are counted
                out[n] = owner[m]
                break


@jit
def coned(values, north_m, east_m, rise):
    """Raise values (rows, cols) in place to the least field above them that rises by at most `rise` a metre.

    Two sweeps over the eight neighbours, so distances are those of chess knights' roads: at most 8 % too long.
    """
    rows, cols = values.shape
    slant = rise * math.hypot(north_m, east_m)
    for turn in range(2):
        for i0 in range(rows):
            i = i0 if turn == 0 else rows - 1 - i0
            back = i - 1 if turn == 0 else i + 1
            for k0 in range(cols):
                k = k0 if turn == 0 else cols - 1 - k0
                side = k - 1 if turn == 0 else k + 1
                best = values[i, k]
                if 0 <= side < cols:
                    best = max(best, values[i, side] - rise * east_m)
                if 0 <= back < rows:
                    best = max(best, values[back, k] - rise * north_m)
                    if k > 0:
                        best = max(best, values[back, k - 1] - slant)
                    if k < cols - 1:
                        best = max(best, values[back, k + 1] - slant)
                values[i, k] = best

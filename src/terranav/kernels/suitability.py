"""What a straight leg teaches, for every window of a line at once; and how rich the ground of a patch is.

A leg turns the covariance P at its start into the one at its end. The legs are kept as triples (A, C, J):

    end = A start + noise of covariance C,     the leg's readings bring the information J about its start,
    P at the end = A (I + P J)^-1 P A' + C

and two legs, i and then j, are again one leg (Sarkka and Garcia-Fernandez, Temporal parallelization of Bayesian
smoothers, IEEE Trans. Automatic Control 66 (2021), section IV; Redheffer's star product):

    A = A_j M A_i,   C = A_j M C_i A_j' + C_j,   J = J_i + A_i' J_j M A_i,   M = (I + C_i J_j)^-1

So a window of W steps costs as much as a short one: the line is cut every W steps, and a window is the end of one piece
and the beginning of the next, both of which are built up step by step.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.matrices import congruent, product


@jit
def solve(m, right):
    """Solve m x = right in place by elimination with pivots; m is spoilt, x stands in `right`."""
    d, cols = right.shape
    for k in range(d):
        pivot = k
        for i in range(k + 1, d):
            if abs(m[i, k]) > abs(m[pivot, k]):
                pivot = i
        if pivot != k:
            for j in range(k, d):
                m[k, j], m[pivot, j] = m[pivot, j], m[k, j]
            for j in range(cols):
                right[k, j], right[pivot, j] = right[pivot, j], right[k, j]
        for i in range(k + 1, d):
            factor = m[i, k] / m[k, k]
            if factor != 0.0:
                for j in range(k + 1, d):
                    m[i, j] -= factor * m[k, j]
                for j in range(cols):
                    right[i, j] -= factor * right[k, j]
    for k in range(d - 1, -1, -1):
        for i in range(k + 1, d):
            for j in range(cols):
                right[k, j] -= m[k, i] * right[i, j]
        for j in range(cols):
            right[k, j] /= m[k, k]


@jit
def _one_plus(a, b, out):
    """out = I + a b."""
    product(a, b, out)
    for i in range(len(out)):
        out[i, i] += 1.0


@jit
def start(a, c, j):
    """The leg of no length."""
    d = len(a)
    for i in range(d):
        for k in range(d):
            a[i, k] = c[i, k] = j[i, k] = 0.0
        a[i, i] = 1.0


@jit
def extend(a, c, j, phi, q, scale, reading, bias):
    """Lengthen a leg (a, c, j) in place by one step (phi, q) and a reading after it.

    Parameters
    ----------
    a, c, j : (d, d)
    phi, q : (d, d)
    scale : (d,) unit of each state
    reading : (3,) slope north, slope east, information of the white part of the reading (0: no reading)
    bias : int
        Index of the bias; the patch comes next.
    """
    d = len(a)
    half = np.empty((d, d))
    product(phi, a, half)
    a[:, :] = half
    congruent(phi, c, half)
    for i in range(d):
        for k in range(d):
            c[i, k] = half[i, k] + q[i, k]
    if reading[2] <= 0.0:
        return
    h = np.zeros(d)
    h[0], h[1] = -reading[0] * scale[0], -reading[1] * scale[1]
    h[bias], h[bias + 1] = scale[bias], scale[bias + 1]
    ch, ah, total = np.zeros(d), np.zeros(d), 1.0 / reading[2]
    for k in range(d):
        if h[k] != 0.0:
            for i in range(d):
                ch[i] += c[i, k] * h[k]
                ah[i] += a[k, i] * h[k]
    for k in range(d):
        total += h[k] * ch[k]
    for i in range(d):
        for k in range(d):
            j[i, k] += ah[i] * ah[k] / total
            a[i, k] -= ch[i] * ah[k] / total
            c[i, k] -= ch[i] * ch[k] / total


@jit
def joined(ai, ci, ji, aj, cj, jj, a, c, j):
    """The leg i and then the leg j, into (a, c, j), which may be neither of them."""
    d = len(ai)
    m, right, half = np.empty((d, d)), np.empty((d, 2 * d)), np.empty((d, d))
    _one_plus(ci, jj, m)
    right[:, :d], right[:, d:] = ai, ci
    solve(m, right)
    by_a, by_c = right[:, :d].copy(), right[:, d:].copy()
    product(aj, by_a, a)
    product(aj, by_c, half)
    product(half, aj.T.copy(), c)
    product(jj, by_a, half)
    product(ai.T.copy(), half, j)
    for i in range(d):
        for k in range(d):
            c[i, k] += cj[i, k]
            j[i, k] += ji[i, k]
    for i in range(d):  # keep what rounding takes from symmetry
        for k in range(i):
            c[i, k] = c[k, i] = 0.5 * (c[i, k] + c[k, i])
            j[i, k] = j[k, i] = 0.5 * (j[i, k] + j[k, i])


@jit
def flown(a, c, j, cov, out):
    """Covariance at the end of a leg from that at its start, the first len(out) states of it."""
    d, n = len(a), len(out)
    m, right = np.empty((d, d)), np.empty((d, n))
    _one_plus(cov, j, m)
    product(cov, a[:n].T.copy(), right)
    solve(m, right)
    product(a[:n].copy(), right, out)
    for i in range(n):
        for k in range(n):
            out[i, k] += c[i, k]
    for i in range(n):
        for k in range(i):
            out[i, k] = out[k, i] = 0.5 * (out[i, k] + out[k, i])


@jit
def _suffixes(readings, first, window, phi, q, scale, bias, cov0, middle):
    """Covariance in the middle: after the steps s .. first + window - 1 of a piece, for every s."""
    d, subs = len(phi), readings.shape[1]
    a, c, j = np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    start(a, c, j)
    ai, ci, ji = np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    a2, c2, j2 = np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    for s in range(window - 1, 0, -1):
        start(ai, ci, ji)
        for k in range(subs):
            extend(ai, ci, ji, phi, q, scale, readings[first + s, k], bias)
        joined(ai, ci, ji, a, c, j, a2, c2, j2)
        a, a2, c, c2, j, j2 = a2, a, c2, c, j2, j
        flown(a, c, j, cov0, middle[s])


@jit
def windows(readings, window, phi, q, scale, bias, cov0, out):
    """Covariance of the position after each window of a line.

    Parameters
    ----------
    readings : (steps, subs, 3)
        Slope north and east [unit/m] and information [1/unit^2] of the readings of each step; a step with a NaN breaks
        the line.
    window : int
        Steps of a leg, >= 1.
    phi, q : (d, d)
        From one reading to the next, of the scaled states.
    scale : (d,) unit of each state
    bias : int
        Index of the bias of the map.
    cov0 : (d, d)
        At the start of every leg, scaled.
    out : (steps, 3)
        Variance north, covariance, variance east [m^2] after the window that ends with each step; NaN without one.
    """
    steps, subs, _ = readings.shape
    d = len(phi)
    out[:] = np.nan
    middle = np.empty((window, d, d))
    a, c, j, end = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty((2, 2))
    at = 0
    while at < steps:
        stop = at
        while stop < steps and np.isfinite(readings[stop]).all():
            stop += 1
        piece = at
        while piece < stop:  # windows that end in this piece
            if piece > at:
                _suffixes(readings, piece - window, window, phi, q, scale, bias, cov0, middle)
            start(a, c, j)
            for k in range(min(window, stop - piece)):
                for sub in range(subs):
                    extend(a, c, j, phi, q, scale, readings[piece + k, sub], bias)
                if piece > at and k < window - 1:
                    flown(a, c, j, middle[k + 1], end)
                elif k == window - 1:
                    flown(a, c, j, cov0, end)
                else:
                    continue
                out[piece + k, 0] = end[0, 0] * scale[0] * scale[0]
                out[piece + k, 1] = end[0, 1] * scale[0] * scale[1]
                out[piece + k, 2] = end[1, 1] * scale[1] * scale[1]
            piece += window
        at = max(stop, at) + 1


@jit
def entropies(values, block, half, width, out):
    """Entropy [bits] of the heights within `half` cells of each block's middle, in bins `width` wide; NaN with a void.

    Parameters
    ----------
    values : (rows, cols) [unit]
    block, half : int [cells]
    width : float [unit]
    out : (blocks down, blocks across)
    """
    rows, cols = values.shape
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            r0, c0 = i * block + block // 2, k * block + block // 2
            top, bottom, left, right = max(r0 - half, 0), min(r0 + half, rows), max(c0 - half, 0), min(c0 + half, cols)
            cells = np.sort(values[top:bottom, left:right].copy().ravel())
            out[i, k] = np.nan
            if cells.size == 0 or np.isnan(cells[-1]):  # NaN sorts last
                continue
            total, run = 0.0, 0
            for n in range(cells.size):
                run += 1
                here = math.floor((cells[n] - cells[0]) / width)
                if n == cells.size - 1 or math.floor((cells[n + 1] - cells[0]) / width) != here:
                    total -= run / cells.size * math.log2(run / cells.size)
                    run = 0
            out[i, k] = total


@jit
def likeness(values, half, guard, reach, out):
    """How alike the most alike other place within reach is: 1 - d^2 / (s^2 + t^2), d the rms difference of two patches
    less their means, s and t their standard deviations; 1 is the same ground.

    Parameters
    ----------
    values : (rows, cols) [unit]
        One for each block.
    half, guard, reach : int [blocks]
        Patches have 2 half + 1 blocks a side; the other place is more than `guard` and at most `reach` away on an axis.
    out : (rows, cols)
        NaN where no two patches fit in or a void lies in the own one.
    """
    rows, cols = values.shape
    n = (2 * half + 1) ** 2
    for i in range(rows):
        for k in range(cols):
            out[i, k] = np.nan
            if i < half or k < half or i >= rows - half or k >= cols - half:
                continue
            for di in range(-reach, reach + 1):
                for dk in range(-reach, reach + 1):
                    p, s = i + di, k + dk
                    if max(abs(di), abs(dk)) <= guard:
                        continue
                    if p < half or s < half or p >= rows - half or s >= cols - half:
                        continue
                    sx = sy = sxx = syy = sxy = 0.0
                    for u in range(-half, half + 1):
                        for v in range(-half, half + 1):
                            x, y = values[i + u, k + v] - values[i, k], values[p + u, s + v] - values[p, s]
                            sx, sy, sxx, syy, sxy = sx + x, sy + y, sxx + x * x, syy + y * y, sxy + x * y
                    spread = sxx + syy - (sx * sx + sy * sy) / n
                    cross = 2.0 * (sxy - sx * sy / n)
                    like = 1.0 if spread <= 0.0 else cross / spread
                    if spread == spread and not out[i, k] >= like:
                        out[i, k] = like

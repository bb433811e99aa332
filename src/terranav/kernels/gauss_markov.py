"""The recursion of a second-order Gauss-Markov field, along the columns of each row and down the rows, in one pass.

White noise is made where it is used: row i of a key has numbers of its own, so that a field's bits do not depend on how
many rows are asked for at once.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.random import normal_pairs

TILE = 2048  # columns that are carried through all steps together, in the nearest cache; says which number goes where
SIDE_BY_SIDE = 4  # rows whose recursions run at once, for each has to wait for the number before


@jit
def continue_field(key, first_row, across, down, start, mean, out):
    """Write further rows of a field that is filtered along both axes.

    Each filter is y[k] = s1 + b0 e[k], s1 <- a1 y[k] + b1 e[k] + s2, s2 <- a2 y[k] (direct form II transposed).

    Parameters
    ----------
    key : uint64
        Of the white noise, standard normal.
    first_row : int
        Which row of that noise the first one written has.
    across, down : (7,) float64
        a1, a2, b0, b1 and the start's lower triangle l11, l21, l22, for the filter along a row and down the columns.
    start : (2, cols) float64, read and written
        State of the filters down the columns.
    mean : float
        Added to what is written.
    out : (n, cols) float64 or float32, written
    """
    rows, cols = out.shape
    pairs = (cols + 1) // 2 + 1  # of a row; the last one starts its filter
    noise, driven = np.empty(TILE + 1), np.empty((SIDE_BY_SIDE, TILE + 1))
    past, last, seed = np.empty((SIDE_BY_SIDE, 2)), np.empty(SIDE_BY_SIDE), np.empty(2)
    for top in range(0, rows, SIDE_BY_SIDE):
        past[:], last[:] = 0.0, 0.0
        for begin in range(0, cols, TILE):
            size = min(TILE, cols - begin)
            half = (size + 1) // 2
            for r in range(SIDE_BY_SIDE):
                pair = (first_row + top + r) * pairs
                noise[0] = last[r]
                normal_pairs(key, pair + begin // 2, noise[1 : 1 + half], noise[1 + half : 1 + 2 * half])
                last[r] = noise[size]
                _blend(noise[:size], noise[1 : 1 + size], across[2], across[3], driven[r, :size])
                if begin == 0:
                    normal_pairs(key, pair + pairs - 1, seed[:1], seed[1:])
                    driven[r, 0] += across[4] * seed[0]
                    driven[r, min(1, size)] += across[5] * seed[0] + across[6] * seed[1]
            _four_recursions(across[0], across[1], past, driven[0], driven[1], driven[2], driven[3], size)
            end = begin + size
            for r in range(min(SIDE_BY_SIDE, rows - top)):
                _down(driven[r, :size], down, mean, start[0, begin:end], start[1, begin:end], out[top + r, begin:end])


@jit
def _blend(before, here, b0, b1, out):
    for j in range(out.size):
        out[j] = b0 * here[j] + b1 * before[j]


@jit(fastmath={"contract"})  # a multiply-add is one wait instead of two
def _four_recursions(a1, a2, past, w0, w1, w2, w3, size):
    """y[k] = a1 y[k-1] + a2 y[k-2] + w[k] along four rows, in place; `past` (4, 2) has y[-1], y[-2], and is kept up."""
    p0, p1, p2, p3 = past[0, 0], past[1, 0], past[2, 0], past[3, 0]
    q0, q1, q2, q3 = past[0, 1], past[1, 1], past[2, 1], past[3, 1]
    for j in range(size):
        p0, q0 = (a2 * q0 + w0[j]) + a1 * p0, p0
        p1, q1 = (a2 * q1 + w1[j]) + a1 * p1, p1
        p2, q2 = (a2 * q2 + w2[j]) + a1 * p2, p2
        p3, q3 = (a2 * q3 + w3[j]) + a1 * p3, p3
        w0[j], w1[j], w2[j], w3[j] = p0, p1, p2, p3
    past[0, 0], past[1, 0], past[2, 0], past[3, 0] = p0, p1, p2, p3
    past[0, 1], past[1, 1], past[2, 1], past[3, 1] = q0, q1, q2, q3


@jit(fastmath={"contract"})
def _down(line, down, mean, s_first, s_second, out):
    """One row further down the columns."""
    a1, a2, b0, b1 = down[0], down[1], down[2], down[3]
    for j in range(line.size):
        e = line[j]
        y = s_first[j] + b0 * e
        s_first[j] = a1 * y + b1 * e + s_second[j]
        s_second[j] = a2 * y
        out[j] = y + mean

"""One step of a hidden Markov model on a still grid whose cells move to their eight neighbours (papers/000).

Arrays are (rows north, cols east). Scores are logarithms; minus infinity is "no path". The 3 x 3 neighbours are
numbered row by row from the south-west, so that number 4 is the cell itself and k stands for the step
(k // 3 - 1, k % 3 - 1) back to where the path came from. Beyond the border there is no path and no probability.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.fastmath import fast_exp
from terranav.kernels.jit import jit
from terranav.kernels.noises import log_probabilities

STAY = 4
FLOOR, SCALE = 1e-290, 1e290  # probabilities below are zero: denormals cost time and mean nothing
_DEEP = -650.0  # a likelihood is never taken for less than e to this, relative to the best


@jit
def max_sum(score, log_stay, log_move, out, pointer):
    """Best score into each cell and where it came from: papers/000 eqs. 11 and 12 without the measurement.

    Parameters
    ----------
    score : (rows, cols)
    log_stay, log_move : logarithms of a_ii and of a_ij for one of the eight neighbours
    out : (rows, cols), written
    pointer : (rows, cols) uint8, written; of equal scores staying wins, then the lowest number
    """
    rows, cols = out.shape
    framed = np.full((3, cols + 2), -np.inf)
    _copy(score[0], framed[1, 1 : 1 + cols])
    for i in range(rows):
        south, here, north = framed[i % 3], framed[(i + 1) % 3], framed[(i + 2) % 3]
        if i + 1 < rows:
            _copy(score[i + 1], north[1 : 1 + cols])
        else:
            north[:] = -np.inf
        _best_of_nine(south, here, north, log_stay, log_move, out[i], pointer[i])


@jit
def _copy(row, out):  # a quarter of the time of a slice assignment
    for j in range(row.size):
        out[j] = row[j]


@jit
def _best_of_nine(south, here, north, log_stay, log_move, line, back):
    """One row of `max_sum`, from three rows within a frame; of each two the lower number stands unless beaten."""
    cols = line.size
    sw, s, se = south[:cols], south[1 : 1 + cols], south[2 : 2 + cols]
    w, c, e = here[:cols], here[1 : 1 + cols], here[2 : 2 + cols]
    nw, n, ne = north[:cols], north[1 : 1 + cols], north[2 : 2 + cols]
    for j in range(cols):
        k01, m01 = 1 if s[j] > sw[j] else 0, max(sw[j], s[j])
        k23, m23 = 3 if w[j] > se[j] else 2, max(se[j], w[j])
        k56, m56 = 6 if nw[j] > e[j] else 5, max(e[j], nw[j])
        k78, m78 = 8 if ne[j] > n[j] else 7, max(n[j], ne[j])
        k03, m03 = k23 if m23 > m01 else k01, max(m01, m23)
        k58, m58 = k78 if m78 > m56 else k56, max(m56, m78)
        k, best = k58 if m58 > m03 else k03, max(m03, m58) + log_move
        stayed = c[j] + log_stay
        back[j] = STAY if stayed >= best else k
        line[j] = max(stayed, best)


@jit
def spread(probability, stay, move, out):
    """Probability of each cell after one step, sum_i P(i) a_ij, over what has not left the grid.

    Parameters
    ----------
    probability : (rows, cols), sums to one
    stay, move : a_ii, and a_ij for one of the eight neighbours
    out : (rows, cols), written, sums to one; what is left of a difference of two equal sums, or is too small to be a
        normal number later, is zero
    """
    rows, cols = out.shape
    kept = 1.0 / (stay + move * _neighbours(probability))
    stay, move = stay * kept, move * kept
    column, none = np.zeros(cols + 2), np.zeros(cols)
    west, middle, east = column[:cols], column[1 : 1 + cols], column[2 : 2 + cols]
    for i in range(rows):
        south, here = probability[i - 1] if i > 0 else none, probability[i]
        north = probability[i + 1] if i + 1 < rows else none
        for j in range(cols):
            middle[j] = south[j] + here[j] + north[j]
        line = out[i]
        for j in range(cols):
            p = stay * here[j] + move * (west[j] + middle[j] + east[j] - here[j])
            line[j] = p if p > FLOOR else 0.0


@jit
def _neighbours(probability):
    """Mean number of neighbours within the grid: eight, but for the cells at its border."""
    rows, cols = probability.shape
    first, last = probability[0], probability[rows - 1]
    edge_rows = first.sum() + last.sum()
    edge_cols = probability[:, 0].sum() + probability[:, cols - 1].sum()
    corners = first[0] + first[cols - 1] + last[0] + last[cols - 1]
    return 8.0 - 3.0 * (edge_rows + edge_cols) + corners  # sum of (3 - borders passed) (3 - borders passed) - 1


@jit
def weigh(score, probability, field, model, new_score, new_probability):
    """Both recursions after one reading (papers/000 eqs. 3, 4 and 6).

    Parameters
    ----------
    score, probability : (rows, cols); the probabilities sum to one
    field : (rows, cols), the map at each cell, NaN where it says nothing
    model : (value, sigma, cell_share, noise, first, second)
        The reading and its 1-sigma, map error included; the map's squared change from cell to cell that counts as
        noise: 1/12 for an error that is anywhere within its cell, 0 for one at the centre; the rest as in
        `noises.log_probabilities`, whose interval is of one sigma on either side.
    new_score, new_probability : (rows, cols), written; without meaning where `known` is 0

    Returns
    -------
    known : share of the probability before on cells where the map says something; the others are neither confirmed
        nor refuted: they get the average likelihood
    mean, variance : of reading less map, by the probability before on those cells
    gained : what was taken from all scores, so that the best is 0
    """
    known, mean, square, top, best, solid = _weighed(score, probability, field, model, new_score, new_probability)
    if known <= 0.0:
        return 0.0, np.nan, np.nan, 0.0
    total = 0.0
    for i in range(new_score.shape[0]):
        total += _likelihoods(probability[i], top, new_probability[i])
    average = total / known
    if not solid:
        best = max(best, _fill(score, probability, average, top + np.log(average), new_score, new_probability))
        total += average * max(1.0 - known, 0.0)
    norm = 1.0 / total
    for i in range(new_score.shape[0]):
        s, p = new_score[i], new_probability[i]
        for j in range(s.size):
            s[j] -= best
        for j in range(p.size):
            p[j] *= norm
    mean /= known
    return known, mean, max(square / known - mean * mean, 0.0), best


@jit
def _weighed(score, probability, field, model, new_score, new_weight):
    """Scores with the reading's log probability added, and that itself, NaN where the map says nothing.

    Returns the sums of probability, probability x residual and x its square where the map says something, the best
    log probability where there is probability, the best score, and whether the map says something everywhere.
    """
    value, sigma, cell_share, noise, first, second = model
    rows, cols = field.shape
    line, tops, bests = np.empty(cols + 2), np.full(cols, -np.inf), np.full(cols, -np.inf)
    known, mean, square, solid, work = 0.0, 0.0, 0.0, 0, np.empty((3, cols))
    for i in range(rows):
        weight = new_weight[i]
        _extended(field[i], line)
        below, above = max(i - 1, 0), min(i + 1, rows - 1)
        told = (value, sigma * sigma, 1.0 / max(above - below, 1), cell_share)
        log_probabilities(line, field[below], field[above], told, noise, (sigma, first, second), work, weight)
        p, m, s, n = _sums(probability[i], field[i], weight, value, tops)
        known, mean, square, solid = known + p, mean + m, square + s, solid + n
        _add(score[i], weight, new_score[i], bests)
    return known, mean, square, tops.max(), bests.max(), solid == rows * cols


@jit
def _extended(row, out):
    """A row with a cell more at either end, in line with the two that end it."""
    last = row.size - 1
    for j in range(row.size):
        out[j + 1] = row[j]
    out[0], out[last + 2] = 2.0 * row[0] - row[min(1, last)], 2.0 * row[last] - row[max(last - 1, 0)]


@jit(fastmath={"reassoc"})  # sums in several lanes; NaN is told by comparison and keeps its meaning
def _sums(prior, line, weight, value, tops):
    """Sums of probability, times residual, times its square, and of cells, where the map says something.

    The highest weight of each column where there is any probability is kept in `tops`.
    """
    total, mean, square, solid = 0.0, 0.0, 0.0, 0
    for j in range(line.size):
        d, w, p = value - line[j], weight[j], prior[j]
        one = 1 if d == d else 0
        p, d = p if d == d else 0.0, d if d == d else 0.0
        solid += one
        total += p
        mean += p * d
        square += p * d * d
        w = w if p > 0.0 else -np.inf
        tops[j] = w if w > tops[j] else tops[j]
    return total, mean, square, solid


@jit
def _add(score, weight, new_score, bests):
    """New scores of a row; the highest of each column is kept, NaN is not the highest."""
    for j in range(score.size):
        s = score[j] + weight[j]
        new_score[j] = s
        bests[j] = s if s > bests[j] else bests[j]


@jit
def _highest(row, highest):
    """Keep the highest value of each column."""
    for j in range(row.size):
        highest[j] = row[j] if row[j] > highest[j] else highest[j]


@jit(fastmath={"reassoc"})  # a sum in several lanes; NaN is told by comparison and keeps its meaning
def _likelihoods(prior, top, weight):
    """Probabilities of a row times likelihoods, in place of the log probabilities; NaN stays; and their sum."""
    total = 0.0
    for j in range(weight.size):
        w = weight[j]
        q = (SCALE * prior[j]) * fast_exp(min(max(w - top, _DEEP), 0.0))
        q = FLOOR * (q if q > 1.0 else 0.0)  # scaled, so that no denormal number ever comes up
        weight[j] = q if w == w else np.nan
        total += q if w == w else 0.0
    return total


@jit
def _fill(score, probability, average, weight, new_score, new_probability):
    """Give the cells where the map says nothing the average likelihood; the best score of these."""
    best = -np.inf
    for i in range(score.shape[0]):
        for j in range(score.shape[1]):
            if np.isnan(new_probability[i, j]):
                new_score[i, j] = score[i, j] + weight
                p = SCALE * probability[i, j] * average
                new_probability[i, j] = FLOOR * p if p > 1.0 else 0.0
                best = max(best, new_score[i, j])
    return best


@jit
def moments(score, probability, south, west):
    """Where the best score is, and mean and covariance of the probabilities.

    Parameters
    ----------
    score, probability : (rows, cols)
    south, west : int
        Lattice indices of the first row and column; of equal best scores that nearest to (0, 0) is taken, then the
        first.

    Returns
    -------
    row, col : lattice indices of the best score
    north, east, nn, ne, ee : means and covariance, in cells
    """
    rows, cols = score.shape
    mass, moment, columns, bests = np.empty(rows), np.empty(rows), np.zeros(cols), np.full(cols, -np.inf)
    at, up = west + np.arange(cols).astype(np.float64), south + np.arange(rows).astype(np.float64)
    for i in range(rows):
        mass[i], moment[i] = _row_sums(probability[i], at, columns)
        _highest(score[i], bests)
    best, nearest, row, col = bests.max(), np.inf, 0, 0
    for i in range(rows):
        if _occurs(best, score[i]):
            for j in range(cols):
                away = up[i] * up[i] + at[j] * at[j]
                if score[i, j] == best and away < nearest:
                    nearest, row, col = away, south + i, west + j
    north, east = (mass * up).sum(), (columns * at).sum()
    nn, ee = (mass * (up - north) ** 2).sum(), (columns * (at - east) ** 2).sum()
    return row, col, north, east, nn, ((moment - east * mass) * (up - north)).sum(), ee


@jit
def _occurs(value, row):
    found = 0
    for j in range(row.size):
        found += row[j] == value
    return found > 0


@jit(fastmath={"reassoc"})  # sums in several lanes; the summands are finite
def _row_sums(p, at, columns):
    """Sum and first moment of a row, and its share of the columns' sums added to these."""
    mass, moment = 0.0, 0.0
    for j in range(p.size):
        mass += p[j]
        moment += p[j] * at[j]
        columns[j] += p[j]
    return mass, moment

"""One step of a hidden Markov model on a still grid whose cells move to their eight neighbours (papers/000).

Arrays are (rows north, cols east). Scores are logarithms; minus infinity is "no path". The 3 x 3 neighbours are
numbered row by row from the south-west, so that number 4 is the cell itself and k stands for the step
(k // 3 - 1, k % 3 - 1) back to where the path came from.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit

STAY = 4
INTEGRAL, GAUSSIAN, LAPLACE, STUDENT_T, MIXTURE = range(5)
_FAR = 8.0  # from here on erfc is taken from its asymptotic series: relative error 3e-9


@jit
def max_sum(padded, log_stay, log_move, out, pointer):
    """Best score into each cell and where it came from: papers/000 eqs. 11 and 12 without the measurement.

    Parameters
    ----------
    padded : (rows + 2, cols + 2), the scores within a frame of minus infinity
    log_stay, log_move : logarithms of a_ii and of a_ij for one of the eight neighbours
    out : (rows, cols), written
    pointer : (rows, cols) uint8, written; of equal scores staying wins, then the lowest number
    """
    rows, cols = out.shape
    for i in range(rows):
        south, here, north = padded[i], padded[i + 1], padded[i + 2]
        sw, s, se = south[:cols], south[1 : 1 + cols], south[2 : 2 + cols]
        w, c, e = here[:cols], here[1 : 1 + cols], here[2 : 2 + cols]
        nw, n, ne = north[:cols], north[1 : 1 + cols], north[2 : 2 + cols]
        line, back = out[i], pointer[i]
        for j in range(cols):
            best, k = sw[j], 0
            k = 1 if s[j] > best else k
            best = max(best, s[j])
            k = 2 if se[j] > best else k
            best = max(best, se[j])
            k = 3 if w[j] > best else k
            best = max(best, w[j])
            k = 5 if e[j] > best else k
            best = max(best, e[j])
            k = 6 if nw[j] > best else k
            best = max(best, nw[j])
            k = 7 if n[j] > best else k
            best = max(best, n[j])
            k = 8 if ne[j] > best else k
            best = max(best, ne[j]) + log_move
            stayed = c[j] + log_stay
            back[j] = STAY if stayed >= best else k
            line[j] = max(stayed, best)


@jit
def spread(padded, stay, move, out):
    """Probability of each cell after one step, sum_i P(i) a_ij; `padded` (rows + 2, cols + 2) has a frame of zeros.

    What is left of a difference of two equal sums, or is too small to be a normal number later, is zero.
    """
    rows, cols = out.shape
    column = np.empty(cols + 2)
    for i in range(rows):
        south, here, north = padded[i], padded[i + 1], padded[i + 2]
        for j in range(cols + 2):
            column[j] = south[j] + here[j] + north[j]
        west, middle, east, centre = column[:cols], column[1 : 1 + cols], column[2 : 2 + cols], here[1 : 1 + cols]
        line = out[i]
        for j in range(cols):
            p = stay * centre[j] + move * (west[j] + middle[j] + east[j] - centre[j])
            line[j] = p if p > 1e-290 else 0.0


@jit
def _log_erfc_far(z):
    """Logarithm of erfc for z >= _FAR, also where erfc itself is below the smallest number."""
    q = 0.5 / (z * z)
    series = 1.0 - q * (1.0 - 3.0 * q * (1.0 - 5.0 * q * (1.0 - 7.0 * q * (1.0 - 9.0 * q))))
    return -z * z + math.log(series / (z * math.sqrt(math.pi)))


@jit
def log_probability(v, sigma, half_width, noise, first, second):
    """Logarithm of the measurement probability of a residual v [unit], up to a constant that all cells share.

    Parameters
    ----------
    v, sigma : the residual and its 1-sigma
    half_width : INTEGRAL only: half the width of the interval of papers/000 eq. 6
    noise : INTEGRAL, GAUSSIAN, LAPLACE, STUDENT_T (all of variance sigma^2) or MIXTURE
    first, second : STUDENT_T: degrees of freedom; MIXTURE: share of outliers, how many times noisier they are
    """
    r = abs(v) / sigma
    if noise == INTEGRAL:
        near, far = (r - half_width / sigma) * math.sqrt(0.5), (r + half_width / sigma) * math.sqrt(0.5)
        if near < 1.0:
            return math.log(0.5 * (math.erf(far) - math.erf(near)))
        if near < _FAR:
            return math.log(0.5 * (math.erfc(near) - math.erfc(far)))
        top = _log_erfc_far(near) - math.log(2.0)
        if far * far - near * near > 40.0:  # the far end takes less than e^-40 of it
            return top
        return top + math.log(-math.expm1(_log_erfc_far(far) - _log_erfc_far(near)))
    if noise == GAUSSIAN:
        return -0.5 * r * r - math.log(sigma)
    if noise == LAPLACE:
        return -math.sqrt(2.0) * r - math.log(sigma)
    if noise == STUDENT_T:
        return -0.5 * (first + 1.0) * math.log1p(r * r / (first - 2.0)) - math.log(sigma)
    good = math.log1p(-first) - 0.5 * r * r
    bad = math.log(first / second) - 0.5 * (r / second) ** 2 if first > 0.0 else -math.inf
    top = max(good, bad)
    return top + math.log(math.exp(good - top) + math.exp(bad - top)) - math.log(sigma)


@jit
def measure(field, value, sigma, cell_share, noise, first, second, out):
    """Logarithm of b_j(y) for every cell (papers/000 eqs. 3, 4 and 6), NaN where the map says nothing.

    Parameters
    ----------
    field : (rows, cols), the map at each cell
    value, sigma : the reading and its 1-sigma, map error included
    cell_share : the map's squared change from cell to cell that counts as noise: 1/12 for an error that is
        anywhere within its cell, 0 for one at the centre
    noise, first, second : as in `log_probability`
    out : (rows, cols), written
    """
    rows, cols = field.shape
    for i in range(rows):
        line = field[i]
        below, above = field[max(i - 1, 0)], field[min(i + 1, rows - 1)]
        per_row = 1.0 / max(min(i + 1, rows - 1) - max(i - 1, 0), 1)
        target = out[i]
        for j in range(cols):
            h = line[j]
            if h != h:
                target[j] = np.nan
                continue
            west, east = max(j - 1, 0), min(j + 1, cols - 1)
            north_step, east_step = (above[j] - below[j]) * per_row, (line[east] - line[west]) / max(east - west, 1)
            slope2 = 0.0
            if north_step == north_step:
                slope2 += north_step * north_step
            if east_step == east_step:
                slope2 += east_step * east_step
            s = math.sqrt(sigma * sigma + cell_share * slope2)
            target[j] = log_probability(value - h, s, sigma, noise, first, second)

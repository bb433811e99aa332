"""Monitoring kernels: rival places that are weighed beside an estimate, and how far its posterior reaches."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.fastmath import fast_exp
from terranav.kernels.jit import jit
from terranav.kernels.marginalized import BLOCK, SUMS
from terranav.kernels.sampling import bilinear_at
from terranav.kernels.sloped import sloped

BINS = 200  # of the distance from the mean, in steps of 5 %
STEP = 0.05
CLIP = 9.0  # one reading speaks for or against a place by at most half of this


@jit(fastmath=SUMS)
def weigh_rivals(values, frame, origin, node, shift, bias, odds, recent, numbers, out):
    """One reading, weighed at the estimated place (the first node) and at its rivals.

    Every place is a Kalman filter of its own for the bias of the readings, and follows the slope of the map within its
    cell (a constant gain: least mean squares), so that a place that fits is not missed for lying between two nodes.

    Parameters
    ----------
    values : (rows, cols) float32
    frame : (2, 6) float64, of the LocalFrame at the indicated position
    origin : (2,) float64, the estimated INS error [m]
    node : (2, n) float64, offsets of the rivals from it; the first is zero [m]
    shift : (2, n) float64, how far each has followed the slope within its cell [m]
    bias : (n,) float64
    odds, recent : (n,) float64
        Logarithm of the likelihood ratio against the first, of all readings, and with fading memory.
    numbers : (7,) float64
        Reading; white variance; variance of the bias; variance of the place within a cell [m^2]; farthest that a rival
        may follow the slope [m]; least odds; fading.
    out : (5, n) written: shift north and east, bias, odds, recent
    """
    value, white, common, cell2, tether, least, fading = numbers
    work = np.empty(BLOCK, np.uint64), np.empty((4, BLOCK), np.float32), np.empty((3, BLOCK))
    found, at, block = np.empty((3, BLOCK)), np.empty((2, BLOCK)), np.empty((2, BLOCK))
    first = 0.0
    for start in range(0, odds.size, BLOCK):
        stop = min(start + BLOCK, odds.size)
        size = stop - start
        for i in range(2):
            place, base, away, moved = at[i, :size], origin[i], node[i, start:stop], shift[i, start:stop]
            for k in range(size):
                place[k] = base + away[k] + moved[k]
        sloped(values, frame, at[0, :size], at[1, :size], work, found)
        height, rise_n, rise_e, own = found[0, :size], found[1, :size], found[2, :size], bias[start:stop]
        gain, against = block[0, :size], block[1, :size]
        for k in range(size):
            r = value - height[k] - own[k]
            there = r == r
            r = r if there else 0.0
            precision = 1.0 / (white + common + (rise_n[k] * rise_n[k] + rise_e[k] * rise_e[k]) * cell2)
            square = r * r * precision
            most = math.copysign(math.sqrt(CLIP * precision), r)
            gain[k] = r * precision if square < CLIP else most
            against[k] = 0.5 * (square if square < CLIP else CLIP) if there else np.nan
        if start == 0 and against[0] == against[0]:
            first = against[0]
        for i in range(2):
            rise, moved, after = found[1 + i, :size], shift[i, start:stop], out[i, start:stop]
            for k in range(size):
                step = moved[k] - gain[k] * cell2 * rise[k]  # h falls with the error: dr/dn = +gn
                step = step if step > -tether else -tether
                after[k] = step if step < tether else tether
        after, before = out[2, start:stop], bias[start:stop]
        for k in range(size):
            after[k] = before[k] + common * gain[k]
        _ratios(odds[start:stop], against, first, 1.0, least, out[3, start:stop])
        _ratios(recent[start:stop], against, first, fading, -np.inf, out[4, start:stop])
    for i in range(2):
        out[i, 0] = shift[i, 0]
    out[3, 0], out[4, 0] = 0.0, 0.0


@jit
def _ratios(before, against, first, keep, least, after):
    """Log likelihood ratios after a reading, as they were where the map is silent."""
    for k in range(after.size):
        ratio = keep * before[k] + first - against[k]
        ratio = ratio if ratio > least else least
        after[k] = ratio if against[k] == against[k] else before[k]


@jit(fastmath=SUMS)
def reach_of_rivals(distance, odds, budget, near):
    """How far from the estimate the rivals that are not refuted reach.

    Parameters
    ----------
    distance : (n,) of each place, rising [m]; the first is the estimate
    odds : (n,) log likelihood ratio against the estimate
    budget : float, probability that may be left out
    near : float, rivals nearer than this belong to the estimate's own surroundings [m]

    Returns
    -------
    reach : distance beyond which the rivals hold no more than the budget, 0 when those that are not near hold less
    share : probability of the rivals that are not near, each even odds with the estimate before any reading
    best : index of the likeliest rival that is not near, 0 when there is none
    """
    n = odds.size
    start = max(np.searchsorted(distance, near, side="right"), 1)
    if start >= n:
        return 0.0, 0.0, 0
    best = start
    for k in range(start, n):
        best = k if odds[k] > odds[best] else best
    top = max(odds[best], 0.0)
    likely, share = np.empty(n), 0.0
    for k in range(start, n):
        each = fast_exp(odds[k] - top)
        likely[k] = each
        share += each
    total = math.exp(-top) + share
    beyond, reach, allowed = 0.0, 0.0, budget * total
    if share > allowed:
        for k in range(n - 1, start - 1, -1):
            beyond += likely[k]
            if beyond > allowed:
                reach = distance[k]
                break
    return reach, share / total, best


@jit
def scatter(values, frames, centre, value, node, out):
    """Scatter of the residuals about their mean, were the vehicle displaced all along.

    Parameters
    ----------
    values : (rows, cols) float32
    frames : (n, 2, 6) float64, of the LocalFrame at each indicated position
    centre : (n, 2) float64, the estimated INS errors [m]
    value : (n,) float64, the readings
    node : (k, 2) float64, offsets of the INS error [m]
    out : (k,) written: mean square about the mean, NaN where the map answers fewer than half of the readings
    """
    for k in range(len(node)):
        count, mean, square = 0, 0.0, 0.0
        for i in range(value.size):
            r, c = frames[i, 0], frames[i, 1]
            n, e = -centre[i, 0] - node[k, 0], -centre[i, 1] - node[k, 1]
            row = r[0] + n * (r[1] + r[3] * n + r[4] * e) + e * (r[2] + r[5] * e)
            col = c[0] + n * (c[1] + c[3] * n + c[4] * e) + e * (c[2] + c[5] * e)
            h = bilinear_at(values, row, col)
            if h == h:
                count += 1
                away = value[i] - h - mean
                mean += away / count
                square += away * (value[i] - h - mean)
        out[k] = square / count if 2 * count >= value.size else np.nan


@jit(forceinline=True)
def _log(x):
    """Natural logarithm of a normal number > 0 to 1e-11, without a branch: exponent, and the series of atanh."""
    bits = np.float64(x).view(np.int64)
    power = (bits - np.int64(0x3FE6A09E667F3BCD)) >> 52  # mantissa between sqrt(1/2) and sqrt(2)
    m = np.int64(bits - (power << 52)).view(np.float64)
    t = (m - 1.0) / (m + 1.0)
    s = t * t
    series = 1.0 / 7.0 + s * (1.0 / 9.0 + s * (1.0 / 11.0 + s * (1.0 / 13.0)))
    return np.float64(power) * 0.6931471805599453 + 2.0 * t * (1.0 + s * (1.0 / 3.0 + s * (1.0 / 5.0 + s * series)))


@jit(fastmath=SUMS)
def tail(north, east, weight, centre, outside):
    """How far a cloud reaches from its mean.

    Parameters
    ----------
    north, east, weight : (m,) the particles [m]; weights sum to one
    centre : (2,) [m]
    outside : float, the weight that may be left outside

    Returns
    -------
    core : median distance [m]
    reach : distance that leaves no more than `outside` outside, to 5 % on the safe side [m]
    far : weight beyond 7 times the median distance
    sigma2 : mean squared distance [m^2]
    """
    sigma2, n, e = 0.0, centre[0], centre[1]
    for k in range(weight.size):
        sigma2 += weight[k] * ((north[k] - n) * (north[k] - n) + (east[k] - e) * (east[k] - e))
    scale = 1e4 / max(sigma2, 1e-12)
    mass, base = np.zeros(BINS + 1), BINS - 1.0 - math.log(1e4 * 400.0) / (2.0 * STEP)
    at = np.empty(BLOCK, np.int64)
    for start in range(0, weight.size, BLOCK):
        stop = min(start + BLOCK, weight.size)
        one, two = north[start:stop], east[start:stop]
        for k in range(one.size):
            d2 = ((one[k] - n) * (one[k] - n) + (two[k] - e) * (two[k] - e)) * scale
            place = base + _log(d2 + 1e-12) * (0.5 / STEP)
            place = place if place > 0.0 else 0.0
            at[k] = np.int64(place if place < BINS else BINS)
        for k in range(one.size):
            mass[np.uint64(at[k])] += weight[start + k]
    below, core, reach, far = 0.0, 0.0, 0.0, 0.0
    for i in range(BINS + 1):
        edge = math.exp((i + 1.0 - base) * STEP) / math.sqrt(scale)
        if core > 0.0 and edge * math.exp(-STEP) > 7.0 * core:
            far += mass[i]
        below += mass[i]
        if core == 0.0 and below >= 0.5:
            core = edge
        if reach == 0.0 and below >= 1.0 - outside:
            reach = edge
    return core, reach, far, sigma2


@jit
def latest(values, count):
    """Of the latest values, at most `count`: their mean, NaN where there are none, and how many exceed 4."""
    start = max(values.size - count, 0)
    total, far = 0.0, 0
    for k in range(start, values.size):
        total += values[k]
        far += 1 if values[k] > 4.0 else 0
    return (total / (values.size - start) if values.size > 0 else np.nan), far


@jit
def clipped_mean(values, most):
    """Mean of values of which none counts for more than `most`; there is at least one."""
    total = 0.0
    for k in range(values.size):
        total += min(values[k], most)
    return total / values.size


@jit
def appended(rows, row, most, cap):
    """A window with one more reading, and its normalised innovations squared.

    Parameters
    ----------
    rows : (n, k) float64, residual and its variance first
    row : (k,) float64
    most : int, how many rows are kept
    cap : float, one NIS counts for no more

    Returns
    -------
    rows : (min(n + 1, most), k), nis : as many
    """
    n, k = rows.shape
    size = min(n + 1, most)
    out, nis = np.empty((size, k)), np.empty(size)
    for i in range(size - 1):
        out[i] = rows[n - size + 1 + i]
    out[size - 1] = row
    for i in range(size):
        nis[i] = min(out[i, 0] * out[i, 0] / out[i, 1], cap)
    return out, nis


@jit
def autocorrelation(rows, lags, most):
    """Correlation of the normalised residuals (rows[:, 0] over the root of rows[:, 1], clipped) at each lag from one.

    NaN where all residuals are zero.
    """
    n = len(rows)
    z, power = np.empty(n), 0.0
    for i in range(n):
        z[i] = min(max(rows[i, 0] / math.sqrt(rows[i, 1]), -most), most)
        power += z[i] * z[i]
    rho = np.zeros(lags)
    for lag in range(1, lags + 1):
        for i in range(lag, n):
            rho[lag - 1] += z[i] * z[i - lag]
        rho[lag - 1] = rho[lag - 1] / power if power > 0.0 else np.nan
    return rho

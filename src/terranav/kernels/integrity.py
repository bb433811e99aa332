"""Monitoring kernels: rival places that are weighed beside an estimate, and how far its posterior reaches."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.sampling import bilinear_at

BINS = 200  # of the distance from the mean, in steps of 5 %
STEP = 0.05
CLIP = 9.0  # one reading speaks for or against a place by at most half of this


@jit
def _at(values, frame, n, e):
    """Map value and slope (north, east) at n, e metres from the origin of a frame; NaN where the map is silent."""
    rows, cols = values.shape
    r, c = frame[0], frame[1]
    row = r[0] + n * (r[1] + r[3] * n + r[4] * e) + e * (r[2] + r[5] * e)
    col = c[0] + n * (c[1] + c[3] * n + c[4] * e) + e * (c[2] + c[5] * e)
    if not (row >= 0.0 and col >= 0.0 and row <= rows - 1.0 and col <= cols - 1.0):
        return bilinear_at(values, row, col), 0.0, 0.0
    i, j = min(int(row), rows - 2), min(int(col), cols - 2)
    u, v = row - i, col - j
    one, two, three, four = values[i, j], values[i, j + 1], values[i + 1, j], values[i + 1, j + 1]
    low, high = one + v * (two - one), three + v * (four - three)
    value = low + u * (high - low)
    if value != value:
        return bilinear_at(values, row, col), 0.0, 0.0
    by_row, by_col = high - low, (1.0 - u) * (two - one) + u * (four - three)
    return value, by_row * r[1] + by_col * c[1], by_row * r[2] + by_col * c[2]


@jit
def weigh_rivals(values, frame, origin, node, shift, bias, odds, recent, numbers, out):
    """One reading, weighed at the estimated place (the first node) and at its rivals.

    Every place is a Kalman filter of its own for the bias of the readings, and follows the slope of the map within its
    cell (a constant gain: least mean squares), so that a place that fits is not missed for lying between two nodes.

    Parameters
    ----------
    values : (rows, cols) float32
    frame : (2, 6) float64, of the LocalFrame at the indicated position
    origin : (2,) float64, the estimated INS error [m]
    node : (n, 2) float64, offsets of the rivals from it; the first is zero [m]
    shift : (n, 2) float64, how far each has followed the slope within its cell [m]
    bias : (n,) float64
    odds, recent : (n,) float64
        Logarithm of the likelihood ratio against the first, of all readings, and with fading memory.
    numbers : (7,) float64
        Reading; white variance; variance of the bias; variance of the place within a cell [m^2]; farthest that a rival
        may follow the slope [m]; least odds; fading.
    out : (shift, bias, odds, recent) of the same shapes, written
    """
    value, white, common, cell2, tether, least, fading = numbers
    new_shift, new_bias, new_odds, new_recent = out
    first = 0.0
    for k in range(odds.size):
        n = origin[0] + node[k, 0] + shift[k, 0]
        e = origin[1] + node[k, 1] + shift[k, 1]
        h, gn, ge = _at(values, frame, -n, -e)
        new_shift[k, 0], new_shift[k, 1], new_bias[k] = shift[k, 0], shift[k, 1], bias[k]
        if h != h:
            new_odds[k], new_recent[k] = odds[k], recent[k]
            continue
        r = value - h - bias[k]
        variance = white + common + (gn * gn + ge * ge) * cell2
        against = 0.5 * min(r * r / variance, CLIP)
        gain = r / variance if r * r < CLIP * variance else math.copysign(math.sqrt(CLIP / variance), r)
        new_bias[k] = bias[k] + common * gain
        if k == 0:
            first = against
        else:
            follow = gain * cell2  # h falls with the error: dr/dn = +gn
            new_shift[k, 0] = min(max(shift[k, 0] - follow * gn, -tether), tether)
            new_shift[k, 1] = min(max(shift[k, 1] - follow * ge, -tether), tether)
        new_odds[k] = max(odds[k] + first - against, least)
        new_recent[k] = fading * recent[k] + first - against
    new_odds[0], new_recent[0] = 0.0, 0.0


@jit
def reach_of_rivals(distance, order, odds, budget, near):
    """How far from the estimate the rivals that are not refuted reach.

    Parameters
    ----------
    distance : (n,) of each place [m]; the first is the estimate
    order : (n,) int, places by falling distance
    odds : (n,) log likelihood ratio against the estimate
    budget : float, probability that may be left out
    near : float, rivals nearer than this belong to the estimate's own surroundings [m]

    Returns
    -------
    reach : distance beyond which the rivals hold no more than the budget, 0 when those that are not near hold less
    share : probability of the rivals that are not near, each even odds with the estimate before any reading
    best : index of the likeliest rival that is not near, 0 when there is none
    """
    share, best = 0.0, 0
    for k in range(1, odds.size):
        if distance[k] > near:
            share += math.exp(odds[k])
            if best == 0 or odds[k] > odds[best]:
                best = k
    total = 1.0 + share
    beyond, reach = 0.0, 0.0
    for i in range(odds.size - 1):
        k = order[i]
        if distance[k] <= near:
            break
        beyond += math.exp(odds[k])
        if beyond > budget * total:
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
            h = _at(values, frames[i], -centre[i, 0] - node[k, 0], -centre[i, 1] - node[k, 1])[0]
            if h == h:
                count += 1
                away = value[i] - h - mean
                mean += away / count
                square += away * (value[i] - h - mean)
        out[k] = square / count if 2 * count >= value.size else np.nan


@jit
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
    sigma2 = 0.0
    for k in range(weight.size):
        sigma2 += weight[k] * ((north[k] - centre[0]) ** 2 + (east[k] - centre[1]) ** 2)
    scale = 1e4 / max(sigma2, 1e-12)
    mass, base = np.zeros(BINS + 1), BINS - 1.0 - math.log(1e4 * 400.0) / (2.0 * STEP)
    for k in range(weight.size):
        d2 = ((north[k] - centre[0]) ** 2 + (east[k] - centre[1]) ** 2) * scale
        at = base + math.log(d2 + 1e-12) / (2.0 * STEP)
        mass[max(0, min(BINS, int(at)))] += weight[k]
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

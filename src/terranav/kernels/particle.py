"""Particles: weigh by a reading, and resample without branches."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.sampling import bilinear_at


@jit
def weigh_cloud(values, frame, cloud, weight, reading, outliers, out):
    """Multiply the weights of INS errors by the likelihood of one reading and normalise.

    Parameters
    ----------
    values : (rows, cols) float32, the map, NaN where void
    frame : (2, 6) float64
        Row and column coefficients of the LocalFrame at the indicated position.
    cloud : (m, 2) float64 [m]
        INS errors north and east; the true place lies at minus the error.
    weight : (m,) float64, sums to one
    reading : (2,) float64, value and 1-sigma, map error included [unit]
    outliers : (2,) float64
        The reading is, with this probability, this many times noisier than told.
    out : (m,) float64, written

    Returns
    -------
    known : share of the weight on particles where the map says something
    nis : squared innovation over its predicted variance (1 on average), NaN when nothing is known
    effective : 1 / sum(w^2) of the new weights

    Particles where the map says nothing get the average likelihood of the others: a void neither attracts nor repels.
    """
    m = weight.size
    r0, r1, r2, r3, r4, r5 = frame[0]
    c0, c1, c2, c3, c4, c5 = frame[1]
    value, sigma = reading[0], reading[1]
    share, scale = outliers[0], outliers[1]
    known, mean, square, power = 0.0, 0.0, 0.0, 0.0
    for k in range(m):
        n, e = -cloud[k, 0], -cloud[k, 1]
        row = r0 + n * (r1 + r3 * n + r4 * e) + e * (r2 + r5 * e)
        col = c0 + n * (c1 + c3 * n + c4 * e) + e * (c2 + c5 * e)
        out[k] = bilinear_at(values, row, col) - value
    for k in range(m):
        d, p = out[k], weight[k]
        there = d == d
        known += p if there else 0.0
        mean += p * d if there else 0.0
        square += p * d * d if there else 0.0
        power += p * p
    if known <= 0.0:
        out[:] = weight
        return 0.0, np.nan, 1.0 / power
    mean /= known
    nis = mean * mean / (sigma * sigma + max(square / known - mean * mean, 0.0))
    narrow, wide = -0.5 / (sigma * sigma), -0.5 / (sigma * sigma * scale * scale)
    high, low = 1.0 - share, share / scale
    total = 0.0
    for k in range(m):
        d = out[k]
        likely = high * math.exp(narrow * d * d) + low * math.exp(wide * d * d)
        out[k] = weight[k] * likely
        total += out[k] if d == d else 0.0
    if total <= 1e-290:  # the reading contradicts every particle: it says nothing about which one is right
        out[:] = weight
        return known, nis, 1.0 / power
    average = total / known
    norm = 1.0 / (total + average * (1.0 - known))
    power = 0.0
    for k in range(m):
        p = out[k]
        p = norm * (p if p == p else weight[k] * average)
        out[k] = p
        power += p * p
    return known, nis, 1.0 / power


@jit
def systematic(weight, offset, out):
    """Systematic resampling: copy k is the particle in whose share of the unit interval (k + offset) / m lies.

    Each particle writes its number where its first copy would stand; one without copies is overwritten by the next.
    The running maximum fills in the other copies. No branch depends on the weights.

    Parameters
    ----------
    weight : (m,) float64, sums to one
    offset : float in [0, 1)
    out : (m,) int64, written
        The particle that each copy is made of, in increasing order.
    """
    m = weight.size
    slots = np.zeros(m + 1, np.int64)
    sum_before = 0.0
    for k in range(m):
        at = m * sum_before - offset
        first = int(at)
        first += at > first
        slots[min(first, m)] = k
        sum_before += weight[k]
    latest = 0
    for k in range(m):
        latest = max(latest, slots[k])
        out[k] = latest

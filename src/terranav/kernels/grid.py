"""Point-mass densities on a still grid: diffuse, weigh, measure. Arrays are (rows north, cols east), float64."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.sampling import bicubic_at

FLOOR = 1e-300  # densities below are zero: denormals cost time and mean nothing
OVERSHOOT = 0.7  # a cubic patch of the logarithm rises at most this much above the four cells around it


@jit
def diffuse(density, taps_north, taps_east, out):
    """Convolve `density` with the outer product of two odd-length symmetric tap arrays, zero outside the grid."""
    rows, cols = density.shape
    rn, re = taps_north.size // 2, taps_east.size // 2
    line = np.zeros(cols + 2 * re)
    for i in range(rows):
        middle = line[re : re + cols]
        middle[:] = 0.0
        for k in range(max(-rn, -i), min(rn, rows - 1 - i) + 1):
            tap = taps_north[k + rn]
            source = density[i + k]
            for j in range(cols):
                middle[j] += tap * source[j]
        target = out[i]
        target[:] = 0.0
        for k in range(2 * re + 1):
            tap = taps_east[k]
            shifted = line[k : k + cols]
            for j in range(cols):
                target[j] += tap * shifted[j]


@jit
def weigh(density, field, value, sigma, resolve, outlier_share, outlier_scale, out):
    """Multiply `density` by the likelihood of one reading and normalise.

    Parameters
    ----------
    density : (rows, cols), sums to one
    field : (rows, cols), the map at each cell, NaN where it says nothing
    value, sigma : the reading and its 1-sigma, map error included
    resolve : a likelihood ridge is never narrower than this many cells (1-sigma), so that the grid can carry it
    outlier_share, outlier_scale : the reading is, with this probability, this many times noisier than told
    out : (rows, cols), the new density

    Returns
    -------
    known : share of the prior density on cells where the map says something
    nis : squared innovation over its predicted variance (1 on average), NaN when nothing is known
    slope : root mean square change of the field over one cell, weighed by the new density

    Cells where the map says nothing get the average likelihood of the others: a void neither attracts nor repels.
    """
    rows, cols = density.shape
    known, mean, square = 0.0, 0.0, 0.0
    for i in range(rows):
        for j in range(cols):
            h = field[i, j]
            if h == h:
                p = density[i, j]
                known += p
                mean += p * (h - value)
                square += p * (h - value) * (h - value)
    if known <= 0.0:
        out[:] = density
        return 0.0, np.nan, 0.0
    mean /= known
    spread = max(square / known - mean * mean, 0.0)
    variance = sigma * sigma
    nis = mean * mean / (variance + spread)

    total, slope_sum = 0.0, 0.0
    for i in range(rows):
        above, below = min(i + 1, rows - 1), max(i - 1, 0)
        for j in range(cols):
            h = field[i, j]
            if h != h:
                continue
            east = field[i, min(j + 1, cols - 1)] - field[i, max(j - 1, 0)]
            north = field[above, j] - field[below, j]
            slope2 = 0.0  # squared change of the field over one cell
            if east == east:
                slope2 += 0.25 * east * east
            if north == north:
                slope2 += 0.25 * north * north
            s2 = max(variance, resolve * resolve * slope2)
            r2 = (h - value) * (h - value) / s2
            like = (1.0 - outlier_share) * math.exp(-0.5 * r2)
            if outlier_share > 0.0:
                like += outlier_share / outlier_scale * math.exp(-0.5 * r2 / (outlier_scale * outlier_scale))
            p = density[i, j] * like / math.sqrt(s2)
            out[i, j] = p
            total += p
            slope_sum += p * slope2
    if total <= 1e-290:  # the reading contradicts every cell: it says nothing about which one is right
        out[:] = density
        return known, nis, 0.0
    average = total / known
    norm = 1.0 / (total + average * (1.0 - known))
    for i in range(rows):
        for j in range(cols):
            h = field[i, j]
            p = (out[i, j] if h == h else density[i, j] * average) * norm
            out[i, j] = p if p > FLOOR else 0.0
    return known, nis, math.sqrt(slope_sum / total)


@jit
def measure(density, north, east):
    """Moments, marginals and fineness of a density on a grid.

    Returns
    -------
    moments : (5,) mean north, mean east, variance north, covariance, variance east
    rows_mass, cols_mass : marginals, (rows,) and (cols,)
    width : (2,) local width along rows and along columns [cells]: sqrt(sum p^2 / (2 sum (dp)^2)), which is sigma for a
        Gaussian and the width of the narrowest structure that carries weight otherwise
    """
    rows, cols = density.shape
    rows_mass, cols_mass = np.zeros(rows), np.zeros(cols)
    cross, power, step_n, step_e = 0.0, 0.0, 0.0, 0.0
    for i in range(rows):
        line = density[i]
        mass, moment = 0.0, 0.0
        for j in range(cols):
            p = line[j]
            mass += p
            moment += p * east[j]
            cols_mass[j] += p
            power += p * p
        for j in range(1, cols):
            d = line[j] - line[j - 1]
            step_e += d * d
        if i > 0:
            before = density[i - 1]
            for j in range(cols):
                d = line[j] - before[j]
                step_n += d * d
        rows_mass[i] = mass
        cross += moment * north[i]
    total = rows_mass.sum()
    mean_n = (rows_mass * north).sum() / total
    mean_e = (cols_mass * east).sum() / total
    var_n = (rows_mass * (north - mean_n) ** 2).sum() / total
    var_e = (cols_mass * (east - mean_e) ** 2).sum() / total
    moments = np.array([mean_n, mean_e, var_n, cross / total - mean_n * mean_e, var_e])
    tiny = 1e-300
    width = np.array([math.sqrt(power / (2.0 * step_n + tiny)), math.sqrt(power / (2.0 * step_e + tiny))])
    return moments, rows_mass / total, cols_mass / total, width


@jit
def resample(log_density, rows, cols, out):
    """Density at the lattice of fractional rows (p,) and columns (q,), zero outside the grid; out is (p, q).

    The cubic patch (Catmull-Rom, exact on quadratics) is laid through the logarithm, so that a Gaussian keeps its
    moments and its tails whatever the new cells. At the cliff of a cut-off the patch overshoots; OVERSHOOT limits that.
    """
    last_row, last_col = log_density.shape[0] - 1, log_density.shape[1] - 1
    for a in range(rows.size):
        for b in range(cols.size):
            value = bicubic_at(log_density, rows[a], cols[b])
            if np.isnan(value):
                out[a, b] = 0.0
                continue
            i = max(min(int(rows[a]), last_row - 1), 0)
            j = max(min(int(cols[b]), last_col - 1), 0)
            low = max(log_density[i, j], log_density[i, j + 1])
            high = max(log_density[i + 1, j], log_density[i + 1, j + 1])
            p = math.exp(min(value, max(low, high) + OVERSHOOT))
            out[a, b] = p if p > FLOOR else 0.0

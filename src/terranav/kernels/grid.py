"""Point-mass densities on a still grid: diffuse, weigh, measure. Arrays are (rows north, cols east), float64."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.fastmath import fast_exp
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
    variance, narrowest = sigma * sigma, resolve * resolve
    wide2, wide_share = -0.5 / (outlier_scale * outlier_scale), outlier_share / outlier_scale
    slope2, square = np.zeros(cols), np.zeros(cols)
    known, mean, spread, total, slope_sum = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(rows):
        line, prior, target = field[i], density[i], out[i]
        _slope2(line, field[max(i - 1, 0)], field[min(i + 1, rows - 1)], slope2)
        for j in range(cols):
            d = line[j] - value
            d = d if d == d else 0.0
            s2 = max(variance, narrowest * slope2[j])
            square[j] = d * d / s2
            target[j] = prior[j] / math.sqrt(s2)
        if outlier_share > 0.0:
            for j in range(cols):
                r2 = square[j]
                target[j] *= (1.0 - outlier_share) * fast_exp(-0.5 * r2) + wide_share * fast_exp(wide2 * r2)
        else:
            for j in range(cols):
                target[j] *= fast_exp(-0.5 * square[j])
        for j in range(cols):
            d = line[j] - value
            solid = d == d
            p = prior[j] if solid else 0.0
            d = d if solid else 0.0
            q = target[j] if solid else 0.0
            known += p
            mean += p * d
            spread += p * d * d
            total += q
            slope_sum += q * slope2[j]
    if known <= 0.0:
        out[:] = density
        return 0.0, np.nan, 0.0
    mean /= known
    nis = mean * mean / (variance + max(spread / known - mean * mean, 0.0))
    if total <= 1e-290:  # the reading contradicts every cell: it says nothing about which one is right
        out[:] = density
        return known, nis, 0.0
    void = total / known
    norm = 1.0 / (total + void * max(1.0 - known, 0.0))
    void *= norm
    for i in range(rows):
        line, prior, target = field[i], density[i], out[i]
        for j in range(cols):
            h = line[j]
            p = norm * target[j] if h == h else void * prior[j]
            target[j] = p if p > FLOOR else 0.0
    return known, nis, math.sqrt(slope_sum / total)


@jit
def _slope2(line, below, above, out):
    """Squared change of a field over one cell, along a line and across it; a difference with a void counts as none."""
    last = line.size - 1
    for j in range(1, last):
        east, north = 0.5 * (line[j + 1] - line[j - 1]), 0.5 * (above[j] - below[j])
        out[j] = (east * east if east == east else 0.0) + (north * north if north == north else 0.0)
    for j in (0, last):
        east, north = 0.5 * (line[min(j + 1, last)] - line[max(j - 1, 0)]), 0.5 * (above[j] - below[j])
        out[j] = (east * east if east == east else 0.0) + (north * north if north == north else 0.0)


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

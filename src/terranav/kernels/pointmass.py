"""One step of a point-mass filter in one pass over the grid: diffuse, look up the map, weigh, measure.

Each row is diffused, compared with the map and weighed while it lies in the first cache; the sums that normalise and
measure the density are taken on the way, and the new density is scaled at the end. Three rows of the map suffice for
its slope. Arrays are (rows north, cols east), float64. All kernels return, or end their answer with, a `summary`.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.fastmath import fast_exp2, fast_rsqrt
from terranav.kernels.jit import jit
from terranav.kernels.lattice import bilinear_row
from terranav.kernels.rows import SUMS, blur, blur_across, copy_padded, half_taps, measure_row, scale, total_of

TAIL = 1e-7  # mass beyond the support of a density that is given up on each side
LEAST_TOTAL = 1e-290  # of prior times likelihood; below, the reading contradicts every cell
UNSCALED = 1e-100  # of the same; below, squares of a density that is not yet normalised would vanish
_LOG2_E = 1.4426950408889634


@jit
def support(mass):
    """First and last index between which all but TAIL of a marginal lies on either side."""
    total, below, last = total_of(mass, 0, mass.size), 0.0, mass.size - 1
    low, high = 0, last
    while low < last and below + mass[low] <= TAIL * total:
        below += mass[low]
        low += 1
    above = 0.0
    while high > low and above + mass[high] <= TAIL * total:
        above += mass[high]
        high -= 1
    return low, high


@jit
def summary(place, rows_mass, cols_mass, sums):
    """What a density is like.

    Parameters
    ----------
    place : (south, west, cell) [m]
        Centre of cell (0, 0) and the cell's side.
    rows_mass, cols_mass : (rows,) and (cols,) marginals, of any sum
    sums : (cross moment about the middle of the grid, sum p^2, sum of the squared changes along columns, along rows)

    Returns
    -------
    mean_n, mean_e, var_n, cov, var_e : float [m], [m^2]
    width : float
        Least local width along rows and columns [cells]: sqrt(sum p^2 / (2 sum (dp)^2)), which is sigma for a Gaussian
        and the width of the narrowest structure that carries weight otherwise.
    south, north, west, east : int
        First and last row, first and last column of the `support`.
    """
    south, west, cell = place
    cross, power, step_n, step_e = sums
    total = total_of(rows_mass, 0, rows_mass.size)
    middle_n, middle_e = 0.5 * cell * (rows_mass.size - 1), 0.5 * cell * (cols_mass.size - 1)
    mean_n, var_n = _moments(rows_mass, cell, middle_n)
    mean_e, var_e = _moments(cols_mass, cell, middle_e)
    width = math.sqrt(power / (2.0 * max(step_n, step_e) + 1e-300 * total * total))
    low_n, high_n = support(rows_mass)
    low_e, high_e = support(cols_mass)
    mean = (south + middle_n + mean_n, west + middle_e + mean_e)
    return (*mean, var_n, cross / total - mean_n * mean_e, var_e, width, low_n, high_n, low_e, high_e)


@jit
def _moments(mass, cell, middle):
    """Mean from the middle of the axis, and variance."""
    total, first, second = 0.0, 0.0, 0.0
    for i in range(mass.size):
        total += mass[i]
        first += mass[i] * (cell * i - middle)
    mean = first / total
    for i in range(mass.size):
        second += mass[i] * (cell * i - middle - mean) ** 2
    return mean, second / total


@jit
def measured(density, place):
    """Summary of a density of any sum."""
    rows, cols = density.shape
    cell = place[2]
    rows_mass, cols_mass, east = np.empty(rows), np.zeros(cols), _from_middle(cols, cell)
    flat, cross, power, step_n, step_e = density.reshape(density.size), 0.0, 0.0, 0.0, 0.0
    for i in range(rows):
        mass, moment, p2, dn, de = measure_row(flat, i * cols, max(i - 1, 0) * cols, east, cols_mass)
        rows_mass[i] = mass
        cross += moment * cell * (i - 0.5 * (rows - 1))
        power, step_n, step_e = power + p2, step_n + dn, step_e + de
    return summary(place, rows_mass, cols_mass, (cross, power, step_n, step_e))


@jit
def border(density, band):
    """Mass in the outermost `band` rows and columns: south, north, west, east."""
    rows, cols = density.shape
    flat, west, east = density.reshape(density.size), 0.0, 0.0
    for i in range(rows):
        west += total_of(flat, i * cols, band)
        east += total_of(flat, (i + 1) * cols - band, band)
    south = total_of(flat, 0, band * cols)
    return south, total_of(flat, (rows - band) * cols, band * cols), west, east


@jit
def _from_middle(size, cell):
    """(size,) coordinates from the middle of an axis [m]."""
    out = np.empty(size)
    for j in range(size):
        out[j] = cell * (j - 0.5 * (size - 1))
    return out


@jit
def diffused(density, growth_n, growth_e, place, out):
    """Convolve a density with a Gaussian, zero outside the grid, and normalise it.

    Parameters
    ----------
    density : (rows, cols)
    growth_n, growth_e : variance along each axis [cells^2]
    place : as in `summary`
    out : (rows, cols), written

    Returns
    -------
    summary
    """
    rows, cols = density.shape
    taps_n, taps_e = half_taps(growth_n), half_taps(growth_e)
    margin = taps_e.size - 1
    line, total = np.zeros(cols + 2 * margin), 0.0
    source, target = density.reshape(density.size), out.reshape(out.size)
    for i in range(rows):
        blur_across(source, rows, i, taps_n, line, margin, cols)
        blur(line, margin, 1, taps_e, target, i * cols, cols)
        total += total_of(target, i * cols, cols)
    scale(target, 1.0 / total)
    return measured(out, place)


@jit(fastmath=SUMS, forceinline=True)
def _likelihood(d, slope2, law):
    """Density of a residual on a cell over which the map changes by the square root of 4 slope2."""
    variance, narrowest, near, near_0, wide, wide_0 = law
    s2 = narrowest * slope2
    precision = fast_rsqrt(s2 if s2 > variance else variance)
    u = d * precision
    r2 = u * u
    return precision * (fast_exp2(near * r2 + near_0) + fast_exp2(wide * r2 + wide_0))


@jit(fastmath=SUMS, forceinline=True)
def _likelihood_alone(d, slope2, law):
    """The same without outliers."""
    variance, narrowest, near, near_0, _, _ = law
    s2 = narrowest * slope2
    precision = fast_rsqrt(s2 if s2 > variance else variance)
    u = d * precision
    return precision * fast_exp2(near * (u * u) + near_0)


@jit(fastmath=SUMS)
def _weigh(prior, chart, at, value, law, out, first):
    """Prior times likelihood along a row without voids; chart[at[0]:] is the row of the map, then those beside it."""
    known, mean, spread, total, slope = 0.0, 0.0, 0.0, 0.0, 0.0
    here, below, above, one = np.uint64(at[0]), np.uint64(at[1]), np.uint64(at[2]), np.uint64(1)
    start = np.uint64(first)
    for j in range(prior.size):
        k = np.uint64(j)
        east, north = chart[here + k + one] - chart[here + k - one], chart[above + k] - chart[below + k]
        slope2 = east * east + north * north
        p, d = prior[j], chart[here + k] - value
        q = p * _likelihood(d, slope2, law)
        out[start + k] = q
        pd = p * d
        known += p
        mean += pd
        spread += pd * d
        total += q
        slope += q * slope2
    return known, mean, spread, total, slope, 0.0


@jit(fastmath=SUMS)
def _weigh_alone(prior, chart, at, value, law, out, first):
    """`_weigh` without outliers."""
    known, mean, spread, total, slope = 0.0, 0.0, 0.0, 0.0, 0.0
    here, below, above, one = np.uint64(at[0]), np.uint64(at[1]), np.uint64(at[2]), np.uint64(1)
    start = np.uint64(first)
    for j in range(prior.size):
        k = np.uint64(j)
        east, north = chart[here + k + one] - chart[here + k - one], chart[above + k] - chart[below + k]
        slope2 = east * east + north * north
        p, d = prior[j], chart[here + k] - value
        q = p * _likelihood_alone(d, slope2, law)
        out[start + k] = q
        pd = p * d
        known += p
        mean += pd
        spread += pd * d
        total += q
        slope += q * slope2
    return known, mean, spread, total, slope, 0.0


@jit(fastmath=SUMS)
def _weigh_voids(prior, chart, at, value, law, out, first):
    """`_weigh` where voids are near: a difference with one counts as none, and a void cell keeps minus its prior."""
    known, mean, spread, total, slope, missing = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    here, below, above, one = np.uint64(at[0]), np.uint64(at[1]), np.uint64(at[2]), np.uint64(1)
    start = np.uint64(first)
    alone = law[5] == -np.inf
    for j in range(prior.size):
        k = np.uint64(j)
        east, north = chart[here + k + one] - chart[here + k - one], chart[above + k] - chart[below + k]
        slope2 = (east * east if east == east else 0.0) + (north * north if north == north else 0.0)
        p, d = prior[j], chart[here + k] - value
        if d == d:
            q = p * (_likelihood_alone(d, slope2, law) if alone else _likelihood(d, slope2, law))
            out[start + k] = q
            known += p
            mean += p * d
            spread += p * d * d
            total += q
            slope += q * slope2
        else:
            out[start + k] = -p
            missing += p
    return known, mean, spread, total, slope, missing


@jit
def _law(sigma, resolve, share, scale):
    """Constants of `_likelihood`: exponents to base 2, with the shares of ordinary and wild readings in them."""
    near = -0.5 * _LOG2_E
    near_0 = math.log(1.0 - share) * _LOG2_E
    wide_0 = math.log(share / scale) * _LOG2_E if share > 0.0 else -np.inf
    return sigma * sigma, 0.25 * resolve * resolve, near, near_0, near / (scale * scale), wide_0


@jit
def _finish(out, voids, known, total, missing):
    """Normalise; cells where the map says nothing get the average likelihood of the others."""
    void = total / known
    norm = 1.0 / (total + void * missing)
    if voids:
        flat = out.reshape(out.size)
        for k in range(flat.size):
            if flat[k] < 0.0:
                flat[k] *= -void
    scale(out.reshape(out.size), norm)


@jit(forceinline=True)
def _weighed(prior, chart, at, near_void, value, law, out, first):
    """One row by the shortest of the three ways."""
    if near_void:
        return _weigh_voids(prior, chart, at, value, law, out, first)
    if law[5] == -np.inf:
        return _weigh_alone(prior, chart, at, value, law, out, first)
    return _weigh(prior, chart, at, value, law, out, first)


@jit
def advance(density, growth_n, growth_e, place, values, frame, reading, out):
    """Diffuse a density and multiply it by the likelihood of one reading: Bayes' rule, normalised.

    Parameters
    ----------
    density : (rows, cols), of any sum
    growth_n, growth_e : variance of the diffusion along each axis [cells^2]
    place : as in `summary`
    values : the map, as in `lattice.bilinear_lattice`
    frame : (row6, col6), as there; cell (i, j) has an INS error, so that its place is that far south and west
    reading : (value, sigma, resolve, outlier_share, outlier_scale)
        The reading and its 1-sigma, map error included; a likelihood ridge is never narrower than `resolve` cells
        (1-sigma), so that the grid can carry it; the reading is, with probability share, scale times noisier than told.
    out : (rows, cols), the new density

    Returns
    -------
    known : share of the diffused density on cells where the map says something
    nis : squared innovation over its predicted variance (1 on average), NaN when nothing is known
    slope : root mean square change of the field over one cell, weighed by the new density
    summary of the new density

    Cells where the map says nothing get the average likelihood of the others: a void neither attracts nor repels. A
    reading that is off the map, or contradicts every cell, leaves the diffused density as it is.
    """
    rows, cols = density.shape
    south, _, cell = place
    taps_n, taps_e, law = half_taps(growth_n), half_taps(growth_e), _law(*reading[1:])
    margin, width = taps_e.size - 1, cols + 2
    line, prior, blend = np.zeros(cols + 2 * margin), np.empty(cols), np.empty(values.shape[1])
    row, source, target = np.empty(cols), density.reshape(density.size), out.reshape(out.size)
    east = _from_middle(cols, cell)
    minus_east = -(place[1] + 0.5 * cell * (cols - 1)) - east
    chart, void = np.empty(3 * width), np.zeros(3, np.bool_)  # rows of the map, row i at place i % 3
    rows_mass, cols_mass = np.empty(rows), np.zeros(cols)
    known, mean, spread, total, slope, missing = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    cross, power, step_n, step_e, voids = 0.0, 0.0, 0.0, 0.0, False
    bilinear_row(values, frame[0], frame[1], -south, minus_east, blend, row)
    void[0] = copy_padded(row, chart, 0)
    for i in range(rows):
        before, after = max(i - 1, 0), min(i + 1, rows - 1)
        if after > i:
            bilinear_row(values, frame[0], frame[1], -(south + cell * after), minus_east, blend, row)
            void[after % 3] = copy_padded(row, chart, after % 3 * width)
        blur_across(source, rows, i, taps_n, line, margin, cols)
        blur(line, margin, 1, taps_e, prior, 0, cols)
        at = (i % 3 * width + 1, before % 3 * width + 1, after % 3 * width + 1)
        near_void = void[i % 3] or void[before % 3] or void[after % 3]
        sums = _weighed(prior, chart, at, near_void, reading[0], law, target, i * cols)
        known, mean, spread, total = known + sums[0], mean + sums[1], spread + sums[2], total + sums[3]
        slope, missing, voids = slope + sums[4], missing + sums[5], voids or near_void
        if not voids:
            mass, moment, p2, dn, de = measure_row(target, i * cols, before * cols, east, cols_mass)
            rows_mass[i] = mass
            cross += moment * cell * (i - 0.5 * (rows - 1))
            power, step_n, step_e = power + p2, step_n + dn, step_e + de
    if known <= 0.0:
        return (0.0, np.nan, 0.0, *diffused(density, growth_n, growth_e, place, out))
    mean /= known
    nis = mean * mean / (law[0] + max(spread / known - mean * mean, 0.0))
    share = known / (known + missing)
    if total <= LEAST_TOTAL * (known + missing):  # it says nothing about which cell is right
        return (share, nis, 0.0, *diffused(density, growth_n, growth_e, place, out))
    _finish(out, voids, known, total, missing)
    slope = 0.5 * math.sqrt(slope / total)
    if voids or total < UNSCALED:
        return (share, nis, slope, *measured(out, place))
    return (share, nis, slope, *summary(place, rows_mass, cols_mass, (cross, power, step_n, step_e)))

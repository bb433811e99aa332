"""What a density on a grid is like: moments, marginals, local width; and the same after a diffusion.

Arrays are (rows north, cols east), float64. All kernels but `border` return a `summary`.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.rows import BLOCK, blur, blur_block, half_taps, measure_row, scale, total_of

TAIL = 1e-7  # mass beyond the support of a density that is given up on each side


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
    rows_mass, cols_mass, east, line = np.empty(rows), np.zeros(cols), from_middle(cols, cell), np.empty(cols)
    flat, cross, power, step_n, step_e = density.reshape(density.size), 0.0, 0.0, 0.0, 0.0
    for i in range(rows):
        mass, moment, p2, dn, de = measure_row(flat, i * cols, max(i - 1, 0) * cols, east, cols_mass, line, 0)
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
def from_middle(size, cell):
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
    margin, total = taps_e.size - 1, 0.0
    width = cols + margin
    line = np.zeros(margin + BLOCK * width)
    source, target = density.reshape(density.size), out.reshape(out.size)
    for i in range(0, rows, BLOCK):
        count = min(BLOCK, rows - i)
        blur_block(source, rows, i, count, taps_n, line, margin, width, cols)
        for r in range(count):
            blur(line, margin + r * width, 1, taps_e, target, (i + r) * cols, cols)
        total += total_of(target, i * cols, count * cols)
    scale(target, 1.0 / total)
    return measured(out, place)

"""What a grid of cells, weighed by a density, says of one reading before any of them is chosen."""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit

# sums in several lanes, the same ones each time, and no NaN among the terms
SUMS = {"contract", "reassoc"}
ONE = np.uint64(1)  # an unsigned index needs no test for a negative one


@jit(fastmath=SUMS)
def _line(heights, prior, value, i, above, below):
    """Sums over one row of cells; above and below are its neighbours, twice itself at the rim."""
    y, north, south = np.uint64(i), np.uint64(above), np.uint64(below)
    across = 0.5 if above - below == 2 else 1.0
    known, first, second, change, sloped = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(1, heights.shape[1] - 1):
        k = np.uint64(j)
        p, d = prior[y, k], heights[y, k] - value
        dn, de = across * (heights[north, k] - heights[south, k]), 0.5 * (heights[y, k + ONE] - heights[y, k - ONE])
        square = 0.5 * (dn * dn + de * de)
        here, around = d == d, square == square
        p_here, p_around = (p if here else 0.0), (p if around else 0.0)
        pd = p_here * (d if here else 0.0)
        known += p_here
        first += pd
        second += pd * (d if here else 0.0)
        change += p_around * (square if around else 0.0)
        sloped += p_around
    return known, first, second, change, sloped


@jit
def _end(heights, prior, value, i, above, below, j):
    """`_line` of its first or last cell, where the slope along the row is one-sided."""
    east = j + 1 if j == 0 else j
    across = 0.5 if above - below == 2 else 1.0
    p, d = prior[i, j], heights[i, j] - value
    dn, de = across * (heights[above, j] - heights[below, j]), heights[i, east] - heights[i, east - 1]
    square = 0.5 * (dn * dn + de * de)
    known = p if d == d else 0.0
    sloped = p if square == square else 0.0
    if d != d:
        d = 0.0
    if square != square:
        square = 0.0
    return known, known * d, known * d * d, sloped * square, sloped


@jit
def compared(heights, prior, value):
    """How a reading differs from the heights of all cells, weighed by a density, and how these change between cells.

    Parameters
    ----------
    heights : (p, q) float64, both sizes >= 2, NaN where there is none
    prior : (p, q) float64
    value : float

    Returns
    -------
    known : mass of the cells that have a height
    first, second : sums over them of density times height less value, and its square
    change, sloped : sum of density times the mean square of the change to the next cell per axis (by central
        differences, one-sided at the rim) over the cells where it is known, and their mass
    """
    rows, cols = heights.shape
    known, first, second, change, sloped = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(rows):
        above, below = min(i + 1, rows - 1), max(i - 1, 0)
        for part in (
            _end(heights, prior, value, i, above, below, 0),
            _line(heights, prior, value, i, above, below),
            _end(heights, prior, value, i, above, below, cols - 1),
        ):
            known, first, second = known + part[0], first + part[1], second + part[2]
            change, sloped = change + part[3], sloped + part[4]
    return known, first, second, change, sloped

"""One step of a point-mass filter in one pass over the grid: diffuse, look up the map, weigh, measure.

A few rows at a time are diffused, compared with the map and weighed while they lie in the first cache; the sums that
normalise and measure the density are taken on the way, and the new density is scaled at the end.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.density import diffused, from_middle, measured, summary
from terranav.kernels.jit import jit
from terranav.kernels.lattice import bilinear_lattice
from terranav.kernels.rows import BLOCK, blur, blur_block, copy_row, half_taps, measure_row, scale
from terranav.kernels.weighing import even_law, law_of, weighed

LOOKED_UP = 16  # rows of the map fetched at once, a multiple of BLOCK
LEAST_TOTAL = 1e-290  # of prior times likelihood; below, the reading contradicts every cell
UNSCALED = 1e-100  # of the same; below, squares of a density that is not yet normalised would vanish


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


@jit
def _with_ends(west, cell, cols, width):
    """West of a row of `width` places: the first cell twice, the cells, the last as often as there is room."""
    out = np.empty(width)
    for j in range(width):
        out[j] = -(west + cell * min(max(j - 1, 0), cols - 1))
    return out


@jit
def _look_up(values, frame, i, south, east, chart):
    """Rows i - 1 .. i + LOOKED_UP of the map into `chart`, whose last two rows were rows i - 1 and i."""
    rows = south.size
    if i == 0:
        bilinear_lattice(values, frame[0], frame[1], south[:1], east, chart[1:2])
        chart[0] = chart[1]
    else:
        chart[:2] = chart[LOOKED_UP:]
    count = min(LOOKED_UP, rows - 1 - i)
    bilinear_lattice(values, frame[0], frame[1], south[i + 1 : i + 1 + count], east, chart[2 : 2 + count])
    if count < LOOKED_UP:
        chart[2 + count] = chart[1 + count]


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
    cell, taps_n, taps_e, law = place[2], half_taps(growth_n), half_taps(growth_e), law_of(*reading[1:])
    margin, laws = taps_e.size - 1, (law, even_law(law))
    width = cols + max(margin, 2)  # of a row with room for what it takes on either side
    line, prior = np.zeros(margin + BLOCK * width + margin), np.zeros(BLOCK * width)
    fresh, slopes = np.zeros((BLOCK + 1) * width), np.empty(BLOCK * width)  # the first row of fresh is the one before
    room = np.zeros((LOOKED_UP + 2) * width + 2)
    chart = room[: (LOOKED_UP + 2) * width].reshape(LOOKED_UP + 2, width)
    source, target, east = density.reshape(density.size), out.reshape(out.size), from_middle(cols, cell)
    south, west = -(place[0] + cell * np.arange(rows)), _with_ends(place[1], cell, cols, width)
    rows_mass, cols_mass = np.empty(rows), np.zeros(cols)
    known, mean, spread, total, slope, missing = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    cross, power, step_n, step_e, voids = 0.0, 0.0, 0.0, 0.0, False
    for i in range(0, rows, BLOCK):
        count = min(BLOCK, rows - i)
        if i % LOOKED_UP == 0:
            _look_up(values, frame, i, south, west, chart)
        blur_block(source, rows, i, count, taps_n, line, margin, width, cols)
        blur(line, margin, 1, taps_e, prior, 0, count * width)
        for r in range(count):
            prior[r * width + cols : (r + 1) * width] = 0.0
        first = 1 + i % LOOKED_UP * width
        sums = weighed(prior, room, first, width, slopes, reading[0], laws, fresh, width, count * width)
        known, mean, spread, total = known + sums[0], mean + sums[1], spread + sums[2], total + sums[3]
        slope, missing, voids = slope + sums[4], missing + max(sums[5], 0.0), voids or sums[5] >= 0.0
        for r in range(count):
            at = (r + 1) * width
            if voids:
                copy_row(fresh, at, target, (i + r) * cols, cols)
                continue
            before = at if i + r == 0 else at - width
            mass, moment, p2, dn, de = measure_row(fresh, at, before, east, cols_mass, target, (i + r) * cols)
            rows_mass[i + r] = mass
            cross += moment * cell * (i + r - 0.5 * (rows - 1))
            power, step_n, step_e = power + p2, step_n + dn, step_e + de
        copy_row(fresh, BLOCK * width, fresh, 0, cols)
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

"""Functions on a still grid: convolve, and carry to another grid. Arrays are (rows north, cols east), float64."""

from __future__ import annotations

import numpy as np

from terranav.kernels.fastmath import fast_exp, fast_log
from terranav.kernels.jit import jit
from terranav.kernels.rows import FLOOR, SUMS, blur, blur_across, scale, total_of
from terranav.kernels.sampling import SLACK

__all__ = ["FLOOR", "diffuse", "regrid", "resample"]

OVERSHOOT = 0.7  # a cubic patch of the logarithm rises at most this much above the four cells around it


@jit
def _half(taps):
    """Middle and one side of symmetric taps, with zeros up to 0, 1 or a multiple of four on the side."""
    radius = taps.size // 2
    out = np.zeros(1 + (radius if radius < 2 else 4 * ((radius + 3) // 4)))
    out[: radius + 1] = taps[radius:]
    return out


@jit
def diffuse(density, taps_north, taps_east, out):
    """Convolve `density` with the outer product of two odd-length symmetric tap arrays, zero outside the grid."""
    rows, cols = density.shape
    north, east = _half(taps_north), _half(taps_east)
    margin = east.size - 1
    line, source, target = np.zeros(cols + 2 * margin), density.reshape(density.size), out.reshape(out.size)
    for i in range(rows):
        blur_across(source, rows, i, north, line, margin, cols)
        blur(line, margin, 1, east, target, i * cols, cols)


@jit
def _places(at, size):
    """Of places along an axis of so many cells: whether inside, the first of four cells around, and their weights.

    Catmull-Rom: Keys, IEEE Trans. ASSP-29 (1981), eq. 4 with a = -1/2. The cells before the first and after the last
    are the straight continuation of the two within, which is put into the weights of those.
    """
    inside, first, weights = np.empty(at.size, np.bool_), np.empty(at.size, np.int64), np.empty((4, at.size))
    for k in range(at.size):
        inside[k] = at[k] >= -SLACK and at[k] <= size - 1.0 + SLACK
        place = min(max(at[k], 0.0), size - 1.0)
        first[k] = min(int(place), size - 2)
        t = place - first[k]
        before, here = t * (-0.5 + t * (1.0 - 0.5 * t)), 1.0 + t * t * (-2.5 + 1.5 * t)
        after, beyond = t * (0.5 + t * (2.0 - 1.5 * t)), t * t * (-0.5 + 0.5 * t)
        if first[k] == 0:
            here, after, before = here + 2.0 * before, after - before, 0.0
        if first[k] == size - 2:
            here, after, beyond = here - beyond, after + 2.0 * beyond, 0.0
        weights[0, k], weights[1, k], weights[2, k], weights[3, k] = before, here, after, beyond
    return inside, first, weights


@jit(fastmath=SUMS)
def _across(flat, rows, cols, i, weights, line, highest):
    """Cubic patch of the rows i - 1 .. i + 2 into line[1:], and the higher of rows i and i + 1."""
    w0, w1, w2, w3 = weights
    before, here = np.uint64(max(i - 1, 0) * cols), np.uint64(i * cols)
    after, beyond = np.uint64((i + 1) * cols), np.uint64(min(i + 2, rows - 1) * cols)
    for j in range(cols):
        k = np.uint64(j)
        low, high = flat[here + k], flat[after + k]
        line[k + np.uint64(1)] = w0 * flat[before + k] + w1 * low + w2 * high + w3 * flat[beyond + k]
        highest[k] = low if low > high else high


@jit(fastmath=SUMS)
def _along(line, highest, first, weights, out, at):
    """Exponential of the cubic patch along a line, held at most OVERSHOOT above the cells around it."""
    start = np.uint64(at)
    for j in range(first.size):
        k = np.uint64(first[j])
        near = weights[1, j] * line[k + np.uint64(1)] + weights[2, j] * line[k + np.uint64(2)]
        value = near + weights[0, j] * line[k] + weights[3, j] * line[k + np.uint64(3)]
        west, east = highest[k], highest[k + np.uint64(1)]
        limit = (west if west > east else east) + OVERSHOOT
        p = fast_exp(value if value < limit else limit)
        out[start + np.uint64(j)] = p if p > FLOOR else 0.0


@jit
def resample(log_density, rows, cols, out):
    """Density at the lattice of fractional rows (p,) and columns (q,), zero outside the grid; out is (p, q).

    The cubic patch (Catmull-Rom, exact on quadratics) is laid through the logarithm, so that a Gaussian keeps its
    moments and its tails whatever the new cells. At the cliff of a cut-off the patch overshoots; OVERSHOOT limits that.
    Only finite numbers may be in log_density.
    """
    height, width = log_density.shape
    on_row, row, by_row = _places(rows, height)
    on_col, col, by_col = _places(cols, width)
    line, highest = np.zeros(width + 3), np.empty(width)
    source, target = log_density.reshape(log_density.size), out.reshape(out.size)
    for a in range(rows.size):
        if on_row[a]:
            weights = (by_row[0, a], by_row[1, a], by_row[2, a], by_row[3, a])
            _across(source, height, width, row[a], weights, line, highest)
            _along(line, highest, col, by_col, target, a * cols.size)
            for b in range(cols.size):
                if not on_col[b]:
                    out[a, b] = 0.0
        else:
            out[a] = 0.0


@jit
def regrid(density, rows, cols, out):
    """`resample` a density, and normalise it."""
    source, logarithm = density.reshape(density.size), np.empty_like(density)
    flat, target = logarithm.reshape(density.size), out.reshape(out.size)
    for k in range(source.size):
        p = source[k]
        flat[k] = fast_log(p if p > FLOOR else FLOOR)
    resample(logarithm, rows, cols, out)
    scale(target, 1.0 / total_of(target, 0, target.size))

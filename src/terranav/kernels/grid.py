"""Functions on a still grid: convolve, and carry to another grid. Arrays are (rows north, cols east), float64."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.rows import FLOOR, blur, blur_across
from terranav.kernels.sampling import bicubic_at

__all__ = ["FLOOR", "diffuse", "resample"]

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

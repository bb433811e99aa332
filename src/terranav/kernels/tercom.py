"""The correlation surface of a profile: how badly each position error on a lattice fits the readings."""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.lattice import bilinear_lattice


@jit
def correlation_surface(values, frames, readings, lattice, absolute, remove_mean, score, valid):
    """Weighted mean squared or absolute difference between a profile and the map at every position error.

    With d[k] = reading[k] - map(place k of this error), over the points that have a map value:
    sum(w d^2) / sum(w), or sum(w |d|) / sum(w); d less its weighted mean when `remove_mean`.

    Parameters
    ----------
    values : (rows, cols) float32, NaN where void
    frames : (n, 2, 6) float64
        Per point of the profile the row and column coefficients of the LocalFrame at its indicated position.
    readings : (n, 2) float64
        Value [unit] and weight of each.
    lattice : (north (p,), east (q,)) float64 [m]
        Position errors; a point's true place lies at minus the error.
    absolute, remove_mean : bool
    score : (p, q) float64, written
        [unit^2], or [unit] when `absolute`; NaN where no point has a map value.
    valid : (p, q) float64, written
        Share of the points that have a map value.
    """
    place_north, place_east = -lattice[0], -lattice[1]
    n, q = readings.shape[0], place_east.size
    difference = np.empty((n, q))  # of one row of the lattice: stays in the cache for all passes
    weight, centre = np.empty(q), np.empty(q)
    for i in range(place_north.size):
        place = place_north[i : i + 1]
        count, total = valid[i], score[i]
        count[:], total[:], weight[:], centre[:] = 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            line, value, w = difference[k], readings[k, 0], readings[k, 1]
            bilinear_lattice(values, frames[k, 0], frames[k, 1], place, place_east, difference[k : k + 1])
            for j in range(q):
                line[j] = value - line[j]
                known = 1.0 if line[j] == line[j] else 0.0
                weight[j] += w * known
                count[j] += known
        if remove_mean:
            for k in range(n):
                line, w = difference[k], readings[k, 1]
                for j in range(q):
                    centre[j] += w * line[j] if line[j] == line[j] else 0.0
            centre /= weight
        for k in range(n):
            line, w = difference[k], readings[k, 1]
            for j in range(q):
                d = line[j] - centre[j]
                cost = w * (abs(d) if absolute else d * d)
                total[j] += cost if d == d else 0.0
        for j in range(q):
            total[j] /= weight[j]
            count[j] /= n

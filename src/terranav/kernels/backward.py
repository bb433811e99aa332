"""Backward simulation: which particle of a cloud a later state came from, with the moments that need no drawing."""

from __future__ import annotations

import numpy as np

from terranav.kernels.fastmath import fast_exp
from terranav.kernels.jit import jit

NEGLIGIBLE = 1e-7  # a particle below this share of the heaviest one adds nothing to the moments


@jit
def trace_back(weight, rows, predicted, target, uniform, chosen, mean, passed):
    """For every trajectory: P(particle i | later state) ~ weight[i] exp(-|predicted[i] - target[j]|^2 / 2).

    Parameters
    ----------
    weight : (n,) float64, of the particles
    rows : (n, d) float64, the particles
    predicted : (r, n) float64, the particles carried forward to the time of the later state, whitened, axis by axis
    target : (m, r) float64, the later states of the m trajectories, whitened likewise
    uniform : (m,) float64 in [0, 1)
    chosen : (m,) int64, written: the particle drawn
    mean : (m, d) float64, written: mean of the rows under those probabilities
    passed : (n,) float64, written: the probabilities averaged over the trajectories

    Returns
    -------
    nearest : (m,) float64, smallest |predicted - target|^2
    """
    n, d = rows.shape
    m, r = target.shape
    nearest, share = np.empty(m), np.empty(n)
    kept, centre = np.empty(n, np.int64), np.empty(d)
    passed[:] = 0.0
    for j in range(m):
        share[:] = 0.0
        for a in range(r):
            at, axis = target[j, a], predicted[a]
            for i in range(n):
                step = axis[i] - at
                share[i] += step * step
        least = np.inf
        for i in range(n):
            least = share[i] if share[i] < least else least
        for i in range(n):
            share[i] = weight[i] * fast_exp(0.5 * (least - share[i]))
        heaviest = 0.0
        for i in range(n):
            heaviest = share[i] if share[i] > heaviest else heaviest
        count, total, floor = 0, 0.0, NEGLIGIBLE * heaviest
        for i in range(n):
            if share[i] >= floor:
                kept[count] = i
                count += 1
                total += share[i]
        nearest[j] = least
        level, reached, found = uniform[j] * total, 0.0, -1
        centre[:] = 0.0
        for k in range(count):
            i = kept[k]
            p = share[i]
            reached += p
            if found < 0 and reached > level:
                found = i
            p /= total
            passed[i] += p / m
            for a in range(d):
                centre[a] += p * rows[i, a]
        chosen[j] = found if found >= 0 else kept[count - 1]
        mean[j] = centre
    return nearest

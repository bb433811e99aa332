"""Prior times likelihood of one reading, on a block of rows of a grid laid flat.

The rows lie `width` apart, with room between them that holds no mass; those of the map begin with the one before the
block and repeat their end cells on either side, so that the slope is that of central differences, halved at the edge.
Exponents are to base 2, with the shares of ordinary and wild readings in them.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.fastmath import fast_exp2, fast_rsqrt
from terranav.kernels.jit import jit
from terranav.kernels.rows import SUMS

_LOG2_E = 1.4426950408889634


@jit
def law_of(sigma, resolve, share, scale):
    """Constants of `_likelihood`: exponents to base 2, with the shares of ordinary and wild readings in them."""
    near = -0.5 * _LOG2_E
    near_0 = math.log(1.0 - share) * _LOG2_E
    wide_0 = math.log(share / scale) * _LOG2_E if share > 0.0 else -np.inf
    return sigma * sigma, 0.25 * resolve * resolve, near, near_0, near / (scale * scale), wide_0


@jit
def even_law(law):
    """The constants of a likelihood that is nowhere widened: its precision in the exponents."""
    variance, _, near, near_0, wide, wide_0 = law
    precision = -0.5 * math.log(variance) * _LOG2_E
    return near / variance, near_0 + precision, wide / variance, wide_0 + precision


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
def _slopes(prior, chart, first, width, law, out, size):
    """4 slope2 of a block; on how many of its cells with any mass the likelihood is widened; whether voids are near.

    The rows of the map lie `width` apart, the one before the block at chart[first:].
    """
    below, above, one, steep, total = np.uint64(first), np.uint64(first + 2 * width), np.uint64(1), 0, 0.0
    here, variance, narrowest = np.uint64(first + width), law[0], law[1]
    for j in range(size):
        k = np.uint64(j)
        east, north = chart[here + k + one] - chart[here + k - one], chart[above + k] - chart[below + k]
        slope2 = east * east + north * north
        out[k] = slope2
        steep += 1 if (narrowest * slope2 > variance) & (prior[k] > 0.0) else 0
        total += slope2 + chart[here + k]
    return steep, np.isnan(total)


@jit(fastmath=SUMS)
def _weigh(prior, chart, here, slopes, value, law, out, at, size):
    """Prior times likelihood of a block without voids."""
    known, mean, spread, total, slope = 0.0, 0.0, 0.0, 0.0, 0.0
    here, at = np.uint64(here), np.uint64(at)
    for j in range(size):
        k = np.uint64(j)
        p, d, slope2 = prior[k], chart[here + k] - value, slopes[k]
        q = p * _likelihood(d, slope2, law)
        out[at + k] = q
        pd = p * d
        known += p
        mean += pd
        spread += pd * d
        total += q
        slope += q * slope2
    return known, mean, spread, total, slope, -1.0


@jit(fastmath=SUMS)
def _weigh_even(prior, chart, here, slopes, value, law, out, at, size):
    """`_weigh` where the likelihood is nowhere widened."""
    known, mean, spread, total, slope = 0.0, 0.0, 0.0, 0.0, 0.0
    near, near_0, wide, wide_0 = law
    here, at = np.uint64(here), np.uint64(at)
    for j in range(size):
        k = np.uint64(j)
        p, d, slope2 = prior[k], chart[here + k] - value, slopes[k]
        r2 = d * d
        q = p * (fast_exp2(near * r2 + near_0) + fast_exp2(wide * r2 + wide_0))
        out[at + k] = q
        pd = p * d
        known += p
        mean += pd
        spread += pd * d
        total += q
        slope += q * slope2
    return known, mean, spread, total, slope, -1.0


@jit(fastmath=SUMS)
def _weigh_alone(prior, chart, here, slopes, value, law, out, at, size):
    """`_weigh` without outliers."""
    known, mean, spread, total, slope = 0.0, 0.0, 0.0, 0.0, 0.0
    here, at = np.uint64(here), np.uint64(at)
    for j in range(size):
        k = np.uint64(j)
        p, d, slope2 = prior[k], chart[here + k] - value, slopes[k]
        q = p * _likelihood_alone(d, slope2, law)
        out[at + k] = q
        pd = p * d
        known += p
        mean += pd
        spread += pd * d
        total += q
        slope += q * slope2
    return known, mean, spread, total, slope, -1.0


@jit(fastmath=SUMS)
def _weigh_voids(prior, chart, first, width, value, law, out, at, size):
    """`_weigh` where voids are near: a difference with one counts as none, and a void cell keeps minus its prior."""
    known, mean, spread, total, slope, missing = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    below, here, above = np.uint64(first), np.uint64(first + width), np.uint64(first + 2 * width)
    one, at = np.uint64(1), np.uint64(at)
    alone = law[5] == -np.inf
    for j in range(size):
        k = np.uint64(j)
        east, north = chart[here + k + one] - chart[here + k - one], chart[above + k] - chart[below + k]
        slope2 = (east * east if east == east else 0.0) + (north * north if north == north else 0.0)
        p, d = prior[k], chart[here + k] - value
        if d == d:
            q = p * (_likelihood_alone(d, slope2, law) if alone else _likelihood(d, slope2, law))
            out[at + k] = q
            known += p
            mean += p * d
            spread += p * d * d
            total += q
            slope += q * slope2
        else:
            out[at + k] = -p
            missing += p
    return known, mean, spread, total, slope, missing


@jit(forceinline=True)
def weighed(prior, chart, first, width, slopes, value, laws, out, at, size):
    """One block by the shortest of the ways there are; the last sum is negative where there are no voids."""
    steep, near_void = _slopes(prior, chart, first, width, laws[0], slopes, size)
    if near_void:
        return _weigh_voids(prior, chart, first, width, value, laws[0], out, at, size)
    if laws[0][5] == -np.inf:
        return _weigh_alone(prior, chart, first + width, slopes, value, laws[0], out, at, size)
    if steep == 0:
        return _weigh_even(prior, chart, first + width, slopes, value, laws[1], out, at, size)
    return _weigh(prior, chart, first + width, slopes, value, laws[0], out, at, size)

"""Particles: spread by noise of exact moments, weigh by a reading, resample without branches.

North and east are arrays of their own, so that each loop runs over vector registers. Sums may be reassociated and
multiply-adds contracted: the same order each time, whatever the threads.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.fastmath import fast_exp2
from terranav.kernels.jit import jit
from terranav.kernels.neighbours import neighbours_together
from terranav.kernels.random import normal_pairs
from terranav.kernels.sampling import BLOCK, bilinear_block

SUMS = {"contract", "reassoc"}  # NaN keeps its meaning

LOG2_E = 1.4426950408889634
LEAST_LOG2 = -865.0  # of a likelihood: times a weight it is still a normal number, where denormal ones take long
LEAST_WEIGHT = 1e-40  # less is none
LEAST_TOTAL = 1e-250  # less, and the reading contradicts every particle


@jit(fastmath=SUMS)
def moments(north, east, weight, centre):
    """Mean and covariance of a cloud.

    Parameters
    ----------
    north, east, weight : (m,) float64, the weights' sum not zero
    centre : (2,) float64, somewhere near the mean, lest digits be lost

    Returns
    -------
    mean_north, mean_east, var_north, cov, var_east
    """
    cn, ce = centre[0], centre[1]
    total, sn, se, nn, ne, ee = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(weight.size):
        p, n, e = weight[k], north[k] - cn, east[k] - ce
        total += p
        sn += p * n
        se += p * e
        nn += p * n * n
        ne += p * n * e
        ee += p * e * e
    return _central(total, sn, se, nn, ne, ee, cn, ce)


@jit
def _central(total, sn, se, nn, ne, ee, cn, ce):
    """Mean and covariance of sums about a centre."""
    n, e = sn / total, se / total
    return cn + n, ce + e, max(nn / total - n * n, 0.0), ne / total - n * e, max(ee / total - e * e, 0.0)


@jit(fastmath=SUMS)
def _noise_sums(north, east, weight, a, b, cn, ce):
    """Weighted sums of a cloud and noise (a, b): of it, its squares, the cloud, its squares, both."""
    sa, sb, aa, ab, bb = 0.0, 0.0, 0.0, 0.0, 0.0
    sn, se, nn, ne, ee = 0.0, 0.0, 0.0, 0.0, 0.0
    na, nb, ea, eb = 0.0, 0.0, 0.0, 0.0
    for k in range(weight.size):
        p, n, e, x, y = weight[k], north[k] - cn, east[k] - ce, a[k], b[k]
        pn, pe, px, py = p * n, p * e, p * x, p * y
        sa += px
        sb += py
        aa += px * x
        ab += px * y
        bb += py * y
        sn += pn
        se += pe
        nn += pn * n
        ne += pn * e
        ee += pe * e
        na += pn * x
        nb += pn * y
        ea += pe * x
        eb += pe * y
    return sa, sb, aa, ab, bb, sn, se, nn, ne, ee, na, nb, ea, eb


@jit
def spread(north, east, weight, growth, centre, key, out_north, out_east):
    """Add normal noise that is uncorrelated with the cloud under the weights and has exactly this variance.

    Plain draws would do so only to 1/sqrt(m), which over many steps without information looks like information. With
    away = x - mean, S its scatter, C its products with the noise z: z - away S^-1 C is uncorrelated with the cloud, and
    times the inverse of its own Cholesky factor has unit covariance.

    Parameters
    ----------
    north, east, weight : (m,) float64 [m], the weights sum to one
    growth : (2,) float64 [m^2], > 0
    centre : (2,) float64 [m], somewhere near the mean
    key : uint64, of the noise: particle k takes the pair of that number
    out_north, out_east : (m,) float64, written
    """
    cn, ce = centre[0], centre[1]
    sums = np.zeros(14)
    for begin in range(0, weight.size, BLOCK):
        part = slice(begin, min(begin + BLOCK, weight.size))
        a, b = out_north[part], out_east[part]
        normal_pairs(key, begin, a, b)
        for j, value in enumerate(_noise_sums(north[part], east[part], weight[part], a, b, cn, ce)):
            sums[j] += value
    sa, sb, aa, ab, bb, sn, se, nn, ne, ee, na, nb, ea, eb = sums
    nn, ne, ee = nn - sn * sn, ne - sn * se, ee - se * se
    na, nb, ea, eb = na - sn * sa, nb - sn * sb, ea - se * sa, eb - se * sb
    aa, ab, bb = aa - sa * sa, ab - sa * sb, bb - sb * sb
    det = nn * ee - ne * ne
    g00, g01, g10, g11 = 0.0, 0.0, 0.0, 0.0
    if det > 1e-12 * (nn + ee) * (nn + ee):
        g00, g01 = (ee * na - ne * ea) / det, (ee * nb - ne * eb) / det
        g10, g11 = (nn * ea - ne * na) / det, (nn * eb - ne * nb) / det
    aa, ab, bb = aa - na * g00 - ea * g10, ab - na * g01 - ea * g11, bb - nb * g01 - eb * g11
    rest = bb - ab * ab / aa if aa > 0.0 else 0.0
    scale_a, scale_b, mixed = np.sqrt(growth[0]), np.sqrt(growth[1]), 0.0
    if rest > 1e-9 and aa > 1e-9:  # else all the weight is on a few, and its noise has no covariance to correct
        scale_a, scale_b = scale_a / np.sqrt(aa), scale_b / np.sqrt(rest)
        mixed = -scale_b * ab / aa
    _moved(north, east, out_north, out_east, (cn + sn, ce + se, sa, sb), (g00, g01, g10, g11), scale_a, scale_b, mixed)


@jit(fastmath={"contract"})
def _moved(north, east, a, b, means, slopes, scale_a, scale_b, mixed):
    """The cloud with the noise (a, b) corrected; written over the noise."""
    mn, me, sa, sb = means
    g00, g01, g10, g11 = slopes
    for k in range(a.size):
        n, e = north[k] - mn, east[k] - me
        x, y = a[k] - sa - n * g00 - e * g10, b[k] - sb - n * g01 - e * g11
        a[k] = north[k] + scale_a * x
        b[k] = east[k] + scale_b * y + mixed * x


@jit(fastmath={"contract"})
def _cells(frame, north, east, row, col):
    """Rows and columns of the true places, which lie at minus the errors (`LocalFrame.cells`)."""
    r0, r1, r2, r3, r4, r5 = frame[0]
    c0, c1, c2, c3, c4, c5 = frame[1]
    for k in range(north.size):
        n, e = -north[k], -east[k]
        row[k] = r0 + n * (r1 + r3 * n + r4 * e) + e * (r2 + r5 * e)
        col[k] = c0 + n * (c1 + c3 * n + c4 * e) + e * (c2 + c5 * e)


@jit(fastmath=SUMS)
def _weighed(height, north, east, weight, reading, outliers, cn, ce, out):
    """Weights times likelihoods, and sums over particles whose height is known; `out` is NaN where it is not."""
    value, narrow = reading[0], -0.5 * LOG2_E / (reading[1] * reading[1])
    high, low, wide = 1.0 - outliers[0], outliers[0] / outliers[1], narrow / (outliers[1] * outliers[1])
    known, mean, square, voids = 0.0, 0.0, 0.0, 0.0
    total, sn, se, nn, ne, ee = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(weight.size):
        d = height[k] - value
        there = d == d
        d = d if there else 0.0
        w = weight[k] if there else 0.0
        voids += 0.0 if there else 1.0
        known += w
        mean += w * d
        square += w * d * d
        near, far = narrow * d * d, wide * d * d
        near, far = near if near > LEAST_LOG2 else LEAST_LOG2, far if far > LEAST_LOG2 else LEAST_LOG2
        p = w * (high * fast_exp2(near) + low * fast_exp2(far))
        n, e = north[k] - cn, east[k] - ce
        total += p
        pn, pe = p * n, p * e
        sn += pn
        se += pe
        nn += pn * n
        ne += pn * e
        ee += pe * e
        out[k] = p if there else np.nan
    return known, mean, square, voids, total, sn, se, nn, ne, ee


@jit(fastmath=SUMS)
def _fill_unknown(north, east, weight, average, cn, ce, out):
    """Where the map says nothing the weight times the average likelihood of the others; the sums of those."""
    total, sn, se, nn, ne, ee = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(out.size):
        there = out[k] == out[k]
        p, n, e = weight[k] * average, north[k] - cn, east[k] - ce
        out[k] = out[k] if there else p
        p = 0.0 if there else p
        pn, pe = p * n, p * e
        total += p
        sn += pn
        se += pe
        nn += pn * n
        ne += pn * e
        ee += pe * e
    return total, sn, se, nn, ne, ee


@jit(fastmath=SUMS)
def _normalised(weight, norm):
    """Multiply by a factor in place, what is next to nothing becoming nothing; the sum of the squares."""
    power = 0.0
    for k in range(weight.size):
        p = weight[k] * norm
        p = p if p > LEAST_WEIGHT else 0.0
        weight[k] = p
        power += p * p
    return power


@jit
def weigh_cloud(values, frame, reading, outliers, north, east, weight, centre, out):
    """Multiply the weights of INS errors by the likelihood of one reading and normalise.

    Parameters
    ----------
    values : (rows, cols) float32, contiguous, the map, NaN where void
    frame : (2, 6) float64
        Row and column coefficients of the LocalFrame at the indicated position.
    reading : (2,) float64, value and 1-sigma, map error included [unit]
    outliers : (2,) float64
        The reading is, with this probability, this many times noisier than told.
    north, east : (m,) float64 [m]
        INS errors; the true place lies at minus the error.
    weight : (m,) float64, sums to one
    centre : (2,) float64 [m], somewhere near the mean of the cloud
    out : (m,) float64, written

    Returns
    -------
    known : share of the weight on particles where the map says something
    nis : squared innovation over its predicted variance (1 on average), NaN when nothing is known
    effective : 1 / sum(w^2) of the new weights
    mean_and_cov : as `moments` returns them, under the new weights

    Particles where the map says nothing get the average likelihood of the others: a void neither attracts nor repels.
    Likelihoods below 2^-865 count as that. A reading that contradicts every particle says nothing about which is right.
    """
    cn, ce = centre[0], centre[1]
    row, col, height = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    at, corners = np.empty(BLOCK, np.uint64), np.empty(4 * BLOCK, np.float32)
    sums = np.zeros(10)
    for begin in range(0, out.size, BLOCK):
        part = slice(begin, min(begin + BLOCK, out.size))
        n, e, p = north[part], east[part], out[part]
        _cells(frame, n, e, row, col)
        bilinear_block(values, row[: p.size], col[: p.size], at, corners, height[: p.size])
        for j, value in enumerate(_weighed(height, n, e, weight[part], reading, outliers, cn, ce, p)):
            sums[j] += value
    known, total = sums[0], sums[4]
    nis = np.nan
    if known > 0.0:
        mean = sums[1] / known
        nis = mean * mean / (reading[1] * reading[1] + max(sums[2] / known - mean * mean, 0.0))
    if not total > LEAST_TOTAL:
        out[:] = weight
        return known, nis, 1.0 / _normalised(out, 1.0), moments(north, east, weight, centre)
    if sums[3] > 0.0:
        for j, value in enumerate(_fill_unknown(north, east, weight, total / known, cn, ce, out)):
            sums[4 + j] += value
    power = _normalised(out, 1.0 / sums[4])
    return known, nis, 1.0 / power, _central(sums[4], sums[5], sums[6], sums[7], sums[8], sums[9], cn, ce)


@jit
def _first_places(weight, order, offset, begin, sum_before, slots):
    """Write the number of each of a block's particles where its first copy stands; the sum with the block's weights."""
    m, before, place = slots.size - 1, np.empty(order.size), np.empty(order.size, np.uint64)
    for k in range(order.size):
        before[k] = sum_before
        sum_before += weight[np.uint64(order[k])]
    for k in range(order.size):
        place[k] = np.uint64(min(np.int64(np.ceil(m * before[k] - offset)), m))
    for k in range(order.size):
        slots[place[k]] = begin + k
    return sum_before


@jit
def resample(north, east, weight, offset, scratch, out_north, out_east):
    """Systematic resampling along strips in which neighbours in the list are neighbours on the ground.

    Copy k is of the particle in whose share of the unit interval (k + offset) / m lies. Each particle writes its number
    where its first copy would stand; one without copies is overwritten by the next. The running maximum fills in the
    other copies. No branch depends on the weights.

    Parameters
    ----------
    north, east, weight : (m,) float64, the weights sum to one
    offset : float in [0, 1)
    scratch : (4, m + 1) int32, written
    out_north, out_east : (m,) float64, written
        The copies, in the order of `neighbours_together`.
    """
    m = weight.size
    neighbours_together(north, east, weight, scratch)
    order, slots = scratch[0, :m], scratch[1]
    slots[:] = 0
    sum_before, latest = 0.0, np.int32(0)
    for begin in range(0, m, BLOCK):
        sum_before = _first_places(weight, order[begin : begin + BLOCK], offset, begin, sum_before, slots)
    for k in range(m):
        latest = max(latest, slots[k])
        chosen = np.uint64(order[np.uint64(latest)])
        out_north[k], out_east[k] = north[chosen], east[chosen]

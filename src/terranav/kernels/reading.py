"""A reading against the map at every particle: what it leaves, what was expected of it, what it makes of the cloud."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.fastmath import fast_exp
from terranav.kernels.jit import jit
from terranav.kernels.marginalized import BLOCK, SUMS, add_moments, centred
from terranav.kernels.matrices import bayes
from terranav.kernels.sloped import sloped

INV_SQRT_2PI = 1.0 / math.sqrt(2.0 * math.pi)
SAMPLED = 512  # particles that are enough to tell the noise by


@jit(fastmath=SUMS)
def compare(values, frame, cloud, weight, value, bias, residual, slope2):
    """What a reading leaves at each particle, and how steep the map is there.

    Parameters
    ----------
    values : (rows, cols) float32, the map, NaN where void
    frame : (2, 6) float64, row and column coefficients of the LocalFrame at the indicated position
    cloud : (d, m) float64, weight : (m,) float64
    value : float, the reading
    bias : int, row of its bias, the patch being the next
    residual : (m,) written: value - map - bias - patch, NaN where the map says nothing
    slope2 : (m,) written: squared slope of the map [unit^2/m^2]

    Returns
    -------
    known : share of the weight where the map says something
    mean, variance : of the residual there, NaN where the map says nothing at all
    slope2 : its mean there
    """
    known, mean, square, steep = 0.0, 0.0, 0.0, 0.0
    work = np.empty(BLOCK, np.uint64), np.empty((4, BLOCK), np.float32), np.empty((3, BLOCK))
    found = np.empty((3, BLOCK))
    for start in range(0, residual.size, BLOCK):
        stop = min(start + BLOCK, residual.size)
        size = stop - start
        sloped(values, frame, cloud[0, start:stop], cloud[1, start:stop], work, found)
        height, rise_n, rise_e = found[0, :size], found[1, :size], found[2, :size]
        own, patch, left = cloud[bias, start:stop], cloud[bias + 1, start:stop], residual[start:stop]
        for k in range(size):
            left[k] = value - height[k] - own[k] - patch[k]
        slope, w = slope2[start:stop], weight[start:stop]
        for k in range(size):
            r, s = left[k], rise_n[k] * rise_n[k] + rise_e[k] * rise_e[k]
            slope[k] = s
            there = r == r
            p, r = (w[k] if there else 0.0), (r if there else 0.0)
            known += p
            mean += p * r
            square += p * r * r
            steep += p * s
    if known <= 0.0:
        return 0.0, np.nan, np.nan, 0.0
    mean = mean / known
    return known, mean, max(square / known - mean * mean, 0.0), steep / known


@jit(fastmath=SUMS)
def evidence(cloud_weight, residual, slope2, bad, noise, common, reach, scales, out):
    """Likelihood of a reading under each of several scales of the noise, over every few particles.

    Parameters
    ----------
    cloud_weight, residual, slope2 : (m,), the latter two of `compare`
    bad : (m,) probability of the bad regime
    noise : (2,) variance of the white noise is noise[0] + noise[1] slope2 [unit^2], [m^2]
    common : (2,) variance of the bias, and of the patch at scale 1 [unit^2]
    reach : half width of the Cauchy density of the bad regime [unit]
    scales : (s,) factors of the variance of noise and patch
    out : (s,) written
    """
    m = cloud_weight.size
    stride = max(m // SAMPLED, 1)
    count = (m + stride - 1) // stride
    near, square, white = np.empty(count), np.empty(count), np.empty(count)
    known, far = 0.0, 0.0
    for n in range(count):
        k = n * stride
        r, w, b = residual[k], cloud_weight[k], bad[k]
        w, r = (w if r == r else 0.0), (r if r == r else 0.0)
        known += w
        near[n] = w * (1.0 - b) * INV_SQRT_2PI
        square[n] = -0.5 * r * r
        white[n] = noise[0] + noise[1] * slope2[k] + common[1]
        far += w * b * reach / (math.pi * (reach * reach + r * r))
    for j in range(scales.size):
        total = far
        for n in range(count):
            precision = 1.0 / (scales[j] * white[n] + common[0])
            total += near[n] * math.sqrt(precision) * fast_exp(square[n] * precision)
        out[j] = total / known if known > 0.0 else 1.0


@jit(fastmath=SUMS)
def weigh(cloud, weight, bad, residual, slope2, noise, variance, reach, gain, centre, out_weight):
    """Multiply the weights by the likelihood of a reading and update the conditional means and the regimes, in place.

    Parameters
    ----------
    cloud : (d, m) float64, written
    weight : (m,) float64
    bad : (m,) float64, probability of the bad regime, written
    residual, slope2 : of `compare`; residual becomes value - map - bias - patch of the cloud as it is after this
    noise : (2,) as in `evidence`
    variance : of bias + patch, equal for all particles [unit^2]
    reach : half width of the Cauchy density of the bad regime [unit]
    gain : (d,) covariance of the linear states with bias + patch; none with the position
    centre : (d,) about the mean of the cloud
    out_weight : (m,) float64, written

    Returns
    -------
    likely : mean likelihood of the known particles, 0 when the reading contradicts every one and nothing was changed
    effective : 1 / sum(w^2) of the new weights
    reduction : the common covariance becomes C - reduction gain gain'
    mean, cov : (d,), (d, d) of the new cloud
    """
    d, m = cloud.shape
    step, after = np.empty(m), np.empty(m)
    total, known, shrink, widen, silent = 0.0, 0.0, 0.0, 0.0, 0
    for k in range(m):
        r, w, b = residual[k], weight[k], bad[k]
        there = r == r
        r = r if there else 0.0
        precision = 1.0 / (noise[0] + noise[1] * slope2[k] + variance)
        near = (1.0 - b) * math.sqrt(precision) * INV_SQRT_2PI * fast_exp(-0.5 * r * r * precision)
        far = b * reach / (math.pi * (reach * reach + r * r))
        share = far / (near + far)
        p = w * (near + far) if there else 0.0
        good = 1.0 - share if there else 0.0
        jump = r * precision
        out_weight[k] = p
        after[k] = share if there else b
        step[k] = good * jump
        total += p
        known += w if there else 0.0
        silent += 0 if there else 1
        shrink += p * good * precision
        widen += p * good * (share * jump * jump if there else 0.0)
    mean, cov = np.zeros(d), np.zeros((d, d))
    if not total > 1e-280:
        out_weight[:] = weight
        return 0.0, 0.0, 0.0, mean, cov
    average = total / known
    norm = 1.0 / (total + average * (1.0 - known))
    if silent > 0:
        for k in range(m):
            out_weight[k] = out_weight[k] if residual[k] == residual[k] else weight[k] * average
    power, block = 0.0, np.zeros((d // 4 * 4 + 4, BLOCK))
    block[d] = 1.0
    sums = np.zeros((len(block), len(block)))
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        size = stop - start
        part, moved = out_weight[start:stop], step[start:stop]
        for k in range(size):
            part[k] *= norm
            power += part[k] * part[k]
        for i in range(d):
            row, away = cloud[i, start:stop], block[i, :size]
            factor, middle = gain[i], centre[i]
            if factor != 0.0:
                for k in range(size):
                    row[k] += factor * moved[k]
            for k in range(size):
                away[k] = row[k] - middle
        left, regime = residual[start:stop], bad[start:stop]
        for k in range(size):
            left[k] -= variance * moved[k]
            regime[k] = after[start + k]
        add_moments(block, part, sums)
    centred(sums, centre, mean, cov)
    return average, 1.0 / power, norm * (shrink - widen), mean, cov


@jit
def learned(probability, likelihood, switch):
    """The distribution over scales after a reading: a chain that moves to either side with chance `switch`, then Bayes.

    probability, likelihood : (s,); the result is new.
    """
    n = probability.size
    moved = np.empty(n)
    for i in range(n):
        sides = probability[max(i - 1, 0)] + probability[min(i + 1, n - 1)]
        moved[i] = (1.0 - 2.0 * switch) * probability[i] + switch * sides
    return bayes(moved, likelihood)


@jit(fastmath=SUMS)
def mean_of(weight, value):
    """Sum of weight times value."""
    total = 0.0
    for k in range(weight.size):
        total += weight[k] * value[k]
    return total


@jit
def reach_of(cloud):
    """Largest distance of a cloud's positions from the origin along an axis [m]."""
    most = np.int64(0)
    for i in range(2):
        row = cloud[i]
        for k in range(row.size):
            most = max(most, np.float64(abs(row[k])).view(np.int64))  # of numbers >= 0 the bits are in order, too
    return np.int64(most).view(np.float64)


@jit
def settled(common, reduction, gain, cov):
    """C - reduction gain gain' (d, d), and that plus the covariance of the cloud."""
    d = gain.size
    after, whole = np.empty((d, d)), np.empty((d, d))
    for i in range(d):
        for j in range(d):
            after[i, j] = common[i, j] - reduction * gain[i] * gain[j]
            whole[i, j] = after[i, j] + cov[i, j]
    return after, whole

"""Marginalised particles: rows of a cloud are (position error north, east, conditional means of the linear states)."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.fastmath import fast_exp
from terranav.kernels.jit import jit
from terranav.kernels.sampling import bilinear_at

BINS = 48  # per axis, of the histogram that measures a cloud's area
COMMON = 4  # positions and velocities: columns that the noise of a step has nothing in common with
INV_SQRT_2PI = 1.0 / math.sqrt(2.0 * math.pi)


@jit
def advance(cloud, weight, phi, spread, noise, out):
    """Move every particle: out[k] = phi cloud[k] + spread noise*[k].

    noise* are the given normal numbers, shifted and mixed to mean zero, unit covariance, and none in common with the
    predicted positions and velocities, all under the weights: so the cloud's covariance grows by exactly that of the
    noise, and chance makes no velocity out of it.

    Parameters
    ----------
    cloud : (m, d) float64, d >= COMMON
    weight : (m,) float64, sums to one
    phi : (d, d) float64
    spread : (d, 2) float64
    noise : (m, 2) float64, standard normal
    out : (m, d) float64, written
    """
    m, d = cloud.shape
    n = COMMON
    mean, square = np.zeros(n + 2), np.zeros((n + 2, n + 2))  # of the columns COMMON and of the noise
    row = np.empty(n + 2)
    for k in range(m):
        for i in range(d):
            total = 0.0
            for j in range(d):
                total += phi[i, j] * cloud[k, j]
            out[k, i] = total
        for i in range(n):
            mean[i] += weight[k] * out[k, i]
        mean[n] += weight[k] * noise[k, 0]
        mean[n + 1] += weight[k] * noise[k, 1]
    for k in range(m):  # about the mean, or the squares of far positions swamp the products
        for i in range(n):
            row[i] = out[k, i] - mean[i]
        row[n], row[n + 1] = noise[k, 0] - mean[n], noise[k, 1] - mean[n + 1]
        for i in range(n + 2):
            scaled = weight[k] * row[i]
            for j in range(i + 1):
                square[i, j] += scaled * row[j]
    root = np.zeros((n + 2, n + 2))  # Cholesky of `square`; a column that the ones before it explain is left out
    for i in range(n + 2):
        for j in range(i + 1):
            left = square[i, j]
            for k in range(j):
                left -= root[i, k] * root[j, k]
            if i == j:
                floor = 1e-3 if i >= n else 1e-10 * square[i, i]
                root[i, i] = math.sqrt(left) if left > floor else 0.0
                if i >= n and root[i, i] == 0.0:
                    root[i, i] = math.sqrt(floor)
            elif root[j, j] > 0.0:
                root[i, j] = left / root[j, j]
    white = np.empty(n + 2)
    for k in range(m):  # whitened by forward substitution, the last two are what the noise has of its own
        for i in range(n + 2):
            left = out[k, i] - mean[i] if i < n else noise[k, i - n] - mean[i]
            for j in range(i):
                left -= root[i, j] * white[j]
            white[i] = left / root[i, i] if root[i, i] > 0.0 else 0.0
        for i in range(d):
            out[k, i] += spread[i, 0] * white[n] + spread[i, 1] * white[n + 1]


@jit
def compare(values, frame, cloud, state, residual, slope2):
    """What a reading leaves at each particle, and how steep the map is there.

    Parameters
    ----------
    values : (rows, cols) float32, the map, NaN where void
    frame : (2, 6) float64, row and column coefficients of the LocalFrame at the indicated position
    cloud : (m, d) float64
    state : (2,) float64, the reading's value and the index of its bias, the patch being the next
    residual : (m,) written: value - map - bias - patch, NaN where the map says nothing
    slope2 : (m,) written: squared slope of the map [unit^2/m^2]
    """
    r0, r1, r2, r3, r4, r5 = frame[0]
    c0, c1, c2, c3, c4, c5 = frame[1]
    rows, cols = values.shape
    flat, width = values.reshape(values.size), np.int64(cols)
    top, right = rows - 1.0, cols - 1.0
    value, bias = state[0], int(state[1])
    for k in range(residual.size):
        n, e = -cloud[k, 0], -cloud[k, 1]
        row = r0 + n * (r1 + r3 * n + r4 * e) + e * (r2 + r5 * e)
        col = c0 + n * (c1 + c3 * n + c4 * e) + e * (c2 + c5 * e)
        inside = (row >= 0.0) & (row <= top) & (col >= 0.0) & (col <= right)
        row, col = (row if row > 0.0 else 0.0), (col if col > 0.0 else 0.0)
        y, x = np.int64(min(row, top - 1.0)), np.int64(min(col, right - 1.0))
        u, v = min(row, top) - y, min(col, right) - x
        at = np.uint64(y * width + x)
        below = at + np.uint64(width)
        one, two = np.float64(flat[at]), np.float64(flat[at + np.uint64(1)])
        three, four = np.float64(flat[below]), np.float64(flat[below + np.uint64(1)])
        low, high = one + v * (two - one), three + v * (four - three)
        by_row, by_col = high - low, (1.0 - u) * (two - one) + u * (four - three)
        north, east = by_row * r1 + by_col * c1, by_row * r2 + by_col * c2
        h = low + u * by_row
        residual[k] = value - h - cloud[k, bias] - cloud[k, bias + 1] if inside else np.nan
        slope2[k] = north * north + east * east
    for k in range(residual.size):
        if residual[k] != residual[k]:
            n, e = -cloud[k, 0], -cloud[k, 1]
            row = r0 + n * (r1 + r3 * n + r4 * e) + e * (r2 + r5 * e)
            col = c0 + n * (c1 + c3 * n + c4 * e) + e * (c2 + c5 * e)
            residual[k] = value - bilinear_at(values, row, col) - cloud[k, bias] - cloud[k, bias + 1]
            slope2[k] = 0.0 if slope2[k] != slope2[k] else slope2[k]


@jit
def predicted(weight, residual, slope2, noise, common):
    """What was expected of a reading.

    Parameters
    ----------
    weight, residual, slope2 : (m,), the latter two of `compare`
    noise : (2,) variance of the white noise is noise[0] + noise[1] slope2 [unit^2], [m^2]
    common : variance that bias and patch add, equal for all particles [unit^2]

    Returns
    -------
    known : share of the weight where the map says something
    mean, variance : of the residual
    white : mean of the white part of the variance
    """
    known, mean, square, white = 0.0, 0.0, 0.0, 0.0
    for k in range(weight.size):
        r, w = residual[k], weight[k]
        there = r == r
        w = w if there else 0.0
        r = r if there else 0.0
        known += w
        mean += w * r
        square += w * r * r
        white += w * (noise[0] + noise[1] * slope2[k])
    if known <= 0.0:
        return 0.0, np.nan, np.nan, np.nan
    mean, white = mean / known, white / known
    return known, mean, max(square / known - mean * mean, 0.0) + white + common, white


@jit
def effective(weight):
    """Effective number of particles, 1 / sum(w^2); no BLAS, which would wake its threads for a long vector."""
    power = 0.0
    for k in range(weight.size):
        power += weight[k] * weight[k]
    return 1.0 / power


@jit
def mean_known(weight, residual, value):
    """Mean of a value under the weights where the map says something, 0 where it says nothing."""
    known, total = 0.0, 0.0
    for k in range(weight.size):
        if residual[k] == residual[k]:
            known += weight[k]
            total += weight[k] * value[k]
    return total / known if known > 0.0 else 0.0


@jit
def evidence(weight, residual, slope2, bad, noise, common, reach, scales, out):
    """Likelihood of a reading under each of several scales of the noise, over every few particles.

    Parameters
    ----------
    weight, residual, slope2, noise : as in `predicted`
    bad : (m,) probability of the bad regime
    common : (2,) variance of the bias, and of the patch at scale 1 [unit^2]
    reach : half width of the Cauchy density of the bad regime [unit]
    scales : (s,) factors of the variance of noise and patch
    out : (s,) written
    """
    stride = max(weight.size // 512, 1)
    out[:] = 0.0
    known = 0.0
    for k in range(0, weight.size, stride):
        r = residual[k]
        if r == r:
            known += weight[k]
            white = noise[0] + noise[1] * slope2[k] + common[1]
            far = bad[k] * reach / (math.pi * (reach * reach + r * r))
            for j in range(scales.size):
                precision = 1.0 / (scales[j] * white + common[0])
                near = math.sqrt(precision) * INV_SQRT_2PI * fast_exp(-0.5 * r * r * precision)
                out[j] += weight[k] * ((1.0 - bad[k]) * near + far)
    if known > 0.0:
        out /= known
    else:
        out[:] = 1.0


@jit
def weigh(rows, weight, bad, residual, slope2, noise, common, reach, gain, out_rows, out_weight, out_bad):
    """Multiply the weights by the likelihood of a reading and update the conditional means and the regimes.

    Parameters
    ----------
    rows, weight, bad : the particles before: (m, d), (m,), probability of the bad regime (m,)
    residual, slope2 : of `compare`
    noise : (2,) as in `predicted`
    common : variance of bias + patch [unit^2]
    reach : half width of the Cauchy density of the bad regime [unit]
    gain : (d,) covariance of the linear states with bias + patch
    out_rows, out_weight, out_bad : written

    Returns
    -------
    likely : mean likelihood of the known particles, 0 when the reading contradicts every one and nothing was changed
    effective : 1 / sum(w^2) of the new weights
    shrink, widen : the common covariance becomes C - (shrink - widen) gain gain'
    """
    m, d = rows.shape
    total, known, power = 0.0, 0.0, 0.0
    for k in range(m):
        r, w = residual[k], weight[k]
        there = r == r
        r = r if there else 0.0
        precision = 1.0 / (noise[0] + noise[1] * slope2[k] + common)
        near = (1.0 - bad[k]) * math.sqrt(precision) * INV_SQRT_2PI * fast_exp(-0.5 * r * r * precision)
        far = bad[k] * reach / (math.pi * (reach * reach + r * r))
        likely = near + far
        out_weight[k] = w * likely if there else -1.0
        out_bad[k] = far / likely if there else bad[k]
        total += w * likely if there else 0.0
        known += w if there else 0.0
        power += w * w
    if not total > 1e-280:
        out_rows[:], out_weight[:], out_bad[:] = rows, weight, bad
        return 0.0, 1.0 / power, 0.0, 0.0
    average = total / known
    norm = 1.0 / (total + average * (1.0 - known))
    power, shrink, widen = 0.0, 0.0, 0.0
    for k in range(m):
        there = out_weight[k] >= 0.0
        p = norm * (out_weight[k] if there else weight[k] * average)
        out_weight[k] = p
        power += p * p
        good = 1.0 - out_bad[k] if there else 0.0
        pull = good / (noise[0] + noise[1] * slope2[k] + common)
        r = residual[k] if there else 0.0
        step = r * pull
        for i in range(d):
            out_rows[k, i] = rows[k, i] + gain[i] * step
        shrink += p * pull
        widen += p * good * (1.0 - good) * (r * pull / max(good, 1e-300)) ** 2 if good > 0.0 else 0.0
    return average, 1.0 / power, shrink, widen


@jit
def regime(bad, share, keep, out):
    """Let the bad regime come and go: out = share + keep (bad - share)."""
    for k in range(bad.size):
        out[k] = share + keep * (bad[k] - share)


@jit
def moments(cloud, weight):
    """Mean (d,) and covariance (d, d) of the rows under the weights."""
    m, d = cloud.shape
    mean, cov = np.zeros(d), np.zeros((d, d))
    for k in range(m):
        for i in range(d):
            mean[i] += weight[k] * cloud[k, i]
    away = np.empty(d)
    for k in range(m):
        for i in range(d):
            away[i] = cloud[k, i] - mean[i]
        for i in range(d):
            scaled = weight[k] * away[i]
            for j in range(i + 1):
                cov[i, j] += scaled * away[j]
    for i in range(d):
        for j in range(i):
            cov[j, i] = cov[i, j]
    return mean, cov


@jit
def area(cloud, weight):
    """Area that the positions cover: exp(entropy) of their histogram times its bin [m^2]."""
    m = weight.size
    low_n, high_n, low_e, high_e = np.inf, -np.inf, np.inf, -np.inf
    floor = 1e-4 / m
    for k in range(m):
        if weight[k] > floor:
            low_n, high_n = min(low_n, cloud[k, 0]), max(high_n, cloud[k, 0])
            low_e, high_e = min(low_e, cloud[k, 1]), max(high_e, cloud[k, 1])
    step_n, step_e = (high_n - low_n) / BINS + 1e-9, (high_e - low_e) / BINS + 1e-9
    mass = np.zeros((BINS, BINS))
    for k in range(m):
        if weight[k] > floor:
            i, j = int((cloud[k, 0] - low_n) / step_n), int((cloud[k, 1] - low_e) / step_e)
            mass[min(i, BINS - 1), min(j, BINS - 1)] += weight[k]
    entropy = 0.0
    for i in range(BINS):
        for j in range(BINS):
            if mass[i, j] > 0.0:
                entropy -= mass[i, j] * math.log(mass[i, j])
    return math.exp(entropy) * step_n * step_e


@jit
def resampled(rows, weight, bad, offset, centre, keep, spread, noise, out_rows, out_bad):
    """Systematic resampling to equal weights with a kernel: centre + keep (chosen - centre) + spread noise.

    Parameters
    ----------
    rows : (m, d), weight : (m,) that sums to one, bad : (m, kinds)
    offset : float in [0, 1)
    centre : (d,) mean of the cloud
    keep : float, how far the particles are drawn towards the mean, to make room for the kernel
    spread : (d, 2), noise : (n, 2) standard normal
    out_rows, out_bad : (n, d), (n, kinds) written; n need not be m
    """
    m, d = rows.shape
    n = len(out_rows)
    source, reached = 0, weight[0]
    for k in range(n):
        level = (k + offset) / n
        while reached <= level and source < m - 1:
            source += 1
            reached += weight[source]
        for i in range(d):
            away = keep * (rows[source, i] - centre[i])
            out_rows[k, i] = centre[i] + away + spread[i, 0] * noise[k, 0] + spread[i, 1] * noise[k, 1]
        for j in range(bad.shape[1]):
            out_bad[k, j] = bad[source, j]

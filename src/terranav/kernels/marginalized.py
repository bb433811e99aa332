"""Marginalised particles: row i of a cloud is state i of all particles, the first two the position error north, east.

A cloud is worked through in blocks of BLOCK particles, whose rows stay in the first cache, and every sum runs over
vector registers.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit

BINS = 48  # per axis, of the histogram that measures a cloud's area
COMMON = 4  # positions and velocities: rows that the noise of a step has nothing in common with
BLOCK = 512
SUMS = {"contract", "reassoc"}  # sums in any order, so that they run over vector registers; NaN keeps its meaning


@jit(fastmath=SUMS)
def add_moments(block, weight, scaled, first, second):
    """Add weighted sums: first[i] += sum(w x_i), second[i, j] += sum(w x_i x_j) for j <= i.

    Parameters
    ----------
    block : (n, k) float64, weight : (k,) float64
    scaled : (k,) float64, scratch
    first : (n,), second : (n, n) float64, added to
    """
    for i in range(len(block)):
        row, total = block[i], 0.0
        for k in range(weight.size):
            each = weight[k] * row[k]
            scaled[k] = each
            total += each
        first[i] += total
        for j in range(0, i + 1, 4):  # four products for each number fetched
            one, two, three, four = block[j], block[min(j + 1, i)], block[min(j + 2, i)], block[min(j + 3, i)]
            a, b, c, d = 0.0, 0.0, 0.0, 0.0
            for k in range(weight.size):
                each = scaled[k]
                a += each * one[k]
                b += each * two[k]
                c += each * three[k]
                d += each * four[k]
            second[i, j] += a
            if j + 1 <= i:
                second[i, j + 1] += b
            if j + 2 <= i:
                second[i, j + 2] += c
            if j + 3 <= i:
                second[i, j + 3] += d


@jit
def centred(first, second, centre, mean, cov):
    """Mean and covariance from the sums of `add_moments` about a centre; all (n,) and (n, n), the last two written."""
    for i in range(first.size):
        mean[i] = centre[i] + first[i]
        for j in range(i + 1):
            cov[i, j] = second[i, j] - first[i] * first[j]
            cov[j, i] = cov[i, j]


@jit(fastmath=SUMS)
def _carried(rows, factors, start, out):
    """out[k] = sum of factors[j] rows[j, start + k]; states without a factor are not looked at."""
    used, count = np.empty(factors.size, np.int64), 0
    for j in range(factors.size):
        if factors[j] != 0.0:
            used[count] = j
            count += 1
    out[:] = 0.0
    stop = start + out.size
    for n in range(0, count, 3):
        i, j, k = used[n], used[min(n + 1, count - 1)], used[min(n + 2, count - 1)]
        a, b, c = factors[i], factors[j] if n + 1 < count else 0.0, factors[k] if n + 2 < count else 0.0
        one, two, three = rows[i, start:stop], rows[j, start:stop], rows[k, start:stop]
        for k in range(out.size):
            out[k] += a * one[k] + b * two[k] + c * three[k]


@jit
def _whitening(square, own):
    """Rows (2, n) that make of the last two of n variables what they have of their own, with unit covariance.

    By the Cholesky factor of their covariance (n, n); a variable that the ones before it explain is left out.
    """
    n = len(square)
    root = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            left = square[i, j]
            for k in range(j):
                left -= root[i, k] * root[j, k]
            if i == j:
                floor = 1e-3 if i >= n - 2 else 1e-10 * square[i, i]
                root[i, i] = math.sqrt(left) if left > floor else 0.0
                if i >= n - 2 and root[i, i] == 0.0:
                    root[i, i] = math.sqrt(floor)
            elif root[j, j] > 0.0:
                root[i, j] = left / root[j, j]
    white = np.empty(n)
    for c in range(n):  # forward substitution of the unit vectors
        for i in range(n):
            left = 1.0 if i == c else 0.0
            for j in range(i):
                left -= root[i, j] * white[j]
            white[i] = left / root[i, i] if root[i, i] > 0.0 else 0.0
        own[0, c], own[1, c] = white[n - 2], white[n - 1]


@jit(fastmath=SUMS)
def advance(cloud, weight, mean, phi, spread, noise, out):
    """Move every particle: phi x + spread noise*.

    noise* are the given normal numbers, shifted and mixed to mean zero, unit covariance, and none in common with the
    predicted positions and velocities, all under the weights: so the cloud's covariance grows by exactly that of the
    noise, and chance makes no velocity out of it.

    Parameters
    ----------
    cloud : (d, m) float64, d >= COMMON
    weight : (m,) float64, sums to one
    mean : (d,) float64, about the mean of the cloud: squares of far positions would swamp the products
    phi : (d, d) float64
    spread : (d, 2) float64
    noise : (2, m) float64, standard normal
    out : (d, m) float64, written
    """
    d, m = cloud.shape
    n = COMMON + 2
    block, scaled, expected = np.empty((n, BLOCK)), np.empty(BLOCK), np.zeros(n)
    first, second, square, own = np.zeros(n), np.zeros((n, n)), np.empty((n, n)), np.empty((2, n))
    for i in range(COMMON):
        for j in range(d):
            expected[i] += phi[i, j] * mean[j]
    for start in range(0, m, BLOCK):
        width = min(BLOCK, m - start)
        for i in range(COMMON):
            row = block[i, :width]
            _carried(cloud, phi[i], start, row)
            for k in range(width):
                row[k] -= expected[i]
        block[COMMON, :width], block[COMMON + 1, :width] = (
            noise[0, start : start + width],
            noise[1, start : start + width],
        )
        add_moments(block[:, :width], weight[start : start + width], scaled[:width], first, second)
    centred(first, second, np.zeros(n), np.empty(n), square)
    _whitening(square, own)
    constant = np.zeros(2)
    for c in range(n):
        constant[0] -= own[0, c] * (expected[c] + first[c])
        constant[1] -= own[1, c] * (expected[c] + first[c])
    for start in range(0, m, BLOCK):
        width = min(BLOCK, m - start)
        stop = start + width
        for i in range(COMMON):
            _carried(cloud, phi[i], start, out[i, start:stop])
        r0, r1, r2, r3 = out[0, start:stop], out[1, start:stop], out[2, start:stop], out[3, start:stop]
        e0, e1, w0, w1 = noise[0, start:stop], noise[1, start:stop], block[0, :width], block[1, :width]
        a0, a1, a2, a3, a4, a5 = own[0]
        b0, b1, b2, b3, b4, b5 = own[1]
        for k in range(width):
            w0[k] = constant[0] + a0 * r0[k] + a1 * r1[k] + a2 * r2[k] + a3 * r3[k] + a4 * e0[k] + a5 * e1[k]
            w1[k] = constant[1] + b0 * r0[k] + b1 * r1[k] + b2 * r2[k] + b3 * r3[k] + b4 * e0[k] + b5 * e1[k]
        for i in range(d):
            row = out[i, start:stop]
            if i >= COMMON:
                _carried(cloud, phi[i], start, row)
            a, b = spread[i, 0], spread[i, 1]
            for k in range(width):
                row[k] += a * w0[k] + b * w1[k]


@jit(fastmath=SUMS)
def moments(cloud, weight):
    """Mean (d,) and covariance (d, d) of a cloud (d, m) under the weights (m,)."""
    d, m = cloud.shape
    mean, cov, centre = np.zeros(d), np.zeros((d, d)), np.empty(d)
    first, second = np.zeros(d), np.zeros((d, d))
    for i in range(d):
        row, total = cloud[i], 0.0
        for k in range(m):
            total += weight[k] * row[k]
        centre[i] = total
    block, scaled = np.empty((d, BLOCK)), np.empty(BLOCK)
    for start in range(0, m, BLOCK):
        width = min(BLOCK, m - start)
        for i in range(d):
            row, away = cloud[i, start : start + width], block[i, :width]
            for k in range(width):
                away[k] = row[k] - centre[i]
        add_moments(block[:, :width], weight[start : start + width], scaled[:width], first, second)
    first[:] = 0.0  # the centre is the mean but for rounding
    centred(first, second, centre, mean, cov)
    return mean, cov


@jit
def regime(bad, share, keep, out):
    """Let the bad regimes (kinds, m) come and go: out = share + keep (bad - share); keep : (kinds,)."""
    for i in range(len(bad)):
        row, after, stay = bad[i], out[i], keep[i]
        for k in range(row.size):
            after[k] = share + stay * (row[k] - share)


@jit(fastmath=SUMS)
def effective(weight):
    """Effective number of particles, 1 / sum(w^2); no BLAS, which would wake its threads for a long vector."""
    power = 0.0
    for k in range(weight.size):
        power += weight[k] * weight[k]
    return 1.0 / power


@jit
def area(cloud, weight):
    """Area that the positions of a cloud (d, m) cover: exp(entropy) of their histogram times its bin [m^2]."""
    m = weight.size
    low_n, high_n, low_e, high_e = np.inf, -np.inf, np.inf, -np.inf
    floor, north, east = 1e-4 / m, cloud[0], cloud[1]
    for k in range(m):
        there = weight[k] > floor
        low_n, high_n = min(low_n, north[k] if there else np.inf), max(high_n, north[k] if there else -np.inf)
        low_e, high_e = min(low_e, east[k] if there else np.inf), max(high_e, east[k] if there else -np.inf)
    step_n, step_e = (high_n - low_n) / BINS + 1e-9, (high_e - low_e) / BINS + 1e-9
    mass = np.zeros((BINS, BINS))
    for k in range(m):
        if weight[k] > floor:
            i, j = int((north[k] - low_n) / step_n), int((east[k] - low_e) / step_e)
            mass[min(i, BINS - 1), min(j, BINS - 1)] += weight[k]
    entropy = 0.0
    for i in range(BINS):
        for j in range(BINS):
            if mass[i, j] > 0.0:
                entropy -= mass[i, j] * math.log(mass[i, j])
    return math.exp(entropy) * step_n * step_e


@jit
def _chosen(weight, offset, source):
    """Systematic resampling without branches: source[k] is the particle whose share of the weight holds (k + offset)/n.

    Each particle leaves its number where its share begins; a later one that begins at the same place overwrites it.
    What has no number of its own belongs to the particle before.
    """
    n, m = source.size, weight.size
    source[:] = 0
    reached, one = 0.0, n * 1.0
    for s in range(1, m):
        reached += weight[s - 1]
        at = math.ceil(reached * one - offset)
        at = 0.0 if at < 0.0 else at
        if at < one:  # true for all but the last few
            source[np.int64(at)] = s
    last = 0
    for k in range(n):
        last = max(last, source[k])
        source[k] = last


@jit(fastmath=SUMS)
def resampled(cloud, weight, bad, offset, centre, keep, spread, noise, out, out_bad):
    """Systematic resampling to equal weights with a kernel: centre + keep (chosen - centre) + spread noise.

    Parameters
    ----------
    cloud : (d, m), weight : (m,) that sums to one, bad : (kinds, m)
    offset : float in [0, 1)
    centre : (d,) mean of the cloud
    keep : float, how far the particles are drawn towards the mean, to make room for the kernel
    spread : (d, 2), noise : (2, n) standard normal
    out, out_bad : (d, n), (kinds, n) written; n need not be m
    """
    d, n = out.shape
    source = np.empty(n, np.int64)
    _chosen(weight, offset, source)
    e0, e1 = noise[0], noise[1]
    for i in range(d):
        row, drawn, a, b, rest = cloud[i], out[i], spread[i, 0], spread[i, 1], (1.0 - keep) * centre[i]
        for k in range(n):
            drawn[k] = rest + keep * row[np.uint64(source[k])] + a * e0[k] + b * e1[k]
    for i in range(len(bad)):
        row, drawn = bad[i], out_bad[i]
        for k in range(n):
            drawn[k] = row[np.uint64(source[k])]

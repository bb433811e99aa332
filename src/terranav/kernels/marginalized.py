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
BLOCK = 1024
SUMS = {"contract", "reassoc"}  # sums in any order, so that they run over vector registers; NaN keeps its meaning


@jit(fastmath=SUMS)
def add_moments(block, weight, sums):
    """Add weighted sums: sums[i, j] += sum(w x_i x_j), at least for j <= i.

    Four rows by four at a time: sixteen sums stay in registers, and each number fetched serves four of them.

    Parameters
    ----------
    block : (n, BLOCK) float64, n a multiple of four: a row a state, one of ones, which makes means, and zeros
    weight : (k,) float64, k <= BLOCK
    sums : (n, n) float64, added to
    """
    size = weight.size
    for i in range(0, len(block), 4):
        p, q, r, s = block[i, :size], block[i + 1, :size], block[i + 2, :size], block[i + 3, :size]
        for j in range(0, i + 1, 4):
            e, f, g, h = block[j, :size], block[j + 1, :size], block[j + 2, :size], block[j + 3, :size]
            pe, pf, pg, ph, qe, qf, qg, qh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            re, rf, rg, rh, se, sf, sg, sh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(size):
                a, b, c, d, w = e[k], f[k], g[k], h[k], weight[k]
                x = w * p[k]
                pe += x * a
                pf += x * b
                pg += x * c
                ph += x * d
                x = w * q[k]
                qe += x * a
                qf += x * b
                qg += x * c
                qh += x * d
                x = w * r[k]
                re += x * a
                rf += x * b
                rg += x * c
                rh += x * d
                x = w * s[k]
                se += x * a
                sf += x * b
                sg += x * c
                sh += x * d
            found = (pe, pf, pg, ph), (qe, qf, qg, qh), (re, rf, rg, rh), (se, sf, sg, sh)
            for y in range(4):
                for x in range(4):
                    sums[i + y, j + x] += found[y][x]


@jit
def centred(sums, centre, mean, cov):
    """Mean (n,) and covariance (n, n), both written, from the sums of `add_moments` about a centre (n,)."""
    n = centre.size
    for i in range(n):
        mean[i] = centre[i] + sums[n, i]
        for j in range(i + 1):
            cov[i, j] = sums[i, j] - sums[n, i] * sums[n, j]
            cov[j, i] = cov[i, j]


@jit
def _factors(phi, used):
    """Which states each state after a transition takes from: used[i, 0] of them, their numbers after it."""
    for i in range(len(phi)):
        count = 0
        for j in range(len(phi)):
            if phi[i, j] != 0.0:
                count += 1
                used[i, count] = j
        used[i, 0] = count


@jit(fastmath=SUMS)
def _add_four(cloud, factors, used, first, start, out):
    """Add factors[j] cloud[j] of the states used from number `first` on, four at a time."""
    stop, count = start + out.size, used[0]
    for n in range(first, count + 1, 4):
        h, i, j, k = used[n], used[min(n + 1, count)], used[min(n + 2, count)], used[min(n + 3, count)]
        one, two, three, four = cloud[h, start:stop], cloud[i, start:stop], cloud[j, start:stop], cloud[k, start:stop]
        a, b = factors[h], (factors[i] if n + 1 <= count else 0.0)
        c, d = (factors[j] if n + 2 <= count else 0.0), (factors[k] if n + 3 <= count else 0.0)
        for x in range(out.size):
            out[x] += (a * one[x] + b * two[x]) + (c * three[x] + d * four[x])


@jit(fastmath=SUMS)
def _carried(cloud, factors, used, start, out):
    """out[k] = sum of factors[j] cloud[j, start + k] over the states used (`_factors`)."""
    stop, count = start + out.size, used[0]
    if count == 0:
        out[:] = 0.0
        return
    one, two = cloud[used[1], start:stop], cloud[used[min(2, count)], start:stop]
    a, b = factors[used[1]], (factors[used[2]] if count > 1 else 0.0)
    for k in range(out.size):
        out[k] = a * one[k] + b * two[k]
    _add_four(cloud, factors, used, 3, start, out)


@jit(fastmath=SUMS)
def _spread(cloud, factors, used, start, noise, by, out):
    """As `_carried`, and by[0] noise[0] + by[1] noise[1] on top."""
    stop, count = start + out.size, used[0]
    e, f, c, d = noise[0, : out.size], noise[1, : out.size], by[0], by[1]
    if count == 0:
        for k in range(out.size):
            out[k] = c * e[k] + d * f[k]
        return
    one, two = cloud[used[1], start:stop], cloud[used[min(2, count)], start:stop]
    a, b = factors[used[1]], (factors[used[2]] if count > 1 else 0.0)
    for k in range(out.size):
        out[k] = (a * one[k] + b * two[k]) + (c * e[k] + d * f[k])
    _add_four(cloud, factors, used, 3, start, out)


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
    block, white, used = np.zeros((n // 4 * 4 + 4, BLOCK)), np.empty((2, BLOCK)), np.empty((d, d + 1), np.int64)
    block[n] = 1.0
    expected, centre, sums = np.zeros(n), np.zeros(n), np.zeros((len(block), len(block)))
    square, own = np.empty((n, n)), np.empty((2, n))
    _factors(phi, used)
    for i in range(COMMON):
        for j in range(d):
            expected[i] += phi[i, j] * mean[j]
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        size = stop - start
        for i in range(COMMON):
            row, away, middle = out[i, start:stop], block[i, :size], expected[i]
            _carried(cloud, phi[i], used[i], start, row)
            for k in range(size):
                away[k] = row[k] - middle
        block[COMMON, :size], block[COMMON + 1, :size] = noise[0, start:stop], noise[1, start:stop]
        add_moments(block, weight[start:stop], sums)
    centred(sums, expected, centre, square)
    _whitening(square, own)
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        size = stop - start
        for a in range(2):
            _combined(out, noise, start, own[a], centre, white[a, :size])
        e, f = white[0, :size], white[1, :size]
        for i in range(COMMON):
            row, a, b = out[i, start:stop], spread[i, 0], spread[i, 1]
            for k in range(size):
                row[k] += a * e[k] + b * f[k]
        for i in range(COMMON, d):
            _spread(cloud, phi[i], used[i], start, white, spread[i], out[i, start:stop])


@jit(fastmath=SUMS)
def _combined(cloud, noise, start, factors, centre, out):
    """out = the sum of four rows of a cloud and two of noise about their centres, times their factors."""
    stop, constant = start + out.size, 0.0
    one, two, three, four = cloud[0, start:stop], cloud[1, start:stop], cloud[2, start:stop], cloud[3, start:stop]
    five, six = noise[0, start:stop], noise[1, start:stop]
    a, b, c, d, e, f = factors
    for i in range(6):
        constant -= factors[i] * centre[i]
    for k in range(out.size):
        out[k] = constant + (a * one[k] + b * two[k] + c * three[k]) + (d * four[k] + e * five[k] + f * six[k])


@jit(fastmath=SUMS)
def moments(cloud, weight):
    """Mean (d,) and covariance (d, d) of a cloud (d, m) under the weights (m,)."""
    d, m = cloud.shape
    mean, cov, centre, block = np.zeros(d), np.zeros((d, d)), np.empty(d), np.zeros((d // 4 * 4 + 4, BLOCK))
    block[d] = 1.0
    sums = np.zeros((len(block), len(block)))
    for i in range(d):
        row, total = cloud[i], 0.0
        for k in range(m):
            total += weight[k] * row[k]
        centre[i] = total
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        for i in range(d):
            row, away, middle = cloud[i, start:stop], block[i, : stop - start], centre[i]
            for k in range(row.size):
                away[k] = row[k] - middle
        add_moments(block, weight[start:stop], sums)
    sums[d, :] = 0.0  # the centre is the mean but for rounding
    centred(sums, centre, mean, cov)
    return mean, cov


@jit
def regime(bad, share, keep, out):
    """Let the bad regimes (kinds, m) come and go: out = share + keep (bad - share); keep : (kinds,)."""
    for i in range(len(bad)):
        row, after, stay = bad[i], out[i], keep[i]
        for k in range(row.size):
            after[k] = share + stay * (row[k] - share)


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

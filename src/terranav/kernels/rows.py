"""Work on one row of a density at a time, short enough to stay in the first cache.

Rows are told as float64 arrays laid flat and the place of their first cell. Neighbours then differ by an unsigned
offset only, so that the vector loop has neither an overlap nor a negative index to test; and no view is made, whose
references would be counted twice a row, a tenth of the time in all. The compiler may take sums in several lanes
("reassoc"): they are the same ones each time, and NaN keeps its meaning.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit

SUMS = {"contract", "reassoc"}
BLOCK = 4  # rows diffused at once
FLOOR = 1e-300  # densities below are zero: denormals cost time and mean nothing


@jit
def half_taps(variance):
    """Middle and one side of symmetric taps that sum to one and have this variance [cells^2], then zeros.

    The side has 0, 1 or a multiple of four taps. Below half a squared cell three taps do it exactly (q/2, 1 - q, q/2),
    however small the growth of one step; above, a sampled Gaussian out to 5 sigma, whose own sampling error is below
    1e-4 of the variance there.
    """
    if variance <= 0.0:
        return np.ones(1)
    if variance <= 0.5:
        return np.array([1.0 - variance, 0.5 * variance])
    radius = math.ceil(5.0 * math.sqrt(variance))
    taps = np.zeros(4 * ((radius + 3) // 4) + 1)
    total = 0.0
    for k in range(radius + 1):
        taps[k] = math.exp(-0.5 * k * k / variance)
        total += taps[k] if k == 0 else 2.0 * taps[k]
    return taps / total


@jit(fastmath=SUMS)
def _three_of_four(flat, first, stride, taps, out, at, step, size):
    """`_three` for four rows at once, of which each source row is fetched once."""
    t0, t1, two, three, four = taps[0], taps[1], stride + stride, stride + stride + stride, np.uint64(4) * stride
    for j in range(size):
        k, to = first + np.uint64(j), at + np.uint64(j)
        a, b, c, d = flat[k - stride], flat[k], flat[k + stride], flat[k + two]
        e, f = flat[k + three], flat[k + four]
        one, other = t0 * b + t1 * (a + c), t0 * c + t1 * (b + d)
        third, last = t0 * d + t1 * (c + e), t0 * e + t1 * (d + f)
        out[to], out[to + step], out[to + step + step], out[to + step + step + step] = one, other, third, last


@jit(fastmath=SUMS)
def _nine_of_four(flat, first, stride, taps, out, at, step, size):
    """`_nine` for four rows at once: twelve rows are fetched instead of thirty-six."""
    t0, t1, t2, t3, t4 = taps[0], taps[1], taps[2], taps[3], taps[4]
    s2, s3, s4 = stride + stride, stride + stride + stride, np.uint64(4) * stride
    s5, s6, s7 = s4 + stride, s4 + s2, s4 + s3
    for j in range(size):
        k, to = first + np.uint64(j), at + np.uint64(j)
        a, b, c, d = flat[k - s4], flat[k - s3], flat[k - s2], flat[k - stride]
        e, f, g, h = flat[k], flat[k + stride], flat[k + s2], flat[k + s3]
        m, n, o, p = flat[k + s4], flat[k + s5], flat[k + s6], flat[k + s7]
        one = t0 * e + t1 * (d + f) + t2 * (c + g) + t3 * (b + h) + t4 * (a + m)
        other = t0 * f + t1 * (e + g) + t2 * (d + h) + t3 * (c + m) + t4 * (b + n)
        third = t0 * g + t1 * (f + h) + t2 * (e + m) + t3 * (d + n) + t4 * (c + o)
        last = t0 * h + t1 * (g + m) + t2 * (f + n) + t3 * (e + o) + t4 * (d + p)
        out[to], out[to + step], out[to + step + step], out[to + step + step + step] = one, other, third, last


@jit(fastmath=SUMS)
def _four_more(flat, first, stride, taps, k, out, at, size):
    """Add the neighbours k .. k + 3 on either side."""
    t0, t1, t2, t3 = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
    s0 = np.uint64(k) * stride
    s1, s2, s3 = s0 + stride, s0 + stride + stride, s0 + stride + stride + stride
    for j in range(size):
        k = first + np.uint64(j)
        near = t0 * (flat[k - s0] + flat[k + s0]) + t1 * (flat[k - s1] + flat[k + s1])
        far = t2 * (flat[k - s2] + flat[k + s2]) + t3 * (flat[k - s3] + flat[k + s3])
        out[at + np.uint64(j)] += near + far


@jit(fastmath=SUMS)
def _add(flat, first, tap, out, at, size):
    """Add weighted cells."""
    for j in range(size):
        out[at + np.uint64(j)] += tap * flat[first + np.uint64(j)]


@jit(fastmath=SUMS)
def blur(flat, first, stride, taps, out, at, size):
    """Weighted sums of the cells around flat[first + j], `stride` apart, into out[at + j]; taps are `half_taps`.

    In one piece: a function that hands arrays on within a branch counts their references each time.
    """
    first, s1, at = np.uint64(first), np.uint64(stride), np.uint64(at)
    s2, s3, s4 = s1 + s1, s1 + s1 + s1, s1 + s1 + s1 + s1
    if taps.size == 1:
        for j in range(size):
            out[at + np.uint64(j)] = flat[first + np.uint64(j)]
    elif taps.size == 2:
        t0, t1 = taps[0], taps[1]
        for j in range(size):
            k = first + np.uint64(j)
            out[at + np.uint64(j)] = t0 * flat[k] + t1 * (flat[k - s1] + flat[k + s1])
    else:
        t0, t1, t2, t3, t4 = taps[0], taps[1], taps[2], taps[3], taps[4]
        for j in range(size):
            k = first + np.uint64(j)
            near = t0 * flat[k] + t1 * (flat[k - s1] + flat[k + s1]) + t2 * (flat[k - s2] + flat[k + s2])
            far = t3 * (flat[k - s3] + flat[k + s3]) + t4 * (flat[k - s4] + flat[k + s4])
            out[at + np.uint64(j)] = near + far
        for n in range(5, taps.size, 4):
            _four_more(flat, first, s1, taps, n, out, at, size)


@jit(forceinline=True)
def blur_across(flat, rows, i, taps, out, at, size):
    """Row i of a density of so many rows convolved with the taps along its columns, into out[at:]; zero outside."""
    radius = taps.size - 1
    if i >= radius and i + radius < rows:
        blur(flat, i * size, size, taps, out, at, size)
    else:
        for j in range(at, at + size):
            out[j] = 0.0
        for k in range(max(-radius, -i), min(radius, rows - 1 - i) + 1):
            _add(flat, np.uint64((i + k) * size), taps[abs(k)], out, np.uint64(at), size)


@jit(forceinline=True)
def blur_block(flat, rows, i, count, taps, out, at, step, size):
    """Rows i .. i + count - 1 (at most BLOCK) as `blur_across` gives them, `step` apart in out[at:]."""
    radius = taps.size - 1
    if count == BLOCK and radius > 0 and i >= radius and i + count - 1 + radius < rows:
        first, stride, to, apart = np.uint64(i * size), np.uint64(size), np.uint64(at), np.uint64(step)
        if radius == 1:
            _three_of_four(flat, first, stride, taps, out, to, apart, size)
        else:
            _nine_of_four(flat, first, stride, taps, out, to, apart, size)
            for r in range(BLOCK):
                for k in range(5, radius + 1, 4):
                    row, target = np.uint64((i + r) * size), np.uint64(at + r * step)
                    _four_more(flat, row, stride, taps, k, out, target, size)
    else:
        for r in range(count):
            blur_across(flat, rows, i + r, taps, out, at + r * step, size)


@jit(fastmath=SUMS)
def total_of(flat, first, size):
    """Sum of flat[first : first + size]; NaN where one of them is."""
    total, start = 0.0, np.uint64(first)
    for j in range(size):
        total += flat[start + np.uint64(j)]
    return total


@jit(fastmath=SUMS)
def copy_row(flat, first, out, at, size):
    """Copy cells from one array to another."""
    here, to = np.uint64(first), np.uint64(at)
    for j in range(size):
        out[to + np.uint64(j)] = flat[here + np.uint64(j)]


@jit(fastmath=SUMS)
def scale(flat, factor):
    """Multiply in place; what is below FLOOR becomes zero."""
    for j in range(flat.size):
        p = factor * flat[j]
        flat[j] = p if p > FLOOR else 0.0


@jit(fastmath=SUMS)
def measure_row(flat, first, before, east, cols_mass, out, at):
    """Copy the row at flat[first:] to out[at:] and add it to the column sums.

    Returns
    -------
    mass, first moment, sum p^2, and sum (dp)^2 to the row at flat[before:] and along the row, where the first cell has
    no change
    """
    mass, moment, power, step_n, step_e, last = 0.0, 0.0, 0.0, 0.0, 0.0, flat[first]
    here, below, to = np.uint64(first), np.uint64(before), np.uint64(at)
    for j in range(east.size):
        k = np.uint64(j)
        p = flat[here + k]
        out[to + k] = p
        mass += p
        moment += p * east[j]
        cols_mass[j] += p
        power += p * p
        north, along = p - flat[below + k], p - last
        step_n += north * north
        step_e += along * along
        last = p
    return mass, moment, power, step_n, step_e

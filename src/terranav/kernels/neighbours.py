"""An order of particles in which neighbours in the list are neighbours on the ground.

Systematic resampling of an ordered cloud has a smaller variance (Kitagawa, J. Comput. Graph. Stat. 5, 1996; Gerber,
Chopin and Whiteley, Ann. Statist. 47, 2019), and a weight that changes a little moves a copy a little, not across the
cloud. Sorting by counting takes 3 ns a particle where comparisons take 70.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit

LEVELS = 4096  # of north and of east between the least and the greatest, a power of two, finer than strips are wide


@jit
def extent(values):
    """Least and greatest; as many side by side as fit in the nearest cache, so that none waits for another."""
    lanes = min(512, values.size)
    low, high = values[:lanes].copy(), values[:lanes].copy()
    for begin in range(lanes, values.size, lanes):
        part = values[begin : begin + lanes]
        for k in range(part.size):
            low[k] = part[k] if part[k] < low[k] else low[k]
            high[k] = part[k] if part[k] > high[k] else high[k]
    return low.min(), high.max()


@jit
def _places(values):
    """Factor and addend that put the values between 0 and LEVELS.

    Levels are a power of two wide and stand still: one particle more or less at the rim moves no other into another.
    """
    least, greatest = extent(values)
    scale = 2.0 ** np.floor(np.log2((LEVELS - 1.0) / max(greatest - least, 1e-3)))
    return scale, -np.floor(least * scale)


@jit
def _strips(north, weight, strips, out):
    """Number of the strip: the weight further south, rising linearly within each level, times how many there are."""
    scale, addend = _places(north)
    share, before = np.zeros(LEVELS), np.empty(LEVELS)
    for k in range(north.size):
        share[np.uint64(north[k] * scale + addend)] += weight[k]
    total = 0.0
    for j in range(LEVELS):
        before[j], total = total, total + share[j]
    for k in range(north.size):
        place = north[k] * scale + addend
        at = np.uint64(place)
        out[k] = min(int((before[at] + (place - np.floor(place)) * share[at]) * strips), strips - 1)


@jit
def _starts(count):
    """From how many there are of each number to where the first of each stands, in place."""
    before = 0
    for k in range(count.size):
        before, count[k] = before + count[k], before


@jit
def neighbours_together(north, east, weight, scratch):
    """Strips of equal weight from south to north, along each to the east and along the next back to the west.

    Two sorts by counting, the second of which keeps the order of the first, on north and east rounded to LEVELS.

    Parameters
    ----------
    north, east, weight : (m,) float64, the weights sum to one
    scratch : (4, m + 1) int32, written
        The first m of its first row are the particles' numbers in order.
    """
    m = weight.size
    strips = int(np.sqrt(m))  # as many as copies within each
    strip, level, by_east = scratch[0, :m], scratch[1, :m], scratch[2:].reshape(2 * m + 2).view(np.int64)
    _strips(north, weight, strips, strip)
    scale, addend = _places(east)
    for k in range(m):
        level[k] = np.int32(east[k] * scale + addend)
    in_level, in_strip = np.zeros(LEVELS, np.int32), np.zeros(strips, np.int32)
    for k in range(m):
        in_strip[np.uint64(strip[k])] += 1
    for k in range(m):  # a loop of its own: in one with the strips each step waited for the one before, 3 ns
        a = level[k] ^ (-(strip[k] & 1) & (LEVELS - 1))  # in each second strip from the other end, without a branch
        level[k] = a
        in_level[np.uint64(a)] += 1
    _starts(in_level)
    _starts(in_strip)
    for k in range(m):  # the strip goes along with the number, so that it need not be looked up out of order
        a = np.uint64(level[k])
        by_east[np.uint64(in_level[a])] = np.int64(strip[k]) << 32 | k
        in_level[a] += 1
    for k in range(m):
        s = np.uint64(by_east[k] >> 32)
        strip[np.uint64(in_strip[s])] = by_east[k] & 0xFFFFFFFF
        in_strip[s] += 1

"""Normal numbers by counter: number i of a key is a function of the key and i, of nothing else.

Philox 4x32 with ten rounds (Salmon, Moraes, Dror and Shaw, Parallel random numbers: as easy as 1, 2, 3, SC 2011) turns
the counter into 128 bits; Box and Muller (Ann. Math. Statist. 29, 1958) turn those into two normal numbers. All of it
runs over vector registers, nothing is summed and no multiply-add is fused, so that each machine gives the same bits.

The radius comes from 52 bits, u = (k + 1/2) / 2^52: no number is larger than 8.572, and P(|z| > 8.572) = 1e-17.
Logarithm, sine and cosine are polynomials: a number is off by less than 1e-13 of the pair's radius.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit

BLOCK = 1024  # pairs whose bits wait in the nearest cache

_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_LOW, _HALF = np.uint64(0xFFFFFFFF), np.uint64(32)
_ONE = np.uint64(0x3FF0000000000000)  # the bits of 1.0: with 52 random bits below them, a number in [1, 2)
_SQRT_HALF = np.int64(0x3FE6A09E667F3BCD)
_TWELVE, _MANTISSA, _TOP, _TWO = np.uint64(12), np.int64(52), np.uint64(63), np.uint64(2)


@jit(forceinline=True)
def philox(key, low, high):
    """Philox 4x32-10 of a 64-bit key and a 128-bit counter in two halves: two 64-bit halves."""
    k0, k1 = key & _LOW, key >> _HALF
    x0, x1, x2, x3 = low & _LOW, low >> _HALF, high & _LOW, high >> _HALF
    for _ in range(10):
        p0, p1 = _MULTIPLIER_0 * (x0 & _LOW), _MULTIPLIER_1 * (x2 & _LOW)
        x0, x1, x2, x3 = (p1 >> _HALF) ^ x1 ^ k0, p1, (p0 >> _HALF) ^ x3 ^ k1, p0  # rubbish above bit 32 does no harm
        k0, k1 = (k0 + _WEYL_0) & _LOW, (k1 + _WEYL_1) & _LOW
    return (x0 & _LOW) | (x1 << _HALF), (x2 & _LOW) | (x3 << _HALF)


@jit(forceinline=True)
def _one_to_two(bits):
    """1 + k / 2^52 of the upper 52 bits."""
    return np.uint64((bits >> _TWELVE) | _ONE).view(np.float64)


@jit(forceinline=True)
def _minus_two_log(u):
    """-2 ln(u) for u in (0, 1) to a relative error below 1e-13.

    u = 2^e m, m in [1/sqrt(2), sqrt(2)); 2 ln(m) = 4 artanh(s), s = (m - 1) / (m + 1), a polynomial in s^2
    times s.
    """
    bits = np.float64(u).view(np.int64)
    e = (bits - _SQRT_HALF) >> _MANTISSA
    m = np.int64(bits - (e << _MANTISSA)).view(np.float64)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    z2 = z * z
    p = 3.9999999999998943 + z * 1.3333333335915856
    p += z2 * ((0.7999998978365328 + z * 0.5714433229267627) + z2 * (0.44348499787030154 + z * 0.3921619171754052))
    return e * -1.3862943611198906 - s * p


@jit(forceinline=True)
def _sine_cosine(x):
    """Sine and cosine of x pi / 2, |x| <= 1/2, each to 1e-14."""
    y = x * x
    y2 = y * y
    y4 = y2 * y2
    sine = (1.57079632679489 + y * -0.645964097504309) + y2 * (0.07969262615574647 + y * -0.004681752591462536)
    sine = x * (sine + y4 * (0.0001604292650640847 + y * -3.5563862913813773e-06))
    cosine = (1.0 + y * -1.2337005501361513) + y2 * (0.2536695078998646 + y * -0.02086348073494432)
    cosine += y4 * ((0.0009192599500239531 + y * -2.520013520024121e-05) + y2 * 4.655295323053466e-07)
    return sine, cosine


@jit(forceinline=True)
def box_muller(first, second):
    """Two normal numbers of twice 64 bits; the second's lowest two say which quadrant."""
    radius = np.sqrt(_minus_two_log(_one_to_two(first) - (1.0 - 2.0**-53)))
    radius = np.uint64(np.float64(radius).view(np.uint64) ^ np.uint64(second << _TOP)).view(np.float64)
    sine, cosine = _sine_cosine(_one_to_two(second) - 1.5)
    swapped = (second & _TWO) != np.uint64(0)
    return radius * (sine if swapped else cosine), radius * (cosine if swapped else sine)


@jit
def _bits(key, first, count, left, right):
    """Pairs first, first + 1, ... of 64 bits; a loop of its own, for its long chain leaves no room for another."""
    for k in range(count):
        left[k], right[k] = philox(key, np.uint64(first + k), np.uint64(0))


@jit
def normal_pairs(key, first, left, right):
    """Numbers 2 (first + k) and 2 (first + k) + 1 of a key.

    Parameters
    ----------
    key : uint64
    first : int, the pair to begin with
    left, right : (n,) float64, written
    """
    a, b = np.empty(BLOCK, np.uint64), np.empty(BLOCK, np.uint64)
    for begin in range(0, left.size, BLOCK):
        count = min(BLOCK, left.size - begin)
        _bits(np.uint64(key), first + begin, count, a, b)
        one, other = left[begin : begin + count], right[begin : begin + count]
        for k in range(count):
            one[k], other[k] = box_muller(a[k], b[k])


@jit
def normals(key, out):
    """Fill an array with independent standard normal numbers; number i depends on the key and on i only.

    Parameters
    ----------
    key : uint64
    out : (n,) float64, contiguous, written
    """
    a, b = np.empty(BLOCK, np.uint64), np.empty(BLOCK, np.uint64)
    pairs = out.size // 2
    for begin in range(0, pairs, BLOCK):
        count = min(BLOCK, pairs - begin)
        _bits(np.uint64(key), begin, count, a, b)
        block = out[2 * begin : 2 * (begin + count)]
        for k in range(count):
            block[2 * k], block[2 * k + 1] = box_muller(a[k], b[k])
    if out.size % 2:
        _bits(np.uint64(key), pairs, 1, a, b)
        out[-1] = box_muller(a[0], b[0])[0]

"""Elementary functions that the compiler can lay out over vector registers.

All are laid open in their caller's loop, and need no instruction that AVX2 lacks: a number of modest size is rounded by
adding 1.5 * 2^52, which leaves the whole part in the lowest bits, and shifting those up writes the exponent of 2^k.
Only products and sums are contracted: were sums reassociated, the rounding would cancel.
"""

from __future__ import annotations

import numpy as np

from terranav.kernels.jit import jit

LEAST_EXPONENT = -708.0  # exp of it is the smallest normal number, but for a factor of two
LEAST_POWER = -1021.4  # the same for 2^x
_LOG2_E = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # of which high * 2^k is exact
_ROUND = 6755399441055744.0  # 1.5 * 2^52


@jit(fastmath={"contract"}, forceinline=True)
def fast_exp(x):
    """exp(x) for x <= 0 to a relative error below 4e-15, x held at LEAST_EXPONENT.

    exp(x) = 2^k exp(r), |r| <= ln(2)/2, with a polynomial of degree 10 through the Chebyshev nodes.
    """
    x = LEAST_EXPONENT if x < LEAST_EXPONENT else x  # NaN stays NaN
    shifted = x * _LOG2_E + _ROUND
    k = shifted - _ROUND
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    p = 1.984120875699232e-04 + r * (2.4801536409064087e-05 + r * (2.7625102005388108e-06 + r * 2.761379555451986e-07))
    p = 0.041666666666651364 + r * (0.008333333353717156 + r * (0.0013888888905871347 + r * p))
    p = 1.0 + r * (1.0 + r * (0.5 + r * (0.16666666666648303 + r * p)))
    return np.int64(np.float64(p).view(np.int64) + (np.float64(shifted).view(np.int64) << 52)).view(np.float64)


@jit(fastmath={"contract"}, forceinline=True)
def fast_exp2(x):
    """2^x for x <= 1000 to a relative error below 3e-12, x held at LEAST_POWER; 15 operations, `fast_exp` has 20."""
    x = LEAST_POWER if x < LEAST_POWER else x
    shifted = x + _ROUND
    f = x - (shifted - _ROUND)
    p = 0.00015403475186508684 + f * (1.5303700721574385e-05 + f * 1.3250805524574835e-06)
    p = 0.05550410906325891 + f * (0.009618129135236157 + f * (0.0013333478473653514 + f * p))
    p = 1.0 + f * (0.6931471805568324 + f * (0.24022650695888503 + f * p))
    return np.int64(np.float64(p).view(np.int64) + (np.float64(shifted).view(np.int64) << 52)).view(np.float64)


@jit(fastmath={"contract"}, forceinline=True)
def fast_rsqrt(x):
    """1/sqrt(x) for normal x > 0 to a relative error below 1e-15, in 11 operations where square root and quotient wait.

    Half the exponent, its sign turned, is good to 3.5 %. Two steps of the binomial series, 1/sqrt(1 - h) = 1 + h/2 +
    3 h^2/8 + 5 h^3/16 + ... with h = 1 - x y^2, leave its third and fourth power.
    """
    half = np.int64(np.uint64(np.float64(x).view(np.uint64)) >> np.uint64(1))
    y = np.int64(np.int64(0x5FE6EB50C7B537A9) - half).view(np.float64)
    h = 1.0 - x * y * y
    y = y + y * h * (0.5 + h * 0.375)
    h = 1.0 - x * y * y
    return y + y * h * (0.5 + h * (0.375 + h * 0.3125))


@jit(fastmath={"contract"}, forceinline=True)
def fast_log(x):
    """ln(x) for normal x > 0, good to 2e-15 of the greater of its size and one.

    x = 2^k m, sqrt(1/2) <= m < sqrt(2), and ln(m) = 2 artanh(s), s = (m - 1)/(m + 1), by its series to s^21.
    """
    least = np.uint64(0x3FE6A09E667F3BCD)  # the bits of sqrt(1/2)
    bits = np.uint64(np.float64(x).view(np.uint64)) + (np.uint64(0x3FF0000000000000) - least)
    k = np.uint64((bits >> np.uint64(52)) | np.uint64(0x4330000000000000)).view(np.float64) - 4503599627371519.0
    m = np.uint64((bits & np.uint64(0x000FFFFFFFFFFFFF)) + least).view(np.float64)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 1.0 / 15.0 + z * (1.0 / 17.0 + z * (1.0 / 19.0 + z * (1.0 / 21.0)))
    p = 1.0 / 7.0 + z * (1.0 / 9.0 + z * (1.0 / 11.0 + z * (1.0 / 13.0 + z * p)))
    p = 1.0 + z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * p))
    return k * _LN2_HIGH + (2.0 * s * p + k * _LN2_LOW)

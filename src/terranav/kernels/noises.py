"""Logarithms of the probability of many residuals at once, without a branch, so that they run over vector registers.

Each function may fuse a multiplication with an addition, which errs less than the two apart.
"""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.fastmath import fast_exp
from terranav.kernels.jit import jit

INTEGRAL, GAUSSIAN, LAPLACE, STUDENT_T, MIXTURE = range(5)
_SQRT_HALF = math.sqrt(0.5)
_BITS_OF_SQRT_HALF, _MANTISSA = np.int64(0x3FE6A09E667F3BCD), np.int64(52)
_LN2 = math.log(2.0)
_SHIFT, _SPAN = 4.4144, 7.4144  # q = 1 / (x + _SHIFT), t = 1 - _SPAN q: x from -1/sqrt(2) to infinity, t from -1 to 1
_E = (
    1.327186135319295, -1.661837913358212, 1.8235162029861869, -1.753890925407733, 1.4732067909684483,
    -1.0714886145389235, 0.664257351427909, -0.34103847078225963, 0.13674452258526432, -0.036543835893625254,
    0.0018737303661188645, 0.00361323837963285, -0.0015969716981967313, 4.1173577496829674e-05, 0.00021532673248224685,
    -6.039165083848751e-05, -2.015627702947237e-05, 1.2822130188442736e-05, 1.3666840201096448e-06,
    -1.9165443597190593e-06, -4.937164229560905e-08, 1.6791354176774657e-07,
)  # fmt: skip


@jit(forceinline=True, fastmath={"contract"})
def fast_log(x):
    """ln(x) for normal x > 0 to a relative error below 1e-14, near x = 1 too.

    x = 2^e m, m in [1/sqrt(2), sqrt(2)); ln(m) = 2 artanh(s), s = (m - 1) / (m + 1), by its series to s^19.
    """
    bits = np.float64(x).view(np.int64)
    e = (bits - _BITS_OF_SQRT_HALF) >> _MANTISSA
    m = np.int64(bits - (e << _MANTISSA)).view(np.float64)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    z2 = z * z
    p = (2.0 / 13.0 + z * (2.0 / 15.0)) + z2 * (2.0 / 17.0 + z * (2.0 / 19.0))
    p = (2.0 / 5.0 + z * (2.0 / 7.0)) + z2 * ((2.0 / 9.0 + z * (2.0 / 11.0)) + z2 * p)
    return e * _LN2 + s * ((2.0 + z * (2.0 / 3.0)) + z2 * p)


@jit(forceinline=True, fastmath={"contract"})
def _scaled_erfc(q):
    """exp(x^2) erfc(x) of q = 1 / (x + _SHIFT), x >= -1/sqrt(2), to a relative error below 2e-14.

    q times a polynomial in t, the Chebyshev series of degree 21, as Shepherd and Laframboise, Mathematics of
    Computation 36 (1981), have one for x >= 0.
    """
    t = 1.0 - _SPAN * q
    u = t * t
    even, odd = _E[20], _E[21]
    for k in (18, 16, 14, 12, 10, 8, 6, 4, 2, 0):
        even, odd = _E[k] + u * even, _E[k + 1] + u * odd
    return q * (even + t * odd)


@jit(forceinline=True, fastmath={"contract"})
def _cell(west, east, south, north, here, value, variance, per_row, share):
    """Residual and its variance at one cell, and whether the map says something; a difference with a void is none."""
    v, across, along = value - here, 0.5 * (east - west), per_row * (north - south)
    slope2 = (across * across if across == across else 0.0) + (along * along if along == along else 0.0)
    return v if v == v else 0.0, variance + share * slope2, v == v


@jit(fastmath={"contract"})
def _integral(line, south, north, told, half_width, out):
    """ln of the probability within +-half_width of the residual (papers/000 eq. 6), near and far into the tail.

    With a, b = (|v| -+ half_width) / (sqrt(2) sigma): b^2 - a^2 = 2 |v| half_width / sigma^2, and the probability is
    exp(-a^2) (E(a) - exp(a^2 - b^2) E(b)) / 2, E(x) = exp(x^2) erfc(x). One division serves three. A loop for each
    part, for together they have more constants than there are registers.
    """
    value, variance, per_row, share = told
    here, east = line[1 : 1 + out.size], line[2 : 2 + out.size]
    first, second, third = np.empty(out.size), np.empty(out.size), np.empty(out.size)
    for j in range(out.size):
        v, s2, solid = _cell(line[j], east[j], south[j], north[j], here[j], value, variance, per_row, share)
        first[j] = _SQRT_HALF * abs(v) if solid else np.nan
        second[j] = s2
    half = _SQRT_HALF * half_width
    for j in range(out.size):
        v, s2 = first[j], second[j]
        s = math.sqrt(s2)
        near, far = v - half, v + half
        one, other = near + _SHIFT * s, far + _SHIFT * s
        both = one * other
        once = 1.0 / (both * s2)
        per_variance, once = once * both, once * s2 * s
        first[j], second[j] = other * once, one * once
        third[j], out[j] = -4.0 * v * half * per_variance, near * near * per_variance
    for j in range(out.size):
        first[j] = _scaled_erfc(first[j])
    for j in range(out.size):
        second[j] = _scaled_erfc(second[j])
    for j in range(out.size):
        p = 0.5 * (first[j] - fast_exp(third[j]) * second[j])
        log_p = fast_log(p) - out[j]
        out[j] = log_p if p == p else np.nan


@jit(fastmath={"contract"})
def _gaussian(line, south, north, told, out):
    value, variance, per_row, share = told
    here, east = line[1 : 1 + out.size], line[2 : 2 + out.size]
    for j in range(out.size):
        v, s2, solid = _cell(line[j], east[j], south[j], north[j], here[j], value, variance, per_row, share)
        log_p = -0.5 * (v * v / s2 + fast_log(s2))
        out[j] = log_p if solid else np.nan


@jit(fastmath={"contract"})
def _laplace(line, south, north, told, out):
    value, variance, per_row, share = told
    here, east = line[1 : 1 + out.size], line[2 : 2 + out.size]
    for j in range(out.size):
        v, s2, solid = _cell(line[j], east[j], south[j], north[j], here[j], value, variance, per_row, share)
        log_p = -math.sqrt(2.0 * v * v / s2) - 0.5 * fast_log(s2)
        out[j] = log_p if solid else np.nan


@jit(fastmath={"contract"})
def _student_t(line, south, north, told, degrees, out):
    value, variance, per_row, share = told
    here, east = line[1 : 1 + out.size], line[2 : 2 + out.size]
    for j in range(out.size):
        v, s2, solid = _cell(line[j], east[j], south[j], north[j], here[j], value, variance, per_row, share)
        x = v * v / (s2 * (degrees - 2.0))
        y = 1.0 + x
        log1p = fast_log(y) + (x - (y - 1.0)) / y  # what the sum lost
        log_p = -0.5 * ((degrees + 1.0) * log1p + fast_log(s2))
        out[j] = log_p if solid else np.nan


@jit(fastmath={"contract"})
def _mixture(line, south, north, told, outlier_share, scale, out):
    log_good, log_bad = math.log1p(-outlier_share), math.log(outlier_share / scale)
    narrower = 1.0 / (scale * scale)
    value, variance, per_row, share = told
    here, east = line[1 : 1 + out.size], line[2 : 2 + out.size]
    for j in range(out.size):
        v, s2, solid = _cell(line[j], east[j], south[j], north[j], here[j], value, variance, per_row, share)
        square = 0.5 * v * v / s2
        good, bad = log_good - square, log_bad - narrower * square
        top = max(good, bad)
        log_p = top + fast_log(1.0 + fast_exp(min(good, bad) - top)) - 0.5 * fast_log(s2)
        out[j] = log_p if solid else np.nan


@jit
def log_probabilities(line, south, north, told, noise, settings, out):
    """Logarithms of the probability of a reading at each cell of a row, up to a constant that all cells share.

    Parameters
    ----------
    line : (cols + 2,) the map along the row with a cell more at either end, NaN where it says nothing [unit]
    south, north : (cols,) the rows before and after
    told : (value, variance, per_row, share)
        The reading, its variance, one over the rows from `south` to `north`, and how much of the map's squared change
        from cell to cell counts as noise.
    noise : int
        INTEGRAL, GAUSSIAN, LAPLACE, STUDENT_T (all of that variance) or MIXTURE.
    settings : (half_width, first, second)
        INTEGRAL: half the width of the interval of papers/000 eq. 6, at most the sigma; the logarithm errs by 2e-14
        sigma / half_width, that of all others by 1e-14, relative to the larger of 1 and itself. STUDENT_T: degrees of
        freedom, > 2. MIXTURE: share of outliers, how many times noisier they are.
    out : (cols,) written, NaN where the map says nothing
    """
    half_width, first, second = settings
    if noise == INTEGRAL:
        _integral(line, south, north, told, half_width, out)
    elif noise == LAPLACE:
        _laplace(line, south, north, told, out)
    elif noise == STUDENT_T:
        _student_t(line, south, north, told, first, out)
    elif noise == MIXTURE and first > 0.0:
        _mixture(line, south, north, told, first, second, out)
    else:
        _gaussian(line, south, north, told, out)

"""Logarithms of the probability of many residuals at once, without a branch, so that they run over vector registers.

Each function may fuse a multiplication with an addition, which errs less than the two apart.
"""

from __future__ import annotations

import math

from terranav.kernels.fastmath import fast_exp, fast_log
from terranav.kernels.jit import jit

INTEGRAL, GAUSSIAN, LAPLACE, STUDENT_T, MIXTURE = range(5)
_SQRT_HALF = math.sqrt(0.5)
_SHIFT, _SPAN = 4.4144, 7.4144  # q = 1 / (x + _SHIFT), t = 1 - _SPAN q: x from -1/sqrt(2) to infinity, t from -1 to 1
_E = (
    1.327186135319295, -1.661837913358212, 1.8235162029861869, -1.753890925407733, 1.4732067909684483,
    -1.0714886145389235, 0.664257351427909, -0.34103847078225963, 0.13674452258526432, -0.036543835893625254,
    0.0018737303661188645, 0.00361323837963285, -0.0015969716981967313, 4.1173577496829674e-05, 0.00021532673248224685,
    -6.039165083848751e-05, -2.015627702947237e-05, 1.2822130188442736e-05, 1.3666840201096448e-06,
    -1.9165443597190593e-06, -4.937164229560905e-08, 1.6791354176774657e-07,
)  # fmt: skip


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


@jit
def _residuals(line, south, north, told, residual, variance):
    """Reading less map, NaN where it says nothing, and the variance of that; a difference with a void is none."""
    value, least, per_row, share = told
    here, east = line[1 : 1 + residual.size], line[2 : 2 + residual.size]
    for j in range(residual.size):
        across, along = 0.5 * (east[j] - line[j]), per_row * (north[j] - south[j])
        slope2 = (across * across if across == across else 0.0) + (along * along if along == along else 0.0)
        residual[j] = value - here[j]
        variance[j] = least + share * slope2


@jit(fastmath={"contract"})
def _integral(residual, variance, half_width, rest, out):
    """ln of the probability within +-half_width of the residual (papers/000 eq. 6), near and far into the tail.

    With a, b = (|v| -+ half_width) / (sqrt(2) sigma): b^2 - a^2 = 2 |v| half_width / sigma^2, and the probability is
    exp(-a^2) (E(a) - exp(a^2 - b^2) E(b)) / 2, E(x) = exp(x^2) erfc(x). One division serves three. A loop for each
    part, for together they have more constants than there are registers.
    """
    half = _SQRT_HALF * half_width
    for j in range(out.size):
        v, s2 = _SQRT_HALF * abs(residual[j]), variance[j]
        s = math.sqrt(s2)
        near, far = v - half, v + half
        one, other = near + _SHIFT * s, far + _SHIFT * s
        both = one * other
        once = 1.0 / (both * s2)
        per_variance, once = once * both, once * s2 * s
        residual[j], variance[j] = other * once, one * once
        rest[j], out[j] = -4.0 * v * half * per_variance, near * near * per_variance
    for j in range(out.size):
        residual[j] = _scaled_erfc(residual[j])
    for j in range(out.size):
        variance[j] = _scaled_erfc(variance[j])
    for j in range(out.size):
        residual[j] = 0.5 * (residual[j] - fast_exp(rest[j]) * variance[j])
    for j in range(out.size):
        out[j] = fast_log(residual[j]) - out[j]


@jit(fastmath={"contract"})
def _gaussian(residual, variance, out):
    for j in range(out.size):
        v, s2 = residual[j], variance[j]
        out[j] = -0.5 * (v * v / s2 + fast_log(s2))


@jit(fastmath={"contract"})
def _laplace(residual, variance, out):
    for j in range(out.size):
        v, s2 = residual[j], variance[j]
        out[j] = -math.sqrt(2.0 * v * v / s2) - 0.5 * fast_log(s2)


@jit(fastmath={"contract"})
def _student_t(residual, variance, degrees, out):
    for j in range(out.size):
        v, s2 = residual[j], variance[j]
        residual[j] = v * v / (s2 * (degrees - 2.0))
    for j in range(out.size):
        x = residual[j]
        y = 1.0 + x
        out[j] = fast_log(y) + (x - (y - 1.0)) / y  # what the sum lost
    for j in range(out.size):
        out[j] = -0.5 * ((degrees + 1.0) * out[j] + fast_log(variance[j]))


@jit(fastmath={"contract"})
def _mixture(residual, variance, outlier_share, scale, out):
    log_good, log_bad = math.log1p(-outlier_share), math.log(outlier_share / scale)
    narrower = 1.0 / (scale * scale)
    for j in range(out.size):
        v, s2 = residual[j], variance[j]
        square = 0.5 * v * v / s2
        good, bad = log_good - square, log_bad - narrower * square
        out[j], residual[j] = max(good, bad), -abs(good - bad)
    for j in range(out.size):
        residual[j] = 1.0 + fast_exp(residual[j])
    for j in range(out.size):
        out[j] += fast_log(residual[j])
    for j in range(out.size):
        out[j] -= 0.5 * fast_log(variance[j])


@jit
def log_probabilities(line, south, north, told, noise, settings, work, out):
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
    work : (3, cols) room
    out : (cols,) written, NaN where the map says nothing
    """
    half_width, first, second = settings
    residual, variance = work[0], work[1]
    _residuals(line, south, north, told, residual, variance)
    if noise == INTEGRAL:
        _integral(residual, variance, half_width, work[2], out)
    elif noise == LAPLACE:
        _laplace(residual, variance, out)
    elif noise == STUDENT_T:
        _student_t(residual, variance, first, out)
    elif noise == MIXTURE and first > 0.0:
        _mixture(residual, variance, first, second, out)
    else:
        _gaussian(residual, variance, out)

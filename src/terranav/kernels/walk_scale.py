"""A bank of Kalman filters that differ in how much the INS wanders; (L, ...) arrays, one row a filter."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit


@jit
def linearised(rows, weight, residual, bias):
    """The map as a plane over a cloud: what a reading less bias and patch would be, by least squares under the weights.

    Parameters
    ----------
    rows : (m, d), weight : (m,), residual : (m,) of `kernels.marginalized.compare`
    bias : index of the bias, the patch being the next

    Returns
    -------
    (6,) mean position (2), minus mean height against the reading, slope by position error (2), mean square left over;
    the third is mean(reading - height). NaN where the map says nothing.
    """
    out = np.full(6, np.nan)
    total, a, b, h = 0.0, 0.0, 0.0, 0.0
    for k in range(weight.size):
        r = residual[k]
        if r == r:
            w = weight[k]
            total += w
            a += w * rows[k, 0]
            b += w * rows[k, 1]
            h += w * (r + rows[k, bias] + rows[k, bias + 1])
    if total <= 0.5:
        return out
    a, b, h = a / total, b / total, h / total
    aa, ab, bb, ha, hb, hh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(weight.size):
        r = residual[k]
        if r == r:
            w = weight[k]
            u, v, g = rows[k, 0] - a, rows[k, 1] - b, r + rows[k, bias] + rows[k, bias + 1] - h
            aa += w * u * u
            ab += w * u * v
            bb += w * v * v
            ha += w * g * u
            hb += w * g * v
            hh += w * g * g
    det = aa * bb - ab * ab
    if det <= 1e-12 * (aa + bb) ** 2:
        return out
    north, east = (ha * bb - hb * ab) / det, (hb * aa - ha * ab) / det
    out[0], out[1], out[2] = a, b, h
    out[3], out[4] = -north, -east
    out[5] = max(hh - north * ha - east * hb, 0.0) / total
    return out


@jit
def stepped(mean, cov, phi, q, inertial, factors, out_mean, out_cov):
    """Predict every filter: the inertial block (inertial states) of q times the filter's factor.

    Parameters
    ----------
    mean : (L, d), cov : (L, d, d)
    phi, q : (d, d)
    inertial : int, states of the INS
    factors : (L,) of the variance
    out_mean, out_cov : written
    """
    for j in range(len(mean)):
        out_mean[j] = phi @ mean[j]
        grown = phi @ cov[j] @ phi.T
        for i in range(len(phi)):
            for k in range(len(phi)):
                factor = factors[j] if i < inertial and k < inertial else 1.0
                out_cov[j, i, k] = grown[i, k] + factor * q[i, k]


@jit
def corrected(mean, cov, row, value, noise, outlier, use, out_mean, out_cov, likelihood):
    """Update every filter by the reading value = row x + noise.

    Parameters
    ----------
    mean : (L, d), cov : (L, d, d)
    row : (d,)
    value, noise : the reading, and the variance of its noise
    outlier : (2,) probability of an outlier, and the half width of its Cauchy density
    use : bool, False where the reading is one: then it weighs the filters but corrects none
    out_mean, out_cov : written
    likelihood : (L,) written
    """
    d = row.size
    for j in range(len(mean)):
        out_mean[j], out_cov[j] = mean[j], cov[j]
        gain, left = np.zeros(d), value
        for i in range(d):
            left -= row[i] * mean[j, i]
            for k in range(d):
                gain[i] += cov[j, i, k] * row[k]
        spread = noise
        for i in range(d):
            spread += row[i] * gain[i]
        near = math.exp(-0.5 * left * left / spread) / math.sqrt(2.0 * math.pi * spread)
        far = outlier[1] / (math.pi * (outlier[1] * outlier[1] + left * left))
        likelihood[j] = (1.0 - outlier[0]) * near + outlier[0] * far
        if use:
            for i in range(d):
                out_mean[j, i] += gain[i] * left / spread
                for k in range(d):
                    out_cov[j, i, k] -= gain[i] * gain[k] / spread

"""A bank of Kalman filters that differ in how much the INS wanders; (L, ...) arrays, one row a filter."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit
from terranav.kernels.marginalized import SUMS
from terranav.kernels.matrices import bayes, congruent


@jit(fastmath=SUMS)
def linearised(cloud, weight, residual, bias, centre):
    """The map as a plane over a cloud: what a reading less bias and patch would be, by least squares under the weights.

    Parameters
    ----------
    cloud : (d, m), weight : (m,), residual : (m,) value - map - bias - patch, NaN where the map says nothing
    bias : row of the bias, the patch being the next
    centre : (d,) about the mean of the cloud

    Returns
    -------
    (6,) mean position (2), mean of the reading less the map, slope by position error (2), mean square left over.
    NaN where the map says nothing.
    """
    out = np.full(6, np.nan)
    north, east, own, patch = cloud[0], cloud[1], cloud[bias], cloud[bias + 1]
    a, b, h = centre[0], centre[1], 0.0
    for k in range(weight.size):
        if residual[k] == residual[k]:
            h = residual[k] + own[k] + patch[k]
            break
    total, ma, mb, mh, aa, ab, bb, ha, hb, hh = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(weight.size):
        r = residual[k]
        w = weight[k] if r == r else 0.0
        u, v, g = north[k] - a, east[k] - b, (r + own[k] + patch[k] - h if r == r else 0.0)
        total += w
        ma += w * u
        mb += w * v
        mh += w * g
        aa += w * u * u
        ab += w * u * v
        bb += w * v * v
        ha += w * g * u
        hb += w * g * v
        hh += w * g * g
    if total <= 0.5:
        return out
    aa, ab, bb = aa - ma * ma / total, ab - ma * mb / total, bb - mb * mb / total
    ha, hb, hh = ha - mh * ma / total, hb - mh * mb / total, hh - mh * mh / total
    det = aa * bb - ab * ab
    if det <= 1e-12 * (aa + bb) ** 2:
        return out
    rise_n, rise_e = (ha * bb - hb * ab) / det, (hb * aa - ha * ab) / det
    out[0], out[1], out[2] = a + ma / total, b + mb / total, h + mh / total
    out[3], out[4] = -rise_n, -rise_e
    out[5] = max(hh - rise_n * ha - rise_e * hb, 0.0) / total
    return out


@jit
def stepped(mean, cov, phi, q, inertial, factors):
    """Predict every filter: the inertial block (inertial states) of q times the filter's factor.

    Parameters
    ----------
    mean : (L, d), cov : (L, d, d)
    phi, q : (d, d)
    inertial : int, states of the INS
    factors : (L,) of the variance

    Returns
    -------
    mean, cov : new arrays of the same shapes
    """
    d = len(phi)
    out_mean, out_cov, grown = np.zeros(mean.shape), np.empty(cov.shape), np.empty(phi.shape)
    for n in range(len(mean)):
        congruent(phi, cov[n], grown)
        for i in range(d):
            inner = factors[n] if i < inertial else 1.0
            for j in range(inertial):
                out_cov[n, i, j] = grown[i, j] + inner * q[i, j]
            for j in range(inertial, d):
                out_cov[n, i, j] = grown[i, j] + q[i, j]
            total = 0.0
            for j in range(d):
                if phi[i, j] != 0.0:
                    total += phi[i, j] * mean[n, j]
            out_mean[n, i] = total
    return out_mean, out_cov


@jit
def corrected(mean, cov, slope, bias, value, noise, share, reach, use, prior):
    """Update every filter by the reading value = slope p + bias + patch + noise, and the probabilities of the filters.

    Parameters
    ----------
    mean : (L, d), cov : (L, d, d)
    slope : (2,) by position
    bias : int, index of the bias, the patch being the next
    value, noise : the reading, and the variance of its noise
    share, reach : probability of an outlier, and the half width of its Cauchy density
    use : bool, False where the reading is one: then it weighs the filters but corrects none
    prior : (L,) probability of each filter

    Returns
    -------
    probability, mean, cov : new arrays of the same shapes
    """
    d = mean.shape[1]
    out_mean, out_cov, likelihood = mean.copy(), cov.copy(), np.empty(len(mean))
    gain = np.empty(d)
    for n in range(len(mean)):
        at, spread = mean[n], cov[n]
        left = value - slope[0] * at[0] - slope[1] * at[1] - at[bias] - at[bias + 1]
        for i in range(d):
            gain[i] = slope[0] * spread[i, 0] + slope[1] * spread[i, 1] + spread[i, bias] + spread[i, bias + 1]
        total = noise + slope[0] * gain[0] + slope[1] * gain[1] + gain[bias] + gain[bias + 1]
        near = math.exp(-0.5 * left * left / total) / math.sqrt(2.0 * math.pi * total)
        far = reach / (math.pi * (reach * reach + left * left))
        likelihood[n] = (1.0 - share) * near + share * far
        if use:
            for i in range(d):
                out_mean[n, i] += gain[i] * left / total
                for j in range(d):
                    out_cov[n, i, j] -= gain[i] * gain[j] / total
    return bayes(prior, likelihood), out_mean, out_cov

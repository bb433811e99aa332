"""Small matrices of one step, in loops: a call of BLAS costs more than the work, and its bits go with its threads."""

from __future__ import annotations

import math

import numpy as np

from terranav.kernels.jit import jit

NO_VARIANCE = 1e-12  # of the larger variance of the position: what is less is none
ROUNDING = 1e-14  # share of a variance below which a difference from it is but rounding


@jit
def product(a, b, out):
    """out = a b; zeros of a, of which a transition has many, cost nothing.

    Element by element: a row taken out counts its references, which costs as much as its sums.
    """
    rows, inner = a.shape
    cols = b.shape[1]
    for i in range(rows):
        for j in range(cols):
            out[i, j] = 0.0
        for k in range(inner):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(cols):
                    out[i, j] += factor * b[k, j]


@jit
def congruent(phi, cov, out):
    """out = phi cov phi' of a symmetric cov, as phi (phi cov)'."""
    half = np.empty(cov.shape)
    product(phi, cov, half)
    turned = half.T.copy()
    product(phi, turned, out)


@jit
def then(phi, q, later_phi, later_q):
    """Two transitions as one: later_phi phi, later_phi q later_phi' + later_q."""
    both, noise = np.empty(phi.shape), np.empty(q.shape)
    product(later_phi, phi, both)
    congruent(later_phi, q, noise)
    for i in range(len(q)):
        for j in range(len(q)):
            noise[i, j] += later_q[i, j]
    return both, noise


@jit
def predicted(phi, q, mean, cov, other):
    """After a transition: phi mean, phi C phi' + q, and the same of another covariance."""
    after, first, second = np.zeros(mean.size), np.empty(cov.shape), np.empty(cov.shape)
    congruent(phi, cov, first)
    congruent(phi, other, second)
    for i in range(mean.size):
        for j in range(mean.size):
            after[i] += phi[i, j] * mean[j]
            first[i, j] += q[i, j]
            second[i, j] += q[i, j]
    return after, first, second


@jit
def eigen2(a, b, c):
    """Eigenvalues, rising, of [a b; b c], and the matrix (2, 2) whose columns are their vectors."""
    half, middle = 0.5 * (a - c), 0.5 * (a + c)
    radius = math.hypot(half, b)
    values, vectors = np.empty(2), np.empty((2, 2))
    values[1] = middle + radius
    values[0] = (a * c - b * b) / values[1] if values[1] > 0.0 else middle - radius
    angle = 0.5 * math.atan2(b, half)
    cos, sin = math.cos(angle), math.sin(angle)
    vectors[0, 0], vectors[1, 0] = -sin, cos
    vectors[0, 1], vectors[1, 1] = cos, sin
    return values, vectors


@jit
def conditioned(phi, q, common):
    """A transition with the positions drawn and the rest conditioned on them.

    Parameters
    ----------
    phi, q : (d, d)
    common : (d, d) covariance given the positions, zero for these

    Returns
    -------
    spread : (d, 2), what two standard normal numbers add to the states
    common : (d, d) afterwards
    """
    d = len(phi)
    grown, inverse, root = np.empty((d, d)), np.zeros((2, 2)), np.zeros((2, 2))
    congruent(phi, common, grown)
    for i in range(d):
        for j in range(d):
            grown[i, j] += q[i, j]
    values, vectors = eigen2(grown[0, 0], grown[0, 1], grown[1, 1])
    condition = 1.0
    for k in range(2):
        if values[k] > max(NO_VARIANCE * values[1], 0.0):  # none where no time passes, or nothing drifts
            condition = max(condition, values[1] / values[k])
            for i in range(2):
                root[i, k] = vectors[i, k] * math.sqrt(values[k])
                for j in range(2):
                    inverse[i, j] += vectors[i, k] * vectors[j, k] / values[k]
    carry, spread, after = np.empty((d, 2)), np.empty((d, 2)), np.zeros((d, d))
    product(grown[:, :2], inverse, carry)
    product(carry, root, spread)
    for i in range(2, d):
        for j in range(2, i + 1):
            one = grown[i, j] - carry[i, 0] * grown[0, j] - carry[i, 1] * grown[1, j]
            two = grown[j, i] - carry[j, 0] * grown[0, i] - carry[j, 1] * grown[1, i]
            after[i, j] = 0.5 * (one + two)
            after[j, i] = after[i, j]
    _without_rounding(grown, ROUNDING * condition, after)
    return spread, after


@jit
def _without_rounding(cov, least, left):
    """Take out of `left`, a difference from cov, what is but rounding; where there is none, nothing changes.

    An INS without random walk moves by its velocity alone, so the positions tell it exactly. What a subtraction leaves
    of its variance is rounding of either sign, which its covariance with other states does not fit. Taken for knowledge
    and divided by at the next step, it would make anything of their variances. A state of which, given the positions
    and the states before it, no more than the share `least` of its variance in cov is left, is made a function of them.
    """
    d, found = len(cov), False
    factor = left.copy()  # column i becomes the covariance of the states with i, given those before i
    for i in range(2, d):
        known = not factor[i, i] > max(least * cov[i, i], 0.0)
        for j in range(i, d):
            if known:
                found = found or factor[j, i] != 0.0
                factor[j, i] = 0.0
            elif j > i:
                share = factor[j, i] / factor[i, i]
                for k in range(i + 1, j + 1):
                    factor[j, k] -= share * factor[k, i]
    if found:
        for i in range(2, d):
            for j in range(2, i + 1):
                left[i, j] = 0.0
                for k in range(2, j + 1):
                    if factor[k, k] > 0.0:
                        left[i, j] += factor[i, k] * factor[j, k] / factor[k, k]
                left[j, i] = left[i, j]


@jit
def kernel_of(cov, common, width, floor):
    """A normal kernel of covariance width^2 cov: its part in the positions is drawn, the rest goes into `common`.

    Parameters
    ----------
    cov : (d, d) covariance of a cloud
    common : (d, d)
    width : float
    floor : float, added to the variances of the positions [m^2]

    Returns
    -------
    spread : (d, 2), what two standard normal numbers add to the states
    common : (d, d) afterwards
    """
    d = len(cov)
    a, b, c = cov[0, 0] + floor, cov[0, 1], cov[1, 1] + floor
    det = a * c - b * b
    carry, spread, after = np.empty((d, 2)), np.empty((d, 2)), common.copy()
    for i in range(d):
        carry[i, 0] = (cov[i, 0] * c - cov[i, 1] * b) / det
        carry[i, 1] = (cov[i, 1] * a - cov[i, 0] * b) / det
    carry[0, 0], carry[0, 1], carry[1, 0], carry[1, 1] = 1.0, 0.0, 0.0, 1.0
    low = math.sqrt(a)
    side, high = b / low, math.sqrt(det / a)
    for i in range(d):
        spread[i, 0] = width * (carry[i, 0] * low + carry[i, 1] * side)
        spread[i, 1] = width * carry[i, 1] * high
    for i in range(2, d):
        for j in range(2, d):
            one = cov[i, j] - carry[i, 0] * cov[0, j] - carry[i, 1] * cov[1, j]
            two = cov[j, i] - carry[j, 0] * cov[0, i] - carry[j, 1] * cov[1, i]
            after[i, j] += 0.5 * width * width * (one + two)
    return spread, after


@jit
def bayes(probability, likelihood):
    """Bayes' rule over a few hypotheses (s,), none of which a single reading rules out for good."""
    after, most, total = np.empty(probability.size), 0.0, 0.0
    for i in range(after.size):
        most = max(most, likelihood[i])
    for i in range(after.size):
        after[i] = probability[i] * (likelihood[i] + 1e-12 * most)
        total += after[i]
    if not total > 0.0:
        return probability.copy()
    for i in range(after.size):
        after[i] /= total
    return after

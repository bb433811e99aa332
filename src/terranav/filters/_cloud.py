"""Marginalised particles: positions with conditional means, one conditional covariance for all.

The state x = (p, z) is that of `terranav.ins.error_state`. Column k of `rows` is (p, E[z | p]) of particle k, row i one
state of all of them, side by side for the kernels; `common` is the covariance of z given p, zero for p. Steps are held
back until a reading comes, and then drawn at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.special import ndtri

from terranav.core.judgement import largest_sigma_m
from terranav.core.records import Prior
from terranav.filters._normals import standard_normal
from terranav.ins.error_state import Transition
from terranav.kernels import marginalized as kernels
from terranav.kernels.matrices import conditioned, kernel_of

FloatArray = NDArray[np.float64]

KERNEL_DIMENSIONS = 4  # position and velocity: what a particle's history is about
TAILS = 1.5
KERNEL_CELLS = 0.5  # a kernel wider than this many cells would smear what the terrain resolves


@dataclass(frozen=True, slots=True)
class Cloud:
    """Particles.

    Attributes
    ----------
    rows : (d, m)
    weight : (m,), sums to one
    bad : (kinds, m)
        Probability that the map of each kind is in its bad regime below the particle.
    common : (d, d)
    mean, cov : (d,), (d, d)
        Of the rows under the weights, when they were last weighed or drawn.
    spacing_m : float
        Side of the square of ground that one particle stands for.
    """

    rows: FloatArray
    weight: FloatArray
    bad: FloatArray
    common: FloatArray
    mean: FloatArray
    cov: FloatArray
    spacing_m: float


def drawn(prior: Prior, common: FloatArray, count: int, bad: FloatArray, rng: Generator) -> Cloud:
    """A cloud with exactly the moments of the prior, its positions evenly spread, z = 0.

    A normal prior is covered TAILS times as wide, each particle weighted by what the prior gives to its place: a truth
    three sigmas out would otherwise be left to a dozen particles.

    Parameters
    ----------
    prior : Prior
    common : (d, d) covariance of z
    count : int
    bad : (kinds,) probability of the bad regime
    rng : Generator
    """
    target = prior_covariance(prior)
    even = _even(count, rng)
    if prior.shape == "uniform":
        unit, weight = math.sqrt(12.0) * (even - 0.5), np.full(count, 1.0 / count)
    else:
        unit = TAILS * ndtri(even)
        weight = np.exp(-0.5 * (1.0 - TAILS**-2) * np.sum(unit**2, axis=1))
        weight /= weight.sum()
    away = unit - np.einsum("k,ki", weight, unit)  # einsum: a product of matrices would wake the threads of BLAS
    spread = np.einsum("k,ki,kj", weight, away, away)
    away = away @ np.linalg.inv(np.linalg.cholesky(spread)).T
    rows = np.zeros((len(common), count))
    rows[:2] = (prior.mean_m + away @ np.linalg.cholesky(target).T).T
    regimes = np.repeat(bad[:, None], count, axis=1)
    mean, cov = kernels.moments(rows, weight)
    return Cloud(rows, weight, regimes, common, mean, cov, math.sqrt(prior_area(prior) / count))


def advanced(cloud: Cloud, passed: Transition, share: float, keep: FloatArray, rng: Generator) -> Cloud:
    """The cloud after a step: positions drawn, z conditioned on them. Its `mean` and `cov` stay those of before.

    Parameters
    ----------
    cloud : Cloud
    passed : Transition
    share : float
        What the probability of the bad regimes tends to.
    keep : (kinds,)
        What stays of their distance from it.
    rng : Generator
    """
    spread, common = conditioned(passed.phi, passed.q, cloud.common)
    rows, bad = np.empty_like(cloud.rows), np.empty_like(cloud.bad)
    noise = standard_normal(rng, (2, cloud.weight.size))
    kernels.advance(cloud.rows, cloud.weight, cloud.mean, passed.phi, spread, noise, rows)
    kernels.regime(cloud.bad, share, keep, bad)
    return Cloud(rows, cloud.weight, bad, common, cloud.mean, cloud.cov, cloud.spacing_m)


def resampled(cloud: Cloud, count: int, cell_m: float, area_m2: float, rng: Generator) -> Cloud:
    """Equal weights again. Mean and covariance stay: a normal kernel takes up what shrinking towards the mean leaves.

    Liu and West, Combined parameter and state estimation, in: Sequential Monte Carlo Methods in Practice, 2001. The
    bandwidth is the best one for a normal density in `KERNEL_DIMENSIONS` (Silverman 1986, eq. 4.14). The kernel's part
    in p is drawn and moves z along; its part in z given p goes into `common`.

    Parameters
    ----------
    cloud : Cloud
    count : int
        Particles afterwards.
    cell_m : float
        Of the finest map.
    area_m2 : float
        `covered_area` of the cloud.
    rng : Generator
    """
    d = KERNEL_DIMENSIONS
    sigma = largest_sigma_m(cloud.cov[:2, :2])
    width = min((4.0 / (count * (d + 2.0))) ** (1.0 / (d + 4.0)), KERNEL_CELLS * cell_m / max(sigma, 1e-9))
    spread, common = kernel_of(cloud.cov, cloud.common, width, 1e-9)
    rows, bad = np.empty((len(cloud.rows), count)), np.empty((len(cloud.bad), count))
    noise, offset, keep = standard_normal(rng, (2, count)), rng.random(), math.sqrt(1.0 - width**2)
    kernels.resampled(cloud.rows, cloud.weight, cloud.bad, offset, cloud.mean, keep, spread, noise, rows, bad)
    weight = np.full(count, 1.0 / count)
    return Cloud(rows, weight, bad, common, cloud.mean, cloud.cov, math.sqrt(area_m2 / count))


def covered_area(cloud: Cloud) -> float:
    """Area that the positions cover, exp(entropy) [m^2]."""
    return min(float(kernels.area(cloud.rows, cloud.weight)), gaussian_area(cloud.cov[:2, :2]))


def gaussian_area(cov_m2: FloatArray) -> float:
    """exp(entropy) of a normal density: 2 pi e sqrt(det) [m^2]."""
    return 2.0 * math.pi * math.e * math.sqrt(max(float(np.linalg.det(cov_m2)), 0.0))


def prior_covariance(prior: Prior) -> FloatArray:
    """(2, 2) covariance of a prior of either shape [m^2]."""
    return np.diag(3.0 * np.diag(prior.cov_m2)) if prior.shape == "uniform" else prior.cov_m2


def prior_area(prior: Prior) -> float:
    """exp(entropy) of a prior [m^2]."""
    if prior.shape == "uniform":
        return 36.0 * float(np.sqrt(np.prod(np.diag(prior.cov_m2))))
    return gaussian_area(prior.cov_m2)


def _even(count: int, rng: Generator) -> FloatArray:
    """(count, 2) points that fill the unit square evenly, in an order in which neighbours are near: a shifted lattice.

    Additive recurrence with the plastic number (Roberts' R2 sequence).
    """
    plastic = 1.32471795724474602596
    steps = np.arange(count)[:, None] * np.array([1.0 / plastic, 1.0 / plastic**2])
    points = np.clip((steps + rng.random(2)) % 1.0, 1e-9, 1.0 - 1e-9)
    strip = np.floor(points[:, 0] * math.sqrt(count))
    return np.asarray(points[np.lexsort((np.where(strip % 2.0 == 0.0, points[:, 1], -points[:, 1]), strip))])

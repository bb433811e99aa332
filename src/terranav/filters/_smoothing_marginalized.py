"""Backward simulation over the clouds of `marginalized`: every epoch in the light of the whole recording.

Rao-Blackwellised forward filtering, backward simulation (Godsill, Doucet and West, Monte Carlo smoothing for nonlinear
time series, J. Amer. Stat. Assoc. 99, 2004, eq. 6 and algorithm 1; Lindsten and Schon, Backward simulation methods for
Monte Carlo statistical inference, 2013, section 4.3). The filter's cloud at a reading is a mixture of normal densities

    p(x | past) = sum_i w_i N(x; c_i, K),   K = C + h^2 P,   c_i = mean + sqrt(1 - h^2) (x_i - mean)

with the particles x_i = (p_i, mean of z), the common covariance C of z, and the kernel of the filter's own resampling
(P: covariance of the x_i), which leaves mean and covariance as they are. Without it the mixture has no width in the
position, and no particle but its own ancestor could explain a later position. Given the state x' at the next stored
epoch, x' = phi x + noise of covariance q, S = phi K phi' + q, G = K phi' S^-1:

    P(i | x') ~ w_i N(x'; phi c_i, S),   x | i, x' ~ N(c_i + G (x' - phi c_i), K - G S G')

Means and covariances are those of these normal densities, averaged over the trajectories; only x' is drawn. Between
two readings the error is bridged in closed form. For linear readings all this is the Rauch-Tung-Striebel smoother.

S is singular where a state is known exactly and does not move (a velocity or a map without error). Its inverse is taken
on its support: eigenvalues below 1e-10 of the covariance scaled to unit variances are rounding, since K gives every
direction in which the cloud has a variance h^2 of it, and h is above 1e-3 for any cloud narrower than 500 cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.judgement import largest_sigma_m
from terranav.core.records import Epoch, Estimate
from terranav.filters._cloud import Cloud
from terranav.filters._replay import Flown, inner_of
from terranav.filters.marginalized import Marginalized, MarginalizedState
from terranav.ins.error_state import POSITION, Transition
from terranav.kernels.backward import trace_back
from terranav.kernels.marginalized import moments as moments_of

FloatArray = NDArray[np.float64]
Moments = tuple[FloatArray, FloatArray]  # of the position: mean (2,) [m], covariance (2, 2) [m^2]

TRAJECTORIES = 300  # their number costs time in proportion and leaves 1/600 of the RMSE as Monte Carlo noise
MOST_ROWS = 4000  # particles of a larger cloud that are compared with
KERNEL_DIMENSIONS = 4  # position and velocity: what tells one particle's past from another's
KERNEL_CELLS = 0.5  # a kernel wider than this many cells would smear what the terrain resolves
SUPPORT = 1e-10  # eigenvalues of a scaled covariance below this are rounding
BREAK = 100.0  # squared distance in sigmas at which a later state did not come from a cloud


@dataclass(frozen=True)
class Mixture:
    """A cloud as a sum of normal densities: weights (n,), centres (n, d), common covariance K (d, d)."""

    weight: FloatArray
    centres: FloatArray
    cov: FloatArray


@dataclass(frozen=True)
class Anchor:
    """Epoch k, where the filter has a cloud, its state there, and those of the trajectories, x (m, d)."""

    k: int
    state: MarginalizedState
    x: FloatArray


@dataclass(frozen=True)
class Link:
    """The state at an anchor given that at the next one, x' (m, d).

    mean : (m, d) for each trajectory, cov : (d, d) conditional covariance averaged over them, drawn : (m, d) draws.
    """

    mean: FloatArray
    cov: FloatArray
    drawn: FloatArray


def smooth_marginalized(flight: Flown[Any], rng: Generator, on_epoch: Callable[[int], None]) -> list[Estimate]:
    """The estimate at every epoch, given all readings.

    Parameters
    ----------
    flight : Flown
        A run of `Marginalized`, with a monitor or without.
    rng : Generator
        For the trajectories.
    on_epoch : callable
        Called with the number of epochs done, counted from the end.

    Returns
    -------
    list of Estimate, (n,)
        From the last reading on, and where the chain is broken, those of the filter. A chain breaks where the filter
        was started anew, or where most trajectories lie beyond ten sigmas of all that the filter held possible.
    """
    estimator, estimates = flight.method, list(flight.estimates)
    later: Anchor | None = None
    passed: list[Any] = []  # states from this epoch to the one before the next anchor
    steps: list[Transition] = []  # likewise, each to the epoch after
    for k, watched in flight.backwards():
        on_epoch(len(estimates) - k)
        state: MarginalizedState = inner_of(watched)
        if later is not None:
            passed.insert(0, watched)
            steps.insert(0, step_between(estimator, state, flight.epochs[k + 1]))
        if state.pending is not None or state.cloud is None:
            continue  # no reading here: bridged from the readings on either side
        mixture, link = _mixture(state.cloud, estimator, rng), None
        if later is not None and not _started_anew(state, later.state):
            link = _linked(mixture, reduce(Transition.then, steps), later.x, rng)
            if link is not None:
                found = zip(passed, _bridged(link, steps, later.x), strict=True)
                estimates[k : later.k] = [_estimate(flight, one, *moments) for one, moments in found]
        later, passed, steps = Anchor(k, state, _drawn(mixture, rng) if link is None else link.drawn), [], []
    return estimates


def step_between(estimator: Marginalized, state: MarginalizedState, epoch: Epoch) -> Transition:
    """The transition that the filter takes from a state to the next epoch."""
    passed = estimator._passed(replace(state, pending=None), epoch).pending
    assert passed is not None
    return passed


def _estimate(flight: Flown[Any], watched: Any, mean_m: FloatArray, cov_m2: FloatArray) -> Estimate:
    """What the filter would say of these moments of the position."""
    state = inner_of(watched)
    mean, cov = state.mean.copy(), state.cov.copy()
    mean[POSITION], cov[POSITION, POSITION] = mean_m, cov_m2
    return flight.estimate(watched, mean=mean, cov=cov)


def _mixture(cloud: Cloud, estimator: Marginalized, rng: Generator) -> Mixture:
    """The normal densities that a cloud stands for, of a large cloud only a sample of them.

    The kernel's width is the best for a normal density (Silverman, Density Estimation, 1986, eq. 4.14), with a limit.
    """
    mean, cov = moments_of(cloud.rows, cloud.weight)
    rows, weight = np.ascontiguousarray(cloud.rows.T), cloud.weight
    if len(rows) > MOST_ROWS:
        rows, weight = rows[_systematic(weight, MOST_ROWS, rng)], np.full(MOST_ROWS, 1.0 / MOST_ROWS)
    cell_m = min(chart.cell_m for chart in estimator.maps)
    d, count = KERNEL_DIMENSIONS, 1.0 / float(np.sum(weight**2))
    width = (4.0 / (count * (d + 2.0))) ** (1.0 / (d + 4.0))
    width = min(width, KERNEL_CELLS * cell_m / max(largest_sigma_m(cov[POSITION, POSITION]), 1e-9), 1.0)
    centres = mean + math.sqrt(1.0 - width**2) * (rows - mean)
    whole = cloud.common + width**2 * cov
    return Mixture(weight, centres, 0.5 * (whole + whole.T))


def _drawn(mixture: Mixture, rng: Generator) -> FloatArray:
    """Trajectories' ends (m, d) from a mixture alone."""
    chosen = _systematic(mixture.weight, TRAJECTORIES, rng)
    noise = rng.standard_normal((TRAJECTORIES, len(mixture.cov)))
    return np.asarray(mixture.centres[chosen] + noise @ _root(mixture.cov).T)


def _linked(mixture: Mixture, step: Transition, later: FloatArray, rng: Generator) -> Link | None:
    """The state before a step given the trajectories after it; None where those cannot have come from here."""
    gain, whiten = _gain(mixture.cov, step)
    m, d = later.shape
    chosen, mean, passed = np.empty(m, np.int64), np.empty((m, d)), np.empty(len(mixture.weight))
    ahead = np.einsum("ai,ki->ak", (step.phi.T @ whiten).T, mixture.centres)  # not BLAS, whose bits go with its threads
    nearest = trace_back(mixture.weight, mixture.centres, ahead, later @ whiten, rng.random(m), chosen, mean, passed)
    if np.median(nearest) > BREAK:
        return None
    within = moments_of(np.ascontiguousarray(mixture.centres.T), passed)[1] - np.cov(mean.T, bias=True)
    keep = np.eye(d) - gain @ step.phi
    own = keep @ mixture.cov @ keep.T + gain @ step.q @ gain.T  # K - G S G', positive in this form
    noise = rng.standard_normal((m, d)) @ _root(own).T
    pulled = later @ gain.T
    drawn = mixture.centres[chosen] @ keep.T + pulled + noise
    return Link(mean @ keep.T + pulled, own + keep @ within @ keep.T, drawn)


def _gain(cov: FloatArray, step: Transition) -> tuple[FloatArray, FloatArray]:
    """G = K phi' S^-1 (d, d), and W (d, r) with W W' = S^-1 on the support of S = phi K phi' + q."""
    ahead = step.phi @ cov @ step.phi.T + step.q
    scale = np.sqrt(np.diag(ahead))
    scale = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    values, vectors = np.linalg.eigh(scale[:, None] * ahead * scale)
    solid = values > SUPPORT
    whiten = scale[:, None] * vectors[:, solid] / np.sqrt(values[solid])
    return cov @ step.phi.T @ whiten @ whiten.T, whiten


def _bridged(link: Link, steps: list[Transition], later: FloatArray) -> list[Moments]:
    """Moments of the position at the anchor and at the epochs without a reading up to the next one.

    With x_t = phi_1 x_a + noise Q_1 and x_b = phi_2 x_t + noise Q_2, x_t given both ends is normal about
    phi_1 x_a + B (x_b - phi_2 phi_1 x_a), B = Q_1 phi_2' (phi_2 Q_1 phi_2' + Q_2)^-1.
    """
    d = later.shape[1]
    moments = [_moments(np.eye(d), np.zeros((d, d)), np.zeros((d, d)), link, later)]
    rest = list(accumulate(reversed(steps), lambda after, before: before.then(after)))
    for first, second in zip(accumulate(steps[:-1], Transition.then), reversed(rest[:-1])):
        gain, _ = _gain(first.q, second)
        keep = np.eye(d) - gain @ second.phi
        own = keep @ first.q @ keep.T + gain @ second.q @ gain.T
        moments.append(_moments(keep @ first.phi, gain, own, link, later))
    return moments


def _moments(of_here: FloatArray, of_later: FloatArray, own: FloatArray, link: Link, later: FloatArray) -> Moments:
    """Moments of the position in of_here x + of_later x' + noise of covariance own, over the trajectories.

    The covariance is that of m - 1 degrees of freedom, and the mean's own Monte Carlo variance, 1/m of it, is added.
    """
    each = (link.mean @ of_here.T + later @ of_later.T)[:, POSITION]
    mean = each.mean(axis=0)
    away = each - mean
    between = away.T @ away / (len(each) - 1) * (1.0 + 1.0 / len(each))
    inside = (of_here @ link.cov @ of_here.T + own)[POSITION, POSITION]
    cov = between + 0.5 * (inside + inside.T)
    return mean, cov


def _started_anew(before: MarginalizedState, after: MarginalizedState) -> bool:
    """Whether the filter was restarted between two anchors: then it has another prior."""
    a, b = before.prior, after.prior
    return a is not b and not (np.array_equal(a.mean_m, b.mean_m) and np.array_equal(a.cov_m2, b.cov_m2))


def _root(cov: FloatArray) -> FloatArray:
    """R with R R' = cov, for a covariance that may be singular."""
    values, vectors = np.linalg.eigh(cov)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _systematic(weight: FloatArray, count: int, rng: Generator) -> NDArray[np.intp]:
    """Indices of `count` particles drawn by their weights, evenly."""
    levels = (np.arange(count) + rng.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weight), levels), len(weight) - 1)

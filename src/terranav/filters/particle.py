"""Particle: a bootstrap particle filter of the two horizontal INS position errors.

Gordon, Salmond and Smith, Novel approach to nonlinear/non-Gaussian Bayesian state estimation, IEE Proc. F 140 (1993);
named as future work in papers/001. Particles are INS errors: the vehicle's motion moves nothing, only the growth of the
INS error spreads them.

    w_i <- w_i p(y | x_i);   when 1 / sum(w^2) < share m: systematic resampling (Kitagawa, J. Comput. Graph. Stat. 5,
    1996) and roughening, a normal jitter per axis of sigma K E m^(-1/2), E the extent of the cloud (Gordon, K = 0.2)

The jitter is part of the next step's noise: one draw of normal numbers a step, whether there was a resampling or not.

Random numbers are moment-matched: the initial cloud has exactly the prior's mean and covariance, and the noise of each
step exactly its own and none in common with the cloud. Plain draws would do both only to 1/sqrt(m), which over many
steps without information looks like information.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m
from terranav.core.records import Epoch, Estimate, Measurement, Posterior, Prior
from terranav.filters._maps import one_map_a_kind
from terranav.kernels.particle import systematic, weigh_cloud
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma

FloatArray = NDArray[np.float64]

LEAST_PARTICLES = 100
MOST_PARTICLES = 10_000_000


@dataclass(frozen=True, slots=True)
class ParticleState:
    """The cloud (m, 2) [m], its weights (m,), their moments before the latest resampling, and what it left to do."""

    cloud_m: FloatArray
    weight: FloatArray
    mean_m: FloatArray
    cov_m2: FloatArray
    jitter_m2: FloatArray = field(default_factory=lambda: np.zeros(2))  # roughening that is due
    judgement: Judgement = field(default_factory=Judgement)
    start_s: float = math.nan
    epoch: Epoch | None = None
    last_reading: Epoch | None = None


@dataclass(frozen=True)
class Particle:
    """Bootstrap particle filter of the two horizontal INS position errors.

    Attributes
    ----------
    maps : tuple of Map
        One a kind; a reading is compared with the map of its kind, several kinds multiply their likelihoods.
    ins : InsGrade
        How fast the position error grows (`InsGrade.position_growth_m2`).
    particles : int
        How many, 100 to 10 million.
    resample_share : float
        Resample when the effective number of particles falls below this share, in (0, 1].
    roughening : float
        K of the jitter after resampling, >= 0.
    outlier_share, outlier_scale : float
        A reading is an outlier with this probability, in [0, 0.5], and then this many times noisier, > 1.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the finest map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, or two maps of one kind.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    particles: int = 10_000
    resample_share: float = 0.5
    roughening: float = 0.2
    outlier_share: float = 0.02
    outlier_scale: float = 10.0
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        count = self.particles
        if isinstance(count, bool) or not isinstance(count, int) or not LEAST_PARTICLES <= count <= MOST_PARTICLES:
            raise ConfigError(
                f"particle particles is {count!r}, expected a whole number from {LEAST_PARTICLES} to {MOST_PARTICLES}"
            )
        finite("particle resample_share", self.resample_share, above=0.0, maximum=1.0)
        finite("particle roughening", self.roughening, minimum=0.0)
        finite("particle outlier_share", self.outlier_share, minimum=0.0, maximum=0.5)
        finite("particle outlier_scale", self.outlier_scale, above=1.0)
        if self.converged_sigma_m is not None:
            finite("particle converged_sigma_m", self.converged_sigma_m, above=0.0)
        one_map_a_kind("particle", self.maps)

    def init(self, prior: Prior, rng: Generator) -> ParticleState:
        """A cloud drawn from the prior."""
        count = self.particles
        weight = np.full(count, 1.0 / count)
        if prior.shape == "gaussian":
            drawn, target = rng.standard_normal((count, 2)), prior.cov_m2
        else:
            drawn, target = rng.uniform(-3.0, 3.0, (count, 2)), np.diag(3.0 * np.diag(prior.cov_m2))
        cloud = prior.mean_m + _with_moments(drawn, weight, target)
        return ParticleState(cloud, weight, *_moments(cloud, weight))

    def step(self, state: ParticleState, epoch: Epoch, rng: Generator) -> ParticleState:
        """Spread the cloud by the INS's growth since the last epoch, weigh it by the readings, resample if need be."""
        start_s = epoch.time_s if state.epoch is None else state.start_s
        dt = 0.0 if state.epoch is None else epoch.time_s - state.epoch.time_s
        before = epoch.time_s - dt - start_s
        growth = [self.ins.position_growth_m2(before, dt, float(v)) for v in np.diag(state.cov_m2)]
        cloud = _spread(state.cloud_m, state.weight, np.array(growth) + state.jitter_m2, rng)
        state = replace(state, epoch=epoch, start_s=start_s, cloud_m=cloud, jitter_m2=np.zeros(2))
        offset = float(rng.random())
        nis: list[float] = []
        known: list[float] = []
        effective = math.inf
        for reading in epoch.measurements:
            for chart in self.maps:
                if chart.kind == reading.kind:
                    weight, share, innovation2, effective = self._weighed(state, epoch, chart, reading)
                    state = replace(state, weight=weight)
                    known.append(share)
                    if share > 0.5:
                        nis.append(innovation2)
        mean, cov = _moments(state.cloud_m, state.weight)
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(cov),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=max(known) <= 0.5 if known else None,
        )
        last = epoch if known else state.last_reading
        state = replace(state, mean_m=mean, cov_m2=cov, judgement=judgement, last_reading=last)
        return self._resampled(state, offset) if effective < self.resample_share * self.particles else state

    def estimate(self, state: ParticleState) -> Estimate:
        """Mean and covariance of the weighted cloud."""
        if state.epoch is None:
            raise StateError("particle: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    def posterior(self, state: ParticleState) -> Posterior:
        """The cloud itself."""
        return Posterior(state.cloud_m[:, 0].copy(), state.cloud_m[:, 1].copy(), state.weight)

    @property
    def _judge(self) -> Judge:
        limit = self.converged_sigma_m
        return Judge(converged_sigma_m=min(chart.cell_m for chart in self.maps) if limit is None else limit)

    def _weighed(
        self, state: ParticleState, epoch: Epoch, chart: Map, reading: Measurement
    ) -> tuple[FloatArray, float, float, float]:
        """New weights, the share on the map, the NIS and the effective number of particles."""
        radius = float(np.abs(state.cloud_m).max()) * math.sqrt(2.0)
        frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg, max(radius, chart.cell_m))
        told = np.array([reading.value, reading_sigma(reading, chart, state.last_reading, epoch)])
        outliers = np.array([self.outlier_share, self.outlier_scale])
        out = np.empty(self.particles)
        coefficients = np.stack([frame.row, frame.col])
        return out, *weigh_cloud(chart.values, coefficients, state.cloud_m, state.weight, told, outliers, out)

    def _resampled(self, state: ParticleState, offset: float) -> ParticleState:
        """Equal weights again; the jitter that tells copies apart comes with the next step."""
        chosen = np.empty(self.particles, dtype=np.int64)
        order = _neighbours_together(state.cloud_m, state.weight)
        systematic(state.weight[order], offset, chosen)
        cloud = state.cloud_m[order[chosen]]
        extent = cloud.max(axis=0) - cloud.min(axis=0)
        jitter = self.roughening**2 * extent**2 / self.particles
        weight = np.full(self.particles, 1.0 / self.particles)
        return replace(state, cloud_m=cloud, weight=weight, jitter_m2=jitter)


def _moments(cloud: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (2,) and covariance (2, 2), which a cloud in a single place does not make singular."""
    mean = weight @ cloud
    away = cloud - mean
    cov = (away * weight[:, None]).T @ away
    return mean, 0.5 * (cov + cov.T) + 1e-6 * np.eye(2)


def _neighbours_together(cloud: FloatArray, weight: FloatArray) -> NDArray[np.intp]:
    """An order in which neighbours in the list are neighbours on the ground: along strips of equal weight, to and fro.

    Systematic resampling of an ordered cloud has a smaller variance (Kitagawa 1996; Gerber, Chopin and Whiteley, Ann.
    Statist. 47, 2019), and a weight that changes a little moves a copy a little, not across the cloud.
    """
    northward = np.argsort(cloud[:, 0], kind="stable")
    share = np.empty(len(cloud))
    share[northward] = np.cumsum(weight[northward])
    strip = np.floor(share * math.sqrt(len(cloud)))  # as many strips as copies within each
    return np.lexsort((np.where(strip % 2.0 == 0.0, cloud[:, 1], -cloud[:, 1]), strip))


def _with_moments(drawn: FloatArray, weight: FloatArray, target: FloatArray) -> FloatArray:
    """The numbers, shifted and mixed linearly to mean zero and exactly this covariance under the weights."""
    away = drawn - weight @ drawn
    own = np.linalg.cholesky((away * weight[:, None]).T @ away)
    return np.asarray(away @ np.linalg.inv(own).T @ np.linalg.cholesky(target).T)


def _spread(cloud: FloatArray, weight: FloatArray, growth_m2: FloatArray, rng: Generator) -> FloatArray:
    """The cloud with normal noise that is uncorrelated with it under the weights and has exactly this variance."""
    noise = rng.standard_normal(cloud.shape)
    if growth_m2.max() <= 0.0:
        return cloud
    away = cloud - weight @ cloud
    weighted = away * weight[:, None]
    scatter = weighted.T @ away
    if np.linalg.cond(scatter) < 1e12:
        noise = noise - away @ np.linalg.solve(scatter, weighted.T @ noise)
    return cloud + _with_moments(noise, weight, np.diag(np.maximum(growth_m2, 1e-12)))

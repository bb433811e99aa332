"""Particle: a bootstrap particle filter of the two horizontal INS position errors.

Gordon, Salmond and Smith, Novel approach to nonlinear/non-Gaussian Bayesian state estimation, IEE Proc. F 140 (1993);
named as future work in papers/001. Particles are INS errors: the vehicle's motion moves nothing, only the growth of the
INS error spreads them.

    w_i <- w_i p(y | x_i);   when 1 / sum(w^2) < share m: systematic resampling (Kitagawa, J. Comput. Graph. Stat. 5,
    1996) and roughening, a normal jitter per axis of sigma K E m^(-1/2), E the extent of the cloud (Gordon, K = 0.2)

Resampling goes along strips on the ground (`kernels.neighbours`). The jitter is part of the next step's noise: one
draw of normal numbers a step, whether there was a resampling or not.

Random numbers are moment-matched: the initial cloud has exactly the prior's mean and covariance, and the noise of each
step exactly its own and none in common with the cloud. Plain draws would do both only to 1/sqrt(m), which over many
steps without information looks like information.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m
from terranav.core.memory import need
from terranav.core.records import Epoch, Estimate, Measurement, Posterior, Prior
from terranav.filters import _blocks
from terranav.filters._maps import one_map_a_kind
from terranav.filters._normals import drawn_key, standard_normal
from terranav.kernels import particle as kernels
from terranav.kernels.neighbours import extent
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma

FloatArray = NDArray[np.float64]

LEAST_PARTICLES = 100
PARTICLE_BYTES = 120  # that a step takes at its most
MOST_PARTICLES = 10_000_000


Moments = tuple[float, float, float, float, float]  # mean north and east, variance north, covariance, variance east


@dataclass(frozen=True, slots=True)
class ParticleState:
    """The cloud (m,), (m,) [m], its weights (m,), moments before the latest resampling and what it left to do."""

    north_m: FloatArray
    east_m: FloatArray
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
        need(PARTICLE_BYTES * count, f"particle: particles = {count}")
        weight = np.full(count, 1.0 / count)
        if prior.shape == "gaussian":
            drawn, target = standard_normal(rng, (count, 2)), prior.cov_m2
        else:
            drawn, target = rng.uniform(-3.0, 3.0, (count, 2)), np.diag(3.0 * np.diag(prior.cov_m2))
        cloud = prior.mean_m + _with_moments(drawn, target)
        north, east = np.ascontiguousarray(cloud.T)
        return ParticleState(north, east, weight, *_as_arrays(kernels.moments(north, east, weight, prior.mean_m)))

    def step(self, state: ParticleState, epoch: Epoch, rng: Generator) -> ParticleState:
        """Spread the cloud by the INS's growth since the last epoch, weigh it by the readings, resample if need be."""
        key, offset = drawn_key(rng), float(rng.random())
        start_s = epoch.time_s if state.epoch is None else state.start_s
        block = _blocks.empty((3, self.particles))
        north, east = self._spread(state, epoch, start_s, key, block)
        weight, found, effective = state.weight, None, math.inf
        nis: list[float] = []
        known: list[float] = []
        for reading in epoch.measurements:
            for chart in self.maps:
                if chart.kind == reading.kind:
                    far = math.hypot(*(max(abs(end) for end in extent(axis)) for axis in (north, east)))
                    land = chart.around(epoch.lat_deg, epoch.lon_deg, max(far, chart.cell_m))
                    told = self._told(state, epoch, (chart, land), reading)
                    out = _blocks.empty((self.particles,)) if known else block[2]
                    share, innovation2, effective, found = kernels.weigh_cloud(
                        land.values, *told, north, east, weight, state.mean_m, out
                    )
                    weight = out
                    known.append(share)
                    if share > 0.5:
                        nis.append(innovation2)
        mean, cov = _as_arrays(found or kernels.moments(north, east, weight, state.mean_m))
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(cov),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=max(known) <= 0.5 if known else None,
        )
        jitter = np.zeros(2)
        if effective < self.resample_share * self.particles:
            north, east, weight, jitter = self._resampled(north, east, weight, offset)
        last = epoch if known else state.last_reading
        return ParticleState(north, east, weight, mean, cov, jitter, judgement, start_s, epoch, last)

    def estimate(self, state: ParticleState) -> Estimate:
        """Mean and covariance of the weighted cloud."""
        if state.epoch is None:
            raise StateError("particle: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    def posterior(self, state: ParticleState) -> Posterior:
        """The cloud itself."""
        return Posterior(state.north_m, state.east_m, state.weight)

    @property
    def _judge(self) -> Judge:
        limit = self.converged_sigma_m
        return Judge(converged_sigma_m=min(chart.cell_m for chart in self.maps) if limit is None else limit)

    def _spread(
        self, state: ParticleState, epoch: Epoch, start_s: float, key: np.uint64, out: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The cloud after the growth of the INS error since the last epoch and the jitter that is due; in `out`."""
        dt = 0.0 if state.epoch is None else epoch.time_s - state.epoch.time_s
        before = epoch.time_s - dt - start_s
        growth = [
            self.ins.position_growth_m2(before, dt, float(variance)) + float(jitter)
            for variance, jitter in zip(state.cov_m2.diagonal(), state.jitter_m2)
        ]
        if max(growth) <= 0.0:
            return state.north_m, state.east_m
        variance = np.array([max(one, 1e-12) for one in growth])
        kernels.spread(state.north_m, state.east_m, state.weight, variance, state.mean_m, key, out[0], out[1])
        return out[0], out[1]

    def _told(
        self, state: ParticleState, epoch: Epoch, maps: tuple[Map, Map], reading: Measurement
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The local frame (2, 6) of a map's part, the reading (2,) and its outliers (2,), as the kernel takes them."""
        chart, land = maps
        radius = math.hypot(*state.mean_m) + 6.0 * largest_sigma_m(state.cov_m2)
        frame = land.local_frame(epoch.lat_deg, epoch.lon_deg, max(radius, chart.cell_m))
        sigma = reading_sigma(reading, chart, state.last_reading, epoch)
        outliers = np.array([self.outlier_share, self.outlier_scale])
        return np.stack([frame.row, frame.col]), np.array([reading.value, sigma]), outliers

    def _resampled(
        self, north: FloatArray, east: FloatArray, weight: FloatArray, offset: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Equal weights again; the jitter that tells copies apart comes with the next step."""
        count = self.particles
        copies_n, copies_e, equal = _blocks.empty((3, count))
        kernels.resample(north, east, weight, offset, _blocks.empty((4, count + 1), np.int32), copies_n, copies_e)
        equal.fill(1.0 / count)
        width = [greatest - least for least, greatest in (extent(copies_n), extent(copies_e))]
        jitter = np.array([self.roughening**2 * one**2 / count for one in width])
        return copies_n, copies_e, equal, jitter


def _as_arrays(moments: Moments) -> tuple[FloatArray, FloatArray]:
    """Mean (2,) and covariance (2, 2), which a cloud in a single place does not make singular."""
    north, east, nn, ne, ee = moments
    return np.array([north, east]), np.array([[nn + 1e-6, ne], [ne, ee + 1e-6]])


def _with_moments(drawn: FloatArray, target: FloatArray) -> FloatArray:
    """The numbers, shifted and mixed linearly to mean zero and exactly this covariance."""
    away = drawn - drawn.mean(axis=0)
    own = np.linalg.cholesky(away.T @ away / len(away))
    return np.asarray(away @ np.linalg.inv(own).T @ np.linalg.cholesky(target).T)

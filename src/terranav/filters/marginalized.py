"""Marginalized: the navigator. Particles for the position error, a Kalman filter for everything linear given it.

Rao-Blackwellised particle filter (Schon, Gustafsson and Nordlund, IEEE Trans. Signal Processing 53, 2005, algorithm 1
and section IV; Nordlund and Gustafsson, IEEE Trans. Aerospace and Electronic Systems 45, 2009, for terrain). With the
state x = (p, z) of `terranav.ins.error_state`, a particle is a position p and the conditional mean of z; the
conditional covariance C of z depends on no particle and is kept once. Over a step with transition phi, noise q:

    S = phi [0 0; 0 C] phi' + q,   p drawn from N(phi_p (p, z), S_pp),   z = phi_z (p, z) + S_zp S_pp^-1 (drawn - mean),
    C = S_zz - S_zp S_pp^-1 S_pz

A reading y = h(p) + bias + patch + e of a map weighs the particles by N(y - h - bias - patch; 0, c + r) and updates z
as in a Kalman filter, c being the variance of bias + patch in C. What is in r, and why it is honest:

- the sensor's noise, which is, with a small probability, several times larger (heavy tails);
- not the map's error: that is the state 'patch', correlated along the track, so that readings over one wrong patch
  count once; nor a common bias, which is a state of its own;
- blur2 |slope|^2: the place within a cell for which the map speaks, and, while the cloud is coarse, the ground that
  one particle stands for. So a cloud over kilometres sees the terrain only as finely as it can, and loses no truth.

The noise of the draw is moment-matched and resampling keeps mean and covariance (kernel with shrinkage, Liu and West
2001, in the position; its part in z goes into C), so flat land teaches nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.special import ndtri

from terranav.core.checks import finite
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m
from terranav.core.records import Epoch, Estimate, Innovation, Measurement, Posterior, Prior
from terranav.filters._maps import one_map_a_kind
from terranav.ins.error_state import ErrorModel, Transition, check_bias_sigma
from terranav.kernels import marginalized as kernels
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

LEAST_PARTICLES, MOST_PARTICLES = 100, 10_000_000
RESAMPLE_SHARE = 0.5  # of the effective number
KERNEL = 0.15  # bandwidth of the resampling kernel in sigmas of the cloud ...
KERNEL_CELLS = 0.2  # ... but never more than this many cells, or it would smear what the terrain resolves
FINEST_CELLS = 0.25  # a coarse cloud gets particles until they are so many cells apart
GROUND = 1.0 / 12.0  # variance of the place within the square that a particle stands for [its side squared]


@dataclass(frozen=True, slots=True)
class Cloud:
    """Particles: rows (p, mean of z), weights, the common covariance of z (d, d, zero for p), and their own moments."""

    rows: FloatArray
    weight: FloatArray
    common: FloatArray
    mean: FloatArray
    cov: FloatArray
    spacing_m: float

    @property
    def effective(self) -> float:
        """Effective number of particles."""
        return float(1.0 / np.sum(self.weight**2))


@dataclass(frozen=True, slots=True)
class MarginalizedState:
    """A cloud at the latest reading, the steps since then, and mean and covariance (d), (d, d) now."""

    prior: Prior
    cloud: Cloud | None = None
    model: ErrorModel | None = None
    pending: Transition | None = None
    mean: FloatArray = field(default_factory=lambda: np.zeros(0))
    cov: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    innovations: tuple[Innovation, ...] = ()
    excluded: frozenset[str] = frozenset()
    judgement: Judgement = field(default_factory=Judgement)
    epoch: Epoch | None = None


@dataclass(frozen=True)
class Marginalized:
    """Rao-Blackwellised particle filter of the INS error and of what map and sensors have in common.

    Attributes
    ----------
    maps : tuple of Map
        One a kind; a reading is compared with the map of its kind, several kinds multiply their likelihoods.
    ins : InsGrade
        Which error states there are and how they grow (`terranav.ins.error_state`).
    particles : int
        Most particles, while the position is uncertain over kilometres; 100 to 10 million.
    least_particles : int
        Fewest, once it is known to a few cells.
    outlier_share, outlier_scale : float
        A reading is an outlier with this probability, in [0, 0.5], and then this many times noisier, > 1.
    blur_cells : float
        1-sigma of the place within the map for which a cell's value speaks: registration, interpolation and footprint
        [cells]; it counts by the slope.
    bias_sigma : mapping of kind to float
        1-sigma of the error common to all readings of a kind [unit]; by default `Kind.bias_sigma`.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the finest map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, or two maps of one kind.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    particles: int = 20_000
    least_particles: int = 2_000
    outlier_share: float = 0.05
    outlier_scale: float = 6.0
    blur_cells: float = 0.05
    bias_sigma: Mapping[str, float] = field(default_factory=dict)
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        for key in ("particles", "least_particles"):
            count = getattr(self, key)
            if isinstance(count, bool) or not isinstance(count, int) or not LEAST_PARTICLES <= count <= MOST_PARTICLES:
                raise ConfigError(
                    f"marginalized {key} is {count!r}, "
                    f"expected a whole number from {LEAST_PARTICLES} to {MOST_PARTICLES}"
                )
        finite("marginalized outlier_share", self.outlier_share, minimum=0.0, maximum=0.5)
        finite("marginalized outlier_scale", self.outlier_scale, above=1.0)
        finite("marginalized blur_cells", self.blur_cells, minimum=0.0)
        check_bias_sigma("marginalized", self.bias_sigma)
        if self.converged_sigma_m is not None:
            finite("marginalized converged_sigma_m", self.converged_sigma_m, above=0.0)
        one_map_a_kind("marginalized", self.maps)

    def init(self, prior: Prior, rng: Generator) -> MarginalizedState:
        """The prior; which states there are shows with the first epoch, so the cloud is drawn then."""
        return MarginalizedState(prior)

    def step(self, state: MarginalizedState, epoch: Epoch, rng: Generator) -> MarginalizedState:
        """Let the time since the last epoch pass, then use the readings one by one."""
        if state.cloud is None or state.model is None or state.epoch is None:
            model = ErrorModel(self.ins, self.maps, ErrorModel.level_for(self.ins, epoch), self.bias_sigma)
            cloud = self._drawn(state.prior, model, rng)
            state = replace(state, cloud=cloud, model=model, epoch=epoch)
            state = replace(state, mean=cloud.mean, cov=cloud.cov + cloud.common)
        else:
            passed = state.model.transition(state.epoch, epoch)
            cov = passed.phi @ state.cov @ passed.phi.T + passed.q
            pending = passed if state.pending is None else state.pending.then(passed)
            state = replace(state, epoch=epoch, pending=pending, mean=passed.phi @ state.mean, cov=cov)
        pairs = [(m, chart) for m in epoch.measurements for chart in self.maps if chart.kind == m.kind]
        innovations: list[Innovation] = []
        for reading, chart in pairs:
            state, innovation = self._updated(_advanced(state, rng), epoch, chart, reading, rng)
            innovations.append(innovation)
        nis = [one.nis for one in innovations if one.known > 0.5]
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(state.cov[:2, :2]),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=not nis if innovations else None,
        )
        return replace(state, innovations=tuple(innovations), judgement=judgement)

    def estimate(self, state: MarginalizedState) -> Estimate:
        """Mean and covariance of the position error."""
        if state.epoch is None:
            raise StateError("marginalized: no estimate before the first epoch")
        cov, judgement = state.cov[:2, :2], state.judgement
        return Estimate.at(state.epoch, state.mean[:2].copy(), 0.5 * (cov + cov.T), judgement.status, judgement.nis)

    def posterior(self, state: MarginalizedState) -> Posterior:
        """The positions of the cloud; what has passed since the latest reading moves them as a whole."""
        if state.cloud is None:
            raise StateError("marginalized: no posterior before the first epoch")
        rows = state.cloud.rows
        moved = rows[:, :2] if state.pending is None else rows @ state.pending.phi[:2].T
        return Posterior(moved[:, 0].copy(), moved[:, 1].copy(), state.cloud.weight)

    def innovations(self, state: MarginalizedState) -> tuple[Innovation, ...]:
        """Of the last epoch's readings."""
        return state.innovations

    def restarted(self, state: MarginalizedState, prior: Prior, rng: Generator) -> MarginalizedState:
        """A new cloud at the same epoch."""
        if state.model is None:
            return replace(state, prior=prior)
        cloud = self._drawn(prior, state.model, rng)
        return replace(state, cloud=cloud, pending=None, mean=cloud.mean, cov=cloud.cov + cloud.common)

    def excluding(self, state: MarginalizedState, kinds: frozenset[str]) -> MarginalizedState:
        """The state that does not use readings of these kinds."""
        return replace(state, excluded=kinds)

    @property
    def _judge(self) -> Judge:
        limit = self.converged_sigma_m
        return Judge(converged_sigma_m=self._cell_m if limit is None else limit)

    @property
    def _cell_m(self) -> float:
        return min(chart.cell_m for chart in self.maps)

    def _count(self, area_m2: float) -> int:
        """How many particles a posterior of this area takes; in steps, so that a little more area changes nothing."""
        wanted = area_m2 / (FINEST_CELLS * self._cell_m) ** 2
        doublings = math.ceil(math.log2(max(wanted / self.least_particles, 1.0)))
        return int(min(self.least_particles * 2**doublings, max(self.particles, self.least_particles)))

    def _drawn(self, prior: Prior, model: ErrorModel, rng: Generator) -> Cloud:
        """A cloud with exactly the moments of the prior, its positions evenly spread."""
        d, uniform = model.size, prior.shape == "uniform"
        target = np.diag(3.0 * np.diag(prior.cov_m2)) if uniform else prior.cov_m2
        area = 36.0 * math.sqrt(np.linalg.det(prior.cov_m2)) if uniform else _gaussian_area(target)
        count = self._count(area)
        even = _even(count, rng)
        unit = math.sqrt(12.0) * (even - 0.5) if uniform else ndtri(even)
        away = unit - unit.mean(axis=0)
        away = away @ np.linalg.inv(np.linalg.cholesky(away.T @ away / count)).T
        rows = np.zeros((count, d))
        rows[:, :2] = prior.mean_m + away @ np.linalg.cholesky(target).T
        common = model.initial_covariance(target)
        common[:2, :2] = 0.0
        return _measured(rows, np.full(count, 1.0 / count), common, math.sqrt(area / count))

    def _updated(
        self, state: MarginalizedState, epoch: Epoch, chart: Map, reading: Measurement, rng: Generator
    ) -> tuple[MarginalizedState, Innovation]:
        """The state after one reading, and what the reading was against its prediction."""
        cloud, model = state.cloud, state.model
        assert cloud is not None and model is not None  # noqa: PT018  set by step()
        bias = model.bias_index(chart.kind)
        radius = float(np.abs(cloud.rows[:, :2]).max()) * math.sqrt(2.0)
        frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg, max(radius, chart.cell_m))
        residual, slope2 = np.empty(len(cloud.rows)), np.empty(len(cloud.rows))
        kernels.compare(
            chart.values,
            np.stack([frame.row, frame.col]),
            cloud.rows,
            np.array([reading.value, bias]),
            residual,
            slope2,
        )
        gain = cloud.common[:, bias] + cloud.common[:, bias + 1]
        common = float(gain[bias] + gain[bias + 1])
        blur2 = (self.blur_cells * chart.cell_m) ** 2
        noise = reading.sigma**2
        known, mean, variance, white = kernels.predicted(cloud.weight, residual, slope2, noise, blur2, common)
        used = chart.kind not in state.excluded and known > 0.0
        innovation = Innovation(chart.kind, mean, variance, white, known, used)
        if not used:
            return state, innovation
        coarse2 = blur2 + GROUND * cloud.spacing_m**2
        rows, weight = np.empty_like(cloud.rows), np.empty_like(cloud.weight)
        outliers = np.array([self.outlier_share, self.outlier_scale])
        likely, effective, shrink, widen = kernels.weigh(
            cloud.rows, cloud.weight, residual, slope2, noise, coarse2, common, gain, outliers, rows, weight
        )
        if likely <= 0.0:
            return state, innovation
        cloud = _measured(rows, weight, cloud.common - (shrink - widen) * np.outer(gain, gain), cloud.spacing_m)
        state = replace(state, mean=cloud.mean, cov=cloud.cov + cloud.common)
        if effective < RESAMPLE_SHARE * len(rows):
            cloud = self._resampled(cloud, rng)
        return replace(state, cloud=cloud), innovation

    def _resampled(self, cloud: Cloud, rng: Generator) -> Cloud:
        """Equal weights again, with as many particles as the posterior's area asks for."""
        area = min(float(kernels.area(cloud.rows, cloud.weight)), _gaussian_area(cloud.cov[:2, :2]))
        count = self._count(area)
        sigma = largest_sigma_m(cloud.cov[:2, :2])
        h2 = min(KERNEL, KERNEL_CELLS * self._cell_m / sigma) ** 2
        position = cloud.cov[:2, :2] + 1e-9 * np.eye(2)
        carry = cloud.cov[:, :2] @ np.linalg.inv(position)
        carry[:2] = np.eye(2)
        spread = math.sqrt(h2) * carry @ np.linalg.cholesky(position)
        rest = h2 * (cloud.cov - carry @ cloud.cov[:2])
        rest[:2], rest[:, :2] = 0.0, 0.0
        rows = np.empty((count, cloud.rows.shape[1]))
        noise = rng.standard_normal((count, 2))
        kernels.resampled(
            cloud.rows, cloud.weight, float(rng.random()), cloud.mean, math.sqrt(1.0 - h2), spread, noise, rows
        )
        common = cloud.common + 0.5 * (rest + rest.T)
        return _measured(rows, np.full(count, 1.0 / count), common, math.sqrt(area / count))


def _advanced(state: MarginalizedState, rng: Generator) -> MarginalizedState:
    """The cloud at the epoch of the state: what is pending drawn."""
    cloud, passed = state.cloud, state.pending
    if cloud is None or passed is None:
        return state
    grown = passed.phi @ cloud.common @ passed.phi.T + passed.q
    values, vectors = np.linalg.eigh(grown[:2, :2])
    if values[1] <= 0.0:  # no time has passed
        return replace(state, pending=None)
    solid = values > 1e-12 * values[1]
    root = vectors * np.sqrt(np.where(solid, values, 0.0))
    inverse = (vectors * np.where(solid, 1.0 / np.where(solid, values, 1.0), 0.0)) @ vectors.T
    carry = grown[:, :2] @ inverse
    spread = carry @ root
    common = grown - carry @ grown[:2]
    common[:2], common[:, :2] = 0.0, 0.0
    rows = np.empty_like(cloud.rows)
    noise = rng.standard_normal((len(rows), 2))
    kernels.advance(cloud.rows, cloud.weight, passed.phi, spread, noise, rows)
    cloud = _measured(rows, cloud.weight, 0.5 * (common + common.T), cloud.spacing_m)
    return replace(state, cloud=cloud, pending=None)


def _measured(rows: FloatArray, weight: FloatArray, common: FloatArray, spacing_m: float) -> Cloud:
    """A cloud with its moments."""
    mean, cov = kernels.moments(rows, weight)
    return Cloud(rows, weight, common, mean, cov, spacing_m)


def _gaussian_area(cov_m2: FloatArray) -> float:
    """exp(entropy) of a normal density: 2 pi e sqrt(det) [m^2]."""
    return 2.0 * math.pi * math.e * math.sqrt(max(float(np.linalg.det(cov_m2)), 0.0))


def _even(count: int, rng: Generator) -> FloatArray:
    """(count, 2) points that fill the unit square evenly, in an order in which neighbours are near: a shifted lattice.

    Additive recurrence with the plastic number (Roberts' R2 sequence).
    """
    plastic = 1.32471795724474602596
    steps = np.arange(count)[:, None] * np.array([1.0 / plastic, 1.0 / plastic**2])
    points = (steps + rng.random(2)) % 1.0
    points = np.clip(points, 1e-9, 1.0 - 1e-9)
    strip = np.floor(points[:, 0] * math.sqrt(count))
    return np.asarray(points[np.lexsort((np.where(strip % 2.0 == 0.0, points[:, 1], -points[:, 1]), strip))])

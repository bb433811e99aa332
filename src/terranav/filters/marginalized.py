"""Marginalized: the navigator. Particles for the position error, a Kalman filter for everything linear given it.

Rao-Blackwellised particle filter (Schon, Gustafsson and Nordlund, IEEE Trans. Signal Processing 53, 2005, algorithm 1
and section IV; Nordlund and Gustafsson, IEEE Trans. Aerospace and Electronic Systems 45, 2009, for terrain). With the
state x = (p, z) of `terranav.ins.error_state`, a particle is a position p and the conditional mean of z; the
conditional covariance C of z depends on no particle and is kept once. Over a step with transition phi, noise q:

    S = phi [0 0; 0 C] phi' + q,   p drawn from N(phi_p (p, z), S_pp),   z = phi_z (p, z) + S_zp S_pp^-1 (drawn - mean),
    C = S_zz - S_zp S_pp^-1 S_pz

A reading y of a map h leaves r = y - h(p) - bias - patch. It weighs a particle by

    (1 - b) N(r; 0, c + s v) + b Cauchy(r; reach),     v = sigma^2 + u^2 |slope|^2

and moves z as in a Kalman filter, c being the variance of bias + patch in C. What makes that honest:

- v holds neither the map's error, which is the state 'patch', correlated along the track, so that readings over one
  wrong patch count once, nor a common bias, which is a state of its own;
- u is the place within a cell for which the map speaks, and, while the cloud is coarse, the ground that one particle
  stands for: a cloud over kilometres sees the terrain only as finely as it can, and loses no truth;
- b is a particle's own belief that the map is wrong here (a quarry, a wood, a void filled in) or that the reading is an
  outlier. It comes and goes along the track as a two-state Markov chain, so that a run of misfits over one bad patch
  costs the truth little more than the first of them;
- s is how noisy readings have proved, as against what was told (`filters._noise_scale`); q grows likewise where the INS
  wanders more than told (`filters._walk_scale`);
- the map as a whole may lie beside its place, by part of a cell and by no more than its told sigma allows on the slopes
  that are met. No reading can tell that from an INS error, so it is added to the covariance that is given out.

The noise of a draw is moment-matched and resampling keeps mean and covariance, so flat land teaches nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import offset_of
from terranav.core.errors import ConfigError, StateError
from terranav.core.frozen import changed
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m
from terranav.core.memory import need
from terranav.core.records import Epoch, Estimate, Innovation, Measurement, Posterior, Prior
from terranav.filters import _noise_scale as noise_scale
from terranav.filters import _walk_scale as walk_scale
from terranav.filters._cloud import Cloud, advanced, covered_area, drawn, prior_area, prior_covariance, resampled
from terranav.filters._maps import one_map_a_kind
from terranav.filters._reading import Seen, compared, learned, weighed
from terranav.ins.error_state import ErrorModel, Transition, check_bias_sigma
from terranav.kernels.matrices import predicted
from terranav.kernels.reading import mean_of
from terranav.kernels.walk_scale import linearised
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

LEAST_PARTICLES, MOST_PARTICLES = 100, 10_000_000
STATE_BYTES = 64  # that a step takes at its most for each state of a particle
RESAMPLE_SHARE = 0.5  # of the effective number
FINEST_CELLS = 0.25  # a coarse cloud gets particles until they are so many cells apart
SLOPE_MEMORY = 300.0  # readings over which the slope along the track is averaged
BAD_PATCH = 2.0  # a bad patch is so many times longer than the map error's correlation


@dataclass(frozen=True, slots=True)
class MarginalizedState:
    """A cloud at the latest reading, the steps since then, and mean (d,) and covariance (d, d) now.

    `unaided` is the covariance (d, d) without readings; `scale` (kinds, scales) the distribution of the noise scale of
    each map, `slope2` (kinds,) the mean squared slope met [unit^2/m^2], over `met` (kinds,) readings.
    """

    prior: Prior
    cloud: Cloud | None = None
    model: ErrorModel | None = None
    pending: Transition | None = None
    mean: FloatArray = field(default_factory=lambda: np.zeros(0))
    cov: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    unaided: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    scale: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    walk: walk_scale.WalkScale = field(default_factory=lambda: walk_scale.told(adapt=False))
    slope2: FloatArray = field(default_factory=lambda: np.zeros(0))
    met: FloatArray = field(default_factory=lambda: np.zeros(0))
    innovations: tuple[Innovation, ...] = ()
    excluded: frozenset[str] = frozenset()
    judgement: Judgement = field(default_factory=Judgement)
    epoch: Epoch | None = None
    last_reading: Epoch | None = None


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
    outlier_share : float
        Share of readings that are outliers or lie over a bad patch of the map, in [0, 0.5].
    outlier_scale : float
        How far they lie off: half width of a Cauchy density, in sigmas of sensor and map together, > 0.
    blur_cells : float
        1-sigma of the place within the map for which a cell's value speaks: interpolation and footprint [cells].
    registration_cells : float
        1-sigma per axis of the place of the map as a whole [cells]: 1/sqrt(12), anywhere within a cell, unless known
        better. At most what shows as 1/sqrt(2) of the map's sigma on the slopes along the track; none for a map whose
        sigma is 0.
    adapt_noise : bool
        Whether the noise of readings is learned; else it is taken as told.
    adapt_walk : bool
        Whether an INS that wanders more than told is noticed and followed.
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
    least_particles: int = 8_000
    outlier_share: float = 0.05
    outlier_scale: float = 3.0
    blur_cells: float = 0.1
    registration_cells: float = 0.29
    adapt_noise: bool = True
    adapt_walk: bool = True
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
        finite("marginalized outlier_scale", self.outlier_scale, above=0.0)
        finite("marginalized blur_cells", self.blur_cells, minimum=0.0)
        finite("marginalized registration_cells", self.registration_cells, minimum=0.0)
        for key in ("adapt_noise", "adapt_walk"):
            if not isinstance(getattr(self, key), bool):
                raise ConfigError(f"marginalized {key} is {getattr(self, key)!r}, expected true or false")
        check_bias_sigma("marginalized", self.bias_sigma)
        if self.converged_sigma_m is not None:
            finite("marginalized converged_sigma_m", self.converged_sigma_m, above=0.0)
        one_map_a_kind("marginalized", self.maps)

    def init(self, prior: Prior, rng: Generator) -> MarginalizedState:
        """The prior; which states there are shows with the first epoch, so the cloud is drawn then."""
        return MarginalizedState(prior)

    def step(self, state: MarginalizedState, epoch: Epoch, rng: Generator) -> MarginalizedState:
        """Let the time since the last epoch pass, then use the readings one by one."""
        state = self._begun(state, epoch, rng) if state.cloud is None else self._passed(state, epoch)
        pairs = [(reading, number) for reading in epoch.measurements if (number := self._number(reading.kind)) >= 0]
        innovations: list[Innovation] = []
        cloud = self._advanced(state, epoch, rng) if pairs else None
        for pair in pairs:
            assert cloud is not None
            state, innovation = self._updated(state, cloud, epoch, pair, rng)
            cloud = state.cloud
            innovations.append(innovation)
        compared = [one for one in innovations if one.known > 0.5]
        nis = [one.nis for one in compared if one.used]
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(state.cov[:2, :2]),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=not compared if innovations else None,
        )
        return changed(state, innovations=tuple(innovations), judgement=judgement)

    def estimate(self, state: MarginalizedState) -> Estimate:
        """Mean and covariance of the position error, the map's own place included."""
        if state.epoch is None:
            raise StateError("marginalized: no estimate before the first epoch")
        (north, one), (two, east) = state.cov[:2, :2].tolist()
        unaided = float(state.unaided[0, 0] + state.unaided[1, 1])
        place = max(1.0 - (north + east) / unaided, 0.0) * self._registration_m2(state)
        cross = 0.5 * (one + two)
        cov = np.array(((north + place, cross), (cross, east + place)))
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean[:2].copy(), cov, judgement.status, judgement.nis)

    def posterior(self, state: MarginalizedState) -> Posterior:
        """The positions of the cloud; what has passed since the latest reading moves them as a whole."""
        if state.cloud is None:
            raise StateError("marginalized: no posterior before the first epoch")
        rows, pending = state.cloud.rows, state.pending
        north, east = rows[:2].copy() if pending is None else np.einsum("ij,jk", pending.phi[:2], rows)
        return Posterior(north, east, state.cloud.weight)

    def innovations(self, state: MarginalizedState) -> tuple[Innovation, ...]:
        """Of the last epoch's readings."""
        return state.innovations

    def restarted(self, state: MarginalizedState, prior: Prior, rng: Generator) -> MarginalizedState:
        """A new cloud at the same epoch; what was learned of the noise stays."""
        if state.model is None:
            return replace(state, prior=prior)
        return self._filled(replace(state, prior=prior), state.model, rng)

    def excluding(self, state: MarginalizedState, kinds: frozenset[str]) -> MarginalizedState:
        """The state that does not use readings of these kinds."""
        return replace(state, excluded=kinds)

    @cached_property
    def _judge(self) -> Judge:
        limit = self.converged_sigma_m
        return Judge(converged_sigma_m=self._cell_m if limit is None else limit)

    @cached_property
    def _cell_m(self) -> float:
        return min(chart.cell_m for chart in self.maps)

    def _number(self, kind: str) -> int:
        """Of the map of a kind, -1 where there is none."""
        return next((i for i, chart in enumerate(self.maps) if chart.kind == kind), -1)

    def _registration_m2(self, state: MarginalizedState) -> float:
        """Variance per axis of the place of the map that fixes the position best [m^2]."""
        places = [
            min((self.registration_cells * chart.cell_m) ** 2, 0.5 * chart.sigma**2 / max(slope2, 1e-30))
            for chart, slope2, met in zip(self.maps, state.slope2.tolist(), state.met.tolist())
            if met > 0.0
        ]
        return min(places, default=0.0)

    def _count(self, area_m2: float) -> int:
        """How many particles a posterior of this area takes; in steps, so that a little more area changes nothing."""
        wanted = area_m2 / (FINEST_CELLS * self._cell_m) ** 2
        doublings = math.ceil(math.log2(max(wanted / self.least_particles, 1.0)))
        return int(min(self.least_particles * 2**doublings, max(self.particles, self.least_particles)))

    def _begun(self, state: MarginalizedState, epoch: Epoch, rng: Generator) -> MarginalizedState:
        """The state at the first epoch, before its readings."""
        model = ErrorModel(self.ins, self.maps, ErrorModel.level_for(self.ins, epoch), self.bias_sigma)
        start = noise_scale.told() if self.adapt_noise else noise_scale.certain()
        scale = np.tile(start, (len(self.maps), 1))
        none = np.zeros(len(self.maps))
        walk = walk_scale.told(self.adapt_walk)
        state = replace(state, model=model, scale=scale, walk=walk, slope2=none, met=none, epoch=epoch)
        return self._filled(state, model, rng)

    def _filled(self, state: MarginalizedState, model: ErrorModel, rng: Generator) -> MarginalizedState:
        """The state with a cloud drawn from its prior."""
        whole = model.initial_covariance(prior_covariance(state.prior))
        common = whole.copy()
        common[:2, :2] = 0.0
        bad, count = np.full(len(self.maps), self.outlier_share), self._count(prior_area(state.prior))
        need(STATE_BYTES * model.size * count, f"marginalized: {count} particles of {model.size} states")
        cloud = drawn(state.prior, common, count, bad, rng)
        cov, walk = cloud.cov + common, walk_scale.stopped(state.walk)
        return replace(state, cloud=cloud, pending=None, mean=cloud.mean, cov=cov, unaided=whole, walk=walk)

    def _passed(self, state: MarginalizedState, epoch: Epoch) -> MarginalizedState:
        """The state at the time of an epoch, before its readings; nothing is drawn yet."""
        model, before = state.model, state.epoch
        assert model is not None and before is not None  # noqa: PT018  set by _begun()
        passed = model.transition(before, epoch)
        for number, probability in enumerate(state.scale):
            patch = model.inertial + 2 * number + 1
            passed.q[patch, patch] *= noise_scale.expected(probability)
        walk = walk_scale.stepped(state.walk, passed, model.inertial)
        passed.q[: model.inertial, : model.inertial] *= walk.expected
        pending = passed if state.pending is None else state.pending.then(passed)
        mean, cov, unaided = predicted(passed.phi, passed.q, state.mean, state.cov, state.unaided)
        return changed(state, epoch=epoch, pending=pending, mean=mean, cov=cov, unaided=unaided, walk=walk)

    def _advanced(self, state: MarginalizedState, epoch: Epoch, rng: Generator) -> Cloud:
        """The cloud at an epoch with readings, all of its arrays new: what is pending drawn, regimes carried on."""
        cloud, last = state.cloud, state.last_reading
        assert cloud is not None  # set by _begun()
        keep = np.ones(len(self.maps))
        if last is not None:  # over the ground in between
            travelled = math.hypot(*offset_of(last.lat_deg, last.lon_deg, epoch.lat_deg, epoch.lon_deg))
            keep = np.array([math.exp(-travelled / (BAD_PATCH * chart.error_length_m)) for chart in self.maps])
        if state.pending is None:  # drawn at this very epoch
            return cloud
        return advanced(cloud, state.pending, self.outlier_share, keep, rng)

    def _updated(
        self, state: MarginalizedState, cloud: Cloud, epoch: Epoch, pair: tuple[Measurement, int], rng: Generator
    ) -> tuple[MarginalizedState, Innovation]:
        """The state after a reading of a map, given by number, and what it was against its prediction.

        `cloud` is that of this epoch, its arrays not yet anyone's.
        """
        (reading, number), model = pair, state.model
        chart = self.maps[number]
        assert model is not None  # set by _begun()
        blur2 = (self.blur_cells * chart.cell_m) ** 2
        reach = self.outlier_scale * math.hypot(reading.sigma, chart.sigma)
        seen = compared(cloud, model, number, epoch, reading, blur2=blur2, reach=reach)
        factor = noise_scale.expected(state.scale[number])
        noise = factor * (seen.told[0] + seen.told[1] * seen.mean_slope2) if seen.known > 0.0 else math.nan
        variance, used = seen.variance + noise + seen.common, chart.kind not in state.excluded and seen.known > 0.0
        innovation = Innovation(chart.kind, seen.mean, variance, noise, seen.known, used, math.sqrt(factor))
        drawn_now: dict[str, Any] = {"cloud": cloud, "pending": None, "last_reading": epoch}
        if not used:
            return changed(state, **drawn_now), innovation
        met, slope2, scale = state.met.copy(), state.slope2.copy(), state.scale
        met[number] = min(met[number] + 1.0, SLOPE_MEMORY)
        slope2[number] += (seen.mean_slope2 - slope2[number]) / met[number]
        if self.adapt_noise:
            scale = scale.copy()
            scale[number] = learned(cloud, seen, scale[number], factor)
            factor = noise_scale.expected(scale[number])
        white = seen.noise(factor, cloud.spacing_m)
        after = weighed(cloud, seen, state.mean, white)
        if after is None:  # the reading contradicts every particle
            return changed(state, met=met, slope2=slope2, scale=scale, **drawn_now), innovation
        cloud, cov, effective = after
        walk = self._wandered(state.walk, cloud, cov, seen, float(white[0])) if self.adapt_walk else state.walk
        mean = cloud.mean
        if effective < RESAMPLE_SHARE * cloud.weight.size:
            cloud = self._renewed(cloud, rng)
        drawn_now["cloud"] = cloud
        return changed(
            state, mean=mean, cov=cov, scale=scale, walk=walk, slope2=slope2, met=met, **drawn_now
        ), innovation

    def _wandered(
        self, walk: walk_scale.WalkScale, cloud: Cloud, cov: FloatArray, seen: Seen, noise: float
    ) -> walk_scale.WalkScale:
        """What a reading says of how much the INS wanders, the map being made a plane (`kernels.walk_scale`)."""
        if not largest_sigma_m(cov[:2, :2]) <= self._cell_m:
            return walk_scale.stopped(walk)
        plane = linearised(cloud.rows, cloud.weight, seen.residual, seen.bias, cloud.mean)
        noise += float(plane[5])
        if not 2.0 * plane[5] < noise:  # what the plane leaves is less than the rest, and no NaN
            return walk_scale.stopped(walk)
        if walk.idle:
            return walk_scale.started(walk, cloud.mean, cov)
        bad = mean_of(cloud.weight, cloud.bad[seen.number])
        return walk_scale.weighed(walk, plane, seen.bias, noise, (self.outlier_share, seen.reach), use=bad < 0.5)

    def _renewed(self, cloud: Cloud, rng: Generator) -> Cloud:
        """A cloud resampled, because too few particles carry the weight."""
        area = covered_area(cloud)
        count = max(self._count(area), cloud.weight.size // 2)  # small modes are not cut off at once
        return resampled(cloud, count, self._cell_m, area, rng)

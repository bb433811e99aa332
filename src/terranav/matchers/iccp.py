"""ICCP, iterative closest contour point: the INS trace is laid over the contours of its readings (papers/003).

Each reading c_i says that the vehicle is somewhere on the contour of that value. The trace x_i starts beside the INS
trace a_i and steps like it but for velocity and course errors alpha_i, eps_i; y_i is the point of contour c_i nearest
to x_i; the downhill simplex looks for the least

    E = E_INS + E_H,  E_INS = K sum |a_i - a_(i-1)| sqrt(alpha_i^2 + eps_i^2),  E_H = sum |x_i - y_i|     eqs. 1-4

from Q random starts, each until E < E_min or for T_max iterations. A judge says which of the Q results is the match and
whether it is believed (`terranav.matchers._judges`). The exponents in the print of eq. 2 are garbled; the paper's
E_min = (0.0005 + 0.0001) degrees a point is a sum of distances and not of squares.

What a match is worth is not in the paper. Here every distinct result is a Gaussian (`terranav.matchers._contours`)
weighed by the likelihood of its residuals and by the belief, so that ambiguity shows as covariance, and the match is
fused with the belief.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite, unknown_name
from terranav.core.earth import offset_m, shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m, started_over
from terranav.core.records import Epoch, Estimate, Measurement, Posterior, Prior, Profile, Status
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma
from terranav.matchers._contours import LEAST_STEP_ERROR, Optimisations, Task, solve
from terranav.matchers._judges import JUDGES, Decision, Memory, decide
from terranav.matchers.tercom import LEAST_READINGS, Tercom

FloatArray = NDArray[np.float64]

MOST_STEP_ERROR = 0.3  # 1-sigma of velocity [1] and course error [rad] to start from
REACH_SIGMA = 3.0  # contours are looked for this many sigmas of the search area away, and two cells


@dataclass(frozen=True, slots=True)
class Match:
    """The latest match: what the simplex found, and what the judge said of it.

    Attributes
    ----------
    found : Optimisations
        Best first.
    decision : Decision
    weight : (Q,)
        Probability of each result by its residuals and the belief, results of one place counted once.
    """

    found: Optimisations
    decision: Decision
    weight: FloatArray


@dataclass(frozen=True, slots=True)
class IccpState:
    """The belief after an epoch, the readings that wait to be matched, and what the judge remembers.

    Attributes
    ----------
    prior, unaided_m2 : Prior, float
        The initial belief, and the variance that an INS without fixes has gained since [m^2].
    mean_m, cov_m2 : (2,) [m], (2, 2) [m^2]
        The belief.
    window : tuple of Epoch
        The latest epochs with a reading.
    fresh : int
        How many of them have not been matched yet.
    memory : Memory
    matched_s : float
        Time of the latest match [s].
    judgement : Judgement
    fixed : bool
        Whether the belief rests on a match.
    latest : Match or None
    start_s, epoch : float, Epoch or None
        The time of the first epoch, and the latest.
    """

    prior: Prior
    mean_m: FloatArray
    cov_m2: FloatArray
    unaided_m2: float = 0.0
    window: tuple[Epoch, ...] = ()
    fresh: int = 0
    memory: Memory = field(default_factory=Memory.empty)
    matched_s: float = math.nan
    judgement: Judgement = field(default_factory=Judgement)
    fixed: bool = False
    latest: Match | None = None
    start_s: float = math.nan
    epoch: Epoch | None = None


@dataclass(frozen=True)
class Iccp:
    """ICCP with a judge of mismatches, over the stream of epochs.

    The defaults are for accuracy; papers/003 has window 3, every 1, iterations 60, e_min_m 222 (0.002 degrees),
    weight 1, per_step, fuse off.

    Attributes
    ----------
    maps : tuple of Map
        Readings of the kind of the first are matched with it.
    ins : InsGrade
        How fast the position error grows, and how far velocity and course may be off.
    window : int
        W, readings in a trace, >= 2.
    every : int or None
        New readings from one match to the next; None is the whole window. With fewer, readings are used again, and
        each match counts for the share of its readings that is new.
    starts : int
        Q, optimisations from random starts, >= 1.
    iterations : int
        T_max, of the simplex.
    e_min_m : float or None
        E_min [m]: a start ends as soon as E is below. 0 runs to convergence; None adapts it to slope and noise: eq. 5,
        W E(|height error|) / E(slope), and K times what the INS may be off over the trace.
    weight : float or None
        K, 1 in the paper. None weighs the INS by its precision: step errors of one sigma then cost as much as one
        point's expected distance from its contour. With K = 1 a trace of many points is bent to fit its noise.
    per_step : bool
        Whether each step has its own velocity and course error, as in the paper, or one of each holds for all.
    step_sigma : float or None
        1-sigma of velocity error [1] and course error [rad]; None follows from the INS's velocity sigma.
    judge : 'none', 'm_of_n' or 'pdaf'
    m, n, agree_m : int, int, float
        M/N: a match is accepted within `agree_m` [m] of at least m of the n matches before (0.003 degrees).
    pdaf_sigma_m : float or None
        sigma of eq. 7 [m]; None is the growth of the INS error between two matches, and a cell.
    search_sigma_m : float or None
        1-sigma of the starts about the centre of the search [m]; None is the belief's own.
    feedback : bool
        Whether the search is centred on the belief, or always on the initial prior.
    fuse : bool
        Whether an accepted match is fused with the belief unless its residuals are those of a lost one, or replaces it
        whatever its residuals, as in the paper.
    coarse_above_cells : float
        Where a sigma of the search is larger than so many map cells, TERCOM finds the places to start from (windows of
        four readings or more).
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, or no map.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    window: int = 32
    every: int | None = None
    starts: int = 20
    iterations: int = 500
    e_min_m: float | None = 0.0
    weight: float | None = None
    per_step: bool = False
    step_sigma: float | None = None
    judge: Literal["none", "m_of_n", "pdaf"] = "pdaf"
    m: int = 2
    n: int = 3
    agree_m: float = 334.0
    pdaf_sigma_m: float | None = None
    search_sigma_m: float | None = None
    feedback: bool = True
    fuse: bool = True
    coarse_above_cells: float = 10.0
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        if not self.maps:
            raise ConfigError("iccp maps is empty, expected at least one map")
        for key, least in (("window", 2), ("starts", 1), ("iterations", 1), ("m", 1), ("n", 1)):
            _whole(key, getattr(self, key), least)
        if self.m > self.n:
            raise ConfigError(f"iccp m is {self.m}, expected at most n, which is {self.n}")
        if self.every is not None:
            _whole("every", self.every, 1)
            if self.every > self.window:
                raise ConfigError(f"iccp every is {self.every}, expected at most the window of {self.window} readings")
        if self.judge not in JUDGES:
            unknown_name("iccp judge", str(self.judge), JUDGES)
        if self.weight is not None:
            finite("iccp weight", self.weight, minimum=0.0)
        finite("iccp agree_m", self.agree_m, above=0.0)
        finite("iccp coarse_above_cells", self.coarse_above_cells, above=0.0)
        if self.e_min_m is not None:
            finite("iccp e_min_m", self.e_min_m, minimum=0.0)
        for key in ("step_sigma", "pdaf_sigma_m", "search_sigma_m", "converged_sigma_m"):
            if getattr(self, key) is not None:
                finite(f"iccp {key}", getattr(self, key), above=0.0)

    def init(self, prior: Prior, rng: Generator) -> IccpState:
        """The prior, and an empty window."""
        return IccpState(prior, prior.mean_m, prior.cov_m2)

    def step(self, state: IccpState, epoch: Epoch, rng: Generator) -> IccpState:
        """Let the belief drift, take the reading, and match when the window is full and new enough."""
        state = self._drifted(state, epoch)
        chart = self.maps[0]
        if all(m.kind != chart.kind for m in epoch.measurements):
            return replace(state, judgement=self._judged(state))
        state = replace(state, window=(*state.window, epoch)[-self.window :], fresh=state.fresh + 1)
        here = Estimate.at(epoch, state.mean_m, state.cov_m2, Status.SEARCHING)
        off_map = bool(np.isnan(chart.sample(here.lat_deg, here.lon_deg)))
        if len(state.window) == self.window and state.fresh >= (self.every or self.window):
            return self._matched(state, off_map, rng)
        return replace(state, judgement=self._judged(state, off_map=off_map))

    def estimate(self, state: IccpState) -> Estimate:
        """The belief."""
        if state.epoch is None:
            raise StateError("iccp: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    def posterior(self, state: IccpState) -> Posterior | None:
        """The optimisations of the latest match with their probabilities; None before the first."""
        if state.latest is None:
            return None
        north, east = state.latest.found.places_m.T
        return Posterior(north, east, state.latest.weight)

    def _judged(
        self, state: IccpState, nis: float = math.nan, readings: int = 0, off_map: bool | None = None
    ) -> Judgement:
        """Judge the belief as it is."""
        sigma = largest_sigma_m(state.cov_m2)
        return judge(self._limits, state.judgement, sigma, nis=nis, readings=readings, off_map=off_map)

    @property
    def _limits(self) -> Judge:
        return Judge(self.maps[0].cell_m if self.converged_sigma_m is None else self.converged_sigma_m)

    def _drifted(self, state: IccpState, epoch: Epoch) -> IccpState:
        """The belief at the time of `epoch`."""
        if state.epoch is None:
            return replace(state, epoch=epoch, start_s=epoch.time_s)
        elapsed, dt = state.epoch.time_s - state.start_s, epoch.time_s - state.epoch.time_s
        growth = [self.ins.position_growth_m2(elapsed, dt, float(v)) for v in np.diag(state.cov_m2)]
        unaided = state.unaided_m2 + self.ins.position_growth_m2(elapsed, dt)
        return replace(state, epoch=epoch, cov_m2=state.cov_m2 + np.diag(growth), unaided_m2=unaided)

    def _matched(self, state: IccpState, off_map: bool, rng: Generator) -> IccpState:
        """Match the window; take the match if the judge accepts it and its residuals are not those of a lost one."""
        search = self._search(state)
        task = self._task(state, search)
        found = solve(task, *self._starts(task, search, rng), (self._e_min_m(task, search), self.iterations))
        fresh = min(state.fresh, self.window)
        state = replace(state, fresh=0)
        if not found.target_m.size:
            return replace(state, latest=None, judgement=self._judged(state, off_map=off_map))
        limits = (self.m, self.n, self.agree_m, self._pdaf_sigma_m(state))
        decision, memory = decide(self.judge, found.places_m, found.target_m, state.memory, limits)
        means, covs, weight = _gaussians(found, search, fresh / self.window, self.maps[0].cell_m)
        chosen = found.best_near(decision.chosen, self.maps[0].cell_m) if self.fuse else decision.chosen
        nis = float(np.nanmean(found.misfit[chosen] ** 2))
        now = state.window[-1].time_s
        state = replace(state, memory=memory, matched_s=now, latest=Match(found, decision, weight))
        if decision.accepted and not (self.fuse and nis > self._limits.nis_lost):
            mean = means[chosen] if self.fuse else found.places_m[chosen]
            off = means - mean
            cov = np.einsum("k,kij->ij", weight, covs) + np.einsum("k,ki,kj->ij", weight, off, off)
            walk = self.ins.position_walk_m_per_sqrt_s**2 * 0.5 * (now - state.window[0].time_s)
            state = replace(state, mean_m=mean, cov_m2=cov + walk * np.eye(2), fixed=True)
        state = replace(state, judgement=self._judged(state, nis, fresh, off_map))
        lost = self.fuse and state.judgement.status is Status.LOST
        return _started_over(state) if lost else state

    def _search(self, state: IccpState) -> Prior:
        """Where the match is looked for."""
        mean = state.mean_m if self.feedback else state.prior.mean_m
        cov = state.cov_m2 if self.search_sigma_m is None else np.eye(2) * self.search_sigma_m**2
        shape = "gaussian" if state.fixed or self.search_sigma_m is not None else state.prior.shape
        return Prior(mean, cov, shape)

    def _task(self, state: IccpState, search: Prior) -> Task:
        """The window as a task for the simplex."""
        chart, profile = self.maps[0], Profile(state.window, self.maps[0].kind)
        before = (None, *profile.epochs[:-1])
        told = [
            reading_sigma(Measurement(profile.kind, float(v), float(s)), chart, previous, epoch)
            for v, s, previous, epoch in zip(profile.value, profile.sigma, before, profile.epochs, strict=True)
        ]
        step_sigma = self._step_sigma(state, profile) if self.step_sigma is None else self.step_sigma
        sigma = np.maximum(np.array(told), 1e-6)
        reach = REACH_SIGMA * largest_sigma_m(search.cov_m2) + 2.0 * chart.cell_m
        aside = min(_expected_m(chart, profile, sigma, search), reach)
        length = max(_length_m(profile), 1e-3)
        weight = aside / (step_sigma * length) if self.weight is None else self.weight
        return Task(chart, profile, sigma, self.per_step, step_sigma, weight, reach)

    def _step_sigma(self, state: IccpState, profile: Profile) -> float:
        """Velocity error over speed [1]: as large a course error [rad] is as likely."""
        seconds = float(profile.time_s[-1] - profile.time_s[0])
        drift_m = self.ins.velocity_sigma_at_mps(state.window[-1].time_s - state.start_s) * seconds
        return min(max(drift_m / max(_length_m(profile), 1e-3), LEAST_STEP_ERROR), MOST_STEP_ERROR)

    def _starts(self, task: Task, search: Prior, rng: Generator) -> tuple[FloatArray, FloatArray]:
        """Q random starts: the INS errors (Q, 2) at the last point [m] and the velocity and course errors."""
        steps = task.step_sigma * rng.standard_normal((self.starts, task.variables - 2))
        half = np.sqrt(np.diag(search.cov_m2))
        if search.shape == "uniform":
            errors = search.mean_m + rng.uniform(-3.0, 3.0, (self.starts, 2)) * half
        else:
            errors = search.mean_m + rng.standard_normal((self.starts, 2)) @ np.linalg.cholesky(search.cov_m2).T
        if half.max() > self.coarse_above_cells * task.chart.cell_m and self.window >= LEAST_READINGS:
            places = Tercom((task.chart,), sub_cell=False).match(search, task.profile).ins_error_m
            if len(places):  # each of its places in turn, and random starts a cell around
                near = rng.standard_normal((self.starts, 2)) * task.chart.cell_m
                errors = places[np.arange(self.starts) % len(places)] + near
        return errors, steps

    def _e_min_m(self, task: Task, search: Prior) -> float:
        """E_min: as set, or by eqs. 3-5 for the searched trace and step errors of one sigma."""
        if self.e_min_m is not None:
            return self.e_min_m
        aside = min(_expected_m(task.chart, task.profile, task.sigma, search), task.reach_m)
        return self.window * aside + task.weight * task.step_sigma * _length_m(task.profile)

    def _pdaf_sigma_m(self, state: IccpState) -> float:
        """1-sigma of the INS error's change since the latest match."""
        if self.pdaf_sigma_m is not None:
            return self.pdaf_sigma_m
        if math.isnan(state.matched_s):
            return self.maps[0].cell_m
        elapsed, dt = state.matched_s - state.start_s, state.window[-1].time_s - state.matched_s
        return math.sqrt(self.ins.position_growth_m2(elapsed, dt, 0.0) + self.maps[0].cell_m ** 2)


def _length_m(profile: Profile) -> float:
    """Length of the INS trace."""
    north, east = offset_m(profile.lat_deg[:-1], profile.lon_deg[:-1], profile.lat_deg[1:], profile.lon_deg[1:])
    return float(np.hypot(north, east).sum())


def _expected_m(chart: Map, profile: Profile, sigma: FloatArray, search: Prior) -> float:
    """E_H of one point by eq. 5: mean height error over mean slope where the search begins; infinite on the level."""
    here = shift(profile.lat_deg, profile.lon_deg, -search.mean_m[0], -search.mean_m[1])
    slope = np.hypot(*chart.gradient(*here))
    slope = slope[np.isfinite(slope)]
    mean = float(slope.mean()) if slope.size else 0.0
    return math.sqrt(2.0 / math.pi) * float(sigma.mean()) / mean if mean > 0.0 else math.inf


def _gaussians(
    found: Optimisations, search: Prior, share: float, cell_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Means (Q, 2), covariances (Q, 2, 2) and probabilities (Q,) of the results together with the belief.

    Each has the likelihood of its residuals; where these are larger than told, all are discounted. Information counts
    for the `share` of the readings that is new. Results within a cell of a better one are the same place.
    """
    scale = 3.0 if search.shape == "uniform" else 1.0  # a uniform prior reaches 3 sigma: its variance is 3 sigma^2
    before = np.linalg.inv(search.cov_m2 * scale)
    squares = np.nanmean(found.misfit**2, axis=1)
    spread = max(1.0, float(squares.min()))
    information = found.information * (share / spread)
    covs = np.linalg.inv(before + information)
    off = found.places_m - search.mean_m
    pull = np.einsum("kij,kjl,kl->ki", covs, information, off)
    means = search.mean_m + pull
    against = np.einsum("ki,kij,kj->k", off - pull, information, off)
    log_p = -0.5 * squares * found.misfit.shape[1] / spread - 0.5 * against + 0.5 * np.linalg.slogdet(covs)[1]
    for k in range(1, log_p.size):
        if np.hypot(*(means[:k] - means[k]).T)[np.isfinite(log_p[:k])].min() < cell_m:
            log_p[k] = -np.inf
    weight = np.exp(log_p - log_p.max())
    return means, 0.5 * (covs + covs.transpose(0, 2, 1)), weight / weight.sum()


def _started_over(state: IccpState) -> IccpState:
    """The belief as if there had never been a match."""
    cov = state.prior.cov_m2 + state.unaided_m2 * np.eye(2)
    judgement = started_over(state.judgement)
    return replace(
        state, mean_m=state.prior.mean_m, cov_m2=cov, fixed=False, judgement=judgement, memory=Memory.empty()
    )


def _whole(key: str, value: object, minimum: int) -> None:
    """Raise ConfigError unless `value` is a whole number of at least `minimum`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
        raise ConfigError(f"iccp {key} is {value!r}, expected a whole number >= {minimum}")

"""Windowed: makes an Estimator of any Matcher, by matching the latest readings as one profile.

A fix is a posterior: the matcher is given the belief as of now and answers with the belief after the profile, so the
search area follows the belief: it shrinks with each fix and grows with the INS's drift. Candidates are merged into
one mean and covariance, so that ambiguity shows as covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m, started_over
from terranav.core.protocols import Matcher
from terranav.core.records import Candidates, Epoch, Estimate, Posterior, Prior, Profile, Status
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

LEAST_WINDOW = 4


@dataclass(frozen=True, slots=True)
class WindowedState:
    """The belief after an epoch, and the readings that wait to be matched.

    Attributes
    ----------
    prior, unaided_m2 : Prior, float
        The initial belief, and the variance that an INS without fixes has gained since [m^2].
    mean_m, cov_m2 : (2,) [m], (2, 2) [m^2]
        The belief.
    window : tuple of Epoch
        The latest epochs with a reading, at most the window's length.
    fresh : int
        How many of them have not been matched yet.
    judgement : Judgement
    fixed : bool
        Whether the belief rests on a fix.
    posterior : Posterior or None
        Of the latest match.
    start_s, epoch : float, Epoch or None
        The time of the first epoch, and the latest.
    """

    prior: Prior
    mean_m: FloatArray
    cov_m2: FloatArray
    unaided_m2: float = 0.0
    window: tuple[Epoch, ...] = ()
    fresh: int = 0
    judgement: Judgement = field(default_factory=Judgement)
    fixed: bool = False
    posterior: Posterior | None = None
    start_s: float = math.nan
    epoch: Epoch | None = None


@dataclass(frozen=True)
class Windowed:
    """A batch method run over the stream: a fix whenever enough new readings are there.

    The matcher's answer must have the prior in it. The window's readings fix the mean error over the window, which is
    that of its middle, so half a window of INS drift is added to the fix. A fix is taken when its best candidate has
    at least `min_probability` and its NIS is not that of a lost estimate; else the belief stays as it was. When the
    readings say that the estimate is lost, the belief returns to the initial prior and the drift since.

    Attributes
    ----------
    matcher : Matcher
        Matches readings of the kind of its first map.
    ins : InsGrade
        How fast the position error grows (`InsGrade.position_growth_m2`).
    window : int
        Readings in a profile; 48 as in papers/004. Longer ones are less ambiguous, shorter ones suffer less from
        drift.
    every : int or None
        New readings from one match to the next. None is the whole window: then each fix rests on its own readings, as
        TERCOM's always did. With fewer, readings are used again, and each fix counts for the share of its readings
        that is new.
    min_probability : float
        Of the best candidate, for the fix to be taken.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range.
    """

    matcher: Matcher
    ins: InsGrade
    window: int = 48
    every: int | None = None
    min_probability: float = 0.5
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        _whole("windowed window", self.window, LEAST_WINDOW)
        if self.every is not None:
            _whole("windowed every", self.every, 1)
            if self.every > self.window:
                raise ConfigError(
                    f"windowed every is {self.every}, expected at most the window of {self.window} readings"
                )
        finite("windowed min_probability", self.min_probability, minimum=0.0, maximum=1.0)
        if self.converged_sigma_m is not None:
            finite("windowed converged_sigma_m", self.converged_sigma_m, above=0.0)
        if not getattr(self.matcher, "maps", ()):
            raise ConfigError(f"windowed matcher {type(self.matcher).__name__} has no maps, expected at least one")

    @property
    def maps(self) -> tuple[Map, ...]:
        """The matcher's maps."""
        maps: tuple[Map, ...] = self.matcher.maps  # type: ignore[attr-defined]
        return maps

    def init(self, prior: Prior, rng: Generator) -> WindowedState:
        """The prior, and an empty window."""
        return WindowedState(prior, prior.mean_m, prior.cov_m2)

    def step(self, state: WindowedState, epoch: Epoch, rng: Generator) -> WindowedState:
        """Let the belief drift, take the reading, and match when the window is full and new enough."""
        state = self._drifted(state, epoch)
        if all(m.kind != self.maps[0].kind for m in epoch.measurements):
            return replace(state, judgement=self._judged(state))
        state = replace(state, window=(*state.window, epoch)[-self.window :], fresh=state.fresh + 1)
        here = shift(epoch.lat_deg, epoch.lon_deg, -state.mean_m[0], -state.mean_m[1])
        off_map = bool(np.isnan(self.maps[0].sample(*here)))
        if len(state.window) == self.window and state.fresh >= (self.every or self.window):
            return self._matched(state, off_map)
        return replace(state, judgement=self._judged(state, off_map=off_map))

    def estimate(self, state: WindowedState) -> Estimate:
        """The belief."""
        if state.epoch is None:
            raise StateError("windowed: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    def posterior(self, state: WindowedState) -> Posterior | None:
        """What the latest match left of its search area; None before the first."""
        return state.posterior

    @property
    def _judge(self) -> Judge:
        limit = self.maps[0].cell_m if self.converged_sigma_m is None else self.converged_sigma_m
        return Judge(converged_sigma_m=limit)

    def _judged(
        self, state: WindowedState, nis: float = math.nan, readings: int = 0, off_map: bool | None = None
    ) -> Judgement:
        """Judge the belief as it is."""
        sigma = largest_sigma_m(state.cov_m2)
        return judge(self._judge, state.judgement, sigma, nis=nis, readings=readings, off_map=off_map)

    def _drifted(self, state: WindowedState, epoch: Epoch) -> WindowedState:
        """The belief at the time of `epoch`."""
        if state.epoch is None:
            return replace(state, epoch=epoch, start_s=epoch.time_s)
        elapsed, dt = state.epoch.time_s - state.start_s, epoch.time_s - state.epoch.time_s
        growth = [self.ins.position_growth_m2(elapsed, dt, float(v)) for v in np.diag(state.cov_m2)]
        unaided = self.ins.position_growth_m2(elapsed, dt)
        cov = state.cov_m2 + np.diag(growth)
        return replace(state, epoch=epoch, cov_m2=cov, unaided_m2=state.unaided_m2 + unaided)

    def _matched(self, state: WindowedState, off_map: bool) -> WindowedState:
        """Match the window, and take the fix or leave it."""
        shape = "gaussian" if state.fixed else state.prior.shape
        belief = Prior(state.mean_m, state.cov_m2, shape)
        fixes = self.matcher.match(belief, Profile(state.window, self.maps[0].kind))
        fresh = min(state.fresh, self.window)
        found = len(fixes.probability) > 0
        state = replace(state, fresh=0, posterior=fixes.posterior)
        if found and fixes.probability[0] >= self.min_probability and not fixes.nis > self._judge.nis_lost:
            state = self._taken(state, belief, fixes, fresh / self.window)
        state = replace(state, judgement=self._judged(state, fixes.nis, fresh if found else 0, off_map or not found))
        return _started_over(state) if state.judgement.status is Status.LOST else state

    def _taken(self, state: WindowedState, belief: Prior, fixes: Candidates, share: float) -> WindowedState:
        """The belief after a fix that counts for `share` of its information, and half a window of drift."""
        mean, cov = _merged(fixes)
        if share < 1.0:
            before, after = np.linalg.inv(belief.cov_m2), np.linalg.inv(cov)
            cov_part = np.linalg.inv((1.0 - share) * before + share * after)
            mean = cov_part @ ((1.0 - share) * before @ belief.mean_m + share * after @ mean)
            cov = 0.5 * (cov_part + cov_part.T)
        half_s = 0.5 * (state.window[-1].time_s - state.window[0].time_s)
        speed = self.ins.velocity_sigma_at_mps(state.window[-1].time_s - state.start_s)
        drift = (speed * half_s) ** 2 + self.ins.position_walk_m_per_sqrt_s**2 * half_s
        return replace(state, mean_m=mean, cov_m2=cov + drift * np.eye(2), fixed=True)


def _merged(fixes: Candidates) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of all candidates together."""
    p = fixes.probability / fixes.probability.sum()
    mean = p @ fixes.ins_error_m
    off = fixes.ins_error_m - mean
    return mean, np.einsum("k,kij->ij", p, fixes.cov_m2) + np.einsum("k,ki,kj->ij", p, off, off)


def _started_over(state: WindowedState) -> WindowedState:
    """The belief as if there had never been a fix."""
    cov = state.prior.cov_m2 + state.unaided_m2 * np.eye(2)
    return replace(state, mean_m=state.prior.mean_m, cov_m2=cov, fixed=False, judgement=started_over(state.judgement))


def _whole(key: str, value: object, minimum: int) -> None:
    """Raise ConfigError unless `value` is a whole number of at least `minimum`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < minimum:
        raise ConfigError(f"{key} is {value!r}, expected a whole number of readings >= {minimum}")

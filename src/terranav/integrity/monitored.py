"""Monitored: an estimator that is watched, started anew when it is lost, and believed only for good reasons.

After each step of the watched estimator its innovations are tested (`windows`), the places that the readings would fit
as well are weighed (`rivals`), and what does not go together is mended: a sensor that hangs or a map that contradicts
the others is left out, sigmas that are too small are raised, and an estimate that the readings contradict is thrown
away and searched for around the last good one (`recovery`). Then follow status, protection level and reasons.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from numpy.random import Generator

from terranav.core.checks import finite
from terranav.core.earth import offset_of
from terranav.core.errors import ConfigError
from terranav.core.frozen import changed
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import HYSTERESIS, largest_sigma_m
from terranav.core.protocols import Watched
from terranav.core.records import Epoch, Estimate, Measurement, Posterior, Prior
from terranav.integrity import judging, mending, rivals
from terranav.integrity.protection import Tail, tail_of
from terranav.integrity.state import Counted, MonitorState
from terranav.integrity.windows import Window, noise_factor
from terranav.maps.map import Map

RIVALS_SIGMA = 4.0  # how far rivals are looked for, in sigmas of the area that was searched
FARTHEST_M, FARTHEST_CELLS = 4000.0, 60.0  # but no farther than the larger of these
BUDGET = 0.5  # of the risk for the posterior, and as much for the rivals
APART_CELLS, STILL_S = 0.2, 30.0  # readings nearer than that, and sooner, count once
STRIDE = 4  # once the rivals were refuted, every fourth reading is weighed
GAP_MEMORY = 0.1


@dataclass(frozen=True)
class Monitored:
    """An estimator and its integrity monitor.

    Attributes
    ----------
    estimator : Watched
        What is watched; `maps` and `ins` are its own.
    risk : float
        Declared probability that the error of a usable fix exceeds its protection level, in (0, 0.1].
    alert_limit_m : float or None
        A fix whose protection level is larger is withheld [m].
    false_alarm : float
        Probability per window of readings as told that a test of the monitor fails, in (0, 0.01].
    probation : int
        Readings after a fix before it is believed, >= 1.
    outage_s : float
        A fix is withheld when no reading was answered by a map for longer, > 0 [s].
    most_spread_m : float
        Largest sigma of the area that is searched for a lost position, > 0 [m].

    Raises
    ------
    ConfigError
        For a setting out of its range, or an estimator that cannot be watched.
    """

    estimator: Watched[Any]
    risk: float = 1e-3
    alert_limit_m: float | None = None
    false_alarm: float = 1e-6
    probation: int = 20
    outage_s: float = 300.0
    most_spread_m: float = 20_000.0

    def __post_init__(self) -> None:
        if not isinstance(self.estimator, Watched):
            raise ConfigError(
                f"monitored estimator is {self.estimator!r}, expected one with innovations, restarted and excluding"
            )
        finite("monitored risk", self.risk, above=0.0, maximum=0.1)
        finite("monitored false_alarm", self.false_alarm, above=0.0, maximum=0.01)
        finite("monitored outage_s", self.outage_s, above=0.0)
        finite("monitored most_spread_m", self.most_spread_m, above=0.0)
        if self.alert_limit_m is not None:
            finite("monitored alert_limit_m", self.alert_limit_m, above=0.0)
        if isinstance(self.probation, bool) or not isinstance(self.probation, int) or self.probation < 1:
            raise ConfigError(f"monitored probation is {self.probation!r}, expected a whole number of readings >= 1")

    @cached_property
    def maps(self) -> tuple[Map, ...]:
        """Of the estimator."""
        return tuple(getattr(self.estimator, "maps", ()))

    @cached_property
    def ins(self) -> InsGrade:
        """What the estimator is told of the INS."""
        grade: InsGrade = getattr(self.estimator, "ins", InsGrade())
        return grade

    @cached_property
    def converged_sigma_m(self) -> float:
        """Largest axis that counts as a fix: the estimator's own, or the finest map's cell [m]."""
        own = getattr(self.estimator, "converged_sigma_m", None)
        return float(own) if own is not None else min(chart.cell_m for chart in self.maps)

    def init(self, prior: Prior, rng: Generator) -> MonitorState:
        """State before the first epoch."""
        windows = tuple(Window(chart.kind) for chart in self.maps)
        return MonitorState(self.estimator.init(prior, rng), prior, windows=windows)

    def step(self, state: MonitorState, epoch: Epoch, rng: Generator) -> MonitorState:
        """Step the estimator, test, mend, judge."""
        kinds = {chart.kind for chart in self.maps}
        told, counted = self._counting(_with_factors(epoch, state), state)
        inner = self.estimator.step(state.inner, told, rng)
        readings = tuple(reading for reading in told.measurements if reading.kind in kinds)
        innovations = self.estimator.innovations(inner)
        start_s = epoch.time_s if state.epoch is None else state.start_s
        more = {"epoch": told, "start_s": start_s, "innovations": innovations, "counted": counted}
        after = self._located(state, inner, readings, **more)
        after = self._weighed(_seen(self, after, readings), readings)
        after = _settled(self, mending.mended(self, after, rng))
        return changed(after, verdict=judging.verdict(self, after), anchors=judging.anchors(self, after))

    def estimate(self, state: MonitorState) -> Estimate:
        """The estimate with the monitor's verdict."""
        verdict = state.verdict
        return changed(
            self.estimator.estimate(state.inner),
            status=verdict.status,
            nis=verdict.nis,
            protection_m=verdict.protection_m,
            usable=verdict.usable,
            reasons=verdict.reasons,
        )

    def posterior(self, state: MonitorState) -> Posterior:
        """Of the estimator."""
        return self.estimator.posterior(state.inner)

    def _counting(self, epoch: Epoch, state: MonitorState) -> tuple[Epoch, tuple[Counted, ...]]:
        """The epoch without readings less than a fifth of a map cell from the latest of their kind; the latest with it.

        Within a cell readings share the map's error and the place for which it speaks. Ten of them are not ten
        witnesses: the filter would settle on a wrong place, the tests refute the right one, for what is wrong there.
        """
        if not epoch.measurements:
            return epoch, state.counted
        cells = {chart.kind: chart.cell_m for chart in self.maps}
        before = {one[0]: one for one in state.counted}
        kept = []
        for reading in epoch.measurements:
            if reading.kind in cells and reading.kind in before:
                _, time_s, lat_deg, lon_deg = before[reading.kind]
                moved_m = math.hypot(*offset_of(lat_deg, lon_deg, epoch.lat_deg, epoch.lon_deg))
                if moved_m < APART_CELLS * cells[reading.kind] and epoch.time_s - time_s < STILL_S:
                    continue
            kept.append(reading)
            before[reading.kind] = reading.kind, epoch.time_s, epoch.lat_deg, epoch.lon_deg
        counted = tuple(before.values())
        if len(kept) == len(epoch.measurements):
            return epoch, counted
        return changed(epoch, measurements=tuple(kept)), counted

    def _located(self, state: MonitorState, inner: Any, readings: tuple[Measurement, ...], **rest: Any) -> MonitorState:
        """Where the estimate is now, and how far its cloud reaches; rivals of an estimate that jumped are gone.

        `inner` is the state of the estimator after the epoch, `rest` what else has changed.
        """
        estimate = self.estimator.estimate(inner)
        sigma = largest_sigma_m(estimate.cov_m2)
        field = state.rivals
        if field is not None:
            jump = math.dist(estimate.ins_error_m.tolist(), state.mean_m.tolist())
            allowed = max(rivals.NEAR * field.spacing_m, 4.0 * state.sigma_m)
            if jump > allowed or sigma > HYSTERESIS * self.converged_sigma_m:
                field = None
        tail = state.tail
        if readings and sigma <= HYSTERESIS * self.converged_sigma_m:
            tail = tail_of(self.estimator.posterior(inner), estimate.ins_error_m, BUDGET * self.risk)
        elif readings:
            tail = Tail()
        return changed(
            state,
            inner=inner,
            mean_m=estimate.ins_error_m,
            sigma_m=sigma,
            spread_m=max(state.spread_m, sigma),
            tail=tail,
            rivals=field,
            standing=state.standing if field is not None else None,
            **rest,
        )

    def _weighed(self, state: MonitorState, readings: tuple[Measurement, ...]) -> MonitorState:
        """Rivals from the first fix on, and what these readings say of them."""
        pairs = list(zip(readings, state.innovations, strict=True))
        used = [(reading, one.scale) for reading, one in pairs if one.used and one.known > 0.5]
        if not used or state.epoch is None:
            return state
        if state.rivals is None:
            if state.sigma_m > self.converged_sigma_m:
                return state
            cell = min(chart.cell_m for chart in self.maps)
            reach = min(RIVALS_SIGMA * state.spread_m, max(FARTHEST_M, FARTHEST_CELLS * cell))
            field = rivals.Rivals.within(reach, 0.5 * cell)
        elif state.rivals.proved and state.readings % STRIDE and not judging.uneasy(state):
            return state
        else:
            field = state.rivals
            charts = {chart.kind: chart for chart in self.maps}
            windows = {window.kind: window for window in state.windows}
            for reading, scale in used:
                field = rivals.weighed(
                    field,
                    state.epoch,
                    reading,
                    charts[reading.kind],
                    state.mean_m,
                    factor=scale * noise_factor(windows[reading.kind].nis),
                    budget=BUDGET * self.risk,
                )
        near = judging.protection(self, state)
        return changed(state, rivals=field, standing=rivals.standing(field, BUDGET * self.risk, near))


def _seen(monitor: Monitored, state: MonitorState, readings: tuple[Measurement, ...]) -> MonitorState:
    """The windows with these readings; after a gap they start afresh."""
    pairs = list(zip(readings, state.innovations, strict=True))
    compared = [(reading, one) for reading, one in pairs if one.known > 0.5 and one.variance > 0.0]
    if not compared or state.epoch is None:
        return changed(state, off_map=state.off_map + 1) if pairs else state
    now, typical = state.epoch.time_s, state.gap_s
    gap = now - state.last_s
    windows, silence = state.windows, state.silence_s
    if gap > max(monitor.outage_s, 10.0 * typical if math.isfinite(typical) else 0.0):
        windows, silence = tuple(window.cleared() for window in windows), gap
    if math.isfinite(gap) and gap > 0.0:
        typical = typical + GAP_MEMORY * (gap - typical) if math.isfinite(typical) else gap
    by_kind = {window.kind: window for window in windows}
    for reading, one in compared:
        by_kind[one.kind] = by_kind[one.kind].plus(one, reading.value, state.epoch, state.mean_m, monitor.false_alarm)
    count = len(compared)
    return changed(
        state,
        windows=tuple(by_kind.values()),
        readings=state.readings + count,
        since=state.since + count,
        last_s=now,
        gap_s=typical,
        silence_s=silence,
        off_map=0,
    )


def _with_factors(epoch: Epoch, state: MonitorState) -> Epoch:
    """The epoch with the sigmas of its readings as they look, where they look larger than told."""
    if not state.factors:
        return epoch
    scaled: list[Measurement] = []
    for reading in epoch.measurements:
        scaled.append(changed(reading, sigma=reading.sigma * state.factor(reading.kind)))
    return changed(epoch, measurements=tuple(scaled))


def _settled(monitor: Monitored, state: MonitorState) -> MonitorState:
    """A fix that has proved itself: the position is found (again)."""
    if state.fixed and state.silence_s == 0.0 and state.rivals is not None and state.rivals.proved:
        return state
    if not judging.proven(monitor, state) or state.sigma_m > HYSTERESIS * monitor.converged_sigma_m:
        return state
    if state.lost and state.anchors and judging.complaints(monitor, state):
        return state  # sensors and map were good for a fix before: a place where they are not is not the right one
    proved = None if state.rivals is None else changed(state.rivals, proved=True)
    found = tuple(mending.named(state, one) if one.trial else one for one in state.left_out)
    return changed(state, fixed=True, lost="", attempt=0, rivals=proved, left_out=found, silence_s=0.0)

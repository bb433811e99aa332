"""What is done about findings: leave a kind out, take it in again, raise a sigma, search anew."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import Generator

from terranav.integrity import recovery, rivals, words
from terranav.integrity.protection import Tail
from terranav.integrity.state import LeftOut, MonitorState
from terranav.integrity.windows import (
    LENGTHS,
    LONGEST,
    RESIDUAL,
    Finding,
    Window,
    coloured,
    contradiction,
    excess,
    nis_limit,
    noise_factor,
    stuck,
)

if TYPE_CHECKING:
    from terranav.integrity.monitored import Monitored

RIVALS_WIN = 0.99  # probability of all rivals at which the estimate is given up
YOUNG = 20  # readings before rivals can tell noise from a wrong place
LARGEST_FACTOR = 30.0
DOUBT = 1e-3  # probability that residuals as told are called doubtful
AGREES = 1e-3  # probability that a kind that agrees again fails its test


def mended(monitor: Monitored, state: MonitorState, rng: Generator) -> MonitorState:
    """The state after what this epoch's readings call for."""
    if not any(one.known > 0.5 for one in state.innovations):
        return state
    state = _sensors_that_hang(monitor, state, rng)
    bad = {
        window.kind: found
        for window in state.windows
        if window.kind not in state.silent and (found := contradiction(window.nis, monitor.false_alarm))
    }
    wrong = {kind: found for kind, found in bad.items() if not _only_noisy(state, kind)}
    state = _factors(monitor, state, set(bad) - set(wrong))
    if wrong and (state.rivals is None or state.rivals.readings >= YOUNG or state.lost):
        return _contradicted(monitor, state, wrong, rng)
    standing = state.standing
    if standing is not None and standing.share > RIVALS_WIN and _doubtful(state):
        return _searched(monitor, state, words.elsewhere(-standing.best_m, standing.share), standing.readings, rng)
    return _taken_in(monitor, state)


def _only_noisy(state: MonitorState, kind: str) -> bool:
    """Whether the latest readings of a kind, for all their noise, speak for this place and no other."""
    return state.rivals is not None and rivals.supports(state.rivals, kind, 0.0)


def _doubtful(state: MonitorState) -> bool:
    """Whether the residuals are too large for the estimate to be right, on a lower bar than for a contradiction."""
    windows = [window for window in state.windows if window.kind not in state.silent]
    return any(excess(window.nis, DOUBT) for window in windows)


def _factors(monitor: Monitored, state: MonitorState, noisy: set[str]) -> MonitorState:
    """Raise the sigmas of kinds that scatter more than told about the right place, and lower them when they do not.

    From the innovations, as Mehra, IEEE Trans. Automatic Control 15 (1970), section V, but by their median.
    """
    factors = dict(state.factors)
    windows = []
    for seen in state.windows:
        window, nis = seen, seen.nis
        factor = factors.get(window.kind, 1.0)
        full = len(window) >= LONGEST
        scattered = full and excess(nis, monitor.false_alarm) and _only_noisy(state, window.kind)
        if window.kind in noisy or (scattered and coloured(window, monitor.false_alarm) is None):
            factors[window.kind] = min(factor * max(noise_factor(nis, LONGEST), 1.1), LARGEST_FACTOR)
            window = window.cleared()
        elif full and factor > 1.0 and float(nis.mean()) < 0.7:
            factors[window.kind] = max(factor * float(np.sqrt(nis.mean())), 1.0)
            window = window.cleared()
        windows.append(window)
    kept = tuple(sorted((kind, factor) for kind, factor in factors.items() if factor > 1.0))
    return replace(state, windows=tuple(windows), factors=kept)


def _contradicted(monitor: Monitored, state: MonitorState, wrong: dict[str, Finding], rng: Generator) -> MonitorState:
    """Leave the worst kind out if there are others that agree; else the position is lost."""
    worst = max(wrong, key=lambda kind: (wrong[kind].figure / wrong[kind].limit, kind))
    reason, readings = words.contradicts(worst, wrong[worst]), wrong[worst].readings
    agree = [
        window
        for window in state.windows
        if window.kind not in wrong and window.kind not in state.silent and len(window) >= LENGTHS[0]
    ]
    if not agree or state.lost:
        return _searched(monitor, state, reason, readings, rng)
    strikes = sum(one.strikes + 1 for one in state.left_out if one.kind == worst)
    left = (*state.left_out, LeftOut(worst, reason, state.readings, strikes=strikes))
    return _restarted(monitor, replace(state, left_out=left), readings, 0.0, rng)


def _searched(monitor: Monitored, state: MonitorState, reason: str, readings: int, rng: Generator) -> MonitorState:
    """Declare the position lost, or this attempt to find it failed, and search in a wider area."""
    attempt = state.attempt + 1
    kinds, turn = recovery.suspects(state, attempt)
    left = recovery.left_out_anew(state, kinds, f"{' and '.join(kinds)} readings left out in the search")
    spread = recovery.spread_of(state, turn, monitor.most_spread_m)
    anchors = state.anchors if state.lost else recovery.before_trouble(state, readings)
    lost = replace(state, lost=state.lost or reason, attempt=attempt, left_out=left, fixed=False, anchors=anchors)
    return _restarted(monitor, lost, 0, spread, rng)


def _restarted(monitor: Monitored, state: MonitorState, readings: int, spread_m: float, rng: Generator) -> MonitorState:
    """The estimator started anew around the last good estimate from before the latest `readings`."""
    if readings:
        state = replace(state, anchors=recovery.before_trouble(state, readings))
    area = recovery.search_area(state, monitor.ins, spread_m)
    inner = monitor.estimator.excluding(state.inner, state.silent)
    inner = monitor.estimator.restarted(inner, area, rng)
    estimate = monitor.estimator.estimate(inner)
    sigma = float(np.sqrt(np.linalg.eigvalsh(area.cov_m2)[-1]))
    return replace(
        state,
        inner=inner,
        windows=tuple(window.cleared() for window in state.windows),
        since=0,
        mean_m=estimate.ins_error_m,
        sigma_m=sigma,
        spread_m=sigma,
        rivals=None,
        standing=None,
        tail=Tail(),
    )


def _sensors_that_hang(monitor: Monitored, state: MonitorState, rng: Generator) -> MonitorState:
    """Leave out sensors that repeat one value, start anew from before they did, and take them in when they live."""
    hangs = {window.kind: times for window in state.windows if (times := stuck(window))}
    alive = {one.kind for one in state.left_out if one.stuck and one.kind not in hangs and _moves(state, one.kind)}
    if alive:
        state = _readmitted(monitor, state, alive)
    new = {
        kind: times for kind, times in hangs.items() if kind not in {one.kind for one in state.left_out if one.stuck}
    }
    if not new:
        return state
    rest = tuple(one for one in state.left_out if one.kind not in new)
    left = (*rest, *(LeftOut(kind, words.repeats(kind, times), state.readings, True) for kind, times in new.items()))
    return _restarted(monitor, replace(state, left_out=left), max(new.values()), 0.0, rng)


def _moves(state: MonitorState, kind: str) -> bool:
    """Whether the latest value of a kind differs from the one before."""
    window = next(one for one in state.windows if one.kind == kind)
    return len(window) >= 2 and window.rows[-1, -1] != window.rows[-2, -1]


def _readmitted(monitor: Monitored, state: MonitorState, kinds: set[str]) -> MonitorState:
    """These kinds count again."""
    left = tuple(one for one in state.left_out if one.kind not in kinds)
    windows = tuple(window.cleared() if window.kind in kinds else window for window in state.windows)
    inner = monitor.estimator.excluding(state.inner, frozenset(one.kind for one in left))
    return replace(state, left_out=left, windows=windows, inner=inner)


def _taken_in(monitor: Monitored, state: MonitorState) -> MonitorState:
    """A kind that agrees again for long, while the others hold the position, counts again."""
    if state.lost or not state.left_out or state.standing is None or state.standing.reach_m > 0.0:
        return state
    agree = {
        one.kind
        for one in state.left_out
        if not one.stuck
        and state.readings - one.since >= recovery.patience(one, LONGEST)
        and any(_agrees(monitor, window) for window in state.windows if window.kind == one.kind)
    }
    return _readmitted(monitor, state, agree) if agree else state


def _agrees(monitor: Monitored, window: Window) -> bool:
    """Whether the readings follow the map again: the scatter of the residuals about their mean is that of the noise."""
    if len(window) < LONGEST:
        return False
    chart = next(chart for chart in monitor.maps if chart.kind == window.kind)
    noise = float(window.rows[:, 2].mean()) + chart.sigma**2
    scatter = float(np.var(window.rows[:, RESIDUAL], ddof=1)) / noise
    return scatter < nis_limit(len(window), AGREES) and contradiction(window.nis, monitor.false_alarm) is None

"""What is done about findings: leave a kind out, take it in again, raise a sigma, search anew."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.random import Generator

from terranav.core.earth import shift
from terranav.core.frozen import changed
from terranav.core.judgement import largest_sigma_m
from terranav.core.records import Prior
from terranav.integrity import judging, recovery, rivals, words
from terranav.integrity.protection import Tail
from terranav.integrity.state import FloatArray, LeftOut, MonitorState
from terranav.integrity.windows import (
    LENGTHS,
    LONGEST,
    NOISE,
    RESIDUAL,
    VALUE,
    Finding,
    Window,
    excess,
    nis_limit,
    noise_factor,
    stuck,
)

if TYPE_CHECKING:
    from terranav.integrity.monitored import Monitored

RIVAL_WINS = 6.0  # log likelihood ratio of a rival at which the estimate is given up
RANK_EARLY, RANK = 0.05, 0.005  # share of rivals that fit better: the place is wrong; after 20 readings
BLIND = 20  # readings of which the map says nothing, after which a search has left the map
CALM = ((LENGTHS[1], 0.3), (LONGEST, 0.6))  # readings, mean NIS below which a raised sigma is lowered
EDGE, SLIVER = 20, 0.001  # readings after which a search beyond the map is cut, if more than this share lies there
DOUBT_WITHIN = 2.0  # times the covariance of what lies within
LARGEST_FACTOR = 30.0
DOUBT = 1e-3  # probability that residuals as told are called doubtful
AGREES = 1e-3  # probability that a kind that agrees again fails its test


def mended(monitor: Monitored, state: MonitorState, rng: Generator) -> MonitorState:
    """The state after what this epoch's readings call for."""
    if state.lost and state.off_map >= BLIND:
        return changed(_searched(monitor, state, state.lost, 0, rng), off_map=1)
    searching = state.lost and state.off_map == 0 and state.innovations
    if searching and state.since >= EDGE and state.since % EDGE == 0:
        state = _within_the_map(monitor, state, rng)
    if not any(one.known > 0.5 for one in state.innovations):
        return state
    state = _sensors_that_hang(monitor, state, rng)
    bad = {window.kind: window.bad for window in state.windows if window.bad and window.kind not in state.silent}
    if bool(bad) != (state.doubted >= 0):
        state = changed(state, doubted=state.readings if bad else -1)
    verdicts = {kind: _judged(monitor, state, kind, found) for kind, found in bad.items()}
    wrong = {kind: bad[kind] for kind, found in verdicts.items() if found == "wrong"}
    state = _factors(monitor, state, {kind for kind, found in verdicts.items() if found == "noisy"})
    if wrong:
        return _contradicted(monitor, state, wrong, rng)
    standing = state.standing
    if standing is not None and standing.best > RIVAL_WINS and _doubtful(state):
        return _searched(monitor, state, words.elsewhere(-standing.best_m, standing.share), LENGTHS[1], rng)
    return _taken_in(monitor, state)


def _within_the_map(monitor: Monitored, state: MonitorState, rng: Generator) -> MonitorState:
    """A search whose area reaches beyond the map, where no reading can refute it, goes on with what lies within."""
    known = min(one.known for one in state.innovations)
    if not 0.5 < known < 1.0 - SLIVER or state.epoch is None:
        return state
    cloud = monitor.estimator.posterior(state.inner)
    lat, lon = shift(state.epoch.lat_deg, state.epoch.lon_deg, -cloud.north_m, -cloud.east_m)
    inside = np.all([chart.covers(lat, lon) for chart in monitor.maps], axis=0)
    weight = np.where(inside, cloud.weight, 0.0)
    if weight.sum() <= 0.0:
        return state
    at = np.stack([cloud.north_m, cloud.east_m])
    mean = at @ weight / weight.sum()
    cov = np.cov(at, aweights=weight, bias=True) + 1.0 * np.eye(2)
    return _anew(monitor, state, Prior(mean, DOUBT_WITHIN * cov), rng)


def _judged(monitor: Monitored, state: MonitorState, kind: str, found: Finding) -> Literal["wrong", "noisy", "open"]:
    """Whether readings that contradict the map come from another place, or are only noisier than told.

    Noise spares no place; from another place, the readings fit the estimate no better than most of its rivals.
    """
    if state.rivals is None:
        return "wrong"
    window = next(one for one in state.windows if one.kind == kind)
    chart = next(one for one in monitor.maps if one.kind == kind)
    age = state.readings - state.doubted
    if age < LENGTHS[1]:
        return "wrong" if rivals.rank(state.rivals, window, chart, found.readings) > RANK_EARLY else "open"
    readings = max(LENGTHS[1], min(age, len(window)))
    return "wrong" if rivals.rank(state.rivals, window, chart, readings) > RANK else "noisy"


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
        if window.kind in noisy or (full and _scatters(monitor, state, window)):
            factors[window.kind] = min(factor * max(noise_factor(nis, LONGEST), 1.1), LARGEST_FACTOR)
            window = window.cleared()
        elif factor > 1.0 and _calm(nis):
            factors[window.kind] = max(factor * float(np.sqrt(nis.mean())), 1.0)
            window = window.cleared()
        windows.append(window)
    if all(new is old for new, old in zip(windows, state.windows, strict=True)):
        return state
    kept = tuple(sorted((kind, factor) for kind, factor in factors.items() if factor > 1.0))
    return changed(state, windows=tuple(windows), factors=kept)


def _calm(nis: FloatArray) -> bool:
    """Whether readings scatter so little that their sigma was raised too far."""
    return any(len(nis) >= length and float(nis[-length:].mean()) < limit for length, limit in CALM)


def _scatters(monitor: Monitored, state: MonitorState, window: Window) -> bool:
    """Whether a full window is a little too noisy all along, not of late only, about the right place, and white."""
    if window.loud is None or window.alike is not None or excess(window.nis[: -LENGTHS[1]], DOUBT) is None:
        return False
    chart = next(one for one in monitor.maps if one.kind == window.kind)
    return state.rivals is not None and rivals.rank(state.rivals, window, chart, len(window)) <= RANK


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
    return _restarted(monitor, changed(state, left_out=left), readings, 0.0, rng)


def _searched(monitor: Monitored, state: MonitorState, reason: str, readings: int, rng: Generator) -> MonitorState:
    """Declare the position lost, or this attempt to find it failed, and search in a wider area."""
    attempt = state.attempt + 1
    kinds, turn = recovery.suspects(state, attempt)
    left = recovery.left_out_anew(state, kinds, f"{' and '.join(kinds)} readings left out in the search")
    jumped = 1 if state.anchors else 0  # a proven fix is not lost by a little
    spread = recovery.spread_of(state, turn + jumped, monitor.most_spread_m)
    anchors = state.anchors if state.lost else recovery.before_trouble(state, readings)
    factor = 1.0 if state.anchors else recovery.noise_of(turn)  # sigmas that were good for a fix are good
    factors = tuple((window.kind, factor) for window in state.windows if window.seen) if factor > 1.0 else ()
    lost = changed(
        state, lost=state.lost or reason, attempt=attempt, left_out=left, fixed=False, anchors=anchors, factors=factors
    )
    return _restarted(monitor, lost, 0, spread, rng)


def _restarted(monitor: Monitored, state: MonitorState, readings: int, spread_m: float, rng: Generator) -> MonitorState:
    """The estimator started anew around the last good estimate from before the latest `readings`."""
    if readings:
        state = changed(state, anchors=recovery.before_trouble(state, readings))
    return _anew(monitor, state, recovery.search_area(state, monitor.ins, spread_m), rng)


def _anew(monitor: Monitored, state: MonitorState, area: Prior, rng: Generator) -> MonitorState:
    """The estimator started anew in an area, and nothing seen yet."""
    assert state.epoch is not None
    if state.lost:  # what was learned of the noise was learned in the wrong place
        silence = changed(state.epoch, measurements=())
        inner = monitor.estimator.step(monitor.estimator.init(area, rng), silence, rng)
        inner = monitor.estimator.excluding(inner, state.silent)
    else:
        inner = monitor.estimator.restarted(monitor.estimator.excluding(state.inner, state.silent), area, rng)
    sigma = largest_sigma_m(area.cov_m2)
    return changed(
        state,
        inner=inner,
        windows=tuple(window.cleared() for window in state.windows),
        since=0,
        doubted=-1,
        mean_m=monitor.estimator.estimate(inner).ins_error_m,
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
    return _restarted(monitor, changed(state, left_out=left), max(new.values()), 0.0, rng)


def _moves(state: MonitorState, kind: str) -> bool:
    """Whether the latest value of a kind differs from the one before."""
    window = next(one for one in state.windows if one.kind == kind)
    return len(window) >= 2 and window.rows[-1, VALUE] != window.rows[-2, VALUE]


def _readmitted(monitor: Monitored, state: MonitorState, kinds: set[str]) -> MonitorState:
    """These kinds count again."""
    left = tuple(one for one in state.left_out if one.kind not in kinds)
    windows = tuple(window.cleared() if window.kind in kinds else window for window in state.windows)
    inner = monitor.estimator.excluding(state.inner, frozenset(one.kind for one in left))
    return changed(state, left_out=left, windows=windows, inner=inner)


def named(state: MonitorState, one: LeftOut) -> LeftOut:
    """A kind without which the position was found, and why it stays out."""
    window = next(window for window in state.windows if window.kind == one.kind)
    reason = words.contradicts(one.kind, window.bad) if window.bad else f"{one.kind} readings did not fit the others"
    return changed(one, reason=reason, trial=False)


def _taken_in(monitor: Monitored, state: MonitorState) -> MonitorState:
    """A kind that agrees again for long, while the others hold the position, counts again."""
    if state.lost or not state.left_out or not judging.proven(monitor, state):
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
    noise = float(window.rows[:, NOISE].mean()) + chart.sigma**2
    scatter = float(np.var(window.rows[:, RESIDUAL], ddof=1)) / noise
    return scatter < nis_limit(len(window), AGREES) and window.bad is None

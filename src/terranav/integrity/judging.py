"""From what was found to what is said: status, protection level, usable or withheld, and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from terranav.core.judgement import HYSTERESIS
from terranav.core.records import Status
from terranav.integrity import recovery, words
from terranav.integrity.protection import FAR, protection_level
from terranav.integrity.state import Anchor, MonitorState, Verdict
from terranav.integrity.windows import LENGTHS, contradiction, nis_limit
from terranav.kernels import integrity as kernels

if TYPE_CHECKING:
    from terranav.integrity.monitored import Monitored

SHARE = 0.5  # of the risk is for the posterior
TOLD, FAR_OFF = 1.5, 2.5  # sigmas that look so many times too small are said; and degrade the fix
ALARM, ALARM_LENGTHS = 1e-4, (1, 3, 5)  # probability, readings: withholds a fix until the next agrees; degrades it
LOCAL = 3.0  # rivals within so many protection levels of the posterior widen it; farther ones withhold the fix
LOCAL_SHARE = 0.25  # ... and within this share of the area where rivals are looked for
UNEASY = 3.0  # mean NIS of three readings
CLIP = 16.0


def proven(monitor: Monitored, state: MonitorState) -> bool:
    """Whether the fix has served its probation and has no rival left but in its surroundings."""
    standing = state.standing
    return standing is not None and standing.readings >= monitor.probation and _local(monitor, state)


def _local(monitor: Monitored, state: MonitorState) -> bool:
    """Whether the rivals that are left are so near that a protection level that holds them, too, says it all."""
    assert state.standing is not None
    reach = LOCAL * protection(monitor, state)
    if state.rivals is not None:
        reach = min(reach, LOCAL_SHARE * state.rivals.reach_m)
    return state.standing.reach_m <= reach


def protection(monitor: Monitored, state: MonitorState) -> float:
    """Protection level from the posterior alone, widened by what the residuals say of it [m]."""
    return protection_level(state.sigma_m, state.tail, SHARE * monitor.risk, _scale(monitor, state))


def verdict(monitor: Monitored, state: MonitorState) -> Verdict:
    """Judge the state."""
    mean = _mean_nis(state)
    if state.off_map:
        reasons = ("the map says nothing where the readings were taken", *([state.lost] if state.lost else []))
        return Verdict(Status.OFF_MAP, mean, math.inf if state.lost else protection(monitor, state), False, reasons)
    if state.lost:
        search = f"searching within {words.metres(state.spread_m)} (1 sigma), attempt {state.attempt}"
        return Verdict(Status.LOST, mean, math.inf, False, (state.lost, search, *_left_out(state)))
    level = protection(monitor, state)
    unproven, poor, notes = _unproven(monitor, state), complaints(monitor, state), _notes(state)
    if state.standing is not None and state.standing.reach_m > level:
        level = state.standing.reach_m
    if not state.fixed:
        return Verdict(Status.SEARCHING, mean, level, False, (*unproven, *poor, *notes))
    if unproven or poor:
        return Verdict(Status.DEGRADED, mean, level, False, (*unproven, *poor, *notes))
    withheld: list[str] = []
    if monitor.alert_limit_m is not None and level > monitor.alert_limit_m:
        limit = words.metres(monitor.alert_limit_m)
        withheld = [f"protection level {words.metres(level)} beyond the alert limit of {limit}"]
    withheld += _alarms(state, ALARM_LENGTHS[:1])
    return Verdict(Status.CONVERGED, mean, level, not withheld, (*withheld, *notes))


def anchors(monitor: Monitored, state: MonitorState) -> tuple[Anchor, ...]:
    """The anchors, and the present estimate where it is proven and nothing speaks against it."""
    if state.lost or not state.innovations or not state.fixed or not proven(monitor, state):
        return state.anchors
    if not recovery.due(state) or any(
        contradiction(window.nis, 1e-4) for window in state.windows if window.kind not in state.silent
    ):
        return state.anchors
    return recovery.anchored(state, monitor.estimator.estimate(state.inner).cov_m2)


def _unproven(monitor: Monitored, state: MonitorState) -> tuple[str, ...]:
    """Why there is no proven fix, if there is none."""
    standing, limit = state.standing, HYSTERESIS * monitor.converged_sigma_m
    if standing is None or state.sigma_m > limit:
        wanted = monitor.converged_sigma_m
        after = f" after {words.lasting(state.silence_s)} without a reading" if state.silence_s else ""
        return (f"not converged: sigma {words.metres(state.sigma_m)} (limit {words.metres(wanted)}){after}",)
    if standing.readings < monitor.probation:
        return (f"on probation: {standing.readings} of {monitor.probation} readings since the fix",)
    if not _local(monitor, state):
        return (words.elsewhere(-standing.best_m, standing.share),)
    return ()


def complaints(monitor: Monitored, state: MonitorState) -> tuple[str, ...]:
    """What speaks against a fix that is proven."""
    found = []
    for window in state.windows:
        if window.kind in state.silent or not window.seen:
            continue
        if finding := window.bad or window.loud:
            found.append(words.contradicts(window.kind, finding))
        if window.alike:
            found.append(words.alike(window.kind, window.alike))
        if (factor := state.factor(window.kind) * window.scale) >= FAR_OFF:
            found.append(words.noisy(window.kind, factor))
    found += _alarms(state, ALARM_LENGTHS[1:])
    if state.tail.far > FAR:
        found.append(
            f"{100.0 * state.tail.far:.2g} % of the posterior lies apart, up to {words.metres(state.tail.reach_m)}"
        )
    assert state.epoch is not None
    silence = state.epoch.time_s - state.last_s
    if silence > monitor.outage_s:
        found.append(f"no reading that the map answers for {words.lasting(silence)}")
    seen = [window.kind for window in state.windows if window.seen]
    if seen and state.silent.issuperset(seen):
        found.append("no reading is left to hold the position")
    return tuple(found)


def uneasy(state: MonitorState) -> bool:
    """Whether the latest readings fit badly enough to look closer."""
    return any(window.loud or window.mean_nis(3) > UNEASY for window in state.windows)


def _alarms(state: MonitorState, lengths: Sequence[int]) -> list[str]:
    """Kinds whose very latest readings are so far off that the fix waits for the next."""
    found = []
    for window in state.windows:
        if window.kind in state.silent:
            continue
        for length in lengths:
            mean = window.mean_nis(length)
            if len(window) >= length and mean > nis_limit(length, ALARM):
                last = "reading is" if length == 1 else f"{length} readings are"
                found.append(f"the latest {window.kind} {last} {math.sqrt(mean):.1f} sigma off")
                break
    return found


def _notes(state: MonitorState) -> tuple[str, ...]:
    """What the user should know although the fix stands: sigmas that look too small, and kinds that move nothing."""
    scales = [(window.kind, state.factor(window.kind) * window.scale) for window in state.windows if window.seen]
    noisy = tuple(words.noisy(kind, scale) for kind, scale in scales if TOLD <= scale < FAR_OFF)
    return (*noisy, *_left_out(state))


def _left_out(state: MonitorState) -> tuple[str, ...]:
    """Kinds that move nothing, and why: by their latest readings where these contradict the map, too."""
    windows = {window.kind: window for window in state.windows}
    return tuple(
        f"{one.kind} left out: {words.contradicts(one.kind, found) if found and not one.stuck else one.reason}"
        for one in state.left_out
        for found in [windows[one.kind].bad or windows[one.kind].loud]
    )


def _mean_nis(state: MonitorState) -> float:
    """Mean NIS of the latest readings of all kinds that count."""
    total, count, silent = 0.0, 0, state.silent
    for window in state.windows:
        readings = min(len(window), LENGTHS[1])
        if readings and window.kind not in silent:
            total += readings * window.mean_nis(readings)
            count += readings
    return total / count if count else math.nan


def _scale(monitor: Monitored, state: MonitorState) -> float:
    """How many times larger the error may be than the covariance says: by NIS and correlation of the residuals."""
    scale2, silent = 1.0, state.silent
    for window in state.windows:
        if window.kind in silent or len(window) < LENGTHS[1]:
            continue
        mean = kernels.clipped_mean(window.nis, CLIP)
        rho = min(window.alike.figure, 0.9) if window.alike is not None else 0.0
        scale2 = max(scale2, mean * (1.0 + rho) / (1.0 - rho))
    return math.sqrt(scale2)

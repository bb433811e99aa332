"""Where to search when the position is lost, and which maps to trust meanwhile."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import largest_sigma_m
from terranav.core.records import Prior
from terranav.integrity.state import Anchor, FloatArray, LeftOut, MonitorState

EVERY = 10  # readings between two anchors
KEPT = 8  # of them
MARGIN = 4  # readings before the trouble showed that are not trusted either
GROWTH = 3.0  # of the search from one failed attempt to the next
NOISE = (1.0, 3.0, 1.0, 10.0)
DOUBT = 4.0  # times the covariance of an anchor


def due(state: MonitorState) -> bool:
    """Whether the latest anchor is old enough for another."""
    return not state.anchors or state.readings - state.anchors[-1].readings >= EVERY


def anchored(state: MonitorState, cov_m2: FloatArray) -> tuple[Anchor, ...]:
    """The anchors with the present estimate among them."""
    assert state.epoch is not None
    return (*state.anchors[1 - KEPT :], Anchor(state.readings, state.epoch.time_s, state.mean_m, cov_m2))


def before_trouble(state: MonitorState, readings: int) -> tuple[Anchor, ...]:
    """The anchors from before the latest readings that are in doubt."""
    return tuple(one for one in state.anchors if one.readings <= state.readings - readings - MARGIN)


def search_area(state: MonitorState, ins: InsGrade, spread_m: float) -> Prior:
    """The INS error now: the last good one, what the INS may have drifted since, and a spread on top.

    The drift is that of `InsGrade.velocity_sigma_at_mps` held over the whole time, and the position walk.
    """
    assert state.epoch is not None
    start = Anchor(0, state.start_s, state.prior.mean_m, state.prior.cov_m2)
    anchor = state.anchors[-1] if state.anchors else start
    now = state.epoch.time_s
    passed = max(now - anchor.time_s, 0.0)
    drift = ins.velocity_sigma_at_mps(max(now - state.start_s, 0.0)) * passed
    grown = drift**2 + ins.position_walk_m_per_sqrt_s**2 * passed + spread_m**2 + 1.0
    return Prior(anchor.mean_m, DOUBT * anchor.cov_m2 + grown * np.eye(2))


def spread_of(state: MonitorState, turn: int, most_m: float) -> float:
    """Spread of a search that has failed `turn` times: the start's sigma, three times as much each time [m]."""
    first = largest_sigma_m(state.prior.cov_m2)
    return min(first * GROWTH ** min(turn, 30), max(most_m, first))


def noise_of(turn: int) -> float:
    """How many times larger the noise is taken than told in a search that has failed so often.

    Sigmas that are far too small look like a wrong place: any place is soon contradicted.
    """
    return NOISE[turn % len(NOISE)]


def suspects(state: MonitorState, attempt: int) -> tuple[tuple[str, ...], int]:
    """Which kind to leave out in an attempt (counted from one), and how many rounds have failed.

    With several maps a round tries all of them, then each one left out.
    """
    stuck = {one.kind for one in state.left_out if one.stuck}
    names = sorted(window.kind for window in state.windows if window.seen and window.kind not in stuck)
    if len(names) < 2:
        return (), attempt - 1
    options: list[tuple[str, ...]] = [(), *((name,) for name in names)]
    return options[(attempt - 1) % len(options)], (attempt - 1) // len(options)


def left_out_anew(state: MonitorState, kinds: Sequence[str], reason: str) -> tuple[LeftOut, ...]:
    """These kinds left out instead of those that were; sensors that hang stay out."""
    strikes = {one.kind: one.strikes + 1 for one in state.left_out}
    stuck = tuple(one for one in state.left_out if one.stuck)
    return (
        *stuck,
        *(LeftOut(kind, reason, state.readings, strikes=strikes.get(kind, 0), trial=True) for kind in kinds),
    )


def patience(one: LeftOut, readings: int) -> int:
    """For how many readings a kind has to agree until it is used again: doubled each time it was left out."""
    return readings * (1 << min(one.strikes, 8))

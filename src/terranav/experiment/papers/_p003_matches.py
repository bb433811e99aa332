"""The matches of one run of papers/003, and what each judge makes of them.

The search around the INS trace does not depend on the judge, so a run is optimised once and every judge decides on the
same optimisations: the runs are paired. With the search around the corrected trace each judge has a run of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree, offset_m
from terranav.core.records import Prior
from terranav.experiment.papers._p003_world import DEGREE_M, ERROR_DEG, INS, SPEED_MPS, STEP_S, Land, flight, track
from terranav.experiment.stream import states
from terranav.matchers._judges import Memory, decide
from terranav.matchers.iccp import Iccp

FloatArray = NDArray[np.float64]

MATCHES = 31  # of which 28 are counted, from the fourth on: 50 runs make the 1400 of Table 3
E_INS_DEG = 0.0001  # a step, by the paper
AGREE_M = ERROR_DEG * DEGREE_M  # 0.003 degrees, the paper's acceptable threshold


@dataclass(frozen=True)
class Case:
    """One reading of the paper's conditions.

    Attributes
    ----------
    name : str
    window, starts : int
        W and Q.
    closed : bool
        Whether the search is around the corrected trace.
    drawn : bool
        Whether the initial error is drawn.
    """

    name: str
    window: int = 3
    starts: int = 20
    closed: bool = False
    drawn: bool = False


@dataclass(frozen=True)
class Rule:
    """A judge, sigma of eq. 7 [deg], and whether the INS stands where M/N refuses (or else the last accepted match)."""

    name: str
    judge: str
    sigma_deg: float = ERROR_DEG
    ins_stands: bool = False


RULES = (Rule("none", "none"), Rule("M/N", "m_of_n"), Rule("PDAF", "pdaf"))
#: which of RULES each stands in for
OTHER_RULES = (
    (1, Rule("M/N: the INS stands where it refuses", "m_of_n", ins_stands=True)),
    (2, Rule("PDAF with sigma 0.001 degrees", "pdaf", sigma_deg=0.001)),
    (2, Rule("PDAF with sigma 0.0005 degrees", "pdaf", sigma_deg=0.0005)),
)


def estimator(land: Land, case: Case, judge: str) -> Iccp:
    """ICCP as in the paper's section 5: W = 3, E_min = 0.002 degrees, T_max = 60, K = 1, Q = 20, N = 3, M = 2."""
    return Iccp(
        (land.chart,),
        INS,
        window=case.window,
        every=1,
        starts=case.starts,
        iterations=60,
        e_min_m=0.002 / 3.0 * case.window * DEGREE_M,
        weight=1.0,
        per_step=True,
        step_sigma=E_INS_DEG * DEGREE_M / (SPEED_MPS * STEP_S),
        judge=judge,  # type: ignore[arg-type]
        m=2,
        n=3,
        agree_m=AGREE_M,
        pdaf_sigma_m=ERROR_DEG * DEGREE_M,
        search_sigma_m=ERROR_DEG * DEGREE_M,
        feedback=case.closed,
        fuse=False,
    )


def fly(land: Land, case: Case, seed: SeedSequence) -> dict[str, tuple[FloatArray, FloatArray]]:
    """One run: per rule the error of each match [deg] and whether it was accepted, both (31,)."""
    way = track(land, MATCHES + case.window - 1)
    world, search = (np.random.SeedSequence(entropy=seed.entropy, spawn_key=(*seed.spawn_key, i)) for i in range(2))
    run = flight(way, np.random.default_rng(world), drawn=case.drawn)
    at = run.true_deg[case.window - 1 :]
    indicated = np.array([(epoch.lat_deg, epoch.lon_deg) for epoch in run.epochs[case.window - 1 :]])
    true_m = np.stack(offset_m(*at.T, *indicated.T), axis=1)
    per_degree = np.stack(metres_per_degree(at[:, 0]), axis=1)

    def states_of(judge: str) -> list[Any]:
        steps = states(estimator(land, case, judge), Prior.from_ins(INS), run.epochs, np.random.default_rng(search))
        return list(steps)[case.window - 1 :]

    outcome = {}
    if case.closed:
        for rule in RULES:
            after = states_of(rule.judge)
            place = np.array([state.mean_m for state in after])
            accepted = np.array([state.latest is not None and state.latest.decision.accepted for state in after])
            outcome[rule.name] = place, accepted
    else:
        latest = [state.latest for state in states_of("none")]
        outcome = {rule.name: judged(latest, rule) for rule in (*RULES, *(rule for _, rule in OTHER_RULES))}
    return {
        name: (np.hypot(*((place - true_m) / per_degree).T), accepted) for name, (place, accepted) in outcome.items()
    }


def judged(matches: list[Any], rule: Rule) -> tuple[FloatArray, NDArray[np.bool_]]:
    """INS errors (n, 2) [m] by a rule and what it accepts (n,), from n matches; None is one that found nothing."""
    memory, place = Memory.empty(), np.zeros(2)
    places, accepted = np.zeros((len(matches), 2)), np.zeros(len(matches), dtype=bool)
    for i, match in enumerate(matches):
        if match is not None:
            limits = (2, 3, AGREE_M, rule.sigma_deg * DEGREE_M)
            decision, memory = decide(rule.judge, match.found.places_m, match.found.target_m, memory, limits)
            accepted[i] = decision.accepted
            if decision.accepted:
                place = match.found.places_m[decision.chosen]
        places[i] = 0.0 if rule.ins_stands and not accepted[i] else place
    return places, accepted

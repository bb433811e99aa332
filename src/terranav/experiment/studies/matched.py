"""Runs over informative tracks in a world that is as the navigator is told: what `bound` and `consistency` sum up.

The navigator has its defaults but for TOLD: the map lies where it says, and that is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from terranav.core.errors import StateError
from terranav.core.records import Status
from terranav.experiment.metrics import consistency
from terranav.experiment.registry import make_estimator
from terranav.experiment.result import Result
from terranav.experiment.run import run
from terranav.experiment.studies.ensemble import losses
from terranav.experiment.studies.sources import data_folder, terrain_sources
from terranav.experiment.studies.study import CaseRuns, Plan, Setup
from terranav.experiment.studies.tracks import (
    CANDIDATES,
    INS,
    LEAST_SLOPE,
    MATCHED,
    Track,
    drawn_tracks,
    settled_index,
    track_bound,
)
from terranav.experiment.studies.world import flown

FloatArray = NDArray[np.float64]

TRACKS = 6  # on each map
ESTIMATOR = "marginalized"
TOLD = {"registration_cells": 0.0}
TESTED = 5  # epochs at which the NEES is tested: evenly spread, the last is the last


@dataclass(frozen=True)
class MatchedCase:
    """A track and the settings of the estimator that flies it."""

    track: Track
    settings: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """The track's."""
        return self.track.name

    @property
    def map_name(self) -> str:
        """The map's."""
        return self.track.source.name

    def facts(self) -> Mapping[str, Any]:
        """What its figures depend on."""
        return {**self.track.facts(), "settings": dict(self.settings), "ins": repr(INS)}


def plan(setup: Setup) -> Plan:
    """Draw the tracks of every terrain map at hand.

    Raises
    ------
    ConfigError
        A setting that the estimator does not have, or a map that is not there.
    """
    settings = {**TOLD, **setup.settings}
    tracks, notes = informative_tracks(setup, TRACKS)
    if tracks:
        make_estimator(ESTIMATOR, (tracks[0].chart,), INS, **settings)
    return Plan([MatchedCase(track, tuple(sorted(settings.items()))) for track in tracks], notes)


def informative_tracks(setup: Setup, count: int) -> tuple[list[Track], list[str]]:
    """Tracks of all maps, so many on each, and what to say about it."""
    data = data_folder(setup.data)
    tracks: list[Track] = []
    notes = []
    wanted = count if setup.tracks is None else setup.tracks
    for source in terrain_sources(data, setup.maps):
        drawn = drawn_tracks(source, wanted, setup.seed)
        tracks += drawn.tracks
        if len(drawn.tracks) < wanted:
            notes.append(
                f"{source.name}: {len(drawn.tracks)} of {wanted} tracks, no more among {CANDIDATES} candidates are "
                f"whole, of an rms slope >= {LEAST_SLOPE:g} and informative by the bound"
            )
    if data is None and not setup.maps:
        notes.append(
            "only the sample DEM is at hand: name a folder of terrain maps (--data DIR, or TERRANAV_SHARED) or maps "
            "(--map FILE)"
        )
    return tracks, notes


def run_case(case: MatchedCase, seeds: SeedSequence) -> dict[str, float]:
    """One flight in the matched world.

    The epochs that count are those after convergence: from where the bound is low (`tracks.settled_index`) and the
    navigator has first called itself converged; whatever it says later, they count.

    Returns
    -------
    dict
        fixed: whether there are such epochs; if so, mse_m2, bound_m2: mean over them of the squared distance from the
        truth, and of the bound's trace. nees_0 ..: NEES (2 degrees of freedom) at the tested epochs. contained_95,
        max_m: over the epochs that count. lost, unsaid: as of `ensemble.losses`.
    """
    world, estimator = seeds.spawn(2)
    rec = flown(case.track, MATCHED, np.random.default_rng(world)).rec
    seed = int(estimator.generate_state(1)[0])
    result = run(ESTIMATOR, rec, [case.track.chart], seed=seed, **dict(case.settings))
    lowest = track_bound(case.track)
    first = settled_index(lowest)
    if first is None:
        raise StateError(f"{case.name}: the bound does not come down")
    converged = np.flatnonzero(result.status == Status.CONVERGED.value)
    said = losses(result, first)
    if not converged.size:
        return {"fixed": 0.0, **said}
    begin = max(first, int(converged[0]))
    return {"fixed": 1.0, "bound_m2": float(np.mean(lowest.drms_m[begin:] ** 2)), **figures(result, begin), **said}


def after_convergence(case: CaseRuns, *names: str) -> FloatArray:
    """(runs, names) figures of the runs that converged."""
    return np.asarray(np.stack([case[name] for name in names], axis=1)[case["fixed"] == 1.0])


def figures(result: Result, first: int) -> dict[str, float]:
    """Figures of a run from its epoch `first` on; see `run_case`."""
    error, cov = result.error_m[first:], result.cov_m2[first:]
    distance = np.hypot(*error.T)
    whole = consistency(error, cov)
    tested = np.linspace(0, len(error) - 1, TESTED).round().astype(int)
    nees = {f"nees_{i}": consistency(error[k : k + 1], cov[k : k + 1])["nees"] for i, k in enumerate(tested.tolist())}
    return {
        "mse_m2": float(np.mean(distance**2)), "max_m": float(distance.max()), "nees": whole["nees"],
        "contained_95": whole["contained_95"], **nees,
    }  # fmt: skip

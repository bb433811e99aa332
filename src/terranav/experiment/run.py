"""Run one estimator over one recording."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence

from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.protocols import Estimator, Matcher, ShowsPosterior
from terranav.core.recording import Recording
from terranav.core.records import Prior
from terranav.experiment.datums import DatumGuard
from terranav.experiment.inputs import Inputs, prepare
from terranav.experiment.provenance import provenance
from terranav.experiment.registry import check_name, estimator_name, make_estimator, own_maps
from terranav.experiment.result import Result
from terranav.experiment.stream import states
from terranav.io.geoid import Given
from terranav.maps.map import Map

#: is told how many epochs are done, and of how many
Progress = Callable[[int, int], None]


def run(
    estimator: str | Estimator[Any] | Matcher,
    rec: Recording,
    maps: Sequence[Map] | Map = (),
    *,
    seed: int = 0,
    ins: InsGrade | None = None,
    prior: Prior | None = None,
    geoid: Given = None,
    on_epoch: Progress | None = None,
    **settings: Any,
) -> Result:
    """Run one estimator over one recording.

    Parameters
    ----------
    estimator : str, Estimator or Matcher
        A name from `terranav.estimators()`, or an object. An Estimator object has its own maps and INS.
    rec : Recording
        Its truth, where it has one, never reaches the estimator.
    maps : sequence of Map, or one
        At least one, except for 'ins' and for objects, which bring their own.
    seed : int
        >= 0; the same seed gives the same bits, whatever else is run.
    ins : InsGrade, optional
        What the estimator is told of the INS; else the recording's own, else the default grade with a warning.
    prior : Prior, optional
        Of the INS error at the first epoch; else zero mean and the initial position sigma of the INS.
    geoid : path, Geoid, or several of them, optional
        Geoid grids beside those that are installed, for heights that count from other datums than the maps do.
    on_epoch : callable, optional
        Called with (epochs done, epochs in all) after each epoch.
    **settings
        Of the estimator and, for a matcher, of `Windowed`.

    Returns
    -------
    Result

    Raises
    ------
    DataError
        No map, no reading that a map can be compared with, or no map where the recording is.
    ConfigError
        Unknown estimator or setting, or an impossible value.

    Warns
    -----
    DataWarning
        The INS grade or a sigma is assumed, or the map covers a part of the track only.
    """
    check_seed(seed)
    check_name(estimator)
    charts, guard = own_maps(estimator) or maps, DatumGuard(geoid)
    inputs = prepare(rec, charts, ins, prior, needs_maps=needs_maps(estimator), guard=guard)
    check_length(estimator_name(estimator), settings, inputs)
    built = make_estimator(estimator, inputs.maps, inputs.ins, **settings)
    return fly(built, inputs, seed, on_epoch)


def check_length(name: str, settings: Mapping[str, Any], inputs: Inputs) -> None:
    """Raise ConfigError where a method was asked for more readings at once than the whole recording holds."""
    kinds = {chart.kind for chart in inputs.maps}
    count = sum(any(reading.kind in kinds for reading in epoch.measurements) for epoch in inputs.epochs)
    for key in ("window", "readings"):
        asked = settings.get(key)
        if isinstance(asked, int) and not isinstance(asked, bool) and asked > count:
            raise ConfigError(
                f"{name} {key} is {asked}, but {inputs.rec.name} holds {count} readings to compare; "
                "expected at most that many"
            )


def fly(estimator: Estimator[Any], inputs: Inputs, seed: int, on_epoch: Progress | None = None) -> Result:
    """Run an estimator over checked inputs; the parameters are those of `run`."""
    name, maps = estimator_name(estimator), own_maps(estimator) or inputs.maps
    estimates, state, began = [], None, time.perf_counter()
    for state in states(estimator, inputs.prior, inputs.epochs, rng_of(name, seed)):
        estimates.append(estimator.estimate(state))
        if on_epoch is not None:
            on_epoch(len(estimates), len(inputs.epochs))
    wall_s = time.perf_counter() - began
    return Result.from_estimates(
        name,
        estimates,
        inputs.rec,
        posterior=estimator.posterior(state) if isinstance(estimator, ShowsPosterior) else None,
        map_cell_m=min((chart.cell_m for chart in maps), default=float("nan")),
        provenance={**provenance(estimator, inputs, seed), "wall_s": wall_s},
    )


def rng_of(name: str, seed: int) -> Generator:
    """Return the random generator of a run: it depends on the seed and the method's name, not on what else is run."""
    return np.random.default_rng(SeedSequence([seed, zlib.crc32(name.encode())]))


def needs_maps(estimator: str | Estimator[Any] | Matcher) -> bool:
    """Whether a method compares readings with maps: all but the baseline do."""
    return estimator_name(estimator) != "ins"


def check_seed(seed: int) -> None:
    """Raise ConfigError unless `seed` is a whole number >= 0."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ConfigError(f"seed is {seed!r}, expected a whole number >= 0")

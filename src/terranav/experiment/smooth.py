"""Smooth one recording: every epoch in the light of all readings, for those who process a whole run afterwards."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.protocols import Estimator, Matcher
from terranav.core.recording import Recording
from terranav.core.records import Prior
from terranav.experiment.datums import DatumGuard
from terranav.experiment.inputs import prepare
from terranav.experiment.provenance import provenance
from terranav.experiment.registry import check_name, estimator_name, make_estimator, own_maps
from terranav.experiment.result import Result
from terranav.experiment.run import Progress, check_length, check_seed, rng_of
from terranav.filters._smoothing import SMOOTHED, can_be_smoothed, smooth_epochs
from terranav.io.geoid import Given
from terranav.maps.map import Map


def smooth(
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
    """Run an estimator forward and its fixed-interval smoother backward over one recording.

    The forward run is, bit for bit, that of `terranav.run`; the last epoch of the result is its last estimate.

    Parameters
    ----------
    estimator : str, Estimator or Matcher
        'marginalized' or 'pointmass', or an object of one of them.
    rec, maps, seed, ins, prior, geoid
        As for `terranav.run`.
    on_epoch : callable, optional
        Called with (epochs done, twice the number of epochs) after each epoch of either pass.
    **settings
        Of the estimator.

    Returns
    -------
    Result
        One estimate for every epoch, those without a reading too; its estimator is named such as 'pointmass smoothed'.

    Raises
    ------
    DataError
        As `terranav.run`.
    ConfigError
        As `terranav.run`, and for an estimator that cannot be smoothed.

    Warns
    -----
    DataWarning
        As `terranav.run`.
    """
    check_seed(seed)
    check_smoothed(estimator)
    inputs = prepare(rec, own_maps(estimator) or maps, ins, prior, needs_maps=True, guard=DatumGuard(geoid))
    check_length(estimator_name(estimator), settings, inputs)
    built: Any = make_estimator(estimator, inputs.maps, inputs.ins, **settings)
    name, charts, of = estimator_name(built), own_maps(built) or inputs.maps, 2 * len(inputs.epochs)
    began = time.perf_counter()
    both = smooth_epochs(
        built,
        inputs.prior,
        inputs.epochs,
        rng_of(name, seed),
        backward_rng=rng_of(smoothed_name(name), seed),
        on_epoch=lambda done: None if on_epoch is None else on_epoch(done, of),
    )
    return Result.from_estimates(
        smoothed_name(name),
        both.smoothed,
        inputs.rec,
        posterior=built.posterior(both.last),
        map_cell_m=min(chart.cell_m for chart in charts),
        provenance={**provenance(built, inputs, seed), "smoothed": True, "wall_s": time.perf_counter() - began},
    )


def smoothed_name(name: str) -> str:
    """What the smoothed result of an estimator is called."""
    return f"{name} smoothed"


def check_smoothed(estimator: str | Estimator[Any] | Matcher) -> None:
    """Raise ConfigError for an estimator that cannot be smoothed, or an unknown one."""
    check_name(estimator)
    known = estimator in SMOOTHED if isinstance(estimator, str) else can_be_smoothed(estimator)
    if not known:
        raise ConfigError(f"{estimator_name(estimator)!r} cannot be smoothed, expected {' or '.join(SMOOTHED)}")

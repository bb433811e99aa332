"""Run several estimators over the same epochs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.protocols import Estimator, Matcher
from terranav.core.recording import Recording
from terranav.core.records import Prior
from terranav.experiment.datums import DatumGuard
from terranav.experiment.inputs import prepare
from terranav.experiment.registry import check_name, estimator_name, make_estimator, own_maps
from terranav.experiment.result import Result
from terranav.experiment.run import check_length, check_seed, fly, needs_maps
from terranav.io.geoid import Given
from terranav.maps.map import Map

Method = str | Estimator[Any] | Matcher


def compare(
    estimators: Sequence[Method] | Mapping[str, Method | tuple[str, Mapping[str, Any]]],
    rec: Recording,
    maps: Sequence[Map] | Map = (),
    *,
    seed: int = 0,
    ins: InsGrade | None = None,
    prior: Prior | None = None,
    geoid: Given = None,
    on_epoch: Callable[[str, int, int], None] | None = None,
) -> dict[str, Result]:
    """Run several estimators over the same epochs with the same maps, INS and prior.

    Each result is, bit for bit, the one that `run` gives for that estimator alone.

    Parameters
    ----------
    estimators : sequence or mapping
        Names and objects; or a mapping of label to a name, an object, or a pair (name, settings).
    rec, maps, seed, ins, prior, geoid
        As for `run`.
    on_epoch : callable, optional
        Called with (label, epochs done, epochs in all) after each epoch.

    Returns
    -------
    dict of label to Result, in the order given
        The labels are the estimators' names unless a mapping gives others.

    Raises
    ------
    DataError, ConfigError
        As `run`, before any estimator has started; or no estimator, or one name twice.
    """
    check_seed(seed)
    methods = _labelled(estimators)
    for method, _ in methods.values():
        check_name(method)
    theirs = {id(chart): chart for method, _ in methods.values() for chart in own_maps(method)}
    needs = any(needs_maps(method) for method, _ in methods.values())
    inputs = prepare(rec, maps or tuple(theirs.values()), ins, prior, needs_maps=needs, guard=DatumGuard(geoid))
    for method, settings in methods.values():
        check_length(estimator_name(method), settings, inputs)
    built = {
        label: make_estimator(method, inputs.maps, inputs.ins, **settings)
        for label, (method, settings) in methods.items()
    }
    results: dict[str, Result] = {}
    for label, estimator in built.items():

        def progress(done: int, of: int, label: str = label) -> None:
            if on_epoch is not None:
                on_epoch(label, done, of)

        results[label] = fly(estimator, inputs, seed, progress)
    return results


def _labelled(
    estimators: Sequence[Method] | Mapping[str, Method | tuple[str, Mapping[str, Any]]],
) -> dict[str, tuple[Method, Mapping[str, Any]]]:
    """Label -> (method, settings)."""
    if isinstance(estimators, str):
        estimators = [estimators]
    if not estimators:
        raise ConfigError("estimators is empty, expected at least one name")
    if isinstance(estimators, Mapping):
        return {label: value if isinstance(value, tuple) else (value, {}) for label, value in estimators.items()}
    methods: dict[str, tuple[Method, Mapping[str, Any]]] = {}
    for method in estimators:
        label = estimator_name(method)
        if label in methods:
            raise ConfigError(f"estimator {label!r} is given twice, expected a mapping with a label for each")
        methods[label] = (method, {})
    return methods

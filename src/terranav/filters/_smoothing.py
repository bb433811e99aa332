"""Fixed-interval smoothing: the estimates of a whole recording in the light of all its readings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from numpy.random import Generator

from terranav.core.judgement import largest_sigma_m
from terranav.core.protocols import Estimator
from terranav.core.records import Epoch, Estimate, Prior, Status
from terranav.filters._replay import flown, method_of
from terranav.filters._smoothing_marginalized import smooth_marginalized
from terranav.filters._smoothing_pointmass import smooth_pointmass
from terranav.filters.marginalized import Marginalized
from terranav.filters.pointmass import PointMass

#: estimators that can be smoothed, by name
SMOOTHED: dict[str, type[Marginalized | PointMass]] = {"marginalized": Marginalized, "pointmass": PointMass}


@dataclass(frozen=True)
class Smoothed:
    """Both passes over n epochs: estimates of the filter and of the smoother, and the filter's last state."""

    filtered: list[Estimate]
    smoothed: list[Estimate]
    last: Any


def can_be_smoothed(estimator: Any) -> bool:
    """Whether an estimator, or the one that it watches, has a smoother."""
    return isinstance(method_of(estimator), tuple(SMOOTHED.values()))


def smooth_epochs(
    estimator: Estimator[Any],
    prior: Prior,
    epochs: Sequence[Epoch],
    rng: Generator,
    *,
    backward_rng: Generator,
    on_epoch: Callable[[int], None] = lambda done: None,
) -> Smoothed:
    """Run a filter forward and its smoother backward.

    Parameters
    ----------
    estimator : Estimator
        For which `can_be_smoothed`.
    prior : Prior
    epochs : sequence of Epoch, (n,), n >= 1
    rng : Generator
        Of the filter, which gives the same bits as alone.
    backward_rng : Generator
        Of the smoother.
    on_epoch : callable, optional
        Called with the number of epochs done, of 2 n.

    Returns
    -------
    Smoothed
        The status of a smoothed estimate is the filter's, except that epochs 'searching' before its first fix are
        'converged' where the smoothed sigma is within the limit of a fix. Protection level and usability are the
        business of a monitor that watched in flight, and do not carry over.
    """
    flight = flown(estimator, prior, epochs, rng, on_epoch)

    def later(done: int) -> None:
        on_epoch(len(epochs) + done)

    if isinstance(flight.method, Marginalized):
        found = smooth_marginalized(flight, backward_rng, later)
    else:
        found = smooth_pointmass(flight, later)
    limit_m = flight.method._judge.converged_sigma_m
    return Smoothed(flight.estimates, _judged(flight.estimates, found, limit_m), flight.last)


def _judged(filtered: list[Estimate], smoothed: list[Estimate], limit_m: float) -> list[Estimate]:
    """The smoothed estimates with their statuses, and nothing of what a monitor offered in flight."""
    fixes = [k for k, one in enumerate(filtered) if one.status is Status.CONVERGED]
    first_fix = fixes[0] if fixes else 0
    found = []
    for k, (before, after) in enumerate(zip(filtered, smoothed, strict=True)):
        known = k < first_fix and before.status is Status.SEARCHING and largest_sigma_m(after.cov_m2) <= limit_m
        status, reasons = (Status.CONVERGED, ()) if known else (before.status, before.reasons)
        found.append(
            replace(after, status=status, nis=before.nis, reasons=reasons, protection_m=math.nan, usable=False)
        )
    return found

"""The loop: every estimator, over simulated, recorded and live epochs alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

from numpy.random import Generator

from terranav.core.protocols import Estimator
from terranav.core.records import Epoch, Estimate, Prior

S = TypeVar("S")


def states(
    estimator: Estimator[S], prior: Prior, epochs: Iterable[Epoch], rng: Generator, *, resume: S | None = None
) -> Iterator[S]:
    """Yield the estimator's state after each epoch.

    Parameters
    ----------
    estimator : Estimator
    prior : Prior
        Of the INS position error at the first epoch.
    epochs : iterable of Epoch
        In the order of time; may be endless.
    rng : numpy.random.Generator
        The only source of randomness. A checkpoint is a pickled state plus this generator's state.
    resume : state, optional
        Go on from this state instead of `estimator.init(prior, rng)`.

    Yields
    ------
    state
        Frozen and picklable; `estimator.estimate(state)` reads it.
    """
    state = estimator.init(prior, rng) if resume is None else resume
    for epoch in epochs:
        state = estimator.step(state, epoch, rng)
        yield state


def stream(estimator: Estimator[S], prior: Prior, epochs: Iterable[Epoch], rng: Generator) -> Iterator[Estimate]:
    """Yield the estimate after each epoch; the parameters are those of `states`."""
    return map(estimator.estimate, states(estimator, prior, epochs, rng))

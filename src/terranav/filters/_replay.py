"""A run that can be walked backwards: every state of a long recording in the memory of a few."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from numpy.random import Generator

from terranav.core.protocols import Estimator
from terranav.core.records import Epoch, Estimate, Prior

S = TypeVar("S")


@dataclass(frozen=True)
class Flown(Generic[S]):
    """What is left of a forward run over n epochs.

    Attributes
    ----------
    estimator : Estimator
    epochs : sequence of Epoch, (n,)
    estimates : list of Estimate, (n,)
    last : state after the last epoch
    checkpoints : list of (state, Generator)
        Before every `stride`-th epoch; from there the states are made again, bit for bit.
    stride : int
    """

    estimator: Estimator[S]
    epochs: Sequence[Epoch]
    estimates: list[Estimate]
    last: S
    checkpoints: list[tuple[S, Generator]]
    stride: int

    @property
    def method(self) -> Any:
        """The estimator itself, or the one that it watches."""
        return method_of(self.estimator)

    def estimate(self, state: S, **moments: Any) -> Estimate:
        """What the estimator would say, had the method's state these moments."""
        inner = getattr(state, "inner", None)
        changed: Any = state
        changed = replace(changed, **moments) if inner is None else replace(changed, inner=replace(inner, **moments))
        return self.estimator.estimate(changed)

    def backwards(self) -> Iterator[tuple[int, S]]:
        """(index, state) of every epoch from the last to the first: about 2 sqrt(n) states at a time."""
        for part in reversed(range(len(self.checkpoints))):
            state, rng = self.checkpoints[part]
            rng, states = deepcopy(rng), []
            first = part * self.stride
            for epoch in self.epochs[first : first + self.stride]:
                state = self.estimator.step(state, epoch, rng)
                states.append(state)
            for k in reversed(range(len(states))):
                yield first + k, states.pop()


def method_of(estimator: Any) -> Any:
    """The estimator that an integrity monitor watches, or the estimator itself."""
    return getattr(estimator, "estimator", estimator)


def inner_of(state: Any) -> Any:
    """The state of the method, where a monitor's holds it."""
    return getattr(state, "inner", state)


def flown(
    estimator: Estimator[S],
    prior: Prior,
    epochs: Sequence[Epoch],
    rng: Generator,
    on_epoch: Callable[[int], None],
) -> Flown[S]:
    """Run an estimator over at least one epoch and keep what `Flown.backwards` needs.

    Parameters
    ----------
    estimator, prior, epochs, rng
        As for `terranav.stream`, and with the same bits.
    on_epoch : callable
        Called with the number of epochs done.
    """
    stride = math.ceil(math.sqrt(len(epochs)))
    state, estimates, checkpoints = estimator.init(prior, rng), [], []
    for k, epoch in enumerate(epochs):
        if k % stride == 0:
            checkpoints.append((state, deepcopy(rng)))
        state = estimator.step(state, epoch, rng)
        estimates.append(estimator.estimate(state))
        on_epoch(k + 1)
    return Flown(estimator, epochs, estimates, state, checkpoints, stride)

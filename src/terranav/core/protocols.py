"""The seams of the house. Every method is one of these two; one loop runs them all (experiment/stream.py)."""

from __future__ import annotations

from typing import Protocol, TypeVar, runtime_checkable

from numpy.random import Generator

from terranav.core.records import Candidates, Epoch, Estimate, Innovation, Posterior, Prior, Profile

S = TypeVar("S")
S_contra = TypeVar("S_contra", contravariant=True)


@runtime_checkable
class Estimator(Protocol[S]):
    """A recursive method: a frozen dataclass of settings with the fields `maps` and `ins` besides its own.

    States are frozen and picklable; `step` returns a new one and never writes into the arrays of the old.
    """

    def init(self, prior: Prior, rng: Generator) -> S:
        """State before the first epoch."""
        ...

    def step(self, state: S, epoch: Epoch, rng: Generator) -> S:
        """State after one more epoch: the time passes, then its measurements (if any) are used."""
        ...

    def estimate(self, state: S) -> Estimate:
        """What the state says at its last epoch; StateError before the first."""
        ...


@runtime_checkable
class ShowsPosterior(Protocol[S_contra]):
    """An estimator that can also draw what it believes."""

    def posterior(self, state: S_contra) -> Posterior | None:
        """Distribution of the INS error at the last epoch, None where there is nothing to draw."""
        ...


@runtime_checkable
class Watched(Estimator[S], Protocol[S]):
    """An estimator that an integrity monitor can watch, correct and start anew; it has a Posterior to show, too."""

    def innovations(self, state: S) -> tuple[Innovation, ...]:
        """Of the readings of the last epoch, in their order; empty where it had none that a map answers."""
        ...

    def restarted(self, state: S, prior: Prior, rng: Generator) -> S:
        """The state with everything forgotten but the clock and the excluded kinds; `prior` holds at its last epoch."""
        ...

    def excluding(self, state: S, kinds: frozenset[str]) -> S:
        """The state that compares readings of these kinds as before, but does not let them move the estimate."""
        ...

    def posterior(self, state: S) -> Posterior:
        """Distribution of the INS error at the last epoch."""
        ...


@runtime_checkable
class Matcher(Protocol):
    """A batch method: a frozen dataclass of settings with the field `maps` besides its own."""

    def match(self, prior: Prior, profile: Profile) -> Candidates:
        """Match a whole profile against the map within the prior; errors refer to the profile's last epoch."""
        ...

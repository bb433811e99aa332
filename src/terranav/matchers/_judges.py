"""Is this match a mismatch? The judges of papers/003: none, M/N, and PDAF (section 4, eqs. 6-10).

They compare the optimisations of successive matches. Positions are compared as errors of the INS: an INS error does
not move with the vehicle, so the distance between two matches' errors is the distance between their positions after
the INS has carried the earlier one on to the time of the later.

The fractions of eqs. 6 and 10 are garbled in print and read as E_i / sum E, which would give the largest target value
the largest credibility; the text says that 'the larger E should have a less credible probability'. So with 1/E:

    eq. 6    beta_i = (1/E_i) / sum_k (1/E_k)                               first match
    eq. 7    p(i|j') = exp(-dis^2 / (2 sigma^2))                            dis: distance of i from the carried-on j'
    eq. 8    P(i|j') = p(i|j') / sum_k p(k|j')
    eq. 9    P(i) = sum_j' P(i|j') beta'_j'
    eq. 10   beta_i = (P(i)/E_i) / sum_k (P(k)/E_k)

Eq. 7 is garbled, too; the text says that the INS error is normal with variance sigma^2, hence the square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

JUDGES = ("none", "m_of_n", "pdaf")
LEAST_E_M = 1e-3  # a target value of zero is not certainty


@dataclass(frozen=True, slots=True)
class Memory:
    """What a judge remembers of the matches before.

    Attributes
    ----------
    past_m : (k, 2) [m]
        INS errors by the latest matches, oldest first.
    places_m : (Q, 2) [m]
        All the optimisations of the latest match.
    credibility : (Q,)
        Of each of them; sums to one.
    """

    past_m: FloatArray
    places_m: FloatArray
    credibility: FloatArray

    @classmethod
    def empty(cls) -> Memory:
        """Before the first match."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))


@dataclass(frozen=True, slots=True)
class Decision:
    """Which optimisation is the match, how credible each is, and whether the match is accepted."""

    chosen: int
    credibility: FloatArray
    accepted: bool


def by_target(target_m: FloatArray) -> FloatArray:
    """(Q,) credibility from the target values alone (papers/003 eq. 6, as read in the module docstring)."""
    inverse = 1.0 / np.maximum(target_m, LEAST_E_M)
    return np.asarray(inverse / inverse.sum())


def pdaf_credibility(places_m: FloatArray, target_m: FloatArray, memory: Memory, sigma_m: float) -> FloatArray:
    """(Q,) credibility of the optimisations of one match, given those of the match before (papers/003 eqs. 7-10).

    Parameters
    ----------
    places_m : (Q, 2) [m]
        INS errors.
    target_m : (Q,) [m]
        Target values E.
    memory : Memory
        Empty before the first match: then eq. 6.
    sigma_m : float
        1-sigma of how far the INS error may move between the two [m].
    """
    if not memory.credibility.size:
        return by_target(target_m)
    away = places_m[:, None, :] - memory.places_m[None, :, :]
    exponent = -0.5 * np.sum(away**2, axis=2) / sigma_m**2
    p = np.exp(exponent - exponent.max(axis=0))  # eq. 8 is a ratio: scaling each column keeps it from 0/0
    total = (p / p.sum(axis=0)) @ memory.credibility
    weight = total / np.maximum(target_m, LEAST_E_M)
    return np.asarray(weight / weight.sum())


def agrees(place_m: FloatArray, past_m: FloatArray, need: int, of: int, within_m: float) -> bool:
    """M/N: whether a match lies within a distance of at least `need` of the `of` matches before it.

    The first `of` matches are never accepted: as in the paper, the method 'gives the location from the fourth match'
    when N is 3.
    """
    if len(past_m) < of:
        return False
    away = np.hypot(*(past_m[-of:] - place_m).T)
    return int(np.count_nonzero(away <= within_m)) >= need


def decide(
    judge: str, places_m: FloatArray, target_m: FloatArray, memory: Memory, limits: tuple[int, int, float, float]
) -> tuple[Decision, Memory]:
    """Judge one match.

    Parameters
    ----------
    judge : 'none', 'm_of_n' or 'pdaf'
        'none' and 'm_of_n' take the smallest target value, 'pdaf' the largest credibility; 'm_of_n' may refuse it.
    places_m, target_m : (Q, 2), (Q,) [m]
    memory : Memory
    limits : (M, N, distance_m, sigma_m)

    Returns
    -------
    Decision, Memory
        Also what to remember for the next match.
    """
    need, of, within_m, sigma_m = limits
    pdaf = judge == "pdaf"
    credibility = pdaf_credibility(places_m, target_m, memory, sigma_m) if pdaf else by_target(target_m)
    chosen = int(np.argmax(credibility)) if pdaf else int(np.argmin(target_m))
    accepted = judge != "m_of_n" or agrees(places_m[chosen], memory.past_m, need, of, within_m)
    past = np.concatenate([memory.past_m, places_m[chosen][None]])[-of:]
    return Decision(chosen, credibility, accepted), Memory(past, places_m, credibility)

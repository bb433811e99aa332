"""Judges of mismatches: PDAF against an example worked by hand, M/N by its table."""

from __future__ import annotations

import math

import numpy as np
import pytest

from terranav.matchers._judges import Memory, agrees, by_target, decide, pdaf_credibility

LIMITS = (2, 3, 100.0, 100.0)


def test_first_credibility_goes_with_one_over_e() -> None:
    np.testing.assert_allclose(by_target(np.array([10.0, 20.0, 20.0])), [0.5, 0.25, 0.25])
    np.testing.assert_allclose(by_target(np.array([0.0, 0.0])), [0.5, 0.5])


def test_pdaf_equals_an_example_worked_by_hand() -> None:
    """Two places before, two now, on a line north; sigma 100 m.

    Distances of now (0, 200) from before (0, 100): from 0: 0 and 200; from 100: 100 and 100.
    eq. 7: exp(0) = 1, exp(-2) from 0; exp(-1/2) both from 100.
    eq. 8: P(1|1') = 1/(1 + exp(-2)) = 0.880797, P(2|1') = 0.119203; P(.|2') = 1/2.
    eq. 9 with beta' = (0.75, 0.25): P(1) = 0.75 * 0.880797 + 0.125 = 0.785598, P(2) = 0.214402.
    eq. 10 with E = (40, 10): weights 0.01963995, 0.0214402; sum 0.04108015.
    """
    memory = Memory(np.empty((0, 2)), np.array([[0.0, 0.0], [100.0, 0.0]]), np.array([0.75, 0.25]))
    places, target = np.array([[0.0, 0.0], [200.0, 0.0]]), np.array([40.0, 10.0])
    beta = pdaf_credibility(places, target, memory, 100.0)
    np.testing.assert_allclose(beta, [0.478089, 0.521911], atol=1e-5)
    assert beta.sum() == pytest.approx(1.0)


def test_pdaf_prefers_what_the_match_before_supports() -> None:
    before = Memory(np.empty((0, 2)), np.zeros((5, 2)), np.full(5, 0.2))
    places, target = np.array([[10.0, 0.0], [900.0, 0.0]]), np.array([12.0, 10.0])
    assert decide("none", places, target, before, LIMITS)[0].chosen == 1
    decision, memory = decide("pdaf", places, target, before, LIMITS)
    assert decision.chosen == 0
    assert decision.accepted
    np.testing.assert_array_equal(memory.credibility, decision.credibility)
    np.testing.assert_array_equal(memory.places_m, places)


def test_pdaf_stays_finite_however_far_the_places_are() -> None:
    before = Memory(np.empty((0, 2)), np.array([[0.0, 0.0], [1e6, 0.0]]), np.array([0.5, 0.5]))
    beta = pdaf_credibility(np.array([[3e5, 0.0], [5e5, 1.0]]), np.array([1.0, 2.0]), before, 1.0)
    assert np.isfinite(beta).all()
    assert beta.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("past", "need", "of", "accepted"),
    [
        ([], 2, 3, False),
        ([0.0, 0.0], 2, 3, False),  # the first three are never accepted
        ([0.0, 0.0, 0.0], 2, 3, True),
        ([0.0, 500.0, 0.0], 2, 3, True),
        ([0.0, 500.0, 500.0], 2, 3, False),
        ([0.0, 500.0, 500.0], 1, 3, True),
        ([0.0, 0.0, 500.0, 500.0], 2, 3, False),  # only the latest three count
        ([500.0, 500.0, 500.0], 1, 3, False),
        ([100.0, 100.0, 500.0], 2, 3, True),  # the distance itself still agrees
        ([0.0], 1, 1, True),
    ],
)
def test_m_of_n_by_its_table(past: list[float], need: int, of: int, accepted: bool) -> None:
    places = np.array([[north, 0.0] for north in past]).reshape(-1, 2)
    assert agrees(np.zeros(2), places, need, of, 100.0) is accepted


def test_m_of_n_takes_the_smallest_target_and_remembers_n() -> None:
    memory = Memory.empty()
    for k in range(6):
        places = np.array([[300.0 * (k == 4), 0.0], [math.pi, 50.0]])
        decision, memory = decide("m_of_n", places, np.array([1.0, 2.0]), memory, LIMITS)
        assert decision.chosen == 0
        assert decision.accepted is (k in (3, 5))
    assert memory.past_m.shape == (3, 2)

"""The INS alone: its covariance is that of an error which nothing corrects."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Prior
from terranav.experiment.stream import stream
from terranav.filters.ins import InsOnly
from terranav.ins.drift import draw_drift
from terranav.ins.grades import GRADES


def last_cov(ins: InsGrade, times_s: list[float]) -> np.ndarray:
    epochs = [Epoch(time_s, 45.0, 10.0, 0.0) for time_s in times_s]
    *_, last = stream(InsOnly((), ins), Prior.from_ins(ins), epochs, np.random.default_rng(0))
    return last.cov_m2


def test_constant_velocity_error_grows_with_the_square_of_time() -> None:
    ins = InsGrade(100.0, 2.0, 3.0)
    np.testing.assert_allclose(
        last_cov(ins, [50.0, 150.0]), (100.0**2 + 200.0**2 + 9.0 * 100.0) * np.eye(2), rtol=1e-12
    )


@given(st.lists(st.floats(0.01, 599.0), max_size=8, unique=True), st.sampled_from(sorted(GRADES)))
def test_more_epochs_change_nothing(between: list[float], grade: str) -> None:
    ins = GRADES[grade]
    fine = last_cov(ins, [0.0, *np.linspace(1.0, 600.0, 600)])
    np.testing.assert_allclose(last_cov(ins, [0.0, *sorted(between), 600.0]), fine, rtol=0.01)


@pytest.mark.parametrize("grade", sorted(GRADES))
def test_covers_the_drift_of_its_grade(grade: str) -> None:
    ins, times = GRADES[grade], np.linspace(0.0, 900.0, 31)
    rng = np.random.default_rng(2)
    ends = np.array([draw_drift(times, ins, rng)[0][-1] for _ in range(400)])
    claimed = np.sqrt(last_cov(ins, list(times))[0, 0])
    assert 0.9 < claimed / np.sqrt(np.mean(ends**2)) < 1.5  # an envelope: all parts at full strength at once

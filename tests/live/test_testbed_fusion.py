"""The vehicle's filter: what it makes of fixes, and which it leaves."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from terranav.core.earth import shifted
from terranav.ins.grades import grade_named
from terranav.live.testbed.fusion import FLOOR_M, GIVE_IN_S, OLDEST_S, Fix, Fusion

GRADE = replace(grade_named("tactical"), position_sigma_m=3.0)
LAT, LON, SPEED = 46.0, 7.0, 50.0


def flown(
    seconds: float, error_mps: tuple[float, float] = (0.0, 0.0)
) -> tuple[Fusion, list[tuple[float, float, float]]]:
    """A filter that has seen an INS fly east, wrong by a constant velocity; and the true places, ten a second."""
    fusion, true = Fusion(GRADE), []
    for k in range(round(10 * seconds) + 1):
        t = k / 10.0
        true.append((t, *shifted(LAT, LON, 0.0, SPEED * t)))
        indicated = shifted(LAT, LON, error_mps[0] * t, (SPEED + error_mps[1]) * t)
        fusion.predict(t, *indicated, (error_mps[0], SPEED + error_mps[1], 0.0))
    return fusion, true


def test_fixes_give_the_error_of_position_and_velocity() -> None:
    fusion, truth = Fusion(GRADE), (0.6, -0.4)
    rng = np.random.default_rng(2)
    for k in range(1201):
        t = k / 10.0
        fusion.predict(t, *shifted(LAT, LON, truth[0] * t, (SPEED + truth[1]) * t), (truth[0], SPEED + truth[1], 0.0))
        if k % 10 == 0:
            noise = rng.normal(0.0, 5.0, 2)
            fusion.take(Fix(0.0, *shifted(LAT, LON, noise[0], SPEED * t + noise[1]), (5.0, 5.0)))
    assert fusion.used >= 117  # of 121: beyond 3 sigma on one of two axes lies one in 185
    error = fusion.mean[:4] - [truth[0] * 120.0, truth[1] * 120.0, *truth]
    assert error @ np.linalg.solve(fusion.cov[:4, :4], error) < 14.9  # 0.5 % of a chi-square with four degrees
    assert math.sqrt(fusion.cov[0, 0]) < 4.0
    assert np.linalg.eigvalsh(fusion.cov)[0] > 0.0


@pytest.mark.parametrize("age_s", [0.0, 0.35, 2.0])
def test_the_age_of_a_fix_does_not_matter(age_s: float) -> None:
    fusion, true = flown(30.0)
    at = true[-1 - round(10 * age_s)] if age_s != 0.35 else (0.0, *shifted(LAT, LON, 0.0, SPEED * (30.0 - 0.35)))
    for _ in range(20):
        assert fusion.take(Fix(age_s, at[1], at[2], (1.0, 1.0)))
    assert np.abs(fusion.mean[:2]).max() < 0.05


def test_an_outlier_is_left_and_so_is_a_jump_until_it_lasts() -> None:
    fusion, true = flown(30.0)
    fusion.take(Fix(0.0, *true[-1][1:], (2.0, 2.0)))
    before = fusion.mean.copy()
    assert not fusion.take(Fix(0.0, *shifted(*true[-1][1:], 800.0, 0.0), (2.0, 2.0)))
    assert fusion.rejected == 1
    assert (fusion.mean == before).all()
    taken = []
    for k in range(1, 80):
        t = 30.0 + k / 10.0
        place = shifted(LAT, LON, 0.0, SPEED * t)
        fusion.predict(t, *place, (0.0, SPEED, 0.0))
        taken.append(fusion.take(Fix(0.0, *shifted(*place, 800.0, 0.0), (2.0, 2.0))))
    assert fusion.resets == 1
    assert taken.index(True) == pytest.approx(10 * GIVE_IN_S, abs=2)
    assert all(taken[taken.index(True) :])
    assert fusion.mean[0] == pytest.approx(-800.0, abs=3.0)


def test_the_noise_floor_holds() -> None:
    fusion, true = flown(1.0)
    for _ in range(3):
        fusion.take(Fix(0.0, *true[-1][1:], (1e-3, 1e-3)))
    assert math.sqrt(fusion.cov[0, 0]) > 0.95 * FLOOR_M / math.sqrt(3.5)


@pytest.mark.parametrize(
    "wrong",
    [
        {"age_s": math.nan},
        {"age_s": OLDEST_S + 0.1},
        {"lat_deg": math.inf},
        {"sigma_m": (math.nan, 1.0)},
        {"sigma_m": (0.0, 1.0)},
        {"sigma_m": (-1.0, 1.0)},
    ],
)
def test_what_is_no_fix_is_not_taken(wrong: dict[str, object]) -> None:
    fusion, true = flown(10.0)
    before = fusion.mean.copy()
    assert not fusion.take(replace(Fix(0.0, *true[-1][1:], (1.0, 1.0)), **wrong))  # type: ignore[arg-type]
    assert (fusion.mean == before).all()


@pytest.mark.parametrize("speed_sigma", [math.nan, 0.0, -1.0, math.inf])
@pytest.mark.parametrize("speed", [(0.0, SPEED), (math.nan, SPEED)])
def test_a_velocity_without_accuracy_is_left(speed: tuple[float, float], speed_sigma: float) -> None:
    (fusion, true), (other, _) = flown(10.0), flown(10.0)
    fix = Fix(0.0, *true[-1][1:], (1.0, 1.0))
    assert other.take(fix)
    assert fusion.take(replace(fix, velocity_mps=speed, velocity_sigma_mps=speed_sigma))
    assert (fusion.mean == other.mean).all()
    assert (fusion.cov == other.cov).all()


def test_a_copy_goes_its_own_way() -> None:
    fusion, true = flown(10.0, (1.0, 0.0))
    other = fusion.copy()
    fusion.take(Fix(0.0, *true[-1][1:], (1.0, 1.0)))
    assert fusion.mean[0] > 5.0
    assert other.mean[0] == 0.0

"""add_drift: the moments it promises, the truth it keeps, the bits it repeats."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.earth import SCHULER_RAD_PER_S, offset_m, shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.ins.drift import add_drift, draw_drift

STILL = InsGrade(position_sigma_m=1e-9, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.0)


def flight(n: int = 121, *, velocity: bool = True, **columns: np.ndarray) -> Recording:
    """A straight flight north-east at 50 m/s per axis, 1 Hz."""
    time = np.arange(float(n))
    lat, lon = shift(46.0, 7.0, 50.0 * time, 50.0 * time)
    base = {"time_s": time, "lat_deg": lat, "lon_deg": lon, "alt_m": 2000.0 + time}
    if velocity:
        base |= {"vn_mps": np.full(n, 50.0), "ve_mps": np.full(n, 50.0), "vd_mps": np.full(n, -1.0)}
    return Recording({**base, **columns}, name="flight")


def draws(ins: InsGrade, time: np.ndarray, runs: int) -> tuple[np.ndarray, np.ndarray]:
    pairs = [draw_drift(time, ins, np.random.default_rng(seed)) for seed in range(runs)]
    return np.stack([p for p, _ in pairs]), np.stack([v for _, v in pairs])


@pytest.mark.parametrize("step_s", [1.0, 20.0])
def test_moments_are_those_of_the_grade_whatever_the_step(step_s: float) -> None:
    ins = InsGrade(200.0, 0.5, 2.0, 0.02)
    time = np.arange(0.0, 601.0, step_s)
    position, velocity = draws(ins, time, 2000)
    t = time[-1]
    expected = 200.0**2 + (0.5 * t) ** 2 + 2.0**2 * t + 0.02**2 * t**3 / 3.0
    # the standard error of a variance from 4000 normal draws is 2.2 %
    assert np.mean(position[:, 0] ** 2) == pytest.approx(200.0**2, rel=0.09)
    assert np.mean(position[:, -1] ** 2) == pytest.approx(expected, rel=0.09)
    assert np.mean(velocity[:, -1] ** 2) == pytest.approx(0.5**2 + 0.02**2 * t, rel=0.09)
    assert abs(np.mean(position[:, -1])) < 4.0 * math.sqrt(expected / 4000)
    assert abs(np.mean(position[:, -1, 0] * position[:, -1, 1])) < 4.0 * expected / math.sqrt(2000)


def test_velocity_sigma_agrees_with_the_grade_where_biases_act() -> None:
    """The grade's growth formula and the drift are written apart from one another."""
    ins = InsGrade(
        100.0, 0.1, 0.0, 0.0, attitude_sigma_deg=0.01, gyro_bias_sigma_deg_per_h=1.0, accel_bias_sigma_ug=500.0,
        gyro_walk_deg_per_sqrt_h=0.1, accel_walk_mps_per_sqrt_h=0.05,
    )  # fmt: skip
    time = np.arange(0.0, 601.0, 5.0)
    _, velocity = draws(ins, time, 1500)
    for i in (20, 60, 120):
        rms = math.sqrt(np.mean(velocity[:, i] ** 2))
        assert rms == pytest.approx(ins.velocity_sigma_at_mps(float(time[i])), rel=0.06)


def test_velocity_is_the_rate_of_the_drift_without_walk() -> None:
    ins = InsGrade(100.0, 1.0, 0.0, 0.0, 0.05, 0.0, 1.0, 1000.0, gyro_walk_deg_per_sqrt_h=0.1)
    time = np.arange(0.0, 600.0, 0.5)
    position, velocity = draw_drift(time, ins, np.random.default_rng(3))
    np.testing.assert_allclose(np.gradient(position, time, axis=0)[1:-1], velocity[1:-1], atol=2e-3)


def test_an_initial_velocity_error_swings_in_the_schuler_loop_and_is_constant_without_one() -> None:
    level = InsGrade(1e-9, 1.0, 0.0)
    looped = InsGrade(1e-9, 1.0, 0.0, attitude_sigma_deg=1e-12)
    time = np.arange(0.0, 5101.0, 60.0)
    (position, velocity), (swung, swinging) = (draw_drift(time, i, np.random.default_rng(3)) for i in (level, looped))
    np.testing.assert_allclose(position, velocity[0] * time[:, None], atol=1e-6)
    np.testing.assert_array_equal(velocity, np.broadcast_to(velocity[0], velocity.shape))
    phase = SCHULER_RAD_PER_S * time[:, None]
    np.testing.assert_allclose(swung, velocity[0] * np.sin(phase) / SCHULER_RAD_PER_S, atol=1e-5)
    np.testing.assert_allclose(swinging, velocity[0] * np.cos(phase), atol=1e-8)


def test_velocity_is_the_rate_of_the_drift_with_every_walk_in_the_loop() -> None:
    """Whatever is kicked: the integral of the velocity is the position, to the trapezoid of small steps."""
    ins = InsGrade(1e-9, 1.0, 0.0, 0.05, 0.05, 0.0, 1.0, 100.0, 0.1, 0.1)
    time = np.arange(0.0, 3000.0, 1.0)
    position, velocity = draw_drift(time, ins, np.random.default_rng(4))
    travelled = np.concatenate([np.zeros((1, 2)), np.cumsum(0.5 * (velocity[1:] + velocity[:-1]), axis=0)])
    # apart from what a walk does within a step, sqrt(dt^3 / 12) a step, here 0.015 m
    np.testing.assert_allclose(position - position[0], travelled, atol=4.0 * 0.015 * math.sqrt(time.size))


def test_indicated_is_taken_for_true_where_no_truth_is_known() -> None:
    rec = flight()
    out = add_drift(rec, InsGrade(500.0, 0.5, 1.0), 7)
    for key in ("lat_deg", "lon_deg", "alt_m"):
        np.testing.assert_array_equal(out.columns[f"true_{key}"], rec.columns[key])
    np.testing.assert_array_equal(out.alt_m, rec.alt_m)
    np.testing.assert_array_equal(out.columns["vd_mps"], rec.columns["vd_mps"])
    assert out.ins == InsGrade(500.0, 0.5, 1.0)
    assert "seed 7" in out.source["added_drift"]
    assert "500 m" in out.source["added_drift"]
    assert "true_lat_deg" not in rec.columns


@given(seed=st.integers(0, 2**32), sigma=st.floats(1.0, 5000.0))
def test_the_error_is_what_was_drawn(seed: int, sigma: float) -> None:
    ins = InsGrade(sigma, 0.5, 1.0)
    rec = flight(20)
    out = add_drift(rec, ins, seed)
    position, velocity = draw_drift(rec.time_s, ins, np.random.default_rng(seed))
    np.testing.assert_allclose(out.ins_error_m(), position, atol=1e-6)
    north, east = offset_m(rec.lat_deg, rec.lon_deg, out.lat_deg, out.lon_deg)
    np.testing.assert_allclose(np.stack([north, east], axis=1), position, atol=1e-6)
    np.testing.assert_allclose(out.columns["vn_mps"] - 50.0, velocity[:, 0], atol=1e-9)


def test_truth_stays_and_an_old_drift_is_replaced() -> None:
    rec = flight()
    first = add_drift(rec, InsGrade(300.0, 1.0, 0.0), 1)
    second = add_drift(first, InsGrade(50.0, 0.2, 0.0), 2)
    direct = add_drift(rec, InsGrade(50.0, 0.2, 0.0), 2)
    for key in ("true_lat_deg", "true_lon_deg", "true_alt_m", "lat_deg", "lon_deg"):
        np.testing.assert_array_equal(second.columns[key], direct.columns[key])
    np.testing.assert_allclose(second.columns["vn_mps"], direct.columns["vn_mps"], atol=1e-6)


def test_a_grade_without_error_gives_back_the_truth() -> None:
    out = add_drift(flight(), STILL, 0)
    assert np.abs(out.ins_error_m()).max() < 1e-7


def test_same_seed_same_bits() -> None:
    one, two = (add_drift(flight(), InsGrade(), 5) for _ in range(2))
    three = add_drift(flight(), InsGrade(), np.random.default_rng(5))
    other = add_drift(flight(), InsGrade(), 6)
    np.testing.assert_array_equal(one.lat_deg, two.lat_deg)
    np.testing.assert_array_equal(one.lat_deg, three.lat_deg)
    assert not np.array_equal(one.lat_deg, other.lat_deg)


def test_one_epoch_and_no_velocity_are_enough() -> None:
    out = add_drift(add_drift(flight(1, velocity=False), InsGrade(), 0), InsGrade(), 1)
    assert len(out) == 1
    assert "vn_mps" not in out.columns


def test_truth_with_holes_is_refused() -> None:
    lat = np.full(121, 46.0)
    lat[4] = np.nan
    rec = flight(true_lat_deg=lat, true_lon_deg=np.full(121, 7.0))
    with pytest.raises(DataError, match=r"flight: true_lat_deg in row 5 is empty"):
        add_drift(rec, InsGrade(), 0)


@pytest.mark.parametrize("seed", [-1, 1.5, True, "7"])
def test_a_seed_that_is_none_is_refused(seed: object) -> None:
    with pytest.raises(ConfigError, match="seed is"):
        add_drift(flight(), InsGrade(), seed)  # type: ignore[arg-type]

"""The strapdown INS: exact without errors, as bad as its grade says with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from terranav.core.earth import offset_m
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.ins.grades import GRADES, grade_named
from terranav.ins.strapdown import free_inertial
from terranav.ins.trajectory import Route, Trajectory, fly
from terranav.sensors.barometer import Barometer

PERFECT = InsGrade(1e-9, 0.0, 0.0)
LEVEL = [[46.0, 7.0, 2000.0], [46.0, 7.85, 2000.0]]
WINDING = [[46.0, 7.0, 1500.0], [46.2, 7.1, 2500.0], [46.2, 7.4, 2500.0], [46.05, 7.45, 1800.0]]


@pytest.fixture(scope="module")
def winding() -> Trajectory:
    return fly(Route(WINDING, [80.0, 100.0, 90.0]), 50.0)


@pytest.fixture(scope="module")
def level() -> Trajectory:
    return fly(Route(LEVEL, 100.0), 10.0)


def run(truth: Trajectory, grade: InsGrade, seed: int = 0, **settings: float) -> Trajectory:
    return free_inertial(truth, grade, np.random.default_rng(seed), **settings)


def error(truth: Trajectory, indicated: Trajectory) -> np.ndarray:
    """(n, 2) indicated minus true [m]; the truth is sampled a whole number of times as often."""
    step = round((len(truth) - 1) / (len(indicated) - 1))
    true = truth.every(step)
    np.testing.assert_allclose(true.time_s, indicated.time_s, atol=1e-9)
    return np.stack(offset_m(true.lat_deg, true.lon_deg, indicated.lat_deg, indicated.lon_deg), axis=1)


def test_a_perfect_imu_stays_with_the_truth(winding: Trajectory) -> None:
    out = run(winding, PERFECT)
    true = winding.every(50)
    assert true.time_s[-1] > 600.0
    assert np.abs(error(winding, out)).max() < 1.0
    np.testing.assert_allclose(out.alt_m, true.alt_m, atol=0.1)
    np.testing.assert_allclose(out.velocity_mps, true.velocity_mps, atol=0.01)
    turned = (out.attitude_deg - true.attitude_deg + 180.0) % 360.0 - 180.0
    assert np.abs(turned).max() < 1e-3


def test_a_track_of_one_sample_a_second_will_do(winding: Trajectory) -> None:
    track = winding.every(50)
    out = run(track, PERFECT)
    np.testing.assert_array_equal(out.time_s, track.time_s)
    assert np.abs(error(track, out)).max() < 2.0


@pytest.mark.parametrize("name", ["navigation", "tactical", "industrial"])
def test_errors_grow_as_the_grade_says(name: str, level: Trajectory) -> None:
    """RMS over 16 runs and two axes against the formula of InsGrade, which was written without this simulation."""
    grade = GRADES[name]
    short = Trajectory(*(getattr(level, key)[:3001] for key in Trajectory.__dataclass_fields__))
    runs = [run(short, grade, seed, imu_rate_hz=10.0) for seed in range(16)]
    position = np.stack([error(short, out) for out in runs])
    velocity = np.stack([(out.velocity_mps - short.every(10).velocity_mps)[:, :2] for out in runs])
    sigma = np.array([grade.velocity_sigma_at_mps(float(t)) for t in range(301)])
    # the standard error of an RMS over 32 draws is 12.5 %; the formula is a model, so 35 %
    assert np.sqrt(np.mean(position[:, 0] ** 2)) == pytest.approx(grade.position_sigma_m, rel=0.35)
    for t in (100, 300):
        assert np.sqrt(np.mean(velocity[:, t] ** 2)) == pytest.approx(sigma[t], rel=0.35)
        grown = np.sqrt(np.mean((position[:, t] - position[:, 0]) ** 2))
        assert grown == pytest.approx(np.trapezoid(sigma[: t + 1]), rel=0.35)


def test_a_tilt_alone_drives_the_schuler_loop(level: Trajectory) -> None:
    """velocity = g tilt sin(wt) / w: the same closed form on which InsGrade and add_drift rest."""
    out = run(level, replace(PERFECT, attitude_sigma_deg=0.1), 3, imu_rate_hz=10.0)
    w = 1.24e-3
    rise = np.sin(w * out.time_s) / w
    velocity = (out.velocity_mps - level.every(10).velocity_mps)[:, :2]
    tilt = velocity[30] / (9.81 * rise[30])
    assert 0.01 < np.degrees(np.hypot(*tilt)) < 0.4
    np.testing.assert_allclose(velocity[:300], 9.81 * rise[:300, None] * tilt, atol=0.05 * np.abs(velocity[300]).max())


def test_the_vertical_channel_is_held(winding: Trajectory) -> None:
    """A free vertical channel with a bias of 2 mg would be kilometres off after ten minutes."""
    out = run(winding, GRADES["industrial"], 1)
    assert np.abs(out.alt_m - winding.every(50).alt_m).max() < 30.0


def test_the_altitude_follows_the_barometer(level: Trajectory) -> None:
    baro = Barometer.from_table({"sigma_m": 3.0, "bias_m": 40.0, "dropout_probability": 0.3, "dropout_length": 5.0})
    reading = baro.measure(level.alt_m, np.random.default_rng(2))
    out = run(level, PERFECT, imu_rate_hz=10.0)
    with_baro = free_inertial(level, PERFECT, np.random.default_rng(0), imu_rate_hz=10.0, baro_altitude_m=reading)
    late = with_baro.alt_m[120:] - 2000.0
    assert late.mean() == pytest.approx(40.0, abs=3.0)
    assert late.std() < 3.0  # the loop smooths the readings
    assert np.abs(error(level, with_baro) - error(level, out)).max() < 10.0


def test_same_generator_same_bits(level: Trajectory) -> None:
    short = Trajectory(*(getattr(level, key)[:601] for key in Trajectory.__dataclass_fields__))
    one, two, other = (run(short, GRADES["tactical"], seed, imu_rate_hz=10.0) for seed in (4, 4, 5))
    for key in ("lat_deg", "lon_deg", "alt_m", "velocity_mps", "attitude_deg"):
        np.testing.assert_array_equal(getattr(one, key), getattr(two, key))
    assert not np.array_equal(one.lat_deg, other.lat_deg)


def test_output_rate_only_thins(level: Trajectory) -> None:
    dense = run(level, GRADES["tactical"], output_rate_hz=10.0, imu_rate_hz=10.0)
    thin = run(level, GRADES["tactical"], output_rate_hz=0.5, imu_rate_hz=10.0)
    np.testing.assert_array_equal(thin.lat_deg, dense.lat_deg[::20])


def test_bad_settings_get_one_clear_line(level: Trajectory) -> None:
    with pytest.raises(ConfigError, match="imu_rate_hz is 50, expected a whole multiple of output_rate_hz"):
        run(level, PERFECT, output_rate_hz=7.0)
    with pytest.raises(ConfigError, match="whole multiple"):
        run(level, PERFECT, output_rate_hz=100.0)
    with pytest.raises(ConfigError, match="output_rate_hz"):
        run(level, PERFECT, output_rate_hz=0.0)
    with pytest.raises(DataError, match="trajectory has 1 sample"):
        run(level.every(10**6), PERFECT)
    with pytest.raises(DataError, match=r"baro_altitude_m has shape \(3,\)"):
        free_inertial(level, PERFECT, np.random.default_rng(0), baro_altitude_m=np.zeros(3))
    with pytest.raises(DataError, match="no reading"):
        free_inertial(level, PERFECT, np.random.default_rng(0), baro_altitude_m=np.full(len(level), np.nan))


def test_grades_by_name() -> None:
    assert grade_named("tactical").name == "tactical"
    assert replace(grade_named("industrial"), position_sigma_m=50.0).velocity_sigma_mps == 0.3
    with pytest.raises(ConfigError, match=r"unknown INS grade 'tactic' \(did you mean 'tactical'\?\)"):
        grade_named("tactic")


def test_better_grades_drift_less() -> None:
    at_ten_minutes = [GRADES[name].velocity_sigma_at_mps(600.0) for name in ("navigation", "tactical", "industrial")]
    assert at_ten_minutes == sorted(at_ten_minutes)

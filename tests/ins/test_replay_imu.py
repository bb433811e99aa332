"""Strapdown of logged inertial sensors: perfect ones follow the truth, their biases are found, gaps are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pyins import sim

from terranav.core.earth import offset_m
from terranav.core.errors import DataError
from terranav.ins.imu import ImuReadings, check_imu, imu_biases, strapdown_of
from terranav.ins.trajectory import Route, Trajectory, fly

BIASES = np.array([1e-3, -2e-3, 5e-4, 0.02, -0.05, 0.03])


@pytest.fixture(scope="module")
def path() -> Trajectory:
    """A minute with two turns and a climb."""
    corners = [(46.0, 8.0, 900.0), (46.006, 8.0, 930.0), (46.006, 8.010, 980.0), (46.02, 8.010, 980.0)]
    whole = fly(Route(corners, 40.0, bank_deg=30.0), 50.0)
    return Trajectory(*(part[:3000] for part in vars(whole).values()))


@pytest.fixture(scope="module")
def imu(path: Trajectory) -> ImuReadings:
    lla = np.stack([path.lat_deg, path.lon_deg, path.alt_m], axis=1)
    _, made = sim.generate_imu(path.time_s, lla, path.attitude_deg, path.velocity_mps, sensor_type="rate")
    rates = made.to_numpy()
    return ImuReadings(path.time_s, rates[:, :3], rates[:, 3:])


def test_perfect_sensors_follow_the_truth(path: Trajectory, imu: ImuReadings) -> None:
    times = path.every(5)
    flown = strapdown_of(imu, path.every(len(path)), times.time_s, times.alt_m)
    off = np.hypot(*offset_m(times.lat_deg, times.lon_deg, flown.lat_deg, flown.lon_deg))
    assert off.max() < 1.0
    assert np.abs(flown.alt_m - times.alt_m).max() < 1.0
    assert np.abs(flown.velocity_mps - times.velocity_mps).max() < 0.1
    turned = (flown.attitude_deg - times.attitude_deg + 180.0) % 360.0 - 180.0
    assert np.abs(turned).max() < 0.05


def test_biases_are_found_and_taken_out(path: Trajectory, imu: ImuReadings) -> None:
    wrong = replace(imu, gyro_radps=imu.gyro_radps + BIASES[:3], accel_mps2=imu.accel_mps2 + BIASES[3:])
    found = imu_biases(wrong, path.every(5))
    np.testing.assert_allclose(found[:3], BIASES[:3], atol=2e-5)
    np.testing.assert_allclose(found[3:], BIASES[3:], atol=6e-3)  # gravity here is not the standard one
    np.testing.assert_allclose(imu_biases(imu.without(BIASES), path.every(5)) - imu_biases(imu, path.every(5)), -BIASES)


def test_uneven_readings_cost_little(path: Trajectory, imu: ImuReadings) -> None:
    keep = np.random.default_rng(4).random(len(path)) > 0.3
    keep[[0, -1]] = True
    thin = ImuReadings(imu.time_s[keep], imu.gyro_radps[keep], imu.accel_mps2[keep])
    times = path.every(5)
    flown = strapdown_of(thin, path.every(len(path)), times.time_s, times.alt_m)
    assert np.hypot(*offset_m(times.lat_deg, times.lon_deg, flown.lat_deg, flown.lon_deg)).max() < 5.0


def test_gaps_and_slow_sensors_are_refused(imu: ImuReadings) -> None:
    hole = (imu.time_s < 20.0) | (imu.time_s > 21.5)
    broken = ImuReadings(imu.time_s[hole], imu.gyro_radps[hole], imu.accel_mps2[hole])
    check_imu("log", broken, 25.0, 50.0)
    with pytest.raises(DataError, match=r"log: the inertial sensors have no reading for 1\.5 s from 20\.0 s on"):
        check_imu("log", broken, 10.0, 50.0)
    slow = ImuReadings(imu.time_s[::5], imu.gyro_radps[::5], imu.accel_mps2[::5])
    with pytest.raises(DataError, match=r"logged 10\.0 times a second, expected at least 20"):
        check_imu("log", slow, 0.0, 50.0)
    with pytest.raises(DataError, match="no reading for"):
        check_imu("log", imu, 0.0, 100.0)

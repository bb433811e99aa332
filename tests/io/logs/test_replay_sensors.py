"""What a log holds beside its recording: airspeed, and inertial sensors where they are asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.replay_flight import ALTITUDE_M, SPEED_MPS, WIND_MPS, Made, dataflash

from terranav.core.ins_grade import InsGrade
from terranav.io.logs import open_log
from terranav.io.logs.found import IMU, true_airspeed_mps


def test_equivalent_airspeed_becomes_true() -> None:
    # ICAO standard atmosphere: density over that at sea level, at 0, 1000, 5000 and 10000 geopotential metres
    ratios = np.array([1.0, 1.11164, 0.736116, 0.412707]) / np.array([1.0, 1.225, 1.225, 1.225])
    found = true_airspeed_mps(100.0, np.array([0.0, 1000.0, 5000.0, 10000.0]))
    np.testing.assert_allclose(found, 100.0 / np.sqrt(ratios), rtol=2e-4)


def test_dataflash_tells_airspeed_and_inertial_sensors(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    file = tmp_path / "00000001.BIN"
    file.write_bytes(dataflash(Made(minutes=0.5, rest_s=0.0, imu=InsGrade(5.0, 0.0, 0.0))))
    log = open_log(file, imu=True)
    air, imu = log.beside["airspeed"], log.beside["imu"]
    assert np.median(np.diff(air.time_s)) == pytest.approx(0.1, abs=1e-6)
    assert np.median(np.diff(imu.time_s)) == pytest.approx(0.02, abs=1e-6)
    velocity = np.array([log.recording.columns[key][0] for key in ("vn_mps", "ve_mps")])
    expected = np.hypot(*(velocity - np.array(WIND_MPS)))
    assert abs(np.median(air.values["airspeed_mps"]) / expected - 1.0) < 0.05
    assert abs(np.median(air.values["airspeed_mps"]) - SPEED_MPS) < 8.0
    assert ALTITUDE_M > 1000.0  # where true and equivalent airspeed differ by 5 %
    down = np.median(imu.values[IMU[5]])
    assert down == pytest.approx(-9.8, abs=0.1)
    assert log.facts["series"]["imu"]["unit"] == "rad/s, m/s^2"
    assert "imu" not in open_log(file).beside


def test_a_real_px4_log_tells_its_inertial_sensors(shared_data: Path) -> None:
    pytest.importorskip("pyulog", reason="needs the extra 'logs'")
    file = shared_data / "px4" / "pyulog_sample_log_small.ulg"
    log = open_log(file, imu=True)
    imu = log.beside["imu"]
    assert 150.0 < 1.0 / np.median(np.diff(imu.time_s)) < 250.0
    force = np.stack([imu.values[key] for key in IMU[3:]])
    assert np.linalg.norm(np.median(force, axis=1)) == pytest.approx(9.8, abs=0.3)
    assert np.median(force[2]) < -9.0
    assert "imu" not in open_log(file).beside

"""The made-up flight comes back from a log of every format, to the resolution of the format."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import terranav as tn
from terranav.io.logs import Log, open_log
from tests.io.logs.bags import write_bag
from tests.io.logs.flights import Flight, dataflash, flight, nmea, tlog, ulog

FORMATS = ("dataflash", "dataflash_ekf", "tlog", "tlog1", "ulog", "ulog_old", "bag", "mcap", "sqlite3", "bag folder")
LIBRARY = {
    "dataflash": "pymavlink",
    "dataflash_ekf": "pymavlink",
    "tlog": "pymavlink",
    "tlog1": "pymavlink",
    "ulog": "pyulog",
    "ulog_old": "pyulog",
}


@pytest.fixture(scope="module")
def made() -> Flight:
    return flight()


def written(folder: Path, made: Flight, kind: str) -> Path:
    pytest.importorskip(LIBRARY.get(kind, "rosbags"), reason="needs the extra 'logs'")
    if kind == "bag":
        return write_bag(folder / "f.bag", made, ".bag")
    if kind in ("mcap", "sqlite3", "bag folder"):
        file = write_bag(folder / "f", made, "sqlite3" if kind == "bag folder" else kind)
        return file.parent if kind == "bag folder" else file
    file = folder / "no_suffix_tells_the_format"
    content = {
        "dataflash": lambda: dataflash(made),
        "dataflash_ekf": lambda: dataflash(made, without=("POS",)),
        "tlog": lambda: tlog(made),
        "tlog1": lambda: tlog(made, version=1),
        "ulog": lambda: ulog(made),
        "ulog_old": lambda: ulog(made, without=("sensor_gps", "vehicle_global_position")),
    }[kind]()
    file.write_bytes(content)
    return file


@pytest.fixture(scope="module", params=FORMATS)
def log(request: pytest.FixtureRequest, made: Flight, tmp_path_factory: pytest.TempPathFactory) -> Log:
    return open_log(written(tmp_path_factory.mktemp("log"), made, request.param))


def test_positions_and_truth_come_back(log: Log, made: Flight) -> None:
    rec = log.recording
    assert len(rec) in (made.time_s.size, made.time_s.size - 1)  # the last may lie too far behind the last fix
    made = made.first(len(rec))
    np.testing.assert_allclose(rec.time_s, made.time_s, atol=1e-6)
    late_s = 0.004 if log.facts["series"]["own"]["from"] == "XKF1 about ORGN" else 0.0  # it is logged so
    np.testing.assert_allclose(rec.lat_deg, made.lat_deg, atol=2e-7 + 1.3e-4 * late_s)
    np.testing.assert_allclose(rec.lon_deg, made.lon_deg, atol=2e-7 + 1.9e-4 * late_s)
    np.testing.assert_allclose(rec.alt_m, made.alt_m, atol=0.01)
    # GNSS at half the rate, up to 1 ms late in DataFlash, in steps of 1e-7 deg; straight lines between its rows
    assert log.facts["truth"]["known"] == 1.0
    assert np.abs(rec.ins_error_m()).max() < 0.03 + 20.0 * late_s
    np.testing.assert_allclose(rec.columns["true_alt_m"], made.alt_m, atol=0.03)


def test_motion_comes_back_in_the_frames_of_a_recording(log: Log, made: Flight) -> None:
    columns, made = log.recording.columns, made.first(len(log.recording))
    for key, value in (
        ("vn_mps", 14.14),
        ("ve_mps", 14.14),
        ("vd_mps", 0.5),
        ("pitch_deg", 2.0),
        ("heading_deg", 45.0),
    ):
        np.testing.assert_allclose(columns[key], value, atol=0.011, err_msg=key)
    np.testing.assert_allclose(columns["roll_deg"], made.roll_deg, atol=0.011)


def test_readings_come_back_and_out_of_range_is_no_reading(log: Log, made: Flight) -> None:
    columns, made = log.recording.columns, made.first(len(log.recording))
    laser, there = columns["laser_altitude_m"], np.isfinite(columns["laser_altitude_m"])
    np.testing.assert_array_equal(there, made.slant_m < 50.0 - 0.004)
    np.testing.assert_allclose(laser[there], made.slant_m[there], atol=0.006)
    # the barometer was 0.5 m, 30 m or 33 m off: it is set at the start
    assert np.abs(columns["baro_altitude_m"] - made.alt_m).max() < 0.02
    assert log.facts["altimeters"]["laser"]["limits_m"] == [0.2, 50.0]
    assert log.facts["altimeters"]["laser"]["covers"] == pytest.approx(there.mean(), abs=1e-4)
    assert any("out of range above 50 m" in line for line in log.remarks)


def test_terrain_is_altitude_less_clearance_where_the_datum_is_known(log: Log, made: Flight) -> None:
    columns, made = log.recording.columns, made.first(len(log.recording))
    by_ellipsoid = log.facts["series"]["own"]["height"] == "above the WGS-84 ellipsoid"
    assert log.recording.datum_of("terrain_m") == ("ellipsoid" if by_ellipsoid else "mean sea level")
    assert any("needs a geoid grid" in line for line in log.remarks) == by_ellipsoid
    there = np.isfinite(columns["laser_altitude_m"])
    np.testing.assert_array_equal(np.isfinite(columns["terrain_m"]), there)
    np.testing.assert_allclose(columns["terrain_m"][there], made.ground_m[there], atol=0.03)
    np.testing.assert_allclose(columns["terrain_sigma_m"][there], np.hypot(5.0, 1.0), atol=0.02)


def test_gnss_is_kept_apart_and_the_facts_say_where_it_went(log: Log) -> None:
    own = log.facts["own_position"]
    told = "XKF4" in str(log.facts["series"].get("fusing")) or "cs_gps" in str(log.facts["series"].get("fusing"))
    assert own["used_gnss"] == ("yes" if told else "unknown")
    assert {"lat_deg", "lon_deg", "alt_m", "vn_mps"} <= set(log.facts["seen_with_gnss"])
    assert "baro_altitude_m" not in log.facts["seen_with_gnss"]
    assert all(epoch.lat_deg == lat for epoch, lat in zip(log.recording.epochs(), log.recording.lat_deg, strict=True))


def test_facts_are_plain_json_and_complete(log: Log) -> None:
    facts = json.loads(json.dumps(log.facts, allow_nan=False))
    assert facts["whole"] is True
    assert facts["missing"] == []
    assert facts["start_utc"].startswith(("2023-11-14T22:13:20", "2024-02-0"))
    for role, part in facts["series"].items():
        assert part["rate_hz"] == pytest.approx(5.0 if role == "gnss" else 10.0, rel=1e-3)
        assert part["gaps"] == 0
        assert part["covers"] > 0.99
    assert tuple(facts["remarks"]) == log.remarks


def test_the_recording_takes_a_drift_and_goes_through_a_file(log: Log, tmp_path: Path) -> None:
    grade = tn.InsGrade(position_sigma_m=100.0, velocity_sigma_mps=0.5)
    drifting = tn.add_drift(log.recording, grade, 7)
    assert np.abs(drifting.ins_error_m()[-1]).max() > 5.0
    tn.write_recording(log.recording, tmp_path / "f.parquet")
    again = tn.read_recording(tmp_path / "f.parquet")
    for key, values in log.recording.columns.items():
        np.testing.assert_array_equal(again.columns[key], values)


def test_nmea_passes_midnight_and_depths_count_from_the_surface(made: Flight, tmp_path: Path) -> None:
    pytest.importorskip("pynmeagps", reason="needs the extra 'logs'")
    file = tmp_path / "ship.log"
    file.write_bytes(nmea(made))
    log = open_log(file)
    np.testing.assert_allclose(log.recording.time_s, made.time_s, atol=1e-6)
    np.testing.assert_allclose(log.recording.lat_deg, made.lat_deg, atol=2e-8)
    np.testing.assert_allclose(log.recording.columns["true_lon_deg"], made.lon_deg, atol=2e-8)
    np.testing.assert_allclose(log.recording.columns["depth_m"], made.clearance_m + 1.5, atol=0.006)
    np.testing.assert_allclose(log.recording.columns["vn_mps"], 38.88 * 1852 / 3600 * np.sqrt(0.5), atol=1e-6)
    np.testing.assert_allclose(log.recording.columns["heading_deg"], 45.0)
    assert log.facts["start_utc"] == "2024-03-01T23:59:50Z"
    assert "gnss" not in log.facts["missing"]
    assert {"own", "baro"} <= set(log.facts["missing"])


def test_a_rate_thins_the_epochs(made: Flight, tmp_path: Path) -> None:
    log_at_2 = open_log(written(tmp_path, made, "dataflash"), rate_hz=2.0)
    assert len(log_at_2.recording) == 120
    np.testing.assert_allclose(np.diff(log_at_2.recording.time_s), 0.5, atol=1e-6)

"""What a log has and has not: altimeters of every kind, GNSS or none, headings, depths; and the real logs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.core.errors import DataError
from terranav.io.logs import Log, open_log
from terranav.io.logs.found import attitude_deg, pressure_altitude_m
from terranav.io.logs.opening import format_of
from tests.io.logs.flights import Flight, dataflash, flight, fmt, message, nmea, quaternion, sentence, tlog, ulog


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "log"


def opened(file: Path, content: bytes) -> Log:
    file.write_bytes(content)
    return open_log(file)


def pymavlink() -> None:
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")


def plain(made: Flight, rows_of: Any, names: Iterable[str], head: bytes = b"") -> bytes:
    """A DataFlash log of POS and the messages that `rows_of` gives for each time."""
    out = [fmt(name) for name in ("POS", "PARM", *names)] + [head]
    for i, t in enumerate((5e6 + made.time_s * 1e6).astype(int).tolist()):
        out.append(message("POS", t, made.lat_deg[i], made.lon_deg[i], made.alt_m[i], 0.0, 0.0))
        out += [message(*row) for row in rows_of(i, t)]
    return b"".join(out)


def test_without_an_altimeter_it_is_said_that_no_map_can_be_matched(file: Path) -> None:
    pymavlink()
    log = opened(file, dataflash(flight(10.0), without=("RFND",)))
    assert log.facts["missing"] == ["altimeter"]
    assert "cannot be matched with a terrain map" in log.remarks[1]
    assert not {"terrain_m", "laser_altitude_m", "radar_altitude_m"} & set(log.recording.columns)


def test_the_autopilots_own_map_is_no_measurement(file: Path) -> None:
    pymavlink()
    log = opened(file, dataflash(flight(10.0), without=("RFND",)))
    assert "TERR" in log.remarks[0]
    assert log.recording.readings == ("baro_altitude_m",)


def test_without_gnss_there_is_no_truth(file: Path) -> None:
    pymavlink()
    log = opened(file, dataflash(flight(10.0), without=("GPS",)))
    assert not log.recording.has_truth
    assert log.facts["truth"] == {"known": 0.0}
    assert "gnss" in log.facts["missing"]
    assert any("there is no truth" in line for line in log.remarks)
    assert "start_utc" not in log.facts


def test_an_estimate_without_gnss_is_told_apart(file: Path) -> None:
    pymavlink()
    made = flight(20.0)

    def rows(i: int, t: int) -> list[tuple[Any, ...]]:
        status = 1 << 13 if i < 50 else 1 << 7
        return [("XKF4", t, 0, 0, 0, 0, 0, 0, 0.0, 0, 0, 0, 0, status if part else 1 << 7, 0, 0)]

    part = True
    log = opened(file, plain(made, rows, ["XKF4"]))
    assert log.facts["own_position"]["used_gnss"] == "part"
    assert log.facts["own_position"]["gnss_share"] == 0.25
    part = False
    log = opened(file, plain(made, rows, ["XKF4"]))
    assert log.facts["own_position"]["used_gnss"] == "no"
    assert log.facts["seen_with_gnss"] == []
    assert not any("no INS without GNSS" in line for line in log.remarks)


def test_of_several_filter_cores_the_one_that_steered_is_read(file: Path) -> None:
    pymavlink()

    def rows(i: int, t: int) -> list[tuple[Any, ...]]:
        cores = [("XKF1", t, core, 0, 0, 45.0, 10.0 + core, 0.0, 0.0, *[0.0] * 8) for core in (0, 1)]
        return [*cores, ("XKF4", t, 0, 0, 0, 0, 0, 0, 0.0, 0, 0, 0, 0, 1 << 13, 0, 1 if i > 20 else 0)]

    log = opened(file, plain(flight(20.0), rows, ["XKF1", "XKF4"]))
    np.testing.assert_allclose(log.recording.columns["vn_mps"], 11.0)
    assert log.facts["series"]["velocity"]["rows"] == 200


def test_without_an_own_position_the_barometer_holds_the_altitude(file: Path) -> None:
    pymavlink()
    made = flight(20.0)
    log = opened(file, dataflash(made, without=("POS", "XKF1", "ORGN")))
    assert log.facts["epochs_from"] == "gnss"
    assert log.facts["missing"] == ["own"]
    np.testing.assert_array_equal(log.recording.lat_deg, log.recording.columns["true_lat_deg"])
    np.testing.assert_allclose(log.recording.alt_m, made.alt_m[::2], atol=0.03)
    assert "alt_m" not in log.facts["seen_with_gnss"]


def test_no_position_at_all_is_an_error(file: Path) -> None:
    pymavlink()
    with pytest.raises(DataError, match="no position in this ArduPilot DataFlash log"):
        opened(file, dataflash(flight(5.0), without=("POS", "XKF1", "ORGN", "GPS")))


def test_a_range_finder_that_looks_ahead_is_left_out(file: Path) -> None:
    pymavlink()
    made = flight(10.0)
    log = opened(file, plain(made, lambda i, t: [("RFND", t, 0, 5.0, 4, 0)], ["RFND"]))
    assert "altimeter" in log.facts["missing"]
    assert any("do not look down" in line for line in log.remarks)


def test_a_radar_is_a_radar_and_stands_in_where_the_laser_ends(file: Path) -> None:
    pymavlink()
    made = flight(60.0)
    head = b"".join(
        message("PARM", 5_000_000, name, value, 0.0)
        for name, value in (
            (b"RNGFND1_TYPE", 8.0),
            (b"RNGFND1_MIN", 0.2),
            (b"RNGFND1_MAX", 50.0),
            (b"RNGFND2_TYPE", 39.0),
            (b"RNGFND2_MIN_CM", 100.0),
            (b"RNGFND2_MAX_CM", 20000.0),
        )
    )

    def rows(i: int, t: int) -> list[tuple[Any, ...]]:
        slant = made.slant_m[i]
        laser = ("RFND", t, 0, slant, 4, 25) if slant < 50 else ("RFND", t, 0, 0.0, 3, 25)
        return [laser, ("RFND", t + 10, 1, made.clearance_m[i], 4, 25)]

    log = opened(file, plain(made, rows, ["RFND"], head))
    assert log.facts["altimeters"]["laser"]["limits_m"] == [0.2, 50.0]
    assert log.facts["altimeters"]["radar"]["limits_m"] == [1.0, 200.0]
    assert log.facts["altimeters"]["radar"]["covers"] == 1.0
    columns = log.recording.columns
    np.testing.assert_allclose(columns["radar_altitude_m"], made.clearance_m, atol=0.006)
    assert np.isfinite(columns["terrain_m"]).all()
    lasers = np.isfinite(columns["laser_altitude_m"])
    assert 0.3 < lasers.mean() < 0.6
    np.testing.assert_allclose(columns["terrain_sigma_m"][~lasers], np.hypot(5.0, 3.0))
    # no attitude is logged: the laser's slant range is taken for vertical, the radar's is to the nearest ground
    np.testing.assert_allclose(columns["terrain_m"][~lasers], made.ground_m[~lasers], atol=0.01)
    assert "attitude" in log.facts["missing"]


def test_the_rfnd_of_old_firmware_has_two_sensors_in_a_row(file: Path) -> None:
    pymavlink()
    made = flight(10.0)
    log = opened(file, plain(made, lambda i, t: [("RFN2", t, made.slant_m[i], 4, 25, 3.0, 4, 0)], ["RFN2"]))
    np.testing.assert_allclose(log.recording.columns["laser_altitude_m"], made.slant_m, atol=0.006)
    assert any("1 range finders do not look down" in line for line in log.remarks)


@pytest.mark.parametrize(
    ("kind", "column"), [(0, "laser_altitude_m"), (1, "radar_altitude_m"), (3, "radar_altitude_m")]
)
def test_px4_range_sensors_by_their_type(kind: int, column: str, file: Path) -> None:
    pytest.importorskip("pyulog", reason="needs the extra 'logs'")
    log = opened(file, ulog(flight(10.0), sensor=kind))
    assert column in log.recording.readings


def test_px4_without_a_global_position_uses_the_local_one(file: Path) -> None:
    pytest.importorskip("pyulog", reason="needs the extra 'logs'")
    made = flight(600.0)
    log = opened(file, ulog(made, without=("vehicle_gps_position", "vehicle_global_position")))
    assert log.facts["own_position"]["from"] == "vehicle_local_position"
    assert (
        np.hypot((made.lat_deg[-1] - made.lat_deg[0]) * 111195, (made.lon_deg[-1] - made.lon_deg[0]) * 75900) > 11_000
    )
    # PX4's own sphere is undone: over 12 km nothing is left but single precision
    assert log.facts["own_position"]["from_gnss_m"]["max"] < 0.01


def test_a_tlog_in_which_a_dataflash_log_was_streamed_is_a_tlog(file: Path) -> None:
    """REMOTE_LOG_DATA_BLOCK holds what a .BIN begins with; a damaged byte before it changes nothing."""
    dialect = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="needs the extra 'logs'")
    made = flight(10.0)
    plain_log, flash = tlog(made), dataflash(made)
    block = dialect.MAVLink_remote_log_data_block_message(255, 190, 0, flash[:200])
    streamed = plain_log[:8] + bytes(block.pack(dialect.MAVLink(None)))
    for content in (streamed + plain_log, b"?" + streamed + plain_log, plain_log[:200] + flash[:3000] + plain_log):
        file.write_bytes(content)
        assert format_of(file) == "tlog"
    assert opened(file, streamed + plain_log).facts["whole"]
    for content in (flash, b"?" + flash, flash[:3000] + plain_log):
        file.write_bytes(content)
        assert format_of(file) == "dataflash"


def test_several_vehicles_and_a_ground_station_in_one_tlog(file: Path) -> None:
    pymavlink()
    made = flight(20.0)
    mine, other = tlog(made), tlog(made.first(50), system=7)
    log = opened(file, mine + other + tlog(made, system=255))
    assert log.facts["vehicle"]["system_id"] == 1
    assert any("2 vehicles speak" in line for line in log.remarks)
    assert len(log.recording) == 200


def test_nmea_without_altitude_date_or_checksums(file: Path) -> None:
    pytest.importorskip("pynmeagps", reason="needs the extra 'logs'")
    made = flight(10.0, 1.0)
    lines = [line for line in nmea(made).splitlines(keepends=True) if b"RMC" in line or b"DPT" in line]
    log = opened(file, b"".join(lines))
    assert np.all(log.recording.alt_m == 0.0)
    assert "true_alt_m" not in log.recording.columns
    assert any("no altitude is logged" in line for line in log.remarks)
    bare = b"".join(line.split(b"*")[0] + b"\r\n" for line in nmea(made).splitlines() if b"RMC" not in line)
    log = opened(file, bare)
    assert "start_utc" not in log.facts
    assert any("times of day" in line for line in log.remarks)
    np.testing.assert_allclose(log.recording.columns["depth_m"], made.clearance_m + 1.5, atol=0.006)


def test_nmea_quality_and_checksum_are_heeded(file: Path) -> None:
    pytest.importorskip("pynmeagps", reason="needs the extra 'logs'")
    made = flight(10.0, 1.0)
    lines = nmea(made).splitlines(keepends=True)
    wrong = lines[0].replace(b"4700.000000", b"4800.000000")
    no_fix = sentence("GPGGA,000005.000,4700.000000,N,01100.000000,E,0,00,99.0,0.0,M,0.0,M,,")
    by_reckoning = sentence("GPGGA,000006.000,4700.000000,N,01100.000000,E,6,00,99.0,0.0,M,0.0,M,,")
    with pytest.warns(UserWarning, match="1 damaged"):
        log = opened(file, b"".join([wrong, *lines[1:], no_fix, by_reckoning]))
    assert len(log.recording) == 9
    assert abs(log.recording.lat_deg - 47.0).max() < 0.01


def test_nmea_attitude_depth_below_transducer_and_prefixed_lines(file: Path) -> None:
    pytest.importorskip("pynmeagps", reason="needs the extra 'logs'")
    out = []
    for i in range(20):
        clock = f"10{i:02d}00.00"
        out.append(b"2024-03-01T10:00:00Z,gps," + sentence(f"GNGGA,{clock},0000.1,S,17959.9,W,4,12,0.8,3.0,M,20,M,,"))
        out.append(sentence(f"PASHR,{clock}0,224.19,T,-01.26,+00.83,+00.00,0.101,0.113,0.267,1,0"))
        out.append(sentence(f"SDDBT,{328.0 + i:.1f},f,{100.0 + i:.1f},M,{54.0:.1f},F"))
    log = opened(file, b"".join(out))
    assert log.recording.columns["roll_deg"][3] == pytest.approx(-1.26)
    assert log.recording.columns["heading_deg"][3] == pytest.approx(224.19)
    np.testing.assert_allclose(log.recording.columns["depth_m"], 100.0 + np.arange(20))
    np.testing.assert_allclose(log.recording.lat_deg, -0.1 / 60, atol=1e-9)
    assert any("no depth of the transducer" in line for line in log.remarks)


def test_truth_is_drawn_across_the_date_line(file: Path) -> None:
    pymavlink()
    made = flight(20.0)
    over = replace(made, lon_deg=(made.lon_deg - 11.0 + 179.999 + 180) % 360 - 180)
    log = opened(file, tlog(over))
    assert (log.recording.lon_deg > 179).any()
    assert (log.recording.lon_deg < -179).any()
    assert np.abs(log.recording.ins_error_m()).max() < 0.03


def test_attitude_and_pressure_formulas() -> None:
    angles = [(10.0, -5.0, 350.0), (-170.0, 80.0, 123.0), (0.0, 0.0, 0.0)]
    made = attitude_deg(*np.array([quaternion(*three) for three in angles]).T)
    got = np.stack([made["roll_deg"], made["pitch_deg"], made["heading_deg"]], axis=1)
    np.testing.assert_allclose(got, angles, atol=1e-6)
    assert np.isnan(attitude_deg([0.0], [0.0], [0.0], [0.0])["roll_deg"]).all()
    # ICAO Doc 7488: 1013.25 hPa at 0 m, 898.746 hPa at 1000 m, 264.363 hPa at 10 km
    np.testing.assert_allclose(pressure_altitude_m([1013.25, 898.746, 264.363]), [0.0, 1000.0, 10000.0], atol=2.0)
    assert np.isnan(pressure_altitude_m([0.0, -5.0])).all()


def test_the_phone_drives(shared_data: Path) -> None:
    for name, epochs in (("2025-07-04_17-24-46", 6227), ("2025-07-11_13-33-16", 5961)):
        log = open_log(shared_data / "phone_drive" / f"{name}.csv")
        assert len(log.recording) == epochs
        assert log.facts["truth"]["known"] == 1.0
        assert set(log.facts["missing"]) == {"own", "attitude", "altimeter"}
        # the barometer alone holds the altitude: within 15 m of GNSS over 100 minutes
        away = log.recording.alt_m - log.recording.columns["true_alt_m"]
        assert np.median(np.abs(away)) < 15.0
        assert log.facts["seen_with_gnss"] == ["lat_deg", "lon_deg", "vn_mps", "ve_mps"]


def test_the_px4_sample(shared_data: Path) -> None:
    pytest.importorskip("pyulog", reason="needs the extra 'logs'")
    log = open_log(shared_data / "px4" / "pyulog_sample_log_small.ulg")
    assert len(log.recording) == 32
    assert log.facts["start_utc"].startswith("2021-04-21T06:30:58")
    assert log.facts["missing"] == ["own", "altimeter"]
    assert log.recording.lat_deg[0] == pytest.approx(63.4170622)
    assert log.recording.columns["true_alt_m"][0] == pytest.approx(66.814)
    assert any("0.03 s in all" in line for line in log.remarks)

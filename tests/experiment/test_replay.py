"""GNSS taken away from a log: when, from where, and that nothing of it is seen afterwards."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.replay_flight import WIND_MPS, Made, dataflash

import terranav as tn
from terranav.core.earth import metres_per_degree, offset_m, shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.recording import TRUTH, FloatArray, Recording
from terranav.experiment.replay import Denied, Withheld, as_log, on_ground, spaced, spans_of, take_off_s, withhold
from terranav.experiment.replay_ways import Flown, nautical_miles_an_hour, summed_up
from terranav.io.logs import Log, open_log


def opened(folder: Path, made: Made, *, imu: bool = False) -> Log:
    file = folder / "00000001.BIN"
    file.write_bytes(dataflash(made))
    return open_log(file, imu=imu)


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Six minutes whose autopilot had no GNSS, after half a minute at rest."""
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    return opened(tmp_path_factory.mktemp("blind"), Made(minutes=6.0, rest_s=30.0))


@pytest.fixture(scope="module")
def aided(tmp_path_factory: pytest.TempPathFactory) -> Log:
    """Two minutes whose autopilot used GNSS."""
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    return opened(tmp_path_factory.mktemp("aided"), Made(minutes=2.0, rest_s=30.0, uses_gnss=True))


def walk(n: int, speed_mps: float = 0.0, **more: FloatArray) -> Recording:
    time_s = 100.0 + np.arange(n, dtype=np.float64)
    lat, lon = shift(np.full(n, 45.0), np.full(n, 7.0), speed_mps * (time_s - 100.0), np.zeros(n))
    columns = {"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(n, 300.0)}
    return Recording({**columns, "terrain_m": np.full(n, 200.0), **more})


def away(denied: Denied) -> FloatArray:
    """(n,) distance of the indicated from the true position [m]."""
    return np.asarray(np.hypot(*denied.recording.ins_error_m().T))


def test_take_off_is_the_first_lasting_height_or_speed() -> None:
    height = np.full(200, 300.0)
    height[50:53] += 30.0  # a gust in the barometer
    height[80:] += 15.0
    assert take_off_s(walk(200, alt_m=height)) == 180.0
    assert take_off_s(walk(200)) is None
    assert take_off_s(walk(200, speed_mps=20.0)) == 100.0
    assert take_off_s(walk(200, speed_mps=5.0)) is None
    assert take_off_s(walk(200, speed_mps=5.0), on_ground=True) == 100.0


def test_take_off_of_a_log(blind: Log) -> None:
    start_s = take_off_s(blind.recording)
    assert start_s is not None
    assert abs(start_s - 30.0) < 1.0


def test_spans_count_from_the_start_of_the_log() -> None:
    rec = walk(200)
    assert spans_of(rec, 50.0)[0] == [(150.0, 299.0)]
    assert spans_of(rec, [(100, 500), (10, 40)])[0] == [(110.0, 140.0), (200.0, 299.0)]
    assert spans_of(rec, "auto")[0] == [(100.0, 299.0)]


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (195.0, "span of 10 s or more"),
        (1e6, "span of 10 s or more"),
        ([(40.0, 20.0)], "span of 10 s or more"),
        ([(10.0, 60.0), (50.0, 90.0)], "begins before the span before it ends, at 60 s"),
    ],
)
def test_spans_that_cannot_be_are_refused(asked: float | list[tuple[float, float]], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        spans_of(walk(200), asked)


def test_a_take_off_that_is_not_there_is_refused() -> None:
    with pytest.raises(DataError, match=r"no take-off.*expected --gnss-off with a time"):
        spans_of(walk(200), "take-off")


@pytest.mark.parametrize("by", ["velocity", "airspeed", "position"])
def test_nothing_of_gnss_is_seen_after_the_cut(blind: Log, by: str) -> None:
    """The law of a replay: other GNSS positions after the cut change nothing but the truth."""
    cut_s = 120.0
    rec = blind.recording
    later = rec.time_s > cut_s
    moved = {key: np.where(later, rec.columns[key] + 0.01, rec.columns[key]) for key in TRUTH}
    other = replace(blind, recording=rec.with_columns(**moved))
    first, second = (withhold(log, Withheld(cut_s, by))[0].recording for log in (blind, other))
    assert first.ins == second.ins
    for key, values in first.columns.items():
        if key not in TRUTH:
            np.testing.assert_array_equal(values, second.columns[key], err_msg=key)
    assert np.nanmax(np.abs(first.columns[TRUTH[0]] - second.columns[TRUTH[0]])) > 0.009


@pytest.mark.parametrize("by", ["velocity", "airspeed", "position"])
def test_it_starts_at_the_last_fix_and_drifts(blind: Log, by: str) -> None:
    denied = withhold(blind, Withheld(120.0, by))[0]
    error = away(denied)
    assert error[0] < 1e-6
    assert 10.0 < error[-1] < 400.0
    assert denied.start_s == pytest.approx(120.0, abs=0.2)
    assert denied.optimistic == (by == "airspeed" and "heading_deg" in blind.facts["seen_with_gnss"])


def test_velocity_summed_up_is_that_of_a_plain_loop() -> None:
    time_s = np.arange(0.0, 3600.0, 0.5)
    velocity = np.stack([60.0 * np.cos(time_s / 300.0), 40.0 + 20.0 * np.sin(time_s / 200.0)], axis=1)
    alt = np.full(time_s.size, 2000.0)
    lat, lon = summed_up(time_s, velocity, (60.0, 179.9), alt)
    north, east = 60.0, 179.9
    for k in range(time_s.size - 1):
        per_lat, per_lon = metres_per_degree(north)
        step = 0.25 * (velocity[k] + velocity[k + 1])
        east += step[1] / (per_lon * (1.0 + 2000.0 / 6.39e6))
        north += step[0] / (per_lat * (1.0 + 2000.0 / 6.39e6))
    assert abs(lat[-1] - north) * 111_000.0 < 2.0
    assert abs((lon[-1] - east + 180.0) % 360.0 - 180.0) * 55_000.0 < 2.0


def test_the_wind_is_that_before_the_cut(blind: Log) -> None:
    seen = withhold(blind, Withheld(240.0, "airspeed"))[0]
    told = next(text for text in seen.remarks if text.startswith("wind before the cut"))
    speed, comes_from = float(told.split()[4]), float(told.split()[7])
    assert abs(speed - np.hypot(*WIND_MPS)) < 1.0
    expected = np.degrees(np.arctan2(-WIND_MPS[1], -WIND_MPS[0])) % 360.0
    assert abs((comes_from - expected + 180.0) % 360.0 - 180.0) < 15.0
    calm = withhold(blind, Withheld(30.0, "airspeed"))[0]
    assert any("no wind was seen" in text for text in calm.remarks)
    assert calm.recording.ins is not None
    assert calm.recording.ins.velocity_sigma_mps == 5.0
    assert away(calm)[-1] > 3.0 * away(seen)[-1]


def test_the_most_honest_way_is_taken(blind: Log, aided: Log) -> None:
    assert withhold(blind, Withheld())[0].by.name == "position"
    flattering = withhold(aided, Withheld(by="velocity"))[0]
    assert flattering.optimistic
    assert set(flattering.seen_with_gnss) == {"vn_mps", "ve_mps"}
    assert withhold(aided, Withheld())[0].by.name == "airspeed"
    still = replace(aided, beside={})
    assert withhold(still, Withheld())[0].by.name == "velocity"
    drifting = withhold(aided, Withheld(flown=Flown(nautical_miles_an_hour(1.0), 3)))[0]
    assert drifting.by.name == "drift"
    assert not drifting.optimistic


def test_a_drift_is_that_of_its_seed_and_keeps_the_gaps_of_the_truth(aided: Log) -> None:
    rec = aided.recording
    known = ~((rec.time_s > 60.0) & (rec.time_s < 63.0))
    gaps = {key: np.where(known, rec.columns[key], np.nan) for key in TRUTH}
    log = replace(aided, recording=rec.with_columns(**gaps))
    flights = [withhold(log, Withheld(40.0, flown=Flown(tn.InsGrade(5.0, 2.0), seed)))[0] for seed in (1, 1, 2)]
    tracks = [flight.recording.lat_deg for flight in flights]
    np.testing.assert_array_equal(tracks[0], tracks[1])
    assert np.abs(tracks[0] - tracks[2]).max() > 1e-5
    error = away(flights[0])
    assert np.isnan(error).sum() == np.count_nonzero(~known)
    assert np.isfinite(flights[0].recording.lat_deg).all()
    assert np.nanmax(np.abs(np.diff(error))) < 5.0  # bridged, no jump


def test_the_last_fix_may_be_old(blind: Log) -> None:
    rec = blind.recording
    lost = (rec.time_s > 90.0) & (rec.time_s < 130.0)
    gaps = {key: np.where(lost, np.nan, rec.columns[key]) for key in TRUTH}
    denied = withhold(replace(blind, recording=rec.with_columns(**gaps)), Withheld(120.0, "velocity"))[0]
    assert denied.start_s == pytest.approx(90.0, abs=0.3)
    assert any("older than the start of the span" in text for text in denied.remarks)


def test_inertial_sensors_are_calibrated_and_integrated(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    unit = tn.InsGrade(5.0, 0.0, 0.0, gyro_bias_sigma_deg_per_h=100.0, accel_bias_sigma_ug=5000.0)
    log = opened(tmp_path, Made(minutes=1.8, rest_s=0.0, imu=unit, uses_gnss=True), imu=True)
    known, unknown = (withhold(log, Withheld(cut_s, "imu"))[0] for cut_s in (50.0, 0.0))
    assert any("biases taken out" in text for text in known.remarks)
    assert any("could not be calibrated" in text for text in unknown.remarks)
    at = int(np.searchsorted(unknown.recording.time_s, 57.5))  # as long after its cut
    assert away(known)[-1] < 40.0
    assert away(unknown)[at] > 2.0 * away(known)[-1]
    assert known.recording.ins is not None
    assert known.recording.ins.has_schuler_loop


def test_ways_say_what_they_lack(blind: Log) -> None:
    with pytest.raises(DataError, match="no inertial sensors are logged"):
        withhold(blind, Withheld(by="imu"))
    with pytest.raises(DataError, match="no airspeed is logged"):
        withhold(replace(blind, beside={}), Withheld(by="airspeed"))
    bare = {key: values for key, values in blind.recording.columns.items() if not key.startswith("v")}
    with pytest.raises(DataError, match="no velocity is logged"):
        withhold(replace(blind, recording=replace(blind.recording, columns=bare)), Withheld(by="velocity"))
    with pytest.raises(ConfigError, match="--by is 'magic', expected velocity, airspeed"):
        withhold(blind, Withheld(by="magic"))
    only_gnss = replace(blind, facts={**blind.facts, "own_position": {"used_gnss": None}})
    with pytest.raises(DataError, match="own position is not logged"):
        withhold(only_gnss, Withheld(by="position"))


def test_a_log_without_truth_flies_from_its_own_position(blind: Log) -> None:
    rec = blind.recording
    bare = replace(rec, columns={key: values for key, values in rec.columns.items() if key not in TRUTH})
    denied = withhold(replace(blind, recording=bare), Withheld(120.0, "velocity"))[0]
    assert not denied.recording.has_truth
    assert any("there is no score" in text for text in denied.remarks)
    row = int(np.searchsorted(rec.time_s, 120.0))
    assert denied.recording.lat_deg[0] == rec.lat_deg[row]


def test_a_barometer_on_wheels_tells_the_ground() -> None:
    rec = walk(60, speed_mps=15.0, baro_altitude_m=np.linspace(300.0, 330.0, 60))
    wheels = on_ground(rec, 1.5)
    np.testing.assert_allclose(wheels.columns["terrain_m"], np.linspace(298.5, 328.5, 60))
    with pytest.raises(DataError, match="no barometer is logged"):
        on_ground(walk(60), 1.5)


def test_a_log_that_measured_nothing_is_refused() -> None:
    rec = walk(60, speed_mps=15.0, baro_altitude_m=np.full(60, 300.0))
    bare = replace(rec, columns={key: values for key, values in rec.columns.items() if key != "terrain_m"})
    with pytest.raises(DataError, match=r"nothing in it measured the ground below.*--ground-vehicle"):
        withhold(as_log(bare), Withheld())
    assert withhold(as_log(bare), Withheld(on_ground_m=1.0))[0].recording.readings[0] == "terrain_m"


def test_readings_are_used_once_it_has_moved() -> None:
    rec = walk(60, speed_mps=10.0)
    denied = withhold(as_log(rec), Withheld())[0]
    used = np.flatnonzero(np.isfinite(spaced(denied, 35.0).recording.columns["terrain_m"]))
    np.testing.assert_array_equal(used, np.arange(0, 60, 4))
    assert spaced(denied, 0.0) is denied
    still = withhold(as_log(walk(100)), Withheld())[0]
    slow = np.flatnonzero(np.isfinite(spaced(still, 35.0).recording.columns["terrain_m"]))
    np.testing.assert_array_equal(slow, [0, 30, 60, 90])


def test_a_recording_whose_position_is_true_gets_a_drift() -> None:
    rec = walk(60, speed_mps=10.0)
    truth = dict(zip(TRUTH, (rec.lat_deg, rec.lon_deg, rec.alt_m), strict=True))
    assert withhold(as_log(rec.with_columns(**truth)), Withheld())[0].by.name == "drift"
    ins_lat, ins_lon = shift(rec.lat_deg, rec.lon_deg, np.linspace(300.0, 400.0, 60), np.zeros(60))
    given = withhold(as_log(rec.with_columns(**truth, lat_deg=ins_lat, lon_deg=ins_lon)), Withheld())[0]
    assert given.by.name == "position"
    error = given.recording.ins_error_m()
    np.testing.assert_allclose(error[:, 0], np.linspace(0.0, 100.0, 60), atol=0.1)


def test_offsets_agree_with_the_earth() -> None:
    """What the tests above lean on: a shift and its offset."""
    lat, lon = shift(45.0, 7.0, 30.0, 40.0)
    assert np.hypot(*offset_m(45.0, 7.0, lat, lon)) == pytest.approx(50.0, abs=1e-6)

"""Clocks that wrap, restart, jump or lie; seen through the readers and by themselves."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.io.logs import open_log
from terranav.io.logs.clocks import median_around, one_run, utc_of_gps
from terranav.io.logs.found import Series, series
from tests.io.logs.flights import dataflash, flight, fmt, message, tlog


def line(times: list[float], role: str = "own", order: list[int] | None = None) -> Series:
    n = len(times)
    return series(role, "test", times, {"lat_deg": np.arange(n), "lon_deg": np.arange(n), "alt_m": np.zeros(n)}, order)


def test_a_counter_that_starts_again_is_carried_on() -> None:
    times = (np.arange(100) * 0.1 + 4294967.296 - 5.0) % 4294967.296
    parts, told = one_run([line(times.tolist())], 4294967.296)
    np.testing.assert_allclose(np.diff(parts[0].time_s), 0.1, atol=1e-6)
    assert len(parts[0]) == 100
    assert "carried on" in told[0]


def test_the_longest_run_is_kept_when_the_clock_restarts() -> None:
    first, second = np.arange(30) * 1.0, np.arange(80) * 1.0
    parts, told = one_run([line([*first, *second])], None)
    assert len(parts[0]) == 80
    np.testing.assert_array_equal(parts[0].values["lat_deg"], np.arange(30, 110))
    assert "30 rows of others were left out" in told[0]


def test_a_restart_is_told_from_the_order_across_series() -> None:
    positions = line([*range(20), *range(50)], order=list(range(0, 140, 2)))
    readings = series("baro", "b", [*range(20), *range(50)], {"altitude_m": np.arange(70)}, list(range(1, 141, 2)))
    parts, _ = one_run([positions, readings], None)
    np.testing.assert_array_equal(parts[1].values["altitude_m"], np.arange(20, 70))


def test_late_rows_and_repeated_stamps_are_no_restart() -> None:
    parts, told = one_run([line([0, 1, 2, 4, 3, 5, 5, 6, 7, 8])], None)
    np.testing.assert_array_equal(parts[0].time_s, np.arange(9.0))
    assert told == []


def test_wild_stamps_are_left_out_and_gaps_are_not() -> None:
    times = [*np.arange(20) * 0.1, 1e9, *np.arange(20, 40) * 0.1, *np.arange(10) * 0.1 + 60.0]
    parts, told = one_run([line(times)], None)
    assert len(parts[0]) == 50
    assert "1 rows" in told[0]


def test_a_slow_clock_is_not_wild() -> None:
    parts, told = one_run([line([60.0 * i for i in range(40)])], None)
    assert len(parts[0]) == 40
    assert told == []


@given(st.lists(st.floats(-1e9, 1e9), min_size=0, max_size=60), st.sampled_from([None, 86400.0, 4294967.296]))
def test_any_clock_ends_up_rising(times: list[float], wrap_s: float | None) -> None:
    parts, _ = one_run([line(times)], wrap_s)
    for part in parts:
        assert (np.diff(part.time_s) > 0).all()
        assert len(part) >= 1


@given(st.lists(st.floats(-1e6, 1e6), min_size=7, max_size=50))
def test_the_median_around_is_numpys(values: list[float]) -> None:
    array = np.array(values)
    around = median_around(array)
    for i in range(3, len(values) - 3):
        assert around[i] == np.median(array[i - 3 : i + 4])
    np.testing.assert_array_equal(median_around(np.arange(20.0)), np.arange(20.0))


def test_utc_of_gps_weeks() -> None:
    # GPS week 2086 began on 29 December 2019; 18 leap seconds
    instant, rolled = utc_of_gps(2086, 345_618.0)
    assert (instant, rolled) == (datetime(2020, 1, 2, tzinfo=UTC), False)
    # 15 leap seconds in 2010 (week 1564: 27 December 2009)
    assert utc_of_gps(1564, 15.0) == (datetime(2009, 12, 27, tzinfo=UTC), False)
    # a receiver whose counter holds 1024 weeks says 38 for 2086
    assert utc_of_gps(2086 - 2048, 345_618.0) == (datetime(2020, 1, 2, tzinfo=UTC), True)


def test_a_rolled_over_gps_week_is_said(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    file = tmp_path / "f.bin"
    file.write_bytes(dataflash(flight(20.0), week=2300 - 1024))
    log = open_log(file)
    file.write_bytes(dataflash(flight(20.0), week=2300))
    assert log.facts["start_utc"] == open_log(file).facts["start_utc"]
    assert any("GPS week 1276 has rolled over" in line for line in log.remarks)


def test_mavlinks_boot_clock_wraps(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    file = tmp_path / "f.tlog"
    file.write_bytes(tlog(flight(30.0), start_ms=2**32 - 10_000))
    log = open_log(file)
    assert len(log.recording) == 300
    np.testing.assert_allclose(np.diff(log.recording.time_s), 0.1, atol=1e-6)
    assert any("carried on" in line for line in log.remarks)
    assert log.facts["truth"]["known"] == 1.0


@pytest.mark.parametrize("kind", ["dataflash", "tlog"])
def test_a_reboot_in_one_log_leaves_the_longer_flight(kind: str, tmp_path: Path) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    short, long = flight(20.0), flight(40.0)
    file = tmp_path / "f"
    writer = dataflash if kind == "dataflash" else tlog
    file.write_bytes(writer(short) + writer(long))
    log = open_log(file)
    assert len(log.recording) in (399, 400)
    assert any("the clock steps 1 times" in line for line in log.remarks)


def test_gaps_are_told_and_nothing_is_drawn_over_them(tmp_path: Path) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    made = flight(60.0)
    head = [fmt(name) for name in ("POS", "GPS")]
    rows = []
    for i, t in enumerate((5e6 + made.time_s * 1e6).astype(int).tolist()):
        lat, lon, alt = made.lat_deg[i], made.lon_deg[i], made.alt_m[i]
        rows.append(message("POS", t, lat, lon, alt, 0.0, 0.0))
        if not 200 <= i < 300:  # no fix for ten seconds
            status = 3 if i < 500 else 1
            rows.append(message("GPS", t, 0, status, t // 1000, 2300, 9, 1.0, lat, lon, alt, 20.0, 45.0, 0.0, 0.0, 1))
    file = tmp_path / "f.bin"
    file.write_bytes(b"".join([*head, *rows]))
    log = open_log(file)
    true = np.isfinite(log.recording.columns["true_lat_deg"])
    assert not true[200:300].any()
    assert not true[501:].any()
    assert true[:200].all()
    assert log.facts["series"]["gnss"]["gaps"] == 1
    assert log.facts["series"]["gnss"]["longest_gap_s"] == pytest.approx(10.1, abs=0.01)
    assert log.facts["truth"]["longest_s"] == pytest.approx([0.0, 19.9])
    assert any("recording.between" in line for line in log.remarks)
    assert any("gaps: 1, the longest 10.1 s" in line for line in log.remarks)
    rec = log.recording.between(*log.facts["truth"]["longest_s"])
    assert np.isfinite(rec.ins_error_m()).all()


@pytest.mark.parametrize("unix", [False, True], ids=["counts from start-up", "is a date"])
def test_a_receiver_is_timed_by_its_own_stamp_where_a_link_delivers_in_bursts(tmp_path: Path, unix: bool) -> None:
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="needs the extra 'logs'")
    link, made, data = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), flight(60.0), b""
    host_us = 1_700_000_000_000_000
    for i, t in enumerate(made.time_s.tolist()):
        us, lat, lon = 5_000_000 + round(t * 1e6), round(made.lat_deg[i] * 1e7), round(made.lon_deg[i] * 1e7)
        own = mavlink.MAVLink_global_position_int_message(us // 1000, lat, lon, 500_000, 0, 0, 0, 0, 0)
        stamp = host_us + us if unix else us
        gnss = mavlink.MAVLink_gps_raw_int_message(stamp, 3, lat, lon, 500_000, 80, 80, 2000, 4500, 14)
        arrives = host_us + 700_000 * (us // 700_000 + 1)
        data += b"".join(arrives.to_bytes(8, "big") + one.pack(link) for one in (own, gnss))
    path = tmp_path / "bursts.tlog"
    path.write_bytes(data)
    rec = open_log(path).recording
    late = (rec.columns["lat_deg"] - rec.columns["true_lat_deg"])[10:-10]
    step = np.diff(made.lat_deg)[0]
    if unix:  # a date is not the vehicle's clock: what came late seems late
        assert np.abs(late).max() > 2 * step
    else:
        assert np.abs(late).max() < 0.01 * step

"""Logs that are cut, damaged, of another kind or empty: what is whole is read and the rest is said, or one line."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from terranav.core.errors import ConfigError, DataError, DataWarning, TerranavError
from terranav.io.logs import Log, open_log
from tests.io.logs.bags import write_bag
from tests.io.logs.flights import dataflash, flight, nmea, tlog, ulog

LIBRARY = {"dataflash": "pymavlink", "tlog": "pymavlink", "ulog": "pyulog", "nmea": "pynmeagps"}
WRITERS: dict[str, Callable[..., bytes]] = {"dataflash": dataflash, "tlog": tlog, "ulog": ulog, "nmea": nmea}
PHONE = b"time,speed,bearing,altitude,longitude,latitude,pressure\n"


def phone() -> bytes:
    made = flight(30.0, 1.0)
    rows = zip(made.time_s, made.alt_m, made.lon_deg, made.lat_deg, strict=True)
    lines = [f"2025-07-11 13:33:{16 + t:02.0f}+00:00,20.0,45.0,{a},{lo},{la},960.5\n" for t, a, lo, la in rows]
    return PHONE + "".join(lines).encode()


def content(kind: str) -> bytes:
    if kind == "phone":
        return phone()
    pytest.importorskip(LIBRARY[kind], reason="needs the extra 'logs'")
    return WRITERS[kind](flight(20.0))


@pytest.fixture(scope="module", params=[*WRITERS, "phone"])
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def good(kind: str) -> bytes:
    return content(kind)


def quietly(path: Path) -> Log:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return open_log(path)


def test_a_log_cut_in_the_middle_is_read_up_to_there(good: bytes, kind: str, tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    whole.write_bytes(good)
    cut.write_bytes(good[: int(len(good) * 0.6) + 3])
    full = open_log(whole).recording
    if kind == "phone":  # a table may well end without a line's end
        log = open_log(cut)
    else:
        with pytest.warns(DataWarning, match=r"cut|damaged"):
            log = open_log(cut)
        assert log.facts["whole"] is False
    assert "cut" in log.remarks[0] or "damaged" in log.remarks[0]
    n = len(log.recording)
    assert 0.4 * len(full) < n < 0.75 * len(full)
    np.testing.assert_array_equal(log.recording.lat_deg, full.lat_deg[:n])


def test_damage_in_the_middle_costs_little(good: bytes, kind: str, tmp_path: Path) -> None:
    harmed = bytearray(good)
    middle = len(good) // 2
    harmed[middle : middle + 200] = bytes(np.random.default_rng(3).integers(1, 256, 200, dtype=np.uint8))
    file = tmp_path / "harmed"
    (tmp_path / "whole").write_bytes(good)
    full = open_log(tmp_path / "whole").recording
    file.write_bytes(harmed)
    log = quietly(file)
    assert log.facts["whole"] is False
    assert any("damaged" in line or "left out" in line or "cut" in line for line in log.remarks)
    shared = np.isin(full.time_s.round(3), log.recording.time_s.round(3))
    # pyulog trusts a damaged length: up to 64 kB are lost with it, and this log has no more
    assert shared.mean() > {"phone": 0.75, "ulog": 0.4}.get(kind, 0.85)
    assert np.abs(log.recording.ins_error_m()).max() < 1.0


def test_zeros_after_the_log_are_not_read(good: bytes, kind: str, tmp_path: Path) -> None:
    if kind == "phone":
        pytest.skip("a phone's CSV is text, read line by line")
    file = tmp_path / "padded"
    with file.open("wb") as stream:
        stream.write(good)
        stream.truncate(len(good) + (64 << 20))
    log = quietly(file)
    file.write_bytes(good)
    assert len(log.recording) >= len(open_log(file).recording) - 1
    assert any("zero" in line or "cut" in line for line in log.remarks)


def test_zeros_within_the_log_are_passed_over(tmp_path: Path, kind: str, good: bytes) -> None:
    if kind == "phone":
        pytest.skip("a phone's CSV is text, read line by line")
    middle = len(good) // 2
    file = tmp_path / "holed"
    file.write_bytes(good[:middle] + bytes(300_000) + good[middle:])
    log = quietly(file)
    assert len(log.recording) > 90


@pytest.mark.parametrize(
    ("bytes_of_it", "told"),
    [
        (b"", "the file is empty"),
        (bytes(4096), "begins with only zeros"),
        (b"hello world, this is a text\n" * 10, "begins with b'hello wo'"),
        (b"time,a,b\n1,2,3\n", "terranav convert"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "expected a log"),
        (b"FMT, 128, 89, FMT, BBnNZ, Type,Length\n", "DataFlash log as text"),
        (np.random.default_rng(1).integers(0, 256, 5000, dtype=np.uint8).tobytes(), "expected a log"),
    ],
)
def test_other_files_are_refused_in_one_line(bytes_of_it: bytes, told: str, tmp_path: Path) -> None:
    file = tmp_path / "x.BIN"
    file.write_bytes(bytes_of_it)
    with pytest.raises(DataError, match=r"x\.BIN") as caught:
        open_log(file)
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_gigabytes_of_zeros_are_refused_at_once(tmp_path: Path) -> None:
    file = tmp_path / "zeros.tlog"
    with file.open("wb") as stream:
        stream.truncate(3 << 30)
    with pytest.raises(DataError, match="only zeros"):
        open_log(file)


def test_a_missing_file_a_plain_folder_and_a_bad_rate(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file"):
        open_log(tmp_path / "none.BIN")
    with pytest.raises(DataError, match="folder without metadata"):
        open_log(tmp_path)
    with pytest.raises(ConfigError, match="rate_hz is 0"):
        open_log(tmp_path, rate_hz=0)


@pytest.mark.parametrize(
    "head", [b"\x55\x4c\x6f\x67\x01\x12\x35\x01", b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"]
)
def test_a_head_and_then_noise_is_one_line(head: bytes, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra 'logs'")
    pytest.importorskip("pyulog", reason="needs the extra 'logs'")
    file = tmp_path / "noise"
    for seed in range(20):
        file.write_bytes(head + np.random.default_rng(seed).integers(0, 256, 3000, dtype=np.uint8).tobytes())
        with pytest.raises(DataError, match="noise") as caught:
            quietly(file)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind_of_bag", [".bag", "mcap", "sqlite3"])
def test_cut_bags(kind_of_bag: str, tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra 'logs'")
    made = flight(240.0)
    file = write_bag(tmp_path / ("f.bag" if kind_of_bag == ".bag" else "f"), made, kind_of_bag)
    full, data = open_log(file).recording, file.read_bytes()
    cut = tmp_path / "cut"
    cut.write_bytes(data[: int(0.7 * len(data))])
    if kind_of_bag == "sqlite3":
        with pytest.raises(DataError, match="damaged ROS bag"):
            open_log(cut)
        return
    with pytest.warns(DataWarning, match="cut"):
        log = open_log(cut)
    n = len(log.recording)
    assert 0.25 * len(full) < n < 0.75 * len(full)
    np.testing.assert_array_equal(log.recording.lat_deg, full.lat_deg[:n])
    cut.write_bytes(data[:1000])
    with pytest.raises(DataError, match="cut"):
        quietly(cut)


def test_a_bag_that_was_never_closed_is_read(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs the extra 'logs'")
    file = write_bag(tmp_path / "f.bag", flight(20.0), ".bag")
    data = bytearray(file.read_bytes())
    full = open_log(file).recording
    place = data.find(b"index_pos=") + 10
    end = int.from_bytes(data[place : place + 8], "little")
    data[place : place + 8] = bytes(8)
    file.write_bytes(data[:end])
    with pytest.warns(DataWarning, match="last 0 bytes"):
        log = open_log(file)
    np.testing.assert_array_equal(log.recording.lon_deg, full.lon_deg)


@pytest.mark.parametrize("name", [*WRITERS, "bag"])
def test_without_the_library_one_line_says_what_to_install(name: str, tmp_path: Path) -> None:
    heads = {
        "dataflash": b"\xa3\x95\x80\x80\x59FMT\0" + bytes(range(1, 100)),
        "tlog": (1_700_000_000_000_000).to_bytes(8, "big") + b"\xfd\x01" + bytes(11),
        "ulog": b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + bytes(20) + b"x",
        "nmea": b"$GPGGA,1,2,3*00\r\n",
        "bag": b"#ROSBAG V2.0\n" + bytes(20),
    }
    file = tmp_path / "log"
    file.write_bytes(heads[name])
    script = f"""
        import sys
        for name in ("pymavlink", "pyulog", "rosbags", "pynmeagps"):
            sys.modules[name] = None
        from terranav.core.errors import ConfigError
        from terranav.io.logs import open_log
        try:
            open_log({str(file)!r})
        except ConfigError as problem:
            print(problem)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True)
    assert done.stdout.count("\n") == 1
    assert "not installed: pip install terranav[logs]" in done.stdout


def outcome(path: Path) -> tuple[Log | None, str]:
    """The log, or what the error says; any other exception is a failure."""
    try:
        return quietly(path), ""
    except TerranavError as problem:
        return None, str(problem)


HARM = st.lists(st.tuples(st.integers(0, 10**6), st.binary(min_size=1, max_size=40)), min_size=1, max_size=4)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(harm=HARM, cut=st.floats(0.02, 1.0))
def test_any_damage_gives_a_recording_or_one_line(
    good: bytes, kind: str, tmp_path_factory: pytest.TempPathFactory, harm: list[tuple[int, bytes]], cut: float
) -> None:
    harmed = bytearray(good)
    for place, noise in harm:
        at = place % len(harmed)
        harmed[at : at + len(noise)] = noise
    file = tmp_path_factory.mktemp("fuzz") / "log"
    file.write_bytes(harmed[: max(1, int(cut * len(harmed)))])
    log, problem = outcome(file)
    if log is None:
        assert str(file) in problem
        assert "\n" not in problem
        return
    assert len(log.recording) >= 1
    assert set(log.facts) >= {"series", "truth", "own_position", "missing", "whole"}


@settings(max_examples=40, deadline=None)
@given(harm=HARM, cut=st.floats(0.02, 1.0), which=st.sampled_from([".bag", "mcap", "sqlite3"]))
def test_any_damage_to_a_bag_gives_a_recording_or_one_line(
    bags: dict[str, bytes],
    tmp_path_factory: pytest.TempPathFactory,
    harm: list[tuple[int, bytes]],
    cut: float,
    which: str,
) -> None:
    test_any_damage = test_any_damage_gives_a_recording_or_one_line.hypothesis.inner_test  # type: ignore[attr-defined]
    test_any_damage(bags[which], which, tmp_path_factory, harm, cut)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    pytest.importorskip("rosbags", reason="needs the extra 'logs'")
    folder = tmp_path_factory.mktemp("bags")
    names = {".bag": "f.bag", "mcap": "m", "sqlite3": "s"}
    return {kind: write_bag(folder / name, flight(20.0), kind).read_bytes() for kind, name in names.items()}

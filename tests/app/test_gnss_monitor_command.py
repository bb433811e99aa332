"""`terranav monitor`: one line of verdict, the alarms, and one line for every wrong use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from benchmarks.replay_flight import Made, dataflash

import terranav as tn
from terranav.app.cli import main
from terranav.io.raster_out import write_map
from tests.app.conftest import Flight

FEW = ("--drift", "300,0.5,1", "--drift-seed", "2")


def answered(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert main(["monitor", *arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_an_honest_recording_raises_no_alarm(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["monitor", *flight.arguments, *FEW]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "no alarm in 4 min: GNSS consistent" in said
    assert "set for 0.001 false alarms per flight hour" in said
    told = answered(capsys, *flight.arguments, *FEW)
    assert told["alarms"] == []
    assert told["pull"] is None
    assert told["shares"]["spoofed"] == told["shares"]["jammed"] == 0.0
    assert sum(told["shares"].values()) == pytest.approx(1.0)
    assert answered(capsys, *flight.arguments, *FEW) == told  # the same bits


def test_a_pull_is_flagged_and_drawn(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new"
    pull = ("--pull", "5", "--pull-at", "120", "--pull-towards", "180")
    told = answered(capsys, *flight.arguments, *FEW, *pull, "--out", str(out))
    assert told["pull"]["flagged"] is True
    assert 0.0 < told["pull"]["off_m"] == pytest.approx(5.0 * told["pull"]["flagged_after_s"])
    assert told["pull"]["off_m"] < 300.0
    assert [alarm["status"] for alarm in told["alarms"]] == ["spoofed"]
    assert told["alarms"][0]["from_s"] == 120.0 + told["pull"]["flagged_after_s"]
    assert told["alarms"][0]["to_s"] is None
    assert told["status"] == "spoofed"
    assert (out / "monitor.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((out / "monitor.json").read_text())["alarms"] == told["alarms"]
    assert main(["monitor", *flight.arguments, *FEW, *pull]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "GNSS pulled away at 5 m/s from 2 min 00 s on: flagged after" in said
    assert "spoofed" in said


def test_a_pull_too_small_to_see_is_said(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    told = answered(capsys, *flight.arguments, *FEW, "--pull", "0.02", "--pull-at", "100")
    assert told["pull"]["flagged"] is False
    assert "not flagged, 2.8 m off at the end" in told["verdict"]


def test_a_log_is_navigated_without_gnss(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pymavlink", reason="needs the extra 'logs'")
    write_map(tn.sample_map(), tmp_path / "dem.tif")
    (tmp_path / "aided.BIN").write_bytes(dataflash(Made(minutes=2.0, rest_s=30.0, uses_gnss=True)))
    log = (str(tmp_path / "aided.BIN"), "--map", str(tmp_path / "dem.tif"))
    assert main(["monitor", *log, "--first", "40"]) == 0
    shown = capsys.readouterr()
    assert "GNSS went into" in shown.err  # an autopilot that follows GNSS is no witness against it
    told = answered(capsys, *log, *FEW, "--first", "60", "--pull", "20")
    assert told["ins"] == "its true track and the drift of a stated INS"
    assert told["pull"]["flagged"] is True


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--pull", "-1"), "--pull is -1.0"),
        (("--pull", "2", "--pull-at", "1e6"), "--pull-at is 1000000.0"),
        (("--rate", "0"), "false_alarms_per_h is 0.0"),
        (("--gnss-sigma", "0"), "--gnss-sigma is 0.0"),
        (("--drift", "fast"), "--drift is 'fast'"),
        (("--estimator", "marginal"), "unknown estimator 'marginal'"),
        (("--by", "velocity"), "--by velocity is given for a recording"),
        (("--ground-vehicle",), "--ground-vehicle is given for a recording"),
        (("--first", "-3"), "--first is -3.0"),
    ],
)
def test_wrong_use_is_one_line(
    flight: Flight, more: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["monitor", *flight.arguments, *more]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if "warning" not in line]
    assert len(errors) == 1
    assert message in errors[0]


def test_wrong_files_are_one_line(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "zeros.BIN"
    empty.write_bytes(bytes(5000))
    for arguments, message in [
        ([], "LOG and --recording are not given"),
        ([str(flight.recording), "--recording", str(flight.recording)], "LOG and --recording are both given"),
        (["--recording", str(flight.no_truth), *flight.map_arguments], "has no GNSS to monitor"),
        (["--recording", str(tmp_path / "none.csv"), *flight.map_arguments], "none.csv"),
        ([str(empty), *flight.map_arguments], "only zeros"),
        (["--recording", str(flight.recording)], "no map is given"),
    ]:
        assert main(["monitor", *arguments]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert message in lines[0]

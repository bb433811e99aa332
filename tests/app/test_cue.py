"""`terranav cue`: what it prints, and one line for every wrong use."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.app.cli import main
from terranav.io.recordings import read_recording, write_recording
from tests.app.conftest import Flight


def answered(capsys: pytest.CaptureFixture[str], flight: Flight, *more: str) -> Any:
    assert main(["cue", *flight.arguments, "--json", *more]) == 0
    return json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_high_above_the_hills_is_clear(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    told = answered(capsys, flight, "--margin", "50", "--lookahead", "20", "--at", "100")
    assert told["cue"]["time_s"] == 100.0
    assert told["cue"]["state"] == "clear"
    assert told["cue"]["time_to_s"] is None
    assert told["cue"]["left_deg"] == told["cue"]["climb_mps"] == 0.0
    assert told["settings"]["margin_m"] == 50.0


def test_a_large_margin_warns(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    """No ground lies within 1500 m below 1500 m but the sea, so every epoch warns at once."""
    told = answered(capsys, flight, "--margin", "1500", "--lookahead", "20")
    assert [span["state"] for span in told["timeline"]] == ["warning"]
    assert told["timeline"][0]["nearest_s"] == 0.0
    assert told["cue"]["time_to_s"] == 0.0
    assert told["cue"]["climb_mps"] is None


def test_the_end_of_the_map_is_not_clear(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    told = answered(capsys, flight, "--margin", "50", "--lookahead", "300")
    assert told["cue"]["state"] == "unknown"
    assert 0.0 < told["cue"]["unknown_from_s"] < 300.0
    assert told["cue"]["probability"][-1] is None
    assert {span["state"] for span in told["timeline"]} <= {"clear", "unknown", "warning"}


def test_timeline_covers_the_flight(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    told = answered(capsys, flight, "--margin", "600", "--lookahead", "30")
    rec = read_recording(flight.recording)
    spans = told["timeline"]
    assert spans[0]["from_s"] == rec.time_s[0]
    assert spans[-1]["to_s"] == rec.time_s[-1]
    assert all(one["to_s"] < other["from_s"] for one, other in pairwise(spans))
    assert all(one["state"] != other["state"] for one, other in pairwise(spans))


def test_the_table_for_people(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cue", *flight.arguments, "--margin", "600", "--lookahead", "30", "--estimator", "ins"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "too near" in out
    assert "turn" in out
    assert "nan" not in out


def test_told_velocity_comes_before_differences(
    flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A recording that says it dives: the ground comes near at the told rate."""
    rec = read_recording(flight.recording)
    diving = rec.with_columns(vn_mps=np.zeros(len(rec)), ve_mps=np.zeros(len(rec)), vd_mps=np.full(len(rec), 20.0))
    write_recording(diving, tmp_path / "dive.csv")
    arguments = ["--recording", str(tmp_path / "dive.csv"), *flight.map_arguments]
    assert main(["cue", *arguments, "--json", "--margin", "0", "--lookahead", "80"]) == 0
    found = json.loads(capsys.readouterr().out)["cue"]
    assert found["state"] == "warning"
    assert 20.0 < found["time_to_s"] < 75.0


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--margin", "-1"], "margin_m is -1.0"),
        (["--lookahead", "0"], "lookahead_s"),
        (["--threshold", "2"], "threshold"),
        (["--altitude-sigma", "-3"], "altitude_sigma_m"),
        (["--bank", "95"], "bank_deg"),
        (["--at", "1e6"], "--at is 1000000.0"),
        (["--at", "nan"], "--at"),
        (["--estimator", "pointmas"], "did you mean 'pointmass'"),
        (["--map-kind", "gravity", "--map-unit", "mGal"], "expected one of terrain or bathymetry"),
        (["--margn", "3"], "did you mean --margin"),
    ],
)
def test_wrong_use_is_one_line(more: list[str], words: str, flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cue", *flight.arguments, *more]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err.splitlines()[-1]


def test_one_epoch_without_velocity(tmp_path: Path, flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    rec = read_recording(flight.recording)
    write_recording(rec.between(0.0, 0.0), tmp_path / "one.csv")
    assert main(["cue", "--recording", str(tmp_path / "one.csv"), *flight.map_arguments]) == 2
    assert "expected a velocity or two epochs" in capsys.readouterr().err

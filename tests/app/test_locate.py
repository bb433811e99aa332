"""`terranav locate`: what it prints and writes, and one line for every wrong use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.app.cli import main
from terranav.core.earth import offset_m, shift
from terranav.core.recording import Recording
from terranav.ins.drift import add_drift
from terranav.io.recordings import write_recording
from terranav.maps.map import Map
from tests.app.conftest import INS, Flight

ROWS = 90


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory, chart: Map) -> Path:
    """A profile of 5 km in three minutes whose INS is 40 km off."""
    along = 60.0 * np.arange(ROWS)
    lat, lon = shift(36.55, -84.29, 0.6 * along + 300.0 * np.sin(along / 1500.0), 0.8 * along)
    noise = np.random.default_rng(4).normal(0.0, 3.0, ROWS)
    columns = {"time_s": 100.0 + 2.0 * np.arange(ROWS), "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(ROWS, 2000.0)}
    readings = {"terrain_m": chart.sample(lat, lon) + 30.0 + noise}
    rec = add_drift(Recording({**columns, **readings}, sigma={"terrain_m": 3.0}, name="lost"), INS, 5)
    far = shift(rec.lat_deg, rec.lon_deg, 30e3, -25e3)
    file = tmp_path_factory.mktemp("lost") / "lost.csv"
    write_recording(rec.with_columns(lat_deg=far[0], lon_deg=far[1]), file)
    return file


def answered(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> Any:
    assert main(["locate", *arguments, "--json"]) == status
    return json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_a_lost_flight_is_found(lost: Path, flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = answered(capsys, str(lost), *flight.map_arguments, "--out", str(tmp_path / "new"))
    assert told["verdict"] == "found"
    assert told["reasons"] == []
    assert told["complete"] is True
    best = told["candidates"][0]
    assert best["probability"] > 0.99
    assert told["error_m"] < 4.0 * best["sigma_m"] < 200.0
    assert best["offset"] == pytest.approx(30.0, abs=3.0)
    assert np.hypot(*told["ins_error_m"]) == pytest.approx(39e3, rel=0.1)
    assert told["left_out"]["probability"] < 1e-3
    assert told["searched"]["heading_deg"] == pytest.approx(5.7, abs=0.3)  # 1 m/s of 30 m/s, three times
    assert told["searched"]["scale"] == pytest.approx(0.1, abs=0.005)
    assert told["searched"]["offset_sigma"] is None
    assert Path(told["files"]["picture"]).read_bytes().startswith(b"\x89PNG")
    kept = json.loads(Path(told["files"]["JSON"]).read_text())
    assert kept["candidates"] == told["candidates"]


def test_lines_for_people(lost: Path, flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["locate", "--recording", str(lost), *flight.map_arguments, "--heading-sigma", "1"]) == 0
    said, complaints = capsys.readouterr()
    assert complaints == ""
    assert "verdict    found" in said
    assert "INS error" in said
    assert "from the position" in said
    assert "1.0000" in said


def test_part_of_a_recording(lost: Path, flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    """A few hundred metres are not enough to tell the place, and say so."""
    told = answered(capsys, str(lost), *flight.map_arguments, "--span", "150,170", "--scale-sigma", "0", status=1)
    assert told["recording"]["from_s"] == 150.0
    assert told["recording"]["to_s"] == 170.0
    assert told["verdict"] != "found"
    assert told["ins_error_m"] is None
    first = answered(capsys, str(lost), *flight.map_arguments, "--first", "150", "--span", "120,")
    assert (first["recording"]["from_s"], first["recording"]["to_s"]) == (120.0, 250.0)


def test_flat_readings_are_no_place(lost: Path, flight: Flight, tmp_path: Path, capsys: Any) -> None:
    """Nothing tells one flat place from another; the search that cannot end says that it did not."""
    from terranav.io.recordings import read_recording

    rec = read_recording(lost)
    write_recording(rec.with_columns(terrain_m=np.full(ROWS, 320.0)), tmp_path / "flat.csv")
    flat = ["locate", str(tmp_path / "flat.csv"), *flight.map_arguments]
    status = main([*flat, "--scale-sigma", "0", "--sigma", "40"])
    said = capsys.readouterr().out
    assert status == 1
    assert "not searched to the end" in said
    assert "search stopped: any part of the map may fit better" in said
    assert "probability" not in said
    told = answered(capsys, *flat[1:], "--scale-sigma", "0", "--sigma", "40", "--out", str(tmp_path / "out"), status=1)
    assert told["complete"] is False
    assert told["reasons"][0].startswith("search stopped: more than 20000 cells and headings fit")
    assert told["candidates"]
    assert {place["probability"] for place in told["candidates"]} == {None}
    assert told["left_out"]["probability"] is None
    assert Path(told["files"]["picture"]).read_bytes().startswith(b"\x89PNG")


def test_the_limit_of_a_search_is_a_choice(lost: Path, flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    told = answered(capsys, str(lost), *flight.map_arguments, "--most-places", "1", status=1)
    assert told["verdict"] == "not searched to the end"
    assert told["searched"]["most_places"] == 1
    assert told["ins_error_m"] is None


def test_a_place_off_the_map_is_not_found(
    lost: Path, flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from terranav.io.recordings import read_recording

    rec = read_recording(lost)
    elsewhere = 400.0 + 250.0 * np.sin(np.arange(ROWS) / 3.0)
    write_recording(rec.with_columns(terrain_m=elsewhere), tmp_path / "else.csv")
    told = answered(capsys, str(tmp_path / "else.csv"), *flight.map_arguments, "--out", str(tmp_path))
    assert told["verdict"] == "not found"
    assert told["reasons"]
    assert (tmp_path / "locate.png").is_file()


def test_a_drift_can_be_added(flight: Flight, capsys: pytest.CaptureFixture[str]) -> None:
    told = answered(capsys, str(flight.true_position), *flight.map_arguments, "--drift", "5000,0.3,0.1")
    assert told["verdict"] == "found"
    assert told["error_m"] < 60.0


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (("--span", "170"), "--span is '170', expected FROM,TO"),
        (("--span", "170,150"), "--span is '170,150'"),
        (("--span", "nan,150"), "--span"),
        (("--span", "5000,6000"), "no epoch has time_s in [5000, 6000]"),
        (("--span", "150,157"), "4 terrain readings, expected at least 8"),
        (("--first", "-1"), "--first"),
        (("--heading-sigma", "north"), "--heading-sigma is 'north', expected a number >= 0 or 'unknown'"),
        (("--heading-sigma", "-1"), "--heading-sigma is '-1'"),
        (("--scale-sigma", "unknown"), "--scale-sigma is 'unknown', expected a number >= 0"),
        (("--scale-sigma", "50"), "--scale-sigma is '50', expected at most 6.7"),
        (("--offset-sigma", "0"), "--offset-sigma is '0', expected a number > 0"),
        (("--sigma", "0"), "--sigma"),
        (("--certain", "1"), "certain is 1.0"),
        (("--most-places", "0"), "most_places is 0"),
        (("--map-kind", "gravity", "--map-unit", "mGal"), "no reading compares with a gravity map"),
        (("--map-kind", "terrian"), "terrian"),
        (("--nonsense",), "nonsense"),
        (("--recording", "x.csv"), "RECORDING is given twice"),
    ],
)
def test_wrong_use_is_one_line(
    lost: Path, flight: Flight, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], named: str
) -> None:
    assert main(["locate", str(lost), *flight.map_arguments, *more]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    lines = [line for line in said.err.splitlines() if "warning" not in line]  # heights are no gravity
    assert len(lines) == 1
    assert named in lines[0]


def test_what_is_missing_is_one_line(
    lost: Path, flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = [*flight.map_arguments[:2], *flight.map_arguments]
    for arguments, named in (
        ([*flight.map_arguments], "RECORDING is given not at all"),
        ([str(lost)], "--map is given 0 times"),
        ([str(lost), *two], "--map is given 2 times"),
        ([str(tmp_path / "none.csv"), *flight.map_arguments], "none.csv"),
        ([str(lost), "--map", str(tmp_path / "none.tif")], "none.tif"),
    ):
        assert main(["locate", *arguments]) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert named in said.err.splitlines()[-1]


def test_a_vehicle_that_stands_still(
    lost: Path, flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from terranav.io.recordings import read_recording

    rec = read_recording(lost)
    for name, step, words in (("still", 0.0, "length of 0 m"), ("slow", 1e-7, "expected at least three cells")):
        lat = np.linspace(36.55, 36.55 + step * ROWS, ROWS)
        write_recording(rec.with_columns(lat_deg=lat, lon_deg=np.full(ROWS, -84.29)), tmp_path / f"{name}.csv")
        assert main(["locate", str(tmp_path / f"{name}.csv"), *flight.map_arguments]) == 2
        assert words in capsys.readouterr().err


def test_the_error_is_that_of_the_last_reading(
    lost: Path, flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Readings that end before the recording does: the position is told for the time of the last of them."""
    from terranav.io.recordings import read_recording

    rec = read_recording(lost)
    heights = rec.columns["terrain_m"].copy()
    heights[70:] = np.nan
    write_recording(rec.with_columns(terrain_m=heights), tmp_path / "ends.csv")
    told = answered(capsys, str(tmp_path / "ends.csv"), *flight.map_arguments)
    assert told["recording"]["to_s"] == rec.time_s[69]
    best, true = told["candidates"][0], (rec.columns["true_lat_deg"][69], rec.columns["true_lon_deg"][69])
    assert told["error_m"] == pytest.approx(np.hypot(*offset_m(*true, best["lat_deg"], best["lon_deg"])), abs=1e-6)
    assert told["error_m"] < 100.0

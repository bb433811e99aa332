"""`terranav plan suitability`: what it prints and writes, and one line for every wrong use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.app.cli import main
from tests.app.conftest import Flight


def asked(flight: Flight, out: Path, *more: str) -> list[str]:
    legs = ["--distance", "3", "--headings", "4", "--crs", "EPSG:4326", "--out", str(out)]
    return ["plan", "suitability", str(flight.map), *legs, *more]


def answered(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> Any:
    assert main([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_json_and_files(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = answered(capsys, asked(flight, tmp_path / "new" / "folder", "--limit", "60"))
    assert told["limit_m"] == 60.0
    assert told["settings"]["distance_m"] == 3000.0
    assert told["settings"]["headings"] == 4
    assert told["ins"]["name"] == "tactical"
    within = told["within_limit"]
    assert 0.0 <= within["worst"] <= within["median"] <= within["best"] <= 1.0
    assert told["sigma_m"]["best"]["median"] <= told["sigma_m"]["worst"]["median"]
    assert Path(told["files"]["picture"]).read_bytes().startswith(b"\x89PNG")
    with np.load(told["files"]["grids"]) as grids:
        shape = (told["rows"], told["cols"])
        assert grids["sigma_m"].shape == grids["drms_m"].shape == (4, *shape)
        assert grids["roughness"].shape == grids["self_similarity"].shape == shape
        assert (np.diff(grids["lat_deg"]) < 0).all()
        assert (np.diff(grids["lon_deg"]) > 0).all()
        np.testing.assert_array_equal(grids["headings_deg"], [0.0, 90.0, 180.0, 270.0])


def test_a_longer_leg_than_the_map(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is known, which is null and a dash, and still a picture."""
    told = answered(capsys, asked(flight, tmp_path, "--distance", "500"))
    assert told["covered"] == 0.0
    assert told["within_limit"]["best"] is None
    assert (tmp_path / "suitability.png").is_file()


def test_lines_for_people(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(asked(flight, tmp_path, "--ins", "navigation", "--anchor", "start", "--block", "6")) == 0
    printed = capsys.readouterr().out
    assert "on the best heading over" in printed
    assert "suitability.png" in printed


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (("--sensor-sigma", "0"), "sensor_sigma"),
        (("--rate", "-1"), "rate_hz"),
        (("--speed", "nan"), "speed_mps"),
        (("--distance", "0"), "distance_m"),
        (("--headings", "0"), "headings"),
        (("--headings", "many"), "headings"),
        (("--limit", "0"), "--limit"),
        (("--block", "5000"), "block"),
        (("--block", "900"), "block"),
        (("--anchor", "middle"), "anchor"),
        (("--ins", "tactile"), "tactile"),
        (("--kind", "terrian"), "terrian"),
        (("--distance", "1e9"), "distance_m"),
        (("--nonsense",), "nonsense"),
    ],
)
def test_wrong_use_is_one_line(
    flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], named: str
) -> None:
    assert main(asked(flight, tmp_path, *more)) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.strip().splitlines()) == 1
    assert named in said.err


def test_no_map_no_folder(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "suitability", str(tmp_path / "none.tif"), "--out", str(tmp_path)]) == 2
    assert "none.tif" in capsys.readouterr().err
    assert main(["plan", "suitability", str(flight.map)]) == 2
    assert "--out" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(asked(flight, tmp_path / "file")) == 2
    assert "--out" in capsys.readouterr().err

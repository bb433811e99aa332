"""`terranav plan suitability`: what it prints and writes, and one line for every wrong use."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from terranav.app.cli import main
from terranav.core.earth import shift
from terranav.ins.grades import grade_named
from terranav.io.rasters import open_map
from terranav.planning.suitability import LegSettings, suitability
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
    shape = (told["rows"], told["cols"])
    with rasterio.open(told["files"]["grids"]) as layers, rasterio.open(told["files"]["by_heading"]) as legs:
        assert layers.shape == legs.shape == shape
        assert layers.crs == legs.crs == rasterio.crs.CRS.from_epsg(4326)
        assert legs.descriptions == tuple(f"1-sigma on heading {heading} deg" for heading in (0, 90, 180, 270))
        assert layers.units[:4] == ("m", "m", "m", "deg")
        best, median, worst, heading = layers.read([1, 2, 3, 4])
        by_heading = legs.read()
        known = np.isfinite(best)
        assert known.mean() == pytest.approx(told["covered"])
        np.testing.assert_array_equal(best[known], np.fmin.reduce(by_heading[:, known]))
        np.testing.assert_array_equal(worst[known], np.fmax.reduce(by_heading[:, known]))
        assert set(heading[known]) <= {0.0, 90.0, 180.0, 270.0}
        assert (median[known] <= worst[known]).all()
    assert not list(tmp_path.rglob("*.npz"))


def test_layers_lie_where_the_map_does(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What GDAL has at a place is what the planner has there: the bound at 20 places, and the slope of the map."""
    told = answered(capsys, asked(flight, tmp_path, "--map-correlation", "300"))
    assert told["map_correlation_m"] == 300.0
    chart = open_map(flight.map, kind="terrain", crs="EPSG:4326", correlation_m=300.0)
    found = suitability(chart, grade_named("tactical"), LegSettings(distance_m=3000.0, headings=4))
    rng = np.random.default_rng(1)
    lat, lon = (
        rng.uniform(found.lat_deg[-1], found.lat_deg[0], 20),
        rng.uniform(found.lon_deg[0], found.lon_deg[-1], 20),
    )
    with rasterio.open(told["files"]["by_heading"]) as legs, rasterio.open(told["files"]["grids"]) as layers:
        sigmas = np.array(list(legs.sample(zip(lon, lat, strict=True))))
        slopes = np.array([band[4] for band in layers.sample(zip(lon, lat, strict=True))])
    row = np.abs(found.lat_deg[:, None] - lat).argmin(axis=0)
    col = np.abs(found.lon_deg[:, None] - lon).argmin(axis=0)
    np.testing.assert_array_equal(sigmas, found.sigma_m[:, row, col].T)
    assert np.isfinite(sigmas).sum() > 10
    half = 3.0 * found.block_m  # the patch that the slope is of
    for i in np.flatnonzero(np.isfinite(slopes)):
        away = np.linspace(-half, half, 41)
        around = shift(lat[i], lon[i], *(axis.ravel() for axis in np.meshgrid(away, away)))
        rise = np.array(chart.gradient(*around))
        if np.isfinite(rise).all():
            assert np.sqrt((rise**2).sum(axis=0).mean()) == pytest.approx(slopes[i], rel=0.2)


def test_depths_and_readings_a_cell(flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A map turned over is as good as it was; following fewer readings of a fast sensor tells less."""
    fast = ("--rate", "20", "--kind", "bathymetry", "--positive-down")
    many = answered(capsys, asked(flight, tmp_path / "many", *fast))
    few = answered(capsys, asked(flight, tmp_path / "few", *fast, "--readings-a-cell", "1"))
    assert many["map"]["kind"] == "bathymetry"
    assert (many["settings"]["readings_a_cell"], few["settings"]["readings_a_cell"]) == (4, 1)
    assert many["sigma_m"]["best"]["median"] != few["sigma_m"]["best"]["median"]
    up = answered(capsys, asked(flight, tmp_path / "up", "--rate", "20"))
    assert many["spread"]["median"] == pytest.approx(up["spread"]["median"], rel=1e-5)


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
    assert "a quarter of a cell, expect more than is told here" in " ".join(printed.split())


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
        (("--map-correlation", "0"), "correlation_m"),
        (("--readings-a-cell", "0"), "readings_a_cell"),
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

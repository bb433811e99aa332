"""terranav plan route: a route over the sample DEM with its files, and wrong use."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from terranav.app.cli import main
from terranav.io.raster_out import write_map
from terranav.maps.sample_dem import sample_map

ENDS = ("36.5,-84.3", "36.65,-84.1")


@pytest.fixture(scope="module")
def dem(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("route") / "dem.tif"
    write_map(sample_map(), file)
    return file


def test_a_route_is_told_better_than_the_straight_line_and_written(
    dem: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", "route", *ENDS, "--map", str(dem), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "% more than straight" in said
    shape = json.loads((tmp_path / "route.geojson").read_text())
    assert shape["type"] == "FeatureCollection"
    line = next(one["geometry"] for one in shape["features"] if one["geometry"]["type"] == "LineString")
    for at, (lat, lon) in ((0, (36.5, -84.3)), (-1, (36.65, -84.1))):
        assert line["coordinates"][at][:2] == pytest.approx([lon, lat], abs=2e-3)
    assert json.loads((tmp_path / "route.plan").read_text())["fileType"] == "Plan"
    assert (tmp_path / "route.kml").read_text().lstrip().startswith("<?xml")
    assert (tmp_path / "route.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("ends", "options"),
    [
        (("36.5,-84.3", "50.0,-84.1"), ()),
        (("36.5", ENDS[1]), ()),
        (ENDS, ("--extra", "-3")),
    ],
)
def test_wrong_use_is_one_line(
    dem: Path, tmp_path: Path, ends: tuple[str, str], options: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", "route", *ends, "--map", str(dem), "--out", str(tmp_path), *options]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("terranav: error: ")
    assert said.err.count("\n") == 1


def test_an_impossible_limit_says_the_best_reachable(
    dem: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", "route", *ENDS, "--map", str(dem), "--out", str(tmp_path), "--limit", "0.01"]) == 1
    said = capsys.readouterr().err
    assert "--limit 0.01: no route within it was found; the best has a 1-sigma of " in said

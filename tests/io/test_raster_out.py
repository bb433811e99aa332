"""Maps written and read back: the same values at the same places."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio

import terranav as tn
from terranav.core.errors import ConfigError, DataError
from terranav.io.raster_out import Layer, write_layers, write_map
from terranav.maps.map import Map

RNG = np.random.default_rng(5)
VALUES = RNG.uniform(100.0, 900.0, (30, 41)).astype(np.float32)
VALUES[3, 4:9] = np.nan
UTM = (30.0, 0.0, 500_000.0, 0.0, -30.0, 5_200_000.0)
CHARTS = {
    "geographic": Map(VALUES, (0.01, 0.0, 10.0, 0.0, -0.01, 46.0)),
    "south up": Map(VALUES, (0.01, 0.0, 10.0, 0.0, 0.02, 46.0)),
    "third of a second": Map(VALUES, (1 / 10800, 0.0, 179.99, 0.0, -1 / 10800, -12.1)),
    "projected": Map(-VALUES, UTM, "EPSG:32633", kind="bathymetry"),
    "polar": Map(VALUES, (5000.0, 0.0, -1e5, 0.0, -5000.0, 1e5), "EPSG:3413", kind="magnetic", unit="nT"),
    "other datum": Map(VALUES, (0.01, 0.0, 10.0, 0.0, -0.01, 46.0), "EPSG:4230", kind="gravity", unit="mGal"),
    "feet": Map(VALUES, (100.0, 0.0, 2e6, 0.0, -100.0, 3e5), "EPSG:2264"),
}


def probes(chart: Map) -> tuple[np.ndarray, np.ndarray]:
    south, west, north, east = chart.bounds_deg
    return RNG.uniform(south, north, 500), RNG.uniform(west, east, 500)


@pytest.mark.parametrize("suffix", [".tif", ".nc"])
@pytest.mark.parametrize("name", list(CHARTS))
def test_what_is_written_is_read_back(tmp_path: Path, name: str, suffix: str) -> None:
    chart = CHARTS[name]
    file = tmp_path / f"map{suffix}"
    write_map(chart, file)
    again = tn.open_map(file, kind=chart.kind)
    np.testing.assert_array_equal(again.values, chart.values)
    assert again.unit == chart.unit
    lat, lon = probes(chart)
    for here, there in zip(chart.cells(lat, lon), again.cells(lat, lon), strict=True):
        np.testing.assert_allclose(there, here, atol=1e-5)
    assert [one.name for one in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize("datum", ["EGM96", "EGM2008", "mean sea level"])
def test_a_geotiff_keeps_a_known_datum(tmp_path: Path, datum: str) -> None:
    write_map(replace(CHARTS["geographic"], datum=datum), tmp_path / "map.tif")
    again = tn.open_map(tmp_path / "map.tif")
    assert again.datum is not None
    assert datum.lower() in again.datum.lower().replace("msl", "mean sea level")
    assert again.crs == "EPSG:4326"
    write_map(again, tmp_path / "twice.tif")
    assert tn.open_map(tmp_path / "twice.tif").datum == again.datum


def test_a_geotiff_is_tiled_deflated_and_says_its_unit(tmp_path: Path) -> None:
    write_map(CHARTS["polar"], tmp_path / "map.tif")
    with rasterio.open(tmp_path / "map.tif") as raster:
        assert raster.profile["compress"] == "deflate"
        assert raster.profile["tiled"]
        assert np.isnan(raster.nodata)
        assert raster.units == ("nT",)


@pytest.mark.parametrize("name", ["geographic", "projected", "polar"])
def test_layers_are_read_back_at_their_places(tmp_path: Path, name: str) -> None:
    chart = CHARTS[name]
    layers = [Layer("height", chart.values, chart.unit), Layer("of the row", np.indices(chart.shape)[0])]
    write_layers(tmp_path / "two.tif", layers, chart.transform, chart.crs)
    with rasterio.open(tmp_path / "two.tif") as raster:
        assert raster.descriptions == ("height", "of the row")
        assert raster.units == (chart.unit, None)
        assert raster.dtypes == ("float32", "float32")
        assert raster.crs == rasterio.crs.CRS.from_user_input(chart.crs)
        assert (raster.profile["tiled"], raster.profile["compress"]) == (True, "deflate")
        assert np.isnan(raster.nodata)
        a, _, c, _, e, f = chart.transform
        at = c + 20.5 * a, f + 7.5 * e  # the middle of row 7, column 20
        np.testing.assert_array_equal(next(iter(raster.sample([at]))), [chart.values[7, 20], 7.0])
        np.testing.assert_array_equal(raster.read(1), chart.values)
    again = tn.open_map(tmp_path / "two.tif", kind=chart.kind, variable="1")
    lat, lon = probes(chart)
    for here, there in zip(chart.cells(lat, lon), again.cells(lat, lon), strict=True):
        np.testing.assert_allclose(there, here, atol=1e-5)


def test_layers_that_cannot_be_one_file(tmp_path: Path) -> None:
    grid, place = Layer("a", VALUES), CHARTS["geographic"].transform
    for layers in ([], [grid, Layer("b", VALUES[1:])], [Layer("c", VALUES[0])]):
        with pytest.raises(ConfigError, match=r"x\.tif: layers of shapes .* one shape"):
            write_layers(tmp_path / "x.tif", layers, place, "EPSG:4326")
    with pytest.raises(ConfigError, match=r"suffix is '\.nc', expected \.tif"):
        write_layers(tmp_path / "x.nc", [grid], place, "EPSG:4326")
    with pytest.raises(DataError, match=r"x\.tif: cannot be written"):
        write_layers(tmp_path / "x.tif", [grid], place, "EPSG:999999")
    assert not list(tmp_path.iterdir())
    write_layers(tmp_path / "x.tif", [grid], place, "EPSG:4326")
    with pytest.raises(ConfigError, match="is there already"):
        write_layers(tmp_path / "x.tif", [grid], place, "EPSG:4326")
    write_layers(tmp_path / "x.tif", [grid], place, "EPSG:4326", force=True)


def test_rows_aslant_need_a_geotiff(tmp_path: Path) -> None:
    chart = Map(VALUES, (30.0, 5.0, 500_000.0, 5.0, -30.0, 5_200_000.0), "EPSG:32633")
    with pytest.raises(DataError, match=r"aslant .* expected .tif"):
        write_map(chart, tmp_path / "map.nc")
    write_map(chart, tmp_path / "map.tif")
    np.testing.assert_allclose(tn.open_map(tmp_path / "map.tif").transform, chart.transform)


def test_hgt_is_exact_or_refused(tmp_path: Path) -> None:
    cell = 1 / 1200
    values = RNG.integers(-100, 3000, (1201, 1201)).astype(np.float32)
    values[7, 8] = np.nan
    chart = Map(values, (cell, 0.0, 9.0 - cell / 2, 0.0, -cell, 48.0 + cell / 2))
    write_map(chart, tmp_path / "N47E009.hgt")
    again = tn.open_map(tmp_path / "N47E009.hgt")
    np.testing.assert_array_equal(again.values, chart.values)
    np.testing.assert_allclose(again.transform, chart.transform, atol=1e-9)
    beside = replace(chart, transform=(cell, 0.0, 9.0, 0.0, -cell, 48.0))
    for other, name, message in (
        (chart, "N47E010.hgt", "expected N47E009.hgt"),
        (beside, "N47E009b.hgt", "1 x 1 degree"),
        (replace(chart, values=values + 0.5), "N47E008.hgt", "whole metres"),
        (CHARTS["geographic"], "N47E008.hgt", "30 x 41"),
    ):
        with pytest.raises(DataError) as caught:
            write_map(other, tmp_path / name)
        assert message in str(caught.value)
    assert [one.name for one in tmp_path.iterdir()] == ["N47E009.hgt"]


def test_refusals(tmp_path: Path) -> None:
    chart = CHARTS["geographic"]
    with pytest.raises(ConfigError, match=r"suffix is '.png', expected one of .tif"):
        write_map(chart, tmp_path / "map.png")
    with pytest.raises(DataError, match="is not a folder"):
        write_map(chart, tmp_path / "none" / "map.tif")
    (tmp_path / "map.tif").write_text("mine")
    with pytest.raises(ConfigError, match="is there already"):
        write_map(chart, tmp_path / "map.tif")
    assert (tmp_path / "map.tif").read_text() == "mine"
    write_map(chart, tmp_path / "map.tif", force=True)
    assert tn.open_map(tmp_path / "map.tif").shape == chart.shape


def test_hgt_is_egm96_by_definition(tmp_path: Path) -> None:
    cell = 1 / 1200
    place = (cell, 0.0, 9.0 - cell / 2, 0.0, -cell, 48.0 + cell / 2)
    chart = Map(np.indices((1201, 1201))[0], place, datum="EGM2008")
    with pytest.raises(DataError, match=r"count from EGM2008, but \.hgt holds EGM96"):
        write_map(chart, tmp_path / "N47E009.hgt")
    write_map(replace(chart, datum="EGM96"), tmp_path / "N47E009.hgt")
    assert tn.open_map(tmp_path / "N47E009.hgt").datum == "EGM96"


@pytest.mark.skipif(sys.platform == "win32", reason="no limit on the size of files")
@pytest.mark.parametrize("most", [0, 2_000, 300_000, 800_000])
def test_a_disk_that_fills_up_is_said_and_nothing_is_left(tmp_path: Path, most: int) -> None:
    """A limit on the size of files stands for the disk: what is written beyond it fails."""
    script = f"""
import resource, signal, numpy as np
from terranav.core.errors import DataError
from terranav.io.raster_out import write_map
from terranav.maps.map import Map
values = np.random.default_rng(1).normal(0.0, 1.0, (520, 520))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({most}, {most}))
for suffix in (".tif", ".nc"):
    try:
        write_map(Map(values, (0.01, 0.0, 9.0, 0.0, -0.01, 48.0)), "map" + suffix)
        print("written")
    except DataError as error:
        print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    said = done.stdout.splitlines()
    assert len(said) == 2
    assert all(
        line.startswith(f"map{suffix}: cannot be written") for line, suffix in zip(said, (".tif", ".nc"), strict=True)
    )
    assert list(tmp_path.iterdir()) == []

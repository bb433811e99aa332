"""Mosaics from files: folders, patterns, lists and VRTs, and what is wrong with their tiles."""

from __future__ import annotations

import gzip
import pickle
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import rasterio
import xarray as xr
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.merge import merge
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT

import terranav as tn
from terranav.app.cli import main
from terranav.io import mosaics, rasters
from terranav.maps.mosaic import Mosaic

CELL = 0.001
LAND = (900.0 + np.cumsum(np.random.default_rng(5).normal(0.0, 2.0, (300, 400)), axis=1)).astype(np.float32)


def geotiff(
    file: Path, rows: slice, cols: slice, values: NDArray[np.float32] = LAND, *, datum: str | None = None
) -> Path:
    """A part of the land as a GeoTIFF."""
    part = values[rows, cols]
    at = Affine(CELL, 0.0, 10.0 + CELL * cols.start, 0.0, -CELL, 47.0 - CELL * rows.start)
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "height": part.shape[0], "width": part.shape[1]}
    with rasterio.open(file, "w", **profile, transform=at, crs="EPSG:4326", nodata=-9999.0) as raster:
        raster.write(np.nan_to_num(part, nan=-9999.0), 1)
        if datum is not None:
            raster.update_tags(vertical_datum=datum)
    return file


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four tiles in two folders, one of them a NetCDF, beside files that are no tiles."""
    (tmp_path / "more").mkdir()
    geotiff(tmp_path / "nw.tif", slice(0, 150), slice(0, 200))
    geotiff(tmp_path / "ne.tif", slice(0, 150), slice(200, 400))
    geotiff(tmp_path / "more" / "sw.TIFF", slice(150, 300), slice(0, 200))
    lat, lon = 47.0 - CELL * (np.arange(150, 300) + 0.5), 10.0 + CELL * (np.arange(200, 400) + 0.5)
    z = xr.DataArray(LAND[150:, 200:], {"lat": lat, "lon": lon}, ("lat", "lon"), name="z")
    z.to_netcdf(tmp_path / "more" / "se.nc", engine="h5netcdf")
    (tmp_path / "readme.txt").write_text("no tile")
    (tmp_path / ".hidden.tif").write_bytes(b"no tile either")
    return tmp_path


def opened(path: str | Path | list[Path]) -> Mosaic:
    chart = tn.open_map(path)
    assert isinstance(chart, Mosaic)
    return chart


def test_a_folder_a_pattern_and_a_list_are_the_same_map(folder: Path) -> None:
    for path, count in ((folder, 4), (str(folder / "**" / "*.*[fcF]"), 4), (sorted(folder.rglob("[ns]?.*")), 4)):
        chart = opened(path)
        assert chart.tile_count == count
        np.testing.assert_allclose(chart.values, LAND, rtol=0.0, atol=1e-6)
        assert chart.bounds_deg == pytest.approx((46.7005, 10.0005, 46.9995, 10.3995))
    assert opened(folder / "*.tif").shape == (150, 400)
    assert chart.kind == "terrain"
    box = tn.open_map(folder, box=(46.8, 10.1, 46.9, 10.3))
    assert not isinstance(box, Mosaic)
    np.testing.assert_array_equal(box.values, chart.crop(46.8, 10.1, 46.9, 10.3).values)


def test_tiles_may_be_gzipped(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    plain, packed, alone = (tmp_path_factory.mktemp(name) for name in ("plain", "packed", "alone"))
    for file in folder.rglob("*.tif"):
        (plain / file.name).write_bytes(file.read_bytes())
        (packed / f"{file.name}.gz").write_bytes(gzip.compress(file.read_bytes()))
    assert np.array_equal(opened(packed).values, opened(plain).values, equal_nan=True)
    hgt = (np.arange(1201 * 1201) % 3000).astype(">i2").tobytes()
    (alone / "N47E009.hgt.gz").write_bytes(gzip.compress(hgt))
    chart = tn.open_map(alone / "N47E009.hgt.gz")
    assert (chart.shape, chart.datum) == ((1201, 1201), "EGM96")
    assert chart.sample(48.0, 9.0 + 5.0 / 1200.0) == pytest.approx(5.0)


def test_options_reach_every_tile(folder: Path) -> None:
    chart = tn.open_map(folder, unit="ft", kind="bathymetry", positive_down=True, sigma=7.0, name="sea")
    assert (chart.kind, chart.sigma, chart.name) == ("bathymetry", 7.0, "sea")
    np.testing.assert_allclose(chart.values, -0.3048 * LAND, rtol=1e-6)


def test_a_mosaic_goes_to_another_process(folder: Path) -> None:
    chart = opened(folder)
    again = pickle.loads(pickle.dumps(chart))
    assert again.checksum == chart.checksum
    np.testing.assert_array_equal(again.values, chart.values)


def test_the_checksum_changes_with_a_tile(folder: Path) -> None:
    before = opened(folder).checksum
    geotiff(folder / "ne.tif", slice(0, 150), slice(200, 400), LAND + np.float32(1e-3))
    assert opened(folder).checksum != before


def test_a_corrupted_tile_among_many_is_named_and_the_rest_works(folder: Path) -> None:
    (folder / "no.tif").write_bytes(b"not a raster")
    with pytest.warns(tn.DataWarning, match=r"no\.tif: not a readable raster .*; left out"):
        chart = opened(folder)
    np.testing.assert_allclose(chart.values, LAND, rtol=0.0, atol=1e-6)
    whole = (folder / "nw.tif").read_bytes()
    (folder / "no.tif").unlink()
    (folder / "nw.tif").write_bytes(whole[: len(whole) // 2])  # opens, but cannot be read to its end
    with pytest.warns(tn.DataWarning, match=r"nw\.tif: not a readable raster .*; the tile is left out"):
        values = opened(folder).values
    assert np.isnan(values[:150, :200]).all()
    np.testing.assert_allclose(values[150:], LAND[150:], rtol=0.0, atol=1e-6)


def test_many_corrupted_tiles_are_a_few_lines(folder: Path) -> None:
    for k in range(20):
        (folder / f"bad{k:02}.tif").write_bytes(b"not a raster")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        opened(folder)
    assert len(said) == mosaics.MOST_NAMED + 1
    assert "and 15 more like this: " in str(said[-1].message)
    assert "bad19.tif" in str(said[-1].message)


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("empty", r"empty: no map in it, expected files such as \.hgt"),
        ("none*.tif", r"none\*\.tif: no map in it, expected files that match it"),
        ("bad", r"bad: none of its 2 files is a map \(.*a\.tif: not a readable raster"),
    ],
)
def test_a_folder_without_maps_is_one_line(tmp_path: Path, path: str, said: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad").mkdir()
    for name in ("a.tif", "b.hgt"):
        (tmp_path / "bad" / name).write_bytes(b"not a raster")
    with pytest.raises(tn.DataError, match=said):
        tn.open_map(tmp_path / path)
    assert main(["map", "info", str(tmp_path / path)]) == 2


def test_an_empty_list_and_a_missing_file_of_one_are_said(folder: Path) -> None:
    with pytest.raises(tn.DataError, match="list of map files is empty"):
        tn.open_map([])
    with pytest.raises(tn.DataError, match=r"gone\.tif: no such file"):
        tn.open_map([folder / "nw.tif", folder / "gone.tif"])


def test_tiles_that_disagree_are_said_with_figures(folder: Path) -> None:
    geotiff(folder / "zz.tif", slice(100, 200), slice(100, 300), LAND + np.float32(40.0))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        chart = opened(folder)
    assert len(said) == 4
    for line in said:
        assert re.search(r"zz\.tif differ by 40\.0 rms \(-40\.0 on average\) over \d+ cells", str(line.message))
    np.testing.assert_allclose(chart.values, LAND, rtol=0.0, atol=1e-6)  # by name the others come first
    geotiff(folder / "zz.tif", slice(100, 200), slice(100, 300))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opened(folder)


def test_tiles_of_two_vertical_datums_are_refused(tmp_path: Path) -> None:
    geotiff(tmp_path / "a.tif", slice(0, 150), slice(0, 200), datum="EGM96")
    geotiff(tmp_path / "b.tif", slice(0, 150), slice(200, 400), datum="EGM2008")
    with pytest.raises(tn.DataError, match=r"a\.tif.*EGM96.*b\.tif.*EGM2008"):
        tn.open_map(tmp_path)
    geotiff(tmp_path / "b.tif", slice(0, 150), slice(200, 400))
    with pytest.warns(tn.DataWarning, match=r"1 of 2 tiles, such as .*b\.tif, name no vertical datum, others EGM96"):
        assert opened(tmp_path).datum is None
    assert tn.open_map(tmp_path, datum="EPSG:5773").datum == "EGM96"
    assert tn.open_map(tmp_path / "a.tif", datum="ellipsoid").datum == "ellipsoid"
    with pytest.raises(tn.ConfigError, match="map datum is 'EGM69'"):
        tn.open_map(tmp_path, datum="EGM69")


def test_feet_called_metres_are_doubted(tmp_path: Path) -> None:
    geotiff(tmp_path / "a.tif", slice(0, 150), slice(0, 200), LAND * np.float32(30.0))
    with pytest.warns(tn.DataWarning, match="are they in feet"):
        tn.open_map([tmp_path / "a.tif"])


def test_a_vrt_and_a_file_too_large_for_memory_stay_in_their_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rasters, "LARGE_CELLS", 10_000)
    chart = opened(folder / "nw.tif")
    assert chart.tile_count == 1
    np.testing.assert_allclose(chart.values, LAND[:150, :200], atol=1e-6)
    sources = "".join(
        f'<SimpleSource><SourceFilename relativeToVRT="1">{name}.tif</SourceFilename><SourceBand>1</SourceBand>'
        f'<SrcRect xOff="0" yOff="0" xSize="200" ySize="150"/><DstRect xOff="{at}" yOff="0" xSize="200" ySize="150"/>'
        "</SimpleSource>"
        for name, at in (("nw", 0), ("ne", 200))
    )
    (folder / "north.vrt").write_text(
        '<VRTDataset rasterXSize="400" rasterYSize="150"><SRS>EPSG:4326</SRS>'
        f"<GeoTransform>10.0, {CELL}, 0.0, 47.0, 0.0, {-CELL}</GeoTransform>"
        f'<VRTRasterBand dataType="Float32" band="1">{sources}</VRTRasterBand></VRTDataset>'
    )
    north = opened(folder / "north.vrt")
    np.testing.assert_allclose(north.values, LAND[:150], atol=1e-6)
    lat, lon = np.random.default_rng(1).uniform((46.86, 10.01), (46.99, 10.39), (500, 2)).T
    np.testing.assert_allclose(north.sample(lat, lon), opened(folder).sample(lat, lon), atol=1e-4)


def test_another_grid_is_interpolated_as_gdalwarp_does(tmp_path: Path) -> None:
    """Within 1 cm of GDAL's bilinear warp onto the same grid."""
    smooth = (800.0 + 60.0 * np.sin(np.arange(300) / 9.0)[:, None] * np.cos(np.arange(400) / 11.0)).astype(np.float32)
    geotiff(tmp_path / "fine.tif", slice(0, 100), slice(0, 100), smooth)
    utm = Affine(120.0, 0.0, 578_000.0, 0.0, -120.0, 5_204_000.0)
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "height": 300, "width": 300}
    with rasterio.open(tmp_path / "metres.tif", "w", **profile, transform=utm, crs="EPSG:32632", nodata=-9.0) as raster:
        raster.write(smooth[:300, :300], 1)
    with pytest.warns(tn.DataWarning, match="differ by"):  # other land altogether
        chart = opened([tmp_path / "fine.tif", tmp_path / "metres.tif"])
    a, _, c, _, e, f = chart.transform
    rows, cols = chart.shape
    onto = {
        "transform": Affine(a, 0.0, c, 0.0, e, f),
        "width": cols,
        "height": rows,
        "crs": "EPSG:4326",
        "nodata": -9.0,
    }
    exact = {"resampling": Resampling.bilinear, "tolerance": 1e-6}  # by default it is 1/8 of a cell
    with rasterio.open(tmp_path / "metres.tif") as raster, WarpedVRT(raster, **onto, **exact) as warped:
        expected = warped.read(1).astype(np.float64)
    mine = tn.open_map([tmp_path / "metres.tif"])
    row, col = np.indices(chart.shape)
    lat, lon = f + e * (row + 0.5), c + a * (col + 0.5)
    inner = np.isfinite(mine.sample(lat, lon)) & (expected != -9.0)
    found = chart.values.astype(np.float64)
    fine = (lat > 46.9) & (lon < 10.1)
    assert (inner & ~fine).sum() > 20_000
    np.testing.assert_allclose(found[inner & ~fine], expected[inner & ~fine], rtol=0.0, atol=0.01)


def test_real_hgt_tiles_are_what_rasterio_merges(shared_data: Path) -> None:
    files = sorted((shared_data / "srtm").glob("N4[78]E0*.hgt"))
    chart = opened(str(shared_data / "srtm" / "N4[78]E0*.hgt"))
    merged, at = merge(files)
    values = merged[0].astype(np.float32)
    values[values == -32768.0] = np.nan
    assert chart.shape == (2401, 2401)
    np.testing.assert_array_equal(chart.values, values)
    whole = tn.Map(values, (at.a, at.b, at.c, at.d, at.e, at.f))
    seam = np.linspace(-2.0, 2.0, 4001) / 1200.0
    along = np.linspace(9.01, 10.99, 4001)
    for lat, lon in ((48.0 + seam, along), (along + 38.0, 10.0 + seam)):
        np.testing.assert_allclose(chart.sample(lat, lon), whole.sample(lat, lon), rtol=0.0, atol=1e-6)

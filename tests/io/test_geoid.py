"""Geoid grids in files, and what files say of their vertical datum."""

from __future__ import annotations

import struct
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
import xarray as xr
from rasterio.transform import Affine

import terranav as tn
from terranav.core.errors import ConfigError, DataError
from terranav.io import geoid as geoid_io
from terranav.io.geoid import convert_map, find_geoid, finder, open_geoid
from terranav.io.raster_out import write_map
from terranav.maps.datum import vertical_datum
from terranav.maps.geoid import Geoid
from terranav.maps.map import Map

STEP = 0.25
LAT, LON = 48.0 - STEP * np.arange(25), 8.0 + STEP * np.arange(33)
HEIGHTS = (47.0 + 3.0 * np.sin(LAT)[:, None] + 2.0 * np.cos(LON)[None, :]).astype(np.float32)
PLACES = np.random.default_rng(4).uniform((42.0, 8.0), (48.0, 16.0), (200, 2)).T

#: latitude, longitude [deg], height [m]: the sample output of NGA's programs for EGM96 (INTPT, on the 15 arcmin grid)
#: and EGM2008 (on the 2.5 arcmin grid)
NGA = {
    "EGM96": (
        (38.6281550, 269.7791550, -31.628),
        (-14.6212170, 305.0211140, -2.969),
        (46.8743190, 102.4487290, -43.575),
        (-23.6174460, 133.8747120, 15.871),
        (38.6254730, 359.9995000, 50.066),
        (-0.4667440, 0.0023000, 17.329),
    ),
    "EGM2008": (
        (37.0, 241.0, -26.151),
        (37.0, -119.0, -26.151),
        (36.0, 242.983333, -29.171),
        (90.0, 0.0, 14.899),
        (-90.0, 359.983333, -30.150),
        (-90.0, 0.0, -30.150),
    ),
}


def gtx(path: Path) -> Path:
    """The grid as NOAA's VDatum writes it: south-west corner, steps, size, rows from the south, big-endian."""
    head = struct.pack(">ddddii", LAT[-1], LON[0], STEP, STEP, LAT.size, LON.size)
    path.write_bytes(head + HEIGHTS[::-1].astype(">f4").tobytes())
    return path


def tif(path: Path, crs: str = "EPSG:4326", **about: str) -> Path:
    profile = {"driver": "GTiff", "width": LON.size, "height": LAT.size, "count": 1, "dtype": "float32", "crs": crs}
    place = Affine(STEP, 0.0, LON[0] - STEP / 2, 0.0, -STEP, LAT[0] + STEP / 2)
    with rasterio.open(path, "w", transform=place, **profile) as raster:
        raster.write(HEIGHTS, 1)
        raster.update_tags(**about)
    return path


def netcdf(path: Path, flip: bool = False, extra: bool = False, **about: str) -> Path:
    axes = {"lat": ("lat", LAT, {"units": "degrees_north"}), "lon": ("lon", LON, {"units": "degrees_east"})}
    data = xr.Dataset({"geoid_h": (("lat", "lon"), HEIGHTS, {"units": "m"})}, axes, about)
    if extra:
        data["geoid_free2mean"] = (("lat", "lon"), 0.0 * HEIGHTS)
        data["gravity"] = (("lat", "lon"), 0.0 * HEIGHTS)
    (data.isel(lat=slice(None, None, -1)) if flip else data).to_netcdf(path, engine="h5netcdf")
    return path


def pgm(path: Path, rows: int = 181, cols: int = 360) -> Path:
    """A grid of GeographicLib over the whole Earth: height = offset + scale * pixel."""
    lat, lon = 90.0 - np.arange(rows)[:, None], np.arange(cols)[None, :]
    pixels = np.round((30.0 * np.cos(np.radians(lat)) * np.cos(np.radians(lon)) + 108.0) / 0.003).astype(">u2")
    about = "# Geoid file in PGM format\n# Description WGS84 EGM96, 60-minute grid\n# Offset -108\n# Scale 0.003\n"
    head = f"P5\n{about}{cols}    {rows}\n65535\n"
    path.write_bytes(head.encode() + pixels.tobytes())
    return path


@pytest.fixture
def nothing_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geoid_io, "_folders", list)
    monkeypatch.setattr(geoid_io, "_packaged", lambda: None)


def test_every_format_gives_the_same_heights(tmp_path: Path) -> None:
    expected = Geoid.from_values(HEIGHTS, (STEP, 0.0, LON[0] - STEP / 2, 0.0, -STEP, LAT[0] + STEP / 2), "EGM96")
    for file in (
        gtx(tmp_path / "egm96_15.gtx"),
        tif(tmp_path / "us_nga_egm96_15.tif"),
        netcdf(tmp_path / "egm96.nc"),
        netcdf(tmp_path / "geoid.nc", flip=True, extra=True, source="EGM96, cropped"),
    ):
        geoid = open_geoid(file)
        assert (geoid.datum, geoid.source) == ("EGM96", file.name)
        np.testing.assert_allclose(geoid.height(*PLACES), expected.height(*PLACES), atol=2e-5)


def test_heights_are_those_of_rasterio_and_bilinear_weights(tmp_path: Path) -> None:
    file = tif(tmp_path / "egm96.tif")
    with rasterio.open(file) as raster:
        col, row = ~raster.transform @ (PLACES[1], PLACES[0])
        u, v = np.modf(row - 0.5)[0], np.modf(col - 0.5)[0]
        corners = []
        for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
            at = [(LON[int(c - 0.5) + across], LAT[int(r - 0.5) + down]) for r, c in zip(row, col, strict=True)]
            corners.append(np.array([value[0] for value in raster.sample(at)], dtype=np.float64))
    a, b, c, d = corners
    expected = (1 - u) * ((1 - v) * a + v * b) + u * ((1 - v) * c + v * d)
    np.testing.assert_allclose(open_geoid(file).height(PLACES[0], PLACES[1], "bilinear"), expected, atol=1e-5)


def test_heights_are_those_of_proj_where_it_has_the_grid(tmp_path: Path) -> None:
    from pyproj import Transformer

    file = gtx(tmp_path / "egm96_15.gtx")
    pipeline = f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=vgridshift +grids={file}"
    _, _, up = Transformer.from_pipeline(pipeline).transform(PLACES[1], PLACES[0], np.zeros(PLACES.shape[1]))
    np.testing.assert_allclose(np.abs(up), open_geoid(file).height(PLACES[0], PLACES[1], "bilinear"), atol=1e-6)


def test_geographiclib_grids(tmp_path: Path) -> None:
    geoid = open_geoid(pgm(tmp_path / "grid.pgm"))
    assert geoid.datum == "EGM96"
    lon = np.array([0.0, 45.5, 179.9, -179.9, 359.7, -0.3])
    np.testing.assert_allclose(
        geoid.height(30.2, lon), 30.0 * np.cos(np.radians(30.2)) * np.cos(np.radians(lon)), atol=4e-3
    )
    (tmp_path / "bad.pgm").write_bytes(b"P5\n# Offset -108\n360 181\n65535\n" + bytes(100))
    with pytest.raises(DataError, match=r"bad\.pgm: not one of GeographicLib's geoid grids \(Offset, Scale, 65535\)"):
        open_geoid(tmp_path / "bad.pgm")
    short = pgm(tmp_path / "short.pgm")
    short.write_bytes(short.read_bytes()[:2000])
    with pytest.raises(DataError, match=r"short\.pgm: not one of"):
        open_geoid(short)


@pytest.mark.parametrize(
    ("make", "how", "error", "message"),
    [
        (lambda p: p / "none.gtx", {}, DataError, r"none\.gtx: no such file, expected a geoid grid"),
        (lambda p: tif(p / "a.tif"), {}, DataError, r"a\.tif: neither the file nor its name says .* expected datum="),
        (lambda p: tif(p / "a.tif"), {"datum": "EGM69"}, ConfigError, r"a\.tif: datum is 'EGM69' \(did you mean"),
        (
            lambda p: tif(p / "egm96.tif", "EPSG:32632"),
            {},
            DataError,
            "expected a geoid grid in latitude and longitude",
        ),
        (lambda p: netcdf(p / "egm96.nc"), {"variable": "x"}, DataError, "no variable 'x'"),
    ],
)
def test_files_that_are_no_geoid(tmp_path: Path, make: object, how: dict[str, str], error: type, message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        open_geoid(make(tmp_path), **how)  # type: ignore[operator]
    assert "\n" not in str(caught.value)


def test_a_terrain_map_is_not_taken_for_a_geoid(tmp_path: Path) -> None:
    write_map(Map(HEIGHTS + 500.0, (STEP, 0.0, 8.0, 0.0, -STEP, 48.0), datum="EGM96"), tmp_path / "hills.tif")
    with pytest.raises(
        DataError, match=r"hills\.tif: holds a height of 5\d\d\.?\d* m, but geoid heights stay within 120"
    ):
        open_geoid(tmp_path / "hills.tif")


def test_a_national_geoid_goes_by_the_datum_it_is_for(tmp_path: Path) -> None:
    geoid = open_geoid(tif(tmp_path / "us_noaa_g2018u0.tif"), datum="EPSG:5703")
    chart = Map(HEIGHTS, (0.01, 0.0, 10.0, 0.0, -0.01, 46.0), datum="NAVD 88", name="hills")
    converted = convert_map(chart, "ellipsoid", geoid)
    assert converted.datum == "ellipsoid"
    np.testing.assert_allclose(
        converted.sample(45.9, 10.1), chart.sample(45.9, 10.1) + geoid.height(45.9, 10.1), atol=1e-3
    )


def test_grids_are_found_where_proj_keeps_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PROJ_DATA", str(tmp_path))
    assert tmp_path in geoid_io._folders()
    monkeypatch.setattr(geoid_io, "_folders", lambda: [tmp_path])
    monkeypatch.setattr(geoid_io, "_packaged", lambda: None)
    assert find_geoid("EGM96") is None
    gtx(tmp_path / "egm96_15.gtx")
    found = find_geoid("EGM96")
    assert found is not None
    assert (found.datum, found.source) == ("EGM96", "egm96_15.gtx")
    assert find_geoid("EGM2008") is None
    assert find_geoid("NAVD 88") is None


def test_the_package_serves_where_it_has_heights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geoid_io, "_folders", list)
    monkeypatch.setitem(sys.modules, "egm96", None)
    assert find_geoid("EGM96") is None
    monkeypatch.setitem(sys.modules, "egm96", SimpleNamespace())  # its release for Python 3.11
    assert find_geoid("EGM96") is None
    field = SimpleNamespace(undulation=lambda lat, lon: 10.0 * np.sin(np.radians(lat)) + 0.0 * np.asarray(lon))
    monkeypatch.setitem(sys.modules, "egm96", field)
    found = find_geoid("EGM96")
    assert found is not None
    np.testing.assert_allclose(found.height([30.0, 90.0, -5.0], [10.0, 0.0, 180.0]), [5.0, 10.0, -0.87156], atol=1e-4)


def test_a_mosaic_is_converted_to_a_map_in_memory(tmp_path: Path) -> None:
    for west in (10.0, 10.32):
        write_map(Map(HEIGHTS, (0.01, 0.0, west, 0.0, -0.01, 46.0), datum="EGM96"), tmp_path / f"{west:.2f}.tif")
    chart, geoid = tn.open_map(tmp_path), open_geoid(gtx(tmp_path / "egm96.gtx"))
    high = convert_map(chart, "ellipsoid", geoid)
    assert type(high) is Map
    lat, lon = np.random.default_rng(6).uniform((45.8, 10.01), (45.95, 10.6), (50, 2)).T
    np.testing.assert_allclose(high.sample(lat, lon), chart.sample(lat, lon) + geoid.height(lat, lon), atol=2e-3)


@pytest.mark.usefixtures("nothing_installed")
def test_what_the_user_gives_comes_first(tmp_path: Path) -> None:
    own = open_geoid(gtx(tmp_path / "egm96_15.gtx"))
    find = finder([own, netcdf(tmp_path / "egm2008.nc")])
    assert find("EGM96") is own
    other = find("EGM2008")
    assert other is not None
    assert other.datum == "EGM2008"
    assert finder()("EGM96") is None
    for wrong in (5, [5]):
        with pytest.raises(ConfigError, match="expected a file"):
            finder(wrong)  # type: ignore[arg-type]


@pytest.mark.usefixtures("nothing_installed")
def test_without_a_grid_a_height_is_refused_where_proj_lets_it_pass() -> None:
    from pyproj import Transformer
    from pyproj.transformer import TransformerGroup

    group = TransformerGroup("EPSG:4979", "EPSG:4326+5773", always_xy=True)
    if group.best_available:
        pytest.skip("PROJ has an EGM96 grid here")
    silent = Transformer.from_crs("EPSG:4979", "EPSG:4326+5773", always_xy=True)
    assert silent.transform(9.5, 47.5, 500.0)[2] == 500.0  # the trap: 48 m off, and not a word
    chart = Map(HEIGHTS, (0.01, 0.0, 9.0, 0.0, -0.01, 48.0), datum="EGM96", name="hills")
    with pytest.raises(DataError, match=r"^hills: .* up to 107 m, and no grid .* expected the geoid grid of EGM96"):
        convert_map(chart, "ellipsoid")


@pytest.mark.parametrize("datum", ["EGM96", "EGM2008"])
def test_published_heights(datum: str) -> None:
    geoid = find_geoid(datum)
    if geoid is None:
        pytest.skip(f"no {datum} grid is installed (PROJ's us_nga_*.tif or proj-data, GeographicLib, package egm96)")
    lat, lon, height = np.array(NGA[datum]).T
    np.testing.assert_allclose(
        [float(geoid.height(*place)) for place in zip(lat, lon, strict=True)], height, atol=0.015
    )


def test_real_crops_of_egm2008(shared_data: Path) -> None:
    """A map in the Alps: the change is the geoid there (rasterio and bilinear weights), to a centimetre."""
    file = shared_data / "gravity" / "egm2008_2p5min_alps_s_germany.nc"
    geoid = open_geoid(file)
    assert geoid.datum == "EGM2008"
    chart = tn.open_map(shared_data / "srtm" / "N47E009.hgt").crop(47.2, 9.2, 47.5, 9.6)
    low = replace(chart, datum="EGM2008")
    with rasterio.open(f"netcdf:{file}:geoid_h") as raster:
        values, place = raster.read(1).astype(np.float64), raster.transform
    south, west, north, east = chart.bounds_deg
    at = np.random.default_rng(8).uniform((south, west), (north, east), (300, 2)).T
    col, row = ~place @ (at[1], at[0])
    i, j, u, v = (*(part.astype(int) for part in (row - 0.5, col - 0.5)), (row - 0.5) % 1.0, (col - 0.5) % 1.0)
    upper = (1 - v) * values[i, j] + v * values[i, j + 1]
    lower = (1 - v) * values[i + 1, j] + v * values[i + 1, j + 1]
    expected = (1 - u) * upper + u * lower
    np.testing.assert_allclose(geoid.height(at[0], at[1], "bilinear"), expected, atol=1e-4)
    shift = convert_map(low, "ellipsoid", file).sample(*at) - low.sample(*at)
    known = np.isfinite(shift)
    assert known.sum() > 250
    np.testing.assert_allclose(shift[known], expected[known], atol=0.03)  # bicubic; the bilinear one cuts corners
    np.testing.assert_allclose(shift[known], geoid.height(*at)[known], atol=0.01)
    assert 45.0 < shift[known].min() < shift[known].max() < 55.0


@pytest.mark.parametrize("datum", ["EGM96", "EGM2008", "ellipsoid", "NAVD 88", "mean sea level", "local", "MLLW", None])
@pytest.mark.parametrize("suffix", [".tif", ".nc"])
def test_a_written_map_keeps_its_datum(tmp_path: Path, datum: str | None, suffix: str) -> None:
    chart = Map(HEIGHTS, (0.01, 0.0, 10.0, 0.0, -0.01, 46.0), datum=datum)
    write_map(chart, tmp_path / f"map{suffix}")
    assert vertical_datum(tn.open_map(tmp_path / f"map{suffix}").datum) == datum


@pytest.mark.parametrize(
    ("crs", "tags", "datum"),
    [
        ("EPSG:4326+3855", {}, "EGM2008"),
        ("EPSG:4979", {}, "ellipsoid"),
        ("EPSG:4326", {"DTED_VerticalDatum": "E96"}, "EGM96"),
        ("EPSG:4326", {"DTED_VerticalDatum": "MSL"}, "mean sea level"),
        ("EPSG:4326", {"VERTICAL_DATUM": "not stated"}, None),
        ("EPSG:4326", {"VERTICAL_DATUM": "EPSG:5703"}, "NAVD 88"),
        ("EPSG:4326", {}, None),
    ],
)
def test_what_a_geotiff_says(tmp_path: Path, crs: str, tags: dict[str, str], datum: str | None) -> None:
    chart = tn.open_map(tif(tmp_path / "map.tif", crs, **tags))
    assert vertical_datum(chart.datum) == datum
    assert np.isfinite(chart.sample(45.0, 10.0))


@pytest.mark.parametrize(
    ("own", "whole", "datum"),
    [
        ({"vertical_datum": "EGM2008"}, {}, "EGM2008"),
        ({"standard_name": "height_above_reference_ellipsoid"}, {}, "ellipsoid"),
        ({"standard_name": "altitude"}, {}, "mean sea level"),
        ({"standard_name": "altitude", "geoid": "EGM96"}, {}, "EGM96"),
        ({"standard_name": "surface_altitude"}, {}, None),
        ({}, {"vertical_datum": "MLLW"}, "MLLW"),
        ({"vertical_datum": "unknown"}, {"geoid_name": "EGM96"}, "EGM96"),
        ({"vertical_datum": 5}, {}, None),
        ({}, {}, None),
    ],
)
def test_what_netcdf_says(tmp_path: Path, own: dict[str, object], whole: dict[str, str], datum: str | None) -> None:
    data = xr.open_dataset(netcdf(tmp_path / "a.nc")).assign_attrs(whole)
    data["geoid_h"].attrs.update(own)
    data.to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    assert tn.open_map(tmp_path / "b.nc").datum == datum


def test_a_compound_crs_in_netcdf(tmp_path: Path) -> None:
    from pyproj import CRS

    data = xr.open_dataset(netcdf(tmp_path / "a.nc"))
    data["crs"] = xr.DataArray(np.int32(0), attrs={"crs_wkt": CRS.from_user_input("EPSG:4326+5773").to_wkt()})
    data["geoid_h"].attrs["grid_mapping"] = "crs"
    data.to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    chart = tn.open_map(tmp_path / "b.nc")
    assert (chart.crs, vertical_datum(chart.datum)) == ("EPSG:4326", "EGM96")


def test_real_files_say_egm96(shared_data: Path) -> None:
    for file in ("srtm/N47E009.hgt", "srtm/n46_e008_3arc_v2.tif", "dted/n00_e006_3arc_v2.dt1"):
        assert tn.open_map(shared_data / file).datum == "EGM96"

from __future__ import annotations

import shutil
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray as xr
from numpy.typing import NDArray
from pyproj import Transformer
from rasterio.transform import Affine
from scipy.io import netcdf_file

import terranav as tn
from terranav.core.errors import DataWarning
from tests.real_maps import REAL_MAPS, RealMap, bilinear_reference, place

ROWS, COLS = 5, 7
VALUES = np.random.default_rng(3).uniform(100.0, 900.0, (ROWS, COLS)).round()
NORTH_UP = Affine(0.01, 0.0, 10.0, 0.0, -0.01, 46.0)  # cell centres at 10.005.., 45.995..


def centres(transform: Affine = NORTH_UP) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Latitude and longitude of the cell centres of a geographic raster, (rows, cols) each."""
    col, row = np.meshgrid(np.arange(COLS) + 0.5, np.arange(ROWS) + 0.5)
    lon, lat = place(transform, row, col)
    return lat, lon


def write_tif(path: Path, values: NDArray[Any] = VALUES, **more: Any) -> Path:
    tags, units, scales, offsets = (more.pop(key, None) for key in ("tags", "units", "scales", "offsets"))
    mask = more.pop("mask", None)
    bands = values if values.ndim == 3 else values[None]
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "dtype": "float32",
        "crs": "EPSG:4326",
        "transform": NORTH_UP,
        "count": bands.shape[0],
        "height": bands.shape[1],
        "width": bands.shape[2],
        **more,
    }
    with rasterio.open(path, "w", **profile) as raster:
        if tags:
            raster.update_tags(**tags)
        raster.write(bands.astype(profile["dtype"]))
        if units:
            raster.units = units
        if scales:
            raster.scales, raster.offsets = scales, offsets
        if mask is not None:
            raster.write_mask(mask)
    return path


# -- real files -------------------------------------------------------------------------------------------------------


def probes(values: NDArray[np.float64], transform: Any, crs: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions all over a raster and beyond: anywhere, on cells, on edges and corners, around voids."""
    rng = np.random.default_rng(11)
    rows, cols = values.shape
    anywhere = rng.uniform([-3, -3], [rows + 2, cols + 2], (3000, 2))
    nodes = rng.integers([0, 0], [rows, cols], (300, 2)).astype(float)
    along = rng.uniform(0, 1, 400)
    edges = np.concatenate(
        [
            np.stack([np.repeat([0.0, rows - 1.0], 100), along[:200] * (cols - 1)], axis=1),
            np.stack([along[200:] * (rows - 1), np.repeat([0.0, cols - 1.0], 100)], axis=1),
            [[0.0, 0.0], [0.0, cols - 1], [rows - 1, 0.0], [rows - 1, cols - 1]],
        ]
    )
    voids = np.argwhere(np.isnan(values))
    if len(voids):
        around = voids[rng.integers(0, len(voids), 1000)] + rng.uniform(-2, 2, (1000, 2))
        beside = voids[rng.integers(0, len(voids), 1000)] + rng.integers(-1, 2, (1000, 2))  # exactly on neighbours
        voids = np.concatenate([around, beside])
    row, col = np.concatenate([anywhere, nodes, edges, voids.reshape(-1, 2)]).T
    x, y = place(transform, row + 0.5, col + 0.5)
    lon, lat = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(x, y)
    return lat, lon


@pytest.mark.parametrize("real", REAL_MAPS, ids=lambda real: real.path)
def test_sampling_agrees_with_gdal_and_plain_numpy(shared_data: Path, real: RealMap) -> None:
    m = tn.open_map(shared_data / real.path, **real.options)
    values, transform, crs = real.reference(shared_data)
    lat, lon = probes(values, transform, crs)
    expected = bilinear_reference(values, transform, crs, lat, lon)
    found = m.sample(lat, lon)
    assert np.isfinite(expected).sum() > 500
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    np.testing.assert_allclose(found, expected, atol=0.01, rtol=0)
    assert int(np.isnan(values).sum()) == m.info()["voids"]


def test_neighbouring_tiles_share_their_edge(shared_data: Path) -> None:
    west, east = (tn.open_map(shared_data / "srtm" / f"N48E0{name}.hgt") for name in ("09", "10"))
    lat = np.linspace(48.0, 49.0, 1201)
    np.testing.assert_allclose(west.sample(lat, 10.0), east.sample(lat, 10.0), atol=1e-9)


def test_a_zipped_hgt_is_the_same_map(shared_data: Path, tmp_path: Path) -> None:
    plain = shared_data / "srtm" / "N48E009.hgt"
    zipped = tmp_path / "N48E009.hgt.zip"
    with zipfile.ZipFile(zipped, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(plain, plain.name)
    assert tn.open_map(zipped).checksum == tn.open_map(plain).checksum


# -- formats ----------------------------------------------------------------------------------------------------------


def test_values_stand_at_their_cells(tmp_path: Path) -> None:
    m = tn.open_map(write_tif(tmp_path / "a.tif"), sigma=1.5)
    np.testing.assert_allclose(m.sample(*centres()), VALUES, atol=1e-4)
    assert (m.kind, m.unit, m.sigma, m.crs, m.name, m.source) == ("terrain", "m", 1.5, "EPSG:4326", "a.tif", "a.tif")


def test_pixel_is_point_puts_the_first_post_on_the_tie_point(tmp_path: Path) -> None:
    path = write_tif(tmp_path / "a.tif", tags={"AREA_OR_POINT": "Point"})
    np.testing.assert_allclose(tn.open_map(path).sample(*centres()), VALUES, atol=1e-4)


def test_rows_from_the_south(tmp_path: Path) -> None:
    south_up = Affine(0.01, 0.0, 10.0, 0.0, 0.01, 45.95)
    m = tn.open_map(write_tif(tmp_path / "a.tif", VALUES[::-1], transform=south_up))
    np.testing.assert_allclose(m.sample(*centres()), VALUES, atol=1e-4)


def test_rotated_and_sheared(tmp_path: Path) -> None:
    turned = Affine(0.0087, 0.0051, 10.0, 0.005, -0.0104, 46.0)
    m = tn.open_map(write_tif(tmp_path / "a.tif", transform=turned))
    np.testing.assert_allclose(m.sample(*centres(turned)), VALUES, atol=1e-4)


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "int32", "float32", "float64"])
def test_any_number_type(tmp_path: Path, dtype: str) -> None:
    m = tn.open_map(write_tif(tmp_path / "a.tif", VALUES // 4, dtype=dtype))
    assert m.values.dtype == np.float32
    np.testing.assert_array_equal(m.values, VALUES // 4)


def test_scale_offset_and_nodata(tmp_path: Path) -> None:
    stored = VALUES.copy()
    stored[1, 2] = -32768
    m = tn.open_map(
        write_tif(tmp_path / "a.tif", stored, dtype="int16", nodata=-32768, scales=(0.25,), offsets=(-10.0,))
    )
    expected = VALUES * 0.25 - 10.0
    expected[1, 2] = np.nan
    np.testing.assert_allclose(m.values, expected)


def test_nodata_nan_and_infinities_are_voids(tmp_path: Path) -> None:
    stored = VALUES.copy()
    stored[0, 0], stored[2, 3] = np.nan, np.inf
    m = tn.open_map(write_tif(tmp_path / "a.tif", stored))
    assert np.argwhere(np.isnan(m.values)).tolist() == [[0, 0], [2, 3]]


def test_a_mask_beside_the_values(tmp_path: Path) -> None:
    mask = np.full((ROWS, COLS), 255, dtype=np.uint8)
    mask[3, 4] = 0
    m = tn.open_map(write_tif(tmp_path / "a.tif", mask=mask))
    assert np.argwhere(np.isnan(m.values)).tolist() == [[3, 4]]


def test_feet_in_the_file_become_metres(tmp_path: Path) -> None:
    m = tn.open_map(write_tif(tmp_path / "a.tif", units=("ft",)))
    np.testing.assert_allclose(m.values, VALUES * 0.3048, rtol=1e-6)


def test_feet_said_by_the_user_become_metres(tmp_path: Path) -> None:
    m = tn.open_map(write_tif(tmp_path / "a.tif"), unit="us-ft")
    np.testing.assert_allclose(m.values, VALUES * 1200 / 3937, rtol=1e-6)


def test_band_by_number_and_by_name(tmp_path: Path) -> None:
    path = write_tif(tmp_path / "a.tif", np.stack([VALUES, VALUES + 1.0]))
    with rasterio.open(path, "r+") as raster:
        raster.descriptions = ("low", "high")
    for variable in (2, "2", "high"):
        np.testing.assert_array_equal(tn.open_map(path, variable=variable).values, VALUES + 1.0)
    with pytest.raises(
        tn.DataError, match=r"a\.tif: several bands, say which with variable=; bands in it: 1 low, 2 high"
    ):
        tn.open_map(path)
    with pytest.raises(tn.DataError, match="no band 'hihg'"):
        tn.open_map(path, variable="hihg")


def test_esri_ascii_asks_for_its_crs(tmp_path: Path) -> None:
    path = tmp_path / "a.asc"
    rows = "\n".join(" ".join(f"{value:g}" for value in row) for row in VALUES)
    head = f"ncols {COLS}\nnrows {ROWS}\nxllcorner 10.0\nyllcorner 45.95\ncellsize 0.01\nNODATA_value -9999\n"
    path.write_text(head + rows + "\n")
    with pytest.raises(tn.DataError, match=r"a\.asc: states no CRS .* expected crs= \(e\.g\. 'EPSG:4326'\)"):
        tn.open_map(path)
    np.testing.assert_allclose(tn.open_map(path, crs="EPSG:4326").sample(*centres()), VALUES, atol=1e-4)


def test_vrt(tmp_path: Path) -> None:
    write_tif(tmp_path / "a.tif")
    (tmp_path / "a.vrt").write_text(
        f'<VRTDataset rasterXSize="{COLS}" rasterYSize="{ROWS}"><SRS>EPSG:4326</SRS>'
        "<GeoTransform>10.0, 0.01, 0, 46.0, 0, -0.01</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        '<SourceFilename relativeToVRT="1">a.tif</SourceFilename><SourceBand>1</SourceBand>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    np.testing.assert_allclose(tn.open_map(tmp_path / "a.vrt").sample(*centres()), VALUES, atol=1e-4)


def test_compound_crs_gives_the_datum(tmp_path: Path) -> None:
    m = tn.open_map(write_tif(tmp_path / "a.tif", crs="EPSG:4326+5773"))
    assert m.datum == "EGM96"
    np.testing.assert_allclose(m.sample(*centres()), VALUES, atol=1e-4)


# -- NetCDF and GMT ---------------------------------------------------------------------------------------------------


def write_nc(path: Path, engine: str = "h5netcdf", *, lat_step: int = 1, lon_step: int = 1, flip: bool = False) -> Path:
    lat, lon = centres()
    z = xr.DataArray(VALUES, {"lat": lat[:, 0], "lon": lon[0]}, ("lat", "lon"), "z", {"units": "m"})
    z = z.isel(lat=slice(None, None, lat_step), lon=slice(None, None, lon_step))
    (z.transpose() if flip else z).to_dataset().to_netcdf(path, engine=engine)  # type: ignore[call-overload]
    return path


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
@pytest.mark.parametrize("lat_step", [1, -1])
@pytest.mark.parametrize("lon_step", [1, -1])
@pytest.mark.parametrize("flip", [False, True])
def test_netcdf_axes_in_any_order(tmp_path: Path, engine: str, lat_step: int, lon_step: int, flip: bool) -> None:
    m = tn.open_map(write_nc(tmp_path / "a.nc", engine, lat_step=lat_step, lon_step=lon_step, flip=flip))
    assert m.crs == "EPSG:4326"
    np.testing.assert_allclose(m.sample(*centres()), VALUES, atol=1e-3)


def test_netcdf_with_longitudes_from_0_to_360(tmp_path: Path) -> None:
    lat, lon = centres()
    z = xr.DataArray(VALUES, {"lat": lat[:, 0], "lon": lon[0] + 340.0}, ("lat", "lon"), "z")
    z.to_dataset().to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    m = tn.open_map(tmp_path / "a.nc")
    for turn in (-20.0, 340.0):
        np.testing.assert_allclose(m.sample(lat, lon + turn), VALUES, atol=1e-3)
    assert m.bounds_deg[1] == pytest.approx(-9.995)


def test_depths_marked_positive_down_become_negative(tmp_path: Path) -> None:
    lat, lon = centres()
    z = xr.DataArray(VALUES, {"lat": lat[:, 0], "lon": lon[0]}, ("lat", "lon"), "depth", {"positive": "down"})
    z.to_dataset().to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    np.testing.assert_allclose(tn.open_map(tmp_path / "a.nc", kind="bathymetry").values, -VALUES)


@pytest.mark.parametrize("pixel", [0, 1])
def test_gmt_3_grid_of_one_dimension(tmp_path: Path, pixel: int) -> None:
    lat, lon = centres()
    edge = 0.005 if pixel else 0.0
    with netcdf_file(tmp_path / "a.grd", "w") as grd:
        grd.createDimension("side", 2)
        grd.createDimension("xysize", ROWS * COLS)
        for name, data, unit in (
            ("x_range", [lon.min() - edge, lon.max() + edge], b"longitude"),
            ("y_range", [lat.min() - edge, lat.max() + edge], b"latitude"),
            ("z_range", [VALUES.min(), VALUES.max()], b"m"),
            ("spacing", [0.01, 0.01], b""),
        ):
            variable = grd.createVariable(name, "d", ("side",))
            variable[:] = data
            variable.units = unit
        grd.createVariable("dimension", "i", ("side",))[:] = [COLS, ROWS]
        z = grd.createVariable("z", "f", ("xysize",))
        z[:] = VALUES.ravel()
        z.scale_factor, z.add_offset, z.node_offset = 1.0, 0.0, pixel
    np.testing.assert_allclose(tn.open_map(tmp_path / "a.grd").sample(*centres()), VALUES, atol=1e-3)


def test_netcdf_in_kilometres(tmp_path: Path) -> None:
    km = {"units": "km"}
    axes = {"y": ("y", np.arange(ROWS) * 0.5, km), "x": ("x", np.arange(COLS) * 0.5, km)}
    xr.DataArray(VALUES, axes, ("y", "x"), "z").to_dataset().to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    assert tn.open_map(tmp_path / "a.nc", crs="EPSG:32633").transform[0] == pytest.approx(500.0)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"x": np.arange(COLS)}, "dimension 'y' of 'z' has no axis"),
        (
            {"y": np.arange(ROWS) ** 2, "x": np.arange(COLS)},
            "axis 'y' runs from 0 to 16 unevenly, expected equal steps",
        ),
        ({"y": np.arange(ROWS), "x": np.arange(COLS)}, "states no CRS"),
    ],
)
def test_netcdf_without_what_a_map_needs(tmp_path: Path, axes: dict[str, Any], message: str) -> None:
    xr.DataArray(VALUES, axes, ("y", "x"), "z").to_dataset().to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with pytest.raises(tn.DataError, match=message) as caught:
        tn.open_map(tmp_path / "a.nc")
    assert one_line_naming(tmp_path / "a.nc", caught.value)


def test_netcdf_variable_is_chosen_by_name(tmp_path: Path) -> None:
    lat, lon = centres()
    axes = {"lat": lat[:, 0], "lon": lon[0]}
    both = {"height": (("lat", "lon"), VALUES), "count": (("lat", "lon"), VALUES + 1.0)}
    xr.Dataset(both, axes).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    np.testing.assert_array_equal(tn.open_map(tmp_path / "a.nc", variable="height").values, VALUES)
    with pytest.raises(tn.DataError, match=r"several grids \(height, count\), say which with variable="):
        tn.open_map(tmp_path / "a.nc")
    with pytest.raises(
        tn.DataError, match=r"no variable 'heigth' \(did you mean 'height'\?\); grids in it: height, count"
    ):
        tn.open_map(tmp_path / "a.nc", variable="heigth")


# -- bad input --------------------------------------------------------------------------------------------------------


def one_line_naming(path: Path, error: BaseException) -> bool:
    return str(error).startswith(f"{path}: ") and "\n" not in str(error)


def bad_files(folder: Path) -> dict[str, tuple[Path, str]]:
    """Files that are no maps, by what is wrong with them, and what the message must say."""
    files = {
        "missing": (folder / "nowhere.tif", "no such file"),
        "directory": (folder / "none", "no map in it, expected files such as"),
        "empty": (folder / "empty.tif", "is empty"),
        "text": (folder / "text.tif", "not a readable raster"),
        "truncated hgt": (folder / "N47E009.hgt", "of 1201 x 1201 or 3601 x 3601 two-byte values .* not 20000"),
        "nameless hgt": (folder / "alps.hgt", r"named after its south-west corner, such as N47E009\.hgt"),
        "truncated tif": (folder / "cut.tif", "not a readable raster"),
        "truncated netcdf": (folder / "cut.nc", "not a readable NetCDF grid"),
        "truncated classic": (folder / "cut3.nc", "not a readable NetCDF grid"),
        "one row": (write_tif(folder / "row.tif", VALUES[:1]), f"map of 1 x {COLS} cells, expected at least 2 rows"),
        "one row nc": (folder / "row.nc", f"map of 1 x {COLS} cells, expected at least 2 rows"),
        "all void": (write_tif(folder / "void.tif", VALUES * 0 - 9, nodata=-9), "every cell of the map is void"),
        "not on earth": (folder / "plain.tif", "not georeferenced|states no CRS"),
    }
    files["empty"][0].touch()
    files["text"][0].write_text("height 12\n")
    (folder / "none").mkdir()
    files["truncated hgt"][0].write_bytes(bytes(20000))
    files["nameless hgt"][0].write_bytes(bytes(2 * 1201 * 1201))
    large = np.random.default_rng(1).normal(size=(300, 300))
    files["truncated tif"][0].write_bytes(write_tif(folder / "whole.tif", large).read_bytes()[:9000])
    for key, engine in (("truncated netcdf", "h5netcdf"), ("truncated classic", "scipy")):
        files[key][0].write_bytes(write_nc(folder / "whole.nc", engine).read_bytes()[:300])
    lat, lon = centres()
    row = xr.DataArray(VALUES[:1], {"lat": lat[:1, 0], "lon": lon[0]}, ("lat", "lon"), "z")
    row.to_dataset().to_netcdf(files["one row nc"][0], engine="h5netcdf")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_tif(files["not on earth"][0], crs=None, transform=None)
    return files


WRONG = [
    "missing",
    "directory",
    "empty",
    "text",
    "truncated hgt",
    "nameless hgt",
    "truncated tif",
    "truncated netcdf",
    "truncated classic",
    "one row",
    "one row nc",
    "all void",
    "not on earth",
]


@pytest.mark.parametrize("wrong", WRONG)
def test_bad_files_get_one_clear_line(tmp_path: Path, wrong: str, capfd: pytest.CaptureFixture[str]) -> None:
    path, message = bad_files(tmp_path)[wrong]
    capfd.readouterr()
    with pytest.raises(tn.DataError, match=message) as caught:
        tn.open_map(path)
    assert one_line_naming(path, caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"crs": "EPSG:999999"}, tn.DataError, "unknown crs 'EPSG:999999', expected a name like 'EPSG:4326'"),
        ({"crs": "nonsense"}, tn.DataError, "unknown crs 'nonsense'"),
        ({"crs": "EPSG:4978"}, tn.DataError, "expected a geographic or projected CRS"),
        ({"sigma": -1.0}, tn.ConfigError, r"map sigma is -1\.0, expected a finite number and >= 0"),
        ({"sigma": float("nan")}, tn.ConfigError, "map sigma is nan"),
        ({"kind": "terain"}, tn.ConfigError, r"unknown map kind 'terain' \(did you mean 'terrain'\?\)"),
        ({"unit": "feets"}, tn.ConfigError, r"unknown unit of a terrain map 'feets' \(did you mean 'feet'\?\)"),
    ],
)
def test_bad_options(tmp_path: Path, options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        tn.open_map(write_tif(tmp_path / "a.tif"), **options)
    assert "\n" not in str(caught.value)


def test_a_unit_of_another_kind(tmp_path: Path) -> None:
    with pytest.raises(tn.DataError, match="the unit is 'mGal', expected one of a terrain map such as 'm'"):
        tn.open_map(write_tif(tmp_path / "a.tif", units=("mGal",)))


@pytest.mark.parametrize(
    ("values", "units", "options", "message"),
    [
        (VALUES * 20.0, None, {"unit": "m"}, "terrain on Earth stays within -450 to 8900 m; are they in feet"),
        (VALUES, ("ft",), {"unit": "m"}, "the file says that its unit is 'ft', taken as 'm' as declared"),
        (VALUES, ("cubits",), {}, "the unit 'cubits' is not known, taken as 'm'"),
        (VALUES, None, {"kind": "bathymetry"}, "seabed is negative below the datum; are these positive depths"),
        (VALUES * 0.0, None, {}, "every value is 0 m: a constant map"),
    ],
)
def test_doubtful_values_are_warned_of(
    tmp_path: Path, values: NDArray[Any], units: Any, options: dict[str, Any], message: str
) -> None:
    path = write_tif(tmp_path / "a.tif", values, units=units)
    with pytest.warns(DataWarning, match=message) as caught:
        tn.open_map(path, **options)
    assert [str(warning.message).startswith(str(path)) for warning in caught] == [True]
    assert caught[0].filename == __file__


def test_positive_depths_can_be_said(tmp_path: Path) -> None:
    path = write_tif(tmp_path / "a.tif")
    np.testing.assert_allclose(tn.open_map(path, kind="bathymetry", positive_down=True).values, -VALUES)


def test_the_users_name_is_kept_and_the_file_named_in_errors(tmp_path: Path) -> None:
    path = shutil.copy(write_tif(tmp_path / "a.tif"), tmp_path / "b.tif")
    assert tn.open_map(path, name="alps").name == "alps"
    with pytest.raises(tn.DataError, match=r"b\.tif: unknown crs"):
        tn.open_map(path, name="alps", crs="nonsense")

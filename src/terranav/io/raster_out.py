"""Maps to files: GeoTIFF, NetCDF and, where nothing would be lost, SRTM's .hgt; several grids to one GeoTIFF."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import ConfigError, DataError
from terranav.io.files import replacing
from terranav.io.thinning import Part, part_of

if TYPE_CHECKING:
    from rasterio.io import DatasetWriter

    from terranav.maps.map import Map

TILE = 256  # cells along the side of a GeoTIFF's blocks
_HGT_VOID = -32768
_VERTICAL = {
    "EGM96": 5773,
    "EGM96 height": 5773,
    "EGM2008": 3855,
    "EGM2008 height": 3855,
    "mean sea level": 5714,
    "MSL height": 5714,
}
_STANDARD_NAMES = {"terrain": "surface_altitude", "bathymetry": "height_above_mean_sea_level"}


def write_map(source: Map | Part, path: str | Path, *, force: bool = False) -> None:
    """Write a map to a file that `open_map` reads back with the same values at the same places.

    The unit is the kind's own and stands in the file, as does the vertical datum. What a file cannot say is left to who
    opens it: the kind, sigma and the correlation length.

    Parameters
    ----------
    source : Map or Part
    path : str or Path
        .tif (deflate, tiled, voids NaN), .nc (CF axes, HDF5), or .hgt (whole metres on SRTM's own grid only). What is
        large is written to .tif piece by piece; for the others it must fit into the memory.
    force : bool
        Replace a file that is there.

    Raises
    ------
    ConfigError
        Another suffix, or a file that is there without force.
    DataError
        The folder cannot be written, or the format cannot hold this map exactly; or the map is void throughout.
    """
    file = Path(path)
    part = source if isinstance(source, Part) else part_of(source)
    write = check_target(file, force=force)
    with replacing(file) as aside:
        try:
            write(part, aside, file)
        except DataError:
            raise
        except (RuntimeError, ValueError, TypeError) as problem:
            raise DataError(f"{file}: cannot be written ({' '.join(str(problem).split())[:200]})") from None


def check_target(path: str | Path, *, force: bool = False) -> Callable[[Part, Path, Path], None]:
    """What will write (part, where to, name it will have); ConfigError as of `write_map`, before any work is done."""
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix not in _WRITERS:
        raise ConfigError(f"{file}: the suffix is {suffix!r}, expected one of {', '.join(_WRITERS)}")
    if file.exists() and not file.is_dir() and not force:
        raise ConfigError(f"{file}: is there already, expected a new name or --force")
    return _WRITERS[suffix]


@dataclass(frozen=True, eq=False)
class Layer:
    """One band of a GeoTIFF.

    Attributes
    ----------
    name : str
        What it is: the band's description.
    values : (rows, cols)
        NaN where nothing is known.
    unit : str
        Empty for a plain number.
    """

    name: str
    values: NDArray[Any]
    unit: str = ""


def write_layers(
    path: str | Path, layers: Sequence[Layer], transform: Sequence[float], crs: str, *, force: bool = False
) -> None:
    """Write grids of one shape and place to a GeoTIFF, a named float32 band each: tiled, deflate, nodata NaN.

    Parameters
    ----------
    path : str or Path
        .tif or .tiff
    layers : sequence of Layer
        At least one.
    transform : 6 floats
        As `Map.transform`.
    crs : str
        Anything that rasterio takes.
    force : bool
        Replace a file that is there.

    Raises
    ------
    ConfigError
        Another suffix, a file that is there without force, or layers that are no grids of one shape.
    DataError
        The file cannot be written.
    """
    file = Path(path)
    shapes = sorted({np.shape(layer.values) for layer in layers})
    if file.suffix.lower() not in (".tif", ".tiff"):
        raise ConfigError(f"{file}: the suffix is {file.suffix!r}, expected .tif")
    if len(shapes) != 1 or len(shapes[0]) != 2:
        raise ConfigError(f"{file}: layers of shapes {shapes}, expected one or more grids of one shape")
    check_target(file, force=force)
    with replacing(file) as aside, _raster(aside, file, (len(layers), *shapes[0]), (transform, crs)) as raster:
        for band, layer in enumerate(layers, 1):
            raster.write(np.asarray(layer.values, dtype=np.float32), band)
            raster.set_band_description(band, layer.name)
        raster.units = tuple(layer.unit for layer in layers)


def _tif(part: Part, aside: Path, file: Path) -> None:
    """A GeoTIFF, piece by piece: whole blocks of it, so that none is written twice."""
    chart, known = part.chart, False
    place = part.place.transform, _with_vertical(part.place.crs, part.datum)
    with _raster(aside, file, (1, *part.shape), place) as raster:
        for (rows, cols), values in part.pieces():
            known = known or not bool(np.isnan(values).all())
            raster.write(values, 1, window=(rows, cols))
        raster.units = (chart.unit,)
        raster.update_tags(KIND=chart.kind, SOURCE=chart.source, VERTICAL_DATUM=part.datum or "not stated")
    if not known:
        raise DataError(f"{chart.name}: every cell of it is void, expected values")


@contextmanager
def _raster(
    aside: Path, file: Path, shape: tuple[int, int, int], place: tuple[Sequence[float], str]
) -> Iterator[DatasetWriter]:
    """A GeoTIFF to be filled, of so many bands, rows and columns, with a transform and a CRS."""
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.transform import Affine

    profile: dict[str, Any] = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": shape[0],
        "height": shape[1],
        "width": shape[2],
        "crs": place[1],
        "transform": Affine(*place[0]),
        "nodata": float("nan"),
        "compress": "deflate",
        "predictor": 3,
        "tiled": True,
        "blockxsize": TILE,
        "blockysize": TILE,
        "bigtiff": "if_safer",
    }
    try:
        with rasterio.open(aside, "w", **profile) as raster:
            yield raster
        _check_whole(aside, file)
    except DataError:  # is a ValueError, too, and says what it is
        raise
    except (RasterioError, ValueError) as problem:
        raise DataError(f"{file}: cannot be written ({' '.join(str(problem).split())[:200]})") from None


def _check_whole(aside: Path, file: Path) -> None:
    """Raise DataError where a GeoTIFF has lost blocks: GDAL says nothing of a disk that is full when it closes."""
    import rasterio
    from rasterio.errors import RasterioError

    size = aside.stat().st_size

    def is_there(raster: Any, band: int, place: str) -> bool:
        at, length = (raster.get_tag_item(f"BLOCK_{key}_{place}", "TIFF", band) for key in ("OFFSET", "SIZE"))
        return at is not None and int(at) + int(length) <= size

    try:
        with rasterio.open(aside) as raster:
            down, across = (-(-side // TILE) for side in raster.shape)
            places = [f"{j}_{i}" for i in range(down) for j in range(across)]
            whole = all(is_there(raster, band, place) for band in raster.indexes for place in places)
    except RasterioError:
        whole = False
    if not whole:
        raise DataError(f"{file}: cannot be written whole, expected a disk with space for it")


def _with_vertical(crs: str, datum: str | None) -> str:
    """The CRS with the vertical one that the datum names, where it is a known one."""
    code = _VERTICAL.get(datum or "")
    if code is None:
        return crs
    from pyproj import CRS
    from pyproj.crs import CompoundCRS

    flat, up = CRS.from_user_input(crs), CRS.from_epsg(code)
    if flat.is_compound or len(flat.axis_info) != 2:
        return crs
    return str(CompoundCRS(f"{flat.name} + {up.name}", [flat, up]).to_wkt())


def _netcdf(part: Part, aside: Path, file: Path) -> None:
    """A NetCDF file with one variable and its two axes."""
    import xarray as xr

    chart = part.whole()
    a, b, c, d, e, f = chart.transform
    if b or d:
        raise DataError(f"{file}: the rows of the map run aslant to its axes, which NetCDF cannot say; expected .tif")
    rows, cols = chart.shape
    y, x = f + e * (np.arange(rows) + 0.5), c + a * (np.arange(cols) + 0.5)
    y_axis, x_axis, mapping = _axes(chart.crs)
    about = {"units": chart.unit, "long_name": f"{chart.kind} map", "source": chart.source}
    if chart.kind in _STANDARD_NAMES:
        about["standard_name"] = _STANDARD_NAMES[chart.kind]
    if chart.datum:
        about["vertical_datum"] = chart.datum
    axes = {y_axis[0]: (y_axis[0], y, y_axis[1]), x_axis[0]: (x_axis[0], x, x_axis[1])}
    data = xr.Dataset({"z": ((y_axis[0], x_axis[0]), chart.values, about)}, axes, {"Conventions": "CF-1.8"})
    if mapping:
        data["crs"] = xr.DataArray(np.int32(0), attrs=mapping)
        data["z"].attrs["grid_mapping"] = "crs"
    packed = {"zlib": True, "complevel": 4, "shuffle": True, "dtype": "float32", "_FillValue": np.float32("nan")}
    aside.write_bytes(_netcdf_bytes(data, {"z": packed}))


def _netcdf_bytes(data: Any, encoding: dict[str, Any]) -> memoryview:
    """The file in memory: HDF5 ends the process when a disk is full as it closes a file there."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    held = io.BytesIO()
    with h5netcdf.File(held, "w") as file:
        data.dump_to_store(H5NetCDFStore(file), encoding=encoding)
    return held.getbuffer()


def _axes(crs: str) -> tuple[tuple[str, dict[str, str]], tuple[str, dict[str, str]], dict[str, Any]]:
    """Names and attributes of the axes down and across, and the grid mapping, empty for plain WGS-84."""
    from pyproj import CRS

    where = CRS.from_user_input(crs)
    mapping = {} if crs.upper() == "EPSG:4326" else {key: value for key, value in where.to_cf().items() if value != ""}
    if where.is_geographic:
        lat = {"units": "degrees_north", "standard_name": "latitude", "long_name": "latitude"}
        lon = {"units": "degrees_east", "standard_name": "longitude", "long_name": "longitude"}
        return ("lat", lat), ("lon", lon), mapping
    unit = {"metre": "m"}.get(where.axis_info[0].unit_name, where.axis_info[0].unit_name)
    down = {"units": unit, "standard_name": "projection_y_coordinate", "long_name": "y"}
    across = {"units": unit, "standard_name": "projection_x_coordinate", "long_name": "x"}
    return ("y", down), ("x", across), mapping


def _hgt(part: Part, aside: Path, file: Path) -> None:
    """An SRTM tile: refused where a value, a place or the name would not be exact."""
    rows, cols = part.shape
    if rows != cols or rows not in (1201, 3601):
        raise DataError(f"{file}: map of {rows} x {cols} cells, expected 1201 x 1201 or 3601 x 3601 for .hgt")
    if part.datum not in (None, "EGM96", "EGM96 height"):
        raise DataError(
            f"{file}: the heights count from {part.datum}, but .hgt holds EGM96 by definition; expected .tif"
        )
    chart = part.whole()
    known = ~np.isnan(chart.values)
    values = chart.values[known]
    if (
        chart.kind not in ("terrain", "bathymetry")
        or (values != np.round(values)).any()
        or np.abs(values).max() > 32767
    ):
        raise DataError(f"{file}: the values are not all whole metres within 32767, which .hgt holds; expected .tif")
    south, west, north, east = chart.bounds_deg
    lat, lon = round(south), round(west)
    name = f"{'S' if lat < 0 else 'N'}{abs(lat):02d}{'W' if lon < 0 else 'E'}{abs(lon):03d}"
    off = np.abs(np.array([south - lat, west - lon, north - lat - 1, east - lon - 1])).max()
    a, b, _, d, e, _ = chart.transform
    if chart.crs.upper() != "EPSG:4326" or a <= 0 or e >= 0 or b or d or off > 1e-6 / rows:
        raise DataError(f"{file}: the cells are not those of a 1 x 1 degree tile, which .hgt holds; expected .tif")
    if not re.fullmatch(name, file.stem, re.IGNORECASE):
        raise DataError(f"{file}: an .hgt file is named after its south-west corner, expected {name}.hgt")
    aside.write_bytes(np.where(known, chart.values, _HGT_VOID).astype(">i2").tobytes())


_WRITERS: dict[str, Callable[[Part, Path, Path], None]] = {
    ".tif": _tif,
    ".tiff": _tif,
    ".nc": _netcdf,
    ".hgt": _hgt,
}

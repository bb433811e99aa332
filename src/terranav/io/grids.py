"""NetCDF and GMT grids, classic and HDF5, of GMT 3 and newer: values, axes, unit and CRS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import nearest_name
from terranav.core.errors import DataError
from terranav.core.memory import need
from terranav.maps.datum import split_crs, vertical_datum
from terranav.maps.georeference import Transform, Window

STRIP_CELLS = 2**20  # cells that are read at once

_LONGITUDE = frozenset({"lon", "lons", "longitude", "degrees_east", "degree_east", "degree_e", "degrees_e"})
_LATITUDE = frozenset({"lat", "lats", "latitude", "degrees_north", "degree_north", "degree_n", "degrees_n"})
_ACROSS = _LONGITUDE | {"x", "easting", "projection_x_coordinate", "x-coordinate in cartesian system"}
_KILOMETRES = frozenset({"km", "kilometre", "kilometres", "kilometer", "kilometers"})
_UNEVEN = 0.02  # of a cell: what axes stored in single precision are off
_DATUM_KEYS = ("vertical_datum", "vertical_crs", "vertical_reference", "geopotential_datum_name", "geoid_name", "geoid")
#: CF standard names that say what heights count from; raster_out gives its heights one whatever they count from, so
#: surface_altitude and height_above_mean_sea_level say nothing
_DATUM_NAMES = {
    "height_above_reference_ellipsoid": "ellipsoid",
    "sea_floor_depth_below_mean_sea_level": "mean sea level",
    "sea_surface_height_above_mean_sea_level": "mean sea level",
    "altitude": "mean sea level",
}


@dataclass(frozen=True, slots=True)
class Grid:
    """What a reader finds in a file before it reads the values.

    Attributes
    ----------
    shape : (rows, cols)
    transform : 6 floats
        As in `Map`.
    read : function of (window, factor)
        ((first row, past the last), (first column, past the last)) -> the values of these cells as stored, scale and
        offset applied, times factor, NaN where void: (rows, cols) float32.
    crs : str or None
        None where the file says nothing.
    unit : str
        As the file states it, empty where it does not.
    datum : str or None
        Vertical datum, where the file states it.
    positive_down : bool
        The file says that its values are depths.
    again : function or None
        As `read`, for one window of many: the file stays open.
    """

    shape: tuple[int, int]
    transform: Transform
    read: Callable[[Window, float], NDArray[np.float32]]
    crs: str | None = None
    unit: str = ""
    datum: str | None = None
    positive_down: bool = False
    again: Callable[[Window, float], NDArray[np.float32]] | None = None


def in_strips(window: Window, part: Callable[[int, int], NDArray[Any]], factor: float = 1.0) -> NDArray[np.float32]:
    """The values of a window, read some rows at a time, so that little more memory is taken than they fill.

    Parameters
    ----------
    window : as of `Grid.read`
    part : function of (first row, past the last) that gives (rows, cols of the window)
    factor : float
    """
    (first, last), (west, east) = window
    step = max(STRIP_CELLS // (east - west), 1)
    if last - first <= step:
        whole = scaled(part(first, last), factor)
        return whole if whole.base is None else whole.copy()
    out = np.empty((last - first, east - west), np.float32)
    for row in range(first, last, step):
        past = min(row + step, last)
        out[row - first : past - first] = scaled(part(row, past), factor)
    return out


def scaled(values: NDArray[Any], factor: float) -> NDArray[np.float32]:
    """Values times a factor, which float32 cannot always hold; the same array where nothing is to be done."""
    found: NDArray[np.float32] = (values if factor == 1.0 else values * np.float64(factor)).astype(
        np.float32, copy=False
    )
    return found


def grid_names(file: Path) -> tuple[list[str], tuple[str, ...]]:
    """Names of the variables of a NetCDF file that can be maps, and every text attribute of the file and of them."""
    with _opened(file) as data:
        names = _grid_names(data)
        told = [data.attrs, *(data[name].attrs for name in names)]
        return names, tuple(value for facts in told for value in facts.values() if isinstance(value, str))


def is_netcdf(file: Path) -> bool:
    """Whether a file begins like NetCDF: classic, or HDF5 other than a bathymetric attributed grid (BAG)."""
    with file.open("rb") as stream:
        head = stream.read(8)
    return head[:3] == b"CDF" or (head == b"\x89HDF\r\n\x1a\n" and file.suffix.lower() != ".bag")


def read_grid(file: Path, variable: str | None) -> Grid:
    """Read one grid of a NetCDF file.

    Raises
    ------
    DataError
        Not readable, no such variable or several to choose from, axes missing or uneven.
    """
    with _opened(file) as data:
        if {"x_range", "y_range", "dimension", "z"} <= set(data.variables):
            return _read_gmt3(file, data)
        return _read_cf(file, data, variable)


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """The dataset of a file; what its readers raise is a DataError."""
    import xarray as xr

    with file.open("rb") as stream:
        engine: Any = {"engine": "scipy", "mmap": False} if stream.read(3) == b"CDF" else {"engine": "h5netcdf"}
    if engine["engine"] == "scipy":  # reads everything as it opens
        need(2.0 * file.stat().st_size, f"{file}: a classic NetCDF file, read whole")
    try:
        with xr.open_dataset(file, decode_times=False, **engine) as data:
            yield data
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, AttributeError, IndexError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DataError(f"{file}: not a readable NetCDF grid ({reason}), expected a GMT or CF grid") from None


def _read_gmt3(file: Path, data: Any) -> Grid:
    """Grid of GMT 3: z in one dimension, rows from the north, ranges instead of axes."""
    cols, rows = (int(size) for size in data["dimension"].values)
    z = data["z"]
    if rows < 2 or cols < 2 or z.size != rows * cols:
        raise DataError(
            f"{file}: {z.size} values for a map of {rows} x {cols} cells, expected at least 2 x 2 and as many"
        )
    (west, east), (south, north) = data["x_range"].values, data["y_range"].values
    whole = 0 if int(z.attrs.get("node_offset", 0)) else 1  # gridline registration: the range ends at cell centres
    dx, dy = (east - west) / (cols - whole), (north - south) / (rows - whole)
    half = 0.5 * whole
    transform = (float(dx), 0.0, float(west - half * dx), 0.0, float(-dy), float(north + half * dy))
    lonlat = _says(data["x_range"], _LONGITUDE) and _says(data["y_range"], _LATITUDE)
    unit = str(data["z_range"].attrs.get("units", "")) if "z_range" in data else ""
    values = z.values.reshape(rows, cols)

    def read(window: Window, factor: float) -> NDArray[np.float32]:
        west, east = window[1]
        return in_strips(window, lambda row, past: values[row:past, west:east], factor)

    return Grid((rows, cols), transform, read, "EPSG:4326" if lonlat else None, unit, _stated_datum(data, z))


def _read_cf(file: Path, data: Any, variable: str | None) -> Grid:
    """Grid with one axis per dimension, in either order and either direction."""
    z = _plane(file, data, variable)
    if min(z.shape) < 2:
        raise DataError(f"{file}: map of {z.shape[0]} x {z.shape[1]} cells, expected at least 2 rows and 2 columns")
    y_axis, x_axis = (_axis(file, z, dim) for dim in z.dims)
    (y0, dy), (x0, dx) = _even(file, y_axis), _even(file, x_axis)
    crs, datum = _stated_crs(data, z), _stated_datum(data, z)
    if crs is not None:
        crs, compound = split_crs(crs)
        datum = datum or compound
    if crs is None and _says(x_axis, _LONGITUDE) and _says(y_axis, _LATITUDE):
        crs = "EPSG:4326"

    def read(window: Window, factor: float) -> NDArray[np.float32]:
        west, east = window[1]
        with _opened(file) as again:
            plane = _plane(file, again, variable)
            return in_strips(window, lambda row, past: plane[row:past, west:east].values, factor)

    return Grid(
        shape=(z.shape[0], z.shape[1]),
        read=read,
        transform=(dx, 0.0, x0 - 0.5 * dx, 0.0, dy, y0 - 0.5 * dy),
        crs=crs,
        unit=str(z.attrs.get("units", "")),
        datum=datum,
        positive_down=str(z.attrs.get("positive", "")).lower() == "down",
    )


def _plane(file: Path, data: Any, variable: str | None) -> Any:
    """The variable in two dimensions, the one across last; its values are not read yet."""
    z = _pick(file, data, variable)
    while z.ndim > 2 and 1 in z.shape:
        z = z.isel({z.dims[z.shape.index(1)]: 0})
    if z.ndim != 2:
        raise DataError(f"{file}: variable {z.name!r} has {z.ndim} dimensions, expected 2 (rows and columns)")
    return z.transpose() if _says(_axis(file, z, z.dims[0]), _ACROSS) else z


def _pick(file: Path, data: Any, variable: str | None) -> Any:
    """The variable of this name, or the only one that can be a map."""
    grids = _grid_names(data)
    if variable is not None:
        if variable not in grids:
            known = ", ".join(grids) or "none"
            raise DataError(f"{file}: no variable {variable!r}{nearest_name(variable, grids)}; grids in it: {known}")
        return data[variable]
    if len(grids) != 1:
        found = f"several grids ({', '.join(grids)}), say which with variable=" if grids else "no grid"
        raise DataError(f"{file}: holds {found}, expected one variable in two dimensions")
    return data[grids[0]]


def _grid_names(data: Any) -> list[str]:
    """The variables that have two dimensions or more, of numbers."""
    return [str(name) for name, z in data.data_vars.items() if z.ndim >= 2 and np.issubdtype(z.dtype, np.number)]


def _axis(file: Path, z: Any, dim: Any) -> Any:
    """The coordinates along a dimension."""
    if dim not in z.coords or z.coords[dim].ndim != 1 or not np.issubdtype(z.coords[dim].dtype, np.number):
        raise DataError(
            f"{file}: dimension {dim!r} of {z.name!r} has no axis, expected a variable of coordinates along it"
        )
    return z.coords[dim]


def _says(axis: Any, words: frozenset[str]) -> bool:
    """Whether the name or an attribute of an axis is one of these words."""
    told = (axis.name, *(axis.attrs.get(key, "") for key in ("standard_name", "long_name", "units")))
    return any(str(text).strip().lower() in words for text in told)


def _even(file: Path, axis: Any) -> tuple[float, float]:
    """First coordinate and step of an axis; in metres where it is in kilometres."""
    at = axis.values.astype(np.float64)
    step = (at[-1] - at[0]) / (at.size - 1)
    if (
        not np.isfinite(at).all()
        or step == 0.0
        or np.abs(at - at[0] - step * np.arange(at.size)).max() > abs(step) * _UNEVEN
    ):
        raise DataError(f"{file}: axis {axis.name!r} runs from {at[0]:g} to {at[-1]:g} unevenly, expected equal steps")
    factor = 1000.0 if str(axis.attrs.get("units", "")).strip().lower() in _KILOMETRES else 1.0
    return float(at[0]) * factor, float(step) * factor


def _stated_crs(data: Any, z: Any) -> str | None:
    """The CRS that a grid mapping states, as WKT."""
    mapping = z.encoding.get("grid_mapping") or z.attrs.get("grid_mapping")
    if mapping is None or str(mapping) not in data.variables:
        return None
    attributes = data[str(mapping)].attrs
    for key in ("crs_wkt", "spatial_ref"):
        if attributes.get(key):
            return str(attributes[key])
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        return str(CRS.from_cf(attributes).to_wkt())
    except (CRSError, KeyError):
        return None


def _stated_datum(data: Any, z: Any) -> str | None:
    """The vertical datum that the attributes of the variable, of its grid mapping or of the file state."""
    mapping = str(z.encoding.get("grid_mapping") or z.attrs.get("grid_mapping"))
    told = [z.attrs, data[mapping].attrs if mapping in data.variables else {}, data.attrs]
    for facts in told:
        lower = {str(key).lower(): value for key, value in facts.items()}
        for key in _DATUM_KEYS:
            if isinstance(lower.get(key), str) and (name := vertical_datum(lower[key])):
                return name
    return _DATUM_NAMES.get(str(z.attrs.get("standard_name", "")))

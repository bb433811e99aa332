"""Maps from files: any GDAL raster (GeoTIFF, .hgt, DTED, ESRI ASCII, VRT...) and NetCDF or GMT grids."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from terranav.core.errors import ConfigError, DataError, DataWarning
from terranav.core.kinds import kind_named
from terranav.core.memory import need
from terranav.io.files import existing_file
from terranav.io.gdal import read_raster
from terranav.io.grids import Grid, is_netcdf, read_grid
from terranav.io.units import unit_factor
from terranav.maps.georeference import Georeference
from terranav.maps.info import suspicions
from terranav.maps.map import Map

Box = tuple[float, float, float, float]

#: 1-sigma map error taken where the user states none: SRTM and national terrain models (m), GEBCO-like relief off the
#: sounded tracks of the open sea (m), satellite gravity (mGal), and magnetic compilations (nT).
DEFAULT_SIGMA = {"terrain": 3.0, "bathymetry": 10.0, "gravity": 2.0, "magnetic": 20.0}

CELL_BYTES = 12  # that opening takes for each cell at its most: the value, and what looks it over

_WHAT = "a map raster"


def open_map(
    path: str | Path,
    *,
    kind: str = "terrain",
    sigma: float | None = None,
    correlation_m: float | None = None,
    crs: str | None = None,
    variable: str | int | None = None,
    unit: str | None = None,
    positive_down: bool = False,
    name: str | None = None,
    box: Box | None = None,
) -> Map:
    """Read a map from a file.

    Nodata, masks, scale, offset, row order and pixel-is-area or pixel-is-point are as the file says; the values are
    turned into the kind's unit. Whatever can be used but looks wrong (feet called metres, positive depths) is a
    DataWarning.

    Parameters
    ----------
    path : str or Path
        GeoTIFF, .hgt, .hgt.zip, DTED, ESRI ASCII, VRT or any other raster of GDAL; NetCDF, GMT .grd of any age.
    kind : str
        'terrain', 'bathymetry', 'gravity' or 'magnetic'.
    sigma : float, optional
        1-sigma of the map error [kind's unit], >= 0; by default 3 m, 10 m, 2 mGal, 20 nT for the kinds as above.
    correlation_m : float, optional
        Correlation length of the map error, > 0 [m]; by default `terranav.maps.map.CORRELATION_CELLS` cells.
    crs : str, optional
        Of the file's coordinates, as pyproj takes it; wins over the file's own. Needed where the file states none and
        its axes are not longitude and latitude.
    variable : str or int, optional
        Which variable (NetCDF) or band (its description, or its number from 1) where there are several.
    unit : str, optional
        Of the values, such as 'ft'; wins over what the file states. By default the file's, else the kind's own.
    positive_down : bool
        The values are depths: negate them. NetCDF's attribute positive = "down" does the same.
    name : str, optional
        What to call the map; by default the file's name.
    box : (south, west, north, east), optional
        Read only the cells whose centres enclose this box, as `Map.crop` would cut them out [deg]; memory is taken for
        these alone. East below west means a box across the antimeridian.

    Returns
    -------
    Map

    Raises
    ------
    DataError
        The file is missing, empty, not a raster, without what a map needs, or beside the box.
    ConfigError
        Unknown kind or unit, negative sigma, or a map that does not fit into the memory.
    """
    kind_row = kind_named(kind)
    file = existing_file(path, _WHAT)
    grid = _grid(file, variable)
    if crs is None and grid.crs is None:
        raise DataError(
            f"{file}: states no CRS and its axes are not longitude and latitude, expected crs= (e.g. 'EPSG:4326')"
        )
    doubts: list[str] = []
    factor = unit_factor(str(file), kind_row, grid.unit, unit, doubts)
    if positive_down or grid.positive_down:
        factor = -factor
    label = name or file.name
    with _named(file, label):
        place = Georeference(grid.shape, grid.transform, crs or str(grid.crs))
        window = ((0, grid.shape[0]), (0, grid.shape[1])) if box is None else place.window(*box)
        place = place.cropped(window)
    need(CELL_BYTES * math.prod(place.shape), f"{file}: map of {place.shape[0]} x {place.shape[1]} cells")
    values = grid.read(window, factor)
    values.setflags(write=False)  # the map may keep it without a copy
    with _named(file, label):
        result = Map(
            values=values,
            transform=place.transform,
            crs=place.crs,
            kind=kind,
            unit=kind_row.unit,
            sigma=DEFAULT_SIGMA[kind] if sigma is None else sigma,
            datum=grid.datum,
            source=file.name,
            name=label,
            correlation_m=correlation_m,
        )
    for doubt in (*doubts, *(f"{file}: {text}" for text in suspicions(result.values, kind))):
        warnings.warn(doubt, DataWarning, stacklevel=2)
    return result


def cell_count(path: str | Path, variable: str | int | None = None) -> int:
    """How many cells the map of a file has; its values are not read. The errors are those of `open_map`."""
    return math.prod(_grid(existing_file(path, _WHAT), variable).shape)


def _grid(file: Path, variable: str | int | None) -> Grid:
    """What is in a file."""
    if is_netcdf(file):
        return read_grid(file, None if variable is None else str(variable))
    return read_raster(file, variable)


@contextmanager
def _named(file: Path, label: str) -> Iterator[None]:
    """What is wrong with a map names its file."""
    try:
        yield
    except (DataError, ConfigError) as error:
        raise type(error)(f"{file}: {str(error).removeprefix(f'{label}: ')}") from None

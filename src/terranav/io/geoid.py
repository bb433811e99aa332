"""Geoid grids from files: GTX, GeoTIFF and NetCDF, GeographicLib's .pgm, and what PROJ and the egm96 package have.

Nothing is fetched. A grid is found among what is installed, or the user gives its file.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import ConfigError, DataError
from terranav.io.files import existing_file
from terranav.io.gdal import read_raster
from terranav.io.grids import Grid, grid_names, is_netcdf, read_grid
from terranav.maps.crs import projection
from terranav.maps.datum import Find, stated_datum, vertical_datum
from terranav.maps.datum import convert as convert_by
from terranav.maps.geoid import Geoid
from terranav.maps.georeference import Window
from terranav.maps.map import Map

Given = str | Path | Geoid | Iterable[str | Path | Geoid] | None

_WHAT = "a geoid grid (.gtx, .tif, .nc or GeographicLib's .pgm)"
#: what the grids are called where PROJ and GeographicLib keep them, the finest first
_NAMES = {
    "EGM96": ("us_nga_egm96_15.tif", "egm96_15.gtx", "geoids/egm96-5.pgm", "geoids/egm96-15.pgm"),
    "EGM2008": ("us_nga_egm08_25.tif", "egm08_25.gtx", "geoids/egm2008-1.pgm", "geoids/egm2008-2_5.pgm"),
    "EGM84": ("us_nga_egm84_30.tif", "geoids/egm84-15.pgm"),
}
_LARGEST_M = 120.0  # no geoid height on Earth is larger


def open_geoid(path: str | Path, *, datum: str | None = None, variable: str | int | None = None) -> Geoid:
    """Open a geoid grid; its heights are read when they are asked for.

    Parameters
    ----------
    path : str or Path
        GTX, GeoTIFF or any raster of GDAL, NetCDF, or a .pgm of GeographicLib; in latitude and longitude, heights above
        the WGS-84 ellipsoid [m].
    datum : str, optional
        The datum whose zero surface it is; by default what the file or its name says ('egm96_15.gtx').
    variable : str or int, optional
        Which variable or band, where several could be the geoid.

    Returns
    -------
    Geoid

    Raises
    ------
    DataError
        Not a readable grid, not in latitude and longitude, heights that no geoid has, or no word of its datum.
    ConfigError
        Unknown datum.
    """
    file = existing_file(path, _WHAT)
    grid, words = _read_pgm(file) if _is_pgm(file) else _read(file, variable)
    name = stated_datum(datum, f"{file}: datum") if datum is not None else _model((*words, file.name))
    if name is None:
        raise DataError(
            f"{file}: neither the file nor its name says which geoid it is, expected datum= (--geoid EGM2008=FILE)"
        )
    if grid.crs is not None and not projection(grid.crs).geographic:
        raise DataError(f"{file}: its CRS is {grid.crs[:60]!r}, expected a geoid grid in latitude and longitude")
    if grid.unit.strip().lower() not in ("", "m", "metre", "metres", "meter", "meters", "1", "unknown"):
        raise DataError(f"{file}: its unit is {grid.unit!r}, expected a geoid grid in metres")
    found = Geoid(name, grid.shape, grid.transform, lambda window: grid.read(window, 1.0), file.name)
    _check_heights(file, found)
    return found


def find_geoid(datum: str) -> Geoid | None:
    """The grid of a datum among what is installed, None where there is none.

    Looked for in PROJ's folders (pyproj's own and the user's, PROJ_DATA, PROJ_LIB, those of the system, where Debian's
    proj-data puts EGM96), in GeographicLib's, and, for EGM96, in the package `egm96`. PROJ itself is not asked to
    transform: without a grid it gives heights back unchanged.

    Parameters
    ----------
    datum : str
        As `terranav.maps.datum.vertical_datum` gives it.
    """
    for name in _NAMES.get(datum, ()):
        for folder in _folders():
            if (folder / name).is_file():
                return open_geoid(folder / name, datum=datum)
    return _packaged() if datum == "EGM96" else None


def finder(given: Given = None) -> Find:
    """What gives the geoid of a datum: one of those given, else an installed one.

    Parameters
    ----------
    given : path, Geoid, or several of them, optional

    Raises
    ------
    ConfigError, DataError
        As `open_geoid`, or something else is given.
    """
    several: Any = [given] if isinstance(given, (str, Path, Geoid)) else [] if given is None else given
    if not isinstance(several, Iterable):
        raise ConfigError(f"geoid is {given!r}, expected a file, a Geoid, or several of them")
    own: dict[str, Geoid] = {}
    for one in several:
        if not isinstance(one, (str, Path, Geoid)):
            raise ConfigError(f"geoid is {one!r}, expected a file or a Geoid")
        geoid = one if isinstance(one, Geoid) else open_geoid(one)
        own.setdefault(geoid.datum, geoid)

    @lru_cache(maxsize=16)
    def find(datum: str) -> Geoid | None:
        return own.get(datum) or find_geoid(datum)

    return find


def convert_map(chart: Map, to: str, geoid: Given = None) -> Map:
    """`terranav.maps.datum.convert` with grids from files or found; parameters and errors as there and in `finder`."""
    return convert_by(chart, to, finder(geoid))


def _model(words: Iterable[str]) -> str | None:
    """The first gravity model that any of some texts names."""
    found = (vertical_datum(text) for text in words)
    return next((name for name in found if name in _NAMES), None)


def _read(file: Path, variable: str | int | None) -> tuple[Grid, tuple[str, ...]]:
    """A grid of NetCDF or GDAL, and what it says of itself."""
    if not is_netcdf(file):
        grid = read_raster(file, variable)
        return grid, (grid.datum or "",)
    if variable is None:
        names, words = grid_names(file)
        likely = [
            name for name in names if re.match(r"geoid(?!.*(free|tide|2mean))|undulation|N$", name, re.IGNORECASE)
        ]
        variable = likely[0] if len(names) > 1 and len(likely) == 1 else None
    else:
        words = grid_names(file)[1]
    return read_grid(file, None if variable is None else str(variable)), words


def _is_pgm(file: Path) -> bool:
    with file.open("rb") as stream:
        return stream.read(2) == b"P5"


def _read_pgm(file: Path) -> tuple[Grid, tuple[str, ...]]:
    """GeographicLib's grids: two bytes a height, rows from the north pole, columns eastward from Greenwich."""
    with file.open("rb") as stream:
        head = stream.read(4096)
    match = re.match(rb"P5\s+((?:#[^\n]*\n\s*)*)(\d+)\s+(\d+)\s+65535\s", head)
    try:
        if match is None:
            raise ValueError
        facts = dict(re.findall(r"#\s*(\w+)\s+([^\n]*)", match[1].decode("latin-1")))
        offset, scale = float(facts["Offset"]), float(facts["Scale"])
        cols, rows = int(match[2]), int(match[3])
        values = np.memmap(file, dtype=">u2", mode="r", offset=match.end(), shape=(rows, cols))
        step_x, step_y = 360.0 / cols, 180.0 / (rows - 1)
    except (KeyError, ValueError, ZeroDivisionError):
        raise DataError(
            f"{file}: not one of GeographicLib's geoid grids (Offset, Scale, 65535), expected {_WHAT}"
        ) from None

    def read(window: Window, factor: float) -> NDArray[np.float32]:
        (first, past), (west, east) = window
        return ((values[first:past, west:east] * scale + offset) * factor).astype(np.float32)

    transform = (step_x, 0.0, -0.5 * step_x, 0.0, -step_y, 90.0 + 0.5 * step_y)
    return Grid((rows, cols), transform, read, "EPSG:4326", "m"), (facts.get("Description", ""),)


def _check_heights(file: Path, geoid: Geoid) -> None:
    """Raise DataError where a few heights over the grid are none of a geoid."""
    rows, cols = geoid.shape
    for row in {0, rows // 2, rows - 1}:
        values = geoid.read(((row, row + 1), (0, cols)))
        if np.isfinite(values).any() and np.nanmax(np.abs(values)) > _LARGEST_M:
            worst = float(values.ravel()[np.nanargmax(np.abs(values))])
            raise DataError(f"{file}: holds a height of {worst:g} m, but geoid heights stay within {_LARGEST_M:g} m")


def _folders() -> list[Path]:
    """Where PROJ and GeographicLib keep their grids."""
    datadir = import_module("pyproj.datadir")
    told = [datadir.get_data_dir(), os.environ.get("PROJ_DATA", ""), os.environ.get("PROJ_LIB", "")]
    found = [part for text in told for part in text.split(os.pathsep) if part]
    found += [datadir.get_user_data_dir(), os.environ.get("GEOGRAPHICLIB_DATA", "")]
    roots = (sys.prefix, "/usr", "/usr/local")
    found += [f"{root}/share/{kept}" for root in roots for kept in ("proj", "GeographicLib")]
    return [Path(folder) for folder in dict.fromkeys(found) if folder]


def _packaged() -> Geoid | None:
    """EGM96 of the package `egm96`, where that is installed and can be asked."""
    try:
        undulation = getattr(import_module("egm96"), "undulation", None)
    except ImportError:
        return None
    if undulation is None:  # its release for Python 3.11 is empty
        return None
    step = 1.0 / 12.0

    def read(window: Window) -> NDArray[np.float32]:
        (first, past), (west, east) = window
        lat, lon = 90.0 - step * np.arange(first, past), -180.0 + step * np.arange(west, east)
        heights: NDArray[np.float32] = np.asarray(undulation(lat[:, None], lon[None, :]), dtype=np.float32)
        return heights

    transform = (step, 0.0, -180.0 - 0.5 * step, 0.0, -step, 90.0 + 0.5 * step)
    return Geoid("EGM96", (2161, 4320), transform, read, "package egm96")

"""Maps from files: any GDAL raster (GeoTIFF, .hgt, DTED, ESRI ASCII, VRT...) and NetCDF or GMT grids."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from terranav.core.errors import DataWarning
from terranav.core.kinds import kind_named
from terranav.core.memory import need
from terranav.io.mosaics import mosaic_of, paths_of
from terranav.io.sources import How, Source, named, source_of
from terranav.maps.datum import stated_datum, vertical_datum
from terranav.maps.georeference import Box
from terranav.maps.info import suspicions
from terranav.maps.map import Map
from terranav.maps.mosaic import MEMORY_MB

#: 1-sigma map error taken where the user states none: SRTM and national terrain models (m), GEBCO-like relief off the
#: sounded tracks of the open sea (m), satellite gravity (mGal), and magnetic compilations (nT).
DEFAULT_SIGMA = {"terrain": 3.0, "bathymetry": 10.0, "gravity": 2.0, "magnetic": 20.0}

CELL_BYTES = 12  # that opening takes for each cell at its most: the value, and what looks it over
LARGE_CELLS = 2**26  # a map of more cells (256 MiB) stays in its file


def open_map(
    path: str | Path | Sequence[str | Path],
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
    datum: str | None = None,
    memory_mb: float = MEMORY_MB,
) -> Map:
    """Read a map from a file, or open a mosaic of many.

    Nodata, masks, scale, offset, row order and pixel-is-area or pixel-is-point are as the file says; the values are
    turned into the kind's unit. Whatever can be used but looks wrong (feet called metres, positive depths) is a
    DataWarning.

    Parameters
    ----------
    path : str or Path, or several
        GeoTIFF, .hgt, .hgt.zip, DTED, ESRI ASCII, VRT or any other raster of GDAL; NetCDF, GMT .grd of any age. Or
        tiles: a folder (and its folders), a pattern such as 'tiles/N4?E*.hgt', or a list of files. Several tiles, and a
        file of more than `LARGE_CELLS` cells, become a `terranav.maps.mosaic.Mosaic`, whose values stay in the files.
        Where tiles overlap, the finer one wins, of one grid the first by name; of a list the first in the list.
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
    datum : str, optional
        Vertical datum of the heights, such as 'EGM96', 'EGM2008', 'ellipsoid' or 'MLLW' (`terranav.maps.datum`); wins
        over what the file states.
    memory_mb : float
        Most memory for the values of a mosaic, at least 8 [MiB].

    Returns
    -------
    Map
        A `Mosaic` of tiles, unless a box is given.

    Raises
    ------
    DataError
        The file is missing, empty, not a raster, without what a map needs, or beside the box.
    ConfigError
        Unknown kind, unit or datum, negative sigma, or a map that does not fit into the memory.
    """
    how = How(kind, crs, variable, unit, positive_down)
    about = {"kind": kind, "sigma": DEFAULT_SIGMA.get(kind) if sigma is None else sigma, "correlation_m": correlation_m}
    about["datum"] = stated_datum(datum, "map datum")
    several = paths_of(path)
    if several is None:
        source = source_of(str(path), how, name)
        if box is not None or math.prod(source.place.shape) <= LARGE_CELLS:
            return _read(source, about, name or source.file.name, box)
    chart = mosaic_of(path, how, about | {"name": name}, memory_mb)
    return chart if box is None else chart.crop(*box)


def _read(source: Source, about: dict[str, Any], label: str, box: Box | None) -> Map:
    """The map of one file, or what lies in a box of it."""
    file, place, kind = source.file, source.place, str(about["kind"])
    with named(file, label):
        window = ((0, place.shape[0]), (0, place.shape[1])) if box is None else place.window(*box)
        place = place.cropped(window)
    need(CELL_BYTES * math.prod(place.shape), f"{file}: map of {place.shape[0]} x {place.shape[1]} cells")
    values = source.read(window)
    values.setflags(write=False)  # the map may keep it without a copy
    own: dict[str, Any] = {
        "unit": kind_named(kind).unit,
        "datum": about["datum"] or vertical_datum(source.grid.datum),
        "source": file.name,
        "name": label,
    }
    with named(file, label):
        result = Map(values, place.transform, place.crs, **about | own)
    for doubt in (*source.doubts, *(f"{file}: {text}" for text in suspicions(result.values, kind))):
        warnings.warn(doubt, DataWarning, stacklevel=3)
    return result

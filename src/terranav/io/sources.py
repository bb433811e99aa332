"""A map file before its values are read: its grid, how its values become the kind's unit, and what is doubtful."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import ConfigError, DataError
from terranav.core.kinds import kind_named
from terranav.io.files import existing_file
from terranav.io.gdal import read_raster
from terranav.io.grids import Grid, is_netcdf, read_grid
from terranav.io.units import unit_factor
from terranav.maps.georeference import Georeference, Window

WHAT = "a map raster"


@dataclass(frozen=True)
class How:
    """How map files are read; the options of `open_map` of these names."""

    kind: str = "terrain"
    crs: str | None = None
    variable: str | int | None = None
    unit: str | None = None
    positive_down: bool = False


@dataclass(frozen=True)
class Source:
    """A map file.

    Attributes
    ----------
    file : Path
    grid : Grid
    place : Georeference
    factor : float
        From the values as stored to the kind's unit, depths turned into heights.
    doubts : tuple of str
        One line for each thing that can be used but looks wrong.
    """

    file: Path
    grid: Grid
    place: Georeference
    factor: float
    doubts: tuple[str, ...] = ()

    def read(self, window: Window) -> NDArray[np.float32]:
        """The values of a window (rows, cols) in the kind's unit, NaN where void; DataError where it cannot be read."""
        return self.grid.read(window, self.factor)

    def read_again(self, window: Window) -> NDArray[np.float32]:
        """As `read`, for one window of many: the file may stay open."""
        return (self.grid.again or self.grid.read)(window, self.factor)


def source_of(path: str | Path, how: How, label: str | None = None) -> Source:
    """What is in a file.

    Parameters
    ----------
    path : str or Path
    how : How
    label : str, optional
        What the map is called; messages name the file instead.

    Raises
    ------
    DataError
        The file is missing, empty, not a raster, or without what a map needs.
    ConfigError
        Unknown kind or unit.
    """
    kind = kind_named(how.kind)
    file = existing_file(path, WHAT)
    grid = _grid(file, how.variable)
    if how.crs is None and grid.crs is None:
        raise DataError(
            f"{file}: states no CRS and its axes are not longitude and latitude, expected crs= (e.g. 'EPSG:4326')"
        )
    doubts: list[str] = []
    factor = unit_factor(str(file), kind, grid.unit, how.unit, doubts)
    if how.positive_down or grid.positive_down:
        factor = -factor
    with named(file, label or file.name):
        place = Georeference(grid.shape, grid.transform, how.crs or str(grid.crs))
    return Source(file, grid, place, factor, tuple(doubts))


@contextmanager
def named(file: Path, label: str) -> Iterator[None]:
    """What is wrong with a map names its file."""
    try:
        yield
    except (DataError, ConfigError) as error:
        raise type(error)(f"{file}: {str(error).removeprefix(f'{label}: ')}") from None


def _grid(file: Path, variable: str | int | None) -> Grid:
    if is_netcdf(file):
        return read_grid(file, None if variable is None else str(variable))
    return read_raster(file, variable)

"""Where a study's maps and recordings come from: the sample DEM, which is always at hand, and a folder of real data."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from terranav.core.errors import ConfigError, DataWarning
from terranav.io.rasters import open_map
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map

ENVIRONMENT = "TERRANAV_SHARED"  # names the folder in which `data` lies
TERRAIN_SUFFIXES = (".hgt", ".tif", ".tiff", ".dt0", ".dt1", ".dt2")
_DEPTH = 2  # folders below the data folder in which terrain maps are looked for


@dataclass(frozen=True)
class MapSource:
    """Where a map is read from, and how: small enough to send to another process.

    Attributes
    ----------
    path : Path or None
        None is the sample DEM.
    options : tuple of (keyword, value)
        Of `open_map`.
    """

    path: Path | None = None
    options: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """For tables."""
        return "sample" if self.path is None else self.path.stem

    def open(self) -> Map:
        """The map, read once in each process."""
        return _opened(self)

    def facts(self) -> dict[str, Any]:
        """What figures depend on: the values, not the place of the file."""
        chart = self.open()
        return {"name": self.name, "checksum": chart.checksum, "sigma": chart.sigma, "length_m": chart.error_length_m}


@lru_cache(maxsize=8)
def _opened(source: MapSource) -> Map:
    if source.path is None:
        return sample_map()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return open_map(source.path, **dict(source.options))


def data_folder(given: Path | None) -> Path | None:
    """The folder of real data: the one given, else `data` in the one that TERRANAV_SHARED names, else none.

    Raises
    ------
    ConfigError
        The given one is no folder.
    """
    if given is not None:
        if not given.is_dir():
            raise ConfigError(f"--data {given}: no such folder, expected one with maps and recordings")
        return given.resolve()
    shared = os.environ.get(ENVIRONMENT)
    folder = Path(shared) / "data" if shared else None
    return folder.resolve() if folder is not None and folder.is_dir() else None


def terrain_sources(data: Path | None, more: tuple[Path, ...] = ()) -> list[MapSource]:
    """The sample DEM, the rasters of a data folder that are terrain by their suffix, and the maps that were given."""
    found = [MapSource()]
    files = sorted(_rasters(data, _DEPTH), key=lambda path: path.relative_to(data).as_posix()) if data else []
    for path in (*files, *more):
        if not path.exists():
            raise ConfigError(f"--map {path}: no such file, expected a terrain map")
        found.append(MapSource(path.resolve(), (("kind", "terrain"),)))
    return found


def _rasters(folder: Path, depth: int) -> Iterator[Path]:
    """Files with a suffix of terrain maps."""
    for entry in folder.iterdir():
        if entry.is_dir() and depth > 0 and not entry.name.startswith("."):
            yield from _rasters(entry, depth - 1)
        elif entry.suffix.lower() in TERRAIN_SUFFIXES:
            yield entry

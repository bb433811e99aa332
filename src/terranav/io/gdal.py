"""Rasters of GDAL: shape, transform, CRS, vertical datum, unit, and a way to read a window of one band."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError
from terranav.io.grids import Grid, in_strips
from terranav.maps.georeference import Transform, Window

_DATUMS = {"E96": "EGM96", "E08": "EGM2008", "MSL": "mean sea level"}  # DTED's codes


def read_raster(file: Path, variable: str | int | None) -> Grid:
    """What one band of a GDAL raster is."""
    with _opened(file) as raster:
        band = _band(file, raster, variable)
        crs, datum = _crs_and_datum(file, raster)
        scale, offset, unit = raster.scales[band - 1], raster.offsets[band - 1], raster.units[band - 1] or ""
        shape, transform = (raster.height, raster.width), _transform(file, raster)

    def read(window: Window, factor: float) -> NDArray[np.float32]:
        with _opened(file) as again:

            def part(row: int, past: int) -> NDArray[np.float64]:
                rows = ((row, past), window[1])
                values: NDArray[np.float64] = again.read(band, window=rows).astype(np.float64) * scale + offset
                values[again.read_masks(band, window=rows) == 0] = np.nan
                return values

            return in_strips(window, part, factor)

    return Grid(shape, transform, read, crs, unit, datum)


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """A raster; what GDAL raises is a DataError."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    logging.getLogger("rasterio").addHandler(logging.NullHandler())  # GDAL's remarks stay off the terminal
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(file) as raster:
                yield raster
    except (RasterioError, OSError) as error:
        reason = " ".join(str(error).replace(f"'{file}'", "it").replace(str(file), "it").split())[:200]
        raise DataError(f"{file}: not a readable raster ({reason}), expected a map raster{_hgt_hint(file)}") from None


def _band(file: Path, raster: Any, variable: str | int | None) -> int:
    """Number of the band that was asked for, or of the only one."""
    names = [text or "" for text in raster.descriptions]
    if variable is None and raster.count == 1:
        return 1
    if isinstance(variable, str) and variable in names:
        return names.index(variable) + 1
    if str(variable).isdecimal() and 1 <= int(str(variable)) <= raster.count:
        return int(str(variable))
    bands = ", ".join(f"{i + 1} {text}".strip() for i, text in enumerate(names)) or "none"
    asked = "several bands, say which with variable=" if variable is None else f"no band {variable!r}"
    raise DataError(f"{file}: {asked if raster.count else 'no band'}; bands in it: {bands}")


def _transform(file: Path, raster: Any) -> Transform:
    """The affine of a raster that has one."""
    affine = raster.transform
    if affine.is_identity and raster.crs is None:
        raise DataError(f"{file}: not georeferenced, expected a raster with a transform from cells to coordinates")
    return affine.a, affine.b, affine.c, affine.d, affine.e, affine.f


def _crs_and_datum(file: Path, raster: Any) -> tuple[str | None, str | None]:
    """Horizontal CRS and vertical datum, where stated; .hgt is EGM96 by its definition."""
    code = raster.tags().get("DTED_VerticalDatum")
    datum = "EGM96" if raster.driver == "SRTMHGT" else _DATUMS.get(code, code)
    if raster.crs is None:
        return None, datum
    text = str(raster.crs.to_string())
    if text.startswith(("COMPD_CS", "COMPOUNDCRS", "EPSG:")) and (parts := _parts(text)):
        return parts[0], parts[1]
    return text, datum


def _parts(crs: str) -> tuple[str, str] | None:
    """Horizontal CRS and name of the vertical one of a compound CRS, None for others."""
    if crs in ("EPSG:4326", "EPSG:4269"):
        return None
    from pyproj import CRS

    whole = CRS.from_user_input(crs)
    if not whole.is_compound:
        return None
    horizontal, vertical = whole.sub_crs_list[:2]
    return str(horizontal.to_string()), str(vertical.name)


def _hgt_hint(file: Path) -> str:
    """What an .hgt file must be, since GDAL does not say why it refuses one."""
    if file.suffix.lower() != ".hgt":
        return ""
    if not re.match(r"[NS]\d\d[EW]\d\d\d", file.name, re.IGNORECASE):
        return " named after its south-west corner, such as N47E009.hgt"
    return f" of 1201 x 1201 or 3601 x 3601 two-byte values (2884802 or 25934402 bytes), not {file.stat().st_size}"

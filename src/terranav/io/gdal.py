"""Rasters of GDAL: shape, transform, CRS, vertical datum, unit, and a way to read a window of one band."""

from __future__ import annotations

import logging
import math
import os
import re
import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError
from terranav.io.grids import Grid, in_strips
from terranav.kernels.stored import converted
from terranav.maps.datum import split_crs, vertical_datum
from terranav.maps.georeference import Transform, Window

_DATUM_TAGS = ("dted_verticaldatum", "vertical_datum", "verticaldatum")  # DTED's own, and what write_map writes

MOST_OPEN = 8  # rasters that a thread keeps open
CACHE_BYTES = 32 * 2**20  # of decoded blocks of all files that are kept open, unless the environment says otherwise

_OPEN = threading.local()


def read_raster(file: Path, variable: str | int | None) -> Grid:
    """What one band of a GDAL raster is."""
    with _opened(file) as raster:
        band = _band(file, raster, variable)
        crs, datum = _crs_and_datum(file, raster, band)
        scale, offset, unit = raster.scales[band - 1], raster.offsets[band - 1], raster.units[band - 1] or ""
        shape, transform = (raster.height, raster.width), _transform(file, raster)
        void_of = _void_of(raster, band)

    def read(window: Window, factor: float, *, keep: bool = False) -> NDArray[np.float32]:
        with _kept(file) if keep else _opened(file) as again:

            def part(row: int, past: int) -> NDArray[np.float32]:
                rows = ((row, past), window[1])
                raw = again.read(band, window=rows)
                void, near = (math.nan, 0.0) if void_of is None else void_of
                values: NDArray[np.float32] = converted(raw, scale, offset, factor, void, near)
                if void_of is None:  # only the raster's mask knows
                    values[again.read_masks(band, window=rows) == 0] = np.nan
                return values

            return in_strips(window, part)

    return Grid(shape, transform, read, crs, unit, datum, again=partial(read, keep=True))


def _void_of(raster: Any, band: int) -> tuple[float, float] | None:
    """The stored value that means none, and how near to it others mean it, too; None where only the mask tells."""
    nodata, flags = raster.nodatavals[band - 1], [flag.name for flag in raster.mask_flag_enums[band - 1]]
    if flags == ["all_valid"]:
        return math.nan, 0.0
    name = raster.dtypes[band - 1]
    if flags != ["nodata"] or nodata is None or not re.fullmatch(r"u?int(8|16|32)|float(32|64)", name):
        return None
    if math.isnan(nodata):
        return (math.nan, 0.0) if name.startswith("float") else None
    if name.startswith("float"):
        float_limits, void = np.finfo(name), np.dtype(name).type(nodata)
        if not float_limits.min <= nodata <= float_limits.max:
            return None
        return float(void), float(2.0 * np.spacing(np.abs(void)))  # GDAL, too, takes what two steps set apart for one
    limits = np.iinfo(name)
    return (nodata, 0.0) if limits.min <= nodata <= limits.max and nodata == round(nodata) else None


@contextmanager
def _kept(file: Path) -> Iterator[Any]:
    """A raster that stays open for the next window of this thread, until MOST_OPEN others have been."""
    rasters: OrderedDict[tuple[Path, int, int], Any] = _OPEN.__dict__.setdefault("rasters", OrderedDict())
    with _as_data_error(file):
        state = file.stat()
        key = file, state.st_mtime_ns, state.st_size  # a file that was written anew is another one
        raster = rasters.pop(key, None)
        if raster is None:
            import rasterio

            own = {} if "GDAL_CACHEMAX" in os.environ else {"GDAL_CACHEMAX": CACHE_BYTES}
            with rasterio.Env(**own):
                raster = rasterio.open(_path(file))
                raster.read(1, window=((0, 1), (0, 1)))  # GDAL fixes its limit with the first block of the process
        yield raster
        rasters[key] = raster
        if len(rasters) > MOST_OPEN:
            rasters.popitem(last=False)[1].close()


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """A raster; what GDAL raises is a DataError."""
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    logging.getLogger("rasterio").addHandler(logging.NullHandler())  # GDAL's remarks stay off the terminal
    with _as_data_error(file), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(_path(file)) as raster:
            yield raster


def _path(file: Path) -> str:
    """What GDAL calls a file: it looks into .gz only where it is told to."""
    return f"/vsigzip/{file.absolute()}" if file.suffix.lower() == ".gz" else str(file)


@contextmanager
def _as_data_error(file: Path) -> Iterator[None]:
    """What GDAL raises over a file, as a DataError that names it."""
    from rasterio.errors import RasterioError

    try:
        yield
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


def _crs_and_datum(file: Path, raster: Any, band: int) -> tuple[str | None, str | None]:
    """Horizontal CRS and vertical datum, where stated; .hgt is EGM96 by its definition."""
    tags = {key.lower(): value for key, value in (*raster.tags().items(), *raster.tags(band).items())}
    told = next((tags[key] for key in _DATUM_TAGS if key in tags), None)
    datum = "EGM96" if raster.driver == "SRTMHGT" else vertical_datum(told)
    if raster.crs is None:
        return None, datum
    text = str(raster.crs.to_string())
    if text.startswith(("COMPD_CS", "COMPOUNDCRS", "GEOGCRS", "EPSG:")):
        text, vertical = split_crs(text)
        datum = vertical or datum
    return text, datum


def _hgt_hint(file: Path) -> str:
    """What an .hgt file must be, since GDAL does not say why it refuses one."""
    if file.suffix.lower() != ".hgt":
        return ""
    if not re.match(r"[NS]\d\d[EW]\d\d\d", file.name, re.IGNORECASE):
        return " named after its south-west corner, such as N47E009.hgt"
    return f" of 1201 x 1201 or 3601 x 3601 two-byte values (2884802 or 25934402 bytes), not {file.stat().st_size}"

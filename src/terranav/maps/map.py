"""Map: a scalar field on a regular grid, anywhere on Earth, in any CRS."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terranav.core.checks import finite
from terranav.core.earth import shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.kinds import kind_named
from terranav.maps.frame import LocalFrame
from terranav.maps.georeference import Georeference

FloatArray = NDArray[np.float64]
Method = Literal["bilinear", "bicubic"]

#: correlation length of a map's error [cells] where nothing better is known: what the ship's soundings show against a
#: 15 arcsec relief and its gravimeter against a 2.5 arcmin field, once the error common to the whole cruise is out
CORRELATION_CELLS = 2.5


@dataclass(frozen=True, eq=False)
class Map:
    """A scalar field on a regular grid; immutable.

    Attributes
    ----------
    values : (rows, cols) float32, read-only
        In `unit`; NaN where void. At least 2 x 2, at least one cell not void. Stored as a copy, unless it is float32,
        owns its memory and is read-only already.
    transform : 6 floats
        (a, b, c, d, e, f) as in rasterio: at the centre of cell (row, col) x = a (col + 0.5) + b (row + 0.5) + c and
        y = d (col + 0.5) + e (row + 0.5) + f.
    crs : str
        Of x and y: anything that pyproj takes. x is the longitude in a geographic one.
    kind : str
        'terrain', 'bathymetry', 'gravity' or 'magnetic'.
    unit : str
        The kind's unit.
    sigma : float
        1-sigma of the map error, same unit, >= 0.
    datum : str or None
        Vertical datum, where known.
    correlation_m : float or None
        Correlation length of the map error, covariance sigma^2 exp(-distance / correlation_m), > 0 [m]; None is
        `CORRELATION_CELLS` cells.
    source, name : str
        Where it came from, and what to call it.
    """

    values: NDArray[Any]
    transform: tuple[float, float, float, float, float, float]
    crs: str = "EPSG:4326"
    kind: str = "terrain"
    unit: str = "m"
    sigma: float = 3.0
    datum: str | None = None
    source: str = ""
    name: str = "map"
    correlation_m: float | None = None

    def __post_init__(self) -> None:
        kind = kind_named(self.kind)
        if self.unit != kind.unit:
            raise ConfigError(f"{self.name}: unit is {self.unit!r}, expected {kind.unit!r} for a {self.kind} map")
        object.__setattr__(self, "sigma", finite(f"{self.name}: map sigma", self.sigma, minimum=0.0))
        if self.correlation_m is not None:
            finite(f"{self.name}: map correlation_m", self.correlation_m, above=0.0)
        values = _kept(self.values)
        if values.ndim != 2 or min(values.shape) < 2:
            shape = " x ".join(str(size) for size in values.shape)
            raise DataError(f"{self.name}: map of {shape} cells, expected at least 2 rows and 2 columns")
        if np.isnan(values).all():
            raise DataError(f"{self.name}: every cell of the map is void, expected values")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        try:
            object.__setattr__(self, "transform", self._place.transform)
        except DataError as error:
            raise DataError(f"{self.name}: {error}") from None

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.values.setflags(write=False)  # pickling forgets it

    def __getstate__(self) -> dict[str, Any]:
        return {key: self.__dict__[key] for key in self.__dataclass_fields__}

    def __repr__(self) -> str:
        rows, cols = self.shape
        return f"<Map {self.name!r}: {self.kind} [{self.unit}], {rows} x {cols} cells of {self.cell_m:.0f} m>"

    @cached_property
    def _place(self) -> Georeference:
        return Georeference(self.shape, self.transform, self.crs)

    @property
    def centre_deg(self) -> tuple[float, float]:
        """Latitude and longitude of the middle of the map [deg]."""
        return self._place.centre_deg

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.values.shape
        return rows, cols

    def cells(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Fractional rows and columns of positions, (0.0, 0.0) being the centre of the first cell.

        Parameters
        ----------
        lat_deg, lon_deg : array_like, shapes that broadcast [deg]
            Longitudes may run from -180 to 180 or from 0 to 360, whatever the map's own axis does.

        Returns
        -------
        row, col : ndarray [cells]
            Not finite where the projection knows no such place.
        """
        return self._place.cells(lat_deg, lon_deg)

    def sample(self, lat_deg: ArrayLike, lon_deg: ArrayLike, method: Method = "bilinear") -> FloatArray:
        """Values of the field at positions.

        Parameters
        ----------
        lat_deg, lon_deg : array_like, shapes that broadcast [deg]
        method : 'bilinear' or 'bicubic' (Catmull-Rom)

        Returns
        -------
        value : ndarray of the broadcast shape [unit]
            NaN outside the hull of the cell centres and where a void has weight.
        """
        row, col = self.cells(lat_deg, lon_deg)
        return sampled(self.values, row.ravel(), col.ravel(), method).reshape(row.shape)

    def gradient(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Slopes of the field: differences of `sample` over one cell, from half a cell before to half a cell after.

        That is the slope of the field smoothed over a cell: continuous, where the slope of the bilinear patch itself
        jumps from cell to cell. At an edge or a void the half that has a value serves alone.

        Parameters
        ----------
        lat_deg, lon_deg : array_like, shapes that broadcast [deg]

        Returns
        -------
        d_dnorth, d_deast : ndarray [unit/m]
            NaN where `sample` is.
        """
        lat, lon = np.broadcast_arrays(np.asarray(lat_deg, dtype=np.float64), np.asarray(lon_deg, dtype=np.float64))
        here = self.sample(lat, lon)
        half = 0.5 * self.cell_m

        def slope(north: float, east: float) -> FloatArray:
            after = self.sample(*shift(lat, lon, north, east))
            before = self.sample(*shift(lat, lon, -north, -east))
            span = np.where(np.isnan(after) | np.isnan(before), half, 2.0 * half)
            rise = np.where(np.isnan(after), here, after) - np.where(np.isnan(before), here, before)
            alone = np.isnan(here) | (np.isnan(after) & np.isnan(before))
            out: FloatArray = np.where(alone, np.nan, rise / span)
            return out

        return slope(half, 0.0), slope(0.0, half)

    def covers(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> NDArray[np.bool_]:
        """Whether positions lie in the hull of the cell centres, void or not; of the broadcast shape."""
        row, col = self.cells(lat_deg, lon_deg)
        rows, cols = self.shape
        slack = 1e-6  # as in kernels.sampling
        inside: NDArray[np.bool_] = (
            (row >= -slack) & (row <= rows - 1 + slack) & (col >= -slack) & (col <= cols - 1 + slack)
        )
        return inside

    def around(self, lat_deg: ArrayLike, lon_deg: ArrayLike, radius_m: float) -> Map:
        """The map near places, with `values` in memory: itself here, a window of a `Mosaic`.

        Who reads `values` by rows and columns asks for this first; `local_frame` of what it gives fits those values.

        Parameters
        ----------
        lat_deg, lon_deg : array_like, shapes that broadcast [deg]
        radius_m : float [m]
            How far from any of the places it will be used.
        """
        return self

    def local_frame(self, lat_deg: float, lon_deg: float, radius_m: float = 5000.0) -> LocalFrame:
        """The map's rows and columns as a quadratic in metres north and east of a place.

        Good to 0.1 cell within `radius_m` for radii up to 20 km, cells of 30 m and latitudes below 80 degrees.

        Parameters
        ----------
        lat_deg, lon_deg : float [deg]
        radius_m : float [m]
            How far from the place it will be used.
        """
        return self._place.local_frame(lat_deg, lon_deg, radius_m)

    @property
    def cell_m(self) -> float:
        """Geometric mean of a cell's two sides in the middle of the map [m]."""
        return self._place.cell_m

    @property
    def error_length_m(self) -> float:
        """Correlation length of the map error [m]."""
        return CORRELATION_CELLS * self.cell_m if self.correlation_m is None else self.correlation_m

    @property
    def bounds_deg(self) -> tuple[float, float, float, float]:
        """South, west, north, east of the hull of the cell centres [deg].

        West is in [-180, 180); east is greater than west, beyond 180 on a map that crosses the antimeridian.
        """
        return self._place.bounds_deg

    def crop(self, south_deg: float, west_deg: float, north_deg: float, east_deg: float) -> Map:
        """The part of the map whose cell centres enclose a box; the same values at the same places.

        Parameters
        ----------
        south_deg, west_deg, north_deg, east_deg : float [deg]
            East below west means a box across the antimeridian.

        Raises
        ------
        DataError
            The box has no area or misses the map.
        """
        try:
            window = self._place.window(south_deg, west_deg, north_deg, east_deg)
        except DataError as error:
            raise DataError(f"{self.name}: {error}") from None
        (r0, r1), (c0, c1) = window
        return replace(self, values=self.values[r0:r1, c0:c1], transform=self._place.cropped(window).transform)

    def typical(self) -> Map:
        """The map for statistics of its ground: itself here, parts side by side of a `Mosaic` too large to be read."""
        return self

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of values, transform, CRS and kind, hexadecimal."""
        digest = hashlib.sha256(np.ascontiguousarray(self.values, dtype="<f4").tobytes())
        digest.update(repr((self.shape, self.transform, self.crs, self.kind)).encode())
        return digest.hexdigest()

    def info(self) -> dict[str, Any]:
        """What the map is, as plain numbers and texts: extent, cells, voids, statistics, and what looks suspicious."""
        from terranav.maps.info import describe

        return describe(self)


def as_maps(given: Map | Iterable[Map]) -> tuple[Map, ...]:
    """One map or several as a tuple; ConfigError for anything else."""
    several: object = (given,) if isinstance(given, Map) else given
    if not isinstance(several, Iterable) or isinstance(several, str):
        raise ConfigError(f"maps is {given!r}, expected Map objects (terranav.open_map reads one from a file)")
    charts = tuple(several)
    for chart in charts:
        if not isinstance(chart, Map):
            raise ConfigError(f"maps holds {chart!r}, expected Map objects (terranav.open_map reads one from a file)")
    return charts


def sampled(values: NDArray[np.float32], row: FloatArray, col: FloatArray, method: Method) -> FloatArray:
    """Values at fractional rows and columns (n,), NaN off them; ConfigError for an unknown method."""
    from terranav.kernels import sampling

    if method not in ("bilinear", "bicubic"):
        raise ConfigError(f"sampling method is {method!r}, expected 'bilinear' or 'bicubic'")
    out = np.empty(row.size)
    kernel = sampling.bilinear if method == "bilinear" else sampling.bicubic
    kernel(values, row, col, out)
    return out


def _kept(given: NDArray[Any]) -> NDArray[np.float32]:
    """Values that nobody else writes to: a copy, unless they are closed already; what is infinite is void."""
    whole = isinstance(given, np.ndarray) and given.flags.owndata and given.flags.c_contiguous
    if whole and given.dtype == np.float32 and not given.flags.writeable and not np.isinf(given).any():
        return given
    values = np.array(given, dtype=np.float32, order="C")
    values[np.isinf(values)] = np.nan
    return values

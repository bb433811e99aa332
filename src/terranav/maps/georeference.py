"""Where the cells of a grid lie on Earth: its transform and CRS, without its values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terranav.core.earth import wrap_longitude
from terranav.core.errors import DataError
from terranav.maps.crs import Projection, projection
from terranav.maps.frame import LocalFrame, fitted_frame, geographic_frame

FloatArray = NDArray[np.float64]
Transform = tuple[float, float, float, float, float, float]
Window = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class Georeference:
    """The grid of a map.

    Attributes
    ----------
    shape : (rows, cols), both >= 2
    transform : 6 floats
        (a, b, c, d, e, f) as in rasterio: at the centre of cell (row, col) x = a (col + 0.5) + b (row + 0.5) + c and
        y = d (col + 0.5) + e (row + 0.5) + f.
    crs : str
        Of x and y; x is the longitude in a geographic one.

    Raises
    ------
    DataError
        The transform has no inverse, or pyproj does not know the CRS.
    """

    shape: tuple[int, int]
    transform: Transform
    crs: str

    def __post_init__(self) -> None:
        transform = tuple(float(number) for number in self.transform)
        if len(transform) != 6 or not np.isfinite(transform).all() or _determinant(transform) == 0.0:
            raise DataError(f"map transform is {self.transform!r}, expected six numbers of an invertible affine")
        object.__setattr__(self, "transform", transform)
        _ = self.projection

    @property
    def projection(self) -> Projection:
        """The projection of the CRS."""
        return projection(self.crs)

    @cached_property
    def inverse(self) -> Transform:
        """(col, row) of cell centres from (x, y): col = i0 x + i1 y + i2, row = i3 x + i4 y + i5."""
        a, b, c, d, e, f = self.transform
        det = _determinant(self.transform)
        return e / det, -b / det, (b * f - c * e) / det - 0.5, -d / det, a / det, (c * d - a * f) / det - 0.5

    @cached_property
    def centre_xy(self) -> tuple[float, float]:
        """Map coordinates of the middle."""
        x, y = self._xy(0.5 * (self.shape[0] - 1), 0.5 * (self.shape[1] - 1))
        return float(x), float(y)

    @cached_property
    def centre_deg(self) -> tuple[float, float]:
        """Latitude and longitude of the middle of the map [deg]."""
        x, y = self.centre_xy
        lat, lon = self.projection.inverse(np.array([x]), np.array([y]))
        return float(lat[0]), float(wrap_longitude(lon[0]))

    def _xy(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Map coordinates of fractional rows and columns in cell centres."""
        a, b, c, d, e, f = self.transform
        y, x = np.asarray(row, dtype=np.float64) + 0.5, np.asarray(col, dtype=np.float64) + 0.5
        return a * x + b * y + c, d * x + e * y + f

    def cells(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """As `Map.cells`."""
        lat, lon = np.broadcast_arrays(np.asarray(lat_deg, dtype=np.float64), np.asarray(lon_deg, dtype=np.float64))
        x, y = (np.asarray(axis) for axis in self.projection.forward(lat, lon))
        if self.projection.geographic:
            x = self.centre_xy[0] + wrap_longitude(x - self.centre_xy[0])
        i = self.inverse
        with np.errstate(invalid="ignore"):  # PROJ marks places without an image by infinity
            return np.asarray(i[3] * x + i[4] * y + i[5]), np.asarray(i[0] * x + i[1] * y + i[2])

    def local_frame(self, lat_deg: float, lon_deg: float, radius_m: float = 5000.0) -> LocalFrame:
        """As `Map.local_frame`."""
        if self.projection.plain:
            middle = self.centre_xy[0]
            return geographic_frame(lat_deg, middle + (lon_deg - middle + 180.0) % 360.0 - 180.0, self.inverse)
        return fitted_frame(lat_deg, lon_deg, 0.75 * radius_m, self.cells)

    @cached_property
    def cell_m(self) -> float:
        """Geometric mean of a cell's two sides in the middle of the map [m]."""
        frame = self.local_frame(*self.centre_deg, radius_m=100.0)
        return float(abs(frame.row[1] * frame.col[2] - frame.row[2] * frame.col[1]) ** -0.5)

    @cached_property
    def bounds_deg(self) -> tuple[float, float, float, float]:
        """South, west, north, east of the hull of the cell centres [deg].

        West is in [-180, 180); east is greater than west, beyond 180 on a map that crosses the antimeridian.
        """
        rows, cols = self.shape
        t = np.linspace(0.0, 1.0, 41)
        row = np.concatenate([0.0 * t, t, 0.0 * t + 1.0, t]) * (rows - 1)
        col = np.concatenate([t, 0.0 * t + 1.0, t, 0.0 * t]) * (cols - 1)
        lat, lon = self.projection.inverse(*self._xy(row, col))
        middle = self.centre_xy[0] if self.projection.plain else self.centre_deg[1]
        away = lon - middle if self.projection.plain else wrap_longitude(lon - middle)
        west = float(wrap_longitude(middle + away.min()))
        return float(lat.min()), west, float(lat.max()), west + float(away.max() - away.min())

    def window(self, south_deg: float, west_deg: float, north_deg: float, east_deg: float) -> Window:
        """Rows and columns of the cells whose centres enclose a box.

        Parameters
        ----------
        south_deg, west_deg, north_deg, east_deg : float [deg]
            East below west means a box across the antimeridian.

        Returns
        -------
        (first row, past the last), (first column, past the last)

        Raises
        ------
        DataError
            The box has no area or misses the map.
        """
        box = f"({south_deg:g}, {west_deg:g}, {north_deg:g}, {east_deg:g})"
        width = (east_deg - west_deg) % 360.0 or 360.0 * (east_deg != west_deg)
        if not (north_deg > south_deg and width > 0.0):
            raise DataError(f"box {box} has no area, expected south < north and west < east")
        t = np.linspace(0.0, 1.0, 21)
        lat, lon = np.meshgrid(south_deg + t * (north_deg - south_deg), west_deg + t * width)
        row, col = self.cells(lat, lon)
        known = np.isfinite(row) & np.isfinite(col)
        rows, cols = (_span(position[known], size) for position, size in zip((row, col), self.shape, strict=True))
        if rows[1] - rows[0] < 2 or cols[1] - cols[0] < 2:
            south, west, north, east = self.bounds_deg
            raise DataError(f"box {box} misses the map, which spans ({south:.4f}, {west:.4f}, {north:.4f}, {east:.4f})")
        return rows, cols

    def cropped(self, window: Window) -> Georeference:
        """The grid of a window of the cells."""
        (r0, r1), (c0, c1) = window
        a, b, c, d, e, f = self.transform
        moved = (a, b, c + a * c0 + b * r0, d, e, f + d * c0 + e * r0)
        return replace(self, shape=(r1 - r0, c1 - c0), transform=moved)


def _determinant(transform: tuple[float, ...]) -> float:
    return transform[0] * transform[4] - transform[1] * transform[3]


def _span(position: FloatArray, size: int) -> tuple[int, int]:
    """First and past-the-last index of the cells that enclose positions, within the map."""
    if not position.size:
        return 0, 0
    return max(int(np.floor(position.min() + 1e-6)), 0), min(int(np.ceil(position.max() - 1e-6)) + 1, size)

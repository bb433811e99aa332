"""The height of a geoid above the WGS-84 ellipsoid, from a grid in latitude and longitude."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terranav.core.errors import ConfigError, DataError
from terranav.core.memory import need
from terranav.maps.georeference import Transform, Window

FloatArray = NDArray[np.float64]
Method = Literal["bilinear", "bicubic"]
Read = Callable[[Window], NDArray[np.float32]]

_AROUND = 2  # cells that the bicubic patch reaches beyond a position
_WHOLE = 1e-3  # of a cell: how well whole cells must fill the circle of longitudes


@dataclass(frozen=True, eq=False)
class Geoid:
    """A geoid, or any other surface of zero height, as its height above the WGS-84 ellipsoid.

    height above the ellipsoid = height above the geoid + geoid height (NIMA TR8350.2, 3rd edition, section 6).

    Attributes
    ----------
    datum : str
        The vertical datum whose heights count from this surface, such as 'EGM2008'.
    shape : (rows, cols), both >= 2
    transform : 6 floats
        As in `Map`, of longitude and latitude [deg]; no rotation. A grid that goes all the way around is read across
        its seam.
    read : function of ((first row, past the last), (first column, past the last))
        -> (rows, cols) float32 [m], NaN where the grid says nothing. It is called with what a question needs.
    source : str
        Where it came from, for messages.
    """

    datum: str
    shape: tuple[int, int]
    transform: Transform
    read: Read
    source: str = "geoid"

    def __post_init__(self) -> None:
        a, b, _, d, e, _ = self.transform
        if min(self.shape) < 2 or not np.isfinite(self.transform).all() or b or d or a <= 0.0 or e == 0.0:
            raise DataError(
                f"{self.source}: {self.shape[0]} x {self.shape[1]} cells with transform {self.transform}, expected a "
                "geoid grid of at least 2 x 2 cells along latitude and longitude, from west to east"
            )

    def __repr__(self) -> str:
        rows, cols = self.shape
        return f"<Geoid {self.datum}: {rows} x {cols} cells of {60.0 * self.transform[0]:.3g}', {self.source}>"

    @classmethod
    def from_values(cls, values: ArrayLike, transform: Transform, datum: str, source: str = "geoid") -> Geoid:
        """A geoid of heights in memory: (rows, cols) [m], transform and the rest as above."""
        grid = np.array(values, dtype=np.float32, order="C")
        if grid.ndim != 2:
            raise DataError(f"{source}: geoid heights of shape {grid.shape}, expected rows and columns")
        rows, cols = grid.shape
        return cls(datum, (rows, cols), transform, lambda w: grid[w[0][0] : w[0][1], w[1][0] : w[1][1]], source)

    def height(self, lat_deg: ArrayLike, lon_deg: ArrayLike, method: Method = "bicubic") -> FloatArray:
        """Height of the geoid above the ellipsoid.

        Parameters
        ----------
        lat_deg, lon_deg : array_like, shapes that broadcast [deg]
        method : 'bicubic' (Catmull-Rom) or 'bilinear'

        Returns
        -------
        height : ndarray of the broadcast shape [m]
            NaN where the grid does not reach or says nothing, and at positions that are not finite.

        Raises
        ------
        ConfigError
            Another method, or positions so far apart that the grid between them does not fit into the memory.
        """
        from terranav.kernels import sampling

        if method not in ("bilinear", "bicubic"):
            raise ConfigError(f"geoid method is {method!r}, expected 'bilinear' or 'bicubic'")
        lat, lon = np.broadcast_arrays(np.asarray(lat_deg, dtype=np.float64), np.asarray(lon_deg, dtype=np.float64))
        out = np.full(lat.size, np.nan)
        row, col = self._cells(lat.ravel(), lon.ravel())
        inside = (row >= -_WHOLE) & (row <= self.shape[0] - 1 + _WHOLE) & np.isfinite(col)
        if not self._period:
            inside &= (col >= -_WHOLE) & (col <= self.shape[1] - 1 + _WHOLE)
        if inside.any():
            r, c = np.clip(row[inside], 0.0, self.shape[0] - 1.0), col[inside]
            c = c if self._period else np.clip(c, 0.0, self.shape[1] - 1.0)
            found = np.empty(r.size)
            patch, top, left = self._patch(r, c)
            kernel = sampling.bilinear if method == "bilinear" else sampling.bicubic
            kernel(patch, r - top, c - left, found)
            out[inside] = found
        return out.reshape(lat.shape)

    @property
    def _period(self) -> int:
        """Cells around the Earth, of a grid that goes all the way; else 0."""
        around = 360.0 / self.transform[0]
        whole = round(around)
        return whole if abs(around - whole) < _WHOLE and self.shape[1] >= whole else 0

    def _cells(self, lat: FloatArray, lon: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fractional rows, and columns that run on across the seam beside the first finite position."""
        a, _, west, _, e, north = self.transform
        centre = lon[np.isfinite(lon)][0] if np.isfinite(lon).any() else 0.0
        if not self._period:
            centre = west + 0.5 * a * self.shape[1]
        with np.errstate(invalid="ignore"):
            near = centre + (lon - centre + 180.0) % 360.0 - 180.0
            return (lat - north) / e - 0.5, (near - west) / a - 0.5

    def _patch(self, row: FloatArray, col: FloatArray) -> tuple[NDArray[np.float32], int, int]:
        """The cells around positions, with the numbers of the first row and column."""
        rows, cols = self.shape
        top, bottom = max(int(row.min()) - _AROUND, 0), min(int(row.max()) + _AROUND + 2, rows)
        left, right = int(np.floor(col.min())) - _AROUND, int(np.floor(col.max())) + _AROUND + 2
        if not self._period:
            left, right = max(left, 0), min(right, cols)
        need(
            8.0 * (bottom - top) * (right - left), f"{self.source}: {bottom - top} x {right - left} cells of the geoid"
        )
        pieces, at = [], left
        while at < right:
            first = at % self._period if self._period else at
            past = min(first + right - at, self._period or cols)
            pieces.append(self.read(((top, bottom), (first, past))))
            at += past - first
        return np.ascontiguousarray(np.concatenate(pieces, axis=1), dtype=np.float32), top, left

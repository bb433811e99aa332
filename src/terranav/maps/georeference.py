"""Where the cells of a grid lie on Earth: its transform and CRS, without its values."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terranav.core.earth import ECCENTRICITY_SQ, SEMI_MAJOR_M, wrap_longitude
from terranav.core.errors import DataError
from terranav.maps.crs import Projection, projection
from terranav.maps.frame import LocalFrame, fitted_frame, geographic_frame

FloatArray = NDArray[np.float64]
Transform = tuple[float, float, float, float, float, float]
Window = tuple[tuple[int, int], tuple[int, int]]
Box = tuple[float, float, float, float]

SLACK = 1e-6  # cells that a place may lie outside and still count as on the edge, as in kernels.sampling


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

    def lat_lon(self, row: ArrayLike, col: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude of fractional rows and columns, on the grid or beyond it [deg]."""
        return self.projection.inverse(*self._xy(row, col))

    def _places(self, down: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude [deg] at shares of the way from the first row and column to the last.

        Longitudes go on beyond 180 in a geographic CRS.
        """
        x, y = self._xy(down * (self.shape[0] - 1), across * (self.shape[1] - 1))
        lat, lon = self.projection.inverse(x, y)
        if self.projection.geographic and not self.projection.plain:
            lon = x + wrap_longitude(lon - x)
        return lat, lon

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
        """Geometric mean of a cell's two sides in the middle of the map [m]; measured in space, poles are no matter."""
        rows, cols = 0.5 * (np.array(self.shape) - 1.0)
        x, y = self._xy(rows + np.array([-0.5, 0.5, 0.0, 0.0]), cols + np.array([0.0, 0.0, -0.5, 0.5]))
        above, below, left, right = _in_space(*self.projection.inverse(x, y))
        return float(np.linalg.norm(np.cross(below - above, right - left)) ** 0.5)

    @cached_property
    def bounds_deg(self) -> Box:
        """South, west, north, east of the hull of the cell centres [deg].

        West is in [-180, 180); east is greater than west, beyond 180 on a map that crosses the antimeridian. With a
        pole inside they are -180 and 180.

        Raises
        ------
        DataError
            The middle of the map is not on the Earth.
        """
        half = np.array([0.5])
        middle = float(self._places(half, half)[1][0])
        if not np.isfinite(middle):
            raise DataError(
                f"the middle of the map is not on the Earth in {self.crs}, expected another transform or crs"
            )

        def place(down: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray]:
            lat, lon = self._places(down, across)
            with np.errstate(invalid="ignore"):  # places off the Earth
                return lat, lon - middle if self.projection.geographic else wrap_longitude(lon - middle)

        south, north, left, right = _extremes(place)
        inside = False
        for pole in (-90.0, 90.0):
            share = self._pole(pole)
            if share is None:
                continue
            nearest = np.clip(share, 0.0, 1.0)
            lat, _ = place(nearest[:1], nearest[1:])
            if np.isfinite(lat[0]):
                south, north = min(south, float(lat[0])), max(north, float(lat[0]))
            inside = inside or bool(((share > SLACK) & (share < 1.0 - SLACK)).all())
        if inside:
            return south, -180.0, north, 180.0
        west = float(wrap_longitude(middle + left))
        return south, west, north, west + right - left

    def _pole(self, lat_deg: float) -> FloatArray | None:
        """Shares of the way from the first row and column to the last, (2,), at which a pole lies.

        None where the map has no such point, or draws it as a line.
        """
        if self.projection.geographic:
            return None
        found = np.stack(self.cells(lat_deg, np.array([0.0, 90.0, 180.0, -90.0])))
        if not np.isfinite(found).all() or np.ptp(found, axis=1).max() > 1e-3:
            return None
        out: FloatArray = found[:, 0] / (np.array(self.shape) - 1.0)
        return out

    def window(self, south_deg: float, west_deg: float, north_deg: float, east_deg: float) -> Window:
        """Rows and columns of the cells whose centres enclose what a box and the map have in common.

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
        parts = self._common(south_deg, west_deg, north_deg, west_deg + width)
        spans = np.array([span for part in parts if np.isfinite(span := self._span(part)).all()])
        if spans.size:  # a box may meet a map of the whole Earth at both its sides
            first, last = spans[:, ::2].min(axis=0), spans[:, 1::2].max(axis=0)
            first = np.maximum(np.floor(first + SLACK), 0).astype(int)
            last = np.minimum(np.ceil(last - SLACK) + 1, self.shape).astype(int)
        if not spans.size or (last - first < 2).any():
            south, west, north, east = self.bounds_deg
            raise DataError(f"box {box} misses the map, which spans ({south:.4f}, {west:.4f}, {north:.4f}, {east:.4f})")
        return (int(first[0]), int(last[0])), (int(first[1]), int(last[1]))

    def _common(self, south: float, west: float, north: float, east: float) -> list[Box]:
        """The parts of a box that lie within the bounds of the map, so that none is mistaken for its far side.

        A map whose sides are off the Earth has no sharp bounds: the box as it is.
        """
        t = np.linspace(0.0, 1.0, 41)
        down, across = np.concatenate([t, t, 0.0 * t, 0.0 * t + 1.0]), np.concatenate([0.0 * t, 0.0 * t + 1.0, t, t])
        if not np.isfinite(self._places(down, across)).all():
            return [(south, west, north, east)]
        low, left, high, right = self.bounds_deg
        more = 0.0 if self.projection.geographic else 0.01  # the bounds of others are good to a fraction of a cell
        tall, wide = more * (high - low), more * (right - left)
        parts = []
        for turn in (-720.0, -360.0, 0.0, 360.0, 720.0):
            if west + turn <= right and east + turn >= left and south <= high and north >= low:
                sides = max(west + turn, left - wide), min(east + turn, right + wide)
                parts.append((max(south, low - tall), sides[0], min(north, high + tall), sides[1]))
        return parts

    def _span(self, box: Box) -> tuple[float, float, float, float]:
        """Least and largest row and column of a box."""
        south, west, north, east = box
        return _extremes(lambda up, along: self.cells(south + up * (north - south), west + along * (east - west)))

    def cropped(self, window: Window) -> Georeference:
        """The grid of a window of the cells."""
        (r0, r1), (c0, c1) = window
        a, b, c, d, e, f = self.transform
        moved = (a, b, c + a * c0 + b * r0, d, e, f + d * c0 + e * r0)
        return replace(self, shape=(r1 - r0, c1 - c0), transform=moved)


def _determinant(transform: tuple[float, ...]) -> float:
    return transform[0] * transform[4] - transform[1] * transform[3]


def _in_space(lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
    """Earth-centred coordinates of places on the ellipsoid [m], (n, 3)."""
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    normal = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_SQ * np.sin(lat) ** 2)
    flat = normal * np.cos(lat)
    return np.stack([flat * np.cos(lon), flat * np.sin(lon), normal * (1.0 - ECCENTRICITY_SQ) * np.sin(lat)], axis=1)


def _extremes(
    image: Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
) -> tuple[float, float, float, float]:
    """Least and largest of both coordinates of the image of the unit square, NaN where it has none.

    They lie on its sides, which are searched ever more finely; a coarse grid within serves images that are partly
    infinite.
    """

    def both(t: FloatArray) -> FloatArray:
        """The image of the way around, t in 0..4."""
        up = np.clip(np.where(t < 2.0, t - 1.0, 4.0 - t), 0.0, 1.0)
        along = np.clip(np.where(t < 2.0, t, 3.0 - t), 0.0, 1.0)
        found = np.stack(image(up, along))
        return np.where(np.isfinite(found), found, np.nan)

    around = np.linspace(0.0, 4.0, 361)
    rim = both(around)
    grid = np.linspace(0.0, 1.0, 21)
    within = np.stack([part.ravel() for part in image(*np.meshgrid(grid, grid))])
    every = np.concatenate([rim, np.where(np.isfinite(within), within, np.nan)], axis=1)
    ends = []
    for axis in (0, 1):
        for sign in (1.0, -1.0):
            if np.isnan(every[axis]).all():
                ends.append(np.nan)
                continue
            best = float(np.nanmin(sign * every[axis]))
            at, step = _least(around, sign * rim[axis]), 4.0 / 360.0
            for _ in range(2):
                near = np.clip(at + step * np.linspace(-1.0, 1.0, 41), 0.0, 4.0)
                finer = sign * both(near)[axis]
                at, step = _least(near, finer), 0.05 * step
                best = float(np.fmin(best, np.fmin.reduce(finer)))
            ends.append(sign * best)
    return ends[0], ends[1], ends[2], ends[3]


def _least(place: FloatArray, value: FloatArray) -> float:
    """Where the value is least; the first place where none is known."""
    return float(place[0 if np.isnan(value).all() else int(np.nanargmin(value))])

"""Mosaic: a Map of many tiles, or of one that is larger than memory, whose values stay in their files."""

from __future__ import annotations

import hashlib
import math
import pickle
import threading
import warnings
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terranav.core.checks import finite
from terranav.core.errors import DataError, DataWarning
from terranav.core.kinds import kind_named
from terranav.core.memory import need
from terranav.maps.georeference import Window
from terranav.maps.map import CORRELATION_CELLS, Map, Method, sampled
from terranav.maps.tiles import Layer, Tile, interpolated, layers, union
from terranav.maps.windows import BLOCK, Windows

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
Ends = tuple[tuple[float, float], tuple[float, float]]

MEMORY_MB = 256.0
LEAST_MEMORY_MB = 8.0
MARGIN = 3  # cells around what is asked for: what interpolation and the error of a local frame reach beyond it
ONE_WINDOW = 2**22  # cells: places that lie farther apart are looked up block by block
MOST_PER_DEGREE = 111_700.0  # metres: no degree of latitude or longitude is longer
SEEN = 4  # windows that a thread remembers: a filter and its monitor look around with different radii
SAMPLED = 2**24  # cells: what `info` looks at of a larger mosaic


class _Seen(NamedTuple):
    """A place and a radius, how far both may change together with the same window, and that window."""

    lat_deg: float
    lon_deg: float
    radius_m: float
    slack_m: float
    land: Map

    def serves(self, lat_deg: float, lon_deg: float, radius_m: float) -> bool:
        """Whether another place and radius have the same window; False where it is not sure."""
        degrees = abs(lat_deg - self.lat_deg) + abs(lon_deg - self.lon_deg)
        return degrees * MOST_PER_DEGREE + abs(radius_m - self.radius_m) < self.slack_m


class Mosaic(Map):
    """A Map whose values stay in the files of its tiles.

    It answers as a Map does that was cut out beforehand. `around` and `sample` read windows of whole blocks, keep them
    up to a number of bytes and read ahead in the direction of motion; any number of threads may use it. `values` reads
    all of it, as far as the memory allows.

    The grid is that of the finest tiles, from the outermost tile to the outermost. Tiles on this grid are copied, exact
    across their seams; others are interpolated onto it. Where tiles overlap, the first that has a value there wins,
    tiles that share a grid being taken together; what no tile has is NaN. A geographic grid across the antimeridian is
    in one piece, and one that goes around the Earth has no edge there.

    Parameters
    ----------
    tiles : sequence of Tile
        At least one; earlier ones win.
    about : mapping
        kind, sigma, datum, source, name, correlation_m as of `Map`; correlation_m is by default
        `terranav.maps.map.CORRELATION_CELLS` cells of the coarsest tiles.
    memory_mb : float
        Most memory for what is kept of the values, at least 8 [MiB].
    again : function, optional
        Makes this mosaic in another process; itself something that can be pickled.
    finest_first : bool
        Finer tiles win over coarser ones, whatever their order.

    Raises
    ------
    ConfigError
        A figure is out of its range.
    """

    def __init__(
        self,
        tiles: Sequence[Tile],
        about: Mapping[str, Any],
        memory_mb: float = MEMORY_MB,
        again: Callable[[], Mosaic] | None = None,
        *,
        finest_first: bool = True,
    ) -> None:
        finite("map memory_mb", memory_mb, minimum=LEAST_MEMORY_MB)
        several = layers(tiles)
        if finest_first:
            several.sort(key=lambda layer: layer.place.cell_m)
        finest = min(several, key=lambda layer: layer.place.cell_m)
        place, start = union(finest, [layer for layer in several if layer is not finest])
        if min(place.shape) < 2:
            size = " x ".join(str(side) for side in place.shape)
            raise DataError(
                f"{about.get('name', 'map')}: mosaic of {size} cells, expected at least 2 rows and 2 columns"
            )
        given = {"kind": "terrain", **about, "transform": place.transform, "crs": place.crs}
        given["unit"] = kind_named(given["kind"]).unit
        if given.get("correlation_m") is None and len(several) > 1:
            given["correlation_m"] = CORRELATION_CELLS * max(layer.place.cell_m for layer in several)
        for key, field in self.__dataclass_fields__.items():
            if key != "values":
                object.__setattr__(self, key, given.get(key, field.default))
        finite(f"{self.name}: map sigma", self.sigma, minimum=0.0)
        if self.correlation_m is not None:
            finite(f"{self.name}: map correlation_m", self.correlation_m, above=0.0)
        edges = place.shape[0], None if finest.period is not None else place.shape[1]
        windows = Windows(self._read, self._part, edges, int(memory_mb * 2**20))
        own = {"_place": place, "_layers": several, "_finest": finest, "_start": start, "_windows": windows}
        own["_edges"] = edges
        own |= {"_again": again, "_clipped": threading.Event(), "_here": threading.local()}
        for key, value in own.items():
            object.__setattr__(self, key, value)

    _layers: list[Layer]
    _finest: Layer
    _start: tuple[int, int]
    _edges: tuple[int, int | None]  # rows and columns, None where the grid has no end
    _windows: Windows[Map]
    _again: Callable[[], Mosaic] | None
    _clipped: threading.Event
    _here: threading.local

    def __reduce__(self) -> tuple[Callable[[], Mosaic], tuple[()]]:
        if self._again is None:
            raise pickle.PicklingError(f"{self.name}: a mosaic of tiles that are not in files cannot be pickled")
        return self._again, ()

    def __repr__(self) -> str:
        rows, cols = self.shape
        size = f"{rows} x {cols} cells of {self.cell_m:.0f} m"
        return f"<Mosaic {self.name!r}: {self.kind} [{self.unit}], {self.tile_count} tiles, {size}>"

    @property
    def tile_count(self) -> int:
        """How many tiles there are."""
        return sum(len(layer.tiles) for layer in self._layers)

    @property
    def tiles(self) -> tuple[Tile, ...]:
        """The tiles, those of a grid together, earlier ones winning."""
        return tuple(tile for layer in self._layers for tile in layer.tiles)

    @property
    def reading_s(self) -> tuple[float, float]:
        """Seconds that reading has taken so far, and seconds for which a caller had to wait."""
        return self._windows.read_s, self._windows.waited_s

    @property
    def held_bytes(self) -> int:
        """Bytes of values that are in memory now."""
        return self._windows.bytes

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self._place.shape

    @property
    def values(self) -> Float32Array:
        """All cells (rows, cols) in `unit`, read anew each time; ConfigError where they do not fit into the memory."""
        rows, cols = self.shape
        return self._whole(((0, rows), (0, cols))).values

    def around(self, lat_deg: ArrayLike, lon_deg: ArrayLike, radius_m: float) -> Map:
        """A window with all cells within a distance of places, `values` in memory.

        A window that is larger than half of the memory is cut down to it about the middle, with a DataWarning.

        Parameters
        ----------
        lat_deg, lon_deg : array_like, shapes that broadcast [deg]
        radius_m : float [m]
        """
        lat, lon = np.asarray(lat_deg, dtype=np.float64), np.asarray(lon_deg, dtype=np.float64)
        if lat.size == lon.size == 1:  # the usual case, at every step of a filter
            return self._around_one(lat.item(), lon.item(), radius_m)
        lat, lon = np.broadcast_arrays(lat, lon)
        return self._windows.get(self._bounded(self._reach(lat.ravel(), lon.ravel(), radius_m)))

    def _around_one(self, lat_deg: float, lon_deg: float, radius_m: float) -> Map:
        """As `around`; close to a place of before its window is known to be the same, without a look."""
        seen: deque[_Seen] = self._here.__dict__.setdefault("seen", deque(maxlen=SEEN))
        for last in seen:
            if last.serves(lat_deg, lon_deg, radius_m):
                return last.land
        ends = self._ends(lat_deg, lon_deg, radius_m)
        cells = self._bounded(ends)
        land = self._windows.get(cells)
        per_m = 0.6 * max(high - low for low, high in ends) / radius_m if radius_m > 0.0 else math.nan
        slack = min(self._windows.slack(cells), BLOCK // 8) - 1  # no more, so that reading ahead hears of the motion
        if self._windows.fits(cells) and per_m > 0.0:
            seen.appendleft(_Seen(lat_deg, lon_deg, radius_m, slack / per_m, land))
        return land

    def sample(self, lat_deg: ArrayLike, lon_deg: ArrayLike, method: Method = "bilinear") -> FloatArray:
        """As `Map.sample`."""
        row, col = self.cells(lat_deg, lon_deg)
        if self._finest.period is not None:
            col = np.where(np.isfinite(col), np.mod(col, self._finest.period), col)
        out = np.full(row.size, np.nan)
        r, c = row.ravel(), col.ravel()
        rows, cols = self._edges
        with np.errstate(invalid="ignore"):
            near = np.flatnonzero((r > -1.0) & (r < rows) & (c > -1.0) & (c < (math.inf if cols is None else cols)))
        for part, ahead in self._together(r, c, near):
            cells = _around(r[part], rows), _around(c[part], cols)
            land = self._windows.get(cells, ahead=ahead)
            top, left = self._at(land)
            out[part] = sampled(land.values, r[part] - top, c[part] - left, method)
        return out.reshape(row.shape)

    def covers(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> NDArray[np.bool_]:
        """Whether positions lie between the outermost tiles, in a gap or not; of the broadcast shape."""
        if self._finest.period is None:
            return super().covers(lat_deg, lon_deg)
        row, _ = self.cells(lat_deg, lon_deg)
        inside: NDArray[np.bool_] = (row >= -1e-6) & (row <= self.shape[0] - 1 + 1e-6)
        return inside

    def crop(self, south_deg: float, west_deg: float, north_deg: float, east_deg: float) -> Map:
        """As `Map.crop`: a Map of the cells whose centres enclose a box, in memory.

        Raises
        ------
        DataError
            The box has no area, misses the map, or lies in a gap.
        ConfigError
            It does not fit into the memory.
        """
        try:
            place = self._place
            if self._finest.period is not None:  # the edge of the grid is no edge
                middle = 0.5 * (west_deg + west_deg + (east_deg - west_deg) % 360.0)
                columns = int(self._place.cells(0.0, middle)[1]) - self.shape[1] // 2
                place = place.cropped(((0, self.shape[0]), (columns, columns + self.shape[1])))
            else:
                columns = 0
            (r0, r1), (c0, c1) = place.window(south_deg, west_deg, north_deg, east_deg)
        except DataError as error:
            raise DataError(f"{self.name}: {error}") from None
        return self._whole(((r0, r1), (c0 + columns, c1 + columns)))

    @cached_property
    def checksum(self) -> str:
        """SHA-256 of the grid and of what each tile's file says of its content (see `terranav.io.mosaics`)."""
        digest = hashlib.sha256(repr((self.shape, self.transform, self.crs, self.kind)).encode())
        for tile in self.tiles:
            digest.update(tile.fingerprint().encode())
        return digest.hexdigest()

    def info(self) -> dict[str, Any]:
        """As `Map.info`, with how many tiles there are; of a large mosaic, figures of parts spread over its tiles."""
        from terranav.maps.info import describe

        rows, cols = self.shape
        seen = self.typical()
        share = min(seen.values.size / (rows * cols), 1.0)
        south, west, north, east = self.bounds_deg
        own = {"extent_deg": {"south": south, "west": west, "north": north, "east": east}, "checksum": self.checksum}
        size = {"rows": rows, "cols": cols, "cell_m": self.cell_m, "tiles": self.tile_count, "looked_at": share}
        return describe(seen) | own | size

    def typical(self) -> Map:
        """The whole as a Map in memory where it is small, else parts of up to 64 tiles below each other."""
        rows, cols = self.shape
        if rows * cols <= SAMPLED:
            return self._whole(((0, rows), (0, cols)))
        side, tiles = math.isqrt(SAMPLED // 64), self.tiles
        parts = []
        for tile in tiles[:: -(-len(tiles) // 64)] if len(tiles) > 1 else ():
            at = self.cells(*tile.place.centre_deg)
            parts.append((int(at[0]), int(at[1])))
        if len(tiles) == 1:
            parts = [(rows * i // 16, cols * j // 16) for i in range(1, 16, 2) for j in range(1, 16, 2)]
        whole = np.full((len(parts) * (side + 1), side), np.nan, np.float32)  # a void row between
        for k, (row, col) in enumerate(parts):
            top, left = row - side // 2, col - side // 2
            whole[k * (side + 1) : (k + 1) * (side + 1) - 1] = self._read(((top, top + side), (left, left + side)))
        return self._map(((0, len(whole)), (0, side)), whole)

    def _whole(self, window: Window) -> Map:
        """A window as a Map of its own."""
        (r0, r1), (c0, c1) = window
        need(8.0 * (r1 - r0) * (c1 - c0), f"{self.name}: map of {r1 - r0} x {c1 - c0} cells")
        return self._map(window, self._read(window))

    def _map(self, window: Window, values: Float32Array) -> Map:
        """Checked values of a window as a Map."""
        values.setflags(write=False)
        about = {key: getattr(self, key) for key in self.__dataclass_fields__ if key not in ("values", "transform")}
        return Map(values, self._place.cropped(window).transform, **about)

    def _part(self, window: Window, values: Float32Array) -> Map:
        """A window as a Map that need not have a value anywhere."""
        state = {key: getattr(self, key) for key in self.__dataclass_fields__ if key != "values"}
        part = Map.__new__(Map)
        place = self._place.cropped(window)
        part.__setstate__(state | {"values": values, "transform": place.transform, "_place": place})
        return part

    def _at(self, land: Map) -> tuple[int, int]:
        """First row and column of a window."""
        (a, b, c, d, e, f), (_, _, x, _, _, y) = self.transform, land.transform
        det = a * e - b * d
        return round((a * (y - f) - d * (x - c)) / det), round((e * (x - c) - b * (y - f)) / det)

    def _read(self, window: Window) -> Float32Array:
        """What the tiles have in a window of the grid."""
        (r0, r1), (c0, c1) = window
        down, right = self._start
        own = (r0 + down, r1 + down), (c0 + right, c1 + right)
        if len(self._layers) == 1:
            return self._finest.read(own)
        out = np.full((r1 - r0, c1 - c0), np.nan, np.float32)
        for layer in self._layers:
            if layer is self._finest:
                np.copyto(out, layer.read(own), where=np.isnan(out))
            else:
                interpolated(layer, self._place, (r0, c0), out)
        for layer in self._layers:  # between the outer cells of tiles that meet
            interpolated(layer, self._place, (r0, c0), out, nearest=True)
        return out

    def _reach(self, lat: FloatArray, lon: FloatArray, radius_m: float) -> Ends:
        """Least and greatest row, and least and greatest column, within a distance of places (n,)."""
        row, col = self.cells(lat, lon)
        outer = [self._ends(float(lat[k]), float(lon[k]), radius_m) for k in (lat.argmin(), lat.argmax())]
        down, across = (max(0.5 * (ends[axis][1] - ends[axis][0]) for ends in outer) for axis in (0, 1))
        (top, bottom), (left, right) = ((float(axis.min()), float(axis.max())) for axis in (row, col))
        return (top - down, bottom + down), (left - across, right + across)

    def _ends(self, lat_deg: float, lon_deg: float, radius_m: float) -> Ends:
        """As `_reach`, of one place."""
        frame = self.local_frame(lat_deg, lon_deg, radius_m)
        ends = []
        for at, north, east, *curved in (frame.row.tolist(), frame.col.tolist()):
            span = radius_m * (abs(north) + abs(east) + radius_m * sum(map(abs, curved)))
            ends.append((at - span, at + span))
        return ends[0], ends[1]

    def _bounded(self, ends: Ends) -> Window:
        """Whole cells of the grid, no more than fit into a window."""
        sides = [high - low for low, high in ends]
        if not math.isfinite(sides[0] + sides[1]):
            return (0, 2), (0, 2)
        cells = _cells_between(*ends[0], self._edges[0]), _cells_between(*ends[1], self._edges[1])
        if self._windows.fits(cells):
            return cells
        self._say_clipped(sides)
        return self._windows.cut(cells)

    def _say_clipped(self, sides: Sequence[float]) -> None:
        """Warn, once."""
        if not self._clipped.is_set():
            self._clipped.set()
            cells, megabytes = " x ".join(f"{side:.0f}" for side in sides), 8 * self._windows.most_cells / 2**20
            warnings.warn(
                f"{self.name}: a search over {cells} cells does not fit into {megabytes:.0f} MiB of map; only its "
                "middle is compared (open_map(memory_mb=...) gives it more)",
                DataWarning,
                stacklevel=4,
            )

    def _together(self, row: FloatArray, col: FloatArray, near: NDArray[np.intp]) -> list[tuple[Any, bool]]:
        """Places in groups that one window holds each, and whether to read ahead."""
        if not near.size:
            return []
        rows, cols = _around(row[near], None), _around(col[near], None)
        if self._windows.fits((rows, cols)) and (rows[1] - rows[0]) * (cols[1] - cols[0]) <= ONE_WINDOW:
            return [(near, True)]
        block = np.floor(row[near] / BLOCK) * 2.0**26 + np.floor(col[near] / BLOCK)
        order = np.argsort(block, kind="stable")
        ends = np.flatnonzero(np.diff(block[order])) + 1
        return [(near[part], False) for part in np.split(order, ends)]


def _around(position: FloatArray, size: int | None) -> tuple[int, int]:
    return _cells_between(float(position.min()), float(position.max()), size)


def _cells_between(low: float, high: float, size: int | None) -> tuple[int, int]:
    """First and past-the-last cell around positions with a margin, within the grid, at least two."""
    first, past = math.floor(low) - MARGIN, math.ceil(high) + MARGIN + 1
    if size is None:
        return first, past
    first, past = min(max(first, 0), size - 2), min(max(past, 2), size)
    return first, max(past, first + 2)

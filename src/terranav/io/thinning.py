"""Maps larger than memory, a piece at a time: a part of one, in another datum, or with fewer cells to look at."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError
from terranav.core.memory import need
from terranav.io.geoid import Given, finder
from terranav.io.mosaics import paths_of
from terranav.io.rasters import LARGE_CELLS, open_map
from terranav.io.sources import How, source_of
from terranav.maps.datum import Shift, shift_of
from terranav.maps.georeference import Box, Georeference, Window
from terranav.maps.info import describe
from terranav.maps.map import Map
from terranav.maps.mosaic import SAMPLED, Mosaic

Float32Array = NDArray[np.float32]

PIECE = (
    1024  # cells along the side of what is in memory at a time: whole blocks of a GeoTIFF, whole windows of a mosaic
)
CACHE_BYTES = 32 * 2**20  # of decoded blocks of all files
LOOKS = 8  # along each side: where a large part is looked at for its figures


@dataclass(frozen=True)
class Part:
    """A window of a map, read where and when it is wanted.

    Attributes
    ----------
    chart : Map
        Whose cells these are.
    window : (first row, past the last), (first column, past the last)
        Of the chart; columns of one that goes around the Earth may run beyond it.
    shift : Shift or None
        What is added to the values: they count from another datum then.
    """

    chart: Map
    window: Window
    shift: Shift | None = None

    @cached_property
    def place(self) -> Georeference:
        """The grid of the window."""
        chart = self.chart
        return Georeference(chart.shape, chart.transform, chart.crs).cropped(self.window)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.place.shape

    @property
    def datum(self) -> str | None:
        """What the values count from."""
        return self.chart.datum if self.shift is None else self.shift.target

    @property
    def is_large(self) -> bool:
        """Whether it is better read in pieces."""
        return math.prod(self.shape) > LARGE_CELLS

    def read(self, window: Window) -> Float32Array:
        """Values of a window of the part (rows, cols) in the chart's unit, NaN where void; the caller's own."""
        (top, left), ((r0, r1), (c0, c1)) = (self.window[0][0], self.window[1][0]), window
        if isinstance(self.chart, Mosaic):
            values = self.chart._read(((r0 + top, r1 + top), (c0 + left, c1 + left)))
        else:
            values = np.array(self.chart.values[r0 + top : r1 + top, c0 + left : c1 + left])
        if self.shift is not None and self.shift.geoids:
            known = np.nonzero(~np.isnan(values))
            if known[0].size:
                lat, lon = self.place.lat_lon(known[0] + r0, known[1] + c0)
                values[known] += self.shift.heights(lat, lon)
        return values

    def pieces(self, down: int = PIECE, across: int = PIECE) -> Iterator[tuple[Window, Float32Array]]:
        """The whole, row of pieces by row, each no larger than `down` x `across` cells: its window and its values."""
        rows, cols = self.shape
        with _little_cache():
            for r0 in range(0, rows, down):
                for c0 in range(0, cols, across):
                    window = (r0, min(r0 + down, rows)), (c0, min(c0 + across, cols))
                    yield window, self.read(window)

    def whole(self) -> Map:
        """The part as a Map in memory.

        Raises
        ------
        DataError
            It is void throughout.
        ConfigError
            It does not fit into the memory.
        """
        rows, cols = self.shape
        if self.shift is None and not isinstance(self.chart, Mosaic) and self.shape == self.chart.shape:
            return self.chart
        need(8.0 * rows * cols, f"{self.chart.name}: map of {rows} x {cols} cells")
        return self._map(self.read(((0, rows), (0, cols))), self.place)

    def info(self) -> dict[str, Any]:
        """As `Map.info`; of a large part, figures of pieces spread over it."""
        with _little_cache():
            return self._info()

    def _info(self) -> dict[str, Any]:
        if self.shift is None and self.window == tuple((0, size) for size in self.chart.shape):
            return self.chart.info()
        if not self.is_large:
            return self.whole().info()
        rows, cols = self.shape
        side = math.isqrt(SAMPLED // LOOKS**2)
        tall, wide = min(side, rows), min(side, cols)
        seen = np.full((LOOKS**2, tall + 1, wide), np.nan, np.float32)  # a void row between
        for k in range(LOOKS**2):
            top, left = (rows - tall) * (k // LOOKS) // (LOOKS - 1), (cols - wide) * (k % LOOKS) // (LOOKS - 1)
            seen[k, :-1] = self.read(((top, top + tall), (left, left + wide)))
        facts = describe(self._map(seen.reshape(-1, wide), replace(self.place, shape=(LOOKS**2 * (tall + 1), wide))))
        south, west, north, east = self.place.bounds_deg
        box = {"south": south, "west": west, "north": north, "east": east}
        print_of = hashlib.sha256(repr((self.chart.checksum, self.window, self.datum)).encode()).hexdigest()
        own = {"rows": rows, "cols": cols, "cell_m": self.place.cell_m, "extent_deg": box, "checksum": print_of}
        return facts | own | {"looked_at": min(LOOKS**2 * tall * wide / (rows * cols), 1.0)}

    def _map(self, values: Float32Array, place: Georeference) -> Map:
        """Values as a Map that is called what the chart is."""
        values.setflags(write=False)
        facts = {entry.name: getattr(self.chart, entry.name) for entry in fields(Map) if entry.name != "values"}
        return Map(**{**facts, "values": values, "transform": place.transform, "datum": self.datum})


def part_of(chart: Map) -> Part:
    """All of a map."""
    rows, cols = chart.shape
    return Part(chart, ((0, rows), (0, cols)))


def open_part(path: str | Path, box: Box | None = None, **options: Any) -> Part:
    """Open a map, or what lies in a box of it; of what is large nothing is read yet.

    Parameters
    ----------
    path : str or Path
        As of `open_map`.
    box : (south, west, north, east), optional
        As of `open_map` [deg].
    **options
        The others of `open_map`.

    Raises
    ------
    DataError, ConfigError
        As `open_map`.
    """
    if box is None:
        return part_of(open_map(path, **options))
    if paths_of(path) is None:
        how = How(**{entry.name: options[entry.name] for entry in fields(How) if entry.name in options})
        place = source_of(path, how).place
        if math.prod(place.shape) <= LARGE_CELLS or _cells(place, box) <= LARGE_CELLS:
            return part_of(open_map(path, box=box, **options))
    chart = open_map(path, **options)
    return Part(chart, _window(chart, box))


def converted(part: Part, to: str, geoid: Given = None) -> Part:
    """The same cells with heights that count from another datum.

    Parameters
    ----------
    part : Part
    to : str
        As of `terranav.maps.datum.convert`.
    geoid : path, Geoid, or several of them, optional
        As of `terranav.io.geoid.finder`.

    Raises
    ------
    ConfigError, DataError
        As `terranav.maps.datum.convert`; that a grid does not cover the map only when its values are read.
    """
    return replace(part, shift=shift_of(part.chart, to, finder(geoid)))


def thinned(part: Part, longest: int) -> tuple[Map, tuple[int, int]]:
    """A map with fewer, larger cells: each the mean of the known ones among so many rows and columns.

    It has from `longest` to twice as many cells along a side of a longer one; shorter sides stay as they are. All of
    the part is read, once, in pieces: memory is taken for the answer and one piece.

    Parameters
    ----------
    part : Part
    longest : int

    Returns
    -------
    map : Map
        A cell is void only where all that it stands for are. Its outer side may be half a cell off the part's.
    down, across : int
        Rows and columns that a cell stands for, 1 where nothing was thinned.

    Raises
    ------
    DataError
        The part is void throughout.
    """
    (rows, cols), (down, across) = part.shape, (max(size // longest, 1) for size in part.shape)
    if down == across == 1:
        return part.whole(), (1, 1)
    size = max(round(rows / down), 2), max(round(cols / across), 2)
    out = np.full(size, np.nan, np.float32)
    step = max(PIECE // down, 1), max(PIECE // across, 1)
    for ((r0, _), (c0, _)), values in part.pieces(step[0] * down, step[1] * across):
        means = _means(values, down, across)
        top, left = r0 // down, c0 // across
        tall, wide = min(means.shape[0], size[0] - top), min(means.shape[1], size[1] - left)
        out[top : top + tall, left : left + wide] = means[:tall, :wide]
    a, b, c, d, e, f = part.place.transform
    place = Georeference(size, (a * across, b * down, c, d * across, e * down, f), part.place.crs)
    return part._map(out, place), (down, across)


def _means(values: Float32Array, down: int, across: int) -> NDArray[np.float64]:
    """Means of the known values of blocks of rows and columns, those at the ends smaller; NaN where none is known."""
    ends = tuple((0, -size % step) for size, step in zip(values.shape, (down, across), strict=True))
    if ends != ((0, 0), (0, 0)):
        values = np.pad(values, ends, constant_values=np.nan)
    rows, cols = values.shape

    def sums(of: NDArray[Any]) -> NDArray[np.float64]:
        strips = np.add.reduce(of.reshape(rows // down, down, cols), axis=1, dtype=np.float64)  # columns side by side
        total: NDArray[np.float64] = strips.reshape(rows // down, cols // across, across).sum(axis=2)
        return total

    total = sums(values)
    if not np.isnan(total).any():
        return total / (down * across)
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        means: NDArray[np.float64] = sums(np.where(known, values, np.float32(0.0))) / sums(known)
    return means


def _window(chart: Map, box: Box) -> Window:
    """The cells of a box of a map, as `Map.crop` would cut them out; a map around the Earth goes on at its edge."""
    south, west, north, east = box
    place = Georeference(chart.shape, chart.transform, chart.crs)
    (rows, cols), around = chart.shape, 360.0 / abs(chart.transform[0])
    start = 0
    if isinstance(chart, Mosaic) and place.projection.geographic and abs(cols - around) < 0.5:
        middle = 0.5 * (west + west + (east - west) % 360.0)
        start = int(place.cells(0.0, middle)[1]) - cols // 2
    try:
        (r0, r1), (c0, c1) = place.cropped(((0, rows), (start, start + cols))).window(south, west, north, east)
    except DataError as error:
        raise DataError(f"{chart.name}: {error}") from None
    return (r0, r1), (c0 + start, c1 + start)


def _cells(place: Georeference, box: Box) -> int:
    """How many cells a box of a grid has; none where it misses it, which is said when it is read."""
    try:
        (r0, r1), (c0, c1) = place.window(*box)
    except DataError:
        return 0
    return (r1 - r0) * (c1 - c0)


def _little_cache() -> AbstractContextManager[Any]:
    """GDAL keeps 5 % of the machine's memory in decoded blocks unless it is told not to."""
    import rasterio

    own = {} if "GDAL_CACHEMAX" in os.environ else {"GDAL_CACHEMAX": CACHE_BYTES}
    return rasterio.Env(**own)  # type: ignore[no-any-return]

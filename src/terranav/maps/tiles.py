"""Tiles of a mosaic: which of them share one grid, and what is in a window of that grid."""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.errors import DataError, DataWarning
from terranav.maps.georeference import Georeference, Window
from terranav.maps.map import sampled

Float32Array = NDArray[np.float32]
FloatArray = NDArray[np.float64]

SAME_CELL = 1e-3  # of a cell: grids that differ by less from end to end are one


@dataclass(frozen=True)
class Tile:
    """A map in a file.

    Attributes
    ----------
    name : str
        For messages.
    place : Georeference
    read : function of a window
        ((first row, past the last), (first column, past the last)) -> (rows, cols) float32, NaN where void. It may
        raise DataError, which leaves the tile out.
    fingerprint : function
        A text that changes with the content.
    """

    name: str
    place: Georeference
    read: Callable[[Window], Float32Array]
    fingerprint: Callable[[], str] = str


class Layer:
    """Tiles whose cells coincide where they overlap: a window of them is exact across their seams.

    Parameters
    ----------
    tiles : sequence of Tile
        On one grid, but for whole cells and whole turns of the Earth. Where several have a value the first has it.

    Attributes
    ----------
    place : Georeference
        The grid from the outermost tile to the outermost.
    at : (n, 4) int64
        First row, past the last, first column and past the last of each tile.
    period : int or None
        Columns around the Earth, of a grid that goes around.
    """

    def __init__(self, tiles: Sequence[Tile]) -> None:
        self.tiles = tuple(tiles)
        first = self.tiles[0].place
        shifts = [np.round(_offset(first, tile.place)).astype(int) for tile in self.tiles]
        around = round(360.0 / abs(first.transform[0])) if _turns(first) else None
        if around is not None:
            shifts = _unrolled(shifts, [tile.place.shape[1] for tile in self.tiles], around)
        start = np.min(shifts, axis=0)
        size = np.array([tile.place.shape for tile in self.tiles])
        origin = np.array(shifts) - start
        self.at = np.stack([origin[:, 0], origin[:, 0] + size[:, 0], origin[:, 1], origin[:, 1] + size[:, 1]], axis=1)
        shape = int(self.at[:, 1].max()), int(self.at[:, 3].max())
        (top, left), (rows, cols) = start.tolist(), shape
        self.place = first.cropped(((top, top + rows), (left, left + cols)))
        self.period = around if around is not None and shape[1] >= around else None
        self._broken: set[int] = set()
        self._lock = threading.Lock()

    def read(self, window: Window) -> Float32Array:
        """The values of a window, which may reach beyond the grid: NaN there, and around the Earth if the grid is."""
        (top, bottom), (left, right) = window
        if self.period is None or 0 <= left < right <= self.period:
            return self._filled(window)
        out = np.empty((bottom - top, right - left), np.float32)
        column = left
        while column < right:  # turn by turn; a column more than the period is there twice
            turn = column // self.period
            past, west = min(right, (turn + 1) * self.period), turn * self.period
            out[:, column - left : past - left] = self._filled((window[0], (column - west, past - west)))
            column = past
        return out

    def _filled(self, window: Window) -> Float32Array:
        """What the tiles have in a window, NaN elsewhere."""
        (top, bottom), (left, right) = window
        at, out = self.at, None
        for k in np.flatnonzero((at[:, 0] < bottom) & (at[:, 1] > top) & (at[:, 2] < right) & (at[:, 3] > left)):
            if k in self._broken:
                continue
            r0, r1, c0, c1 = (int(number) for number in at[k])
            rows, cols = (max(r0, top), min(r1, bottom)), (max(c0, left), min(c1, right))
            if out is not None:
                part = out[rows[0] - top : rows[1] - top, cols[0] - left : cols[1] - left]
                missing = np.isnan(part)
                if not missing.any():
                    continue
            found = self._read(int(k), ((rows[0] - r0, rows[1] - r0), (cols[0] - c0, cols[1] - c0)))
            if found is None:
                continue
            if out is not None:
                np.copyto(part, found, where=missing)
            elif (rows, cols) == window:
                out = found
            else:
                out = np.full((bottom - top, right - left), np.nan, np.float32)
                out[rows[0] - top : rows[1] - top, cols[0] - left : cols[1] - left] = found
        return np.full((bottom - top, right - left), np.nan, np.float32) if out is None else out

    def _read(self, k: int, window: Window) -> Float32Array | None:
        """A window of a tile; None, and a warning the first time, of one that cannot be read."""
        try:
            return self.tiles[k].read(window)
        except DataError as error:
            with self._lock:
                new = k not in self._broken
                self._broken.add(k)
            if new:
                warnings.warn(f"{error}; the tile is left out", DataWarning, stacklevel=2)
            return None


def layers(tiles: Sequence[Tile]) -> list[Layer]:
    """Tiles by the grids that they share, in the order of the first of each."""
    groups: list[list[Tile]] = []
    for tile in tiles:
        for group in groups:
            if _same_grid(group[0].place, tile.place):
                group.append(tile)
                break
        else:
            groups.append([tile])
    return [Layer(group) for group in groups]


def union(finest: Layer, others: Sequence[Layer]) -> tuple[Georeference, tuple[int, int]]:
    """The grid of a layer made so large that it holds others, and where it begins in that layer's rows and columns."""
    low, high = np.zeros(2), np.array(finest.place.shape, dtype=np.float64)
    for layer in others:
        rows, cols = layer.place.shape
        t = np.linspace(-0.5, 0.5, 41)
        row, col = np.meshgrid(0.5 * (rows - 1) + t * rows, 0.5 * (cols - 1) + t * cols, indexing="ij")
        at = np.stack(finest.place.cells(*layer.place.lat_lon(row, col))).reshape(2, -1)
        at = at[:, np.isfinite(at).all(axis=0)]
        if at.size:
            low, high = np.minimum(low, np.floor(at.min(axis=1))), np.maximum(high, np.ceil(at.max(axis=1)) + 1.0)
    if finest.period is not None:
        low[1], high[1] = 0.0, finest.place.shape[1]
    (top, left), (bottom, right) = low.astype(int).tolist(), high.astype(int).tolist()
    return finest.place.cropped(((top, bottom), (left, right))), (top, left)


def interpolated(
    layer: Layer, place: Georeference, start: tuple[int, int], out: Float32Array, *, nearest: bool = False
) -> None:
    """Write a layer into the cells of another grid that are NaN: bilinear, or the nearest cell.

    Parameters
    ----------
    layer : Layer
    place : Georeference
        The other grid.
    start : row and column of its first cell in `out`
    out : (rows, cols)
        Written to.
    nearest : bool
        The nearest cell, no more than half a cell away along rows and columns: for what lies beside voids and edges.
    """
    at = np.nonzero(np.isnan(out))
    if not at[0].size:
        return
    row, col = layer.place.cells(*place.lat_lon(at[0] + start[0], at[1] + start[1]))
    rows, cols = layer.place.shape
    with np.errstate(invalid="ignore"):
        known = (row > -0.5 - 1e-6) & (row < rows - 0.5 + 1e-6)
        if layer.period is None:
            known &= (col > -0.5 - 1e-6) & (col < cols - 0.5 + 1e-6)
    if not known.any():
        return
    row, col = row[known], col[known]
    top, left = math.floor(row.min()) - 1, math.floor(col.min()) - 1
    values = layer.read(((top, math.ceil(row.max()) + 2), (left, math.ceil(col.max()) + 2)))
    if nearest:
        found = values[np.rint(row - top).astype(int), np.rint(col - left).astype(int)].astype(np.float64)
    else:
        found = sampled(values, row - top, col - left, "bilinear")
    out[at[0][known], at[1][known]] = found


def _turns(place: Georeference) -> bool:
    """Whether columns are meridians, a whole number of them around the Earth."""
    a, b, _, d, _, _ = place.transform
    if not place.projection.geographic or b != 0.0 or d != 0.0:
        return False
    around = 360.0 / abs(a)
    return abs(around - round(around)) < 10.0 * SAME_CELL


def _offset(first: Georeference, other: Georeference) -> FloatArray:
    """Row and column, in the first grid, of the first cell of another."""
    a, b, c, d, e, f = other.transform
    x, y = c + 0.5 * (a + b), f + 0.5 * (d + e)
    i = first.inverse
    return np.array([i[3] * x + i[4] * y + i[5], i[0] * x + i[1] * y + i[2]])


def _same_grid(first: Georeference, other: Georeference) -> bool:
    """Whether the cells of two grids coincide but for whole numbers of them."""
    one, two = first.projection, other.projection
    if not (one is two or (one.plain and two.plain) or one.crs == two.crs):
        return False
    a, b, _, d, e, _ = first.transform
    p, q, _, s, t, _ = other.transform
    cell = min(np.hypot(a, d), np.hypot(b, e))
    if max(abs(a - p), abs(b - q), abs(d - s), abs(e - t)) * max(other.shape) > SAME_CELL * cell:
        return False
    offset = _offset(first, other)
    return bool((np.abs(offset - np.round(offset)) < 10.0 * SAME_CELL).all())


def _unrolled(shifts: list[NDArray[np.int_]], width: Sequence[int], around: int) -> list[NDArray[np.int_]]:
    """First rows and columns with whole turns added, so that the largest gap between tiles lies at the ends."""
    west = np.array([shift[1] for shift in shifts]) % around
    order = np.argsort(west, kind="stable")
    reach, start, widest = 0, int(west[order[0]]), -1
    reach = max(int(west[k]) + width[k] for k in order) - around  # what hangs over the seam
    for k in order:
        gap = int(west[k]) - reach
        if gap > widest:
            widest, start = gap, int(west[k])
        reach = max(reach, int(west[k]) + width[k])
    return [np.array([shift[0], start + (int(w) - start) % around]) for shift, w in zip(shifts, west, strict=True)]

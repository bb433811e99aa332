"""Placements of a track on a map: the tables of a search without a prior, and the search."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.memory import need
from terranav.kernels import locating
from terranav.maps.crs import projection
from terranav.maps.frame import LocalFrame
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Region = tuple[int, int, int, int]  # first row, past row, first column, past column

TOP = 6  # levels above the single cell: blocks of 2, 4 ... 64 cells
SWEEP = 0.25  # most that an interval of headings or scales moves a point either way, of its level's block
SHAPE_BYTES = 256 * 2**20  # of the shapes in all regions that are kept for the next search
POINT_BYTES = 48  # of a point of a shape, both levels of it


@dataclass
class Search:
    """What one search needs: the track about its middle, weights, tables, and the work done."""

    chart: Map
    values: NDArray[np.float32]  # of the chart, read once
    points: FloatArray  # (2, k) north and east of the middle [m]
    along: FloatArray  # from the first point [m]
    height: FloatArray
    weight: FloatArray
    offset_weight: float
    void_cost: float
    half: float  # of the heading range [rad]
    stretch: float  # of the range of scales
    tables: tuple[Any, Any, Any]  # least and greatest heights of windows and whether they hold any, a level each
    spans: IntArray
    shapes: IntArray  # (levels, 2) where each level's begin, and how many
    mids: FloatArray  # (shapes, 2) heading [rad] and factor
    halves: FloatArray  # (shapes, 2) of the heading [rad], and of the factor against its own
    parts: tuple[int, int]  # finest intervals of heading and scale
    kept: dict[Region, Any] = field(default_factory=dict)  # shapes of regions, for the next search
    counts: IntArray = field(default_factory=lambda: np.zeros(3, dtype=np.int64))

    @property
    def lookups_of_all(self) -> float:
        """Lookups of every cell, finest shape and point [double, since it may be large]."""
        return float(self.values.size) * float(self.shapes[0, 1]) * self.height.size

    @property
    def leaf(self) -> float:
        """Volume of a finest heading and scale, what is known not counting [rad]."""
        return self.whole / float(self.shapes[0, 1])

    @property
    def whole(self) -> float:
        """Volume of all headings and scales, what is known not counting [rad]."""
        return math.prod(2.0 * one for one in (self.half, self.stretch) if one > 0.0)

    @property
    def reach_m(self) -> float:
        """Of the farthest point from the middle [m]."""
        return float(np.hypot(*self.points).max())

    def turned(self, psi: float, factor: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """Metres north and east of the middle after a turn clockwise [rad], and a stretch."""
        cos, sin = factor * math.cos(psi), factor * math.sin(psi)
        return self.points[0] * cos - self.points[1] * sin, self.points[0] * sin + self.points[1] * cos

    def frame(self, row: float, col: float) -> LocalFrame:
        """The map around a cell."""
        radius = (1.0 + self.stretch) * self.reach_m
        return self.chart.local_frame(*lat_lon(self.chart, row, col), radius_m=max(radius, 100.0))


def lat_lon(chart: Map, row: float, col: float) -> tuple[float, float]:
    """Latitude and longitude of a fractional cell [deg]."""
    a, b, c, d, e, f = chart.transform
    x, y = a * (col + 0.5) + b * (row + 0.5) + c, d * (col + 0.5) + e * (row + 0.5) + f
    lat, lon = projection(chart.crs).inverse(np.array([x]), np.array([y]))
    return float(lat[0]), (float(lon[0]) + 180.0) % 360.0 - 180.0


@dataclass(frozen=True)
class Shapes:
    """Headings and factors of each level, as in `Search`."""

    begins: IntArray
    mids: FloatArray
    halves: FloatArray
    parts: tuple[int, int]


def shapes_of(half: float, stretch: float, reach_cells: float) -> Shapes:
    """Headings and factors of each level, the finest first: where they begin, their middles and half intervals.

    Each shape of a level is divided into as many of the next finer one, which stand one after the other there.
    """
    counts = np.array([[_parts(one * reach_cells, level) for one in (half, stretch)] for level in range(TOP + 1)])
    whole = np.array([half, stretch])
    middles = [np.array([[0.0, 1.0]])]
    before = np.array([1, 1])
    for count in counts[::-1]:
        ratio = count // before
        steps = [(2.0 * np.arange(n) + 1.0 - n) * w / c for n, w, c in zip(ratio, whole, count)]
        inner = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
        middles.append((middles[-1][:, None] + inner).reshape(-1, 2))
        before = count
    finest_first = middles[:0:-1]
    sizes = np.array([len(one) for one in finest_first])
    mids = np.concatenate(finest_first)
    halves = np.repeat(whole / counts, sizes, axis=0)
    halves[:, 1] /= mids[:, 1]
    begins = np.column_stack([np.cumsum(sizes) - sizes, sizes])
    return Shapes(begins, mids, halves, (int(counts[0, 0]), int(counts[0, 1])))


def _parts(sweep_cells: float, level: int) -> int:
    """Into how many intervals a range is divided that moves a point by so much either way."""
    wanted = sweep_cells / (SWEEP * 2**level)
    return int(2 ** math.ceil(math.log2(max(wanted, 1.0))))


def tables_of(values: NDArray[np.float32]) -> tuple[tuple[Any, Any, Any], IntArray]:
    """Least and greatest heights of windows for blocks of 1, 2, 4 ... cells, and whether they hold anything but voids.

    A void makes a window unknown.
    """
    low, high = np.where(np.isnan(values), -np.inf, values), np.where(np.isnan(values), np.inf, values)
    low, high = (
        _wider(_wider(low, 1, 1, np.minimum), 1, 1, np.minimum),
        _wider(_wider(high, 1, 1, np.maximum), 1, 1, np.maximum),
    )
    some = _wider(_wider((~np.isnan(values)).view(np.uint8), 1, 1, np.maximum), 1, 1, np.maximum)
    lows, highs, somes, spans = [low], [high], [some], [(3, 1, 1)]
    for level in range(1, TOP + 1):
        width, stride, block = spans[-1]
        step = (1, 2)[level - 1] if level < 3 else (width - 1) // stride
        thin = 1 if level < 3 else 2
        lows.append(_wider(lows[-1], step, thin, np.minimum))
        highs.append(_wider(highs[-1], step, thin, np.maximum))
        somes.append(_wider(somes[-1], step, thin, np.maximum))
        spans.append((width + step * stride, stride * thin, 2 * block))
    return (tuple(lows), tuple(highs), tuple(somes)), np.array(spans, dtype=np.int64)


def _wider(table: NDArray[Any], step: int, thin: int, better: Any) -> NDArray[Any]:
    """Each window joined with the one `step` further on, along both axes; every `thin`-th one kept."""
    out = table[::thin].copy()
    part = table[step::thin]
    better(out[: len(part)], part[: len(out)], out=out[: len(part)])
    wide = np.ascontiguousarray(out[:, ::thin])
    part = out[:, step::thin]
    better(wide[:, : part.shape[1]], part, out=wide[:, : part.shape[1]])
    return wide


def regions_of(work: Search) -> list[Region]:
    """Parts of the map in which a track keeps its shape in cells."""
    rows, cols = work.values.shape
    side = 2**TOP
    width = cols if projection(work.chart.crs).plain else 4 * side
    return [
        (i, min(i + side, rows), j, min(j + width, cols)) for i in range(0, rows, side) for j in range(0, cols, width)
    ]


def shape_in(work: Search, region: Region) -> tuple[NDArray[np.int32], FloatArray]:
    """Under each point at each level's shapes, the cells it may lie on; and the points at the finest shapes.

    Both hold for the middle of the track anywhere in a region of the map, as in `locating.search`.
    """
    i0, i1, j0, j1 = region
    plain = projection(work.chart.crs).plain  # there the shape in cells depends on the row alone
    middle = work.frame(0.5 * (i0 + i1 - 1), 0.5 * (j0 + j1 - 1))
    corners = [work.frame(i, j) for i in (i0 - 0.5, i1 - 0.5) for j in ((j0,) if plain else (j0 - 0.5, j1 - 0.5))]
    count, size = len(work.mids), work.height.size
    ends = np.empty((4, count, size), dtype=np.int32)
    places = np.empty((2, int(work.shapes[0, 1]), size))
    frames = [np.array([frame.row, frame.col]) for frame in (middle, *corners)]
    locating.lie(work.points, work.mids, work.halves, frames[0], np.array(frames[1:]), ends, places)
    return ends, places


def relative(frame: LocalFrame, north: FloatArray, east: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows and columns from the frame's origin."""
    row, col = frame.cells(north, east)
    return row - frame.row[0], col - frame.col[0]


def searched(
    work: Search, weight: FloatArray, limit: float, margin: float, most: int
) -> tuple[FloatArray, float, bool]:
    """Cells and shapes whose bound is within a limit, which falls to the best middle's misfit and the margin.

    Returns
    -------
    kept : (n, 5): row, column, heading [rad], factor, misfit of the middle
    limit : float
        Below which nothing was left out, if the search is complete.
    complete : bool
    """
    rows, cols = work.values.shape
    found, limits = np.empty((most, 4)), np.array([limit, margin, np.inf])
    regions, complete = regions_of(work), True
    size = POINT_BYTES * len(work.mids) * work.height.size
    need(size, f"locate: {work.shapes[0, 1]} headings and scales of {work.height.size} points")
    work.counts[0] = 0
    for region in regions:
        ends, places = work.kept.get(region) or shape_in(work, region)
        if size * len(regions) <= SHAPE_BYTES:
            work.kept[region] = (ends, places)
        complete = locating.search(
            work.values, work.tables, work.spans, work.shapes, ends, places,
            (work.height, weight, work.offset_weight, rows, cols, work.void_cost), region, limits, found, work.counts,
        )  # fmt: skip
        if not complete:
            break
    some = found[: work.counts[0]]
    kept = np.column_stack([some[:, :2], work.mids[some[:, 2].astype(np.int64)], some[:, 3]])
    return kept, float(limits[0]), complete

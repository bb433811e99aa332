"""Placements of a track on a map: the tables of a search without a prior, the search, and the fits below the cell."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.kernels import locating, sampling
from terranav.maps.crs import projection
from terranav.maps.frame import LocalFrame
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

TOP = 6  # levels above the single cell: blocks of 2, 4 ... 64 cells
SWEEP = 0.25  # most that a heading interval moves a point either way, of its level's block
MOST_SHAPES = 200  # regions whose shapes are kept for the next search: some 50 MB
APART_CELLS = 2.5  # places nearer than this are one
ROUNDS = 25  # of a fit


@dataclass
class Search:
    """What one search needs: the track about its middle, weights, tables, and the work done."""

    chart: Map
    down: FloatArray  # north of the middle [m]
    right: FloatArray  # east of it [m]
    along: FloatArray  # from the first point [m]
    height: FloatArray
    weight: FloatArray
    offset_weight: float
    void_cost: float
    half: float  # of the heading range [rad]
    lows: tuple[NDArray[np.float32], ...]
    highs: tuple[NDArray[np.float32], ...]
    spans: IntArray
    headings: IntArray
    shapes: dict[tuple[int, int, int, int], Any] = field(default_factory=dict)  # of regions, for the next search
    counts: IntArray = field(default_factory=lambda: np.zeros(3, dtype=np.int64))

    @property
    def lookups_of_all(self) -> float:
        """Lookups of every cell, finest heading and point [double, since it may be large]."""
        return float(self.chart.values.size) * float(self.headings[0, 1]) * self.height.size

    def turned(self, psi: float) -> tuple[FloatArray, FloatArray]:
        """Metres north and east of the middle after a turn clockwise [rad]."""
        cos, sin = math.cos(psi), math.sin(psi)
        return self.down * cos - self.right * sin, self.down * sin + self.right * cos

    def frame(self, row: float, col: float) -> LocalFrame:
        """The map around a cell."""
        radius = float(np.hypot(self.down, self.right).max())
        return self.chart.local_frame(*lat_lon(self.chart, row, col), radius_m=max(radius, 100.0))


def lat_lon(chart: Map, row: float, col: float) -> tuple[float, float]:
    """Latitude and longitude of a fractional cell [deg]."""
    a, b, c, d, e, f = chart.transform
    x, y = a * (col + 0.5) + b * (row + 0.5) + c, d * (col + 0.5) + e * (row + 0.5) + f
    lat, lon = projection(chart.crs).inverse(np.array([x]), np.array([y]))
    return float(lat[0]), (float(lon[0]) + 180.0) % 360.0 - 180.0


def tables_of(values: NDArray[np.float32]) -> tuple[Any, Any, IntArray]:
    """Least and greatest heights of windows for blocks of 1, 2, 4 ... cells; a void makes a window unknown."""
    low, high = np.where(np.isnan(values), -np.inf, values), np.where(np.isnan(values), np.inf, values)
    low, high = (
        _wider(_wider(low, 1, 1, np.minimum), 1, 1, np.minimum),
        _wider(_wider(high, 1, 1, np.maximum), 1, 1, np.maximum),
    )
    lows, highs, spans = [low], [high], [(3, 1, 1)]
    for level in range(1, TOP + 1):
        width, stride, block = spans[-1]
        step = (1, 2)[level - 1] if level < 3 else (width - 1) // stride
        thin = 1 if level < 3 else 2
        lows.append(_wider(lows[-1], step, thin, np.minimum))
        highs.append(_wider(highs[-1], step, thin, np.maximum))
        spans.append((width + step * stride, stride * thin, 2 * block))
    return tuple(lows), tuple(highs), np.array(spans, dtype=np.int64)


def _wider(table: NDArray[np.float32], step: int, thin: int, better: Any) -> NDArray[np.float32]:
    """Each window joined with the one `step` further on, along both axes; every `thin`-th one kept."""
    out = table[::thin].copy()
    part = table[step::thin]
    better(out[: len(part)], part[: len(out)], out=out[: len(part)])
    wide = np.ascontiguousarray(out[:, ::thin])
    part = out[:, step::thin]
    better(wide[:, : part.shape[1]], part, out=wide[:, : part.shape[1]])
    return wide


def _regions(chart: Map) -> list[tuple[int, int, int, int]]:
    """Parts of the map in which a track keeps its shape in cells."""
    rows, cols = chart.shape
    side = 2**TOP
    width = cols if projection(chart.crs).plain else 4 * side
    return [
        (i, min(i + side, rows), j, min(j + width, cols)) for i in range(0, rows, side) for j in range(0, cols, width)
    ]


def shape_in(work: Search, region: tuple[int, int, int, int]) -> tuple[tuple[IntArray, ...], FloatArray]:
    """Under each point at each level's headings, the cells it may lie on; and the points at the finest headings.

    Both hold for the middle of the track anywhere in a region of the map; the first as in `locating.search`.
    """
    i0, i1, j0, j1 = region
    frame = work.frame(0.5 * (i0 + i1 - 1), 0.5 * (j0 + j1 - 1))
    plain = projection(work.chart.crs).plain  # there the shape in cells depends on the row alone
    corners = [work.frame(i, j) for i in (i0 - 0.5, i1 - 0.5) for j in ((j0,) if plain else (j0 - 0.5, j1 - 0.5))]
    ends: list[list[FloatArray]] = [[], [], [], []]
    places: list[list[FloatArray]] = [[], []]
    rho = np.hypot(work.down, work.right) * _cells_per_m(frame)
    for level in range(TOP + 1):
        count = int(work.headings[level, 1])
        half = work.half / count
        for h in range(count):
            moved = work.turned(-work.half + (2 * h + 1) * half)
            ahead = work.turned(-work.half + (2 * h + 1) * half + 0.5 * math.pi)
            at, turn = _relative(frame, *moved), _relative(frame, *ahead)
            others = [_relative(corner, *moved) for corner in corners]
            for axis in range(2):
                bent = np.max([np.abs(other[axis] - at[axis]) for other in others], axis=0)
                slack = half * np.abs(turn[axis]) + (0.5 * half * half + 0.02 * half) * rho + 1.1 * bent + 1e-4
                ends[2 * axis].append(np.floor(at[axis] - 0.5 - slack))
                ends[2 * axis + 1].append(np.ceil(at[axis] - 0.5 + slack))
                if level == 0:
                    places[axis].append(at[axis])
    whole = tuple(np.array(one).astype(np.int64) for one in ends)
    return whole, np.array(places)


def _cells_per_m(frame: LocalFrame) -> float:
    """Most cells in a metre, whichever way."""
    return float(np.linalg.norm(np.array([frame.row[1:3], frame.col[1:3]]), 2))


def _relative(frame: LocalFrame, north: FloatArray, east: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows and columns from the frame's origin."""
    row, col = frame.cells(north, east)
    return row - frame.row[0], col - frame.col[0]


def searched(
    work: Search, weight: FloatArray, limit: float, margin: float, most: int
) -> tuple[FloatArray, float, bool]:
    """Cells and headings whose bound is within a limit, which falls to the best middle's misfit and the margin.

    Returns
    -------
    kept : (n, 4): row, column, heading [rad], misfit of the middle
    limit : float
        Below which nothing was left out, if the search is complete.
    complete : bool
    """
    rows, cols = work.chart.shape
    found, limits = np.empty((most, 4)), np.array([limit, margin, np.inf])
    complete = True
    work.counts[0] = 0
    for region in _regions(work.chart):
        ends, places = work.shapes.get(region) or shape_in(work, region)
        if len(work.shapes) < MOST_SHAPES:
            work.shapes[region] = (ends, places)
        complete = locating.search(
            work.chart.values, work.lows, work.highs, work.spans, work.headings, ends, (places[0], places[1]),
            (work.height, weight, work.offset_weight, rows, cols, work.void_cost), region, limits, found, work.counts,
        )  # fmt: skip
        if not complete:
            break
    kept = found[: work.counts[0]]
    half = work.half / work.headings[0, 1]
    kept[:, 2] = -work.half + (2.0 * kept[:, 2] + 1.0) * half
    return kept, float(limits[0]), complete


@dataclass(frozen=True)
class Fit:
    """A placement at its least misfit nearby."""

    row: float
    col: float
    psi: float
    offset: float
    misfit: float
    sigma: float  # of the position along its worse axis [cells]
    volume: float  # [cells^2 rad], within which the likelihood is about its peak
    points: tuple[FloatArray, FloatArray]  # rows and columns, in the search's order
    residual: FloatArray  # NaN over voids


def fitted(work: Search, weight: FloatArray, kept: FloatArray, margin: float, most: int) -> tuple[list[Fit], int]:
    """The distinct places among what was kept, each at its least misfit, the best first; and how many were left."""
    fits: list[Fit] = []
    left = kept[np.argsort(kept[:, 3], kind="stable")]
    cell = (2.0 * work.half / work.headings[0, 1]) or 1.0
    for _ in range(most):
        if not len(left):
            break
        start = left[0]
        fit = _descended(work, weight, start)
        near = (np.abs(left[:, :2] - start[:2]).max(axis=1) <= APART_CELLS) | (
            np.abs(left[:, :2] - [fit.row, fit.col]).max(axis=1) <= APART_CELLS
        )
        near[0] = True
        cap = float(near.sum()) * cell
        if all(math.hypot(fit.row - one.row, fit.col - one.col) > APART_CELLS for one in fits):
            fits.append(replace(fit, volume=min(fit.volume, cap)))
        left = left[~near]
    fits.sort(key=lambda one: one.misfit)
    return [one for one in fits if one.misfit <= fits[0].misfit + margin], len(left)


def _descended(work: Search, weight: FloatArray, start: FloatArray) -> Fit:
    """Levenberg-Marquardt over row, column and heading, the offset eliminated."""
    frame = work.frame(float(start[0]), float(start[1]))
    at, damping = start[:3].astype(np.float64), 1e-3
    best = _placed(work, weight, frame, start, at)
    normal, right = _normal(work, weight, frame, best)
    for _ in range(ROUNDS):
        step = np.linalg.lstsq(normal + damping * np.diag(np.diag(normal) + 1e-12), right, rcond=None)[0]
        step *= min(1.0, 1.0 / max(float(np.abs(step[:2]).max()), 1e-12))  # a cell at a time
        to = np.array([*(at[:2] + step[:2]), min(max(at[2] + step[2], -work.half), work.half)])
        tried = _placed(work, weight, frame, start, to)
        if tried.misfit < best.misfit:
            gained, at, best, damping = best.misfit - tried.misfit, to, tried, 0.3 * damping
            normal, right = _normal(work, weight, frame, best)
            if gained < 1e-3:
                break
        else:
            damping *= 10.0
            if damping > 1e4:
                break
    size = 2 if work.half == 0.0 else 3
    known, ways = np.linalg.eigh(normal[:size, :size])
    known = np.maximum(known, 1e-12)
    sigma = math.sqrt(float(np.linalg.eigvalsh((ways[:2] / known) @ ways[:2].T)[-1]))
    return replace(best, volume=float(np.prod(np.sqrt(2.0 * math.pi / known))), sigma=sigma)


def _placed(work: Search, weight: FloatArray, frame: LocalFrame, start: FloatArray, at: FloatArray) -> Fit:
    """The placement at a row, column and heading; infinite misfit where it leaves the map."""
    down, right = _relative(frame, *work.turned(float(at[2])))
    row, col = at[0] + down, at[1] + right
    rows, cols = work.chart.shape
    height = np.empty(row.size)
    sampling.bilinear(work.chart.values, row, col, height)
    d = work.height - height
    known = np.isfinite(d)
    total = float(weight[known].sum()) + work.offset_weight
    offset = float((weight[known] * d[known]).sum()) / total if total > 0.0 else 0.0
    misfit = float((weight[known] * (d[known] - offset) ** 2).sum()) + work.offset_weight * offset**2
    misfit += work.void_cost * float((~known).sum())
    if row.min() < -1e-6 or col.min() < -1e-6 or row.max() > rows - 1 + 1e-6 or col.max() > cols - 1 + 1e-6:
        misfit = math.inf
    return Fit(float(at[0]), float(at[1]), float(at[2]), offset, misfit, 0.0, 0.0, (row, col), d - offset)


def _normal(work: Search, weight: FloatArray, frame: LocalFrame, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Normal matrix (3, 3) and right side (3,) of row, column and heading, the offset eliminated."""
    row, col = fit.points
    low, high, slopes = np.empty(row.size), np.empty(row.size), []
    for by_row, by_col in ((0.5, 0.0), (0.0, 0.5)):
        sampling.bilinear(work.chart.values, row - by_row, col - by_col, low)
        sampling.bilinear(work.chart.values, row + by_row, col + by_col, high)
        slopes.append(high - low)
    turn = _relative(frame, *work.turned(fit.psi + 0.5 * math.pi))
    jacobian = np.column_stack([*slopes, slopes[0] * turn[0] + slopes[1] * turn[1]])
    known = np.isfinite(jacobian).all(axis=1) & np.isfinite(fit.residual)
    j, w, r = jacobian[known], weight[known], fit.residual[known]
    total = max(float(w.sum()) + work.offset_weight, 1e-30)
    mean = (w @ j) / total
    normal = (j * w[:, None]).T @ j - total * np.outer(mean, mean)
    return normal, (j * w[:, None]).T @ r - mean * (w @ r)

"""A lattice between start and end, what each of its edges teaches, and the best way over it.

Nodes are `side` apart along and across the geodesic, which is itself a line of nodes; from each, sixteen edges go to
the neighbours and to the knight's moves. An edge is flown in pieces; the readings of a piece are summed up as the
information about position and bias (`kernels.routing.edge_information`), taken to arrive at its end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from terranav.kernels.routing import FULL, edge_information, search
from terranav.planning._route_plane import Plane, Walls
from terranav.planning._route_sensing import Sensing

FloatArray = NDArray[np.float64]

_HALF = ((1, 0), (2, 1), (1, 1), (1, 2), (0, 1), (-1, 2), (-1, 1), (-2, 1))
MOVES = np.array([*_HALF, *[(-a, -b) for a, b in _HALF]])
STEPS = 100  # nodes along the geodesic, at most
MOST_NODES = 14_000
PIECES = 2.0  # that an edge as long as the lattice's side is flown in
READINGS_A_CELL = 2.0  # of an edge
CARE = ((0.4, 12, 120_000), (1.0, 3, 250_000), (1.0, 1, 1_000_000))  # slack of dominance in variance, labels at one
# place and heading, labels in all: where a search would need more, the next, coarser one has them
LEAST_SIDE_RADII = 0.6  # of the turn radius: a lattice finer than that has corners that cannot be flown
CHUNK = 200_000  # readings looked up at a time


@dataclass(frozen=True)
class Wanted:
    """What a way is to be.

    Attributes
    ----------
    limit_m : float
        1-sigma up to which nothing better is looked for.
    longest_m : float
        No way is longer.
    settle_m : float
        From so far on the 1-sigma counts.
    """

    limit_m: float
    longest_m: float
    settle_m: float


@dataclass(frozen=True)
class Way:
    """The best way over a lattice: points (n, 2) in the plane [m], none where there is no way.

    `labels` were followed; `coarse`: by a search that compares less carefully, the first having had too many.
    """

    points_m: FloatArray
    top_m: float
    labels: int
    coarse: bool


@dataclass(frozen=True)
class Lattice:
    """Nodes and edges between the ends of a plane.

    Attributes
    ----------
    plane : Plane
    sensing : Sensing
    walls : Walls
    radius_m : float
        Of a turn.
    margin_m : float
        Kept from the walls.
    longest_m : float
        Ways that are longer are left out.
    """

    plane: Plane
    sensing: Sensing
    walls: Walls
    radius_m: float
    margin_m: float
    longest_m: float

    @cached_property
    def steps(self) -> int:
        """Edges of the straight way."""
        length, room = self.plane.length_m, self.longest_m / self.plane.length_m
        ellipse = 0.25 * math.pi * room * math.sqrt(max(room * room - 1.0, 1e-4))  # in lengths squared
        finest = max(LEAST_SIDE_RADII * self.radius_m, 2.0 * self.sensing.chart.cell_m)
        return max(2, min(STEPS, int(length / finest), int(math.sqrt(MOST_NODES / ellipse))))

    @property
    def side_m(self) -> float:
        """Distance of neighbours."""
        return self.plane.length_m / self.steps

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Nodes along and across; both counts beyond the ends are even on either side."""
        behind, across = self._room
        return self.steps + 1 + 2 * behind, 1 + 2 * across

    @property
    def _room(self) -> tuple[int, int]:
        """Nodes behind each end, and to each side of the geodesic."""
        over = self.longest_m - self.plane.length_m
        wide = 0.5 * math.sqrt(max(self.longest_m**2 - self.plane.length_m**2, 0.0))
        return math.ceil(0.5 * over / self.side_m) + 1, math.ceil(wide / self.side_m) + 1

    @property
    def ends(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row and column of start and end."""
        behind, across = self._room
        return np.array([behind, across]), np.array([behind + self.steps, across])

    def points_m(self, nodes: NDArray[np.int64]) -> FloatArray:
        """(n, 2) of rows and columns (n, 2)."""
        return np.asarray((nodes - self.ends[0]) * self.side_m + self.plane.ends_m[0])

    @cached_property
    def turns(self) -> NDArray[np.bool_]:
        """(headings, headings): whether the arc of a corner takes at most half of both edges."""
        unit = MOVES / np.hypot(*MOVES.T)[:, None]
        between = np.arccos(np.clip(unit @ unit.T, -1.0, 1.0))
        half = 0.5 * self.side_m * np.hypot(*MOVES.T)
        taken = self.radius_m * np.tan(np.minimum(0.5 * between, 0.49 * math.pi))
        short = np.minimum(half[:, None], half[None, :])
        return np.asarray((taken <= short * (1.0 + 1e-9)) & (between < 2.0), dtype=np.bool_)

    @property
    def pieces(self) -> NDArray[np.int64]:
        """(headings,) pieces of an edge."""
        return np.asarray(np.maximum(np.round(PIECES * np.hypot(*MOVES.T)), 1.0).astype(np.int64))

    @cached_property
    def edges(self) -> FloatArray:
        """(headings / 2, rows, cols, most pieces, 6) information of each piece, NaN first where an edge is barred."""
        out = np.full((len(_HALF), *self.shape, self.pieces.max(), 6), np.nan)
        rows, cols = np.indices(self.shape)
        nodes = np.stack([rows.ravel(), cols.ravel()], axis=1)
        start, end = self.plane.ends_m
        for k, move in enumerate(MOVES[: len(_HALF)]):
            last = nodes + move
            inside = ((last >= 0) & (last < self.shape)).all(axis=1)
            ends = self.points_m(nodes[inside]), self.points_m(last[inside])
            length = self.side_m * math.hypot(*move)
            detour = [np.hypot(*(a - start).T) + length + np.hypot(*(b - end).T) for a, b in (ends, ends[::-1])]
            near = np.minimum(*detour) <= self.longest_m * (1.0 + 1e-9)
            chosen = np.flatnonzero(inside)[near]
            both = np.concatenate([ends[0][near], ends[1][near]], axis=1)
            free = self.walls.hit(both, self.margin_m) < 0
            chosen = chosen[free]
            told = self._told(both[free], length, int(self.pieces[k]))
            out[k, nodes[chosen, 0], nodes[chosen, 1], : self.pieces[k]] = told
        return out

    def _told(self, ends: FloatArray, length: float, pieces: int) -> FloatArray:
        """(edges, pieces, 6) information of edges (edges, 4), all of one length."""
        sensing, chart = self.sensing, self.sensing.chart
        wanted = length / sensing.spacing_m
        n = pieces * max(1, math.ceil(min(wanted, READINGS_A_CELL * length / chart.cell_m) / pieces))
        keep = math.exp(-length / n / chart.error_length_m)
        out = np.empty((len(ends), pieces, 6))
        part = (np.arange(n) + 0.5) / n
        for some in np.array_split(np.arange(len(ends)), max(1, len(ends) * n // CHUNK)):
            if not some.size:
                continue
            lat, lon = self.plane.to_earth(ends[some].reshape(-1, 2, 2))
            at = [(axis[:, :1] + (axis[:, 1:] - axis[:, :1]) * part).ravel() for axis in (lat, lon)]
            readings = sensing.readings(at[0], at[1], wanted / n)
            barred = np.any(self._lacking(at[0], at[1], readings).reshape(-1, n), axis=1)
            found = np.empty((some.size * pieces, 6))
            edge_information(readings.reshape(-1, n // pieces, 3), chart.sigma, keep, found)
            out[some] = np.where(np.reshape(barred, (-1, 1, 1)), np.nan, found.reshape(-1, pieces, 6))
        return out

    def _lacking(self, lat: FloatArray, lon: FloatArray, readings: FloatArray) -> NDArray[np.bool_]:
        """Where a vehicle must not be; and takes away the readings that are out of the altimeter's range."""
        chart, heights = self.sensing.chart, self.sensing.heights
        ground = chart.sample(lat, lon)
        barred = np.asarray(np.isnan(ground))
        if heights is not None:
            barred |= ground + heights.clearance_m > heights.ceiling_m
            if math.isfinite(heights.range_m):
                readings[~(self.sensing.cone.sample(lat, lon) - ground <= heights.range_m), 2] = 0.0
        return barred

    def best(self, wanted: Wanted) -> Way:
        """The way with the least length of those within the limit, else with the least largest 1-sigma."""
        patch = self.sensing.model.size - 1
        lengths = self.side_m * np.hypot(*MOVES.T)
        steps = [self.sensing.moved(length) for length in (lengths / self.pieces).tolist()]
        phis, qs = (np.ascontiguousarray([step[i][:patch, :patch] for step in steps]) for i in (0, 1))
        numbers = (wanted.limit_m, wanted.longest_m * (1.0 + 1e-9), wanted.settle_m, self.side_m)
        start = np.ascontiguousarray(self.sensing.start[:patch, :patch])
        followed, coarse = 0, False
        for slack, deep, most in CARE:
            ended, path, _, top, taken = search(
                MOVES, lengths, self.pieces, self.turns, self.edges, phis, qs, *self.ends, start, numbers,
                slack, most, deep,
            )  # fmt: skip
            followed += int(taken)
            if ended != FULL:
                break
            coarse = True
        return Way(self.points_m(path), top, followed, coarse)

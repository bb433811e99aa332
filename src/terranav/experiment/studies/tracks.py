"""Tracks over real terrain, drawn by a seed and chosen by what the map alone says, before anything is run.

A candidate starts anywhere on the map, in any direction, flies at 40 to 90 m/s for 400 s, straight or (every other one)
in a steady turn of up to 90 degrees in all, and reads the terrain every 2 s. It is taken when

1. within REACH_SIGMAS initial sigmas of the INS, and its drift, about the track the map has no edge and no void;
2. the terrain is rough: the root mean square of its slope along the track is at least LEAST_SLOPE;
3. it is informative: the Cramer-Rao bound comes down to CONVERGED_SHARE of the initial sigma, per axis, within the
   first half of the track, and stays below it. That is 25 m, a quarter of a usual cell: the bound takes the map for a
   plane over the error, and where it is none, no estimator reaches the bound.

The figures count from where the bound is that low, but from SETTLED_READINGS readings on at the earliest.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS
from terranav.core.recording import Recording
from terranav.experiment.studies.sources import MapSource
from terranav.filters.marginalized import Marginalized
from terranav.maps.map import Map
from terranav.planning.bound import Bound, bound

FloatArray = NDArray[np.float64]

INS = InsGrade(position_sigma_m=500.0, velocity_sigma_mps=0.5, position_walk_m_per_sqrt_s=1.0)
SENSOR_SIGMA_M = 3.0
DURATION_S, INTERVAL_S = 400.0, 2.0
SPEED_MPS = (40.0, 90.0)
LARGEST_TURN_DEG = 90.0

REACH_SIGMAS = 3.5
LEAST_SLOPE = 0.05
CONVERGED_SHARE = 0.05
SETTLED_READINGS = 50
CANDIDATES = 2000  # drawn on each map


@dataclass(frozen=True)
class World:
    """What makes the readings; by default everything is as told.

    Attributes
    ----------
    blur_cells : float
        As in `Marginalized` [cells].
    bias_sigma : float or None
        1-sigma of the bias drawn [unit]; None is the kind's own.
    bias : float
        A constant added to every reading [unit].
    noise_factor : float
        The white noise is so many times what is told.
    gross_share, gross_size : float
        With this probability a reading is off by +- this much besides [1], [unit].
    walk_factor : float
        The random walk of the INS is so many times what is told.
    """

    blur_cells: float = Marginalized.blur_cells
    bias_sigma: float | None = None
    bias: float = 0.0
    noise_factor: float = 1.0
    gross_share: float = 0.0
    gross_size: float = 0.0
    walk_factor: float = 1.0


MATCHED = World()


@dataclass(frozen=True)
class Leg:
    """Where a vehicle truly goes: a straight line, or a steady turn.

    Attributes
    ----------
    lat_deg, lon_deg : float
        Start.
    heading_deg, turn_deg : float
        Course at the start, and by how much it has turned at the end.
    speed_mps, duration_s, interval_s : float
        A reading every `interval_s`.
    """

    lat_deg: float
    lon_deg: float
    heading_deg: float
    turn_deg: float
    speed_mps: float
    duration_s: float = DURATION_S
    interval_s: float = INTERVAL_S

    @property
    def time_s(self) -> FloatArray:
        """(n,) times of the readings [s]."""
        return np.arange(int(self.duration_s / self.interval_s) + 1, dtype=np.float64) * self.interval_s

    def positions_deg(self) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude (n,) at these times [deg]."""
        start, turned = math.radians(self.heading_deg), math.radians(self.turn_deg)
        part = self.time_s / self.duration_s
        length = self.speed_mps * self.duration_s
        if turned == 0.0:
            north, east = length * part * math.cos(start), length * part * math.sin(start)
        else:
            radius, course = length / turned, start + turned * part
            north = radius * (np.sin(course) - math.sin(start))
            east = radius * (math.cos(start) - np.cos(course))
        return shift(self.lat_deg, self.lon_deg, north, east)


@dataclass(frozen=True)
class Track:
    """A leg over a map, as a picklable description.

    Attributes
    ----------
    name : str
    source : MapSource
    leg : Leg
    kind : str
        'terrain', or another kind as which the same field is taken (its values in that kind's unit).
    """

    name: str
    source: MapSource
    leg: Leg
    kind: str = "terrain"

    @property
    def chart(self) -> Map:
        """Its map."""
        return _chart(self.source, self.kind)

    def facts(self) -> dict[str, Any]:
        """What its figures depend on."""
        return {"name": self.name, "kind": self.kind, "map": self.source.facts(), "leg": vars(self.leg)}

    def true_recording(self) -> Recording:
        """The track with its position true, and what a perfect sensor would read."""
        lat, lon = self.leg.positions_deg()
        values = KINDS[self.kind].sign * self.chart.sample(lat, lon)
        n = len(lat)
        columns = {
            "time_s": self.leg.time_s, "lat_deg": lat, "lon_deg": lon, "alt_m": np.zeros(n),
            "true_lat_deg": lat, "true_lon_deg": lon, "true_alt_m": np.zeros(n), KINDS[self.kind].column: values,
        }  # fmt: skip
        return Recording(columns, ins=INS, sigma={KINDS[self.kind].column: SENSOR_SIGMA_M}, name=self.name)


@lru_cache(maxsize=8)
def _chart(source: MapSource, kind: str) -> Map:
    """The map of a source; as another kind it is the same relief, sunk below the datum where it is to be a seabed."""
    chart = source.open()
    if kind == chart.kind:
        return chart
    values = chart.values - np.nanmax(chart.values) - 100.0
    return replace(chart, kind=kind, unit=KINDS[kind].unit, values=values)


@dataclass(frozen=True)
class Drawn:
    """The tracks of one map, and how many candidates it took."""

    tracks: tuple[Track, ...]
    candidates: int


def drawn_tracks(source: MapSource, count: int, seed: int) -> Drawn:
    """The first `count` candidates on a map that meet the criteria in the head of this module."""
    chart = source.open()
    rng = np.random.default_rng(SeedSequence([seed, int(chart.checksum[:8], 16)]))
    clear = Clear(chart)
    found: list[Track] = []
    for tried in range(1, CANDIDATES + 1):
        track = Track(f"{source.name}-{len(found) + 1:02d}", source, _candidate(chart, rng))
        if clear.around(track.leg) and _rough(track) and settled_index(track_bound(track)) is not None:
            found.append(track)
            if len(found) == count:
                return Drawn(tuple(found), tried)
    return Drawn(tuple(found), CANDIDATES)


@lru_cache(maxsize=16)
def track_bound(track: Track) -> Bound:
    """The Cramer-Rao bound along a track, where everything is as told: normal noise, no outliers."""
    return bound(track.true_recording(), [track.chart], INS, outlier_share=0.0, blur_cells=MATCHED.blur_cells)


def settled_index(lowest: Bound) -> int | None:
    """The first epoch that counts; None where the bound is not low enough from the middle to the end."""
    per_axis = lowest.drms_m / math.sqrt(2.0)
    high = np.flatnonzero(per_axis > CONVERGED_SHARE * INS.position_sigma_m)
    first = int(high[-1]) + 1 if high.size else 0
    return max(first, SETTLED_READINGS) if first <= len(lowest) // 2 else None


def _candidate(chart: Map, rng: Generator) -> Leg:
    """Any leg that starts on the map."""
    south, west, north, east = chart.bounds_deg
    place, course, straight, turn, speed = rng.random(2), rng.random(), rng.random(), rng.random(), rng.random()
    return Leg(
        south + float(place[0]) * (north - south),
        west + float(place[1]) * (east - west),
        360.0 * course,
        0.0 if straight < 0.5 else LARGEST_TURN_DEG * (2.0 * turn - 1.0),
        SPEED_MPS[0] + speed * (SPEED_MPS[1] - SPEED_MPS[0]),
    )


def _rough(track: Track) -> bool:
    """Criterion 2."""
    north, east = track.chart.gradient(*track.leg.positions_deg())
    return bool(np.sqrt(np.mean(north**2 + east**2)) >= LEAST_SLOPE)


class Clear:
    """Criterion 1, for many legs over one map: counts voids in windows by sums over all cells above and left."""

    def __init__(self, chart: Map) -> None:
        self.chart = chart
        self.sums = np.zeros((chart.shape[0] + 1, chart.shape[1] + 1))
        np.cumsum(np.cumsum(np.isnan(chart.values), axis=0), axis=1, out=self.sums[1:, 1:])

    def around(self, leg: Leg) -> bool:
        """Whether the map is whole about a leg."""
        reach = REACH_SIGMAS * (INS.position_sigma_m + INS.velocity_sigma_mps * leg.duration_s)
        lat, lon = leg.positions_deg()
        windows = list(self._windows(lat, lon, reach))
        low, high = (np.array([window[side] for window in windows]) for side in (0, 1))
        if low.min() < 0.0 or (high >= self.chart.shape).any():
            return False
        (r0, c0), (r1, c1) = low.T, high.T + 1
        return bool((self.sums[r1, c1] - self.sums[r0, c1] - self.sums[r1, c0] + self.sums[r0, c0] == 0.0).all())

    def _windows(self, lat: FloatArray, lon: FloatArray, reach: float) -> Iterator[tuple[list[int], list[int]]]:
        """First and last (row, column) of the square of half side `reach` about each position."""
        offset = reach * np.array([-1.0, 1.0])
        north, east = (axis.ravel() for axis in np.meshgrid(offset, offset))
        rows, cols = self.chart.cells(*shift(lat[:, None], lon[:, None], north, east))
        if not (np.isfinite(rows).all() and np.isfinite(cols).all()):
            yield [-1, -1], [-1, -1]
            return
        corners = np.stack([np.stack([rows.min(1), cols.min(1)], 1), np.stack([rows.max(1), cols.max(1)], 1)], 1)
        whole = np.stack([np.floor(corners[:, 0]), np.ceil(corners[:, 1])], axis=1).astype(int)
        yield from ((low, high) for low, high in whole.tolist())

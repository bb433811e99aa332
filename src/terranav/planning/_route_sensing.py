"""What the readings along a line over a map say, and the heights that it is flown at."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS
from terranav.core.recording import Recording
from terranav.core.records import Epoch, Prior
from terranav.filters.marginalized import Marginalized
from terranav.ins.error_state import ErrorModel
from terranav.kernels.routing import along, coned
from terranav.maps.map import Map
from terranav.planning.bound import bound, mixture_information, patch_slope

FloatArray = NDArray[np.float64]

READINGS_A_CELL = 8.0  # of a faster sensor; as many fewer readings, each better by the root of their number
MOST_READINGS = 20_000  # of a route
CHESS = math.cos(math.pi / 8.0)  # a way over eight neighbours is at most so much shorter as the crow flies
HEIGHTED = ("terrain", "bathymetry")


@dataclass(frozen=True)
class Heights:
    """How high above the ground a vehicle goes.

    Attributes
    ----------
    clearance_m : float
        Least height above ground.
    climb_deg : float
        Steepest climb and descent.
    ceiling_m : float
        Largest altitude, in the map's datum; infinite for none.
    range_m : float
        The altimeter reads nothing above this height; infinite for none.
    """

    clearance_m: float
    climb_deg: float
    ceiling_m: float = math.inf
    range_m: float = math.inf

    @property
    def rise(self) -> float:
        """Climb in metres a metre."""
        return math.tan(math.radians(self.climb_deg))


@dataclass(frozen=True)
class Sensing:
    """A sensor over a map on a vehicle with an INS: the covariance along lines.

    Attributes
    ----------
    chart : Map
    ins : InsGrade
        Its position sigma is that at the start.
    sigma : float
        1-sigma of a reading [unit].
    rate_hz, speed_mps : float
    heights : Heights or None
        None where height does not matter.
    """

    chart: Map
    ins: InsGrade
    sigma: float
    rate_hz: float
    speed_mps: float
    heights: Heights | None

    def thinned(self, longest_m: float) -> Sensing:
        """With no more readings than tell something new, and no more than MOST_READINGS on the longest way."""
        most = min(READINGS_A_CELL / self.chart.cell_m, MOST_READINGS / longest_m)
        kept = min(self.rate_hz, most * self.speed_mps)
        return replace(self, rate_hz=kept, sigma=self.sigma * math.sqrt(kept / self.rate_hz))

    @property
    def spacing_m(self) -> float:
        """Way from one reading to the next."""
        return self.speed_mps / self.rate_hz

    @cached_property
    def model(self) -> ErrorModel:
        """The states of `planning.bound` for such a flight."""
        first = Epoch(0.0, *self.chart.centre_deg, 0.0)
        return ErrorModel(self.ins, (self.chart,), ErrorModel.level_for(self.ins, first))

    @cached_property
    def start(self) -> FloatArray:
        """(d, d) covariance at the start."""
        return self.model.initial_covariance(Prior.from_ins(self.ins).cov_m2)

    def moved(self, way_m: float) -> tuple[FloatArray, FloatArray]:
        """Transition and noise (d, d) over a way."""
        lat, lon = self.chart.centre_deg
        there = [float(value) for value in shift(lat, lon, way_m, 0.0)]
        step = self.model.transition(Epoch(0.0, lat, lon, 0.0), Epoch(way_m / self.speed_mps, there[0], there[1], 0.0))
        return step.phi, step.q

    @cached_property
    def _step(self) -> tuple[FloatArray, FloatArray]:
        return self.moved(self.spacing_m)

    def readings(self, lat_deg: FloatArray, lon_deg: FloatArray, worth: float = 1.0) -> FloatArray:
        """(n, 3) slopes and information of `worth` readings at each of positions (n,); 0 where the map says nothing."""
        chart = self.chart
        slopes, known = patch_slope(chart, lat_deg, lon_deg), np.isfinite(chart.sample(lat_deg, lon_deg))
        white = self.sigma**2 + (Marginalized.blur_cells * chart.cell_m) ** 2 * np.sum(slopes**2, axis=1)
        reach = Marginalized.outlier_scale * math.hypot(self.sigma, chart.sigma) / np.sqrt(white)
        at = np.geomspace(reach.min(), reach.max() * (1.0 + 1e-9), 24)
        kept = [mixture_information(Marginalized.outlier_share, float(f"{value:.3g}")) for value in at]
        return np.column_stack([slopes, np.where(known, worth * np.interp(reach, at, kept) / white, 0.0)])

    def sigmas(self, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
        """(n,) largest 1-sigma [m] after each of evenly spaced readings (`spacing_m`): quick, as `bound` has it."""
        told = self.readings(lat_deg, lon_deg)
        if self.heights is not None and math.isfinite(self.heights.range_m):
            told[~self.in_range(lat_deg, lon_deg), 2] = 0.0
        out = np.empty((lat_deg.size, 3))
        along(told, *self._step, self.model.bias_index(self.chart.kind), self.start, out)
        return longest_axis(out[:, 0], out[:, 1], out[:, 2])

    def bound(self, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
        """(n, 2, 2) covariance [m^2] by `planning.bound`, where it matters."""
        return bound(self.recording(lat_deg, lon_deg), self.chart, self.ins).cov_m2

    def recording(self, lat_deg: FloatArray, lon_deg: FloatArray) -> Recording:
        """A flight of evenly spaced readings with its position true, and what a perfect sensor would read."""
        kind, n = KINDS[self.chart.kind], lat_deg.size
        values = kind.sign * self.chart.sample(lat_deg, lon_deg)
        altitude = np.zeros(n)
        if self.heights is not None:
            altitude = self.altitudes(lat_deg, lon_deg)[0]
            values = np.where(self.in_range(lat_deg, lon_deg), values, np.nan)
        columns = {
            "time_s": np.arange(n) / self.rate_hz, "lat_deg": lat_deg, "lon_deg": lon_deg, "alt_m": altitude,
            "true_lat_deg": lat_deg, "true_lon_deg": lon_deg, "true_alt_m": altitude, kind.column: values,
        }  # fmt: skip
        return Recording(columns, self.ins, {kind.column: self.sigma}, {}, "route")

    def altitudes(self, lat_deg: FloatArray, lon_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) lowest flyable altitude and the ground below evenly spaced positions [m].

        The ground is looked at every half cell between them; over a void it is taken straight across.
        """
        assert self.heights is not None
        between = max(1, math.ceil(2.0 * self.spacing_m / self.chart.cell_m))
        fine = np.arange((lat_deg.size - 1) * between + 1) / between
        whole = np.arange(lat_deg.size)
        lon = np.unwrap(lon_deg, period=360.0)
        ground = self.chart.sample(np.interp(fine, whole, lat_deg), np.interp(fine, whole, lon))
        known = np.isfinite(ground)
        filled = np.interp(fine, fine[known], ground[known]) if known.any() else np.zeros(fine.size)
        high = lowest_profile(filled + self.heights.clearance_m, self.spacing_m / between * self.heights.rise)
        return high[::between], filled[::between]

    def in_range(self, lat_deg: FloatArray, lon_deg: FloatArray) -> NDArray[np.bool_]:
        """(n,) whether the altimeter reads the ground from the lowest flyable altitude."""
        if self.heights is None or not math.isfinite(self.heights.range_m):
            return np.ones(lat_deg.size, dtype=bool)
        high, ground = self.altitudes(lat_deg, lon_deg)
        return high - ground <= self.heights.range_m

    @cached_property
    def cone(self) -> Map:
        """The lowest altitude that a vehicle may have over each cell whatever way it goes: a bound on `altitudes`."""
        assert self.heights is not None
        chart = self.chart
        rows, cols = chart.shape
        frame = chart.local_frame(*chart.centre_deg, radius_m=0.25 * chart.cell_m * max(rows, cols))
        cell = np.linalg.inv(np.array([[frame.row[1], frame.row[2]], [frame.col[1], frame.col[2]]]))
        values = np.where(np.isnan(chart.values), -np.inf, chart.values.astype(np.float64)) + self.heights.clearance_m
        coned(values, float(np.hypot(*cell[:, 0])), float(np.hypot(*cell[:, 1])), CHESS * self.heights.rise)
        return replace(chart, values=values.astype(np.float32))


def lowest_profile(least: FloatArray, rise: float) -> FloatArray:
    """The lowest heights (n,) that are at least `least` and change by at most `rise` from one to the next."""
    way = rise * np.arange(least.size)
    up = np.maximum.accumulate((least - way)[::-1])[::-1] + way  # climbs in time for what comes
    down = np.maximum.accumulate(least + way) - way
    return np.asarray(np.maximum(up, down))


def longest_axis(north: FloatArray, both: FloatArray, east: FloatArray) -> FloatArray:
    """1-sigma along the longest axis of 2 x 2 covariances."""
    return np.asarray(np.sqrt(0.5 * (north + east + np.hypot(north - east, 2.0 * both))))

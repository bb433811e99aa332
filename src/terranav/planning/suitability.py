"""Where on a map a fix is possible: what a straight leg over each place, on each heading, would make of the position.

For every block of cells and every heading, a leg of one length is flown that ends (or starts) there. It begins with the
prior of an INS grade; its readings and drift are those of `terranav.planning.bound`, the same states, recursion and
information of a reading, so a figure here is the Cramer-Rao bound of that leg and no estimator does better:

- the INS: `terranav.ins.error_state` at the level 'position' or 'schuler', process noise and all;
- the map error: a state that changes along the track with covariance sigma^2 exp(-distance / correlation length), so
  that readings over the same wrong ground count once. Roughly, of n readings d apart n d / (d + 2 length) count against
  the map error; the state does that without the rule;
- the common bias (barometer, tide) and its walk, outliers and blur as in the filter `marginalized`.

The bound is that of small errors: it does not know of the other valley that looks the same. `self_similarity` does.

What is approximate: a leg ends within half a block of its place, its length is a whole number of steps of one block
(root 2 of that on the diagonal), readings stand evenly on a step and carry the information of rate x time whatever
their number, at most a few a cell; north and east are those of the middle latitude of the map, and no vehicle turns, so
that tilt and accelerometer bias are one state. All windows of a line share their work (`terranav.kernels.suitability`),
so the time is linear in the cells of the map whatever the leg's length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import shift
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Prior
from terranav.filters.marginalized import Marginalized
from terranav.ins.error_state import ErrorModel
from terranav.kernels.suitability import windows
from terranav.maps.map import Map
from terranav.planning._terrain_statistics import BlockGrid, statistics
from terranav.planning.bound import mixture_information, patch_slope

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

MOST_STEPS = 20_000  # of one leg
TRUSTED_CELLS = 0.25
CHUNK = 200_000  # readings looked up at a time


@dataclass(frozen=True)
class LegSettings:
    """The sensor, the vehicle and the legs.

    Attributes
    ----------
    sensor_sigma : float
        1-sigma of a reading [unit of the map], > 0.
    rate_hz : float
        Readings a second, > 0.
    speed_mps : float
        Ground speed, > 0.
    distance_m : float
        Length of a leg, > 0.
    headings : int
        How many, evenly around from north, 1 to 72.
    block : int
        Side of a block [cells], >= 1.
    anchor : 'end' or 'start'
        Whether a leg ends or starts at its place.
    readings_a_cell : int
        Of a faster sensor so many are followed, 1 to 100, each worth several; fewer are quicker and tell too little.

    Raises
    ------
    ConfigError
        For a value out of its range.
    """

    sensor_sigma: float = 5.0
    rate_hz: float = 1.0
    speed_mps: float = 60.0
    distance_m: float = 10_000.0
    headings: int = 8
    block: int = 4
    anchor: str = "end"
    readings_a_cell: int = 4

    def __post_init__(self) -> None:
        for name in ("sensor_sigma", "rate_hz", "speed_mps", "distance_m"):
            finite(f"suitability {name}", getattr(self, name), above=0.0)
        for name, most in (("headings", 72), ("block", 1000), ("readings_a_cell", 100)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
                raise ConfigError(f"suitability {name} is {value!r}, expected a whole number from 1 to {most}")
        if self.anchor not in ("end", "start"):
            raise ConfigError(f"suitability anchor is {self.anchor!r}, expected 'end' or 'start'")


@dataclass(frozen=True, eq=False)
class Suitability:
    """North-up grids over a map: rows run from north to south, columns from west to east.

    Attributes
    ----------
    lat_deg : (rows,), lon_deg : (cols,) [deg]
        Of the middle of each block; evenly spaced.
    block_m : float
        Side of a block [m].
    headings_deg : (headings,) [deg]
    sigma_m : (headings, rows, cols) float32 [m]
        1-sigma along the longest axis of the position error; NaN where the map does not hold the whole leg.
    drms_m : (headings, rows, cols) float32 [m]
    roughness : (rows, cols) float32 [unit/m]
        Root mean square slope of the ground around.
    spread : (rows, cols) float32 [unit]
        Standard deviation of the heights around.
    correlation_m : (rows, cols) float32 [m]
        Of the ground around: 2 spread / roughness, the length L of a field with covariance std^2 exp(-(r/L)^2).
    entropy_bits : (rows, cols) float32
        Of the heights around, in bins as wide as a reading's error with the map's.
    self_similarity : (rows, cols) float32
        How alike the most alike other place within two sigma of the prior is, 1 the same
        (`kernels.suitability.likeness`).
    settings : LegSettings
    ins : InsGrade
    """

    lat_deg: FloatArray
    lon_deg: FloatArray
    block_m: float
    headings_deg: FloatArray
    sigma_m: Float32Array
    drms_m: Float32Array
    roughness: Float32Array
    spread: Float32Array
    correlation_m: Float32Array
    entropy_bits: Float32Array
    self_similarity: Float32Array
    settings: LegSettings
    ins: InsGrade

    @property
    def trusted_m(self) -> float:
        """A quarter of a cell [m]: the bound takes the ground for a plane over the error, which it is not beyond."""
        return TRUSTED_CELLS * self.block_m / self.settings.block

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """As `Map.transform`, of the grids in longitude and latitude [deg]."""
        south, east = float(self.lat_deg[0] - self.lat_deg[1]), float(self.lon_deg[1] - self.lon_deg[0])
        west_edge, north_edge = float(self.lon_deg[0]) - 0.5 * east, float(self.lat_deg[0]) + 0.5 * south
        return east, 0.0, west_edge, 0.0, -south, north_edge

    @property
    def worst_m(self) -> FloatArray:
        """(rows, cols) largest `sigma_m` of the headings that the map allows, NaN without one."""
        high = np.where(np.isnan(self.sigma_m), -np.inf, self.sigma_m).max(axis=0)
        return np.where(np.isfinite(high), high, np.nan).astype(np.float64)

    @property
    def best_m(self) -> FloatArray:
        """(rows, cols) smallest `sigma_m`, NaN without one."""
        low = np.where(np.isnan(self.sigma_m), np.inf, self.sigma_m).min(axis=0)
        return np.where(np.isfinite(low), low, np.nan).astype(np.float64)

    @property
    def median_m(self) -> FloatArray:
        """(rows, cols) median of `sigma_m` over the headings that the map allows, NaN without one."""
        ranked, known = np.sort(self.sigma_m, axis=0), np.isfinite(self.sigma_m).sum(axis=0)  # NaN sorts last
        low, high = np.maximum((known - 1) // 2, 0)[None], np.maximum(known // 2, 0)[None]
        high = np.minimum(high, len(ranked) - 1)
        pair = np.take_along_axis(ranked, low, 0)[0] + np.take_along_axis(ranked, high, 0)[0]
        return np.where(known > 0, 0.5 * pair, np.nan).astype(np.float64)

    @property
    def best_heading_deg(self) -> FloatArray:
        """(rows, cols) heading of the smallest `sigma_m` [deg], NaN without one."""
        chosen = np.where(np.isnan(self.sigma_m), np.inf, self.sigma_m).argmin(axis=0)
        return np.where(np.isnan(self.best_m), np.nan, self.headings_deg[chosen])

    def at(self, lat_deg: float, lon_deg: float, heading_deg: float) -> float:
        """1-sigma of a leg at a place on a heading [m], between blocks and headings; NaN off the blocks or without one.

        The logarithm of `sigma_m` is interpolated linearly, over those of the nearest four blocks and two headings that
        are known.
        """
        row = (self.lat_deg[0] - lat_deg) / (self.lat_deg[0] - self.lat_deg[1])
        east = (lon_deg - self.lon_deg[0] + 180.0) % 360.0 - 180.0
        place = row, east / (self.lon_deg[1] - self.lon_deg[0]), heading_deg * self.headings_deg.size / 360.0
        count, rows, cols = self.sigma_m.shape
        if not (-0.5 <= place[0] <= rows - 0.5 and -0.5 <= place[1] <= cols - 0.5):
            return math.nan
        first = [math.floor(axis) for axis in place]
        found = weight = 0.0
        for step in product((0, 1), repeat=3):
            i, k, turn = (low + more for low, more in zip(first, step, strict=True))
            part = math.prod(1.0 - abs(axis - one) for axis, one in zip(place, (i, k, turn), strict=True))
            sigma = float(self.sigma_m[turn % count, min(max(i, 0), rows - 1), min(max(k, 0), cols - 1)])
            if sigma > 0.0:  # NaN is not
                found, weight = found + part * math.log(sigma), weight + part
        return math.exp(found / weight) if weight > 1e-9 else math.nan

    def share_within(self, limit_m: float) -> dict[str, float]:
        """Of the blocks with a leg, the share whose best, median and worst heading stays within a limit [m]."""
        known = np.isfinite(self.best_m)
        if not known.any():
            return {"best": math.nan, "median": math.nan, "worst": math.nan}
        grids = {"best": self.best_m, "median": self.median_m, "worst": self.worst_m}
        return {name: float((grid[known] <= limit_m).mean()) for name, grid in grids.items()}


def suitability(chart: Map, ins: InsGrade | None = None, settings: LegSettings | None = None) -> Suitability:
    """Statistics of a map, and the expected position 1-sigma after a leg at each block and heading.

    Parameters
    ----------
    chart : Map
    ins : InsGrade, optional
        Its initial position sigma is the prior of every leg.
    settings : LegSettings, optional

    Returns
    -------
    Suitability

    Raises
    ------
    ConfigError
        For a leg of too many steps, or too many blocks.
    DataError
        For a map of fewer than two blocks on a side.
    """
    settings, ins = settings or LegSettings(), ins or InsGrade()
    grid = BlockGrid.over(chart, settings.block)
    headings = 360.0 * np.arange(settings.headings) / settings.headings
    model = ErrorModel(ins, (chart,), ErrorModel.level_for(ins, Epoch(0.0, *chart.centre_deg, 0.0)))
    sigma, drms = np.empty((2, headings.size, *grid.shape), dtype=np.float32)
    for k, heading in enumerate(headings):
        sigma[k], drms[k] = _heading(chart, model, grid, settings, math.radians(heading))
    ground = statistics(chart, grid, settings.sensor_sigma, ins.position_sigma_m)
    lat, lon = grid.lat_deg(np.arange(grid.shape[0])), grid.lon_deg(np.arange(grid.shape[1]))
    return Suitability(lat, lon, grid.side_m, headings, sigma, drms, *ground, settings=settings, ins=ins)


@dataclass(frozen=True)
class _Lines:
    """Parallel lines over a grid in flight order: one block along an axis a step, `slant` across it.

    Every block lies on exactly one line: line c has at step u the block round(c + slant u) across.
    """

    by_row: bool
    forward: bool  # whether the index along grows in flight
    slant: float
    along: int
    across: int
    numbers: NDArray[np.intp] = field(repr=False)

    @classmethod
    def of(cls, shape: tuple[int, int], heading: float) -> _Lines:
        down, right = -math.cos(heading), math.sin(heading)
        by_row = abs(down) >= abs(right) * (1.0 - 1e-12)
        main, side = (down, right) if by_row else (right, down)
        along, across = shape if by_row else shape[::-1]
        slant = side / abs(main)
        drift = slant * (along - 1)
        low, high = math.floor(min(0.0, -drift)) - 1, math.ceil(max(0.0, -drift)) + across + 1
        return cls(by_row, main > 0.0, slant, along, across, np.arange(low, high))

    def place(self, step: FloatArray, line: FloatArray | np.float64) -> tuple[FloatArray, FloatArray]:
        """Row and column of places along and on lines."""
        along = step if self.forward else self.along - 1 - step
        across = line + self.slant * step
        return (along + 0.0 * across, across) if self.by_row else (across, along + 0.0 * across)


def _heading(
    chart: Map, model: ErrorModel, grid: BlockGrid, settings: LegSettings, heading: float
) -> tuple[Float32Array, Float32Array]:
    """Largest 1-sigma and DRMS (rows, cols) of one heading [m]."""
    lines = _Lines.of(grid.shape, heading)
    step_m = grid.side_m * math.hypot(1.0, lines.slant)
    step_s = step_m / settings.speed_mps
    window = max(1, round(settings.distance_m / step_m))
    if window > MOST_STEPS:
        raise ConfigError(
            f"suitability distance_m is {settings.distance_m:g}, {window} steps of {step_m:.0f} m, "
            f"expected at most {MOST_STEPS} steps"
        )
    wanted = settings.rate_hz * step_s
    subs = max(1, min(round(wanted), math.ceil(settings.readings_a_cell * step_m / chart.cell_m)))
    scaled = _scaled(model, chart, step_s / subs, step_m / subs)
    cov = np.full((3, *grid.shape), np.nan)
    out = np.empty((lines.along - 1, 3))
    chunk = max(1, CHUNK // (lines.along * subs))
    for first in range(0, lines.numbers.size, chunk):
        numbers = lines.numbers[first : first + chunk]
        readings = _readings(chart, grid, lines, numbers, (subs, wanted / subs, settings.sensor_sigma))
        for number, reading in zip(numbers, readings, strict=True):
            windows(reading, window, *scaled, out)
            steps = np.flatnonzero(np.isfinite(out[:, 0]))
            at = (steps + (1 if settings.anchor == "end" else 1 - window)).astype(np.float64)
            row, col = (np.floor(axis + 0.5).astype(np.intp) for axis in lines.place(at, np.float64(number)))
            inside = (row >= 0) & (row < grid.shape[0]) & (col >= 0) & (col < grid.shape[1])
            cov[:, row[inside], col[inside]] = out[steps[inside]].T
    trace = cov[0] + cov[2]
    longest = 0.5 * (trace + np.hypot(cov[0] - cov[2], 2.0 * cov[1]))
    return np.sqrt(longest).astype(np.float32), np.sqrt(trace).astype(np.float32)


def _scaled(
    model: ErrorModel, chart: Map, dt_s: float, travelled_m: float
) -> tuple[FloatArray, FloatArray, FloatArray, int, FloatArray]:
    """Transition, noise, unit of each state, index of the bias and covariance at the start, each state in its sigma."""
    lat, lon = chart.centre_deg
    there = [float(value) for value in shift(lat, lon, travelled_m, 0.0)]
    passed = model.transition(Epoch(0.0, lat, lon, 0.0), Epoch(dt_s, there[0], there[1], 0.0))
    cov = model.initial_covariance(Prior.from_ins(model.ins).cov_m2)
    unit = np.sqrt(np.diagonal(cov))
    unit = np.where(unit > 0.0, unit, 1.0)
    both = np.outer(unit, unit)
    phi = passed.phi * unit[None, :] / unit[:, None]
    return phi, passed.q / both, unit, model.bias_index(chart.kind), cov / both


def _readings(
    chart: Map, grid: BlockGrid, lines: _Lines, numbers: NDArray[np.intp], reading: tuple[int, float, float]
) -> FloatArray:
    """(lines, steps, subs, 3) slopes and information, NaN off the map.

    `reading`: how many there are a step, how many of the sensor's each of them stands for, and its sigma.
    """
    subs, worth, sensor_sigma = reading
    step = (np.arange((lines.along - 1) * subs) + 1.0) / subs
    row, col = lines.place(step[None, :], numbers[:, None].astype(np.float64))
    near = (row > -1.0) & (row < grid.shape[0]) & (col > -1.0) & (col < grid.shape[1])
    found = np.full((*row.shape, 3), np.nan)
    lat, lon = grid.lat_deg(row[near]), grid.lon_deg(col[near])
    if lat.size:
        slopes, known = patch_slope(chart, lat, lon), np.isfinite(chart.sample(lat, lon))
        white = sensor_sigma**2 + (Marginalized.blur_cells * chart.cell_m) ** 2 * np.sum(slopes**2, axis=1)
        reach = Marginalized.outlier_scale * math.hypot(sensor_sigma, chart.sigma) / np.sqrt(white)
        at = np.geomspace(reach.min(), reach.max() * (1.0 + 1e-9), 24)
        kept = [mixture_information(Marginalized.outlier_share, float(f"{value:.3g}")) for value in at]
        information = worth * np.interp(reach, at, kept) / white
        found[near] = np.where(known[:, None], np.column_stack([slopes, information]), np.nan)
    return found.reshape(len(numbers), lines.along - 1, subs, 3)

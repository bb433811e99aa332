"""Point-mass filter: Bayes' rule on a grid of INS errors that follows the density in extent and cell size.

Bergman, Recursive Bayesian Estimation (Linkoping 1999), chapter 5; papers/002 eqs. 7-11 as numbered there. The grid
lies in error space, so the vehicle's motion moves nothing; only the growth of the INS error diffuses the density.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.errors import StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m
from terranav.core.memory import need
from terranav.core.records import Epoch, Estimate, Measurement, Posterior, Prior
from terranav.filters._maps import one_map_a_kind
from terranav.kernels.density import border, diffused, measured
from terranav.kernels.grid import regrid
from terranav.kernels.pointmass import advance
from terranav.kernels.rows import half_taps
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma

FloatArray = NDArray[np.float64]

CELL_BYTES = 40  # that a step takes at its most
TAIL = 1e-7  # mass near the grid's border that makes the grid grow
REACH = 5.5  # a Gaussian is carried out to this many sigmas
RESOLVE = 0.6  # 1-sigma of a likelihood ridge that a grid carries to 0.2 % [cells]
WIDTH_REFINE, WIDTH_WANTED, WIDTH_COARSEN = 1.3, 2.5, 6.0  # local width of the density [cells]
STILL = (0.0, 0.0)  # no growth


@dataclass(frozen=True, slots=True)
class Grid:
    """A density over INS errors: cell (i, j) is centred at (south_m + i * cell_m, west_m + j * cell_m)."""

    south_m: float
    west_m: float
    cell_m: float
    density: FloatArray

    @property
    def north_m(self) -> FloatArray:
        """(rows,) errors north [m]."""
        return self.south_m + self.cell_m * np.arange(self.density.shape[0], dtype=np.float64)

    @property
    def east_m(self) -> FloatArray:
        """(cols,) errors east [m]."""
        return self.west_m + self.cell_m * np.arange(self.density.shape[1], dtype=np.float64)


class Summary(NamedTuple):
    """What a density is like (`kernels.density.summary`)."""

    mean_n: float
    mean_e: float
    var_n: float
    cov: float
    var_e: float
    width: float  # of its narrowest structure that carries weight [cells]
    south: int  # the rows and columns, both ends included, beyond which less than the tail lies
    north: int
    west: int
    east: int


@dataclass(frozen=True, slots=True)
class Update:
    """What one reading made of a grid."""

    grid: Grid
    known: float  # share of the prior density on the map
    nis: float
    resolved_m: float  # cells up to this size carry the likelihood
    summary: Summary | None = None  # of the grid, where it came with the update


@dataclass(frozen=True, slots=True)
class PointMassState:
    """Density and its moments after an epoch."""

    grid: Grid
    mean_m: FloatArray
    cov_m2: FloatArray
    judgement: Judgement
    start_s: float = math.nan
    epoch: Epoch | None = None
    last_reading: Epoch | None = None


@dataclass(frozen=True)
class PointMass:
    """Point-mass filter of the two horizontal INS position errors.

    Attributes
    ----------
    maps : tuple of Map
        One a kind; a reading is compared with the map of its kind, several kinds multiply their likelihoods.
    ins : InsGrade
        How fast the position error grows (`InsGrade.position_growth_m2`).
    outlier_share : float
        Probability that a reading is an outlier, in [0, 1).
    outlier_scale : float
        How many times noisier an outlier is, > 1.
    min_cell_m : float or None
        Finest cell [m]; a posterior narrower than it is not resolved, and would be claimed too narrow. None is 1 m, or
        1/20 of the map's cell where that is less.
    max_cells : int
        Most cells of the grid; where the density would need more, the cell grows and the likelihood is widened to
        what the cells can carry, so that a narrow peak between them is not missed.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, or two maps of one kind.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    outlier_share: float = 0.02
    outlier_scale: float = 10.0
    min_cell_m: float | None = None
    max_cells: int = 160_000
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        finite("pointmass outlier_share", self.outlier_share, minimum=0.0, maximum=0.5)
        finite("pointmass outlier_scale", self.outlier_scale, above=1.0)
        finite("pointmass max_cells", self.max_cells, minimum=400)
        for key in ("min_cell_m", "converged_sigma_m"):
            if getattr(self, key) is not None:
                finite(f"pointmass {key}", getattr(self, key), above=0.0)
        one_map_a_kind("pointmass", self.maps)

    def init(self, prior: Prior, rng: Generator) -> PointMassState:
        """The prior density on a grid that reaches 5.5 sigma (or the uniform prior's edge)."""
        sigma = np.sqrt(np.diag(prior.cov_m2))
        reach = (REACH if prior.shape == "gaussian" else 3.0) * sigma
        cell = max(self._coarsest_m, math.sqrt(4.0 * float(reach.prod()) / (0.9 * self.max_cells)))
        cell = min(cell, max(float(sigma.min()) / WIDTH_WANTED, self._finest_m))
        cell = max(cell, math.sqrt(4.0 * float(reach.prod()) / (0.9 * self.max_cells)))
        half = np.maximum(np.ceil(reach / cell), 3).astype(int)
        rows, cols = (2 * half + 1).tolist()
        need(CELL_BYTES * rows * cols, f"pointmass: grid of {rows} x {cols} cells for max_cells = {self.max_cells:g}")
        south, west = prior.mean_m - half * cell
        north = south + cell * np.arange(2 * half[0] + 1) - prior.mean_m[0]
        east = west + cell * np.arange(2 * half[1] + 1) - prior.mean_m[1]
        if prior.shape == "gaussian":
            a, b, c = np.linalg.inv(prior.cov_m2)[[0, 0, 1], [0, 1, 1]]
            n, e = north[:, None], east[None, :]
            density = np.exp(-0.5 * (a * n * n + 2.0 * b * n * e + c * e * e))
        else:
            density = np.ones((north.size, east.size))
        grid = Grid(float(south), float(west), cell, density / density.sum())
        return PointMassState(grid, *moments(summary_of(grid), cell), Judgement())

    def step(self, state: PointMassState, epoch: Epoch, rng: Generator) -> PointMassState:
        """Diffuse by the INS's growth since the last epoch, multiply by the likelihoods, refit the grid if need be."""
        start_s = epoch.time_s if state.epoch is None else state.start_s
        grid, growth = self._ready(state.grid, self._growth(state, epoch))
        summary: Summary | None = None
        nis: list[float] = []
        known = -1.0
        resolved_m = math.inf
        for reading in epoch.measurements:
            for chart in self.maps:
                if chart.kind == reading.kind:
                    update = self._updated(grid, growth, epoch, chart, reading, last_reading=state.last_reading)
                    grid, growth, summary = update.grid, STILL, update.summary
                    known, resolved_m = max(known, update.known), min(resolved_m, update.resolved_m)
                    if update.known > 0.5:
                        nis.append(update.nis)
        if summary is None:
            grid, summary = _diffused(grid, growth)
        fitted = self._fitted(grid, summary, resolved_m)
        if fitted is not grid:
            grid, summary = fitted, summary_of(fitted)
        mean_m, cov_m2 = moments(summary, grid.cell_m)
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(cov_m2),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=known <= 0.5 if known >= 0.0 else None,
        )
        last_reading = epoch if known >= 0.0 else state.last_reading
        return PointMassState(grid, mean_m, cov_m2, judgement, start_s, epoch, last_reading)

    def estimate(self, state: PointMassState) -> Estimate:
        """Mean and covariance of the density."""
        if state.epoch is None:
            raise StateError("pointmass: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    def posterior(self, state: PointMassState) -> Posterior:
        """The density itself."""
        return Posterior(state.grid.north_m, state.grid.east_m, state.grid.density)

    @cached_property
    def _coarsest_m(self) -> float:
        return 0.5 * min(chart.cell_m for chart in self.maps)

    @property
    def _finest_m(self) -> float:
        return min(1.0, 0.1 * self._coarsest_m) if self.min_cell_m is None else self.min_cell_m

    @cached_property
    def _judge(self) -> Judge:
        threshold = 2.0 * self._coarsest_m if self.converged_sigma_m is None else self.converged_sigma_m
        return Judge(converged_sigma_m=threshold)

    def _growth(self, state: PointMassState, epoch: Epoch) -> tuple[float, float]:
        """Variance that the INS error of the two axes has gained since the last epoch [m^2]."""
        if state.epoch is None:
            before, dt = 0.0, 0.0
        else:
            before, dt = state.epoch.time_s - state.start_s, epoch.time_s - state.epoch.time_s
        north, east = float(state.cov_m2[0, 0]), float(state.cov_m2[1, 1])
        gained = self.ins.position_growth_m2
        return gained(before, dt, north), gained(before, dt, east)

    def _ready(self, grid: Grid, growth_m2: tuple[float, float]) -> tuple[Grid, tuple[float, float]]:
        """A grid with room to diffuse, and by how much; after a long gap in stages, each on cells twice as large."""
        while max(growth_m2) > 0.0:
            most = (3.0 * grid.cell_m) ** 2 if max(growth_m2) > (6.0 * grid.cell_m) ** 2 else math.inf
            part = min(growth_m2[0], most), min(growth_m2[1], most)
            grid = _padded(grid, _reach(max(part) / grid.cell_m**2))
            growth_m2 = growth_m2[0] - part[0], growth_m2[1] - part[1]
            if max(growth_m2) <= 0.0:
                return grid, part
            grid, summary = _diffused(grid, part)
            grid = self._regridded(grid, 2.0 * grid.cell_m, summary)
        return grid, STILL

    def _grown(self, grid: Grid, growth_m2: tuple[float, float]) -> Grid:
        """Diffuse by `growth_m2` (north, east)."""
        grid, growth_m2 = self._ready(grid, growth_m2)
        return grid if growth_m2 == STILL else _diffused(grid, growth_m2)[0]

    def _updated(
        self,
        grid: Grid,
        growth_m2: tuple[float, float],
        epoch: Epoch,
        chart: Map,
        reading: Measurement,
        *,
        last_reading: Epoch | None,
    ) -> Update:
        """Diffuse and weigh by one reading; where the likelihood is narrower than the cells, on a finer grid."""
        sigma = reading_sigma(reading, chart, last_reading, epoch)
        if type(self)._weighed is PointMass._weighed:
            update = self._advanced(grid, growth_m2, epoch, chart, reading, sigma=sigma)
        else:  # a likelihood of another kind
            grid, growth_m2 = _diffused(grid, growth_m2)[0], STILL
            update = self._weighed(grid, epoch, chart, reading, sigma)
        if grid.cell_m > 1.1 * update.resolved_m:
            coarse, summary = _diffused(grid, growth_m2)
            if self._possible_m(update.resolved_m, summary, grid.cell_m) < 0.9 * grid.cell_m:
                fine = self._regridded(coarse, update.resolved_m, summary)
                update = self._weighed(fine, epoch, chart, reading, sigma)
        return update

    def _weighed(self, grid: Grid, epoch: Epoch, chart: Map, reading: Measurement, sigma: float) -> Update:
        """Weigh the grid as it is."""
        return self._advanced(grid, STILL, epoch, chart, reading, sigma=sigma)

    def _advanced(
        self,
        grid: Grid,
        growth_m2: tuple[float, float],
        epoch: Epoch,
        chart: Map,
        reading: Measurement,
        *,
        sigma: float,
    ) -> Update:
        """Diffuse and weigh in one pass."""
        density, cell, south, west = grid.density, grid.cell_m, grid.south_m, grid.west_m
        high, wide = (0.5 * cell * (side - 1) for side in density.shape)
        radius = math.hypot(abs(south + high) + high, abs(west + wide) + wide)
        land = chart.around(epoch.lat_deg, epoch.lon_deg, radius)
        frame = land.local_frame(epoch.lat_deg, epoch.lon_deg, radius)
        out = np.empty_like(density)
        found = advance(
            density,
            growth_m2[0] / (cell * cell),
            growth_m2[1] / (cell * cell),
            (south, west, cell),
            land.values,
            (frame.row, frame.col),
            (reading.value, sigma, RESOLVE, self.outlier_share, self.outlier_scale),
            out,
        )
        known, nis, slope = found[:3]
        resolved = cell * sigma / (RESOLVE * slope) if slope > 0.0 else math.inf
        return Update(Grid(south, west, cell, out), known, nis, resolved, Summary._make(found[3:]))

    def _fitted(self, grid: Grid, summary: Summary, resolved_m: float) -> Grid:
        """The same density on a grid that fits it; the grid itself when it already does."""
        cells, narrow = grid.density.size, summary.width
        need = (summary.north - summary.south + 1) * (summary.east - summary.west + 1)
        roomy = 6 * need < cells and cells > 2500
        refine = narrow < WIDTH_REFINE and grid.cell_m > 1.01 * self._allowed_m(summary, grid.cell_m)
        coarsen = narrow > WIDTH_COARSEN and grid.cell_m < 0.6 * min(self._coarsest_m, resolved_m)
        if not (roomy or refine or coarsen or cells > 1.5 * self.max_cells):
            return grid
        wanted = grid.cell_m * narrow / WIDTH_WANTED if refine or coarsen else grid.cell_m
        return self._regridded(grid, min(wanted, 0.9 * resolved_m, max(self._coarsest_m, grid.cell_m)), summary)

    def _allowed_m(self, summary: Summary, cell_m: float) -> float:
        """The finest cell that the support of the density, with its margin, may have under max_cells."""
        high = (1.4 * (summary.north - summary.south + 1) + 8) * cell_m
        wide = (1.4 * (summary.east - summary.west + 1) + 8) * cell_m
        return max(self._finest_m, math.sqrt(high * wide / self.max_cells))

    def _possible_m(self, wanted_m: float, summary: Summary, cell_m: float) -> float:
        """The cell of the density once it is resampled."""
        return max(wanted_m, self._allowed_m(summary, cell_m))

    def _regridded(self, grid: Grid, wanted_m: float, summary: Summary) -> Grid:
        """Resample the density to cells of about `wanted_m` over its support and a margin of a fifth on each side."""
        cell = self._possible_m(wanted_m, summary, grid.cell_m)
        axes = []
        for low, high, origin in (
            (summary.south, summary.north, grid.south_m),
            (summary.west, summary.east, grid.west_m),
        ):
            centre = origin + 0.5 * (low + high) * grid.cell_m
            half = math.ceil((0.7 * (high - low + 1) + 1.0) * grid.cell_m / cell) + 2
            axes.append(centre + cell * np.arange(-half, half + 1))
        density = np.empty((axes[0].size, axes[1].size))
        rows, cols = (axes[0] - grid.south_m) / grid.cell_m, (axes[1] - grid.west_m) / grid.cell_m
        regrid(grid.density, rows, cols, density)
        return Grid(float(axes[0][0]), float(axes[1][0]), cell, density)


def gaussian_taps(variance: float) -> FloatArray:
    """Symmetric taps that sum to one and have exactly this variance [cells^2], up to their sampling error of 1e-4."""
    half = half_taps(float(variance))
    return np.concatenate([half[:0:-1], half])


def moments(summary: Summary, cell_m: float) -> tuple[FloatArray, FloatArray]:
    """Mean (2,) and covariance (2, 2) of a density; one in a single cell is not certainty."""
    floor = (0.05 * cell_m) ** 2
    mean = np.array([summary.mean_n, summary.mean_e])
    return mean, np.array([[summary.var_n + floor, summary.cov], [summary.cov, summary.var_e + floor]])


def _reach(variance: float) -> int:
    """How far the taps of a variance reach [cells]."""
    return 1 if variance <= 0.5 else math.ceil(5.0 * math.sqrt(variance))


def summary_of(grid: Grid) -> Summary:
    """What the density of a grid is like."""
    return Summary(*measured(grid.density, (grid.south_m, grid.west_m, grid.cell_m)))


def _diffused(grid: Grid, growth_m2: tuple[float, float]) -> tuple[Grid, Summary]:
    """The density convolved with a Gaussian, and what it is like."""
    if growth_m2 == STILL:
        return grid, summary_of(grid)
    out, cell = np.empty_like(grid.density), grid.cell_m
    summary = diffused(
        grid.density, growth_m2[0] / cell**2, growth_m2[1] / cell**2, (grid.south_m, grid.west_m, cell), out
    )
    return Grid(grid.south_m, grid.west_m, cell, out), Summary(*summary)


def _padded(grid: Grid, radius: int) -> Grid:
    """Add a margin on every side whose border band, as wide as the taps reach, holds more than the tail."""
    rows, cols = grid.density.shape
    band = min(radius + 2, rows, cols)
    sides = border(grid.density, band)
    if max(sides) <= TAIL:
        return grid
    high, wide = max(band, rows // 8), max(band, cols // 8)
    room = [size if mass > TAIL else 0 for mass, size in zip(sides, (high, high, wide, wide), strict=True)]
    density = np.zeros((rows + room[0] + room[1], cols + room[2] + room[3]))
    density[room[0] : room[0] + rows, room[2] : room[2] + cols] = grid.density
    return Grid(grid.south_m - room[0] * grid.cell_m, grid.west_m - room[2] * grid.cell_m, grid.cell_m, density)

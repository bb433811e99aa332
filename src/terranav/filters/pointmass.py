"""Point-mass filter: Bayes' rule on a grid of INS errors that follows the density in extent and cell size.

Bergman, Recursive Bayesian Estimation (Linkoping 1999), chapter 5; papers/002 eqs. 7-11 as numbered there. The grid
lies in error space, so the vehicle's motion moves nothing; only the growth of the INS error diffuses the density.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.errors import StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m
from terranav.core.records import Epoch, Estimate, Measurement, Posterior, Prior
from terranav.filters._maps import one_map_a_kind
from terranav.kernels.grid import FLOOR, diffuse, measure, resample, weigh
from terranav.kernels.lattice import bilinear_lattice
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma

FloatArray = NDArray[np.float64]

TAIL = 1e-7  # density beyond the grid's border that is given up
REACH = 5.5  # a Gaussian is carried out to this many sigmas
RESOLVE = 0.6  # 1-sigma of a likelihood ridge that a grid carries to 0.2 % [cells]
WIDTH_REFINE, WIDTH_WANTED, WIDTH_COARSEN = 1.3, 2.5, 6.0  # local width of the density [cells]


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


@dataclass(frozen=True, slots=True)
class Update:
    """What one reading made of a grid."""

    grid: Grid
    known: float  # share of the prior density on the map
    nis: float
    resolved_m: float  # cells up to this size carry the likelihood


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
        return _measured(PointMassState(grid, np.zeros(2), np.zeros((2, 2)), Judgement()))[0]

    def step(self, state: PointMassState, epoch: Epoch, rng: Generator) -> PointMassState:
        """Diffuse by the INS's growth since the last epoch, multiply by the likelihoods, refit the grid if need be."""
        start_s = epoch.time_s if state.epoch is None else state.start_s
        dt = 0.0 if state.epoch is None else epoch.time_s - state.epoch.time_s
        before = epoch.time_s - dt - start_s
        growth = [self.ins.position_growth_m2(before, dt, float(v)) for v in np.diag(state.cov_m2)]
        state = replace(state, epoch=epoch, start_s=start_s, grid=self._grown(state.grid, growth))
        nis: list[float] = []
        known: list[float] = []
        resolved_m = math.inf
        for reading in epoch.measurements:
            for chart in self.maps:
                if chart.kind == reading.kind:
                    update = self._updated(state, epoch, chart, reading)
                    state = replace(state, grid=update.grid)
                    known.append(update.known)
                    resolved_m = min(resolved_m, update.resolved_m)
                    if update.known > 0.5:
                        nis.append(update.nis)
        state, rows, cols, width = _measured(state)
        if known:
            state = replace(state, last_reading=epoch)
        grid = self._fitted(state.grid, (rows, cols), float(width.min()), resolved_m)
        if grid is not state.grid:
            state = _measured(replace(state, grid=grid))[0]
        judgement = judge(
            self._judge,
            state.judgement,
            largest_sigma_m(state.cov_m2),
            nis=sum(nis) / len(nis) if nis else math.nan,
            readings=len(nis),
            off_map=max(known) <= 0.5 if known else None,
        )
        return replace(state, judgement=judgement)

    def estimate(self, state: PointMassState) -> Estimate:
        """Mean and covariance of the density."""
        if state.epoch is None:
            raise StateError("pointmass: no estimate before the first epoch")
        judgement = state.judgement
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, judgement.status, judgement.nis)

    def posterior(self, state: PointMassState) -> Posterior:
        """The density itself."""
        return Posterior(state.grid.north_m, state.grid.east_m, state.grid.density)

    @property
    def _coarsest_m(self) -> float:
        return 0.5 * min(chart.cell_m for chart in self.maps)

    @property
    def _finest_m(self) -> float:
        return min(1.0, 0.1 * self._coarsest_m) if self.min_cell_m is None else self.min_cell_m

    @property
    def _judge(self) -> Judge:
        threshold = 2.0 * self._coarsest_m if self.converged_sigma_m is None else self.converged_sigma_m
        return Judge(converged_sigma_m=threshold)

    def _grown(self, grid: Grid, growth_m2: list[float]) -> Grid:
        """Diffuse by `growth_m2` (north, east); after a long gap in stages, each on cells twice as large."""
        while max(growth_m2) > 0.0:
            most = (3.0 * grid.cell_m) ** 2 if max(growth_m2) > (6.0 * grid.cell_m) ** 2 else math.inf
            parts = [min(growth, most) for growth in growth_m2]
            taps = [gaussian_taps(part / grid.cell_m**2) for part in parts]
            padded = _padded(grid, max(taps[0].size, taps[1].size) // 2)
            out = np.empty_like(padded.density)
            diffuse(padded.density, taps[0], taps[1], out)
            grid = replace(padded, density=out / out.sum())
            growth_m2 = [growth - part for growth, part in zip(growth_m2, parts, strict=True)]
            if max(growth_m2) > 0.0:
                grid = self._regridded(grid, 2.0 * grid.cell_m)
        return grid

    def _updated(self, state: PointMassState, epoch: Epoch, chart: Map, reading: Measurement) -> Update:
        """Weigh the grid by one reading; where the likelihood is narrower than the cells, on a finer grid."""
        sigma = reading_sigma(reading, chart, state.last_reading, epoch)
        update = self._weighed(state.grid, epoch, chart, reading, sigma)
        if state.grid.cell_m > 1.1 * update.resolved_m:
            grid = self._regridded(state.grid, update.resolved_m)
            if grid.cell_m < 0.9 * state.grid.cell_m:
                update = self._weighed(grid, epoch, chart, reading, sigma)
        return update

    def _weighed(self, grid: Grid, epoch: Epoch, chart: Map, reading: Measurement, sigma: float) -> Update:
        """Weigh the grid as it is."""
        north, east = grid.north_m, grid.east_m
        radius = math.hypot(float(np.abs(north).max()), float(np.abs(east).max()))
        frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg, radius)
        field = np.empty_like(grid.density)
        bilinear_lattice(chart.values, frame.row, frame.col, -north, -east, field)
        out = np.empty_like(grid.density)
        known, nis, slope = weigh(
            grid.density, field, reading.value, sigma, RESOLVE, self.outlier_share, self.outlier_scale, out
        )
        resolved = grid.cell_m * sigma / (RESOLVE * slope) if slope > 0.0 else math.inf
        return Update(replace(grid, density=out), known, nis, resolved)

    def _fitted(self, grid: Grid, marginals: tuple[FloatArray, FloatArray], narrow: float, resolved_m: float) -> Grid:
        """The same density on a grid that fits it; the grid itself when it already does."""
        used = (_support(marginals[0]), _support(marginals[1]))
        need = (used[0][1] - used[0][0] + 1) * (used[1][1] - used[1][0] + 1)
        roomy = 6 * need < grid.density.size and grid.density.size > 2500
        refine = narrow < WIDTH_REFINE and grid.cell_m > 1.01 * self._allowed_m(used, grid.cell_m)
        coarsen = narrow > WIDTH_COARSEN and grid.cell_m < 0.6 * min(self._coarsest_m, resolved_m)
        if not (roomy or refine or coarsen or grid.density.size > 1.5 * self.max_cells):
            return grid
        wanted = grid.cell_m * narrow / WIDTH_WANTED if refine or coarsen else grid.cell_m
        return self._regridded(grid, min(wanted, 0.9 * resolved_m, max(self._coarsest_m, grid.cell_m)))

    def _allowed_m(self, used: tuple[tuple[int, int], tuple[int, int]], cell_m: float) -> float:
        """The finest cell that the support of the density, with its margin, may have under max_cells."""
        sides = [(1.4 * (high - low + 1) + 8) * cell_m for low, high in used]
        return max(self._finest_m, math.sqrt(sides[0] * sides[1] / self.max_cells))

    def _regridded(self, grid: Grid, wanted_m: float) -> Grid:
        """Resample the density to cells of about `wanted_m` over its support and a margin of a fifth on each side."""
        used = (_support(grid.density.sum(axis=1)), _support(grid.density.sum(axis=0)))
        cell = max(wanted_m, self._allowed_m(used, grid.cell_m))
        axes = []
        for (low, high), origin in zip(used, (grid.south_m, grid.west_m), strict=True):
            centre = origin + 0.5 * (low + high) * grid.cell_m
            half = math.ceil((0.7 * (high - low + 1) + 1.0) * grid.cell_m / cell) + 2
            axes.append(centre + cell * np.arange(-half, half + 1))
        density = np.empty((axes[0].size, axes[1].size))
        rows, cols = (axes[0] - grid.south_m) / grid.cell_m, (axes[1] - grid.west_m) / grid.cell_m
        resample(np.log(np.maximum(grid.density, FLOOR)), rows, cols, density)
        return Grid(float(axes[0][0]), float(axes[1][0]), cell, density / density.sum())


def gaussian_taps(variance: float) -> FloatArray:
    """Symmetric taps that sum to one and have exactly this variance [cells^2].

    Below half a squared cell three taps do it exactly (q/2, 1 - q, q/2), however small the growth of one step; above, a
    sampled Gaussian out to 5 sigma, whose own sampling error is below 1e-4 of the variance there.
    """
    if variance <= 0.5:
        return np.array([0.5 * variance, 1.0 - variance, 0.5 * variance])
    radius = max(3, math.ceil(5.0 * math.sqrt(variance)))
    steps = np.arange(-radius, radius + 1)
    taps = np.exp(-0.5 * steps**2 / variance)
    return np.asarray(taps / taps.sum())


def _measured(state: PointMassState) -> tuple[PointMassState, FloatArray, FloatArray, FloatArray]:
    """The state with the moments of its density, the density's marginals and its local width [cells]."""
    grid = state.grid
    moments, rows, cols, width = measure(grid.density, grid.north_m, grid.east_m)
    cov = np.array([[moments[2], moments[3]], [moments[3], moments[4]]])
    floor = (0.05 * grid.cell_m) ** 2  # a density in a single cell is not certainty
    cov[0, 0] += floor
    cov[1, 1] += floor
    return replace(state, mean_m=moments[:2].copy(), cov_m2=cov), rows, cols, width


def _support(mass: FloatArray) -> tuple[int, int]:
    """First and last index between which all but TAIL of the mass lies on either side."""
    cumulative = np.cumsum(mass) / mass.sum()
    low = int(np.searchsorted(cumulative, TAIL, side="right"))
    high = int(np.searchsorted(cumulative, 1.0 - TAIL, side="left"))
    return min(low, mass.size - 1), min(max(high, low), mass.size - 1)


def _padded(grid: Grid, radius: int) -> Grid:
    """Add a margin on every side whose border band, as wide as the taps reach, holds more than the tail."""
    rows, cols = grid.density.sum(axis=1), grid.density.sum(axis=0)
    band = min(radius + 2, rows.size, cols.size)
    sides = [rows[:band].sum(), rows[-band:].sum(), cols[:band].sum(), cols[-band:].sum()]
    room = [max(band, side // 8) if mass > TAIL else 0 for mass, side in zip(sides, [rows.size] * 2 + [cols.size] * 2)]
    if not any(room):
        return grid
    density = np.pad(grid.density, ((room[0], room[1]), (room[2], room[3])))
    return Grid(grid.south_m - room[0] * grid.cell_m, grid.west_m - room[2] * grid.cell_m, grid.cell_m, density)

"""Bayes grid: candidate cells of equal height, and Bayes' rule over a window that moves with the vehicle (papers/001).

The paper's algorithm (its section 5, steps 3 and 4; Bayes' rule is its eq. 5, the Gaussian its eq. 6), for a reading y:

    C = {cells c of the window: |h(c) - y| <= b}                  candidates, b = 1 m, the radar altimeter's 1-sigma
    L(s) = sum over c in C of N(c; s, P),  P = 25 I m^2           likelihood of the cell s
    p(s) <- p(s) L(s) / sum p L                                   prior times likelihood, normalised at each reading
    the estimate is the cell where p is largest                   (or the mean of p)

The paper moves its window with the vehicle's known displacement. Here the window is a grid of INS errors: the cell of
error x stands for the place 'indicated position less x', which moves over the map by that same displacement while the
grid lies still. The two are the same sums; a still grid needs no shift by fractions of a cell. Between two epochs the
prior is diffused by the growth of the INS error, the process noise of the paper's eq. 7; with an INS that does not
drift it is carried over unchanged, which is what the paper's step 4 prints. Extent and cells of the grid follow the
density as in `pointmass`.

What the paper leaves open is settled so that the covariance means something:
- sum over C is divided by the same sum over all cells that have a height. So flat ground teaches nothing, and neither
  the window's border nor a void attracts.
- P by default is (sigma / slope)^2 I, slope being the rms slope of the map under the density. On the paper's terrain
  (20 m x 0.01 rad/m = 0.2) with its radar (1 m) that is the paper's 25 m^2.
- A share of the readings says nothing (outliers), so that the truth outside the band is not excluded for good.
- When the candidates hold next to none of the prior, the band is doubled up to WIDEST times; beyond that the reading is
  not used. Either way its NIS tells the status, as in every other method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.errors import ConfigError, StateError
from terranav.core.records import Epoch, Estimate, Measurement
from terranav.filters.pointmass import RESOLVE, Grid, PointMass, PointMassState, Update, gaussian_taps
from terranav.kernels.candidates import compared
from terranav.kernels.grid import diffuse
from terranav.kernels.lattice import bilinear_lattice
from terranav.kernels.sampling import bicubic
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

WIDEST = 8.0  # times the band
FEW = 1e-3  # share of the prior on the candidates below which there are none
BROADEST = 30.0  # 1-sigma of the likelihood's Gaussian at most [cells]


@dataclass(frozen=True)
class BayesGrid(PointMass):
    """Candidate cells and Bayes' rule on a grid of the two horizontal INS position errors.

    Attributes
    ----------
    maps, ins, outlier_share, outlier_scale, max_cells, converged_sigma_m
        As in `PointMass`; `outlier_share` is the share of the readings that say nothing.
    min_cell_m : float or None
        Finest cell [m]; None is 1/20 of the map's.
    max_cell_m : float or None
        Cell of the grid where it is not refined; None is half the map's. Equal to `min_cell_m`, the cells never change.
    band : float or None
        Half-width of the height band of the candidates [the kind's unit]; None is `band_sigmas` of the reading. The
        paper's is 1 m.
    band_sigmas : float
        See `band`.
    likelihood_var_m2 : float or None
        P of the likelihood, variance per axis [m^2]; the paper's is 25. None is (sigma / slope)^2.
    interpolation : 'bilinear' or 'bicubic'
        Of the map between its cells; 'bicubic' (Catmull-Rom) is the cubic spline that the paper recommends.
    point : 'mean' or 'peak'
        What is estimated: the mean of the density, or the cell where it is largest as in the paper, with the covariance
        about it.

    Raises
    ------
    ConfigError
        For a setting out of its range, or two maps of one kind.
    """

    max_cell_m: float | None = None
    band: float | None = None
    band_sigmas: float = 2.0
    likelihood_var_m2: float | None = None
    interpolation: Literal["bilinear", "bicubic"] = "bilinear"
    point: Literal["mean", "peak"] = "mean"

    def __post_init__(self) -> None:
        for key in ("min_cell_m", "max_cell_m", "band", "likelihood_var_m2", "converged_sigma_m"):
            if getattr(self, key) is not None:
                finite(f"bayes_grid {key}", getattr(self, key), above=0.0)
        finite("bayes_grid band_sigmas", self.band_sigmas, above=0.0)
        for key, known in (("interpolation", ("bilinear", "bicubic")), ("point", ("mean", "peak"))):
            if getattr(self, key) not in known:
                raise ConfigError(f"bayes_grid {key} is {getattr(self, key)!r}, expected {known[0]!r} or {known[1]!r}")
        super().__post_init__()
        if self._finest_m > self._coarsest_m:
            raise ConfigError(
                f"bayes_grid max_cell_m is {self._coarsest_m:g}, expected at least min_cell_m {self._finest_m:g}"
            )

    def estimate(self, state: PointMassState) -> Estimate:
        """Mean or peak of the density, with the covariance about it."""
        if state.epoch is None:
            raise StateError("bayes_grid: no estimate before the first epoch")
        judgement = state.judgement
        error, cov = state.mean_m, state.cov_m2
        if self.point == "peak":
            error = peak(state.grid)
            cov = cov + np.outer(error - state.mean_m, error - state.mean_m)
        return Estimate.at(state.epoch, error, cov, judgement.status, judgement.nis)

    @property
    def _coarsest_m(self) -> float:
        return 0.5 * min(chart.cell_m for chart in self.maps) if self.max_cell_m is None else self.max_cell_m

    @property
    def _finest_m(self) -> float:
        return 0.05 * min(chart.cell_m for chart in self.maps) if self.min_cell_m is None else self.min_cell_m

    def _weighed(self, grid: Grid, epoch: Epoch, chart: Map, reading: Measurement, sigma: float) -> Update:
        """Weigh the grid by the candidates of one reading."""
        prior, heights = grid.density, self._heights(grid, epoch, chart)
        known, first, second, steps2, sloped = compared(heights, prior, reading.value)
        if known <= 0.0:
            return Update(grid, 0.0, math.nan, math.inf)
        mean = first / known
        spread = max(second / known - mean**2, 0.0)
        nis = mean**2 / (sigma**2 + spread)
        change = (
            math.sqrt(steps2 / sloped) if sloped > 0.0 else 0.0
        )  # of the map from one cell to the next, rms per axis
        resolved = grid.cell_m * sigma / (RESOLVE * change) if change > 0.0 else math.inf
        away = np.abs(heights - reading.value)
        away[np.isnan(away)] = np.inf
        likelihood = self._likelihood(away, grid, sigma, change)
        if likelihood is None:
            return Update(grid, known, nis, resolved)
        return Update(replace(grid, density=_normalised(prior, likelihood)), known, nis, resolved)

    def _heights(self, grid: Grid, epoch: Epoch, chart: Map) -> FloatArray:
        """The map at the place of each cell, NaN where it says nothing."""
        north, east = grid.north_m, grid.east_m
        radius = math.hypot(float(np.abs(north).max()), float(np.abs(east).max()))
        land = chart.around(epoch.lat_deg, epoch.lon_deg, radius)
        frame = land.local_frame(epoch.lat_deg, epoch.lon_deg, radius)
        out = np.empty_like(grid.density)
        if self.interpolation == "bilinear":
            bilinear_lattice(land.values, frame.row, frame.col, -north, -east, out)
        else:
            row, col = np.broadcast_arrays(*frame.cells(-north[:, None], -east[None, :]))
            bicubic(land.values, row.ravel(), col.ravel(), out.reshape(-1))
        return out

    def _likelihood(self, away: FloatArray, grid: Grid, sigma: float, change: float) -> FloatArray | None:
        """L(s), NaN where nothing near has a height; None when no band within reason has candidates."""
        band = self.band_sigmas * sigma if self.band is None else self.band
        # a band thinner than the step of the heights from cell to cell would fall between them
        band = max(band, 0.5 * change)
        if self.likelihood_var_m2 is not None:
            variance = self.likelihood_var_m2 / grid.cell_m**2
        else:
            variance = (sigma / change) ** 2 if change > 0.0 else BROADEST**2
        taps = gaussian_taps(min(max(variance, RESOLVE**2), BROADEST**2))
        solid = _smooth(np.isfinite(away).astype(np.float64), taps)
        unknown = (solid <= 1e-12) | np.isinf(away)
        solid[unknown] = np.nan
        told = float(grid.density.sum(where=~unknown))
        for widened in (1.0, 2.0, 4.0, WIDEST):
            inside = _smooth((away <= widened * band).astype(np.float64), taps)
            likelihood = inside / solid
            average = float((grid.density * likelihood).sum(where=~unknown)) / told
            if average > FEW:
                return (1.0 - self.outlier_share) * likelihood + self.outlier_share * average
        return None


def peak(grid: Grid) -> FloatArray:
    """(2,) error of the cell where the density is largest; the mean of all such cells when they are several [m]."""
    rows, cols = np.nonzero(grid.density >= grid.density.max() * (1.0 - 1e-9))
    return np.array([grid.north_m[rows].mean(), grid.east_m[cols].mean()])


def _smooth(field: FloatArray, taps: FloatArray) -> FloatArray:
    """The field convolved with the taps along both axes."""
    out = np.empty_like(field)
    diffuse(field, taps, taps, out)
    return out


def _normalised(prior: FloatArray, likelihood: FloatArray) -> FloatArray:
    """Bayes' rule; cells without a likelihood get the average of the others."""
    there = np.isfinite(likelihood)
    posterior = prior * likelihood
    if not there.all():
        average = float(posterior[there].sum()) / float(prior[there].sum())
        posterior = np.where(there, posterior, average * prior)
    return np.asarray(posterior / posterior.sum())

"""Hybrid of several maps: a point-mass filter for each, their posteriors mixed by the weight of their kurtosis.

Papers/002, section 4 (two of its equations bear the number 11 and two the number 12; here they are told by their
place):

    C_e = 1/(l m) sum_ij (S_ij - S_mean)^4 / sigma_T^4                  its second eq. 11
    sigma_T = sqrt(1/(l m - 1) sum_ij (S_ij - S_mean)^2)                its eq. 12
    pdf = w_1 pdf_1 + ... + w_N pdf_N                                   eq. 13
    w_i = C_e,i / sum_k C_e,k                                           eq. 14

Under eq. 12 the paper calls S "the geophysical information", but everywhere else C_e is the kurtosis of the posterior
density, so S_ij is taken as the density in cell (i, j). That is the kurtosis of the *values* of the density, not of its
position: it has no axis and no radius. Over one area A that all maps share, a Gaussian posterior of covariance P has
C_e = A / (2 pi sqrt(det P)), so the weights go with the inverse area of the error ellipses. Over a grid that fits each
posterior A shrinks with it, and C_e no longer tells a sharp posterior from a broad one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.checks import unknown_name
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.judgement import Judge, Judgement, judge, largest_sigma_m
from terranav.core.records import Epoch, Estimate, Posterior, Prior
from terranav.filters._maps import one_map_a_kind
from terranav.filters.pointmass import Grid, PointMass, PointMassState
from terranav.kernels.grid import FLOOR, resample
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
Kurtosis = Literal["common", "own", "position"]

KURTOSES = ("common", "own", "position")
MIX_CELLS = 40_000  # most cells of a mixed density


@dataclass(frozen=True, slots=True)
class HybridState:
    """The filter of each map, and their mix."""

    parts: tuple[PointMassState, ...]
    weights: FloatArray
    mean_m: FloatArray
    cov_m2: FloatArray
    judgement: Judgement
    epoch: Epoch | None = None


@dataclass(frozen=True)
class Hybrid:
    """Point-mass filters of one map each, mixed by normalised kurtosis weights (papers/002 eqs. 11-14).

    A map counts once a reading was compared with it; until then all count alike. With one map it is `pointmass`.
    The rival is `pointmass` with the same maps: it multiplies their likelihoods.

    Attributes
    ----------
    maps : tuple of Map
        One a kind.
    ins : InsGrade
    kurtosis : str
        What is taken for the kurtosis of a posterior: 'common', of the values of the density over the area that holds
        the grids of all maps; 'own', the same over each filter's own grid; 'position', of the position under the
        density, fourth central moment over squared variance, mean of the axes north and east (3 for every Gaussian).
    feedback : bool
        Whether every filter goes on from the mixed density (eq. 13 as part of the recursion) rather than its own.
    outlier_share, outlier_scale, min_cell_m, max_cells, converged_sigma_m
        As in `terranav.filters.pointmass.PointMass`, of the filter of each map.

    Raises
    ------
    ConfigError
        For a setting out of its range, an unknown `kurtosis`, or two maps of one kind.
    """

    maps: tuple[Map, ...]
    ins: InsGrade
    kurtosis: Kurtosis = "common"
    feedback: bool = False
    outlier_share: float = 0.02
    outlier_scale: float = 10.0
    min_cell_m: float | None = None
    max_cells: int = 160_000
    converged_sigma_m: float | None = None

    def __post_init__(self) -> None:
        one_map_a_kind("hybrid", self.maps)
        if self.kurtosis not in KURTOSES:
            unknown_name("hybrid kurtosis", str(self.kurtosis), KURTOSES)
        if not isinstance(self.feedback, bool):
            raise ConfigError(f"hybrid feedback is {self.feedback!r}, expected true or false")
        _ = self.filters

    @cached_property
    def filters(self) -> tuple[PointMass, ...]:
        """The filter of each map, in the order of the maps."""
        return tuple(
            PointMass(
                (chart,),
                self.ins,
                self.outlier_share,
                self.outlier_scale,
                self.min_cell_m,
                self.max_cells,
                self.converged_sigma_m,
            )
            for chart in self.maps
        )

    def init(self, prior: Prior, rng: Generator) -> HybridState:
        """Every filter starts from the same prior."""
        parts = tuple(one.init(prior, rng) for one in self.filters)
        return HybridState(parts, equal_weights(len(parts)), parts[0].mean_m, parts[0].cov_m2, Judgement())

    def step(self, state: HybridState, epoch: Epoch, rng: Generator) -> HybridState:
        """Step each filter, weigh their posteriors by kurtosis, mix."""
        parts = tuple(one.step(part, epoch, rng) for one, part in zip(self.filters, state.parts, strict=True))
        if len(parts) == 1:
            only = parts[0]
            return HybridState(parts, equal_weights(1), only.mean_m, only.cov_m2, only.judgement, epoch)
        weights = self.weigh(parts, epoch)
        mean, cov = mixed_moments(weights, [part.mean_m for part in parts], [part.cov_m2 for part in parts])
        judgement = self._judged(state.judgement, parts, weights, cov)
        if self.feedback:
            grid = _mixed(weights, [part.grid for part in parts], self.max_cells)
            parts = tuple(replace(part, grid=grid, mean_m=mean, cov_m2=cov) for part in parts)
        return HybridState(parts, weights, mean, cov, judgement, epoch)

    def estimate(self, state: HybridState) -> Estimate:
        """Mean and covariance of the mix, the distance between its parts included."""
        if state.epoch is None:
            raise StateError("hybrid: no estimate before the first epoch")
        return Estimate.at(state.epoch, state.mean_m, state.cov_m2, state.judgement.status, state.judgement.nis)

    def posterior(self, state: HybridState) -> Posterior:
        """The mixed density (eq. 13)."""
        grid = state.parts[0].grid
        if len(state.parts) > 1:
            grid = _mixed(state.weights, [part.grid for part in state.parts], MIX_CELLS)
        return Posterior(grid.north_m, grid.east_m, grid.density)

    def weigh(self, parts: Sequence[PointMassState], epoch: Epoch) -> FloatArray:
        """Weights of the maps after an epoch (eq. 14).

        Parameters
        ----------
        parts : (k,) sequence of PointMassState
            Of the filters of the maps.
        epoch : Epoch
            The latest. With feedback only the maps that were measured at it have a posterior of their own.

        Returns
        -------
        weights : (k,) they sum to one
        """
        if self.feedback:
            counts = [part.last_reading is epoch for part in parts]
        else:
            counts = [part.last_reading is not None for part in parts]
        if not any(counts):
            return equal_weights(len(parts))
        area_m2 = _area_m2([part.grid for part in parts])
        return normalised([self._kurtosis(part.grid, area_m2) if on else 0.0 for part, on in zip(parts, counts)])

    def _kurtosis(self, grid: Grid, area_m2: float) -> float:
        """Kurtosis of one posterior as `kurtosis` reads it."""
        if self.kurtosis == "position":
            return position_kurtosis(grid)
        cells = area_m2 / grid.cell_m**2 if self.kurtosis == "common" else float(grid.density.size)
        return value_kurtosis(grid.density, cells)

    def _judged(
        self, before: Judgement, parts: Sequence[PointMassState], weights: FloatArray, cov_m2: FloatArray
    ) -> Judgement:
        """Judge the mix by its own width and the weighted NIS of its parts, which is smoothed already."""
        known = [(part.judgement, float(w)) for part, w in zip(parts, weights) if part.judgement.readings and w > 0.0]
        total = sum(w for _, w in known)
        nis = sum(w * one.nis for one, w in known) / total if known else math.nan
        read = [part.judgement.off_map for part in parts if part.last_reading is not None]
        cell_m = min(chart.cell_m for chart in self.maps)
        threshold = cell_m if self.converged_sigma_m is None else self.converged_sigma_m
        seen = max(part.judgement.readings for part in parts)
        now = replace(before, nis=nis, readings=seen)
        return judge(Judge(threshold), now, largest_sigma_m(cov_m2), off_map=all(read) if read else None)


def value_kurtosis(values: FloatArray, cells: float) -> float:
    """Kurtosis of the values of a density over a grid (papers/002, its second eq. 11 with its eq. 12).

    Parameters
    ----------
    values : any shape
        The density where it is not zero.
    cells : float
        l m, the number of cells of the whole grid; those beyond `values` hold zero.

    Returns
    -------
    kurtosis : float
        1, the least there is, where all values are equal and eq. 12 divides by zero.
    """
    flat = values.ravel()
    empty = max(cells - flat.size, 0.0)
    away = flat - flat.sum() / cells
    at_zero = -float(flat.sum()) / cells
    away *= away
    square = float(away.sum()) + empty * at_zero**2
    fourth = float(away @ away) + empty * at_zero**4
    variance = square / max(cells - 1.0, 1.0)
    if variance <= 1e-18 * float(flat.max()) ** 2:
        return 1.0
    return fourth / cells / variance**2


def position_kurtosis(grid: Grid) -> float:
    """Fourth central moment over the squared variance of a density, mean of north and east; 3 for a Gaussian."""
    found = []
    for at, mass in ((grid.north_m, grid.density.sum(axis=1)), (grid.east_m, grid.density.sum(axis=0))):
        away = at - (mass @ at) / mass.sum()
        variance = float(mass @ away**2 / mass.sum())
        found.append(float(mass @ away**4 / mass.sum()) / variance**2 if variance > 0.0 else 1.0)
    return 0.5 * (found[0] + found[1])


def normalised(kurtosis: Sequence[float]) -> FloatArray:
    """Weights (k,) that sum to one (papers/002 eq. 14)."""
    values = np.asarray(kurtosis, dtype=np.float64)
    return np.asarray(values / values.sum())


def equal_weights(count: int) -> FloatArray:
    """Weights (k,) of maps of which nothing is known yet."""
    return np.full(count, 1.0 / count)


def mixed_moments(
    weights: FloatArray, means_m: Sequence[FloatArray], covs_m2: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of a mixture: the spread between its parts is part of the covariance.

    Parameters
    ----------
    weights : (k,) sum to one
    means_m : (k,) of (2,) [m]
    covs_m2 : (k,) of (2, 2) [m^2]

    Returns
    -------
    mean_m : (2,) [m]
    cov_m2 : (2, 2) [m^2]
    """
    means = np.stack(list(means_m))
    mean = weights @ means
    away = means - mean
    cov = np.einsum("k,kij->ij", weights, np.stack(list(covs_m2))) + (weights[:, None] * away).T @ away
    return mean, 0.5 * (cov + cov.T)


def _box(grids: Sequence[Grid]) -> tuple[float, float, float, float]:
    """South, west, north, east of the outer edges of all grids [m]."""
    edges = [
        (
            grid.south_m - 0.5 * grid.cell_m,
            grid.west_m - 0.5 * grid.cell_m,
            grid.south_m + (grid.density.shape[0] - 0.5) * grid.cell_m,
            grid.west_m + (grid.density.shape[1] - 0.5) * grid.cell_m,
        )
        for grid in grids
    ]
    south, west, north, east = zip(*edges, strict=True)
    return min(south), min(west), max(north), max(east)


def _area_m2(grids: Sequence[Grid]) -> float:
    """Area of the box that holds all grids."""
    south, west, north, east = _box(grids)
    return (north - south) * (east - west)


def _mixed(weights: FloatArray, grids: Sequence[Grid], most_cells: int) -> Grid:
    """The mixed density on one grid, as fine as the finest of those with weight and the limit of cells allow."""
    used = [(float(w), grid) for w, grid in zip(weights, grids, strict=True) if w > 0.0]
    south, west, north, east = _box([grid for _, grid in used])
    cell = max(min(grid.cell_m for _, grid in used), math.sqrt((north - south) * (east - west) / most_cells))
    rows, cols = max(math.ceil((north - south) / cell), 2), max(math.ceil((east - west) / cell), 2)
    first, left = south + 0.5 * cell, west + 0.5 * cell
    total = np.zeros((rows, cols))
    for weight, grid in used:
        at_row = (first + cell * np.arange(rows) - grid.south_m) / grid.cell_m
        at_col = (left + cell * np.arange(cols) - grid.west_m) / grid.cell_m
        part = np.empty((rows, cols))
        resample(np.log(np.maximum(grid.density, FLOOR)), at_row, at_col, part)
        mass = float(part.sum())
        if mass > 0.0:
            total += weight / mass * part
        else:  # all of it lies between two cells
            peak = np.unravel_index(int(grid.density.argmax()), grid.density.shape)
            row = round((grid.south_m + float(peak[0]) * grid.cell_m - first) / cell)
            col = round((grid.west_m + float(peak[1]) * grid.cell_m - left) / cell)
            total[min(max(row, 0), rows - 1), min(max(col, 0), cols - 1)] += weight
    return Grid(first, left, cell, total / total.sum())

"""Forward and backward over the grids of `pointmass`: every epoch in the light of the whole recording.

With F_k the filter's density after epoch k, L the likelihoods of epoch k + 1 and g the growth of the INS error that the
filter used for the step, the smoothed density is (Kitagawa, Non-Gaussian state-space modeling of nonstationary time
series, J. Amer. Stat. Assoc. 82, 1987, eq. 2.5; on grids Bergman, Recursive Bayesian Estimation, 1999, section 5.3)

    p(x_k | all) = F_k(x_k) B_k(x_k),   B_k(x_k) = integral N(x' - x_k; g) p(x' | all) / p(x' | y_1..k) dx'
                                                 ~ integral N(x' - x_k; g) L(x') B_k+1(x') dx',   B_n = 1

The second form is the one computed: where the first divides two densities on grids of different extent and cells, B is
a smooth function of its own, carried to another grid by its logarithm, and nothing is divided by a tail. L is taken
from the filter itself (its density after a reading over that before, on one grid), so voids, outliers and the widening
of a ridge finer than the cells are those of the filter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.records import Epoch, Estimate
from terranav.filters._replay import Flown, inner_of
from terranav.filters.pointmass import Grid, PointMass, PointMassState, gaussian_taps
from terranav.kernels.grid import FLOOR, diffuse, measure, resample

FloatArray = NDArray[np.float64]

LARGEST = 1e250  # B beyond it stands where the filter has no density


def smooth_pointmass(flight: Flown[Any], on_epoch: Callable[[int], None]) -> list[Estimate]:
    """The estimate at every epoch, given all readings.

    Parameters
    ----------
    flight : Flown
        A run of `PointMass`, with a monitor or without.
    on_epoch : callable
        Called with the number of epochs done, counted from the end.

    Returns
    -------
    list of Estimate, (n,)
        At the last epoch those of the filter.
    """
    estimator, epochs = flight.method, flight.epochs
    estimates = list(flight.estimates)
    ahead: Grid | None = None  # B at the epoch after, where there is one
    for k, watched in flight.backwards():
        state: PointMassState = inner_of(watched)
        if ahead is None:
            ahead = replace(state.grid, density=np.ones_like(state.grid.density))
        else:
            ahead = _scaled(state.grid, _before(estimator, state, epochs[k + 1], ahead))
            mean_m, cov_m2 = _measured(state.grid, ahead)
            estimates[k] = flight.estimate(watched, mean_m=mean_m, cov_m2=cov_m2)
        on_epoch(len(epochs) - k)
    return estimates


def _before(estimator: PointMass, state: PointMassState, epoch: Epoch, ahead: Grid) -> Grid:
    """B after `state`, on its grid, from B after the next epoch: the filter's step, its readings in reverse."""
    assert state.epoch is not None
    dt = epoch.time_s - state.epoch.time_s
    elapsed = epoch.time_s - dt - state.start_s
    growth = [estimator.ins.position_growth_m2(elapsed, dt, float(v)) for v in np.diag(state.cov_m2)]
    grown = estimator._grown(state.grid, growth)
    future = ahead
    for likelihood in reversed(_likelihoods(estimator, replace(state, grid=grown), epoch)):
        moved = _on(likelihood, future)
        future = replace(likelihood, density=likelihood.density * moved.density)
    if max(growth) <= 0.0:
        return _on(state.grid, future)
    future = _on(grown, future)
    cell2 = grown.cell_m**2  # after a long gap the filter's cells are twice as large, so many times over
    out = np.empty_like(future.density)
    diffuse(future.density, gaussian_taps(growth[0] / cell2), gaussian_taps(growth[1] / cell2), out)
    return _on(state.grid, replace(grown, density=out))


def _likelihoods(estimator: PointMass, state: PointMassState, epoch: Epoch) -> list[Grid]:
    """The likelihood of each reading of an epoch, up to a factor, on the grid that the filter weighed."""
    found = []
    for reading in epoch.measurements:
        for chart in estimator.maps:
            if chart.kind == reading.kind:
                after = estimator._updated(state, epoch, chart, reading).grid
                before = _on(after, state.grid).density
                likely = np.divide(after.density, before, out=np.zeros_like(before), where=before > FLOOR)
                found.append(replace(after, density=likely / likely.max()))
                state = replace(state, grid=after)
    return found


def _on(lattice: Grid, function: Grid) -> Grid:
    """A positive function on the cells of another grid, zero outside its own: copied where the cells coincide."""
    cell = function.cell_m
    rows, cols = (lattice.north_m - function.south_m) / cell, (lattice.east_m - function.west_m) / cell
    out = np.zeros(lattice.density.shape)
    if lattice.cell_m == cell and max(abs(rows[0] - round(rows[0])), abs(cols[0] - round(cols[0]))) < 1e-6:
        near, far = np.rint(rows).astype(int), np.rint(cols).astype(int)
        here = [(at >= 0) & (at < size) for at, size in zip((near, far), function.density.shape, strict=True)]
        out[np.ix_(*here)] = function.density[np.ix_(near[here[0]], far[here[1]])]
    else:
        resample(np.log(np.maximum(function.density, FLOOR)), rows, cols, out)
    return replace(lattice, density=out)


def _scaled(grid: Grid, ahead: Grid) -> Grid:
    """B such that the smoothed density sums to one; B = 1 where the readings to come contradict all of the grid."""
    total = float(np.sum(grid.density * ahead.density))
    if not total > FLOOR:
        return replace(ahead, density=np.ones_like(ahead.density))
    return replace(ahead, density=np.minimum(ahead.density / total, LARGEST))


def _measured(grid: Grid, ahead: Grid) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the smoothed density, with the filter's floor."""
    density = grid.density * ahead.density
    moments = measure(density / density.sum(), grid.north_m, grid.east_m)[0]
    cov = np.array([[moments[2], moments[3]], [moments[3], moments[4]]])
    return moments[:2].copy(), cov + (0.05 * grid.cell_m) ** 2 * np.eye(2)

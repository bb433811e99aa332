"""Forward and backward over the grids of `pointmass`: every epoch in the light of the whole recording.

With F_k the filter's density after epoch k, L the likelihoods of epoch k + 1 and g the growth of the INS error that the
filter used for the step, the smoothed density is (Kitagawa, Non-Gaussian state-space modeling of nonstationary time
series, J. Amer. Stat. Assoc. 82, 1987, eq. 2.5; on grids Bergman, Recursive Bayesian Estimation, 1999, section 5.3)

    p(x_k | all) = F_k(x_k) B_k(x_k),   B_k(x_k) = integral N(x' - x_k; g) p(x' | all) / p(x' | y_1..k) dx'
                                                 ~ integral N(x' - x_k; g) L(x') B_k+1(x') dx',   B_n = 1

The second form is the one computed: where the first divides two densities on grids of different extent and cells, B is
a smooth function of its own, carried to another grid by its logarithm, and nothing is divided by a tail. L is taken
from the filter itself (its density after a reading over that before, on one grid), so voids, outliers and the widening
of a ridge finer than the cells are those of the filter. B lives on cells that fit the smoothed density, which is often
far narrower than the filter's, and only where that density is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.records import Epoch, Estimate
from terranav.filters._replay import Flown, inner_of
from terranav.filters.pointmass import STILL, Grid, PointMass, PointMassState, moments, summary_of
from terranav.kernels.grid import FLOOR, resample

FloatArray = NDArray[np.float64]

MATTERS = (
    1e-9  # where the smoothed density is below this share of its peak, B is not let rise above its values elsewhere
)


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
            smoothed, ahead = _combined(estimator, state.grid, _before(estimator, state, epochs[k + 1], ahead))
            mean_m, cov_m2 = moments(summary_of(smoothed), smoothed.cell_m)
            estimates[k] = flight.estimate(watched, mean_m=mean_m, cov_m2=cov_m2)
        on_epoch(len(epochs) - k)
    return estimates


def _before(estimator: PointMass, state: PointMassState, epoch: Epoch, ahead: Grid) -> Grid:
    """B after `state`, up to a factor, from B after the next epoch: the filter's step in reverse."""
    assert state.epoch is not None
    growth = estimator._growth(state, epoch)
    if epoch.measurements:
        grown = replace(state, grid=estimator._grown(state.grid, growth))
        for likelihood in reversed(_likelihoods(estimator, grown, epoch)):
            ahead = _product(likelihood, ahead)
    total = float(ahead.density.sum())
    if not total > FLOOR:
        return replace(state.grid, density=np.ones_like(state.grid.density))
    return estimator._grown(replace(ahead, density=ahead.density / total), growth)  # a symmetric kernel: either way


def _likelihoods(estimator: PointMass, state: PointMassState, epoch: Epoch) -> list[Grid]:
    """The likelihood of each reading of an epoch, up to a factor, on the grid that the filter weighed."""
    found = []
    for reading in epoch.measurements:
        for chart in estimator.maps:
            if chart.kind == reading.kind:
                after = estimator._updated(
                    state.grid, STILL, epoch, chart, reading, last_reading=state.last_reading
                ).grid
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


def _product(one: Grid, other: Grid) -> Grid:
    """Product of two functions, on the finer of their grids, where both are known."""
    fine, coarse = (one, other) if one.cell_m <= other.cell_m else (other, one)
    parts = []
    for mine, theirs in ((fine.north_m, coarse.north_m), (fine.east_m, coarse.east_m)):
        inside = np.flatnonzero((mine >= theirs[0] - fine.cell_m) & (mine <= theirs[-1] + fine.cell_m))
        parts.append(slice(inside[0], inside[-1] + 1) if inside.size else slice(0, mine.size))
    part = Grid(
        float(fine.north_m[parts[0].start]),
        float(fine.east_m[parts[1].start]),
        fine.cell_m,
        fine.density[parts[0], parts[1]],
    )
    return replace(part, density=part.density * _on(part, coarse).density)


def _combined(estimator: PointMass, filtered: Grid, ahead: Grid) -> tuple[Grid, Grid]:
    """The smoothed density, and B on its grid; the past alone where the readings to come contradict all of it."""
    smoothed = _product(filtered, ahead)
    total = float(smoothed.density.sum())
    if not total > FLOOR:
        return filtered, replace(filtered, density=np.ones_like(filtered.density))
    smoothed = replace(smoothed, density=smoothed.density / total)
    smoothed = estimator._fitted(smoothed, summary_of(smoothed), math.inf)
    known = _on(smoothed, ahead).density
    matters = smoothed.density > MATTERS * smoothed.density.max()
    return smoothed, replace(smoothed, density=np.minimum(known, known[matters].max()))

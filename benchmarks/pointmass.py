"""Steps of the point-mass filter along a stream of epochs, through the public estimator, and its kernel alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, map_coordinates, zoom

import terranav as tn
from benchmarks.limits import byte_ns, multiply_add_ns
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.core.earth import shifted
from terranav.core.records import Epoch, Measurement, Prior
from terranav.filters.pointmass import RESOLVE, PointMass, PointMassState, gaussian_taps
from terranav.kernels.pointmass import advance
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma
from terranav.maps.sample_dem import sample_map

FloatArray = NDArray[np.float64]
NOISE_M = 60.0  # the density stays wide, and the grid as it is
WARM = 2  # readings before the clock starts, at one time
#: per cell: blend and look up the map 5, slope 4, residual 1, variance 2, inverse root 11, square 2, two exponentials
#: 26, their sum and product 3, five sums 6, marginals, moments and width 8, scaling 2; a tap is 1 on each axis
OPERATIONS = 70
SOUP = (
    *("functions", "types.array", "types.detection", "types.hypothesis", "types.state"),
    *("models.transition.linear", "models.measurement.nonlinear", "predictor.pointmass", "updater.pointmass"),
)
RNG = np.random.default_rng(0)


@dataclass(frozen=True)
class Case:
    """A filter, its state before the first epoch, and epochs with a reading each; the grid is `size` cells a side."""

    size: int
    method: PointMass
    start: PointMassState
    epochs: tuple[Epoch, ...]
    growth: float  # [cells^2]

    def ours(self, method: PointMass | None = None) -> PointMassState:
        """The state after the epochs."""
        state = self.start
        for epoch in self.epochs:
            state = (method or self.method).step(state, epoch, RNG)
        return state


def case(size: int, growth: float, count: int) -> Case:
    chart = sample_map()
    if size > 500:  # the same land in cells of a quarter
        a, b, c, d, e, f = chart.transform
        fine = zoom(chart.values, 4, order=1, mode="nearest", grid_mode=True)
        chart = replace(chart, values=fine, transform=(a / 4, b / 4, c, d / 4, e / 4, f))
    cell = 0.5 * chart.cell_m
    sigma = (size // 2 - 0.5) * cell / 5.5
    ins = tn.InsGrade(sigma, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=math.sqrt(growth) * cell)
    method = tn.make_estimator("pointmass", [chart], ins, max_cells=2 * size * size)
    assert isinstance(method, PointMass)
    rng, epochs = np.random.default_rng(1), []
    for k in range(count + WARM):
        lat, lon = shifted(*chart.centre_deg, 40.0 * k, 30.0 * k)
        reading = Measurement("terrain", float(chart.sample(lat, lon)) + rng.normal(0.0, NOISE_M), NOISE_M)
        told = shifted(lat, lon, 0.4 * sigma, -0.3 * sigma)
        epochs.append(Epoch(max(k - WARM + 1.0, 0.0), *told, 2000.0, measurements=(reading,)))
    start = method.init(Prior.from_ins(ins), rng)
    # narrower than the prior, so that the grid is not widened on the way
    axis = np.arange(size, dtype=np.float64) - size // 2
    density = np.exp(-0.5 * (axis[:, None] ** 2 + axis[None, :] ** 2) / (size / 15.0) ** 2)
    start = replace(start, grid=replace(start.grid, density=density / density.sum()))
    for epoch in epochs[:WARM]:
        start = method.step(start, epoch, rng)
    made = Case(size, method, start, tuple(epochs[WARM:]), growth)
    state = start
    for epoch in made.epochs:
        state = method.step(state, epoch, rng)
        assert state.grid.density.shape == (size, size), state.grid.density.shape
    return made


def plain(case_: Case, share: float, resolve: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean, covariance and density after the epochs: numpy and scipy, with as much of the likelihood as is asked."""
    grid, chart, scale = case_.start.grid, case_.method.maps[0], case_.method.outlier_scale
    north, east, post = grid.north_m, grid.east_m, grid.density
    taps, last = gaussian_taps(case_.growth), case_.start.epoch
    for epoch in case_.epochs:
        reading = epoch.measurements[0]
        sigma = reading_sigma(reading, chart, last, epoch)
        spread = convolve1d(convolve1d(post, taps, axis=0, mode="constant"), taps, axis=1, mode="constant")
        row, col = chart.local_frame(epoch.lat_deg, epoch.lon_deg).cells(-north[:, None], -east[None, :])
        height = map_coordinates(chart.values, [row, col], order=1, output=np.float64, cval=np.nan)
        variance: Any = sigma**2
        if resolve > 0.0:
            slope = np.gradient(height)
            variance = np.maximum(sigma**2, resolve**2 * (slope[0] ** 2 + slope[1] ** 2))
        ratio = (height - reading.value) ** 2 / variance
        like = (1.0 - share) * np.exp(-0.5 * ratio)
        if share > 0.0:
            like += share / scale * np.exp(-0.5 / scale**2 * ratio)
        if resolve > 0.0:
            like /= np.sqrt(variance)
        post = spread * like
        post /= post.sum()
        by_north, by_east = post.sum(axis=1), post.sum(axis=0)
        mean = np.array([by_north @ north, by_east @ east])
        cross = north @ post @ east - mean[0] * mean[1]
        cov = np.array([[by_north @ north**2 - mean[0] ** 2, cross], [cross, by_east @ east**2 - mean[1] ** 2]])
        last = epoch
    return mean, cov, post


def stone_soup(case_: Case) -> Callable[[], tuple[FloatArray, FloatArray]] | None:
    """The same stream through Stone Soup's predictor and updater; None where it is not installed."""
    try:
        parts = {name: import_module(f"stonesoup.{name}") for name in SOUP}
    except ImportError:
        return None
    functions, array, detection, hypothesis, state_types, linear, nonlinear, predictors, updaters = parts.values()

    class Terrain(nonlinear.NonLinearGaussianMeasurement):  # type: ignore[misc, name-defined]
        """The height of the land at the indicated position minus the error."""

        ndim_meas = 1
        chart: Map
        epoch: Epoch

        def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
            error = np.asarray(state.state_vector, dtype=np.float64)
            row, col = self.chart.local_frame(self.epoch.lat_deg, self.epoch.lon_deg).cells(-error[0], -error[1])
            return array.StateVectors(
                map_coordinates(self.chart.values, [row, col], order=1, output=np.float64)[None, :]
            )

    chart, grid, size = case_.method.maps[0], case_.start.grid, case_.size
    walk = case_.growth * grid.cell_m**2
    motion = linear.CombinedLinearGaussianTransitionModel([linear.RandomWalk(walk), linear.RandomWalk(walk)])
    predictor, updater = predictors.PointMassPredictor(motion, sFactor=5.0), updaters.PointMassUpdater(None)
    assert case_.start.epoch is not None
    first, began = datetime(2026, 1, 1), case_.start.epoch.time_s
    sides = np.array([size, size])
    lattice, delta, dims, centre, vectors = functions.grid_creation(
        case_.start.mean_m[:, None], case_.start.cov_m2, 5.0, 2, sides
    )
    at = [(lattice[0] - grid.south_m) / grid.cell_m, (lattice[1] - grid.west_m) / grid.cell_m]
    weight = map_coordinates(grid.density, at, order=1)
    weight /= weight.sum() * np.prod(delta)

    def sightings() -> Sequence[Any]:
        found, last = [], case_.start.epoch
        for epoch in case_.epochs:
            reading = epoch.measurements[0]
            variance = np.array([[reading_sigma(reading, chart, last, epoch) ** 2]])
            model = Terrain(ndim_state=2, mapping=(0, 1), noise_covar=variance)
            model.chart, model.epoch, last = chart, epoch, epoch
            when = first + timedelta(seconds=epoch.time_s - began)
            found.append(detection.Detection(np.array([[reading.value]]), timestamp=when, measurement_model=model))
        return found

    seen = sightings()

    def run() -> tuple[FloatArray, FloatArray]:
        where = {"grid_delta": delta, "grid_dim": dims, "center": centre, "eigVec": vectors, "Npa": sides}
        state = state_types.PointMassState(array.StateVectors(lattice), weight=weight, timestamp=first, **where)
        for sighting in seen:
            predicted = predictor.predict(state, timestamp=sighting.timestamp)
            state = updater.update(hypothesis.SingleHypothesis(predicted, sighting))
        return np.asarray(state.mean, dtype=np.float64).ravel(), np.asarray(state.covar(), dtype=np.float64)

    return run


def agreed(case_: Case, soup: Callable[[], tuple[FloatArray, FloatArray]] | None) -> None:
    """Refuse to time what does not give the same answer."""
    state = case_.ours()
    mean, _, post = plain(case_, case_.method.outlier_share, RESOLVE)
    np.testing.assert_allclose(state.grid.density, post, rtol=1e-9, atol=1e-12 * post.max())
    np.testing.assert_allclose(state.mean_m, mean, rtol=1e-8)
    gaussian = case_.ours(replace(case_.method, outlier_share=0.0))
    sigma = np.sqrt(np.diag(gaussian.cov_m2))
    for found, within in ((plain(case_, 0.0, 0.0), 1e-3), (soup() if soup else None, 0.1)):
        if found is not None:
            np.testing.assert_allclose(found[0] / sigma, gaussian.mean_m / sigma, atol=within)
            np.testing.assert_allclose(np.sqrt(np.diag(found[1])), sigma, rtol=within)


def whole(case_: Case, goals: tuple[float, float], repeats: int) -> Row:
    """The estimator's step: records, frames and Python included."""
    soup = stone_soup(case_)
    agreed(case_, soup)
    calls: dict[str, Callable[[], object]] = {
        "ours": case_.ours,
        "scipy/numpy, Gaussian likelihood only": lambda: plain(case_, 0.0, 0.0),
        "scipy/numpy, same likelihood": lambda: plain(case_, case_.method.outlier_share, RESOLVE),
    }
    if soup:
        calls["Stone Soup 1.9.1, Gaussian likelihood only"] = soup
    least = least_ns(calls, case_.size**2 * len(case_.epochs), repeats)
    ours = least.pop("ours")
    wanted = {name: goals[name.startswith("Stone")] for name in least if name.endswith("only")}
    peers = tuple(Peer(name, ns, wanted.get(name, 0.0), reached(name, case_)) for name, ns in least.items())
    return Row(named("step of the estimator", case_), "cell", ours, peers)


def reached(name: str, case_: Case) -> float:
    """Where a goal is not reached: three grids beyond the near caches, which Stone Soup's arithmetic hides."""
    return 65.0 if name.startswith("Stone") and case_.size > 1000 else 0.0


def alone(case_: Case, goal: float) -> Row:
    """The kernel, and what the machine would need at the least."""
    epoch, grid, chart = case_.epochs[0], case_.start.grid, case_.method.maps[0]
    reading = (epoch.measurements[0].value, NOISE_M, RESOLVE, case_.method.outlier_share, case_.method.outlier_scale)
    frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg)
    out, place = np.empty_like(grid.density), (grid.south_m, grid.west_m, grid.cell_m)

    def kernel() -> object:
        growth = case_.growth
        return advance(grid.density, growth, growth, place, chart.values, (frame.row, frame.col), reading, out)

    ns = least_ns({"": kernel}, case_.size**2, repeats=25)[""]
    operations = OPERATIONS + 2 * gaussian_taps(case_.growth).size
    sums, moved = operations * multiply_add_ns(), 32 * byte_ns(2 * out.nbytes)
    limit = Limit(f"{operations} operations", sums, goal) if sums > moved else Limit("32 bytes", moved, goal)
    return Row(named("kernel", case_), "cell", ns, (), limit)


def named(part: str, case_: Case) -> str:
    taps = gaussian_taps(case_.growth).size
    return f"point mass, {part}, {case_.size} x {case_.size}, {taps} taps an axis"


def rows() -> list[Row]:
    usual, wide, large = case(201, 0.05, 20), case(201, 0.6, 20), case(1001, 0.6, 5)
    found = []
    for made, goals, repeats, goal in ((usual, (4.0, 60.0), 7, 2.5), (wide, (4.0, 60.0), 7, 2.5)):
        found += [whole(made, goals, repeats), alone(made, goal)]
    return [*found, whole(large, (6.0, 80.0), 2), alone(large, 3.0)]

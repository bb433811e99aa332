"""How the time of a step and of a run grows with what it works on. A constant time per unit is linear growth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

import terranav as tn
from benchmarks.timing import Row
from terranav.core.earth import shift
from terranav.core.kinds import KINDS
from terranav.core.memory import need
from terranav.core.records import Epoch, Measurement, Prior
from terranav.experiment.montecarlo import Threads, monte_carlo

INS = tn.InsGrade(200.0, 0.2, 0.5)
LAT, LON = 46.5, 8.5
CELLS = (51, 101, 201, 401, 801, 1601, 3201)
PARTICLES = (1_000, 10_000, 100_000, 1_000_000, 10_000_000)
SIDES = (301, 1_001, 3_001, 10_001, 30_001)
EPOCHS = (100, 1_000, 10_000, 100_000)
RUNS = (1, 10, 100, 1_000)


def rows() -> Iterator[Row]:
    chart = ground(1201)
    yield from _cells(ground(3401))  # larger than the largest grid: beyond the edge a place costs more
    yield from _particles("particle", chart, PARTICLES)
    yield from _particles("marginalized", chart, PARTICLES[:-1])
    yield from _maps()
    yield from _sizes()
    yield from _epochs(chart)
    yield from _runs(chart)


def ground(side: int, kind: str = "terrain", cell_deg: float = 4e-4) -> tn.Map:
    """A map of side x side cells about (LAT, LON): the same waves wherever it is, whatever the side."""
    need(6.0 * side * side, f"map of {side} x {side} cells")
    values = np.empty((side, side), np.float32)
    at = np.arange(side, dtype=np.float32) - side // 2
    for row, y in zip(values, at, strict=True):
        row[:] = 90.0 * np.sin(0.11 * at + 0.05 * y) + 60.0 * np.cos(0.17 * y - 0.06 * at)
    half = 0.5 * side * cell_deg
    values.setflags(write=False)
    where = (cell_deg, 0.0, LON - half, 0.0, -cell_deg, LAT + half)
    return tn.Map(values, where, kind=kind, unit=KINDS[kind].unit, sigma=1.0)


def epoch(k: int, maps: Iterable[tn.Map], sigma: float) -> Epoch:
    """Second k of a flight, with a reading of each map."""
    lat, lon = (float(x) for x in shift(LAT, LON, 30.0 * k, 40.0 * k))
    readings = tuple(Measurement(chart.kind, float(chart.sample(lat, lon)), sigma) for chart in maps)
    return Epoch(float(k), lat, lon, 3000.0, (30.0, 40.0, 0.0), None, readings)


def step_ns(
    estimator: Any, prior: Prior, maps: tuple[tn.Map, ...], sigma: float, spent_s: float = 1.0
) -> tuple[float, Any]:
    """The least time of the second step, repeated from the same state, and the state after it."""
    rng = np.random.default_rng(2)
    state = estimator.step(estimator.init(prior, rng), epoch(0, maps, sigma), rng)
    later, least = epoch(1, maps, sigma), float("inf")
    estimator.step(state, later, rng)  # loads what is compiled
    begun = time.perf_counter()
    while least == float("inf") or time.perf_counter() - begun < spent_s:
        start = time.perf_counter_ns()
        after = estimator.step(state, later, rng)
        least = min(least, float(time.perf_counter_ns() - start))
    return least, after


def _cells(chart: tn.Map) -> Iterator[Row]:
    for side in CELLS:
        sigma_m = 0.5 * chart.cell_m * (side // 2) / 5.5
        estimator = tn.make_estimator("pointmass", chart, INS, max_cells=2 * side * side)
        wide = Prior(np.zeros(2), np.eye(2) * sigma_m**2)
        ns, after = step_ns(estimator, wide, (chart,), 3000.0)
        cells = after.grid.density.size
        yield Row(f"pointmass step, {cells:,} cells", "cell", ns / cells)


def _particles(name: str, chart: tn.Map, counts: Iterable[int]) -> Iterator[Row]:
    for count in counts:
        least = {"least_particles": count, "integrity": False} if name == "marginalized" else {}
        estimator = tn.make_estimator(name, chart, INS, particles=count, **least)
        ns, _ = step_ns(estimator, Prior.from_ins(INS), (chart,), 3.0)
        yield Row(f"{name} step, {count:,} particles", "particle", ns / count)


def _maps() -> Iterator[Row]:
    charts = tuple(ground(601, kind) for kind in KINDS)
    for n in range(1, len(charts) + 1):
        estimator = tn.make_estimator("marginalized", charts[:n], INS)
        ns, _ = step_ns(estimator, Prior.from_ins(INS), charts[:n], 5.0)
        yield Row(f"marginalized step with monitor, {n} maps", "map", ns / n)


def _sizes() -> Iterator[Row]:
    for side in SIDES:
        chart = ground(side)
        ns, _ = step_ns(tn.make_estimator("marginalized", chart, INS), Prior.from_ins(INS), (chart,), 3.0)
        yield Row(f"marginalized step, map of {side:,} x {side:,} cells", "step", ns)


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def flight(chart: tn.Map, epochs: int) -> tn.Recording:
    """A flight in circles, one reading a second."""
    turn = 0.01 * np.arange(epochs)
    lat, lon = shift(LAT, LON, 4000.0 * np.sin(turn), 4000.0 * np.cos(turn))
    columns = {"time_s": np.arange(float(epochs)), "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(epochs, 3000.0)}
    noise = np.random.default_rng(5).normal(0.0, 3.0, epochs)
    return tn.Recording({**columns, "terrain_m": chart.sample(lat, lon) + noise}, sigma={"terrain_m": 3.0})


def _epochs(chart: tn.Map) -> Iterator[Row]:
    still = replace(INS, velocity_sigma_mps=0.0)
    tn.run("marginalized", flight(chart, 60), chart, ins=still)  # loads the kernels
    for count in EPOCHS:
        rec = flight(chart, count)
        seconds = _seconds(partial(tn.run, "marginalized", rec, chart, ins=still))
        yield Row(f"marginalized run, {count:,} epochs", "epoch", 1e9 * seconds / count)


def _runs(chart: tn.Map) -> Iterator[Row]:
    rec = flight(chart, 60)

    def one(k: int, seed: np.random.SeedSequence) -> float:
        return float(tn.run("pointmass", rec, chart, ins=INS, seed=int(seed.generate_state(1)[0])).cov_m2[-1, 0, 0])

    one(0, np.random.SeedSequence(0))
    for n in RUNS:
        seconds = _seconds(partial(monte_carlo, one, n, executor=Threads()))
        yield Row(f"pointmass on all cores, {n:,} runs of 60 epochs", "run", 1e9 * seconds / n)

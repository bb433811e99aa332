"""50 runs of a point-mass filter over 320 epochs on 201 x 201 cells: one thread, and a thread on each core."""

from __future__ import annotations

import os
from functools import partial
from time import perf_counter_ns

import numpy as np

import terranav as tn
from benchmarks.growth import epoch, ground
from benchmarks.timing import Peer, Row
from terranav.core.records import Epoch, Prior
from terranav.experiment.montecarlo import Threads, monte_carlo
from terranav.experiment.stream import states
from terranav.filters.pointmass import PointMass

RUNS, EPOCHS, SIDE = 50, 320, 201
INS = tn.InsGrade(200.0, 0.0, 0.01)
Answer = tuple[float, int]


def one(k: int, seed: np.random.SeedSequence, *, filter_: PointMass, prior: Prior, flight: tuple[Epoch, ...]) -> Answer:
    """North error at the end of a run, and the cells of all its steps."""
    del k
    cells, north_m = 0, float("nan")
    for state in states(filter_, prior, flight, np.random.default_rng(seed)):
        cells += state.grid.density.size
        north_m = float(state.mean_m[0])
    return north_m, cells


def rows() -> list[Row]:
    chart = ground(1201)
    filter_ = PointMass((chart,), INS, max_cells=2 * SIDE * SIDE)
    sigma_m = 0.5 * chart.cell_m * (SIDE // 2) / 5.5
    prior = Prior(np.zeros(2), np.eye(2) * sigma_m**2)
    flight = tuple(epoch(k, (chart,), 2000.0) for k in range(EPOCHS))  # readings that leave the grid as wide as it is
    work = partial(one, filter_=filter_, prior=prior, flight=flight)
    cores = os.cpu_count() or 1
    took: dict[int, float] = {}
    answers: dict[int, list[Answer]] = {}
    for _ in range(2):
        for threads in (1, cores):
            start = perf_counter_ns()
            answers[threads], _failures = monte_carlo(work, RUNS, executor=Threads(threads))
            took[threads] = min(took.get(threads, float("inf")), float(perf_counter_ns() - start))
    if answers[1] != answers[cores]:
        raise AssertionError("runs on threads differ from runs on one")
    side = (sum(cells for _, cells in answers[1]) / RUNS / EPOCHS) ** 0.5
    return [
        Row(
            f"{RUNS} runs x {EPOCHS} steps, {side:.0f} x {side:.0f} cells, {cores} threads",
            "run",
            took[cores] / RUNS,
            (Peer("terranav on one thread", took[1] / RUNS, 0.9 * cores if cores > 1 else 0.0),),
        )
    ]

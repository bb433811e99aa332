"""One step of the Viterbi search on 401 x 401 cells, through the estimator: move, sample, measure, store pointers.

Forty times numpy was aimed at. The recursion alone is there; in the whole step the map's values, the density of each
residual and the forward recursion, in which numpy loses less, take six times as long as the recursion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from benchmarks.limits import byte_ns, multiply_add_ns
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior
from terranav.experiment.registry import make_estimator
from terranav.filters.viterbi import ViterbiState
from terranav.kernels.viterbi import STAY, max_sum
from terranav.maps.frame import LocalFrame
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map

FloatArray = NDArray[np.float64]
Answer = tuple[FloatArray, FloatArray, NDArray[np.uint8], FloatArray, FloatArray]
STAYS, CELL_M, SIGMA, STEPS = 0.6, 20.0, 5.0, 12
STACKED, ONE_BY_ONE = "numpy, argmax of nine arrays", "numpy, neighbour by neighbour"
NEIGHBOURS = [0, 1, 2, 3, 5, 6, 7, 8]
LEAST_OPERATIONS = 26.0  # eight comparisons, maxima and choices, two sums: max_sum, per cell


def rows() -> list[Row]:
    cases = ((401, "integral_gaussian", 13.0), (401, "gaussian", 12.0), (201, "gaussian", 7.0))
    return [*(_step(*case) for case in cases), _recursion(401)]


def _step(size: int, noise: str, reached: float) -> Row:
    """The public step beside the same in numpy."""
    chart = sample_map()
    lat, lon = chart.centre_deg
    sigma_m = (size // 2) * CELL_M / 3.0
    ins = InsGrade(position_sigma_m=sigma_m, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=1.0)
    reading = Measurement("terrain", float(chart.sample(lat, lon)) + 3.0, SIGMA)
    estimator = make_estimator("viterbi", (replace(chart, sigma=0.0),), ins, cell_m=CELL_M, stay=STAYS, noise=noise)
    rng = np.random.default_rng(0)
    state: ViterbiState = estimator.init(Prior(np.zeros(2), np.eye(2) * sigma_m**2, "uniform"), rng)
    for k in range(3):
        state = estimator.step(state, Epoch(float(k), lat, lon, 900.0, measurements=(reading,)), rng)
    assert state.score.shape == (size, size)
    epochs = [Epoch(3.0 + k, lat, lon, 900.0, measurements=(reading,)) for k in range(STEPS)]
    frame = chart.local_frame(lat, lon, 6000.0)

    def ours() -> ViterbiState:
        after = state
        for epoch in epochs:
            after = estimator.step(after, epoch, rng)
        return after

    def peer(stacked: bool) -> Answer:
        score, probability = state.score, state.probability
        for _ in epochs:
            answer = _numpy_step(score, probability, (state, reading.value, frame, chart), (noise, stacked))
            score, probability = answer[:2]
        return answer

    after = ours()
    for stacked in (True, False):
        score, probability, pointer, best, cov = peer(stacked)
        np.testing.assert_allclose(after.score, score, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(after.probability, probability, rtol=1e-8, atol=1e-200)
        np.testing.assert_array_equal(after.history.newest[-1].pointers[0], pointer)
        np.testing.assert_allclose(after.estimate_m, best, atol=1e-9)
        np.testing.assert_allclose(after.spread_m2, cov + CELL_M**2 / 12.0 * np.eye(2), rtol=1e-8)
    calls: dict[str, Callable[[], object]] = {
        "ours": ours, STACKED: lambda: peer(True), ONE_BY_ONE: lambda: peer(False)
    }  # fmt: skip
    least = least_ns(calls, STEPS * size * size, repeats=5 if size > 300 else 15)
    name = f"Viterbi step of the estimator, {noise}, {size} x {size}"
    return Row(
        name, "cell", least["ours"], (Peer(STACKED, least[STACKED], 40.0, reached), Peer(ONE_BY_ONE, least[ONE_BY_ONE]))
    )


def _numpy_step(
    score: FloatArray,
    probability: FloatArray,
    world: tuple[ViterbiState, float, LocalFrame, Map],
    how: tuple[str, bool],
) -> Answer:
    """Scores, probabilities, pointers, best place and covariance of the probabilities, array by array."""
    (state, value, frame, chart), (noise, stacked) = world, how
    recursion = _stacked_max_sum if stacked else _numpy_max_sum
    score, pointer = recursion(score, math.log(STAYS), math.log((1.0 - STAYS) / 8.0))
    p = np.pad(probability, 1)
    column = p[:-2] + p[1:-1] + p[2:]
    square = column[:, :-2] + column[:, 1:-1] + column[:, 2:]
    move = (1.0 - STAYS) / 8.0
    p = STAYS * probability + move * (square - probability)
    p /= p.sum()
    north, east = state.north_m, state.east_m
    row, col = frame.cells(-north[:, None], -east[None, :])
    field = _numpy_bilinear(chart.values, row, col)
    slope_north, slope_east = np.gradient(field)
    s = np.sqrt(SIGMA**2 + (slope_north**2 + slope_east**2) / 12.0)
    if noise == "gaussian":
        weight = -0.5 * ((value - field) / s) ** 2 - np.log(s)
    else:
        v = np.abs(value - field)
        upper, lower = log_ndtr((SIGMA - v) / s), log_ndtr((-SIGMA - v) / s)
        weight = upper + np.log(-np.expm1(lower - upper))
    score += weight
    best = score.max()
    score -= best
    p *= np.exp(weight - weight.max())
    p /= p.sum()
    down, across = p.sum(axis=1), p.sum(axis=0)
    mean_n, mean_e = (down * north).sum(), (across * east).sum()
    n, e = north - mean_n, east - mean_e
    cross = (n * (p * e).sum(axis=1)).sum()
    cov = np.array([[(down * n**2).sum(), cross], [cross, (across * e**2).sum()]])
    at = np.unravel_index(int(score.argmax()), score.shape)
    return score, p, pointer, np.array([north[at[0]], east[at[1]]]), cov


def _numpy_bilinear(values: NDArray[np.float32], row: FloatArray, col: FloatArray) -> FloatArray:
    """The map at fractional rows and columns within it."""
    i, j = row.astype(np.int64), col.astype(np.int64)
    u, v = row - i, col - j
    field = (1.0 - u) * ((1.0 - v) * values[i, j] + v * values[i, j + 1])
    field += u * ((1.0 - v) * values[i + 1, j] + v * values[i + 1, j + 1])
    return field


def _stacked_max_sum(score: FloatArray, log_stay: float, log_move: float) -> tuple[FloatArray, NDArray[np.uint8]]:
    """As `_numpy_max_sum`, by argmax over the nine shifted arrays."""
    rows, cols = score.shape
    framed = np.pad(score, 1, constant_values=-np.inf)
    ways = np.stack([framed[k // 3 : k // 3 + rows, k % 3 : k % 3 + cols] for k in [STAY, *NEIGHBOURS]])
    ways[0] += log_stay
    ways[1:] += log_move
    came = ways.argmax(axis=0)
    return np.take_along_axis(ways, came[None], axis=0)[0], np.array([STAY, *NEIGHBOURS], np.uint8)[came]


def _numpy_max_sum(score: FloatArray, log_stay: float, log_move: float) -> tuple[FloatArray, NDArray[np.uint8]]:
    """Best score into each cell and the number of the neighbour that it came from; the cell itself wins a tie."""
    rows, cols = score.shape
    framed = np.pad(score, 1, constant_values=-np.inf)
    best, pointer = score + log_stay, np.full(score.shape, STAY, np.uint8)
    framed += log_move
    for k in NEIGHBOURS:
        came = framed[k // 3 : k // 3 + rows, k % 3 : k % 3 + cols]
        better = came > best
        np.copyto(best, came, where=better)
        pointer[better] = k
    return best, pointer


def _recursion(size: int) -> Row:
    """The recursion alone."""
    rng = np.random.default_rng(0)
    score, out = rng.normal(size=(size, size)), np.empty((size, size))
    pointer = np.empty(score.shape, np.uint8)
    stay, move = math.log(STAYS), math.log((1.0 - STAYS) / 8.0)

    def ours() -> None:
        max_sum(score, stay, move, out, pointer)

    ours()
    calls: dict[str, Callable[[], object]] = {"ours": ours}
    for name, peer in ((STACKED, _stacked_max_sum), (ONE_BY_ONE, _numpy_max_sum)):
        best, came = peer(score, stay, move)
        np.testing.assert_array_equal(out, best)
        np.testing.assert_array_equal(pointer, came)
        calls[name] = partial(peer, score, stay, move)
    least = least_ns(calls, size * size, repeats=25)
    limit = max(LEAST_OPERATIONS * multiply_add_ns(), 17.0 * byte_ns(17 * size * size))
    work = f"Viterbi 3 x 3 recursion with back-pointers, {size} x {size}"
    peers = (Peer(STACKED, least[STACKED], 40.0, reached=30.0), Peer(ONE_BY_ONE, least[ONE_BY_ONE]))
    return Row(work, "cell", least["ours"], peers, Limit("26 operations in vector registers", limit, 2.0))

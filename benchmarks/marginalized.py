"""Steps of the navigator along a stream of epochs, through the public estimator, and its kernels alone."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import terranav as tn
from benchmarks.limits import byte_ns, multiply_add_ns
from benchmarks.marginalized_numpy import Normal, Plain, plain_step
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.core.earth import shift
from terranav.core.records import Epoch, Estimate, Measurement, Prior
from terranav.experiment.demo import demo_scenario
from terranav.experiment.inputs import prepare
from terranav.experiment.registry import make_estimator
from terranav.experiment.stream import states
from terranav.filters._noise_scale import SCALES
from terranav.filters._normals import standard_normal
from terranav.filters.marginalized import Marginalized, MarginalizedState
from terranav.kernels import marginalized as kernels
from terranav.kernels import reading
from terranav.kernels.walk_scale import linearised
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map

FloatArray = NDArray[np.float64]
INS = tn.InsGrade(300.0, 0.5, 1.0, 0.01)
SPEED_MPS, SIGMA_M = 60.0, 4.0
SETTLE, STEPS = 60, 8  # readings before the clock starts, and while it runs
PART, PARTS = 25, 32  # epochs of the demo flight
#: of 6 states, per particle: predicted positions and velocities 8, sums of 8 x 8 with their weights 48 + 12, noise of
#: its own 12, added 18, place in the map 12, blend and slope 14, sums 5, likelihood 45 and regimes 10, means 4, second
#: moments 36 + 12; two normal numbers 60
OPERATIONS = 296
BYTES = 8 * (6 + 2 + 6 + 6 + 6 + 2 + 1 + 6 + 4 + 6)  # arrays of the cloud that are read or written by its passes


@dataclass(frozen=True)
class Case:
    """A filter of `count` particles, and its state before each of some epochs with a reading, the position known."""

    filter_: Marginalized
    states: tuple[MarginalizedState, ...]
    epochs: tuple[Epoch, ...]

    @classmethod
    def of(cls, count: int) -> Case:
        chart = sample_map()
        epochs = _flight(chart, SETTLE + STEPS)
        filter_ = make_estimator("marginalized", [chart], INS, integrity=False, particles=count, least_particles=count)
        assert isinstance(filter_, Marginalized)
        rng = np.random.default_rng(2)
        states = [filter_.init(Prior.from_ins(INS), rng)]
        for epoch in epochs[:-1]:
            states = [*states[1 - STEPS :], filter_.step(states[-1], epoch, rng)]
        return cls(filter_, tuple(states), epochs[SETTLE:])

    def ours(self, k: int) -> MarginalizedState:
        return self.filter_.step(self.states[k], self.epochs[k], np.random.default_rng(k))

    def streamed(self, k: int) -> Estimate:
        return self.filter_.estimate(self.ours(k))


def rows() -> list[Row]:
    return [_large(), _streamed(), *_watched()]


def _each(calls: Mapping[str, Callable[[int], object]], count: int, units: int, repeats: int) -> dict[str, float]:
    """`least_ns` of calls that take the number of a piece of work, each piece by itself: the mean over the pieces.

    Short pieces find a moment when the other processes of the machine leave them alone.
    """
    pieces = {f"{name} {k}": partial(call, k) for name, call in calls.items() for k in range(count)}
    least = least_ns(pieces, units, repeats=repeats)
    return {name: sum(least[f"{name} {k}"] for k in range(count)) / count for name in calls}


def _large() -> Row:
    """100,000 particles, against the same step in numpy; and a smaller one, as in textbooks."""
    count = 100_000
    case = Case.of(count)
    starts = [Plain.of(state) for state in case.states]

    def numpy(k: int, normal: Normal = lambda rng, shape: rng.standard_normal(shape)) -> Plain:
        return plain_step(case.filter_, starts[k], case.epochs[k], np.random.default_rng(k), normal)

    for k in range(STEPS):
        mine, plain = case.ours(k), numpy(k, standard_normal)
        assert mine.cloud is not None
        sigma = np.sqrt(np.diag(plain.cov))
        np.testing.assert_allclose(mine.mean / sigma, plain.mean / sigma, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(mine.cov / np.outer(sigma, sigma), plain.cov / np.outer(sigma, sigma), atol=1e-9)
        np.testing.assert_allclose(mine.cloud.weight * count, plain.weight * count, rtol=1e-6, atol=1e-6)
    textbook = _textbook(case, starts)
    least = _each({"ours": case.ours, "numpy": numpy, "textbook": textbook}, STEPS, count, repeats=7)
    peers = (
        Peer("numpy, the same step", least["numpy"], 7.0),
        Peer("numpy, a textbook's step (5 states, Gaussian)", least["textbook"]),
    )
    limit = max(OPERATIONS / 2 * multiply_add_ns(), BYTES * byte_ns(24 * 2**20))
    work = f"marginalized, {count:,} particles, 2 + 4 states, step"
    return Row(work, "particle", least["ours"], peers, Limit("arithmetic or memory", limit))


def _streamed() -> Row:
    """10,000 particles: what the objects of a step cost beside its kernels."""
    count = 10_000
    case = Case.of(count)
    calls = {"all": case.streamed, "kernels": _kernels(case)}
    least = _each(calls, STEPS, count, repeats=40)
    work = f"marginalized through the stream, {count:,} particles, step"
    return Row(work, "particle", least["all"], (), Limit("its kernels alone", least["kernels"], 2.0))


def _watched() -> list[Row]:
    """The shipped demo flight as it is flown by default, and with five epochs of the INS for a reading."""
    scenario = demo_scenario()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recording = tn.simulate(scenario, seed=1001)
        inputs = prepare(recording, scenario.open_maps(), None, None, needs_maps=True)
    built = make_estimator("marginalized", inputs.maps, inputs.ins)
    bare = make_estimator("marginalized", inputs.maps, inputs.ins, integrity=False)
    epochs = inputs.epochs[: PART * PARTS]
    thin = [one if k % 5 == 0 else replace(one, measurements=()) for k, one in enumerate(epochs)]
    calls = {
        "by default, its monitor watching": _parts(built, inputs.prior, epochs),
        "without its monitor": _parts(bare, inputs.prior, epochs),
        "a reading in every fifth epoch": _parts(built, inputs.prior, thin),
    }
    least = _each(calls, PARTS, PART, repeats=5)
    return [Row(f"marginalized, demo flight, {name}", "epoch", ns) for name, ns in least.items()]


def _parts(estimator: Any, prior: Prior, epochs: Sequence[Epoch]) -> Callable[[int], object]:
    """A flight in parts, each flown again from the state before it."""
    rng = np.random.default_rng(4)
    state, before = estimator.init(prior, rng), []
    for k, epoch in enumerate(epochs):
        if k % PART == 0:
            before.append(state)
        state = estimator.step(state, epoch, rng)

    def part(k: int) -> int:
        again, usable = np.random.default_rng(k), 0
        for state in states(estimator, prior, epochs[PART * k : PART * (k + 1)], again, resume=before[k]):
            usable += estimator.estimate(state).usable
        return usable

    return part


def _flight(chart: Map, count: int) -> tuple[Epoch, ...]:
    """Straight over the middle of the map, a reading a second, an INS that errs by 150 m and drifts."""
    rng = np.random.default_rng(1)
    along = SPEED_MPS * (np.arange(count) - 0.5 * count)
    lat, lon = shift(*chart.centre_deg, 0.6 * along, 0.8 * along)
    value = chart.sample(lat, lon) + SIGMA_M * rng.standard_normal(count)
    told_lat, told_lon = shift(lat, lon, 150.0 + 0.3 * np.arange(count), -80.0 - 0.2 * np.arange(count))
    return tuple(
        Epoch(float(k), north, east, 3000.0, measurements=(Measurement("terrain", h, SIGMA_M),))
        for k, (north, east, h) in enumerate(zip(told_lat.tolist(), told_lon.tolist(), value.tolist(), strict=True))
    )


def _kernels(case: Case) -> Callable[[int], object]:
    """The kernels that one step of the case calls for every particle."""
    chart = case.filter_.maps[0]

    def call(k: int) -> None:
        state, epoch = case.states[k], case.epochs[k]
        cloud, model = state.cloud, state.model
        assert cloud is not None and model is not None and state.epoch is not None  # noqa: PT018
        frame, phi, bias, d, m, gain, white, spread = about[k]
        common, value = float(gain[bias] + gain[bias + 1]), epoch.measurements[0].value
        noise, out, bad = standard_normal(rng, (2, m)), np.empty((d, m)), np.empty((1, m))
        kernels.advance(cloud.rows, cloud.weight, state.mean, phi, spread, noise, out)
        kernels.regime(cloud.bad, 0.05, np.array([0.7]), bad)
        reading.reach_of(out)
        residual, slope2, weight, likelihood = np.empty(m), np.empty(m), np.empty(m), np.empty(SCALES.size)
        reading.compare(chart.values, frame, out, cloud.weight, value, bias, residual, slope2)
        seen = cloud.weight, residual, slope2, bad[0], white, np.array([common, 1.0]), 12.0
        reading.evidence(*seen, SCALES, likelihood)
        reading.weigh(out, cloud.weight, bad[0], residual, slope2, white, common, 12.0, gain, state.mean, weight)
        linearised(out, weight, residual, bias, state.mean)

    rng, about = np.random.default_rng(0), []
    for state, epoch in zip(case.states, case.epochs, strict=True):
        cloud, model = state.cloud, state.model
        assert cloud is not None and model is not None and state.epoch is not None  # noqa: PT018
        found, bias = chart.local_frame(epoch.lat_deg, epoch.lon_deg), model.inertial
        phi, gain = model.transition(state.epoch, epoch).phi, cloud.common[bias] + cloud.common[bias + 1]
        rest = gain, np.array([16.0, 1.0]), np.full((model.size, 2), 0.01)
        about.append((np.stack([found.row, found.col]), phi, bias, model.size, cloud.weight.size, *rest))
    return call


def _textbook(case: Case, starts: Sequence[Plain]) -> Callable[[int], object]:
    """Positions drawn, velocities and bias by their Kalman filter, Gaussian weights, moments: no more than that."""
    chart, velocity, walk, bias = case.filter_.maps[0], 0.25, 1.0, 25.0  # variances
    before = [np.ascontiguousarray(start.rows[:, :5]) for start in starts]

    def call(k: int) -> tuple[FloatArray, FloatArray]:
        epoch, rng, rows = case.epochs[k], np.random.default_rng(k), before[k]
        spread = velocity + walk
        drawn = np.sqrt(spread) * rng.standard_normal((len(rows), 2))
        position = rows[:, :2] + rows[:, 2:4] + drawn
        speed = rows[:, 2:4] + velocity / spread * drawn
        frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg)
        row, col = frame.cells(-position[:, 0], -position[:, 1])
        i, j = row.astype(np.int64), col.astype(np.int64)
        u, v, h = row - i, col - j, chart.values
        low, high = h[i, j] + v * (h[i, j + 1] - h[i, j]), h[i + 1, j] + v * (h[i + 1, j + 1] - h[i + 1, j])
        residual = epoch.measurements[0].value - (low + u * (high - low)) - rows[:, 4]
        variance = bias + SIGMA_M**2
        weight = starts[k].weight * np.exp(-0.5 * residual**2 / variance)
        weight /= weight.sum()
        after = np.column_stack([position, speed, rows[:, 4] + bias / variance * residual])
        mean = weight @ after
        away = position - mean[:2]
        return mean, (weight[:, None] * away).T @ away

    return call

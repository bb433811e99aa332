"""Steps of the navigator along a stream of epochs, through the public estimator, and its kernels alone."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

import terranav as tn
from benchmarks.limits import byte_ns, multiply_add_ns
from benchmarks.marginalized_numpy import Plain, plain_step
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.core.earth import shift
from terranav.core.records import Epoch, Measurement, Prior
from terranav.experiment.demo import demo_scenario
from terranav.experiment.inputs import prepare
from terranav.experiment.registry import make_estimator
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
#: of 6 states, per particle: predicted positions and velocities 8, sums of 8 x 8 with their weights 48 + 12, noise of
#: its own 12, added 18, place in the map 12, blend and slope 14, sums 5, likelihood 45 and regimes 10, means 4, second
#: moments 36 + 12; two normal numbers 60
OPERATIONS = 296
BYTES = 8 * (6 + 2 + 6 + 6 + 6 + 2 + 1 + 6 + 4 + 6)  # arrays of the cloud that are read or written by its passes


@dataclass(frozen=True)
class Case:
    """A filter of `count` particles, its state once the position is known, and epochs with a reading each."""

    filter_: Marginalized
    state: MarginalizedState
    epochs: tuple[Epoch, ...]

    @classmethod
    def of(cls, count: int) -> Case:
        chart = sample_map()
        epochs = _flight(chart, SETTLE + STEPS)
        filter_ = make_estimator("marginalized", [chart], INS, integrity=False, particles=count, least_particles=count)
        assert isinstance(filter_, Marginalized)
        rng = np.random.default_rng(2)
        state = filter_.init(Prior.from_ins(INS), rng)
        for epoch in epochs[:SETTLE]:
            state = filter_.step(state, epoch, rng)
        return cls(filter_, state, epochs[SETTLE:])

    def ours(self) -> MarginalizedState:
        state, rng = self.state, np.random.default_rng(3)
        for epoch in self.epochs:
            state = self.filter_.step(state, epoch, rng)
        return state

    def streamed(self) -> int:
        state, rng, count = self.state, np.random.default_rng(3), 0
        for epoch in self.epochs:  # the loop of `terranav.stream`, begun in the middle
            state = self.filter_.step(state, epoch, rng)
            count += self.filter_.estimate(state).usable
        return count

    def numpy(self, start: Plain, normal: Callable[[Generator, tuple[int, int]], FloatArray]) -> Plain:
        rng = np.random.default_rng(3)
        for epoch in self.epochs:
            start = plain_step(self.filter_, start, epoch, rng, normal)
        return start


def rows() -> list[Row]:
    return [_large(), _streamed(), *_watched()]


def _large() -> Row:
    """100,000 particles, against the same step in numpy; and a smaller one, as in textbooks."""
    count = 100_000
    case = Case.of(count)
    start = Plain.of(case.state)
    mine, plain = case.ours(), case.numpy(start, standard_normal)
    assert mine.cloud is not None
    sigma = np.sqrt(np.diag(plain.cov))
    np.testing.assert_allclose(mine.mean / sigma, plain.mean / sigma, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(mine.cov / np.outer(sigma, sigma), plain.cov / np.outer(sigma, sigma), atol=1e-6)
    np.testing.assert_allclose(mine.cloud.weight * count, plain.weight * count, rtol=1e-6, atol=1e-6)
    calls: dict[str, Callable[[], object]] = {
        "ours": case.ours,
        "numpy": lambda: case.numpy(start, lambda rng, shape: rng.standard_normal(shape)),
        "textbook": _textbook(case, start),
    }
    least = least_ns(calls, STEPS * count, repeats=5)
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
    least = least_ns({"all": case.streamed}, STEPS * count, repeats=25)
    alone = least_ns({"kernels": _kernels(case)}, count, repeats=25)
    work = f"marginalized through the stream, {count:,} particles, step"
    return Row(work, "particle", least["all"], (), Limit("its kernels alone", alone["kernels"], 2.0))


def _watched() -> list[Row]:
    """The shipped demo flight as it is flown by default, and with five epochs of the INS for a reading."""
    scenario = demo_scenario()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recording = tn.simulate(scenario, seed=1001)
        inputs = prepare(recording, scenario.open_maps(), None, None, needs_maps=True)
    built = make_estimator("marginalized", inputs.maps, inputs.ins)
    bare = make_estimator("marginalized", inputs.maps, inputs.ins, integrity=False)
    epochs = inputs.epochs[:1200]
    thin = [one if k % 5 == 0 else replace(one, measurements=()) for k, one in enumerate(epochs)]
    calls = {
        "by default, its monitor watching": partial(_flown, built, inputs.prior, epochs),
        "without its monitor": partial(_flown, bare, inputs.prior, epochs),
        "a reading in every fifth epoch": partial(_flown, built, inputs.prior, thin),
    }
    least = least_ns(calls, len(epochs), repeats=3)
    return [Row(f"marginalized, demo flight, {name}", "epoch", ns) for name, ns in least.items()]


def _flown(estimator: Any, prior: Prior, epochs: Sequence[Epoch]) -> int:
    return sum(one.usable for one in tn.stream(estimator, prior, epochs, np.random.default_rng(4)))


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


def _kernels(case: Case) -> Callable[[], object]:
    """The kernels that one step of the case calls for every particle."""
    state, epoch, chart = case.state, case.epochs[0], case.filter_.maps[0]
    cloud, model = state.cloud, state.model
    assert cloud is not None and model is not None and state.epoch is not None  # noqa: PT018
    found = chart.local_frame(epoch.lat_deg, epoch.lon_deg)
    frame, bias, d, m = np.stack([found.row, found.col]), model.inertial, model.size, cloud.weight.size
    phi, gain = model.transition(state.epoch, epoch).phi, cloud.common[bias] + cloud.common[bias + 1]
    white, common = np.array([16.0, 1.0]), float(gain[bias] + gain[bias + 1])
    value, spread = epoch.measurements[0].value, np.full((d, 2), 0.01)

    def call() -> None:
        noise, out, bad = standard_normal(RNG, (2, m)), np.empty((d, m)), np.empty((1, m))
        kernels.advance(cloud.rows, cloud.weight, state.mean, phi, spread, noise, out)
        kernels.regime(cloud.bad, 0.05, np.array([0.7]), bad)
        reading.reach_of(out)
        residual, slope2, weight, likelihood = np.empty(m), np.empty(m), np.empty(m), np.empty(SCALES.size)
        reading.compare(chart.values, frame, out, cloud.weight, value, bias, residual, slope2)
        about = cloud.weight, residual, slope2, bad[0], white, np.array([common, 1.0]), 12.0
        reading.evidence(*about, SCALES, likelihood)
        reading.weigh(out, cloud.weight, bad[0], residual, slope2, white, common, 12.0, gain, state.mean, weight)
        linearised(out, weight, residual, bias, state.mean)

    return call


RNG = np.random.default_rng(0)


def _textbook(case: Case, start: Plain) -> Callable[[], object]:
    """Positions drawn, velocities and bias by their Kalman filter, Gaussian weights, moments: no more than that."""
    chart = case.filter_.maps[0]
    first = np.ascontiguousarray(start.rows[:, :5])

    def call() -> FloatArray:
        rows, weight, rng = first, start.weight, np.random.default_rng(3)
        cov, mean = np.diag([0.25, 0.25, 25.0]), np.zeros(5)
        for epoch in case.epochs:
            spread = cov[0, 0] + 1.0
            drawn = np.sqrt(spread) * rng.standard_normal((len(rows), 2))
            rows = np.concatenate([
                rows[:, :2] + rows[:, 2:4] + drawn, rows[:, 2:4] + cov[0, 0] / spread * drawn, rows[:, 4:]
            ], axis=1)  # fmt: skip
            frame = chart.local_frame(epoch.lat_deg, epoch.lon_deg)
            row, col = frame.cells(-rows[:, 0], -rows[:, 1])
            i, j = row.astype(np.int64), col.astype(np.int64)
            u, v, h = row - i, col - j, chart.values
            low, high = h[i, j] + v * (h[i, j + 1] - h[i, j]), h[i + 1, j] + v * (h[i + 1, j + 1] - h[i + 1, j])
            residual = epoch.measurements[0].value - (low + u * (high - low)) - rows[:, 4]
            variance = cov[2, 2] + SIGMA_M**2
            weight = weight * np.exp(-0.5 * residual**2 / variance)
            weight = weight / weight.sum()
            rows[:, 4] += cov[2, 2] / variance * residual
            mean = weight @ rows
            away = rows[:, :2] - mean[:2]
            mean[:2] += 0.0 * ((weight[:, None] * away).T @ away)[0]
        return mean

    return call

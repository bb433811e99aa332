"""The navigator alone: the Kalman filter on a plane, flat land, wrong models, several maps, and the laws of states."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.stats import cauchy, norm

from terranav.core.earth import offset_of, shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS
from terranav.core.records import Epoch, Innovation, Measurement, Prior, Status
from terranav.experiment.stream import states
from terranav.filters._cloud import covered_area, drawn, gaussian_area, prior_area, resampled
from terranav.filters.marginalized import Marginalized, MarginalizedState
from terranav.ins.error_state import ErrorModel
from terranav.kernels.marginalized import moments
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

INS = InsGrade(300.0, 0.5, 1.0, 0.01)
STEP_S, SPEED_MPS, SIGMA = 2.0, 50.0, 4.0
SETTLED = 60  # epochs after which every run below has a fix

#: the INS and the noise as told: nothing that is learned changes the model
TOLD: dict[str, Any] = {key.name: False for key in fields(Marginalized) if key.name.startswith("adapt_")}
#: and linear and Gaussian on a plane
LINEAR: dict[str, Any] = {"outlier_share": 0.0, "blur_cells": 0.0, "registration_cells": 0.0, **TOLD}


@dataclass(frozen=True)
class Run:
    """What a filter said, epoch by epoch, and by how much it was off."""

    states: list[MarginalizedState]
    miss_m: FloatArray
    cov_m2: FloatArray

    @property
    def nees(self) -> FloatArray:
        """(n,) of both axes together: 2 on average for an honest filter."""
        return np.asarray(np.einsum("ki,kij,kj->k", self.miss_m, np.linalg.inv(self.cov_m2), self.miss_m))

    @property
    def rms_m(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.miss_m[SETTLED:] ** 2, axis=1))))

    def innovations(self, number: int = 0) -> list[Innovation]:
        return [state.innovations[number] for state in self.states]


@dataclass(frozen=True)
class Track:
    """Epochs, and the true INS error at each."""

    epochs: list[Epoch]
    error_m: FloatArray

    def run(self, filter_: Marginalized, seed: int = 0, prior: Prior | None = None) -> Run:
        start = Prior.from_ins(filter_.ins) if prior is None else prior
        seen = list(states(filter_, start, self.epochs, np.random.default_rng(seed)))
        told = [filter_.estimate(state) for state in seen]
        miss = np.array([one.ins_error_m for one in told]) - self.error_m
        return Run(seen, miss, np.array([one.cov_m2 for one in told]))


def track(
    charts: Sequence[Map],
    seed: int,
    *,
    count: int = 200,
    ins: InsGrade = INS,
    told: float = 1.0,
    bias: float = 0.0,
    wrong: Callable[[Generator, int], FloatArray] | None = None,
) -> Track:
    """A straight flight over the middle of the maps, INS and map errors drawn from the model that the filter has.

    The noise of readings is SIGMA; they claim `told` times that. The first map's have a common bias, and `wrong` adds
    whatever else is wrong with them.
    """
    rng = np.random.default_rng([seed, 7])
    along = SPEED_MPS * STEP_S * (np.arange(count) - 0.5 * count)
    heading = rng.uniform(0.0, 2.0 * np.pi)
    lat, lon = shift(*charts[0].centre_deg, along * np.cos(heading), along * np.sin(heading))
    p, v = rng.normal(0.0, ins.position_sigma_m, 2), rng.normal(0.0, ins.velocity_sigma_mps, 2)
    error = np.empty((count, 2))
    for k in range(count):
        error[k] = p
        after = v + ins.velocity_walk_mps_per_sqrt_s * math.sqrt(STEP_S) * rng.standard_normal(2)
        walk = ins.position_walk_m_per_sqrt_s * math.sqrt(STEP_S) * rng.standard_normal(2)
        p, v = p + 0.5 * STEP_S * (v + after) + walk, after
    readings = []
    for chart in charts:
        keep = math.exp(-SPEED_MPS * STEP_S / chart.error_length_m)
        patch = np.empty(count)
        patch[0] = chart.sigma * rng.standard_normal()
        for k in range(1, count):
            patch[k] = keep * patch[k - 1] + chart.sigma * math.sqrt(1.0 - keep**2) * rng.standard_normal()
        readings.append(chart.sample(lat, lon) + patch + SIGMA * rng.standard_normal(count))
    readings[0] = readings[0] + bias
    if wrong is not None:
        readings[0] = readings[0] + wrong(rng, count)
    told_lat, told_lon = shift(lat, lon, *error.T)
    epochs = [
        Epoch(
            STEP_S * k,
            float(told_lat[k]),
            float(told_lon[k]),
            2000.0,
            measurements=tuple(
                Measurement(chart.kind, float(value[k]), told * SIGMA)
                for chart, value in zip(charts, readings, strict=True)
            ),
        )
        for k in range(count)
    ]
    return Track(epochs, error)


def silent(epochs: Sequence[Epoch]) -> list[Epoch]:
    return [replace(epoch, measurements=()) for epoch in epochs]


def kalman(filter_: Marginalized, epochs: Sequence[Epoch], prior: Prior) -> list[tuple[FloatArray, FloatArray]]:
    """Mean and covariance of all states after each epoch on planes, where a Kalman filter is exact."""
    charts = filter_.maps
    model = ErrorModel(filter_.ins, charts)
    x, cov = np.zeros(model.size), model.initial_covariance(prior.cov_m2)
    x[:2] = prior.mean_m
    found = []
    for k, epoch in enumerate(epochs):
        if k:
            passed = model.transition(epochs[k - 1], epoch)
            x, cov = passed.phi @ x, passed.phi @ cov @ passed.phi.T + passed.q
        for reading in epoch.measurements:
            chart = next(one for one in charts if one.kind == reading.kind)
            at = float(chart.sample(epoch.lat_deg, epoch.lon_deg))
            h = np.zeros(model.size)
            for axis, (north, east) in enumerate(((-64.0, 0.0), (0.0, -64.0))):
                place = shift(epoch.lat_deg, epoch.lon_deg, north, east)
                h[axis] = (float(chart.sample(*place)) - at) / 64.0
            h[model.bias_index(chart.kind) : model.bias_index(chart.kind) + 2] = 1.0
            variance = h @ cov @ h + reading.sigma**2
            gain = cov @ h / variance
            x = x + gain * (reading.value - at - h @ x)
            cov = cov - np.outer(gain, gain) * variance
        found.append((x, cov))
    return found


@pytest.fixture(scope="module")
def hills() -> Map:
    return gaussian_map(np.random.default_rng(2), std=120.0, correlation_m=900.0, cells=257, cell_m=100.0, sigma=1.0)


@pytest.fixture(scope="module")
def wide_hills() -> Map:
    return gaussian_map(np.random.default_rng(2), std=120.0, correlation_m=900.0, cells=512, cell_m=100.0, sigma=1.0)


@pytest.fixture(scope="module")
def plane() -> Map:
    return plane_map(0.25, -0.125, cells=513, cell_m=64.0, sigma=3.0)


@pytest.fixture(scope="module")
def gravity_plane() -> Map:
    return plane_map(-0.0625, -0.125, cells=513, cell_m=64.0, sigma=2.0, kind="gravity", height=10.0)


def uneven(epochs: Sequence[Epoch]) -> list[Epoch]:
    """Some epochs without readings, one twice at the same time, one after a gap."""
    out = [replace(epoch, measurements=()) if k % 4 == 2 else epoch for k, epoch in enumerate(epochs)]
    out.insert(5, out[4])
    return [*out[:8], *out[11:]]


class TestOnAPlane:
    """All is linear and Gaussian there: the full-state Kalman filter is exact."""

    def test_is_the_kalman_filter_of_all_states_as_one_over_root_n(self, plane: Map) -> None:
        epochs = uneven(track([plane], 1, count=24).epochs)
        prior = Prior.from_ins(INS)
        sizes, rms, spread = (1000, 4000, 16000), [], []
        for count in sizes:
            filter_ = Marginalized((plane,), INS, particles=count, least_particles=count, **LINEAR)
            mean, cov = kalman(filter_, epochs, prior)[-1]
            whiten = np.linalg.inv(np.linalg.cholesky(cov))
            misses, covs = [], []
            for seed in range(10):
                *_, state = states(filter_, prior, epochs, np.random.default_rng(seed))
                misses.append(whiten @ (state.mean - mean))
                covs.append(whiten @ state.cov @ whiten.T)
            rms.append(float(np.sqrt(np.mean(np.square(misses)))))
            spread.append(np.mean(covs, axis=0))
        assert np.polyfit(np.log(sizes), np.log(rms), 1)[0] < -0.3
        assert rms[-1] < 0.03  # sigmas
        np.testing.assert_allclose(spread[-1], np.eye(6), atol=0.03)

    def test_two_maps_multiply(self, plane: Map, gravity_plane: Map) -> None:
        epochs = uneven(track([plane, gravity_plane], 2, count=24).epochs)
        prior = Prior(np.array([40.0, -80.0]), np.array([[9e4, 2e4], [2e4, 4e4]]))
        filter_ = Marginalized((plane, gravity_plane), INS, least_particles=16000, **LINEAR)
        mean, cov = kalman(filter_, epochs, prior)[-1]
        alone = kalman(replace(filter_, maps=(plane,)), [
            replace(epoch, measurements=epoch.measurements[:1]) for epoch in epochs
        ], prior)[-1][1]  # fmt: skip
        assert np.linalg.eigvalsh(cov[:2, :2])[1] < 0.5 * np.linalg.eigvalsh(alone[:2, :2])[1]
        whiten = np.linalg.inv(np.linalg.cholesky(cov))
        misses, covs = [], []
        for seed in range(6):
            *_, state = states(filter_, prior, epochs, np.random.default_rng(seed))
            misses.append(whiten @ (state.mean - mean))
            covs.append(whiten @ state.cov @ whiten.T)
        assert np.sqrt(np.mean(np.square(misses))) < 0.04
        np.testing.assert_allclose(np.mean(covs, axis=0), np.eye(8), atol=0.05)

    def test_with_an_ins_that_does_not_drift_at_all(self) -> None:
        """Its position is never drawn anew, yet the map's error below changes along the track."""
        chart = plane_map(0.25, -0.125, cells=513, cell_m=64.0, sigma=6.0)
        still = InsGrade(300.0, 0.0, 0.0)
        epochs = track([chart], 3, count=30, ins=still).epochs
        filter_, prior = Marginalized((chart,), still, least_particles=16000, **LINEAR), Prior.from_ins(still)
        mean, cov = kalman(filter_, epochs, prior)[-1]
        moving = [0, 1, 4, 5]
        whiten = np.linalg.inv(np.linalg.cholesky(cov[np.ix_(moving, moving)]))
        ran = [list(states(filter_, prior, epochs, np.random.default_rng(seed)))[-1] for seed in range(4)]
        misses = [whiten @ (state.mean - mean)[moving] for state in ran]
        spread = np.mean([whiten @ state.cov[np.ix_(moving, moving)] @ whiten.T for state in ran], axis=0)
        assert np.sqrt(np.mean(np.square(misses))) < 0.06
        np.testing.assert_allclose(spread, np.eye(4), atol=0.06)


class TestWithoutReadings:
    def test_mean_and_covariance_are_the_models(self, plane: Map) -> None:
        prior = Prior(np.array([40.0, -80.0]), np.array([[9e4, 2e4], [2e4, 4e4]]))
        filter_ = Marginalized((plane,), INS, **TOLD)
        epochs = silent(track([plane], 1, count=40).epochs)
        for state, (mean, cov) in zip(
            states(filter_, prior, epochs, np.random.default_rng(1)), kalman(filter_, epochs, prior), strict=True
        ):
            np.testing.assert_allclose(state.mean, mean, rtol=1e-9, atol=1e-6)
            np.testing.assert_allclose(state.cov, cov, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(state.unaided, cov, rtol=1e-9, atol=1e-9)
            told = filter_.estimate(state)
            np.testing.assert_allclose(told.cov_m2, cov[:2, :2], rtol=1e-9)
            assert told.status is Status.SEARCHING
            assert state.innovations == ()

    def test_an_epoch_split_in_two_is_one(self, plane: Map) -> None:
        whole = silent(track([plane], 1, count=12).epochs)
        split = [whole[0]]
        for before, after in pairwise(whole):
            split.append(replace(
                after,
                time_s=0.5 * (before.time_s + after.time_s),
                lat_deg=0.5 * (before.lat_deg + after.lat_deg),
                lon_deg=0.5 * (before.lon_deg + after.lon_deg),
            ))  # fmt: skip
            split.append(after)
        filter_, prior = Marginalized((plane,), INS, **TOLD), Prior.from_ins(INS)
        *_, one = states(filter_, prior, whole, np.random.default_rng(1))
        *_, other = states(filter_, prior, split, np.random.default_rng(1))
        np.testing.assert_allclose(other.mean, one.mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(other.cov, one.cov, rtol=1e-6, atol=1e-9)
        assert one.pending is not None
        assert other.pending is not None
        np.testing.assert_allclose(other.pending.q, one.pending.q, rtol=1e-6, atol=1e-9)

    def test_what_is_pending_is_drawn_at_the_next_reading_with_its_exact_moments(self, plane: Map) -> None:
        epochs = track([plane], 1, count=12).epochs
        epochs = [*silent(epochs[:-1]), epochs[-1]]
        filter_, prior = Marginalized((plane,), INS, **LINEAR), Prior(np.array([40.0, -80.0]), np.diag([9e4, 4e4]))
        generator = np.random.default_rng(1)
        *_, waiting = states(filter_, prior, epochs[:-1], generator)
        shown = filter_.posterior(waiting)
        assert shown.weight @ shown.north_m == pytest.approx(waiting.mean[0])
        assert shown.weight @ shown.east_m == pytest.approx(waiting.mean[1])
        unused = filter_.step(filter_.excluding(waiting, frozenset({"terrain"})), epochs[-1], generator)
        mean, cov = kalman(filter_, silent(epochs), prior)[-1]
        assert unused.cloud is not None
        assert unused.pending is None
        found, spread = moments(unused.cloud.rows, unused.cloud.weight)
        np.testing.assert_allclose(found, mean, atol=1e-6)
        np.testing.assert_allclose(spread + unused.cloud.common, cov, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(unused.cov, cov, rtol=1e-9, atol=1e-9)

    def test_a_gap_after_readings_moves_the_posterior_with_the_velocity_found(self, hills: Map) -> None:
        flown = track([hills], 1, count=100)
        filter_, prior = Marginalized((hills,), INS, **TOLD), Prior.from_ins(INS)
        *_, state = states(filter_, prior, flown.epochs, np.random.default_rng(1))
        later = replace(flown.epochs[-1], time_s=flown.epochs[-1].time_s + 600.0, measurements=())
        after = filter_.step(state, later, np.random.default_rng(1))
        assert np.hypot(*(after.mean[:2] - state.mean[:2])) > 60.0
        np.testing.assert_allclose(after.mean[:2], state.mean[:2] + 600.0 * state.mean[2:4], rtol=1e-9)
        shown = filter_.posterior(after)
        mean = [shown.weight @ shown.north_m, shown.weight @ shown.east_m]
        np.testing.assert_allclose(mean, after.mean[:2], atol=6.0)  # resampling keeps it in expectation
        *_, (_, cov) = kalman(filter_, silent([*flown.epochs, later]), prior)
        np.testing.assert_allclose(after.unaided, cov, rtol=1e-9, atol=1e-9)

    def test_no_time_changes_nothing(self, hills: Map) -> None:
        flown = track([hills], 1, count=20)
        filter_ = Marginalized((hills,), INS)
        *_, state = states(filter_, Prior.from_ins(INS), flown.epochs, np.random.default_rng(1))
        again = filter_.step(state, replace(flown.epochs[-1], measurements=()), np.random.default_rng(2))
        np.testing.assert_array_equal(again.mean, state.mean)
        np.testing.assert_allclose(again.cov, state.cov, rtol=1e-14)
        assert again.innovations == ()
        off = replace(flown.epochs[-1], measurements=(Measurement("magnetic", 1.0, 1.0),))
        np.testing.assert_array_equal(filter_.step(state, off, np.random.default_rng(2)).mean, state.mean)


@pytest.mark.parametrize("off", [0.0, 12.0, 35.0, 50.0, 70.0, 200.0])
def test_a_reading_is_good_or_bad_and_the_bias_has_the_moments_of_both(off: float) -> None:
    """Over a level map there is nothing but the bias and the patch: their mixture of two normal densities is exact."""
    chart = plane_map(0.0, 0.0, cells=65, cell_m=64.0, sigma=3.0)
    filter_ = Marginalized((chart,), INS, outlier_share=0.2, **TOLD)
    told = Epoch(0.0, 0.0, 0.0, 2000.0, measurements=(Measurement("terrain", 100.0 + off, SIGMA),))
    generator = np.random.default_rng(1)
    state = filter_.step(filter_.init(Prior.from_ins(INS), generator), told, generator)
    bias, patch = KINDS["terrain"].bias_sigma ** 2, chart.sigma**2
    total, reach = bias + patch + SIGMA**2, filter_.outlier_scale * math.hypot(SIGMA, chart.sigma)
    near = 0.8 * norm.pdf(off, scale=math.sqrt(total))
    good = near / (near + 0.2 * cauchy.pdf(off, scale=reach))
    for index, variance in ((4, bias), (5, patch)):
        moved = variance / total * off
        assert state.mean[index] == pytest.approx(good * moved, abs=1e-6)
        spread = variance - good * variance**2 / total + good * (1.0 - good) * moved**2
        assert state.cov[index, index] == pytest.approx(spread, rel=1e-6)


def test_a_coarse_cloud_sees_the_terrain_as_coarsely_as_it_can(plane: Map) -> None:
    """On a plane a particle that stands for a square of ground sees a reading with the heights of that square."""
    coarse = InsGrade(3000.0, 0.0, 0.0)
    prior = Prior.from_ins(coarse)
    filter_ = Marginalized((plane,), coarse, particles=1000, least_particles=1000, **LINEAR)
    epoch = Epoch(0.0, 0.0, 0.0, 2000.0, measurements=(Measurement("terrain", 100.0, SIGMA),))
    slope = np.array([0.25, -0.125])
    along, bias = slope / np.linalg.norm(slope), KINDS["terrain"].bias_sigma ** 2 + plane.sigma**2
    ground = prior_area(prior) / 1000 / 12.0  # variance of a place within the square [m^2]
    assert ground * slope @ slope > 60.0 * SIGMA**2
    for_readings = (bias + SIGMA**2) / (slope @ slope) + ground
    expected = 1.0 / (1.0 / 3000.0**2 + 1.0 / for_readings)
    found = []
    for seed in range(30):
        generator = np.random.default_rng(seed)
        state = filter_.step(filter_.init(prior, generator), epoch, generator)
        found.append(along @ state.cov[:2, :2] @ along)
    assert np.mean(found) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(("particles", "tolerance"), [(4000, 0.006), (32_000, 0.002)])
def test_flat_land_teaches_nothing_of_the_position(particles: int, tolerance: float) -> None:
    """The mean is exact; the covariance is so but for what chance correlates velocities and positions of particles."""
    chart = plane_map(0.0, 0.0, cells=513, cell_m=64.0, sigma=3.0)
    prior = Prior(np.array([40.0, -80.0]), np.diag([9e4, 4e4]))

    def noisy(rng: Generator, count: int) -> FloatArray:
        return np.where(rng.random(count) < 0.1, 300.0, 8.0 * rng.standard_normal(count))

    filter_ = Marginalized((chart,), INS, particles=particles, least_particles=particles)
    for wrong in (None, noisy):
        epochs = track([chart], 1, count=100, wrong=wrong).epochs
        for state in states(filter_, prior, epochs, np.random.default_rng(1)):
            whiten = np.linalg.inv(np.linalg.cholesky(state.unaided[:2, :2]))
            estimate = filter_.estimate(state)
            kept = np.linalg.eigvalsh(whiten @ estimate.cov_m2 @ whiten.T)
            assert kept[0] > 1.0 - tolerance
            assert kept[1] < 1.0 + tolerance
            np.testing.assert_allclose(estimate.ins_error_m, prior.mean_m, atol=1e-3)
            assert estimate.status is not Status.CONVERGED
        assert state.cov[4, 4] < 0.2 * KINDS["terrain"].bias_sigma ** 2  # but the bias is learned


@pytest.mark.parametrize("seed", range(9))
def test_a_prior_of_kilometres_loses_no_truth(wide_hills: Map, seed: int) -> None:
    coarse = InsGrade(3000.0, 0.5, 1.0, 0.01)
    filter_ = Marginalized((wide_hills,), coarse)
    flown = track([wide_hills], seed, count=150, ins=coarse)
    run = flown.run(filter_, seed)
    counts = []
    for state, error in zip(run.states, flown.error_m, strict=True):
        shown = filter_.posterior(state)
        near = np.hypot(shown.north_m - error[0], shown.east_m - error[1]) < 5.0 * wide_hills.cell_m
        assert shown.weight[near].sum() > 1e-6
        counts.append(shown.weight.size)
    assert counts[0] == filter_.particles
    assert counts[-1] == filter_.least_particles
    assert np.hypot(*run.miss_m[-1]) < wide_hills.cell_m
    assert run.nees[SETTLED:].mean() <= 4.0
    assert run.nees[-1] < 13.8  # 99.9 % of chi-square with two degrees of freedom
    assert filter_.estimate(run.states[-1]).status is Status.CONVERGED


class TestNoise:
    """How noisy readings prove against what is told; the map is exact, so that the truth is the sensor's alone."""

    @pytest.mark.parametrize(("told", "scale", "within"), [(0.5, 2.0, 0.25), (1.0, 1.0, 0.15), (2.0, 0.5, 0.25)])
    def test_scale_is_found(self, hills: Map, told: float, scale: float, within: float) -> None:
        exact = replace(hills, sigma=0.0)
        filter_ = Marginalized((exact,), INS, blur_cells=0.0)
        for seed in range(4):
            found = track([exact], seed, told=told).run(filter_, seed).innovations()[-1].scale
            assert found == pytest.approx(scale, rel=within)

    def test_readings_twice_as_noisy_as_told_leave_it_honest(self, hills: Map) -> None:
        filters = [Marginalized((hills,), INS), Marginalized((hills,), INS, outlier_share=0.0, **TOLD)]
        honest, plain = ([
            track([hills], seed, told=0.5).run(filter_, seed).nees[SETTLED:].mean() for seed in range(8)
        ] for filter_ in filters)  # fmt: skip
        assert np.mean(honest) <= 3.0
        assert np.mean(plain) > 1.5 * np.mean(honest)  # what it would be as told

    def test_as_told_without_adaptation(self, hills: Map) -> None:
        run = track([hills], 1, count=40, told=0.5).run(Marginalized((hills,), INS, adapt_noise=False), 1)
        assert {one.scale for one in run.innovations()} == {1.0}


class TestWrongReadings:
    def nees(
        self, hills: Map, wrong: Callable[[Generator, int], FloatArray], share: float = 0.05, seeds: int = 8
    ) -> FloatArray:
        filter_ = Marginalized((hills,), INS, outlier_share=share)
        return np.array([track([hills], seed, wrong=wrong).run(filter_, seed).nees for seed in range(seeds)])

    def test_one_wrong_patch_leaves_the_error_inside_the_claim(self, hills: Map) -> None:
        def patch(rng: Generator, count: int) -> FloatArray:
            return np.where((np.arange(count) >= 100) & (np.arange(count) < 106), 15.0, 0.0)

        found = self.nees(hills, patch)[:, 106:]
        assert found[:, :10].mean() <= 4.5
        assert found.mean() <= 3.0
        assert (found < 5.99).mean() > 0.88  # of regions that claim 95 %

    @pytest.mark.parametrize("clustered", [False, True])
    def test_outliers_are_found(self, hills: Map, clustered: bool) -> None:
        def outliers(rng: Generator, count: int) -> FloatArray:
            out = np.zeros(count)
            if clustered:
                for first in (40, 90, 140):
                    out[first : first + 4] = 200.0 * rng.choice([-1, 1])
            else:
                out[rng.choice(np.arange(20, count), count // 20, replace=False)] = 200.0
                out *= rng.choice([-1, 1], count)
            return out

        assert self.nees(hills, outliers)[:, SETTLED:].mean() <= 3.0
        assert self.nees(hills, outliers, 0.0, 4)[:, SETTLED:].mean() > 6.0  # what they do to a Gaussian likelihood

    def test_particles_say_where_the_map_is_wrong(self, hills: Map) -> None:
        def cluster(rng: Generator, count: int) -> FloatArray:
            return np.where((np.arange(count) >= 100) & (np.arange(count) < 104), 200.0, 0.0)

        run = track([hills], 1, wrong=cluster).run(Marginalized((hills,), INS), 1)
        clouds = [state.cloud for state in run.states if state.cloud is not None]
        bad = np.array([float(cloud.weight @ cloud.bad[0]) for cloud in clouds])
        assert bad[100:104].min() > 0.9
        assert bad[60:100].mean() < 0.1
        assert bad[120:].mean() < 0.1


def test_a_bias_of_thirty_metres_costs_little_and_is_found(hills: Map) -> None:
    filter_ = Marginalized((hills,), INS)
    without, with_, off = [], [], []
    for seed in range(10):
        without.append(track([hills], seed).run(filter_, seed).rms_m)
        run = track([hills], seed, bias=30.0).run(filter_, seed)
        with_.append(run.rms_m)
        last = run.states[-1]
        off.append((last.mean[4] - 30.0) / math.sqrt(last.cov[4, 4]))
    assert np.sqrt(np.mean(np.square(with_)) / np.mean(np.square(without))) <= 1.10
    assert np.abs(off).max() < 3.0


class TestExcluded:
    def test_says_so_and_changes_nothing(self, hills: Map) -> None:
        gravity = gaussian_map(
            np.random.default_rng(5), std=20.0, correlation_m=2000.0, cells=257, cell_m=100.0, sigma=1.0, kind="gravity"
        )
        epochs = track([hills, gravity], 1, count=40).epochs
        absurd = [
            replace(epoch, measurements=(epoch.measurements[0], Measurement("gravity", 900.0, 1.0))) for epoch in epochs
        ]
        filter_, kinds = Marginalized((hills, gravity), INS), frozenset({"gravity"})
        results = []
        for flown in (epochs, absurd):
            generator = np.random.default_rng(1)
            state = filter_.excluding(filter_.init(Prior.from_ins(INS), generator), kinds)
            for epoch in flown:
                state = filter_.step(state, epoch, generator)
                terrain, other = state.innovations
                assert (terrain.kind, terrain.used) == ("terrain", True)
                assert (other.kind, other.used) == ("gravity", False)
            assert other.variance > other.noise > 0.0
            results.append(state)
        assert results[1].innovations[1].residual > 300.0
        assert results[0].judgement == results[1].judgement
        np.testing.assert_array_equal(results[0].mean, results[1].mean)
        np.testing.assert_array_equal(results[0].cov, results[1].cov)
        np.testing.assert_array_equal(results[0].scale, results[1].scale)

    def test_alone_it_leaves_the_covariance_to_the_ins(self, hills: Map) -> None:
        flown = track([hills], 1, count=20)
        filter_ = Marginalized((hills,), INS, **TOLD)
        generator, prior = np.random.default_rng(1), Prior.from_ins(INS)
        state = filter_.excluding(filter_.init(prior, generator), frozenset({"terrain"}))
        for epoch, (mean, cov) in zip(flown.epochs, kalman(filter_, silent(flown.epochs), prior), strict=True):
            state = filter_.step(state, epoch, generator)
            np.testing.assert_allclose(state.mean, mean, atol=1e-6)
            np.testing.assert_allclose(state.cov, cov, rtol=1e-9, atol=1e-9)


class TestRegistration:
    """The place of the map as a whole, which no reading tells from an INS error."""

    def added(self, chart: Map, **settings: Any) -> tuple[Run, FloatArray]:
        """What is given out over the state's own covariance at each epoch [m^2]."""
        run = track([chart], 1, count=80).run(Marginalized((chart,), INS, **settings), 1)
        own = np.array([state.cov[:2, :2] for state in run.states])
        return run, run.cov_m2 - own

    def test_none_for_a_map_without_error_or_a_place_that_is_known(self, hills: Map) -> None:
        for chart, settings in ((replace(hills, sigma=0.0), {}), (hills, {"registration_cells": 0.0})):
            np.testing.assert_allclose(self.added(chart, **settings)[1], 0.0, atol=1e-6)

    def test_is_part_of_a_cell_at_most(self, hills: Map) -> None:
        coarse = replace(hills, sigma=40.0)
        _, more = self.added(coarse, registration_cells=0.2)
        assert (more[:, 0, 0] <= (0.2 * hills.cell_m) ** 2).all()
        assert more[-1, 0, 0] == pytest.approx((0.2 * hills.cell_m) ** 2, rel=0.2)
        np.testing.assert_allclose(more[:, 0, 1], 0.0, atol=1e-6)
        np.testing.assert_allclose(more[:, 0, 0], more[:, 1, 1], atol=1e-6)

    def test_is_bounded_by_what_shows_on_the_slopes(self, hills: Map) -> None:
        run, more = self.added(hills, registration_cells=100.0)
        slope2 = np.array([state.slope2[0] for state in run.states])
        assert (more[:, 0, 0] <= 0.5 * hills.sigma**2 / slope2 * (1 + 1e-9)).all()
        assert more[-1, 0, 0] == pytest.approx(0.5 * hills.sigma**2 / slope2[-1], rel=0.02)
        met = hills.gradient([epoch.lat_deg for epoch in track([hills], 1, count=80).epochs], [
            epoch.lon_deg for epoch in track([hills], 1, count=80).epochs
        ])  # fmt: skip
        assert slope2[-1] == pytest.approx(np.mean(met[0] ** 2 + met[1] ** 2), rel=0.5)

    def test_not_before_there_is_information(self) -> None:
        flat = plane_map(0.0, 0.0, cells=513, cell_m=64.0, sigma=3.0)
        assert self.added(flat)[1].max() < 0.01 * (0.29 * 64.0) ** 2  # of what it is once there is
        filter_ = Marginalized((flat,), INS)
        first = filter_.step(
            filter_.init(Prior.from_ins(INS), np.random.default_rng(1)),
            silent(track([flat], 1, count=2).epochs)[0],
            np.random.default_rng(1),
        )
        np.testing.assert_allclose(filter_.estimate(first).cov_m2, 9e4 * np.eye(2), rtol=1e-9, atol=1e-6)


class TestRestarted:
    def test_forgets_the_position_and_keeps_the_noise(self, hills: Map) -> None:
        flown = track([hills], 1, told=0.5)
        filter_, generator = Marginalized((hills,), INS), np.random.default_rng(1)
        *_, state = states(filter_, Prior.from_ins(INS), flown.epochs[:150], generator)
        state = filter_.excluding(state, frozenset({"gravity"}))
        prior = Prior(np.array([700.0, -400.0]), np.diag([250.0**2, 150.0**2]))
        again = filter_.restarted(state, prior, generator)
        np.testing.assert_allclose(again.mean[:2], prior.mean_m, atol=1e-6)
        model = ErrorModel(INS, (hills,))
        np.testing.assert_allclose(again.cov, model.initial_covariance(prior.cov_m2), rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(again.unaided, model.initial_covariance(prior.cov_m2))
        np.testing.assert_allclose(again.mean[2:], 0.0, atol=1e-9)
        np.testing.assert_array_equal(again.scale, state.scale)
        assert np.ptp(again.scale) > 0.5
        assert again.excluded == {"gravity"}
        assert again.epoch is state.epoch
        assert filter_.estimate(again).time_s == flown.epochs[149].time_s
        for epoch in flown.epochs[150:]:
            after = filter_.step(again, epoch, generator)
            assert after.epoch is epoch
            again = after
        assert again.excluded == {"gravity"}

    def test_finds_the_position_again(self, hills: Map) -> None:
        flown = track([hills], 2)
        filter_, generator = Marginalized((hills,), INS), np.random.default_rng(1)
        *_, state = states(filter_, Prior.from_ins(INS), flown.epochs[:20], generator)
        prior = Prior(flown.error_m[20] + [400.0, -300.0], np.diag([500.0**2, 500.0**2]))
        state = filter_.restarted(state, prior, generator)
        for epoch in flown.epochs[20:]:
            state = filter_.step(state, epoch, generator)
        found = filter_.estimate(state)
        miss = found.ins_error_m - flown.error_m[-1]
        assert np.hypot(*miss) < hills.cell_m
        assert miss @ np.linalg.solve(found.cov_m2, miss) < 13.8

    def test_before_the_first_epoch_it_is_another_prior(self, hills: Map) -> None:
        filter_, generator = Marginalized((hills,), INS), np.random.default_rng(1)
        prior = Prior(np.array([70.0, -40.0]), np.diag([2500.0, 900.0]))
        state = filter_.restarted(filter_.init(Prior.from_ins(INS), generator), prior, generator)
        state = filter_.step(state, silent(track([hills], 1, count=2).epochs)[0], generator)
        np.testing.assert_allclose(state.mean[:2], prior.mean_m, atol=1e-6)
        np.testing.assert_allclose(state.cov[:2, :2], prior.cov_m2, rtol=1e-9, atol=1e-9)


GRADES = {
    "schuler": InsGrade(
        300.0, 0.5, 1.0, attitude_sigma_deg=0.01, gyro_bias_sigma_deg_per_h=0.02, accel_bias_sigma_ug=50.0
    ),
    "strapdown": InsGrade(
        300.0, 0.5, 1.0, attitude_sigma_deg=0.01, heading_sigma_deg=0.05, gyro_bias_sigma_deg_per_h=0.02,
        accel_bias_sigma_ug=50.0, gyro_walk_deg_per_sqrt_h=0.002, accel_walk_mps_per_sqrt_h=0.01,
    ),
}  # fmt: skip


@pytest.mark.parametrize(("level", "size"), [("schuler", 10), ("strapdown", 15)])
def test_carries_the_inertial_states(hills: Map, level: str, size: int) -> None:
    ins = GRADES[level]
    flown = track([hills], 1, count=120)
    epochs = flown.epochs
    if level == "strapdown":
        north, east = offset_of(*(getattr(epochs[k], at) for k in (0, -1) for at in ("lat_deg", "lon_deg")))
        span, heading = epochs[-1].time_s, math.degrees(math.atan2(east, north))
        epochs = [
            replace(epoch, velocity_mps=(north / span, east / span, 0.0), attitude_deg=(0.0, 0.0, heading))
            for epoch in epochs
        ]
    filter_ = Marginalized((hills,), ins)
    run = Track(epochs, flown.error_m).run(filter_, 1)
    last = run.states[-1]
    assert last.model is not None
    assert last.model.level == level
    assert last.mean.shape == (size,)
    assert np.isfinite(last.cov).all()
    assert np.linalg.eigvalsh(last.cov / np.sqrt(np.outer(*[np.diag(last.cov)] * 2)))[0] > -1e-9
    assert run.nees[-1] < 13.8
    assert np.hypot(*run.miss_m[-1]) < hills.cell_m
    assert last.cov[2, 2] < 0.5 * last.unaided[2, 2]
    *_, silence = states(replace(filter_, **TOLD), Prior.from_ins(ins), silent(epochs), np.random.default_rng(1))
    model, cov = last.model, last.model.initial_covariance(9e4 * np.eye(2))
    for before, after in pairwise(epochs):
        passed = model.transition(before, after)
        cov = passed.phi @ cov @ passed.phi.T + passed.q
    np.testing.assert_allclose(silence.cov[:2, :2], cov[:2, :2], rtol=1e-9, atol=1e-6)


class TestCloud:
    @pytest.mark.parametrize("shape", ["gaussian", "uniform"])
    def test_starts_with_the_moments_of_the_prior(self, shape: Any) -> None:
        cov = np.array([[900.0, 200.0], [200.0, 400.0]]) if shape == "gaussian" else np.diag([900.0, 400.0])
        prior = Prior(np.array([10.0, -20.0]), cov, shape)
        common = np.diag([0.0, 0.0, 1.0, 1.0])
        cloud = drawn(prior, common, 5000, np.array([0.05]), np.random.default_rng(1))
        mean, spread = moments(cloud.rows, cloud.weight)
        np.testing.assert_allclose(mean, [10.0, -20.0, 0.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(spread[:2, :2], cov if shape == "gaussian" else 3.0 * cov, rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(cloud.rows[2:], 0.0)
        np.testing.assert_array_equal(cloud.bad, 0.05)
        if shape == "uniform":
            away = cloud.rows[:2].T - prior.mean_m
            assert np.abs(away / np.sqrt(np.diag(cov))).max() < 3.05
            counts = np.histogram2d(away[:, 0], away[:, 1], bins=5, range=[(-90, 90), (-60, 60)])[0]
            np.testing.assert_allclose(counts, 200.0, rtol=0.1)  # evenly spread: chance alone would leave 7 % rms
        assert covered_area(cloud) == pytest.approx(prior_area(prior), rel=0.2)
        assert cloud.spacing_m == pytest.approx(math.sqrt(prior_area(prior) / 5000))

    def test_area_of_priors(self) -> None:
        assert prior_area(Prior(np.zeros(2), np.diag([4.0, 9.0]), "uniform")) == pytest.approx(12.0 * 18.0)
        assert prior_area(Prior(np.zeros(2), np.diag([4.0, 9.0]))) == pytest.approx(2 * math.pi * math.e * 6.0)
        assert gaussian_area(np.zeros((2, 2))) == 0.0

    @pytest.mark.parametrize("count", [1000, 500, 3000])
    def test_resampling_keeps_mean_and_covariance_of_all_states_in_expectation(self, count: int) -> None:
        rng = np.random.default_rng(3)
        cloud = drawn(Prior(np.zeros(2), 900.0 * np.eye(2)), np.eye(4), 1000, np.array([0.1]), rng)
        rows = cloud.rows.copy()
        rows[2:] = 0.02 * rows[:2] + rng.normal(0.0, 0.5, (2, 1000))
        weight = rng.random(1000) ** 3
        weight /= weight.sum()
        common = np.diag([0.0, 0.0, 0.3, 0.2])
        mean, cov = moments(rows, weight)
        cloud = replace(cloud, rows=rows, weight=weight, mean=mean, cov=cov, common=common)
        means, covs = [], []
        for _ in range(300):
            after = resampled(cloud, count, 100.0, 1e4, rng)
            np.testing.assert_array_equal(after.weight, 1.0 / count)
            assert after.rows.shape == (4, count)
            found, spread = moments(after.rows, after.weight)
            means.append(found)
            covs.append(spread + after.common)
        sigma = np.sqrt(np.diag(cov + common))
        np.testing.assert_allclose(np.mean(means, axis=0) / sigma, mean / sigma, atol=4e-3)
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(np.mean(covs, axis=0) / scale, (cov + common) / scale, atol=6e-3)
        assert np.linalg.eigvalsh(after.common - common)[0] > -1e-12  # the kernel's part in z given p
        assert np.trace(after.common - common) > 0.0

    def test_resampling_tells_copies_apart(self) -> None:
        cloud = drawn(Prior(np.zeros(2), 900.0 * np.eye(2)), np.eye(4), 1000, np.array([0.1]), np.random.default_rng(1))
        weight = np.zeros(1000)
        weight[:10] = 0.1
        mean, cov = moments(cloud.rows, weight)
        after = resampled(replace(cloud, weight=weight, mean=mean, cov=cov), 1000, 100.0, 1e4, np.random.default_rng(2))
        assert len(np.unique(after.rows[0])) == 1000


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("particles", 99),
        ("particles", 1e4),
        ("particles", True),
        ("least_particles", 10_000_001),
        ("outlier_share", 0.6),
        ("outlier_share", -0.1),
        ("outlier_scale", 0.0),
        ("blur_cells", -0.1),
        ("registration_cells", math.nan),
        ("adapt_noise", 1),
        ("adapt_walk", "yes"),
        ("bias_sigma", {"terrain": -1.0}),
        ("bias_sigma", {"terain": 1.0}),
        ("bias_sigma", 3.0),
        ("converged_sigma_m", 0.0),
    ],
)
def test_settings_out_of_range_are_named(hills: Map, setting: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=setting):
        Marginalized((hills,), INS, **{setting: value})


def test_two_maps_of_one_kind_and_an_early_estimate_are_refused(hills: Map) -> None:
    with pytest.raises(ConfigError, match="one map of each kind"):
        Marginalized((hills, hills), INS)
    with pytest.raises(ConfigError, match="one map of each kind"):
        Marginalized((), INS)
    filter_ = Marginalized((hills,), INS)
    early = filter_.init(Prior.from_ins(INS), np.random.default_rng(0))
    with pytest.raises(StateError, match="before the first epoch"):
        filter_.estimate(early)
    with pytest.raises(StateError, match="before the first epoch"):
        filter_.posterior(early)


def test_resumes_from_a_pickle_to_the_bit(hills: Map) -> None:
    epochs, filter_ = track([hills], 1, count=60).epochs, Marginalized((hills,), INS)
    epochs[29] = replace(epochs[29], measurements=())  # so that a step is pending
    whole = list(states(filter_, Prior.from_ins(INS), epochs, np.random.default_rng(1)))
    for stop in (1, 30, 45):
        generator = np.random.default_rng(1)
        *_, state = states(filter_, Prior.from_ins(INS), epochs[:stop], generator)
        again, state, generator = pickle.loads(pickle.dumps((filter_, state, generator)))
        rest = list(states(again, Prior.from_ins(INS), epochs[stop:], generator, resume=state))
        for one, other in zip(rest, whole[stop:], strict=True):
            assert one.mean.tobytes() == other.mean.tobytes()
            assert one.cov.tobytes() == other.cov.tobytes()
            assert one.scale.tobytes() == other.scale.tobytes()
            assert one.innovations == other.innovations
        assert rest[-1].cloud is not None
        assert whole[-1].cloud is not None
        assert rest[-1].cloud.rows.tobytes() == whole[-1].cloud.rows.tobytes()


def test_a_reading_over_a_void_or_off_the_map_changes_nothing_and_is_said(hills: Map) -> None:
    values = np.array(hills.values)
    values[60:200, 60:200] = np.nan
    holed = replace(hills, values=values)
    flown = track([hills], 1, count=10)
    filter_, prior = Marginalized((holed,), INS, **TOLD), Prior.from_ins(INS)
    *_, (mean, cov) = kalman(filter_, silent(flown.epochs), prior)
    *_, state = states(filter_, prior, flown.epochs, np.random.default_rng(1))
    assert [(one.known, one.used) for one in state.innovations] == [(0.0, False)]
    np.testing.assert_allclose(state.cov, cov, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(state.mean, mean, atol=1e-6)
    assert filter_.estimate(state).status is Status.OFF_MAP

"""Fading memory against plain numpy: the sum, the recursion, the fix, and the covariance that it claims."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Measurement, Prior, Status
from terranav.experiment.stream import states
from terranav.filters.fading_memory import FadingMemory, FadingMemoryState
from terranav.kernels import fading_memory as kernels
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map

STILL = InsGrade(position_sigma_m=300.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.0)
PRIOR = Prior(np.zeros(2), np.eye(2) * 300.0**2)
FLAT = Prior(np.zeros(2), np.eye(2) * 200.0**2, "uniform")
ERROR_M = (150.0, -210.0)


@cache
def chart() -> Map:
    return gaussian_map(np.random.default_rng(3), std=60.0, correlation_m=500.0, cells=241, cell_m=50.0, sigma=2.0)


def flight(
    count: int, seed: int = 1, *, sigma_m: float = 4.0, error_m: tuple[float, float] = ERROR_M, over: Map | None = None
) -> tuple[Epoch, ...]:
    """A straight flight with an INS whose error is constant; readings as noisy as told."""
    ground, rng = over or chart(), np.random.default_rng(seed)
    along = 60.0 * np.arange(count, dtype=np.float64)
    heading = rng.uniform(0.0, 2.0 * np.pi)
    start = shift(*chart().centre_deg, *rng.uniform(-800.0, 800.0, 2))
    lat, lon = shift(*start, along * np.cos(heading), along * np.sin(heading))
    ins_lat, ins_lon = shift(lat, lon, *error_m)
    noise = rng.normal(0.0, np.hypot(sigma_m, ground.sigma), count)
    value = ground.sample(lat, lon) + noise
    return tuple(
        Epoch(float(k), float(ins_lat[k]), float(ins_lon[k]), 900.0, measurements=(Measurement("terrain", v, sigma_m),))
        for k, v in enumerate(value.tolist())
    )


def last(method: FadingMemory, epochs: tuple[Epoch, ...], prior: Prior = PRIOR) -> FadingMemoryState:
    *_, state = states(method, prior, epochs, np.random.default_rng(0))
    return state


def squares(state: FadingMemoryState, epochs: tuple[Epoch, ...], sigma_m: float) -> NDArray[np.float64]:
    """(n, p, q) squared differences over the variance at every error, by sampling the map at every place."""
    north, east = np.meshgrid(state.memory.north_m, state.memory.east_m, indexing="ij")
    places = [shift(epoch.lat_deg, epoch.lon_deg, -north, -east) for epoch in epochs]
    values = [epoch.measurements[0].value for epoch in epochs]
    return np.array([(v - chart().sample(*place)) ** 2 / sigma_m**2 for v, place in zip(values, places, strict=True)])


@pytest.mark.parametrize("alpha", [0.985, 0.8, 1.0])
def test_the_recursion_is_the_sum_and_equals_plain_numpy(alpha: float) -> None:
    """papers/004: eq. 4 is eq. 3, and both are brute force's; 60 m steps over 50 m cells share no map error."""
    epochs = flight(30)
    state = last(FadingMemory((chart(),), STILL, alpha=alpha), epochs, FLAT)
    e2 = squares(state, epochs, float(np.hypot(4.0, 2.0)))
    age = np.arange(len(epochs))[::-1]
    direct = np.tensordot(alpha**age, e2, 1)
    np.testing.assert_allclose(state.memory.surface, direct, rtol=1e-5)
    recursive = np.zeros_like(direct)
    for one in e2:
        recursive = alpha * recursive + one
    np.testing.assert_allclose(recursive, direct, rtol=1e-12)
    assert state.memory.weight == pytest.approx(np.sum(alpha**age))
    assert state.memory.weight2 == pytest.approx(np.sum(alpha ** (2 * age)))
    assert state.memory.readings == 30
    assert state.memory.missing is None


def test_the_fix_is_the_smallest_cell_of_the_sum() -> None:
    """papers/004 eq. 11, without the prior and without sub-cells: the paper's own fix."""
    epochs = flight(80)
    state = last(FadingMemory((chart(),), STILL, sub_cell=False), epochs, FLAT)
    direct = np.tensordot(0.985 ** np.arange(80)[::-1], squares(state, epochs, 1.0), 1)
    i, j = np.unravel_index(np.argmin(direct), direct.shape)
    assert state.fix_m is not None
    assert state.fix_m.tolist() == [state.memory.north_m[i], state.memory.east_m[j]]
    assert np.hypot(*(state.mean_m - ERROR_M)) < 50.0
    assert np.linalg.eigvalsh(state.cov_m2)[0] >= 0.999 * 50.0**2 / 12.0


@pytest.mark.parametrize(
    ("settings", "first"),
    [({}, 67), ({"alpha": 0.9}, 10), ({"alpha": 0.5}, 2), ({"alpha": 1.0}, 48), ({"alpha": 0.9, "readings": 25}, 25)],
)
def test_fixes_from_the_reading_that_the_paper_names(settings: dict[str, Any], first: int) -> None:
    """papers/004, step 5: k >= 1/(1 - alpha)."""
    method = FadingMemory((chart(),), STILL, **settings)
    assert method.least_readings == first
    seen = [state.fix_m is not None for state in states(method, PRIOR, flight(first + 1), np.random.default_rng(0))]
    assert seen == [False] * (first - 1) + [True, True]


def test_between_the_cells_it_is_closer() -> None:
    epochs = flight(120, sigma_m=1.0)
    cell, fine = (last(FadingMemory((chart(),), STILL, sub_cell=sub), epochs) for sub in (False, True))
    assert np.hypot(*(fine.mean_m - ERROR_M)) < 0.5 * np.hypot(*(cell.mean_m - ERROR_M))
    assert np.trace(fine.cov_m2) < np.trace(cell.cov_m2)


@pytest.mark.parametrize("alpha", [0.985, 0.9])
def test_the_covariance_is_that_of_the_fix(alpha: float) -> None:
    """40 flights with a constant error: NEES near 2, as the effective number of readings (eqs. 9, 10) has it."""
    nees = []
    for seed in range(40):
        error_m = tuple(np.random.default_rng(100 + seed).normal(0.0, 150.0, 2).tolist())
        epochs = flight(80, seed, sigma_m=6.0, error_m=error_m)
        state = last(FadingMemory((chart(),), STILL, alpha=alpha), epochs)
        miss = state.mean_m - error_m
        nees.append(miss @ np.linalg.solve(state.cov_m2, miss))
    assert 1.2 < np.mean(nees) < 2.9  # the mean of 80 squared normals is 2 +- 0.63 at 95 %


def test_a_drift_lies_within_the_covariance() -> None:
    """5 m/s for 80 s: the fix lags by the mean age of the memory, and says so."""
    drifting = replace(STILL, velocity_sigma_mps=5.0)
    epochs = tuple(
        replace(epoch, lat_deg=float(lat), lon_deg=float(lon))
        for epoch in flight(80, sigma_m=2.0)
        for lat, lon in [shift(epoch.lat_deg, epoch.lon_deg, 5.0 * epoch.time_s, 0.0)]
    )
    state = last(FadingMemory((chart(),), drifting), epochs)
    miss = state.mean_m - (ERROR_M[0] + 5.0 * 79.0, ERROR_M[1])
    assert miss[0] < -80.0  # the lag
    assert miss @ np.linalg.solve(state.cov_m2, miss) < 6.0


def test_readings_off_the_map_leave_the_cells_that_have_them() -> None:
    values = np.array(chart().values)
    values[:118] = np.nan  # all that lies north of the flight's first kilometre or so
    holed = replace(chart(), values=values)
    epochs = flight(100)
    state = last(FadingMemory((holed,), STILL), epochs)
    assert state.memory.missing is not None
    assert state.memory.missing.max() <= state.memory.weight + 1e-9
    scores = state.memory.scores()
    assert np.isnan(scores).any() or state.memory.missing.max() <= 0.2 * state.memory.weight


def test_a_jump_of_the_ins_widens_the_covariance_until_it_is_forgotten() -> None:
    """Half way the INS jumps by 400 m: the memory contradicts itself, then has the new error alone."""
    epochs = tuple(
        epoch if k < 50 else replace(epoch, lat_deg=float(shift(epoch.lat_deg, epoch.lon_deg, 400.0, 0.0)[0]))
        for k, epoch in enumerate(flight(100))
    )
    seen = list(states(FadingMemory((chart(),), STILL, alpha=0.9), PRIOR, epochs, np.random.default_rng(0)))
    assert seen[49].judgement.status is Status.CONVERGED
    assert max(np.sqrt(state.cov_m2[0, 0]) for state in seen[50:65]) > 200.0
    assert any(state.judgement.status is not Status.CONVERGED for state in seen[50:65])
    assert seen[-1].judgement.status is Status.CONVERGED
    assert np.hypot(*(seen[-1].mean_m - (ERROR_M[0] + 400.0, ERROR_M[1]))) < 50.0


def test_what_contradicts_everything_is_lost_and_starts_over() -> None:
    """Readings 500 m off all that the map has within the search area."""
    wrong = tuple(
        epoch if k < 40 else replace(epoch, measurements=(Measurement("terrain", 1500.0, 4.0),))
        for k, epoch in enumerate(flight(60))
    )
    seen = list(states(FadingMemory((chart(),), STILL, alpha=0.9), PRIOR, wrong, np.random.default_rng(0)))
    assert Status.LOST in [state.judgement.status for state in seen[40:]]
    assert min(state.memory.readings for state in seen[40:]) == 0


def test_the_grid_follows_a_fix_that_drifts_out_of_it() -> None:
    slow = replace(STILL, velocity_sigma_mps=4.0, position_sigma_m=150.0)
    prior = Prior.from_ins(slow)
    epochs = tuple(
        replace(epoch, lat_deg=float(lat), lon_deg=float(lon))
        for epoch in flight(90, sigma_m=2.0, error_m=(0.0, 0.0))
        for lat, lon in [shift(epoch.lat_deg, epoch.lon_deg, -6.0 * epoch.time_s, 0.0)]
    )
    state = last(FadingMemory((chart(),), slow, alpha=0.8), epochs, prior)
    first = FadingMemory((chart(),), slow, alpha=0.8).init(prior, np.random.default_rng(0))
    assert state.memory.south_m < first.memory.south_m - 300.0
    assert state.memory.south_m + 100.0 < state.mean_m[0] < state.memory.north_m[-1] - 100.0
    assert abs(state.mean_m[0] + 6.0 * 89.0) < 60.0


def test_flat_ground_leaves_the_prior() -> None:
    plane = plane_map(0.0, 0.0, cells=241, cell_m=50.0, centre_deg=chart().centre_deg)
    state = last(FadingMemory((plane,), STILL), flight(100, over=plane))
    np.testing.assert_allclose(state.cov_m2, PRIOR.cov_m2, rtol=0.01, atol=100.0)
    np.testing.assert_allclose(state.mean_m, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"alpha": 0.0}, "fading_memory alpha is 0.0, expected a finite number and > 0 and <= 1"),
        ({"alpha": 1.01}, "alpha is 1.01"),
        ({"alpha": float("nan")}, "alpha is nan"),
        ({"readings": 0}, "fading_memory readings is 0, expected a whole number >= 1"),
        ({"cell_m": 0.0}, "cell_m is 0.0"),
        ({"max_cells": 5}, "max_cells is 5"),
        ({"maps": ()}, r"maps are of kinds \[\], expected one map of each kind"),
    ],
)
def test_impossible_settings_are_one_line(settings: dict[str, Any], line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        FadingMemory(**{"maps": (chart(),), "ins": STILL, **settings})


def test_the_kernels_give_the_same_without_compilation() -> None:
    small = gaussian_map(np.random.default_rng(1), std=30.0, correlation_m=300.0, cells=40, cell_m=50.0)
    frame = small.local_frame(*small.centre_deg, 500.0)
    north, east = np.linspace(-1100.0, 400.0, 9), np.linspace(-400.0, 300.0, 7)  # partly off the map
    before, coefficients = np.full((9, 7), 2.0), np.stack([frame.row, frame.col])
    surfaces = []
    for recall in (kernels.recall, kernels.recall.py_func):
        after = np.empty((9, 7))
        unknown = recall(small.values, coefficients, (north, east), (510.0, 0.25), 0.9, before, after)
        surfaces.append((unknown, after))
    height = small.sample(*shift(*small.centre_deg, -north[:, None], -east[None, :]))
    plain = 0.9 * before + np.nan_to_num(0.25 * (510.0 - height) ** 2)
    assert surfaces[0][0] == surfaces[1][0] == np.isnan(height).sum() > 0
    for _, after in surfaces:
        np.testing.assert_allclose(after, plain, rtol=1e-5)
    log_p = -np.add.outer((np.arange(9) - 4.3) ** 2, 0.5 * (np.arange(7) - 2.8) ** 2) / 0.3
    for sub_cell in (True, False):
        compiled, plain = (each(log_p, 4, 3, sub_cell, 20.0) for each in (kernels.moments, kernels.moments.py_func))
        np.testing.assert_allclose(compiled, plain, rtol=1e-9)
    np.testing.assert_allclose(kernels.moments(log_p, 4, 3, True, 20.0)[:5], [4.3, 2.8, 0.15, 0.0, 0.3], atol=0.02)

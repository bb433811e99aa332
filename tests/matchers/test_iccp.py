"""ICCP: settings, what it finds, that its covariance means something, and the paper's own way of running it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from terranav.core.earth import shift
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Estimate, Measurement, Prior, Status
from terranav.experiment.registry import make_estimator
from terranav.experiment.stream import states, stream
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map
from terranav.matchers.iccp import Iccp

INS = InsGrade(position_sigma_m=300.0, velocity_sigma_mps=0.3, position_walk_m_per_sqrt_s=0.3)


@cache
def rough() -> Map:
    return gaussian_map(np.random.default_rng(3), std=60.0, correlation_m=600.0, cells=241, cell_m=50.0, sigma=1.0)


def flight(chart: Map, seed: int, *, epochs: int = 96, error_m: tuple[float, float] | None = None) -> Any:
    """Epochs of a drifting INS over a map, and its true error."""
    rng = np.random.default_rng(seed)
    t = np.arange(float(epochs))
    lat, lon = shift(*chart.centre_deg, -2500.0 + 50.0 * t, -2500.0 + 50.0 * t)
    start = rng.normal(0.0, 300.0, 2) if error_m is None else np.array(error_m)
    error = start + t[:, None] * rng.normal(0.0, 0.3, 2) + np.cumsum(rng.normal(0.0, 0.3, (epochs, 2)), axis=0)
    ins_lat, ins_lon = shift(lat, lon, *error.T)
    height = chart.sample(lat, lon) + rng.normal(0.0, np.hypot(3.0, chart.sigma), epochs)
    return tuple(
        Epoch(
            float(t[i]),
            float(ins_lat[i]),
            float(ins_lon[i]),
            1500.0,
            (50.0, 50.0, 0.0),
            None,
            (Measurement("terrain", float(height[i]), 3.0),),
        )
        for i in range(epochs)
    ), error


def flown(chart: Map, epochs: Any, prior: Prior | None = None, seed: int = 1, **settings: Any) -> list[Estimate]:
    estimator = make_estimator("iccp", [chart], INS, **settings)
    return list(stream(estimator, prior or Prior.from_ins(INS), epochs, np.random.default_rng(seed)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"starts": 0}, "iccp starts is 0, expected a whole number >= 1"),
        ({"window": 1}, "iccp window is 1, expected a whole number >= 2"),
        ({"window": 4, "every": 5}, "iccp every is 5, expected at most the window of 4 readings"),
        ({"m": 4, "n": 3}, "iccp m is 4, expected at most n, which is 3"),
        ({"m": 0}, "iccp m is 0"),
        ({"iterations": 0}, "iccp iterations is 0"),
        ({"judge": "pdf"}, "unknown iccp judge 'pdf'.*did you mean 'pdaf'"),
        ({"weight": -1.0}, "iccp weight is -1.0"),
        ({"e_min_m": float("nan")}, "iccp e_min_m is nan"),
        ({"agree_m": 0.0}, "iccp agree_m is 0.0"),
        ({"pdaf_sigma_m": 0.0}, "iccp pdaf_sigma_m is 0.0"),
        ({"search_sigma_m": -1.0}, "iccp search_sigma_m is -1.0"),
        ({"start": 3}, "unknown setting of 'iccp' 'start'.*did you mean 'starts'"),
    ],
)
def test_impossible_settings_get_their_line(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_estimator("iccp", [rough()], INS, **settings)


def test_needs_a_map() -> None:
    with pytest.raises(ConfigError, match="iccp maps is empty"):
        Iccp((), INS)


def test_errors_and_covariances_agree_over_many_flights() -> None:
    """NEES has mean 2 when the covariance is right; 12 flights give it a sigma of 0.6."""
    nees, misses, converged = [], [], 0
    for seed in range(12):
        epochs, error = flight(rough(), seed)
        last = flown(rough(), epochs)[-1]
        miss = last.ins_error_m - error[-1]
        nees.append(float(miss @ np.linalg.solve(last.cov_m2, miss)))
        misses.append(float(np.hypot(*miss)))
        converged += last.status is Status.CONVERGED
    assert 0.7 < np.mean(nees) < 3.6
    assert np.median(misses) < 25.0
    assert converged >= 11


@pytest.mark.parametrize("judge", ["none", "m_of_n", "pdaf"])
def test_every_judge_finds_the_error(judge: str) -> None:
    epochs, error = flight(rough(), 5)
    last = flown(rough(), epochs, judge=judge, every=12, iterations=200)[-1]
    assert np.hypot(*(last.ins_error_m - error[-1])) < 50.0
    assert last.status is Status.CONVERGED


def test_velocity_and_course_errors_are_found() -> None:
    """An INS whose velocity is off by 3 m/s: a trace of one shape only would smear."""
    ins = replace(INS, velocity_sigma_mps=3.0)
    epochs, _ = flight(rough(), 7, epochs=48)
    drift = np.array([3.0, -2.0]) * np.arange(48.0)[:, None]
    moved = [
        replace(epoch, lat_deg=float(lat), lon_deg=float(lon))
        for epoch, (lat, lon) in zip(epochs, (shift(e.lat_deg, e.lon_deg, *d) for e, d in zip(epochs, drift)))
    ]
    error = flight(rough(), 7, epochs=48)[1][-1] + drift[-1]
    *_, last = stream(Iccp((rough(),), ins, window=48), Prior.from_ins(ins), moved, np.random.default_rng(0))
    assert np.hypot(*(last.ins_error_m - error)) < 60.0


def test_on_a_plane_only_the_direction_of_the_slope_is_learnt() -> None:
    chart = plane_map(0.125, 0.0, cells=301, cell_m=50.0, centre_deg=(0.0, 0.0))
    epochs, error = flight(chart, 2, epochs=64)
    last = flown(chart, epochs)[-1]
    north, east = np.sqrt(np.diag(last.cov_m2))
    assert north < 40.0
    assert east > 295.0
    assert abs(last.ins_error_m[0] - error[-1, 0]) < 4.0 * north
    assert abs(last.ins_error_m[1]) < 50.0
    assert last.status is Status.SEARCHING


def test_tercom_finds_the_start_when_the_error_is_large() -> None:
    epochs, error = flight(rough(), 3, error_m=(1700.0, -1500.0), epochs=96)
    wide = Prior(np.zeros(2), np.eye(2) * 1500.0**2)
    settings = {"window": 48, "starts": 2}
    found = flown(rough(), epochs, wide, **settings)[-1]
    assert np.hypot(*(found.ins_error_m - error[-1])) < 60.0
    blind = flown(rough(), epochs, wide, coarse_above_cells=1e9, **settings)[-1]
    assert np.hypot(*(blind.ins_error_m - error[-1])) > 200.0


def test_paper_mode_reports_the_chosen_optimisation_itself() -> None:
    epochs, _ = flight(rough(), 4, epochs=20)
    estimator = Iccp(
        (rough(),),
        INS,
        window=3,
        every=1,
        iterations=60,
        e_min_m=222.0,
        weight=1.0,
        per_step=True,
        step_sigma=0.03,
        search_sigma_m=300.0,
        feedback=False,
        fuse=False,
    )
    seen = list(states(estimator, Prior.from_ins(INS), epochs, np.random.default_rng(1)))
    assert [state.latest is not None for state in seen] == [False, False] + [True] * 18
    for state in seen[2:]:
        assert state.latest is not None
        found, decision = state.latest.found, state.latest.decision
        np.testing.assert_array_equal(state.mean_m, found.places_m[decision.chosen])
        assert decision.credibility.sum() == pytest.approx(1.0)
        assert (np.diff(found.target_m) >= 0.0).all()
        assert (found.contour_m <= found.target_m).all()


def test_refused_matches_leave_the_belief_alone() -> None:
    epochs, _ = flight(rough(), 4, epochs=64)
    estimator = Iccp((rough(),), INS, window=16, judge="m_of_n", n=3, m=2)
    seen = list(states(estimator, Prior.from_ins(INS), epochs, np.random.default_rng(1)))
    first_three = [state for state in seen if state.epoch is not None and state.epoch.time_s < 63.0]
    assert all((state.mean_m == 0.0).all() for state in first_three)  # M/N gives the location from the fourth match
    assert seen[-1].latest is not None
    assert seen[-1].latest.decision.accepted
    assert np.abs(seen[-1].mean_m).max() > 0.0


def test_the_lower_bound_ends_the_search_early() -> None:
    """On a plane eq. 5 is exact, so that the bound lies just above what can be reached."""
    chart = plane_map(0.125, 0.0, cells=301, cell_m=50.0)
    epochs, _ = flight(chart, 1, epochs=32)
    target = {}
    for bound in (0.0, None, 2000.0):
        estimator = Iccp((chart,), INS, e_min_m=bound)
        *_, last = states(estimator, Prior.from_ins(INS), epochs, np.random.default_rng(1))
        assert last.latest is not None
        target[bound] = last.latest.found.target_m
    least = 32 * np.sqrt(2.0 / np.pi) * 3.0 / 0.125
    assert target[0.0].max() < target[None].max() < 1.5 * least
    assert target[None].max() < target[2000.0].max() < 2000.0

"""SITAN against a Kalman filter on a plane, on hills, and where it must not claim a fix."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree, shift
from terranav.core.errors import ConfigError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.protocols import Estimator
from terranav.core.records import Epoch, Estimate, Measurement, Prior, Status
from terranav.filters._kalman import KalmanState
from terranav.filters.sitan import Sitan, fitted_plane
from terranav.maps.map import Map
from terranav.maps.noise import reading_sigma
from tests.matchers.test_tercom import CHART, LAT0, LON0

FloatArray = NDArray[np.float64]
RNG = np.random.default_rng(0)
WALKING = InsGrade(position_sigma_m=30.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=1.5)
DEGREE = 1.0 / 3600.0


def equator(per_row: float, per_col: float, kind: str = "terrain", sigma: float = 1.0) -> Map:
    """A plane at the crossing of equator and Greenwich, where degrees are metres to 1e-10; values exact in float32."""
    size = 201
    rows, cols = np.mgrid[0:size, 0:size]
    corner = 0.5 * size * DEGREE
    unit = {"terrain": "m", "gravity": "mGal"}[kind]
    transform = (DEGREE, 0.0, -corner, 0.0, -DEGREE, corner)
    return Map(1000.0 + per_row * rows + per_col * cols, transform, kind=kind, unit=unit, sigma=sigma)


def slope(per_row: float, per_col: float) -> FloatArray:
    """Change of the map value per metre of INS error north and east: the true place lies against the error."""
    north, east = (float(v) for v in metres_per_degree(0.0))
    return np.array([per_row / (DEGREE * north), -per_col / (DEGREE * east)])


def eastward(charts: tuple[Map, ...], error: FloatArray, n: int, sigma: float = 2.0) -> list[Epoch]:
    """A flight along the equator with readings of every kind at two epochs of three."""
    rng = np.random.default_rng(7)
    stream = []
    for k in range(n):
        lat, lon = shift(0.0, 0.0, 0.0, 40.0 * (k - 0.5 * n))
        readings = [
            Measurement(c.kind, float(c.sample(lat, lon)) + sigma * rng.standard_normal(), sigma) for c in charts
        ]
        told = shift(lat, lon, error[0], error[1])
        seen = tuple(readings) if k % 3 else ()
        stream.append(Epoch(0.5 * k, float(told[0]), float(told[1]), 2000.0, measurements=seen))
    return stream


def run(filter_: Sitan, stream: list[Epoch], state: KalmanState | None = None) -> tuple[KalmanState, list[Estimate]]:
    """The last state and all estimates."""
    state = filter_.init(Prior.from_ins(filter_.ins), RNG) if state is None else state
    said = []
    for epoch in stream:
        state = filter_.step(state, epoch, RNG)
        said.append(filter_.estimate(state))
    return state, said


def test_on_planes_it_is_the_kalman_filter() -> None:
    slopes = {"terrain": (3.5, -2.25), "gravity": (0.5, 4.125)}
    charts = tuple(equator(*slopes[kind], kind=kind) for kind in slopes)
    stream = eastward(charts, np.array([21.0, -13.0]), 90)
    _, said = run(Sitan(charts, WALKING), stream)

    mean, cov = np.zeros(2), np.eye(2) * 30.0**2
    last = None
    for k, epoch in enumerate(stream):
        if k:
            cov = cov + np.eye(2) * 1.5**2 * 0.5
        for chart, reading in zip(charts, epoch.measurements):
            h = slope(*slopes[chart.kind])[None, :]
            noise = reading_sigma(reading, chart, last, epoch) ** 2
            predicted = float(chart.sample(epoch.lat_deg, epoch.lon_deg)) + float(h[0] @ mean)
            gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + noise)
            mean = mean + gain[:, 0] * (reading.value - predicted)
            cov = (np.eye(2) - gain @ h) @ cov
        last = epoch if epoch.measurements else last
        np.testing.assert_allclose(said[k].ins_error_m, mean, rtol=0.0, atol=1e-9 * 30.0)
        np.testing.assert_allclose(said[k].cov_m2, cov, rtol=1e-9, atol=1e-9)


def test_the_fit_of_a_plane_is_the_plane() -> None:
    chart = equator(3.5, -2.25)
    epoch = Epoch(0.0, 0.0, 0.0, 0.0)
    for cov in (np.diag([900.0, 100.0]), np.array([[500.0, 300.0], [300.0, 250.0]]), 1e-12 * np.eye(2)):
        plane = fitted_plane(chart, epoch, np.array([5.0, -7.0]), cov)
        assert plane is not None
        np.testing.assert_allclose(plane.slope, slope(3.5, -2.25), rtol=1e-9)
        assert plane.level == pytest.approx(float(chart.sample(*shift(0.0, 0.0, -5.0, 7.0))), abs=1e-9)
        assert plane.left < 1e-18


def over_hills(error: FloatArray, n: int = 200, seed: int = 0) -> list[Epoch]:
    """A flight across the smooth hills."""
    rng = np.random.default_rng(seed)
    stream = []
    for k in range(n):
        along = 40.0 * (k - 0.5 * n)
        lat, lon = shift(LAT0, LON0, 0.8 * along, 0.6 * along)
        value = float(CHART.sample(lat, lon)) + 3.0 * rng.standard_normal()
        told = shift(lat, lon, error[0], error[1])
        stream.append(
            Epoch(float(k), float(told[0]), float(told[1]), 2000.0, measurements=(Measurement("terrain", value, 3.0),))
        )
    return stream


def test_it_tracks_over_hills_and_means_its_covariance() -> None:
    """Final NEES per axis of 30 seeds: chi-square with 60 degrees of freedom, 99.9 % within 0.52 .. 1.66."""
    ins = InsGrade(position_sigma_m=60.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.5)
    rng, nees = np.random.default_rng(5), []
    filter_ = Sitan((CHART,), ins)
    assert isinstance(filter_, Estimator)
    for seed in range(30):
        walk = np.cumsum(rng.normal(0.0, 0.5, (100, 2)), axis=0)
        start = rng.normal(0.0, 60.0, 2)
        stream = []
        for k, epoch in enumerate(over_hills(start, 100, seed)):
            lat, lon = shift(epoch.lat_deg, epoch.lon_deg, walk[k, 0], walk[k, 1])
            stream.append(Epoch(epoch.time_s, float(lat), float(lon), 0.0, measurements=epoch.measurements))
        _, said = run(filter_, stream)
        off = said[-1].ins_error_m - start - walk[-1]
        nees.append(off @ np.linalg.solve(said[-1].cov_m2, off) / 2.0)
        assert said[-1].status is Status.CONVERGED
    assert 0.52 < np.mean(nees) < 1.66


def test_a_start_too_far_off_is_lost_and_starts_over() -> None:
    """A filter told 50 m that is 900 m off: its readings contradict it, and once lost it starts over."""
    ins = InsGrade(position_sigma_m=50.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.2)
    error = np.array([700.0, 600.0])
    stream = over_hills(error)
    _, said = run(Sitan((CHART,), ins, restart=False), stream)
    assert {e.status for e in said[30:]} == {Status.LOST}
    state, again = run(Sitan((CHART,), ins), stream)
    lost = [k for k, e in enumerate(again) if e.status is Status.LOST]
    assert lost
    np.testing.assert_allclose(again[lost[0]].ins_error_m, 0.0)
    assert again[lost[0]].cov_m2[0, 0] == pytest.approx(50.0**2 + 0.04 * lost[0])
    assert np.isfinite(state.mean_m).all()


def test_off_the_map_nothing_is_used_and_the_status_says_so() -> None:
    ins = InsGrade(position_sigma_m=50.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=2.0)
    filter_ = Sitan((CHART,), ins)
    away = [Epoch(float(k), LAT0 + 3.0, LON0, 0.0, measurements=(Measurement("terrain", 5.0, 1.0),)) for k in range(4)]
    state, said = run(filter_, away)
    assert {e.status for e in said} == {Status.OFF_MAP}
    np.testing.assert_allclose(state.cov_m2, np.eye(2) * (50.0**2 + 3 * 4.0))
    assert np.isnan(said[-1].nis)


def test_the_gate_keeps_an_outlier_out() -> None:
    stream = over_hills(np.zeros(2), 60)
    wild = stream[40]
    stream[40] = Epoch(
        wild.time_s, wild.lat_deg, wild.lon_deg, 0.0, measurements=(Measurement("terrain", 3000.0, 3.0),)
    )
    ins = InsGrade(position_sigma_m=50.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.5)
    gated, open_ = (run(Sitan((CHART,), ins, gate_sigma=gate), stream[:41])[1][-2:] for gate in (5.0, None))
    np.testing.assert_allclose(gated[1].ins_error_m, gated[0].ins_error_m)
    assert np.hypot(*(open_[1].ins_error_m - open_[0].ins_error_m)) > 50.0


def test_readings_of_other_kinds_and_bare_epochs_only_let_time_pass() -> None:
    filter_ = Sitan((CHART,), WALKING)
    stream = [
        Epoch(float(k), LAT0, LON0, 0.0, measurements=(Measurement("gravity", 1.0, 1.0),) * (k % 2)) for k in range(5)
    ]
    state, said = run(filter_, stream)
    np.testing.assert_allclose(state.cov_m2, np.eye(2) * (30.0**2 + 4 * 1.5**2))
    assert {e.status for e in said} <= {Status.SEARCHING, Status.CONVERGED}


def test_repeated_epochs_pickles_and_immutable_states() -> None:
    filter_ = Sitan((CHART,), WALKING)
    stream = over_hills(np.array([10.0, 20.0]), 30)
    half, _ = run(filter_, [stream[0]] * 3 + stream[:15])
    kept = pickle.dumps(half)
    straight, _ = run(filter_, stream[15:], half)
    resumed, _ = run(pickle.loads(pickle.dumps(filter_)), stream[15:], pickle.loads(kept))
    assert straight.mean_m.tobytes() == resumed.mean_m.tobytes()
    assert straight.cov_m2.tobytes() == resumed.cov_m2.tobytes()
    assert half.mean_m.tobytes() == pickle.loads(kept).mean_m.tobytes()
    assert np.linalg.eigvalsh(straight.cov_m2)[0] > 0.0


def test_it_says_nothing_before_the_first_epoch() -> None:
    filter_ = Sitan((CHART,), WALKING)
    with pytest.raises(StateError, match="no estimate before the first epoch"):
        filter_.estimate(filter_.init(Prior.from_ins(WALKING), RNG))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gate_sigma": -1.0}, "sitan gate_sigma is -1.0, expected"),
        ({"converged_sigma_m": 0.0}, "sitan converged_sigma_m is 0.0, expected"),
        ({"maps": ()}, "sitan maps are of kinds"),
        ({"maps": (CHART, CHART)}, "sitan maps are of kinds .'terrain', 'terrain'., expected one map of each"),
    ],
)
def test_impossible_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Sitan(**{"maps": (CHART,), "ins": WALKING, **settings})

"""The 15-state error model: against python-ins, against a strapdown INS with and without one error, and its laws."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyins import earth
from pyins.error_model import InsErrorModel, propagate_errors
from pyins.util import TRAJECTORY_ERROR_COLS
from scipy.linalg import expm
from scipy.stats import chi2

from terranav.core.earth import offset_m
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch
from terranav.ins import strapdown_error as model
from terranav.ins.error_state import ErrorModel
from terranav.ins.grades import GRADES
from terranav.ins.strapdown import free_inertial
from terranav.ins.trajectory import Route, Trajectory, fly
from tests.ins.van_loan import discretised

WINDING = [[46.0, 7.0, 1500.0], [46.1, 7.05, 2300.0], [46.1, 7.2, 2300.0], [46.03, 7.22, 1800.0]]
ROUND = [[46.0, 7.0, 2000.0], [46.06, 7.0, 2000.0], [46.06, 7.09, 2200.0], [46.0, 7.09, 2200.0], [46.0, 7.15, 2000.0]]
QUIET = InsGrade(1.0, 0.0, 0.0)
#: one error at a time: its place among the 13 states, and its size
ERRORS = {
    "north": (0, 500.0), "east": (1, 500.0), "vn": (2, 0.3), "ve": (3, 0.3),
    "tilt_north": (4, 1e-3), "tilt_east": (5, 1e-3), "heading": (6, 2e-3),
    "gyro_x": (7, 5e-6), "gyro_y": (8, 5e-6), "gyro_z": (9, 5e-6),
    "accel_x": (10, 0.01), "accel_y": (11, 0.01), "accel_z": (12, 0.01),
}  # fmt: skip
ONE_ERROR = pytest.mark.parametrize("name", list(ERRORS))


@pytest.fixture(scope="module")
def winding() -> Trajectory:
    return fly(Route(WINDING, [80.0, 100.0, 90.0]), 50.0)


def epochs_of(flight: Trajectory) -> list[Epoch]:
    places = zip(
        *(axis.tolist() for axis in (flight.time_s, flight.lat_deg, flight.lon_deg, flight.alt_m)), strict=True
    )
    turning = zip(flight.velocity_mps.tolist(), flight.attitude_deg.tolist(), strict=True)
    return [
        Epoch(t, lat, lon, alt, (v[0], v[1], v[2]), (a[0], a[1], a[2]))
        for (t, lat, lon, alt), (v, a) in zip(places, turning, strict=True)
    ]


def initial(name: str) -> np.ndarray:
    place, size = ERRORS[name]
    x = np.zeros(13)
    x[place] = size
    return x


def propagated(flight: Trajectory, x: np.ndarray) -> np.ndarray:
    """Position and velocity error (n, 4) by the 13-state model."""
    states = [x]
    for before, after in pairwise(epochs_of(flight)):
        states.append(model.transition(QUIET, before, after)[0] @ states[-1])
    return np.array(states)[:, :4]


@pytest.fixture(scope="module")
def by_the_model(winding: Trajectory) -> np.ndarray:
    """Position and velocity errors (n, 4, 13) once a second of a unit of each state."""
    return propagated(winding.every(50), np.eye(13))


def frame_of(flight: Trajectory) -> pd.DataFrame:
    """The trajectory as python-ins has it."""
    columns = ["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"]
    values = [flight.lat_deg, flight.lon_deg, flight.alt_m, flight.velocity_mps, flight.attitude_deg]
    return pd.DataFrame(np.column_stack(values), index=flight.time_s, columns=columns)


def by_pyins(flight: Trajectory, x: np.ndarray, *, with_altitude: bool) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity errors (n, 3) of python-ins' propagation, from the 13 states."""
    pva = frame_of(flight)
    full = np.zeros(9)
    full[[0, 1, 3, 4]], full[6:] = x[:4], x[4:7]
    full[3:6] -= np.cross(pva[["VN", "VE", "VD"]].iloc[0], x[4:7])
    out = InsErrorModel().transform_to_output(pva.iloc[0]) @ full
    start = pd.Series(out, index=TRAJECTORY_ERROR_COLS)
    error, _ = propagate_errors(pva, start, x[7:10], x[10:13], with_altitude=with_altitude)
    return error[["north", "east", "down"]].to_numpy(), error[["VN", "VE", "VD"]].to_numpy()


def relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Largest difference, by the largest value."""
    return float(np.abs(ours - theirs).max() / np.abs(theirs).max())


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x each column of b."""
    return np.cross(a, b.T).T


def small_terms(at: model.Flight) -> np.ndarray:
    """What python-ins drops, written out of the module's docstring by numerical differences of W and rho."""
    lat = math.radians(at.lat_deg)
    rn, re, _ = earth.principal_radii(at.lat_deg, at.alt_m)
    v = np.array(at.velocity_mps)

    def rate(lat: float) -> np.ndarray:
        return 7.292115e-5 * np.array([math.cos(lat), 0.0, -math.sin(lat)])

    def transport_d(lat: float) -> float:
        return float(-v[1] * math.tan(lat) / re)

    step = 1e-4
    turned = np.zeros((3, 3))
    turned[:, 0] = (rate(lat + step) - rate(lat - step)) / (2.0 * step) / rn
    f = np.zeros((15, 15))
    f[1, :2] = math.tan(lat) / re * np.array([v[1], -v[0]])
    f[3:6, :3] = cross(v, turned)
    f[3:6, 6:9] = -cross(v, cross(rate(lat), np.eye(3)))
    f[8, 0] = (transport_d(lat + step) - transport_d(lat - step)) / (2.0 * step) / rn
    return f


@given(
    lat=st.floats(-80.0, 80.0),
    alt=st.floats(-400.0, 12000.0),
    speed=st.tuples(*[st.floats(-250.0, 250.0)] * 3),
    attitude=st.tuples(st.floats(-60.0, 60.0), st.floats(-40.0, 40.0), st.floats(0.0, 360.0)),
)
def test_system_matrix_is_that_of_python_ins_and_the_small_terms(
    lat: float, alt: float, speed: tuple[float, float, float], attitude: tuple[float, float, float]
) -> None:
    at = model.Flight(lat, alt, speed, attitude)
    columns = ["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"]
    pva = pd.Series([lat, 0.0, alt, *speed, *attitude], index=columns)
    expected = np.zeros((15, 15))
    expected[:9, :9], expected[:9, 9:12], expected[:9, 12:] = InsErrorModel().system_matrices(pva)
    np.testing.assert_allclose(model.system_matrix(at), expected + small_terms(at), rtol=1e-6, atol=1e-13)
    flat = InsErrorModel(with_altitude=False).system_matrices(pva)
    lift = model.held(speed)
    ours = ((model.system_matrix(at) - small_terms(at)) @ lift)[model.HELD]
    np.testing.assert_allclose(ours[:7], np.hstack(flat), rtol=1e-6, atol=1e-12)


@ONE_ERROR
def test_propagation_agrees_with_python_ins_but_for_the_small_terms(
    name: str, winding: Trajectory, by_the_model: np.ndarray
) -> None:
    place, size = ERRORS[name]
    ours = by_the_model[:, :, place] * size
    position, velocity = by_pyins(winding.every(5), initial(name), with_altitude=False)
    assert relative(ours[:, :2], position[::10, :2]) < 6e-3
    if place > 1:  # a position error makes next to no velocity error
        assert relative(ours[:, 2:], velocity[::10, :2]) < 1e-3


@pytest.fixture(scope="module")
def all_fifteen(winding: Trajectory) -> np.ndarray:
    """Position and velocity errors (6, 13) at the end by the 15-state matrices without the small terms."""
    flight = [
        model.Flight(e.lat_deg, e.alt_m, e.velocity_mps, e.attitude_deg)
        for e in epochs_of(winding.every(25))
        if e.velocity_mps is not None and e.attitude_deg is not None
    ]
    matrices = [model.system_matrix(at) - small_terms(at) for at in flight]
    states = np.zeros((15, 13))
    states[model.HELD] = np.eye(13)
    states[3:6, 4:7] = -cross(np.array(flight[0].velocity_mps), np.eye(3))
    for before, after in pairwise(matrices):
        states = expm(0.25 * (before + after)) @ states
    states[3:6] += cross(np.array(flight[-1].velocity_mps), states[6:9])
    return states[:6]


@ONE_ERROR
def test_all_fifteen_states_propagate_as_in_python_ins(name: str, winding: Trajectory, all_fifteen: np.ndarray) -> None:
    """The free vertical channel included."""
    place, size = ERRORS[name]
    ours = all_fifteen[:, place] * size
    position, velocity = by_pyins(winding.every(5), initial(name), with_altitude=True)
    assert np.abs(ours[:3] - position[-1]).max() < 5e-3 * np.abs(position).max()
    assert np.abs(ours[3:] - velocity[-1]).max() < 5e-3 * np.abs(velocity).max() + 1e-9


class Given:
    """In the place of a generator: hands `free_inertial` the errors x (13,) as its draws for a grade of unit sigmas."""

    def __init__(self, x: np.ndarray) -> None:
        biases = [x[7:10] / (math.radians(1.0) / 3600.0), x[10:13] / 9.80665e-6]
        # phi turns the platform to the truth, the draw the truth to the platform
        self.draws = iter([*biases, None, None, x[:2], x[2:4], -np.degrees(x[4:7])])

    def standard_normal(self, size: int | tuple[int, ...]) -> np.ndarray:
        value = next(self.draws)
        return np.zeros(size) if value is None else value


UNIT = InsGrade(1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def without_error(winding: Trajectory) -> Trajectory:
    return free_inertial(winding, UNIT, Given(np.zeros(13)))  # type: ignore[arg-type]


@ONE_ERROR
def test_a_strapdown_ins_errs_as_the_model_says(name: str, winding: Trajectory, without_error: Trajectory) -> None:
    """Indicated with the error minus indicated without it: all of the mechanisation, nothing linearised."""
    x = initial(name)
    flown = free_inertial(winding, UNIT, Given(x))  # type: ignore[arg-type]
    difference = offset_m(without_error.lat_deg, without_error.lon_deg, flown.lat_deg, flown.lon_deg)
    position, velocity = np.stack(difference, axis=1), (flown.velocity_mps - without_error.velocity_mps)[:, :2]
    ours = propagated(flown, x)  # at the indicated trajectory, as in flight
    # an accelerometer's vertical bias meets the barometer's loop, which takes half a minute to hold it
    tolerance = 2e-2 if name == "accel_z" else 2e-3
    assert relative(ours[:, :2], position) < tolerance
    if ERRORS[name][0] > 1:
        assert relative(ours[:, 2:], velocity) < tolerance


@pytest.mark.parametrize("name", ["tactical", "industrial"])
def test_covariance_is_that_of_simulated_flights(name: str) -> None:
    """NEES of position and velocity over flights with turns; 30 runs of 4 figures, within 99.9 % of chi-square."""
    runs, grade = 30, replace(GRADES[name], position_sigma_m=50.0)
    dense = fly(Route(ROUND, 90.0), 10.0)
    truth, marks = dense.every(10), (60, 120, 180)
    error_model = ErrorModel(grade, (), "strapdown")
    covs = [error_model.initial_covariance(np.eye(2) * grade.position_sigma_m**2)]
    for before, after in pairwise(epochs_of(truth)[: marks[-1] + 1]):
        step = error_model.transition(before, after)
        covs.append(step.phi @ covs[-1] @ step.phi.T + step.q)
    nees = np.zeros((runs, len(marks)))
    short = Trajectory(*(getattr(dense, key)[: 10 * marks[-1] + 1] for key in Trajectory.__dataclass_fields__))
    for seed in range(runs):
        out = free_inertial(short, grade, np.random.default_rng(seed), imu_rate_hz=10.0)
        for k, i in enumerate(marks):
            north, east = offset_m(truth.lat_deg[i], truth.lon_deg[i], out.lat_deg[i], out.lon_deg[i])
            error = np.array([north, east, *(out.velocity_mps[i] - truth.velocity_mps[i])[:2]])
            nees[seed, k] = error @ np.linalg.solve(covs[i][:4, :4], error)
    low, high = chi2.ppf([0.0005, 0.9995], 4 * runs) / runs
    assert np.ptp(truth.attitude_deg[: marks[-1], 2]) > 90.0
    assert (low < nees.mean(axis=0)).all()
    assert (nees.mean(axis=0) < high).all()


def straight(t: float, *, known: bool = True) -> Epoch:
    """Due east on the equator, where the latitude stays what it is."""
    velocity, attitude = ((0.0, 100.0, 0.0), (1.0, 3.0, 80.0)) if known else (None, None)
    return Epoch(t, 0.0, math.degrees(100.0 * t / 6378137.0), 1000.0, velocity, attitude)


@given(dt=st.floats(1e-3, 3600.0), share=st.floats(0.01, 0.99))
def test_a_step_split_in_two_is_the_step(dt: float, share: float) -> None:
    start, middle, end = straight(0.0), straight(share * dt), straight(dt)
    grade = replace(GRADES["industrial"], position_walk_m_per_sqrt_s=1.0, velocity_walk_mps_per_sqrt_s=0.01)
    (phi1, q1), (phi2, q2) = model.transition(grade, start, middle), model.transition(grade, middle, end)
    phi, q = model.transition(grade, start, end)
    size = np.outer(np.sqrt(np.diag(q)), np.sqrt(np.diag(q))) + 1e-24
    np.testing.assert_allclose(phi2 @ phi1, phi, rtol=1e-8, atol=1e-9 * np.abs(phi).max())
    np.testing.assert_allclose((phi2 @ q1 @ phi2.T + q2) / size, q / size, atol=1e-8)


def test_a_turn_split_in_two_is_nearly_the_turn(winding: Trajectory) -> None:
    """The step is of second order in what changes; here 0.2 s while the vehicle banks."""
    turning = winding.every(10)
    i = int(np.abs(np.gradient(turning.attitude_deg[:, 2])).argmax())
    start, middle, end = epochs_of(turning)[i - 1 : i + 2]
    grade = GRADES["tactical"]
    (phi1, q1), (phi2, q2) = model.transition(grade, start, middle), model.transition(grade, middle, end)
    phi, q = model.transition(grade, start, end)
    assert abs(turning.attitude_deg[i + 1, 2] - turning.attitude_deg[i - 1, 2]) > 0.5
    np.testing.assert_allclose((phi2 @ phi1)[:4], phi[:4], atol=1e-3 * np.abs(phi).max())
    np.testing.assert_allclose(phi2 @ q1 @ phi2.T + q2, q, atol=1e-3 * np.abs(q).max())


@pytest.mark.parametrize("dt", [0.01, 1.0, 9.0, 60.0, 3600.0])
def test_discretised_as_by_van_loan(dt: float) -> None:
    grade, at = GRADES["tactical"], model.Flight(0.0, 1000.0, (0.0, 100.0, 0.0), (1.0, 3.0, 80.0))
    f = (model.system_matrix(at) @ model.held(at.velocity_mps))[model.HELD]
    g = model.noise_input(grade, at.velocity_mps)[model.HELD]
    phi, q = model.transition(grade, straight(0.0), straight(dt))
    to_u = model.to_platform(at.velocity_mps)
    expected = np.linalg.solve(to_u, expm(f * dt) @ to_u)
    np.testing.assert_allclose(phi, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())
    if dt <= 60.0:  # Van Loan's -f is badly conditioned over longer times
        by_expm = np.linalg.solve(to_u, np.linalg.solve(to_u, discretised(f, g @ g.T, dt)[1]).T)
        scale = np.sqrt(np.diag(by_expm)) + 1e-9
        np.testing.assert_allclose(q / np.outer(scale, scale), by_expm / np.outer(scale, scale), atol=1e-6)


@given(
    dt=st.floats(0.0, 3600.0),
    turn=st.floats(-180.0, 180.0),
    lat=st.floats(-90.0, 90.0),
    speed=st.floats(0.0, 300.0),
    known=st.tuples(st.booleans(), st.booleans()),
)
def test_always_finite_and_never_a_negative_variance(
    dt: float, turn: float, lat: float, speed: float, known: tuple[bool, bool]
) -> None:
    first, last = known
    before = Epoch(0.0, lat, 179.9, 500.0, (speed, 0.0, 1.0) if first else None, (0.0, 0.0, 350.0) if last else None)
    after = Epoch(
        dt, 0.999 * lat, -179.9, 500.0,
        (0.0, speed, 0.0) if last else None, (10.0, 0.0, (350.0 + turn) % 360.0) if first else None,
    )  # fmt: skip
    phi, q = model.transition(GRADES["industrial"], before, after)
    assert np.isfinite(phi).all()
    assert np.isfinite(q).all()
    np.testing.assert_array_equal(q, q.T)
    scale = np.sqrt(np.diag(q))
    scale[scale == 0.0] = 1.0
    assert np.linalg.eigvalsh(q / np.outer(scale, scale)).min() > -1e-9


def test_no_time_no_change() -> None:
    phi, q = model.transition(GRADES["tactical"], straight(5.0), straight(5.0))
    np.testing.assert_array_equal(phi, np.eye(13))
    np.testing.assert_array_equal(q, np.zeros((13, 13)))


def test_what_one_epoch_lacks_the_other_lends() -> None:
    grade, known, unknown = GRADES["tactical"], straight(0.0), straight(10.0, known=False)
    same = replace(unknown, velocity_mps=known.velocity_mps, attitude_deg=known.attitude_deg)
    full = model.transition(grade, known, same)
    for ours, expected in zip(model.transition(grade, known, unknown), full, strict=True):
        np.testing.assert_array_equal(ours, expected)
    nan = (math.nan, 0.0, 0.0)
    broken = replace(unknown, velocity_mps=nan, attitude_deg=nan)
    for ours, expected in zip(model.transition(grade, known, broken), full, strict=True):
        np.testing.assert_array_equal(ours, expected)


def test_without_velocity_and_attitude_it_flies_level_along_the_track() -> None:
    grade, start, end = GRADES["tactical"], straight(0.0, known=False), straight(10.0, known=False)
    velocity, attitude = (0.0, 100.0, 0.0), (0.0, 0.0, 90.0)
    told = [replace(epoch, velocity_mps=velocity, attitude_deg=attitude) for epoch in (start, end)]
    for ours, expected in zip(model.transition(grade, start, end), model.transition(grade, *told), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-3, atol=1e-9)


def test_a_jump_of_the_position_is_no_velocity() -> None:
    phi, _ = model.transition(GRADES["tactical"], replace(straight(0.0, known=False)), straight(0.0, known=False))
    np.testing.assert_array_equal(phi, np.eye(13))
    jumped = Epoch(0.01, 1.0, 1.0, 1000.0)
    phi, q = model.transition(GRADES["tactical"], straight(0.0, known=False), jumped)
    assert np.isfinite(q).all()
    assert np.abs(phi[:2, 4:7]).max() <= 1000.0 * 0.01 * 1.01


def test_a_heading_error_turns_the_velocity_with_the_vehicle() -> None:
    """From north to east at V with heading error psi: what the indicated velocity gains is turned by psi."""
    v, psi = 100.0, 0.01
    before = Epoch(0.0, 46.0, 7.0, 1000.0, (v, 0.0, 0.0), (0.0, 0.0, 0.0))
    after = Epoch(1.0, 46.0, 7.0, 1000.0, (0.0, v, 0.0), (0.0, 0.0, 90.0))
    phi, _ = model.transition(QUIET, before, after)
    # phi_d > 0 turns the platform clockwise to the truth: the indicated gain (-V, V) lacks that turn
    np.testing.assert_allclose(phi[2:4, 6] * psi, [v * psi, v * psi], rtol=1e-2)


def test_initial_covariance_is_that_of_the_draws() -> None:
    cov = model.initial_covariance(GRADES["tactical"])
    expected = [math.radians(0.057)] * 2 + [math.radians(1.0)] + [math.radians(1.0) / 3600.0] * 3 + [9.80665e-3] * 3
    np.testing.assert_allclose(cov, np.diag(np.square(expected)), rtol=1e-12)


def test_needs_no_pandas() -> None:
    check = "import terranav.ins.strapdown_error, sys; print('pandas' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"

"""The linear error model: what every level must obey, and the closed forms of those that have one."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.earth import GRAVITY_MPS2, SCHULER_RAD_PER_S, shift
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS
from terranav.core.records import Epoch
from terranav.ins.drift import draw_drift
from terranav.ins.error_state import ErrorModel, Level, Transition, check_bias_sigma
from terranav.ins.grades import GRADES
from terranav.kernels.strapdown import discretised
from terranav.maps.map import Map
from tests.ins.van_loan import discretised as van_loan

LEVELS: tuple[Level, ...] = ("position", "schuler", "strapdown")
FULL = replace(GRADES["industrial"], position_walk_m_per_sqrt_s=2.0, velocity_walk_mps_per_sqrt_s=0.01)
ON_POSITION_LEVEL = InsGrade(500.0, 0.5, 1.0, 0.02)
SPEED = 60.0


def chart(kind: str = "terrain", sigma: float = 4.0) -> Map:
    values = np.zeros((20, 20), dtype=np.float32)
    return Map(values, (0.001, 0.0, 7.0, 0.0, -0.001, 0.01), kind=kind, unit=KINDS[kind].unit, sigma=sigma)


MAPS = (chart(), chart("gravity", 1.5))


def epoch(t: float, *, velocity: bool = True, attitude: bool = True) -> Epoch:
    """On the equator due east: there a straight flight has one system matrix all along."""
    lat, lon = shift(0.0, 7.0, 0.0, SPEED * t)
    return Epoch(
        t, float(lat), float(lon), 1500.0,
        (0.0, SPEED, 0.0) if velocity else None, (0.0, 2.0, 90.0) if attitude else None,
    )  # fmt: skip


def model(level: Level, ins: InsGrade = FULL, maps: tuple[Map, ...] = MAPS) -> ErrorModel:
    return ErrorModel(ins, maps, level)


def normed(cov: np.ndarray) -> np.ndarray:
    """As a correlation matrix, rows without variance left as they are."""
    sigma = np.sqrt(np.diag(cov))
    sigma[sigma == 0.0] = 1.0
    return np.asarray(cov / np.outer(sigma, sigma))


@given(level=st.sampled_from(LEVELS), dt=st.floats(0.0, 3600.0), start=st.floats(0.0, 1000.0))
def test_noise_is_symmetric_and_never_negative(level: Level, dt: float, start: float) -> None:
    step = model(level).transition(epoch(start), epoch(start + dt))
    assert np.isfinite(step.phi).all()
    np.testing.assert_allclose(step.q, step.q.T, rtol=0.0, atol=0.0)
    assert np.linalg.eigvalsh(normed(step.q)).min() > -1e-7


@given(level=st.sampled_from(LEVELS), dt=st.floats(0.1, 600.0), share=st.floats(0.05, 0.95))
def test_a_step_split_in_two_is_the_step(level: Level, dt: float, share: float) -> None:
    of = model(level)
    split = of.transition(epoch(0.0), epoch(share * dt)).then(of.transition(epoch(share * dt), epoch(dt)))
    whole = of.transition(epoch(0.0), epoch(dt))
    np.testing.assert_allclose(split.phi, whole.phi, rtol=1e-6, atol=1e-9 * np.abs(whole.phi).max())
    sigma = np.sqrt(np.diag(whole.q)) + 1e-9
    np.testing.assert_allclose(split.q / np.outer(sigma, sigma), whole.q / np.outer(sigma, sigma), atol=1e-6)


@pytest.mark.parametrize("level", LEVELS)
def test_no_time_and_no_way_change_nothing(level: Level) -> None:
    step = model(level).transition(epoch(3.0), epoch(3.0))
    np.testing.assert_array_equal(step.phi, np.eye(model(level).size))
    np.testing.assert_array_equal(step.q, np.zeros_like(step.q))


@pytest.mark.parametrize("level", LEVELS)
def test_names_and_matrices_have_the_size(level: Level) -> None:
    of = model(level)
    assert of.size == {"position": 4, "schuler": 8, "strapdown": 13}[level] + 4
    assert len(of.names) == len(set(of.names)) == of.size
    assert of.names[of.bias_index("gravity")] == "gravity_bias"
    assert of.names[of.bias_index("gravity") + 1] == "gravity_patch"
    cov = of.initial_covariance(np.diag([100.0, 400.0]))
    assert cov.shape == (of.size, of.size)
    np.testing.assert_array_equal(cov[:2, :2], np.diag([100.0, 400.0]))
    assert cov[2, 2] == cov[3, 3] == FULL.velocity_sigma_mps**2
    assert np.linalg.eigvalsh(cov).min() >= 0.0


def test_two_steps_as_one_is_what_happens_to_a_covariance() -> None:
    rng = np.random.default_rng(0)
    first, later = (Transition(rng.normal(size=(3, 3)), np.diag(rng.random(3))) for _ in range(2))
    cov = np.diag([1.0, 2.0, 3.0])
    by_one = later.phi @ (first.phi @ cov @ first.phi.T + first.q) @ later.phi.T + later.q
    both = first.then(later)
    np.testing.assert_allclose(both.phi @ cov @ both.phi.T + both.q, by_one)


@given(dt=st.floats(0.01, 3600.0))
def test_position_level_in_closed_form(dt: float) -> None:
    step = model("position", ON_POSITION_LEVEL, ()).transition(epoch(0.0), epoch(dt))
    phi, q = np.eye(4), np.zeros((4, 4))
    for axis in (0, 1):
        phi[axis, axis + 2] = dt
        q[axis, axis] = dt + 0.02**2 * dt**3 / 3.0
        q[axis, axis + 2] = q[axis + 2, axis] = 0.02**2 * dt**2 / 2.0
        q[axis + 2, axis + 2] = 0.02**2 * dt
    np.testing.assert_allclose(step.phi, phi, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(step.q, q, rtol=1e-9, atol=1e-12)


@given(dt=st.floats(0.01, 3600.0))
def test_schuler_level_in_closed_form(dt: float) -> None:
    """Groves, 2nd ed., section 5.7: responses to velocity, tilt and gyro bias; variances of the two white noises."""
    g, w = GRAVITY_MPS2, SCHULER_RAD_PER_S
    sin, cos = math.sin(w * dt), math.cos(w * dt)
    ins = replace(FULL, position_walk_m_per_sqrt_s=0.0, velocity_walk_mps_per_sqrt_s=0.0)
    step = model("schuler", ins, ()).transition(epoch(0.0), epoch(dt))
    one = np.array([
        [1.0, sin / w, (1.0 - cos) / w**2, (dt - sin / w) / w**2],
        [0.0, cos, sin / w, (1.0 - cos) / w**2],
        [0.0, -w * sin, cos, sin / w],
        [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip
    np.testing.assert_allclose(step.phi[::2, ::2], one, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(step.phi[1::2, 1::2], one, rtol=1e-6, atol=1e-12)
    assert np.count_nonzero(step.phi[::2, 1::2]) == 0
    tilting, kicking = (
        (g * math.radians(ins.gyro_walk_deg_per_sqrt_h) / 60.0) ** 2,
        (ins.accel_walk_mps_per_sqrt_h / 60.0) ** 2,
    )
    twice = math.sin(2.0 * w * dt) / (4.0 * w)
    expected = tilting * (0.5 * dt - twice) / w**2 + kicking * (0.5 * dt + twice)
    assert step.q[2, 2] == pytest.approx(expected, rel=1e-4)
    assert step.q[3, 3] == step.q[2, 2]


@pytest.mark.parametrize("name", [*sorted(GRADES), "swinging"])
def test_schuler_level_is_the_drift_that_add_drift_draws(name: str) -> None:
    """Position and velocity of 400 drifts, two axes each, against the model's covariance up to twenty minutes."""
    swinging = InsGrade(10.0, 1.0, 0.5, 0.02, 0.005, 0.0, 0.05, 20.0, 0.01, 0.1)
    ins, runs, times = GRADES.get(name, swinging), 400, np.arange(0.0, 1201.0, 20.0)
    of = model("schuler", ins, ())
    cov, covs = of.initial_covariance(np.eye(2) * ins.position_sigma_m**2), {}
    for before, after in pairwise(times.tolist()):
        step = of.transition(epoch(before), epoch(after))
        cov = step.phi @ cov @ step.phi.T + step.q
        covs[after] = cov[:4, :4]
    drifts = np.array([np.hstack(draw_drift(times, ins, np.random.default_rng(seed))) for seed in range(runs)])
    for i in (15, 30, 60):
        nees = np.einsum("ni,ij,nj->n", drifts[:, i], np.linalg.inv(covs[times[i]]), drifts[:, i]).mean() / 4.0
        assert nees == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / (4.0 * runs)))
        grown = np.mean((drifts[:, i, :2] - drifts[:, 0, :2]) ** 2)
        expected = covs[times[i]][0, 0] - ins.position_sigma_m**2
        assert grown == pytest.approx(expected, rel=4.0 * math.sqrt(2.0 / (2.0 * runs)))


def test_a_patch_is_stationary_and_correlated_along_the_way() -> None:
    of = model("position")
    i = of.bias_index("terrain") + 1
    var = of.initial_covariance(np.eye(2))[i, i]
    assert var == 16.0
    step = of.transition(epoch(0.0), epoch(1.5))
    assert step.phi[i, i] == pytest.approx(math.exp(-1.5 * SPEED / MAPS[0].error_length_m), rel=1e-6)
    assert step.phi[i, i] ** 2 * var + step.q[i, i] == pytest.approx(var, rel=1e-12)
    resting = of.transition(epoch(0.0), replace(epoch(0.0), time_s=600.0))
    assert resting.phi[i, i] == 1.0
    assert resting.q[i, i] == 0.0


def test_a_bias_walks_with_time_alone() -> None:
    of = model("schuler")
    step = of.transition(epoch(0.0), replace(epoch(0.0), time_s=100.0))
    for kind in ("terrain", "gravity"):
        i = of.bias_index(kind)
        assert step.phi[i, i] == 1.0
        assert step.q[i, i] == pytest.approx(KINDS[kind].bias_walk ** 2 * 100.0)
        assert np.count_nonzero(step.phi[i]) == np.count_nonzero(step.q[i]) == 1


def test_bias_sigma_is_the_kinds_unless_told() -> None:
    of = ErrorModel(FULL, MAPS, "position", {"gravity": 0.5})
    cov = of.initial_covariance(np.eye(2))
    assert cov[of.bias_index("gravity"), of.bias_index("gravity")] == 0.25
    assert cov[of.bias_index("terrain"), of.bias_index("terrain")] == KINDS["terrain"].bias_sigma ** 2


@pytest.mark.parametrize(
    ("given_sigma", "message"),
    [
        ({"terain": 1.0}, r"unknown kind in ukf bias_sigma 'terain' \(did you mean 'terrain'\?\)"),
        ({"terrain": -1.0}, "ukf bias_sigma terrain"),
        ({"terrain": math.nan}, "ukf bias_sigma terrain"),
        ({"terrain": "wide"}, "ukf bias_sigma terrain"),
    ],
)
def test_a_bias_sigma_that_is_none_is_refused(given_sigma: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_bias_sigma("ukf", given_sigma)


def test_level_is_the_most_that_is_known() -> None:
    known = epoch(0.0)
    assert ErrorModel.level_for(FULL, known) == "strapdown"
    assert ErrorModel.level_for(FULL, epoch(0.0, attitude=False)) == "schuler"
    assert ErrorModel.level_for(FULL, epoch(0.0, velocity=False)) == "schuler"
    for ins in (ON_POSITION_LEVEL, InsGrade(accel_walk_mps_per_sqrt_h=0.1), InsGrade(heading_sigma_deg=1.0)):
        assert ErrorModel.level_for(ins, known) == "position"
    for ins in (
        InsGrade(attitude_sigma_deg=0.1),
        InsGrade(accel_bias_sigma_ug=0.1),
        InsGrade(gyro_bias_sigma_deg_per_h=0.1),
        InsGrade(gyro_walk_deg_per_sqrt_h=0.1),
    ):
        assert ErrorModel.level_for(ins, known) == "strapdown"


def test_on_a_straight_flight_strapdown_and_schuler_agree() -> None:
    """Level, due east, no heading error: the same covariance from other states, but for the Earth's turning."""
    ins = replace(GRADES["tactical"], heading_sigma_deg=0.0, position_sigma_m=1.0)
    start = np.eye(2) * ins.position_sigma_m**2
    sigmas = []
    for level in ("schuler", "strapdown"):
        of = model(level, ins, ())
        cov = of.initial_covariance(start)
        for t in range(300):
            step = of.transition(epoch(float(t)), epoch(t + 1.0))
            cov = step.phi @ cov @ step.phi.T + step.q
        sigmas.append(np.sqrt(np.diag(cov)[:4]))
    np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=0.02)


def test_discretised_is_the_integral() -> None:
    """Against a plain sum over a thousand small steps."""
    f, noise, dt, n = np.array([[0.0, 1.0], [-4e-4, -0.01]]), np.diag([0.3, 2.0]), 5.0, 1000
    g = np.sqrt(noise)
    phi, q = discretised(f, g, dt)
    small, h, total = np.eye(2), dt / n, np.zeros((2, 2))
    step, _ = discretised(f, g, h)
    half, _ = discretised(f, g, 0.5 * h)
    for _ in range(n):
        total += half @ small @ noise @ small.T @ half.T * h
        small = step @ small
    np.testing.assert_allclose(phi, small, rtol=1e-9)
    np.testing.assert_allclose(q, total, rtol=1e-5)


@pytest.mark.parametrize("dt", [0.0, 0.02, 1.0, 9.0, 61.0, 3600.0])
@pytest.mark.parametrize("level", ["position", "schuler"])
def test_steps_of_the_planar_levels_as_by_van_loan(level: Level, dt: float) -> None:
    w2 = SCHULER_RAD_PER_S**2
    f = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -w2, 0.0, 1.0], [0.0, 0.0, 0.0, 0.0]])
    gyro = GRAVITY_MPS2 * math.radians(FULL.gyro_walk_deg_per_sqrt_h) / 60.0
    speed2 = FULL.velocity_walk_mps_per_sqrt_s**2 + (FULL.accel_walk_mps_per_sqrt_h / 60.0) ** 2
    noise = np.diag([FULL.position_walk_m_per_sqrt_s**2, speed2, gyro**2, 0.0])
    if level == "position":
        f, noise = np.array([[0.0, 1.0], [0.0, 0.0]]), noise[:2, :2]
    phi, q = van_loan(f, noise, dt)
    found = model(level, FULL, ()).transition(epoch(0.0), epoch(dt))
    np.testing.assert_allclose(found.phi, np.kron(phi, np.eye(2)), rtol=1e-8, atol=1e-12)
    scale = np.sqrt(np.diag(q)) + 1e-6
    np.testing.assert_allclose(
        found.q / np.kron(np.outer(scale, scale), np.ones((2, 2))),
        np.kron(q / np.outer(scale, scale), np.eye(2)),
        atol=1e-9,
    )

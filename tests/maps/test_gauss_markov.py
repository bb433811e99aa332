"""Gauss-Markov processes and fields: Van Loan against the closed form, covariances against the theory."""

from __future__ import annotations

import math

import numpy as np
import pytest

from terranav.core.errors import ConfigError
from terranav.kernels.gauss_markov import continue_field
from terranav.maps.gauss_markov import GaussMarkov, _recursion, gauss_markov_field, gauss_markov_map

PAPER_TERRAIN = (GaussMarkov(20.0, 0.01), 1.0)
PAPER_MOTION = (GaussMarkov(10.0, 0.51), 1.0)
both = pytest.mark.parametrize(("process", "step"), [PAPER_TERRAIN, PAPER_MOTION, (GaussMarkov(1.0, 2.0), 3.0)])


@both
def test_van_loan_equals_the_closed_form(process: GaussMarkov, step: float) -> None:
    """Roots (-1 +- i) w / sqrt 2: exp(F d) in cos and sin; Q is what stationarity demands, P - Phi P Phi'."""
    w = process.omega
    a = w / math.sqrt(2.0)
    c, s, decay = math.cos(a * step), math.sin(a * step), math.exp(-a * step)
    expected = decay * np.array([[c + s, s / a], [-(w**2) * s / a, c - s]])
    transition, noise = process.van_loan(step)
    np.testing.assert_allclose(transition, expected, rtol=1e-9, atol=1e-15)
    stationary = np.diag([process.sigma**2, (w * process.sigma) ** 2])
    np.testing.assert_allclose(noise, stationary - expected @ stationary @ expected.T, atol=1e-9 * process.sigma**2)


@both
def test_the_series_has_the_autocorrelation_of_the_process(process: GaussMarkov, step: float) -> None:
    """Exactly, by carrying covariances: R(k d) = first element of Phi^k P, and that of the ARMA form."""
    transition, _ = process.van_loan(step)
    lags = np.arange(12)
    theory = process.autocorrelation(lags * step)
    stationary = np.diag([process.sigma**2, (process.omega * process.sigma) ** 2])
    states = [float((np.linalg.matrix_power(transition, int(k)) @ stationary)[0, 0]) for k in lags]
    np.testing.assert_allclose(states, theory, atol=1e-10 * process.sigma**2)

    a1, a2, b0, b1, l11, l21, l22 = _recursion(process, step)
    answers = []  # each column of the linear map from the 12 + 2 normal numbers to the series
    for unit in np.eye(14):
        s1, s2 = l11 * unit[12], l21 * unit[12] + l22 * unit[13]
        series = []
        for k in range(12):
            y = s1 + b0 * unit[k]
            s1, s2 = a1 * y + b1 * unit[k] + s2, a2 * y
            series.append(y)
        answers.append(series)
    made = np.array(answers).T @ np.array(answers)
    np.testing.assert_allclose(made, theory[np.abs(lags[:, None] - lags)], atol=2e-7 * process.sigma**2)


def test_field_matches_the_theory_along_and_across() -> None:
    """Products R(i) R(j): 60 fields of 25 x 15 correlation lengths, within four times the scatter between fields."""
    process, one = GaussMarkov(20.0, 0.1), GaussMarkov(1.0, 0.1)
    lags = [(0, 0), (1, 0), (0, 1), (7, 0), (0, 7), (20, 0), (0, 20), (9, 13), (40, 0), (0, 40)]
    found = []
    for seed in range(60):
        field = gauss_markov_field(np.random.default_rng(seed), 250, 150, (one, process), 1.0)
        found.append([np.mean(field[i:, j:] * field[: 250 - i, : 150 - j]) for i, j in lags])
    theory = [float(process.autocorrelation(np.array(i)) * one.autocorrelation(np.array(j))) for i, j in lags]
    error = np.std(found, axis=0, ddof=1) / math.sqrt(len(found))
    assert (error < 0.05 * 400.0).all()
    assert (np.abs(np.mean(found, axis=0) - theory) < 4.0 * error).all()


def test_field_is_stationary_from_its_first_row_and_column() -> None:
    process, one = GaussMarkov(3.0, 0.05), GaussMarkov(1.0, 0.05)
    rng = np.random.default_rng(0)
    fields = np.array([gauss_markov_field(rng, 70, 5, (one, process), 1.0) for _ in range(1000)])
    corners = fields[:, [0, 0, 1, 69, 69], [0, 4, 0, 0, 4]]
    np.testing.assert_allclose(corners.var(axis=0), 9.0, rtol=4.0 * math.sqrt(2.0 / 1000))
    down = np.mean(fields[:, 0, 0] * fields[:, 10, 0])
    assert down == pytest.approx(float(process.autocorrelation(np.array(10.0))), abs=4.0 * 9.0 * 1.4 / math.sqrt(1000))


def test_kernel_equals_its_python_source() -> None:
    across, down = _recursion(GaussMarkov(2.0, 0.3), 1.0), _recursion(GaussMarkov(1.0, 0.1), 1.0)
    white = np.random.default_rng(1).standard_normal((6, 9))
    outs = []
    for function in (continue_field, continue_field.py_func):
        start, out = np.ones((2, 7)), np.empty((6, 7))
        function(white, across, down, start, out)
        outs.append(np.concatenate([out, start]))
    np.testing.assert_allclose(outs[0], outs[1], rtol=1e-12)


def test_profile_has_the_covariance_of_value_and_slope() -> None:
    process, step = PAPER_MOTION
    state = process.profile(np.random.default_rng(2), 60_000, step)
    np.testing.assert_allclose(np.cov(state.T), [[100.0, 0.0], [0.0, 26.01]], atol=3.0)
    lag = float(np.mean(state[3:, 0] * state[:-3, 0]))
    assert lag == pytest.approx(float(process.autocorrelation(np.array(3.0))), abs=3.0)
    assert (process.profile(np.random.default_rng(2), 5, step, from_rest=True)[0] == 0.0).all()


def test_map_of_any_kind_and_range() -> None:
    chart = gauss_markov_map(np.random.default_rng(3), shape=(40, 60), spacing_m=30.0, kind="gravity", mean=10.0)
    assert chart.shape == (40, 60)
    assert (chart.kind, chart.unit) == ("gravity", "mGal")
    assert chart.cell_m == pytest.approx(30.0, rel=1e-6)
    same = gauss_markov_map(np.random.default_rng(3), shape=(40, 60), spacing_m=30.0, kind="gravity", mean=10.0)
    assert same.checksum == chart.checksum
    stretched = gauss_markov_map(np.random.default_rng(3), shape=(40, 60), value_range=(35.0, 80.0))
    assert (stretched.values.min(), stretched.values.max()) == (pytest.approx(35.0), pytest.approx(80.0))


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("sigma", 0.0),
        ("omega_rad_per_m", -1.0),
        ("spacing_m", 0.0),
        ("shape", (1, 5)),
        ("value_range", (3.0, 3.0)),
        ("mean", math.nan),
        ("kind", "soup"),
    ],
)
def test_settings_out_of_range_are_named(setting: str, value: object) -> None:
    with pytest.raises(ConfigError, match=setting.split("_", maxsplit=1)[0]):
        gauss_markov_map(np.random.default_rng(0), **{"shape": (4, 4), setting: value})  # type: ignore[arg-type]

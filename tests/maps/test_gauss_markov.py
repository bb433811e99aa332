"""Gauss-Markov processes and fields: Van Loan against the closed form, covariances against the theory."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from terranav.core.errors import ConfigError
from terranav.kernels.gauss_markov import TILE, continue_field
from terranav.kernels.random import normal_pairs
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


def series(white: np.ndarray, numbers: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The filter of `continue_field` along the last axis, by scipy."""
    a1, a2, b0, b1 = numbers[:4]
    return np.asarray(lfilter([b0, b1], [1.0, -a1, -a2], white, zi=start)[0])


def white_rows(key: int, rows: int, cols: int) -> np.ndarray:
    """The noise of `continue_field`: (rows, cols + 2), the last two start a row's filter."""
    pairs, out = (cols + 1) // 2 + 1, np.empty((rows, cols + 2))
    for i in range(rows):
        left, right = np.empty(pairs), np.empty(pairs)
        normal_pairs(np.uint64(key), i * pairs, left, right)
        parts = []
        for begin in range(0, cols, TILE):
            at = slice(begin // 2, begin // 2 + (min(TILE, cols - begin) + 1) // 2)
            parts.append(np.concatenate([left[at], right[at]])[: min(TILE, cols - begin)])
        out[i] = np.concatenate([*parts, [left[-1], right[-1]]])
    return out


@pytest.mark.parametrize(("rows", "cols"), [(6, 9), (1, 1), (5, 2), (2, TILE), (9, TILE + 1), (4, 2 * TILE + 7)])
def test_kernel_equals_scipys_filters_compiled_or_not(rows: int, cols: int) -> None:
    across, down = _recursion(GaussMarkov(2.0, 0.3), 1.0), _recursion(GaussMarkov(1.0, 0.1), 1.0)
    white, start = white_rows(7, rows + 3, cols)[3:], np.random.default_rng(1).normal(size=(2, cols))
    l11, l21, l22 = across[4:]
    begin = np.stack([l11 * white[:, cols], l21 * white[:, cols] + l22 * white[:, cols + 1]], axis=-1)
    lines = series(white[:, :cols], across, begin)
    expected = 50.0 + series(lines.T, down, start.T).T
    for function in (continue_field, continue_field.py_func):
        state, out = start.copy(), np.empty((rows, cols))
        function(np.uint64(7), 3, across, down, state, 50.0, out)
        np.testing.assert_allclose(out, expected, rtol=1e-11)
        if rows > 1:  # in two parts it is the same, to the last bit
            state, parts = start.copy(), np.empty((rows, cols))
            function(np.uint64(7), 3, across, down, state, 50.0, parts[:1])
            function(np.uint64(7), 4, across, down, state, 50.0, parts[1:])
            np.testing.assert_array_equal(parts, out)


def test_a_map_is_its_field_in_single_precision() -> None:
    field = gauss_markov_field(
        np.random.default_rng(3), 40, 70, (GaussMarkov(1.0, 0.01), GaussMarkov(20.0, 0.01)), 30.0
    )
    chart = gauss_markov_map(np.random.default_rng(3), shape=(40, 70), spacing_m=30.0, mean=57.5)
    np.testing.assert_array_equal(chart.values, (field + 57.5).astype(np.float32))


def test_a_field_that_does_not_fit_is_refused_before_it_is_made() -> None:
    rng = np.random.default_rng(0)
    for value_range in (None, (0.0, 1.0)):
        with pytest.raises(ConfigError, match=r"gauss_markov map of 4000000 x 4000000 cells: needs \d+\.\d GiB"):
            gauss_markov_map(rng, shape=(4_000_000, 4_000_000), value_range=value_range)
    process = GaussMarkov(1.0, 0.1)
    with pytest.raises(ConfigError, match=r"gauss_markov field of 4000000 x 4000000 cells: needs \d+\.\d GiB"):
        gauss_markov_field(rng, 4_000_000, 4_000_000, (process, process), 1.0)


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

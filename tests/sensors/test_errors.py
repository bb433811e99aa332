"""Error models of the height sensors: laws, published bands, bad tables."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from terranav.core.errors import ConfigError
from terranav.sensors.altimeter import Altimeter, slant_factor
from terranav.sensors.bands import Band, HeightSensor
from terranav.sensors.barometer import Barometer

RADAR = Altimeter.from_table({"preset": "paper_003"})
BARO = Barometer.from_table({"preset": "paper_003"})


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@given(heights=arrays(np.float64, 20, elements=st.floats(0.0, 9000.0)), kind=st.sampled_from([Altimeter, Barometer]))
def test_a_sensor_without_errors_gives_the_truth(heights: np.ndarray, kind: type[HeightSensor]) -> None:
    np.testing.assert_array_equal(kind().measure(heights, rng()), heights)


@pytest.mark.parametrize(
    ("height", "sigma"),
    [(20.0, 0.02), (30.0, 0.03), (100.0, 0.3), (1000.0, 4.0), (2000.0, 8.0), (2000.1, math.nan), (-1.0, math.nan)],
)
def test_radar_bands_of_paper_003(height: float, sigma: float) -> None:
    np.testing.assert_allclose(RADAR.sigma([height]), [sigma], rtol=1e-12)


@pytest.mark.parametrize(
    ("height", "sigma"), [(0.0, 1.0), (-50.0, 1.0), (1000.0, 2.0), (2000.0, 8.0), (5000.0, 17.0), (5001.0, math.nan)]
)
def test_barometer_bands_of_paper_003(height: float, sigma: float) -> None:
    np.testing.assert_allclose(BARO.sigma([height]), [sigma], rtol=1e-12)


def test_noise_has_the_sigma_that_is_told() -> None:
    heights = np.repeat([20.0, 100.0, 1500.0, 3000.0], 20000)
    error = (RADAR.measure(heights, rng(1)) - heights).reshape(4, -1)
    np.testing.assert_allclose(error[:3].std(axis=1), [0.02, 0.3, 6.0], rtol=0.03)
    assert np.isnan(error[3]).all()


def test_bias_scale_and_resolution() -> None:
    sensor = Altimeter(bias_m=2.0, scale_error=0.01)
    np.testing.assert_allclose(sensor.measure([0.0, 100.0, 500.0], rng()), [2.0, 103.0, 507.0])
    coarse = Altimeter(resolution_m=0.5)
    np.testing.assert_allclose(coarse.measure([10.1, 10.3, 10.6], rng()), [10.0, 10.5, 10.5])


@pytest.mark.parametrize(("share", "length"), [(0.1, 1.0), (0.2, 8.0), (0.5, 3.0)])
def test_dropouts_have_their_share_and_length(share: float, length: float) -> None:
    sensor = Altimeter(dropout_probability=share, dropout_length=length)
    lost = np.isnan(sensor.measure(np.full(200_000, 100.0), rng(2)))
    starts = np.count_nonzero(lost[1:] & ~lost[:-1])
    assert lost.mean() == pytest.approx(share, rel=0.06)
    assert lost.sum() / starts == pytest.approx(length, rel=0.06)


def test_barometer_drift_is_gauss_markov_whatever_the_sampling() -> None:
    sensor = Barometer(drift_sigma_m=10.0, drift_correlation_s=50.0)
    for step in (1.0, 25.0):
        time = step * np.arange(100_000)
        drift = sensor.measure(np.zeros(time.size), rng(3), time)
        lag = round(50.0 / step)
        assert drift.std() == pytest.approx(10.0, rel=0.1)
        assert np.mean(drift[lag:] * drift[:-lag]) / drift.var() == pytest.approx(math.exp(-1.0), abs=0.06)


def test_same_seed_same_bits() -> None:
    sensor = Barometer.from_table({"preset": "paper_003", "drift_sigma_m": 5.0, "dropout_probability": 0.1})
    heights = np.linspace(0.0, 4000.0, 500)
    np.testing.assert_array_equal(sensor.measure(heights, rng(4)), sensor.measure(heights, rng(4)))


def test_unknown_true_height_gives_no_reading() -> None:
    assert np.isnan(Altimeter().measure([np.nan], rng())).all()


def test_table_with_one_band_and_with_several() -> None:
    one = Altimeter.from_table({"kind": "laser", "sigma_m": 0.1, "sigma_fraction": 0.001, "max_m": 500.0})
    assert one == Altimeter(kind="laser", bands=(Band(500.0, 0.1, 0.001),))
    several = Altimeter.from_table({"bands": [{"below_m": 50, "sigma_m": 0.5}, {"below_m": 900, "sigma_m": 2}]})
    np.testing.assert_allclose(several.sigma([10.0, 100.0, 1000.0]), [0.5, 2.0, np.nan])
    assert RADAR.column == "radar_altitude_m"
    assert one.column == "laser_altitude_m"
    assert BARO.column == "baro_altitude_m"


@pytest.mark.parametrize(
    ("kind", "table", "message"),
    [
        (Altimeter, {"sigma": 3.0}, "unknown altimeter key 'sigma' (did you mean 'sigma_m'?)"),
        (Altimeter, {"kind": "lazer"}, "unknown altimeter kind 'lazer' (did you mean 'laser'?)"),
        (Altimeter, {"preset": "paper_03"}, "unknown altimeter preset 'paper_03' (did you mean 'paper_003'?)"),
        (Altimeter, {"sigma_m": -1.0}, "band sigma_m is -1.0, expected a finite number and >= 0"),
        (Altimeter, {"sigma_m": "3"}, "band sigma_m is '3'"),
        (Altimeter, {"dropout_probability": 1.5}, "altimeter dropout_probability is 1.5"),
        (Altimeter, {"dropout_probability": 0.9, "dropout_length": 2.0}, "altimeter dropout_length is 2.0"),
        (Altimeter, {"scale_error": -1.0}, "altimeter scale_error is -1.0"),
        (Altimeter, {"resolution_m": math.inf}, "altimeter resolution_m is inf"),
        (Altimeter, {"min_m": 50.0, "max_m": 40.0}, "altimeter min_m is 50.0"),
        (Altimeter, {"bands": []}, "altimeter bands is []"),
        (Altimeter, {"bands": [3]}, "altimeter bands holds 3"),
        (Altimeter, {"bands": [{"below": 3}]}, "unknown altimeter band key 'below' (did you mean 'below_m'?)"),
        (
            Altimeter,
            {"bands": [{"below_m": 9}, {"below_m": 5}]},
            "altimeter bands end at [9, 5] m, expected increasing",
        ),
        (Altimeter, {"bands": [{"below_m": 9}], "sigma_m": 1.0}, "altimeter: bands is given beside sigma_m"),
        (Barometer, {"drift_sigma": 3.0}, "unknown barometer key 'drift_sigma' (did you mean 'drift_sigma_m'?)"),
        (Barometer, {"drift_sigma_m": -3.0}, "barometer drift_sigma_m is -3.0"),
        (Barometer, {"drift_correlation_s": 0.0}, "barometer drift_correlation_s is 0.0"),
    ],
)
def test_bad_tables_get_one_clear_line(kind: type[HeightSensor], table: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        kind.from_table(table)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_bands_of_another_kind_are_refused() -> None:
    with pytest.raises(ConfigError, match="at least one Band"):
        Altimeter(bands=())


def test_slant_factor_is_the_down_component_of_the_body_axis() -> None:
    np.testing.assert_allclose(slant_factor([0.0, 60.0, 0.0, 60.0], [0.0, 0.0, 60.0, 60.0]), [1.0, 0.5, 0.5, 0.25])

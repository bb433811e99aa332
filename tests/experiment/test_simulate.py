"""Simulated flights: the same bits, the right statistics, and clear lines where a flight is impossible."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terranav.core.errors import ConfigError, DataError
from terranav.core.recording import Recording
from terranav.experiment.compare import compare
from terranav.experiment.demo import demo_scenario
from terranav.experiment.scenario import Scenario
from terranav.experiment.simulate import _unit_field, simulate
from terranav.maps.sample_dem import sample_map
from tests.experiment.helpers import equal_columns

BASE: dict[str, Any] = {
    "maps": [{"file": "sample"}],
    "route": {
        "waypoints_deg": [[36.52, -84.33], [36.54, -84.25], [36.58, -84.25]],
        "altitude_m": 1500.0,
        "speed_mps": 80.0,
        "rate_hz": 2.0,
    },
    "ins": {"mode": "drift", "position_sigma_m": 300.0},
    "sensors": {"radar_altimeter": {"sigma_m": 2.0}, "barometer": {"sigma_m": 1.5}},
}


def scenario(**tables: Any) -> Scenario:
    return Scenario.from_dict({**BASE, **tables})


def route(**keys: Any) -> dict[str, Any]:
    return {**BASE["route"], **keys}


def below(rec: Recording) -> np.ndarray[Any, Any]:
    """Height of the map below the vehicle."""
    return sample_map().sample(rec.columns["true_lat_deg"], rec.columns["true_lon_deg"])


def test_same_seed_same_bits() -> None:
    flight = scenario(ins={"grade": "tactical"}, map_error={"sigma": 3.0}, seed=5)
    assert equal_columns(simulate(flight), simulate(flight, seed=5))
    assert not equal_columns(simulate(flight), simulate(flight, seed=6))


def test_readings_are_of_the_truth_with_the_noise_that_was_asked_for() -> None:
    rec = simulate(scenario(), seed=1)
    columns = rec.columns
    np.testing.assert_allclose(columns["true_alt_m"], 1500.0)
    clearance = columns["radar_altitude_m"] - (1500.0 - below(rec))
    assert np.std(clearance) == pytest.approx(2.0, rel=0.15)
    assert abs(clearance.mean()) < 0.5
    assert np.std(columns["baro_altitude_m"] - 1500.0) == pytest.approx(1.5, rel=0.15)
    assert dict(rec.sigma) == {"radar_altitude_m": 2.0, "baro_altitude_m": 1.5}
    np.testing.assert_allclose(rec.time_s, 0.5 * np.arange(len(rec)))
    assert rec.ins is not None
    assert rec.ins.position_sigma_m == 300.0
    assert rec.source["maps"].startswith("jacksboro ")


def test_initial_errors_have_the_sigma_of_the_grade() -> None:
    short = route(waypoints_deg=[[36.52, -84.33], [36.521, -84.33]], rate_hz=1.0)
    for ins in ({"mode": "drift", "position_sigma_m": 300.0}, {"grade": "navigation", "position_sigma_m": 300.0}):
        flight = scenario(route=short, ins=ins)
        first = np.array([simulate(flight, seed=seed).ins_error_m()[0] for seed in range(40)])
        assert np.sqrt(np.mean(first**2)) == pytest.approx(300.0, rel=0.25)


def test_a_sensor_more_leaves_the_others_as_they_were() -> None:
    plain = simulate(scenario(), seed=3)
    more = simulate(
        scenario(sensors={**BASE["sensors"], "laser_altimeter": {"sigma_m": 0.3}, "terrain": {"sigma": 1.0}}), seed=3
    )
    for key, values in plain.columns.items():
        np.testing.assert_array_equal(more.columns[key], values)
    assert set(more.columns) - set(plain.columns) == {"laser_altitude_m", "terrain_m"}
    assert np.std(more.columns["terrain_m"] - below(more)) == pytest.approx(1.0, rel=0.15)
    slant = np.cos(np.radians(more.columns["roll_deg"])) * np.cos(np.radians(more.columns["pitch_deg"]))
    vertical = more.columns["laser_altitude_m"] * slant
    assert np.std(vertical - (1500.0 - below(more))) < 1.0


def test_periods_and_told_sigmas() -> None:
    sensors = {"radar_altimeter": {"sigma_m": 2.0, "period_s": 5.0, "told_sigma_m": 9.0}, "barometer": {}}
    rec = simulate(scenario(sensors=sensors), seed=1)
    read = np.flatnonzero(np.isfinite(rec.columns["radar_altitude_m"]))
    assert set(np.diff(read)) == {10}
    assert dict(rec.sigma) == {"radar_altitude_m": 9.0, "baro_altitude_m": 0.1}


def test_told_ins_is_what_the_recording_says() -> None:
    rec = simulate(scenario(ins_told={"velocity_sigma_mps": 4.0}), seed=1)
    assert rec.ins is not None
    assert rec.ins.velocity_sigma_mps == 4.0
    np.testing.assert_array_equal(rec.lat_deg, simulate(scenario(), seed=1).lat_deg)


def test_the_barometer_holds_the_indicated_altitude() -> None:
    biased = {**BASE["sensors"], "barometer": {"bias_m": 40.0, "dropout_probability": 0.2}}
    for ins in (BASE["ins"], {"grade": "tactical"}):
        rec = simulate(scenario(sensors=biased, ins=ins), seed=2)
        assert np.mean(rec.alt_m[20:]) == pytest.approx(1540.0, abs=5.0)
    without = simulate(scenario(sensors={"radar_altimeter": {}}), seed=2)
    np.testing.assert_allclose(without.alt_m, 1500.0)


def test_map_error_has_the_sigma_and_correlation_asked_for() -> None:
    rng, at = np.random.default_rng(0), np.array([0.0, 50.0, 100.0, 250.0, 800.0])
    drawn = np.array([_unit_field(at, 0.0 * at, 100.0, rng) for _ in range(800)])
    expected = np.exp(-0.5 * (at / 100.0) ** 2)
    np.testing.assert_allclose(drawn.T @ drawn[:, 0] / 800.0, expected, atol=0.12)
    quiet: dict[str, Any] = {"radar_altimeter": {}, "barometer": {}}
    rec = simulate(scenario(map_error={"sigma": 20.0, "correlation_m": 60.0}, sensors=quiet), seed=4)
    miss = rec.columns["true_alt_m"] - rec.columns["radar_altitude_m"] - below(rec)
    assert np.std(miss) == pytest.approx(20.0, rel=0.25)


@pytest.mark.parametrize(
    ("tables", "error", "message"),
    [
        (
            {"route": route(waypoints_deg=[[36.52, -84.33], [36.52, -84.50]])},
            DataError,
            r"the route leaves the map jacksboro after 9\d s at \(36\.5200, -84\.4",
        ),
        (
            {"route": route(altitude_m=400.0)},
            DataError,
            r"\[route\] altitude is 400 m after \d+ s over ground",
        ),
        (
            {"ins": {"grade": "tactical", "imu_rate_hz": 51.0}},
            ConfigError,
            r"\[ins\] imu_rate_hz is 51, expected a whole multiple of \[route\] rate_hz \(2\)",
        ),
        (
            {"sensors": {"gravity": {"sigma": 1.0}}},
            ConfigError,
            r"\[sensors\.gravity\] has nothing to measure, expected a table \[\[maps\]\] with kind = 'gravity'",
        ),
        (
            {"route": route(waypoints_deg=[[36.52, -84.33], [36.521, -84.33], [36.521, -84.32]])},
            ConfigError,
            "turn at waypoint 2 with radius",
        ),
    ],
)
def test_impossible_flights(tables: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        simulate(scenario(**tables))


def test_the_demo_stays_well_inside_its_map_and_needs_help() -> None:
    flight = demo_scenario()
    rec = simulate(flight)
    assert 600.0 <= rec.time_s[-1] <= 900.0
    lat, lon = rec.columns["true_lat_deg"], rec.columns["true_lon_deg"]
    south, west, north, east = sample_map().bounds_deg
    assert min(lat.min() - south, north - lat.max()) > 0.03
    assert min(lon.min() - west, east - lon.max()) > 0.03
    results = compare(flight.methods(), rec, flight.open_maps(), seed=flight.seed, prior=flight.initial_prior())
    assert results["ins"].metrics()["final_m"] > 1000.0
    assert results["pointmass"].metrics(after_first_fix=True)["drms_m"] < 120.0

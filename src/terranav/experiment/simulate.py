"""Fly a scenario: the truth, what the INS makes of it, and what the sensors read."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray

from terranav.core.earth import offset_m
from terranav.core.errors import ConfigError, DataError
from terranav.core.kinds import KINDS
from terranav.core.recording import TRUTH, Recording
from terranav.experiment.run import check_seed
from terranav.experiment.scenario import Scenario
from terranav.experiment.scenario_tables import HeightSensorTable
from terranav.ins.drift import add_drift
from terranav.ins.strapdown import free_inertial
from terranav.ins.trajectory import Trajectory, fly
from terranav.maps.map import Map
from terranav.sensors.altimeter import slant_factor

FloatArray = NDArray[np.float64]

#: each draws from a generator of its own, so that adding one leaves the others as they were
_STREAMS = ("ins", "barometer", "radar_altimeter", "laser_altimeter", "map_error", *KINDS)
_IMU_RATE_HZ = 50.0  # at least, unless the scenario says otherwise
_WAVES = 400  # cosines that make up a map error
_IDEAL_SIGMA_M = 0.1  # told of a sensor without noise: a sigma must be positive


def simulate(scenario: Scenario, seed: int | None = None) -> Recording:
    """Fly a scenario once.

    The sensors look straight down at the true field: the map, plus the error of [map_error]. A laser altimeter, fixed
    to the body, reads the slant range over ground taken as flat at the height below the vehicle.

    Parameters
    ----------
    scenario : Scenario
    seed : int, optional
        Else the scenario's own. The same seed gives the same bits.

    Returns
    -------
    Recording
        With truth, raw readings, and what the estimators are to be told: `ins` and `sigma`.

    Raises
    ------
    DataError
        When the route leaves a map, crosses a void, or goes below ground.
    ConfigError
        When a turn does not fit into the route, or rates do not go together.
    """
    seed = scenario.seed if seed is None else seed
    check_seed(seed)
    children = SeedSequence(seed).spawn(len(_STREAMS))
    rng = {name: np.random.default_rng(child) for name, child in zip(_STREAMS, children, strict=True)}
    dense, truth = _flown(scenario)
    maps = scenario.open_maps()
    fields = {chart.kind: _true_field(scenario, chart, truth, rng["map_error"]) for chart in maps}
    readings = _Readings(scenario, truth)
    baro = readings.barometer(rng["barometer"])
    if "terrain" in fields:
        readings.altimeters(fields["terrain"], rng)
    readings.fields(fields, rng)
    return Recording(
        {**_indicated(scenario, dense, truth, baro, rng["ins"]), **truth.truth(), **readings.columns},
        ins=scenario.told_ins(),
        sigma=readings.sigma,
        source={
            "made_by": "terranav simulate",
            "scenario": scenario.name,
            "seed": str(seed),
            "maps": ", ".join(f"{chart.name} {chart.checksum[:12]}" for chart in maps),
        },
        name=scenario.name,
    )


def _flown(scenario: Scenario) -> tuple[Trajectory, Trajectory]:
    """The true trajectory at the rate of the IMU (if there is one), and at the epochs."""
    rate_hz, route = scenario.route.rate_hz, scenario.route.build()
    if scenario.ins.mode == "drift":
        truth = fly(route, rate_hz)
        return truth, truth
    imu_rate_hz = _imu_rate_hz(scenario)
    dense = fly(route, imu_rate_hz)
    return dense, dense.every(round(imu_rate_hz / rate_hz))


def _imu_rate_hz(scenario: Scenario) -> float:
    """Samples of the IMU a second, a whole multiple of the epochs."""
    rate_hz, given_hz = scenario.route.rate_hz, scenario.ins.imu_rate_hz
    if given_hz is None:
        return rate_hz * math.ceil(_IMU_RATE_HZ / rate_hz)
    stride = round(given_hz / rate_hz)
    if stride < 1 or not math.isclose(stride * rate_hz, given_hz, rel_tol=1e-9):
        raise ConfigError(
            f"{scenario.name}: [ins] imu_rate_hz is {given_hz:g}, "
            f"expected a whole multiple of [route] rate_hz ({rate_hz:g})"
        )
    return given_hz


def _true_field(scenario: Scenario, chart: Map, truth: Trajectory, rng: Generator) -> FloatArray:
    """The true field (n,) below the vehicle: the map and, where the scenario has it, the map's error."""
    value = chart.sample(truth.lat_deg, truth.lon_deg)
    bad = np.flatnonzero(np.isnan(value))
    if bad.size:
        i = int(bad[0])
        what = "crosses a void of" if chart.covers(truth.lat_deg[i], truth.lon_deg[i]) else "leaves"
        raise DataError(
            f"{scenario.name}: the route {what} the map {chart.name} after {truth.time_s[i]:.0f} s at "
            f"({truth.lat_deg[i]:.4f}, {truth.lon_deg[i]:.4f}), expected it on the map all the way"
        )
    if scenario.map_error is None:
        return value
    north, east = offset_m(truth.lat_deg[0], truth.lon_deg[0], truth.lat_deg, truth.lon_deg)
    return value + scenario.map_error.sigma * _unit_field(north, east, scenario.map_error.correlation_m, rng)


def _unit_field(north_m: FloatArray, east_m: FloatArray, correlation_m: float, rng: Generator) -> FloatArray:
    """A random field of unit variance at (n,) places, covariance exp(-d^2 / (2 L^2)).

    A sum of cosines with wave numbers from the field's spectrum, a normal distribution of sigma 1 / L, and random
    phases (Rahimi and Recht, Random features for large-scale kernel machines, 2007): the same place has the same value
    whenever it is crossed.
    """
    waves = rng.standard_normal((_WAVES, 2)) / correlation_m
    phase = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    total = np.zeros(north_m.size)
    for (n, e), shift in zip(waves, phase, strict=True):
        total += np.cos(n * north_m + e * east_m + shift)
    return np.asarray(total * np.sqrt(2.0 / _WAVES))


@dataclass
class _Readings:
    """Readings as they are taken, column by column, with the 1-sigma that is told of each."""

    scenario: Scenario
    truth: Trajectory

    def __post_init__(self) -> None:
        self.columns: dict[str, FloatArray] = {}
        self.sigma: dict[str, float] = {}

    def barometer(self, rng: Generator) -> FloatArray | None:
        """Read the barometer, if there is one."""
        table = self.scenario.sensors.barometer
        if table is None:
            return None
        sensor = table.build()
        reading = sensor.measure(self.truth.alt_m, rng, self.truth.time_s)
        spread = np.hypot(sensor.sigma(self.truth.alt_m), sensor.drift_sigma_m)
        return self._keep(sensor.column, reading, table, spread)

    def altimeters(self, terrain_m: FloatArray, rng: dict[str, Generator]) -> None:
        """Read the altimeters there are."""
        sensors, truth = self.scenario.sensors, self.truth
        clearance = truth.alt_m - terrain_m
        for name, table in (("radar_altimeter", sensors.radar_altimeter), ("laser_altimeter", sensors.laser_altimeter)):
            if table is None:
                continue
            i = int(clearance.argmin())
            if clearance[i] <= 0.0:
                raise DataError(
                    f"{self.scenario.name}: [route] altitude is {truth.alt_m[i]:.0f} m after {truth.time_s[i]:.0f} s "
                    f"over ground of {terrain_m[i]:.0f} m, expected it above the ground"
                )
            slant = slant_factor(*truth.attitude_deg.T[:2]) if name == "laser_altimeter" else 1.0
            sensor, distance = table.build(), clearance / slant
            reading = sensor.measure(distance, rng[name], truth.time_s)
            self._keep(sensor.column, reading, table, sensor.sigma(distance))

    def fields(self, fields: dict[str, FloatArray], rng: dict[str, Generator]) -> None:
        """Read the sensors that measure a field itself."""
        for kind in KINDS.values():
            table = getattr(self.scenario.sensors, kind.name)
            if table is None:
                continue
            if kind.name not in fields:
                raise ConfigError(
                    f"{self.scenario.name}: [sensors.{kind.name}] has nothing to measure, "
                    f"expected a table [[maps]] with kind = {kind.name!r}"
                )
            noise = rng[kind.name].standard_normal(len(self.truth))
            reading = kind.sign * (fields[kind.name] + table.bias + table.sigma * noise)
            self.columns[kind.column] = self._thinned(reading, table.period_s)
            self.sigma[kind.column] = table.sigma

    def _keep(self, column: str, reading: FloatArray, table: HeightSensorTable, spread_m: FloatArray) -> FloatArray:
        """Store a height sensor's readings and the sigma told of them: its root mean square where it reads."""
        self.columns[column] = self._thinned(reading, table.period_s)
        known = spread_m[np.isfinite(spread_m)]
        own = float(np.sqrt(np.mean(known**2))) if known.size else 0.0
        self.sigma[column] = table.told_sigma_m or max(own, _IDEAL_SIGMA_M)
        return self.columns[column]

    def _thinned(self, reading: FloatArray, period_s: float | None) -> FloatArray:
        """Readings every `period_s` only, the others NaN."""
        step = 1 if period_s is None else max(1, round(period_s * self.scenario.route.rate_hz))
        return np.where(np.arange(reading.size) % step == 0, reading, np.nan)


def _indicated(
    scenario: Scenario, dense: Trajectory, truth: Trajectory, baro_m: FloatArray | None, rng: Generator
) -> dict[str, FloatArray]:
    """What the INS indicates at the epochs; its altitude is held by the barometer, if there is one that reads."""
    held = None if baro_m is None or np.isnan(baro_m).all() else _bridged(truth.time_s, baro_m)
    grade = scenario.ins.build()
    if scenario.ins.mode == "strapdown":
        return free_inertial(
            dense,
            grade,
            rng,
            scenario.route.rate_hz,
            imu_rate_hz=_imu_rate_hz(scenario),
            baro_altitude_m=None if held is None else np.interp(dense.time_s, truth.time_s, held),
        ).columns()
    exact = Recording({**truth.columns(), **truth.truth()}, name=scenario.name)
    columns = {name: value for name, value in add_drift(exact, grade, rng).columns.items() if name not in TRUTH}
    return columns if held is None else {**columns, "alt_m": held}


def _bridged(time_s: FloatArray, value: FloatArray) -> FloatArray:
    """Values (n,) with the NaN among them interpolated."""
    known = np.isfinite(value)
    return np.interp(time_s, time_s[known], value[known])

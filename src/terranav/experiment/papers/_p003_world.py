"""The flights of papers/003, Table 1: maps, traces, the INS and the readings, and how each printed figure is read.

- Speed 200 m/s, sample step 2 s, from west to east at a constant height (Figures 4 and 5).
- Initial longitude and latitude error 0.003 degrees: that error, east and north, in every run; a reading of its own
  draws it from a normal distribution of that sigma.
- Gyroscopes 0.1 deg/h and accelerometers 1e-4 g (100 micro-g) on each axis: constant biases of that 1-sigma. Over the
  minute of the flight they move the position by two metres.
- Barometer and radar altimeter bands (0.1 % h + 1 m and so on): 1-sigma, h the height that the sensor measures;
  unavailable above 5000 m and 2000 m (presets 'paper_003' of the sensors).
- The height of flight is not said: here 300 m above the highest ground of the trace, where both sensors work; the mean
  height error then is 2 to 6 m, the paper's (Table 2) 3 to 5 m.
- Degrees are degrees of arc of latitude and longitude as they stand; a distance in degrees is taken along a meridian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree, offset_m, shift
from terranav.core.errors import ConfigError
from terranav.core.records import Epoch, Measurement
from terranav.experiment.papers.outcome import Setup
from terranav.ins.drift import draw_drift
from terranav.ins.grades import grade_named
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map
from terranav.sensors.altimeter import Altimeter
from terranav.sensors.barometer import Barometer

FloatArray = NDArray[np.float64]

SPEED_MPS, STEP_S = 200.0, 2.0
ERROR_DEG = 0.003
ABOVE_M = 300.0
DEGREE_M = float(metres_per_degree(45.0)[0])
INS = grade_named("paper_003")


@dataclass(frozen=True)
class Land:
    """A map and its name."""

    name: str
    chart: Map


@dataclass(frozen=True)
class Track:
    """A straight trace from west to east: (n,) places, the ground below and the height of flight."""

    lat_deg: FloatArray
    lon_deg: FloatArray
    ground_m: FloatArray
    slope: FloatArray
    alt_m: float


@dataclass(frozen=True)
class Flight:
    """What one run hands to an estimator, and the truth.

    Attributes
    ----------
    epochs : tuple of Epoch
    true_deg : (n, 2)
    height_error_m : (n,)
        Measured less true elevation; NaN without a reading.
    """

    epochs: tuple[Epoch, ...]
    true_deg: FloatArray
    height_error_m: FloatArray


def lands(setup: Setup) -> list[Land]:
    """The maps: those given, or the sample DEM and two generated fields with mean slopes of the paper's Table 2."""
    if setup.maps:
        found = [Land(chart.name, chart) for chart in setup.maps if chart.kind == "terrain"]
        if not found:
            kinds = ", ".join(chart.kind for chart in setup.maps)
            raise ConfigError(f"paper 003: the maps given are of kind {kinds}, expected terrain")
        return found
    return [
        Land("Jacksboro", sample_map()),
        Land("field, slope 0.25", field(0.25, 31)),
        Land("field, slope 0.10", field(0.10, 32)),
    ]


def field(mean_slope: float, seed: int) -> Map:
    """A Gaussian field on the paper's 90 m grid, correlated over 1 km, with this mean slope."""
    correlation_m = 1000.0
    std = mean_slope * correlation_m / np.sqrt(np.pi)  # each component of the slope has sigma sqrt(2) std / length
    rng = np.random.default_rng(seed)
    return gaussian_map(rng, std=std, correlation_m=correlation_m, cells=256, cell_m=90.0, sigma=0.0)


def track(land: Land, samples: int, share: float = 0.5) -> Track:
    """A trace of so many samples across the middle of a map, at a share of its extent from the south.

    Raises
    ------
    ConfigError
        The map is too small for it, or has a void there.
    """
    south, west, north, east = land.chart.bounds_deg
    lat, lon = south + share * (north - south), 0.5 * (west + east)
    along = SPEED_MPS * STEP_S * (np.arange(samples) - 0.5 * (samples - 1))
    lats, lons = np.full(samples, lat), shift(lat, lon, 0.0, along)[1]
    ground = land.chart.sample(lats, lons)
    if np.isnan(ground).any():
        raise ConfigError(
            f"paper 003: map {land.name} has no values along a trace of {along[-1] - along[0]:.0f} m from west to east "
            f"at {lat:.4f} N, expected a map that covers it"
        )
    slope = np.hypot(*land.chart.gradient(lats, lons))
    return Track(lats, lons, ground, slope, float(ground.max()) + ABOVE_M)


def flight(way: Track, rng: Generator, *, drawn: bool = False) -> Flight:
    """One run along a trace; `drawn`: the initial error is drawn instead of being 0.003 degrees."""
    n = way.lat_deg.size
    time_s = STEP_S * np.arange(n, dtype=np.float64)
    drift = draw_drift(time_s, INS, rng)[0]
    start = np.array(offset_m(way.lat_deg[0], way.lon_deg[0], way.lat_deg[0] + ERROR_DEG, way.lon_deg[0] + ERROR_DEG))
    error = drift - drift[0] + start * (rng.standard_normal(2) if drawn else 1.0)
    lat, lon = shift(way.lat_deg, way.lon_deg, *error.T)
    barometer, radar = Barometer.from_table({"preset": "paper_003"}), Altimeter.from_table({"preset": "paper_003"})
    altitude, clearance = np.full(n, way.alt_m), way.alt_m - way.ground_m
    height = barometer.measure(altitude, rng) - radar.measure(clearance, rng)
    sigma = np.hypot(barometer.sigma(altitude), radar.sigma(clearance))
    epochs = tuple(
        Epoch(
            float(time_s[i]),
            float(lat[i]),
            float(lon[i]),
            way.alt_m,
            (0.0, SPEED_MPS, 0.0),
            None,
            (Measurement("terrain", float(height[i]), float(sigma[i])),) if np.isfinite(height[i]) else (),
        )
        for i in range(n)
    )
    return Flight(epochs, np.stack([way.lat_deg, way.lon_deg], axis=1), height - way.ground_m)

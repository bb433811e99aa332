"""What the sensors read: GNSS with its troubles, altimeter and barometer with their errors, and the ground below.

The errors of the whole flight are drawn before it, each from a generator of its own, so that what the vehicle does or
is told never changes what the sensors do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.signal import lfilter

from terranav.core.earth import offset_of, shifted
from terranav.live.testbed.aircraft import AircraftState
from terranav.live.testbed.settings import FlightSettings
from terranav.maps.map import Map
from terranav.sensors.altimeter import Altimeter
from terranav.sensors.bands import Band

FloatArray = NDArray[np.float64]

#: ticks of the navigation a second: INS, barometer and altimeter are read at each, GNSS at every second one
RATE_HZ = 10
GNSS_EVERY = 2
_WAVES = 200
_GNSS_SLOW_M, _GNSS_SLOW_S = (1.2, 1.2, 2.5), 60.0  # of a receiver's slowly varying error north, east, down
_GNSS_WHITE_M, _GNSS_WHITE_MPS = (0.2, 0.2, 0.4), 0.05
_JAM_S = 12.0  # from the first noise to the loss of the fix


class Ground:
    """The true ground: the map, and an error of the map that stays where it is (a sum of cosines).

    Parameters
    ----------
    chart : Map
        Its `sigma` and `error_length_m` are those of the error.
    rng : Generator
    """

    def __init__(self, chart: Map, rng: Generator) -> None:
        self._chart, self._origin = chart, chart.centre_deg
        self._waves = rng.standard_normal((_WAVES, 2)) / chart.error_length_m
        self._phase = rng.uniform(0.0, 2.0 * math.pi, _WAVES)
        self._size = chart.sigma * math.sqrt(2.0 / _WAVES)

    def height(self, lat_deg: float, lon_deg: float) -> float:
        """Above mean sea level [m]; NaN off the map and in voids."""
        mapped = float(self._chart.sample(lat_deg, lon_deg))
        if math.isnan(mapped):
            return mapped
        offset = np.array(offset_of(*self._origin, lat_deg, lon_deg))
        return mapped + self._size * float(np.cos(self._waves @ offset + self._phase).sum())


class Ranges:
    """Readings of the altimeter, one a tick.

    Parameters
    ----------
    altimeter : Altimeter
    ticks : int
    rng : Generator
    """

    def __init__(self, altimeter: Altimeter, ticks: int, rng: Generator) -> None:
        self._altimeter = altimeter
        plain = replace(altimeter, bands=(Band(sigma_m=1.0),), min_m=-math.inf, bias_m=0.0, scale_error=0.0)
        # one sigma of noise, NaN where the reading is lost: the size follows from the height when it is known
        self._noise = replace(plain, resolution_m=0.0).measure(np.zeros(ticks), rng)
        self.limits_m = (max(altimeter.min_m, 0.0), altimeter.bands[-1].below_m)

    def read(self, tick: int, clearance_m: float) -> float | None:
        """The reading [m]: infinite beyond the range, None where there is none."""
        noise = float(self._noise[tick])
        if math.isnan(noise) or math.isnan(clearance_m):
            return None
        if not self.limits_m[0] <= clearance_m < self.limits_m[1]:
            return math.inf
        sensor = self._altimeter
        reading = (1.0 + sensor.scale_error) * clearance_m + sensor.bias_m + self._sigma_m(clearance_m) * noise
        if sensor.resolution_m > 0.0:
            reading = sensor.resolution_m * round(reading / sensor.resolution_m)
        return reading if self.limits_m[0] <= reading < self.limits_m[1] else math.inf

    def _sigma_m(self, clearance_m: float) -> float:
        """1-sigma of the noise within the range: `HeightSensor.sigma` of a single height, in a tenth of its time."""
        band = next(band for band in self._altimeter.bands if clearance_m <= band.below_m)
        return band.sigma_m + band.sigma_fraction * clearance_m


def pressure_errors(settings: FlightSettings, ticks: int, rng: Generator) -> FloatArray:
    """Error of the barometer's height (ticks,) [m]; what drops out is the reading before."""
    error = settings.barometer.measure(np.zeros(ticks), rng, np.arange(ticks) / RATE_HZ)
    known = np.isfinite(error)
    return np.interp(np.arange(ticks), np.flatnonzero(known), error[known]) if known.any() else np.zeros(ticks)


def winds(settings: FlightSettings, ticks: int, rng: Generator) -> FloatArray:
    """Wind north and east (ticks, 2) [m/s]: a steady one from anywhere, and gusts that last some seconds."""
    towards = rng.uniform(0.0, 2.0 * math.pi)
    gusts = _slow(np.full(2, 0.2 * settings.wind_mps), 8.0, 1.0 / RATE_HZ, ticks, rng)
    return settings.wind_mps * np.array([math.cos(towards), math.sin(towards)]) + gusts


@dataclass(frozen=True, slots=True)
class GnssReading:
    """What the receiver says.

    Attributes
    ----------
    lat_deg, lon_deg, alt_m : float
    velocity_mps : (north, east, down)
    sigma_m, height_sigma_m, velocity_sigma_mps : float
        The accuracy that it claims.
    satellites : int
    """

    lat_deg: float
    lon_deg: float
    alt_m: float
    velocity_mps: tuple[float, float, float]
    sigma_m: float
    height_sigma_m: float
    velocity_sigma_mps: float
    satellites: int


class Gnss:
    """The receiver, every second tick.

    Parameters
    ----------
    settings : FlightSettings
    ticks : int
    rng : Generator
    """

    def __init__(self, settings: FlightSettings, ticks: int, rng: Generator) -> None:
        count = ticks // GNSS_EVERY + 1
        slow = _slow(np.array(_GNSS_SLOW_M), _GNSS_SLOW_S, GNSS_EVERY / RATE_HZ, count, rng)
        self._error = slow + rng.standard_normal((count, 3)) * _GNSS_WHITE_M
        self._velocity = _GNSS_WHITE_MPS * rng.standard_normal((count, 3))
        self._noise = rng.standard_normal((count, 3))
        self._pull = rng.uniform(0.0, 2.0 * math.pi)
        self._settings = settings

    def read(self, tick: int, truth: AircraftState) -> GnssReading | None:
        """The reading at a tick; None without a fix."""
        told, time_s, k = self._settings, tick / RATE_HZ, tick // GNSS_EVERY
        jammed_s = time_s - told.jam_at_s
        if time_s >= told.gnss_off_s or jammed_s >= _JAM_S:
            return None
        share = max(jammed_s, 0.0) / _JAM_S
        noise = 30.0 * share**2  # [m], a tenth of it [m/s]
        north, east, down = (self._error[k] + noise * self._noise[k]).tolist()
        speed = truth.velocity_mps + self._velocity[k] + 0.1 * noise * self._noise[k]
        pulled_s = max(time_s - told.spoof_at_s, 0.0)
        if pulled_s > 0.0:
            pull = told.spoof_mps * np.array([math.cos(self._pull), math.sin(self._pull), 0.0])
            north, east = north + float(pull[0]) * pulled_s, east + float(pull[1]) * pulled_s
            speed = speed + pull
        lat, lon = shifted(truth.lat_deg, truth.lon_deg, north, east)
        velocity: tuple[float, float, float] = tuple(speed.tolist())
        claimed = 1.0 + 1.5 * noise
        return GnssReading(lat, lon, truth.alt_m - down, velocity, 1.5 * claimed, 2.5 * claimed, 0.1 * claimed,
                           round(15 - 10 * share))  # fmt: skip


def _slow(sigma: FloatArray, correlation_s: float, dt_s: float, count: int, rng: Generator) -> FloatArray:
    """First-order Gauss-Markov errors (count, k), stationary from the start."""
    keep = math.exp(-dt_s / correlation_s)
    fresh = rng.standard_normal((count, sigma.size))
    fresh[1:] *= math.sqrt(1.0 - keep * keep)
    return np.asarray(lfilter([1.0], [1.0, -keep], fresh, axis=0)) * sigma

"""The flights of papers/004: its numbers, the land at 60 m, the readings of its drift, and both methods' bare fixes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree, shift
from terranav.core.errors import DataError
from terranav.kernels.fading_memory import recall
from terranav.kernels.tercom import correlation_surface
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

CELL_M = 60.0
SPEED_MPS = 0.9 * 340.3  # Mach 0.9 near sea level
RATE_HZ = 4.0
NOISE_M = math.hypot(15.0, 3.0)  # radar and barometric altimeter
PROFILE = 48  # readings of a TERCOM profile
ALPHA = 0.985
HALF_M = 3000.0  # the search area is 6 x 6 km
INITIAL_M = 2000.0  # 1-sigma per axis
DRIFT = 5.0  # m/s per axis
MATCH_M = math.sqrt(2.0) * CELL_M
EPOCHS = 4 * PROFILE
FIXES = np.array([2 * PROFILE, 3 * PROFILE, 4 * PROFILE])  # readings at which both methods give a fix

#: how the drift may act, in the order of the tables
READINGS = {
    "none": "drift taken out before the match",
    "walk": "random walk of 5 m/s sqrt(s)",
    "drawn": "constant, drawn with 1-sigma 5 m/s",
    "constant": "constant 5 m/s",
}


@dataclass(frozen=True)
class Flight:
    """One straight flight: true track, noise of the readings, and the INS error at each reading under each reading."""

    lat_deg: FloatArray
    lon_deg: FloatArray
    noise_m: FloatArray
    error_m: dict[str, FloatArray]  # (n, 2) each


@dataclass(frozen=True)
class Seen:
    """A flight as its INS indicates it under one reading of the drift."""

    frames: FloatArray  # (n, 2, 6)
    error_m: FloatArray  # (n, 2)


def resampled(chart: Map) -> Map:
    """A map of 60 m cells of the same place; without map error, of which the paper has none.

    Raises
    ------
    DataError
        When the map is too small for a flight with the search area on either side.
    """
    south, west, north, east = chart.bounds_deg
    centre = 0.5 * (south + north), 0.5 * (west + east)
    per_lat, per_lon = (float(each) for each in metres_per_degree(centre[0]))
    down, right = CELL_M / per_lat, CELL_M / per_lon
    rows, cols = int((north - south) / down), int((east - west) / right)
    need = 2.0 * _margin_m() + 0.75 * EPOCHS / RATE_HZ * SPEED_MPS
    if min(rows, cols) * CELL_M < need:
        raise DataError(
            f"{chart.name}: the map is {rows * CELL_M / 1000.0:.0f} x {cols * CELL_M / 1000.0:.0f} km, "
            f"expected at least {need / 1000.0:.0f} km each way for the search area of papers/004 beside a flight"
        )
    lat = centre[0] + (0.5 * (rows - 1) - np.arange(rows)) * down
    lon = centre[1] + (np.arange(cols) - 0.5 * (cols - 1)) * right
    transform = (right, 0.0, float(lon[0]) - 0.5 * right, 0.0, -down, float(lat[0]) + 0.5 * down)
    values = chart.sample(lat[:, None], lon[None, :], method="bicubic")
    return replace(chart, values=values, transform=transform, crs="EPSG:4326", sigma=0.0)


def relieved(land: Map, factor: float) -> Map:
    """The land with its heights about their mean times a factor."""
    mean = float(np.nanmean(land.values))
    return replace(land, values=mean + factor * (land.values - mean))


def draw(land: Map, rng: Generator) -> Flight:
    """A flight over the land, anywhere and in any direction in which the search area stays on the map."""
    rows, cols = land.shape
    room = 0.5 * CELL_M * np.array([rows - 1, cols - 1]) - _margin_m()
    length = (EPOCHS - 1) * SPEED_MPS / RATE_HZ
    while True:
        heading, middle = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-room, room)
        way = length * np.array([math.cos(heading), math.sin(heading)])
        if (np.abs(middle) + 0.5 * np.abs(way) <= room).all():
            break
    place = middle + (np.arange(EPOCHS)[:, None] / (EPOCHS - 1) - 0.5) * way
    lat, lon = shift(*land.centre_deg, *place.T)
    time_s = np.arange(EPOCHS)[:, None] / RATE_HZ
    velocity, steps = rng.standard_normal(2), rng.standard_normal((EPOCHS, 2))
    steps[0] = 0.0
    gained = {
        "none": np.zeros((EPOCHS, 2)),
        "walk": DRIFT / math.sqrt(RATE_HZ) * np.cumsum(steps, axis=0),
        "drawn": DRIFT * velocity * time_s,
        "constant": DRIFT * np.ones(2) * time_s,
    }
    while True:
        initial = rng.normal(0.0, INITIAL_M, 2)
        if max(float(np.abs(initial + each).max()) for each in gained.values()) < HALF_M - CELL_M:
            break
    noise = rng.normal(0.0, NOISE_M, EPOCHS)
    return Flight(lat, lon, noise, {key: initial + each for key, each in gained.items()})


def indicated(land: Map, flight: Flight, reading: str) -> Seen:
    """The flight as its INS indicates it."""
    error = flight.error_m[reading]
    places = np.stack(shift(flight.lat_deg, flight.lon_deg, *error.T), axis=1)
    frames = [land.local_frame(lat, lon, math.sqrt(2.0) * HALF_M) for lat, lon in places.tolist()]
    return Seen(np.array([(frame.row, frame.col) for frame in frames]), error)


def lattice() -> FloatArray:
    """(101,) errors of the search grid along one axis [m]."""
    count = round(HALF_M / CELL_M)
    return CELL_M * np.arange(-count, count + 1, dtype=np.float64)


def tercom_misses(land: Map, seen: Seen, measured_m: FloatArray) -> FloatArray:
    """(fixes,) distance of the smallest MSD of the latest 48 readings from the error at the last of them [m]."""
    axis = lattice()
    score, valid = np.empty((axis.size, axis.size)), np.empty((axis.size, axis.size))
    misses = []
    for last in FIXES:
        part = slice(last - PROFILE, last)
        readings = np.stack([measured_m[part], np.ones(PROFILE)], axis=1)
        correlation_surface(land.values, seen.frames[part], readings, (axis, axis), False, False, score, valid)
        misses.append(_miss(score, seen.error_m[last - 1]))
    return np.array(misses)


def fading_misses(land: Map, seen: Seen, measured_m: FloatArray) -> FloatArray:
    """(fixes,) distance of the smallest aSD (eqs. 4 and 11) at the same readings from the same errors [m]."""
    axis = lattice()
    surface, spare = np.zeros((axis.size, axis.size)), np.empty((axis.size, axis.size))
    misses = []
    for k in range(EPOCHS):
        recall(land.values, seen.frames[k], (axis, axis), (measured_m[k], 1.0), ALPHA, surface, spare)
        surface, spare = spare, surface
        if k + 1 in FIXES:
            misses.append(_miss(surface, seen.error_m[k]))
    return np.array(misses)


def measured(land: Map, flight: Flight) -> FloatArray:
    """(n,) terrain heights as measured (eq. 2) [m]."""
    height = land.sample(flight.lat_deg, flight.lon_deg) + flight.noise_m
    if np.isnan(height).any():
        raise DataError(f"{land.name}: the flight crosses a void of the map, expected heights all the way")
    return height


def relief_m(land: Map, flight: Flight) -> float:
    """Standard deviation of the heights along the track [m]."""
    return float(np.std(land.sample(flight.lat_deg, flight.lon_deg)))


def _miss(surface: FloatArray, error_m: FloatArray) -> float:
    """Distance of the smallest value of a surface from the true error [m]."""
    i, j = np.unravel_index(int(np.nanargmin(surface)), surface.shape)
    return float(np.hypot(lattice()[i] - error_m[0], lattice()[j] - error_m[1]))


def _margin_m() -> float:
    """How far from the true track the search may look: an INS error and half the search area."""
    return 2.0 * HALF_M

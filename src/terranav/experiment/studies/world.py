"""A world that is exactly as the navigator is told, or wrong in one stated way.

Readings along a true track: y = h(true position) + bias + patch + white noise (`terranav.ins.error_state`), where

- bias: a constant drawn from `bias_sigma`, with the random walk of its kind;
- patch: the map's error, a stationary Ornstein-Uhlenbeck process along the track of sigma `map.sigma` and correlation
  length `map.error_length_m`: over a distance d, patch <- exp(-d/length) patch + N(0, (1 - exp(-2 d/length)) sigma^2);
- white noise: normal, of variance sigma^2 + (blur cells * cell * slope)^2, the slope being that of the bilinear patch.

The INS is that of `terranav.add_drift` on position level: the same model again. The map lies where it says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import offset_m, shift
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS
from terranav.core.recording import Recording
from terranav.experiment.studies.tracks import INS, SENSOR_SIGMA_M, Track, World
from terranav.ins.drift import add_drift
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

_STEP_M = 0.05  # of the difference quotient that takes a bilinear patch's slope


@dataclass(frozen=True)
class Flown:
    """A recording of a track in some world, and the bias of its readings (n,) in the map's sign [unit]."""

    rec: Recording
    bias: FloatArray


def flown(track: Track, world: World, rng: Generator) -> Flown:
    """One flight. Worlds that differ by a factor or an offset are given the same draws by the same generator."""
    true, chart, kind = track.true_recording(), track.chart, KINDS[track.kind]
    lat, lon = true.lat_deg, true.lon_deg
    n = len(true)
    drift, readings = rng.spawn(2)
    bias = world.bias + _bias(readings, world, chart, true.time_s)
    error = bias + _patch(readings, chart, lat, lon) + _white(readings, world, chart, lat, lon)
    gross = readings.random(n) < world.gross_share
    error = error + np.where(gross, np.where(readings.random(n) < 0.5, -1.0, 1.0) * world.gross_size, 0.0)
    column = true.columns[kind.column] + kind.sign * error
    walk = world.walk_factor * INS.position_walk_m_per_sqrt_s
    real = InsGrade(INS.position_sigma_m, INS.velocity_sigma_mps, walk)
    drifted = add_drift(true.with_columns(**{kind.column: column}), real, drift)
    told = Recording(drifted.columns, INS, drifted.sigma, drifted.source, drifted.name)
    return Flown(told, bias)


def _bias(rng: Generator, world: World, chart: Map, time_s: FloatArray) -> FloatArray:
    """(n,) bias with its walk [unit]."""
    kind = KINDS[chart.kind]
    sigma = kind.bias_sigma if world.bias_sigma is None else world.bias_sigma
    steps = rng.standard_normal(len(time_s)) * np.sqrt(np.diff(time_s, prepend=time_s[0]))
    return np.asarray(sigma * rng.standard_normal() + kind.bias_walk * np.cumsum(steps))


def _patch(rng: Generator, chart: Map, lat: FloatArray, lon: FloatArray) -> FloatArray:
    """(n,) map error of the ground below [unit]."""
    travelled = np.hypot(*offset_m(lat[:-1], lon[:-1], lat[1:], lon[1:]))
    draws = rng.standard_normal(len(lat))
    patch = np.empty(len(lat))
    patch[0] = draws[0]
    for i, away in enumerate((travelled / chart.error_length_m).tolist()):
        patch[i + 1] = math.exp(-away) * patch[i] + math.sqrt(-math.expm1(-2.0 * away)) * draws[i + 1]
    return chart.sigma * patch


def _white(rng: Generator, world: World, chart: Map, lat: FloatArray, lon: FloatArray) -> FloatArray:
    """(n,) noise of sensor and of the place within a cell [unit]."""
    slope2 = np.zeros(len(lat))
    for north, east in ((_STEP_M, 0.0), (0.0, _STEP_M)):
        rise = chart.sample(*shift(lat, lon, north, east)) - chart.sample(*shift(lat, lon, -north, -east))
        slope2 += (rise / (2.0 * _STEP_M)) ** 2
    variance = SENSOR_SIGMA_M**2 + (world.blur_cells * chart.cell_m) ** 2 * slope2
    return np.asarray(world.noise_factor * np.sqrt(variance) * rng.standard_normal(len(lat)))

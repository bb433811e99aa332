"""Flights in which something goes wrong, and the monitored navigator over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Estimate, Measurement, Prior
from terranav.experiment.registry import make_estimator
from terranav.experiment.stream import states
from terranav.ins.drift import draw_drift
from terranav.integrity.monitored import Monitored
from terranav.integrity.state import MonitorState
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map

INS = InsGrade(position_sigma_m=300.0, velocity_sigma_mps=0.5, position_walk_m_per_sqrt_s=1.0)
SPEED_MPS = 60.0
SIGMA = {"terrain": 3.0, "gravity": 1.0}
MAP_SIGMA = {"terrain": 2.0, "gravity": 0.5}
PRIOR = Prior.from_ins(INS)

FloatArray = NDArray[np.float64]


@cache
def ground(number: int = 0, std: float = 60.0, length_m: float = 500.0) -> Map:
    rng = np.random.default_rng([number, 1])
    return gaussian_map(rng, std=std, correlation_m=length_m, cells=800, cell_m=60.0, sigma=MAP_SIGMA["terrain"])


@cache
def gravity(number: int = 0) -> Map:
    rng = np.random.default_rng([number, 2])
    return gaussian_map(
        rng, std=25.0, correlation_m=1200.0, mean=0.0, cells=300, cell_m=100.0, kind="gravity",
        sigma=MAP_SIGMA["gravity"],
    )  # fmt: skip


@cache
def flat() -> Map:
    return plane_map(0.0, 0.0, cells=500, cell_m=60.0, centre_deg=(45.0, 10.0))


@dataclass(frozen=True)
class Flight:
    """Epochs, the INS error at each (n, 2) [m]."""

    epochs: tuple[Epoch, ...]
    error_m: FloatArray


def flight(
    fields: Sequence[Map],
    seed: int,
    *,
    readings: int = 300,
    rate_s: float = 1.0,
    ins: InsGrade = INS,
    start_m: tuple[float, float] | None = None,
    noise: float = 1.0,
    outliers: tuple[float, float] = (0.0, 0.0),
    walk: float = 1.0,
    jump: tuple[int, float, float] | None = None,
    north_m: float = 0.0,
) -> Flight:
    """A flight along two legs; the fields are what the sensors meet, whatever the navigator's maps are.

    start_m replaces the drawn initial error, noise scales the sensors' sigma, outliers are (share, sigma in sigmas),
    walk scales the INS's walk, jump is (reading, north, east), north_m moves all of it.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(readings, dtype=np.float64) * rate_s
    way = SPEED_MPS * min(rate_s, 1.0) * np.arange(readings)
    half = 0.5 * way[-1]
    north = -0.5 * half + np.minimum(way, half) + north_m
    east = np.where(way < half, 0.3 * way, 0.3 * half + 0.9 * (way - half)) - 0.5 * half
    lat, lon = shift(*fields[0].centre_deg, north, east)
    told = replace(ins, position_walk_m_per_sqrt_s=ins.position_walk_m_per_sqrt_s * walk)
    error, _ = draw_drift(time_s, told, rng)
    if start_m is not None:
        error = error - error[0] + np.array(start_m)
    if jump is not None:
        error[jump[0] :] += np.array(jump[1:])
    ins_lat, ins_lon = shift(lat, lon, *error.T)
    columns = {}
    for chart in fields:
        step = np.exp(-SPEED_MPS * min(rate_s, 1.0) / chart.error_length_m)
        patch = np.empty(readings)
        white = rng.standard_normal(readings)
        patch[0] = white[0]
        for i in range(1, readings):
            patch[i] = step * patch[i - 1] + np.sqrt(1.0 - step**2) * white[i]
        value = chart.sample(lat, lon) + MAP_SIGMA[chart.kind] * patch
        value = value + noise * SIGMA[chart.kind] * rng.standard_normal(readings)
        gross = rng.random(readings) < outliers[0]
        columns[chart.kind] = value + gross * outliers[1] * SIGMA[chart.kind] * rng.standard_normal(readings)
    epochs = tuple(
        Epoch(
            float(t), float(ins_lat[i]), float(ins_lon[i]), 1500.0, (SPEED_MPS, 20.0, 0.0), None,
            tuple(Measurement(kind, float(at[i]), SIGMA[kind]) for kind, at in columns.items() if np.isfinite(at[i])),
        )
        for i, t in enumerate(time_s)
    )  # fmt: skip
    return Flight(epochs, error)


@dataclass(frozen=True)
class Flown:
    """Estimates and states of a run."""

    estimates: list[Estimate]
    states: list[MonitorState]
    off_m: FloatArray

    @property
    def status(self) -> NDArray[Any]:
        return np.array([one.status.value for one in self.estimates])

    @property
    def usable(self) -> NDArray[np.bool_]:
        return np.array([one.usable for one in self.estimates])

    @property
    def level_m(self) -> FloatArray:
        return np.array([one.protection_m for one in self.estimates])

    def beyond(self) -> NDArray[np.bool_]:
        """Epochs with a usable fix whose error is beyond its protection level."""
        return self.usable & (self.off_m > self.level_m)

    def unannounced(self, off_m: float = 1000.0) -> NDArray[np.bool_]:
        """Epochs with an error beyond a distance that are called a fix."""
        return np.isin(self.status, ("converged", "degraded")) & (self.off_m > off_m)

    def said(self, text: str) -> bool:
        return any(text in reason for one in self.estimates for reason in one.reasons)


def flown(
    maps: Sequence[Map], trip: Flight, seed: int = 0, prior: Prior = PRIOR, ins: InsGrade = INS, **settings: Any
) -> Flown:
    navigator = navigator_for(maps, ins, **settings)
    kept = list(states(navigator, prior, trip.epochs, np.random.default_rng([seed, 7])))
    estimates = [navigator.estimate(state) for state in kept]
    off = np.hypot(*(np.array([one.ins_error_m for one in estimates]) - trip.error_m).T)
    return Flown(estimates, kept, off)


def navigator_for(maps: Sequence[Map], ins: InsGrade = INS, **settings: Any) -> Monitored:
    built = make_estimator("marginalized", maps, ins, **settings)
    assert isinstance(built, Monitored)
    return built


def changed(trip: Flight, kind: str, rows: range, value: Callable[[int, float], float]) -> Flight:
    """The flight with the readings of a kind at these rows replaced."""
    epochs = list(trip.epochs)
    for i in rows:
        readings = tuple(
            replace(one, value=value(i, one.value)) if one.kind == kind else one for one in epochs[i].measurements
        )
        epochs[i] = replace(epochs[i], measurements=readings)
    return Flight(tuple(epochs), trip.error_m)

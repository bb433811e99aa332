"""The flights of papers/000: straight over land whose first third is flat, the INS drifting, a reading every 0.25 s."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.protocols import Estimator
from terranav.core.recording import Recording
from terranav.core.records import Prior
from terranav.experiment.stream import states
from terranav.filters.heli_sitan import HeliSitan
from terranav.filters.sitan import Sitan
from terranav.filters.viterbi import Viterbi
from terranav.ins.drift import add_drift
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

SPEED_MPS = 150.0
STEP_S = 0.25
LENGTH_M = 24_000.0  # at most; on a small map less
SIGMA_H_M = 10.0
DRIFT_MPS, WALK_M_PER_SQRT_S = 1.0, 0.5
OUTLIER_SHARE, OUTLIER_SCALE = 0.1, 5.0  # of the mixture
ALTITUDE_M = 3000.0
PAPER, RESTARTS, BANK, HMM, PATH = "SITAN", "SITAN, restarting", "Heli/SITAN", "HMMTEM", "HMMTEM, whole path"
INS = "INS alone"


@dataclass(frozen=True)
class Track:
    """A straight track: latitude and longitude (n,) [deg], and what the ground below it is like.

    `slope_flat` and `slope_rough` are the root mean square slopes along the first third and the rest.
    """

    lat_deg: FloatArray
    lon_deg: FloatArray
    slope_flat: float
    slope_rough: float

    @cached_property
    def time_s(self) -> FloatArray:
        """(n,) [s]."""
        return STEP_S * np.arange(self.lat_deg.size, dtype=np.float64)


@dataclass(frozen=True)
class Case:
    """One map and one size of the initial error."""

    name: str
    chart: Map
    track: Track
    sigma_m: float

    @property
    def ins(self) -> InsGrade:
        """The INS that flies, and what estimators are told of it."""
        return InsGrade(
            position_sigma_m=self.sigma_m,
            velocity_sigma_mps=DRIFT_MPS,
            position_walk_m_per_sqrt_s=WALK_M_PER_SQRT_S,
        )


def flattest_start(chart: Map, margin_m: float) -> Track:
    """The straight track on a map whose first third is flattest against the rest.

    Over all courses (every 5 degrees) and offsets from the middle (every 500 m) that keep `margin_m` from the map's
    edge, the one with the least ratio of root mean square slopes.

    Raises
    ------
    DataError
        When the map has no room for a track of 60 s.
    """
    rows, cols = chart.shape
    room = min(rows, cols) * chart.cell_m
    length = min(LENGTH_M, 0.8 * room)
    count = int(length / (SPEED_MPS * STEP_S)) // 3 * 3
    if count * STEP_S < 60.0:
        raise DataError(
            f"{chart.name}: {room:.0f} m wide, expected a map with room for a flight of 60 s at {SPEED_MPS:g} m/s"
        )
    along = SPEED_MPS * STEP_S * (np.arange(count, dtype=np.float64) - 0.5 * (count - 1))
    best: Track | None = None
    for course in np.radians(np.arange(0.0, 360.0, 5.0)):
        for aside in np.arange(-0.5 * room, 0.5 * room + 1.0, 500.0):
            track = _track(chart, along, float(course), float(aside), margin_m)
            if track is not None and (
                best is None or track.slope_flat * best.slope_rough < best.slope_flat * track.slope_rough
            ):
                best = track
    if best is None:
        raise DataError(
            f"{chart.name}: no straight track of {length:.0f} m without voids keeps {margin_m:.0f} m to the edge"
        )
    return best


def _track(chart: Map, along: FloatArray, course: float, aside: float, margin_m: float) -> Track | None:
    """The track of a course and an offset; None where it comes too near the edge or crosses a void."""
    north, east = (
        along * math.cos(course) - aside * math.sin(course),
        along * math.sin(course) + aside * math.cos(course),
    )
    ends = np.array([0, -1])
    for dn, de in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        if not chart.covers(*shift(*chart.centre_deg, north[ends] + dn * margin_m, east[ends] + de * margin_m)).all():
            return None
    lat, lon = shift(*chart.centre_deg, north, east)
    height = chart.sample(lat, lon)
    if not np.isfinite(height).all():
        return None
    slope2 = (np.diff(height) / (SPEED_MPS * STEP_S)) ** 2
    third = along.size // 3
    return Track(lat, lon, float(np.sqrt(slope2[:third].mean())), float(np.sqrt(slope2[third:].mean())))


def generated(seed: int) -> tuple[Map, Track]:
    """A field whose hills rise from 2 m in the south to 80 m (1-sigma, 600 m wide), and a track from south to north."""
    field = gaussian_map(
        np.random.default_rng(seed), std=1.0, correlation_m=600.0, mean=0.0, cells=512, cell_m=60.0, sigma=0.0
    )
    north = 60.0 * (255.5 - np.arange(512))[:, None]
    border = -LENGTH_M / 6.0
    height = 2.0 + 78.0 / (1.0 + np.exp(-(north - border) / 200.0))
    chart = replace(field, values=300.0 + height * field.values, name="generated")
    count = int(LENGTH_M / (SPEED_MPS * STEP_S)) // 3 * 3
    along = SPEED_MPS * STEP_S * (np.arange(count, dtype=np.float64) - 0.5 * (count - 1))
    track = _track(chart, along, 0.0, 0.0, 0.0)
    if track is None:
        raise DataError("generated: the track leaves the field")
    return chart, track


def noise_m(kind: str, count: int, rng: Generator) -> FloatArray:
    """(n,) errors of readings of standard deviation SIGMA_H_M [m]; the mixture's good readings have it, not all."""
    if kind == "laplace":
        return rng.laplace(0.0, SIGMA_H_M / math.sqrt(2.0), count)
    if kind == "student_t":
        return SIGMA_H_M * math.sqrt(0.5) * rng.standard_t(4.0, count)
    scale = np.ones(count)
    if kind == "mixture":
        scale = np.where(rng.random(count) < OUTLIER_SHARE, OUTLIER_SCALE, 1.0)
    return SIGMA_H_M * scale * rng.standard_normal(count)


def flown(case: Case, noise: str, rng: Generator) -> Recording:
    """One flight: the INS's error drawn, a reading of the terrain at every epoch."""
    track = case.track
    height = case.chart.sample(track.lat_deg, track.lon_deg) + noise_m(noise, track.lat_deg.size, rng)
    exact = Recording(
        {
            "time_s": track.time_s,
            "lat_deg": track.lat_deg,
            "lon_deg": track.lon_deg,
            "alt_m": np.full(track.lat_deg.size, ALTITUDE_M),
            case.chart.kind + "_m": height,
        },
        sigma={case.chart.kind + "_m": SIGMA_H_M},
        name=case.name,
    )
    return add_drift(exact, case.ins, rng)


def methods(case: Case) -> dict[str, Estimator[Any]]:
    """SITAN as published, SITAN that starts over when lost, the bank, and HMMTEM."""
    maps = (case.chart,)
    return {
        PAPER: Sitan(maps, case.ins, restart=False),
        RESTARTS: Sitan(maps, case.ins),
        BANK: HeliSitan(maps, case.ins),
        HMM: Viterbi(maps, case.ins),
    }


def distances(
    case: Case, rec: Recording, estimators: dict[str, Estimator[Any]], rng: Generator
) -> dict[str, FloatArray]:
    """Horizontal error (n,) of each method at each epoch [m]; HMMTEM starts as in eq. 7, the others from a Gaussian."""
    truth = rec.ins_error_m()
    epochs = list(rec.epochs())
    out = {INS: np.hypot(*truth.T)}
    for name, estimator in estimators.items():
        hmm = isinstance(estimator, Viterbi)
        prior = Prior.from_ins(case.ins, "uniform" if hmm else "gaussian")
        said = np.empty_like(truth)
        state: Any = None
        for k, state in enumerate(states(estimator, prior, epochs, rng)):
            said[k] = estimator.estimate(state).ins_error_m
        out[name] = np.hypot(*(said - truth).T)
        if name == HMM and isinstance(estimator, Viterbi):
            out[PATH] = np.hypot(*(estimator.backtrace(state) - truth).T)
    return out

"""A small flight that every test of the experiment package can afford."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from terranav.core.earth import shift
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.ins.drift import add_drift
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map

INS = InsGrade(position_sigma_m=150.0, velocity_sigma_mps=0.3, position_walk_m_per_sqrt_s=0.5)


@cache
def chart() -> Map:
    """Rough ground, 9 km wide."""
    return gaussian_map(np.random.default_rng(3), std=60.0, correlation_m=400.0, cells=181, cell_m=50.0, sigma=2.0)


@cache
def flight(epochs: int = 60) -> Recording:
    """A straight flight over the middle of the chart, with its truth and an INS that drifts."""
    time_s = np.arange(epochs, dtype=np.float64)
    lat, lon = shift(*chart().centre_deg, -700.0 + 25.0 * time_s, -700.0 + 25.0 * time_s)
    terrain = chart().sample(lat, lon) + np.random.default_rng(1).normal(0.0, 3.0, epochs)
    exact = Recording(
        {"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(epochs, 900.0), "terrain_m": terrain},
        sigma={"terrain_m": 3.0},
        name="short",
    )
    return add_drift(exact, INS, 4)


def without_truth(rec: Recording) -> Recording:
    return replace(rec, columns={key: value for key, value in rec.columns.items() if not key.startswith("true")})


def equal_columns(first: Recording, second: Recording) -> bool:
    """Whether two recordings hold the same bits."""
    return set(first.columns) == set(second.columns) and all(
        values.tobytes() == second.columns[key].tobytes() for key, values in first.columns.items()
    )

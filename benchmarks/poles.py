"""How near to a pole an INS error can be followed by its north and east: `python -m benchmarks.poles`.

A real INS error points the same way in space while the vehicle passes the pole; its north and east then turn, at the
speed over the distance from the pole, which the estimators' models do not know. Synthetic hills (60 m, correlated over
600 m), 100 m/s past the pole, a reading of 3 m every 2 s for 10 min, 300 m and 0.5 m/s of INS error an axis.
"""

from __future__ import annotations

import argparse
import warnings

import numpy as np
from numpy.typing import NDArray
from scipy import stats

import terranav as tn
from terranav.maps.crs import projection
from terranav.maps.fields import gaussian_map

FloatArray = NDArray[np.float64]

CRS = "EPSG:3413"
CELLS, CELL_M = 700, 100.0
COURSE_RAD = 0.5
EPOCHS, STEP_S, SPEED_MPS = 301, 2.0, 100.0
LEAD_IN_S = 200.0
DISTANCES_KM = (500.0, 200.0, 100.0, 50.0, 25.0, 10.0)
GRADE = tn.InsGrade(position_sigma_m=300.0, velocity_sigma_mps=0.5, position_walk_m_per_sqrt_s=0.5)


def terrain(closest_m: float) -> tn.Map:
    """Hills about the place where the track is nearest to the pole."""
    hills = gaussian_map(
        np.random.default_rng(1), std=60.0, correlation_m=600.0, mean=500.0, cells=CELLS, cell_m=CELL_M
    )
    half = 0.5 * CELLS * CELL_M
    x, y = -closest_m * np.sin(COURSE_RAD), closest_m * np.cos(COURSE_RAD)
    return tn.Map(hills.values, (CELL_M, 0.0, x - half, 0.0, -CELL_M, y + half), CRS, sigma=2.0, name="hills")


def flight(chart: tn.Map, closest_m: float, rng: np.random.Generator) -> tn.Recording:
    """A straight line past the pole, indicated with an error that is straight in the map's plane too."""
    time: FloatArray = STEP_S * np.arange(EPOCHS, dtype=np.float64)
    along = SPEED_MPS * (time - time[EPOCHS // 2])
    x = along * np.cos(COURSE_RAD) - closest_m * np.sin(COURSE_RAD)
    y = along * np.sin(COURSE_RAD) + closest_m * np.cos(COURSE_RAD)
    plane = projection(CRS)
    lat, lon = plane.inverse(x, y)
    start, speed = rng.normal(0.0, GRADE.position_sigma_m, 2), rng.normal(0.0, GRADE.velocity_sigma_mps, 2)
    seen_lat, seen_lon = plane.inverse(x + start[0] + speed[0] * time, y + start[1] + speed[1] * time)
    columns: dict[str, FloatArray] = {
        "time_s": time,
        "lat_deg": seen_lat,
        "lon_deg": seen_lon,
        "alt_m": np.full(EPOCHS, 2000.0),
        "true_lat_deg": lat,
        "true_lon_deg": lon,
        "true_alt_m": np.full(EPOCHS, 2000.0),
        "terrain_m": chart.sample(lat, lon) + rng.normal(0.0, 3.0, EPOCHS),
    }
    return tn.Recording(columns, ins=GRADE, sigma={"terrain_m": 3.0})


def interval(values: list[float]) -> str:
    """Mean and half its 95 % interval."""
    half = stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{np.mean(values):.3g} +- {half:.2g}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    runs = parser.parse_args().runs
    warnings.simplefilter("ignore", tn.DataWarning)
    for distance_km in DISTANCES_KM:
        chart = terrain(1000.0 * distance_km)
        for name in ("marginalized", "pointmass"):
            drms, inside = [], []
            for seed in range(runs):
                rec = flight(chart, 1000.0 * distance_km, np.random.default_rng(seed))
                found = tn.run(name, rec, maps=[chart], seed=seed).metrics(since_s=LEAD_IN_S)
                drms.append(float(found["drms_m"]))
                inside.append(float(found["contained_95"]))
            print(
                f"{distance_km:4.0f} km {name:12} drms {interval(drms)} m, inside 95 %: {interval(inside)}", flush=True
            )


if __name__ == "__main__":
    main()

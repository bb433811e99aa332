"""Papers/002 in one picture: terrain alone, gravity alone, their kurtosis mix and their joint likelihood.

A flight over the sample DEM with a generated gravity anomaly. Run it with a folder for the picture:

    python paper_002.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import terranav as tn
from terranav.maps.fields import gaussian_map

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
rng = np.random.default_rng(2)

terrain = tn.sample_map()
gravity = gaussian_map(
    rng, std=12.0, correlation_m=31_000.0, mean=0.0, cells=140, cell_m=926.0,
    centre_deg=terrain.centre_deg, kind="gravity", sigma=0.0,
)  # fmt: skip

# fly north for 200 s at 100 m/s, 3 km above the hills, one reading of each kind a second
time_s = np.arange(201.0)
lat_deg = 36.50 + time_s * 100.0 / 110_950.0
lon_deg = np.full(time_s.size, -84.25)
true = tn.Recording(
    {
        "time_s": time_s,
        "lat_deg": lat_deg,
        "lon_deg": lon_deg,
        "alt_m": np.full(time_s.size, 3500.0),
        "terrain_m": terrain.sample(lat_deg, lon_deg) + 10.0 * rng.standard_normal(time_s.size),
        "gravity_mgal": gravity.sample(lat_deg, lon_deg) + 0.01 * rng.standard_normal(time_s.size),
    },
    sigma={"terrain_m": 10.0, "gravity_mgal": 0.01},
    name="papers/002",
)
ins = tn.InsGrade(
    position_sigma_m=200.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.0,
    gyro_bias_sigma_deg_per_h=0.003, accel_bias_sigma_ug=25.0, gyro_walk_deg_per_sqrt_h=0.0015,
)  # fmt: skip
rec = tn.add_drift(true, ins, seed=4)

# the gravity map's cells are coarse, its readings sharp: let the grids be finer than 1/20 of a cell
fine = {"min_cell_m": 2.0, "max_cells": 20_000}
flights = {
    "terrain only": ("pointmass", [terrain], "#7a5c3e"),
    "gravity only": ("pointmass", [gravity], "#3e6f9e"),
    "kurtosis mix": ("hybrid", [terrain, gravity], "#c2571a"),
    "joint likelihood": ("pointmass", [terrain, gravity], "#2f8f5b"),
}
figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
for label, (method, maps, colour) in flights.items():
    result = tn.run(method, rec, maps=maps, seed=1, **fine)
    error_m = np.hypot(*result.error_m.T)
    axes.plot(result.time_s, error_m, label=f"{label}: {error_m.mean():.1f} m", color=colour)
    print(f"{label:17s} mean {error_m.mean():6.1f} m, at the end {error_m[-1]:5.1f} m")
axes.set(xlabel="time [s]", ylabel="horizontal error [m]", yscale="log", title="One flight of papers/002 (mean error)")
axes.legend()
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "paper_002.png", dpi=120)

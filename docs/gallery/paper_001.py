"""Papers/001 on its own terrain: a Gauss-Markov field by Van Loan, and where the Bayes grid sees the vehicle.

Run it with a folder for the picture: python paper_001.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

import terranav as tn
from terranav.core.earth import offset_m, shift
from terranav.filters.bayes_grid import BayesGrid
from terranav.maps.gauss_markov import GaussMarkov, gauss_markov_map

matplotlib.use("Agg")
import matplotlib.pyplot as plt

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
rng = np.random.default_rng(1)

# 2 km x 2 km of the paper's terrain: sigma 20 m, 0.01 rad/m, cells of 1 m
dem = gauss_markov_map(rng, sigma=20.0, omega_rad_per_m=0.01, spacing_m=1.0, shape=(2001, 2001))

# 18 s of flight at 140 m/s along the diagonal, with the paper's random motion about it; only the nominal is known
seconds = np.arange(19.0)
deviation = np.stack([GaussMarkov(10.0, 0.51).profile(rng, 19, 1.0)[:, 0] for _ in range(2)], axis=1)
along = -900.0 + 99.0 * seconds
lat, lon = shift(0.0, 0.0, along + deviation[:, 0], along + deviation[:, 1])
told_lat, told_lon = shift(0.0, 0.0, along, along)
columns = {
    "time_s": seconds,
    "lat_deg": told_lat,
    "lon_deg": told_lon,
    "alt_m": np.full(19, 200.0),
    "true_lat_deg": lat,
    "true_lon_deg": lon,
    "true_alt_m": np.full(19, 200.0),
    "terrain_m": dem.sample(lat, lon, "bicubic") + rng.normal(0.0, 1.0, 19),
}
ins = tn.InsGrade(position_sigma_m=10.0, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=4.5)
rec = tn.Recording(columns, ins=ins, sigma={"terrain_m": 1.0}, name="papers/001")

grid = BayesGrid((dem,), ins, min_cell_m=1.0, max_cell_m=1.0, band=1.0, likelihood_var_m2=25.0, interpolation="bicubic")
res = tn.run(grid, rec, seed=1)
idle = tn.run("ins", rec, maps=[dem], seed=1)

state = grid.init(tn.Prior.from_ins(ins, "uniform"), rng)
first = grid.step(state, next(iter(rec.epochs())), rng)
seen = grid.posterior(first)

figure, (left, middle, right) = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained")
picture = left.imshow(dem.values, extent=(-1000, 1000, -1000, 1000), cmap="terrain")
north, east = offset_m(0.0, 0.0, lat, lon)
left.plot(east, north, "k--", lw=1, label="flight")
left.set(title="Gauss-Markov terrain [m]", xlabel="east [m]", ylabel="north [m]")
left.legend()
figure.colorbar(picture, ax=left)
middle.pcolormesh(seen.east_m, seen.north_m, seen.weight, cmap="magma_r")
middle.plot(-deviation[0, 1], -deviation[0, 0], "c+", ms=14, mew=2, label="true error")
middle.set(
    title="after one reading: candidates within 1 m, P = 25 I", xlabel="error east [m]", ylabel="error north [m]"
)
middle.legend()
for name, axis in (("x (east)", 1), ("y (north)", 0)):
    right.plot(res.time_s, res.error_m[:, axis], label=f"{name}, bayes_grid")
    right.plot(idle.time_s, idle.error_m[:, axis], ":", label=f"{name}, no aiding")
right.set(title="position error [m]", xlabel="time [s]")
right.legend()
figure.savefig(folder / "paper_001.png", dpi=110)
aided, unaided = (np.sqrt(np.mean(one.error_m**2)) for one in (res, idle))
print(f"rms error per axis: bayes_grid {aided:.1f} m, no aiding {unaided:.1f} m")

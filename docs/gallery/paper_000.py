"""HMMTEM (papers/000) over the sample map: the INS error epoch by epoch, and the whole path traced back at the end.

python paper_000.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

import terranav as tn
from terranav.core.earth import shift
from terranav.experiment.stream import states
from terranav.filters.viterbi import Viterbi

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# a flight over the sample map: 160 s at 100 m/s, a reading every 0.5 s
dem = tn.sample_map()
time_s = 0.5 * np.arange(320, dtype=np.float64)
lat, lon = shift(*dem.centre_deg, 6000.0 - 70.0 * time_s, 6000.0 - 75.0 * time_s)
rng = np.random.default_rng(4)
flight = tn.Recording(
    {
        "time_s": time_s,
        "lat_deg": lat,
        "lon_deg": lon,
        "alt_m": np.full(time_s.size, 2500.0),
        "terrain_m": dem.sample(lat, lon) + rng.normal(0.0, 5.0, time_s.size),
    },
    sigma={"terrain_m": 5.0},
)
ins = tn.InsGrade(position_sigma_m=300.0, velocity_sigma_mps=1.5, position_walk_m_per_sqrt_s=0.5)
rec = tn.add_drift(flight, ins, 11)
truth = rec.ins_error_m()

# eq. 7: the start is uniform over the square of side 6 sigma
hmm = Viterbi((dem,), ins)
said = []
for state in states(hmm, tn.Prior.from_ins(ins, "uniform"), rec.epochs(), rng):
    said.append(hmm.estimate(state))
estimate = np.array([one.ins_error_m for one in said])
sigma = np.array([np.sqrt(np.diag(one.cov_m2)) for one in said])
path = hmm.backtrace(state)
for name, value in (("INS alone", truth), ("HMMTEM, eq. 14", estimate - truth), ("whole path, eq. 15", path - truth)):
    print(f"{name:>20}: median {np.median(np.hypot(*value.T)):6.1f} m, last {np.hypot(*value[-1]):6.1f} m")

figure, axes = plt.subplots(3, 1, figsize=(8.0, 8.0), sharex=True, layout="constrained")
axes[0].plot(time_s, dem.sample(lat, lon), color="0.3")
axes[0].set_ylabel("terrain [m]")
for axis, column, name in ((axes[1], 0, "north"), (axes[2], 1, "east")):
    low, high = estimate[:, column] - 2.0 * sigma[:, column], estimate[:, column] + 2.0 * sigma[:, column]
    axis.fill_between(time_s, low, high, color="C0", alpha=0.2, lw=0.0, label="2 sigma")
    axis.plot(time_s, estimate[:, column], "C0", lw=1.0, label="estimate as it came (eq. 14)")
    axis.plot(time_s, path[:, column], "C1", lw=1.5, label="whole path (eq. 15)")
    axis.plot(time_s, truth[:, column], "k--", lw=1.0, label="true INS error")
    axis.set_ylim(truth[:, column].min() - 400.0, truth[:, column].max() + 400.0)
    axis.set_ylabel(f"error {name} [m]")
axes[1].legend(loc="upper right", fontsize="small")
axes[2].set_xlabel("time [s]")
folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
folder.mkdir(parents=True, exist_ok=True)
figure.savefig(folder / "paper_000.png", dpi=120)

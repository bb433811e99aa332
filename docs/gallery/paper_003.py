"""ICCP laid over the contours of a real DEM: the optimisations of three matches, and what the judges make of them.

Usage: python paper_003.py [folder for the picture]
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import terranav as tn
from terranav.core.earth import shift

DEGREE_M = 111_132.0
WINDOW = 3

dem = tn.sample_map()
rng = np.random.default_rng(2)
time_s = np.arange(0.0, 66.0, 2.0)
lat, lon = shift(*dem.centre_deg, np.zeros(time_s.size), 200.0 * (time_s - 32.0))  # west to east at 200 m/s
error_m = np.array([333.0, 268.0])  # 0.003 degrees of latitude and longitude
ins_lat, ins_lon = shift(lat, lon, *error_m)
height = dem.sample(lat, lon) + rng.normal(0.0, 5.0, time_s.size)
epochs = [
    tn.Epoch(*map(float, row[:3]), 1200.0, (0.0, 200.0, 0.0), None, (tn.Measurement("terrain", float(row[3]), 5.0),))
    for row in zip(time_s, ins_lat, ins_lon, height, strict=True)
]
ins = tn.InsGrade(position_sigma_m=0.003 * DEGREE_M, velocity_sigma_mps=0.0, position_walk_m_per_sqrt_s=0.0)
paper = {
    "window": WINDOW,
    "every": 1,
    "iterations": 60,
    "e_min_m": 0.002 * DEGREE_M,
    "weight": 1.0,
    "per_step": True,
    "step_sigma": 0.028,
    "search_sigma_m": 0.003 * DEGREE_M,
    "pdaf_sigma_m": 0.003 * DEGREE_M,
    "feedback": False,
    "fuse": False,
}

figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), constrained_layout=True)
for judge in ("none", "m_of_n", "pdaf"):
    estimator = tn.make_estimator("iccp", [dem], ins, judge=judge, **paper)
    prior, generator = tn.Prior.from_ins(ins), np.random.default_rng(0)
    estimates = list(tn.stream(estimator, prior, epochs, generator))[WINDOW - 1 :]
    miss = [np.hypot(*(one.ins_error_m - error_m)) / DEGREE_M for one in estimates]
    mismatches = np.mean(np.array(miss[3:]) > 0.002)
    right.plot(time_s[WINDOW - 1 :], miss, ".-", label=f"{judge}: {mismatches:.0%} mismatches")
right.axhline(0.002, color="0.6", lw=1)
right.set(xlabel="time [s]", ylabel="error of the match [deg]", title="Matches under three judges")
right.legend()

# the optimisations of one match, on the contours of its readings
state = estimator.init(prior, generator)
for epoch in epochs[: WINDOW + 6]:
    state = estimator.step(state, epoch, generator)
cloud = estimator.posterior(state)
north, east = np.linspace(-1200.0, 1500.0, 181), np.linspace(-1100.0, 1500.0, 175)
last = epochs[WINDOW + 5]
field = dem.sample(*shift(last.lat_deg, last.lon_deg, -north[:, None], -east))
left.contour(east, north, field, 14, colors="0.8", linewidths=0.7)
left.contour(east, north, field, [last.measurements[0].value], colors="tab:blue", linewidths=1.5)
left.plot(cloud.east_m, cloud.north_m, "o", mfc="none", color="tab:orange", label="20 optimisations")
left.plot(*error_m[::-1], "k+", ms=14, mew=2, label="true INS error")
left.plot(0.0, 0.0, "kx", label="INS")
left.set(
    xlabel="INS error east [m]", ylabel="north [m]", title=f"One match at {last.time_s:.0f} s; blue: its last contour"
)
left.set_aspect("equal")
left.legend(loc="lower right")

folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
figure.savefig(folder / "paper_003.png", dpi=110)
print(folder / "paper_003.png")

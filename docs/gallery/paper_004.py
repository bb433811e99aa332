"""Correlation with fading memory (papers/004): the surface sharpens reading by reading.

    python docs/gallery/paper_004.py [FOLDER]

A flight over the sample DEM with an INS that is 900 m off. The picture shows the posterior after 5, 20, 67 and 190
readings, and the error of the fix over time with the 1-sigma that the method claims.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import terranav as tn

EARLY = (5, 20, 67, 190)


def flight(dem: tn.Map) -> tn.Recording:
    """A straight flight at 100 m/s with terrain heights of 10 m noise; its position is true."""
    count, rng = 240, np.random.default_rng(4)
    lat = np.linspace(36.54, 36.64, count)
    lon = np.linspace(-84.32, -84.15, count)
    columns = {"time_s": np.arange(count, dtype=float), "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(count, 1500.0)}
    return tn.Recording(
        {**columns, "terrain_m": dem.sample(lat, lon) + rng.normal(0.0, 10.0, count)}, sigma={"terrain_m": 10.0}
    )


def main(folder: Path) -> None:
    dem = tn.sample_map()
    ins = tn.InsGrade(position_sigma_m=600.0, velocity_sigma_mps=0.2, position_walk_m_per_sqrt_s=0.5)
    rec = tn.add_drift(flight(dem), ins, 9)
    method = tn.make_estimator("fading_memory", [dem], ins, alpha=0.985)
    eager = replace(method, readings=1)  # so that there is a posterior to draw before 1/(1 - alpha) readings
    prior, rng = tn.Prior.from_ins(ins), np.random.default_rng(0)
    truth = rec.ins_error_m()

    figure, axes = plt.subplots(2, 3, figsize=(12, 7.5), layout="constrained")
    state = eager.init(prior, rng)
    places = iter(axes.ravel()[[0, 1, 3, 4]])
    for k, epoch in enumerate(rec.epochs(), start=1):
        state = eager.step(state, epoch, rng)
        if k in EARLY:
            axis, shown = next(places), eager.posterior(state)
            level = np.log10(np.maximum(shown.weight / shown.weight.max(), 1e-6))
            axis.pcolormesh(shown.east_m, shown.north_m, level, cmap="viridis")
            axis.plot(truth[k - 1, 1], truth[k - 1, 0], "r+", markersize=14, markeredgewidth=2)
            axis.set(title=f"{k} readings", xlabel="error east [m]", ylabel="error north [m]", aspect="equal")

    result = tn.run(method, rec)
    off = np.hypot(*result.error_m.T)
    sigma = np.sqrt(np.trace(result.cov_m2, axis1=1, axis2=2))
    for axis, top in ((axes[0, 2], None), (axes[1, 2], 150.0)):
        axis.plot(result.time_s, off, label="distance from the truth")
        axis.plot(result.time_s, sigma, "--", label="claimed (root of the trace)")
        axis.axvline(method.least_readings - 1, color="grey", lw=0.8)
        axis.set(xlabel="time [s]", ylabel="[m]", ylim=(0.0, top))
    axes[0, 2].legend()
    figure.suptitle("Fading memory: log10 of the posterior over the INS error (red: the true error)")
    figure.savefig(folder / "paper_004.png", dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path())

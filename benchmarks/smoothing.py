"""What smoothing gains over the filter: on rough synthetic ground, and on the helicopter days with an added drift.

    python -m benchmarks.smoothing --seeds 40 [--real --seeds 5] [--jobs 2]

Each run gives the DRMS of the filter and of its smoother over the whole run and over the epochs before the filter's
first fix. The table pools the squared errors of all runs; the gain is 1 - smoothed over filter. Intervals are 95 %, by
bootstrap over the runs.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import terranav as tn
from benchmarks.helicopter import COLUMNS, DATA
from terranav.core.earth import shift
from terranav.experiment.smooth import smooth
from terranav.io.tables import convert_table
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
METHODS = ("marginalized", "pointmass")


def rough(seed: int, epochs: int = 200) -> tuple[tn.Recording, Map]:
    """A straight flight over a Gaussian field of 60 m and 600 m, a reading every 2 s of 5 m, INS 300 m, 0.5 m/s."""
    chart = gaussian_map(np.random.default_rng(seed), std=60.0, correlation_m=600.0, cells=301, cell_m=60.0, sigma=1.0)
    time_s = np.arange(float(epochs))
    lat, lon = shift(*chart.centre_deg, 30.0 * time_s - 3000.0, 20.0 * time_s - 2000.0)
    noise = np.random.default_rng(seed + 1000).normal(0.0, 5.0, epochs)
    terrain = np.where(time_s % 2.0 == 0.0, chart.sample(lat, lon) + noise, np.nan)
    columns = {"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(epochs, 900.0), "terrain_m": terrain}
    exact = tn.Recording(columns, sigma={"terrain_m": 5.0}, name="rough ground")
    return tn.add_drift(exact, tn.InsGrade(300.0, 0.5, 1.0), seed + 2000), chart


def helicopter(day: str, seed: int) -> tuple[tn.Recording, Map]:
    """The first hour of a day with the drift of InsGrade(500 m, 0.5 m/s, 1 m/sqrt(s))."""
    track = convert_table(DATA / f"flight_{day}.csv", COLUMNS).between(0.0, 3600.0)
    chart = tn.open_map(DATA / "land_surface_100m.tif", kind="terrain", sigma=3.0)
    return tn.add_drift(track, tn.InsGrade(500.0, 0.5, 1.0), seed), chart


def fly(job: tuple[str, str, int]) -> list[float]:
    """One run: squared errors and NEES of filter and smoother, whole and before the fix, containment, wall times."""
    warnings.simplefilter("ignore")
    name, day, seed = job
    rec, chart = helicopter(day, seed) if day != "rough" else rough(seed)
    began = time.perf_counter()
    both = [tn.run(name, rec, [chart], seed=seed)]
    middle = time.perf_counter()
    both.append(smooth(name, rec, [chart], seed=seed))
    walls = [middle - began, time.perf_counter() - middle]
    fix_s = both[0].metrics()["first_fix_s"]
    early = rec.time_s - rec.time_s[0] < (fix_s if np.isfinite(fix_s) else np.inf)
    squared = [np.sum(one.error_m**2, axis=1) for one in both]
    before = [float(one[early].mean()) if early.any() else np.nan for one in squared]
    metrics = [one.metrics() for one in both]
    figures = [m[key] for key in ("nees_per_axis", "contained_95") for m in metrics]
    return [*(float(one.mean()) for one in squared), *before, *figures, *walls]


def gain(filtered: FloatArray, smoothed: FloatArray) -> str:
    """Gain in the pooled RMSE [%] with its bootstrap interval."""
    known = np.isfinite(filtered)
    pairs = np.stack([filtered[known], smoothed[known]])
    picks = np.random.default_rng(0).integers(0, pairs.shape[1], (4000, pairs.shape[1]))
    ratios = np.sqrt(pairs[1][picks].sum(axis=1) / pairs[0][picks].sum(axis=1))
    low, high = 100.0 * (1.0 - np.percentile(ratios, (97.5, 2.5)))
    return f"{100.0 * (1.0 - np.sqrt(pairs[1].sum() / pairs[0].sum())):.0f} % ({low:.0f}..{high:.0f})"


def line(name: str, label: str, runs: FloatArray) -> str:
    """One row of the table."""
    mean = np.sqrt(np.nanmean(runs[:, :4], axis=0))
    median = np.sqrt(np.nanmedian(runs[:, :4], axis=0))
    nees, inside, wall = (np.mean(runs[:, i : i + 2], axis=0) for i in (4, 6, 8))
    return (
        f"| {name} | {label} | {len(runs)} | {mean[0]:.0f} / {mean[1]:.0f} | {gain(runs[:, 0], runs[:, 1])} "
        f"| {median[0]:.0f} / {median[1]:.0f} | {mean[2]:.0f} / {mean[3]:.0f} | {gain(runs[:, 2], runs[:, 3])} "
        f"| {nees[0]:.2f} / {nees[1]:.2f} | {100 * inside[0]:.0f} / {100 * inside[1]:.0f} % "
        f"| {wall[0]:.1f} / {wall[1]:.1f} |"
    )


def main() -> int:
    """Fly all and print a line per estimator and day."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--real", action="store_true", help="the helicopter days instead of synthetic ground")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    given = parser.parse_args()
    if given.real and not DATA.is_dir():
        print("the helicopter survey is not at hand: set TERRANAV_SHARED to its folder", file=sys.stderr)
        return 2
    days = sorted(path.stem.removeprefix("flight_") for path in Path(DATA).glob("flight_*.csv")) if given.real else []
    days = days or ["rough"]
    jobs = [(name, day, seed) for name in METHODS for day in days for seed in range(1, given.seeds + 1)]
    with ProcessPoolExecutor(given.jobs) as pool:
        runs = dict(zip(jobs, pool.map(fly, jobs), strict=True))
    print(
        "| estimator | track | runs | RMSE m, filter / smoothed | gain | median DRMS m | before the first fix, RMSE m "
        "| gain | NEES per axis | in 95 % ellipse | time s |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for name in METHODS:
        for day in [*days, *(["all"] if len(days) > 1 else [])]:
            print(
                line(
                    name, day, np.array([run for job, run in runs.items() if job[0] == name and day in (job[1], "all")])
                )
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())

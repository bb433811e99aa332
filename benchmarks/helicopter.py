"""Real flights: the four helicopter days, first hour each, with an added INS drift.

    python -m benchmarks.helicopter --seeds 10 [--velocity 0.05] [--walk 0.3]

Needs the survey's tables and map beside the checkout (or in the folder that TERRANAV_SHARED names). Errors count over
the second half of each run; a run is lost when it ends beyond 1 km, 'said' when its status then is 'lost' or 'off_map'.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

import terranav as tn
from benchmarks.statistics import median_with_interval
from terranav.io.tables import convert_table

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("TERRANAV_SHARED", ROOT.parent / "shared")) / "data" / "wisconsin_helicopter"
COLUMNS = ROOT / "examples" / "wisconsin_helicopter.toml"
METHODS: dict[str, tuple[str, dict[str, object]]] = {
    "ins": ("ins", {}),
    "marginalized": ("marginalized", {}),
    "pointmass": ("pointmass", {}),
    "sitan": ("sitan", {}),
    "tercom": ("tercom", {"window": 12, "every": 3}),  # 48 readings of one every 20 s would span 16 minutes
}


def fly(job: tuple[str, int, float, float]) -> dict[str, list[float]]:
    """One day and seed: DRMS of the second half, containment, NEES per axis, lost, lost and said."""
    warnings.simplefilter("ignore")
    day, seed, velocity, walk = job
    track = convert_table(DATA / f"flight_{day}.csv", COLUMNS).between(0.0, 3600.0)
    grade = tn.InsGrade(500.0, velocity, walk)
    recording = tn.add_drift(track, grade, seed)
    chart = tn.open_map(DATA / "land_surface_100m.tif", kind="terrain", sigma=3.0)
    half = 0.5 * float(recording.time_s[-1] - recording.time_s[0])
    table = {}
    for label, result in tn.compare(METHODS, recording, [chart], seed=seed).items():
        metrics = result.metrics(since_s=half)
        lost = float(np.linalg.norm(result.error_m[-1]) > 1000.0)
        said = lost * float(result.status[-1] in ("lost", "off_map"))
        table[label] = [metrics["drms_m"], metrics["contained_95"], metrics["nees_per_axis"], lost, said]
    return table


def main() -> int:
    """Fly all days and seeds on both cores and print a line per estimator and day."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--velocity", type=float, default=0.05, help="velocity error of the added INS [m/s]")
    parser.add_argument("--walk", type=float, default=0.3, help="its position walk [m/sqrt(s)]")
    given = parser.parse_args()
    if not DATA.is_dir():
        print("the helicopter survey is not at hand: set TERRANAV_SHARED to its folder", file=sys.stderr)
        return 2
    days = sorted(path.stem.removeprefix("flight_") for path in DATA.glob("flight_*.csv"))
    jobs = [(day, seed, given.velocity, given.walk) for day in days for seed in range(1, given.seeds + 1)]
    with ProcessPoolExecutor(2) as pool:
        runs = dict(zip(jobs, pool.map(fly, jobs), strict=True))
    print(
        f"first hour of {len(days)} days, {given.seeds} runs each; "
        f"INS 500 m, {given.velocity:g} m/s, {given.walk:g} m/sqrt(s)"
    )
    print(
        "| estimator | day | DRMS m, median (95 % interval) | worst m | in 95 % ellipse | NEES per axis | lost (said) |"
    )
    print("|---|---|---|---|---|---|---|")
    for name in METHODS:
        for day in [*days, "all"]:
            rows = np.array([run[name] for job, run in runs.items() if day in (job[0], "all")])
            drms = "{:.0f} ({:.0f}..{:.0f})".format(*median_with_interval(rows[:, 0]))
            more = f"{rows[:, 0].max():.0f} | {100 * rows[:, 1].mean():.0f} % | {np.median(rows[:, 2]):.2f}"
            print(f"| {name} | {day} | {drms} | {more} | {rows[:, 3].sum():.0f} ({rows[:, 4].sum():.0f}) |")
    return 0


if __name__ == "__main__":
    sys.exit(main())

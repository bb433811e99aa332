"""The demo flight over many seeds: the accuracy table of README.

    python -m benchmarks.demo_flight --seeds 50

Each seed draws another INS, other sensor noise and another map error. Figures of a run count from its first fix, of the
whole run for the INS alone. Medians over runs with 95 % bootstrap intervals.
"""

from __future__ import annotations

import argparse
import warnings
from concurrent.futures import ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray

import terranav as tn
from benchmarks.statistics import median_with_interval
from terranav.experiment.demo import demo_scenario

METHODS = ("ins", "marginalized", "pointmass", "sitan", "tercom")
FIGURES = ("drms_m", "r95_m", "nees_per_axis", "contained_95", "first_fix_s", "lost_s", "final_m")


def fly(seed: int) -> dict[str, list[float]]:
    """One seed: the figures of each estimator."""
    warnings.simplefilter("ignore")
    scenario = demo_scenario()
    recording = tn.simulate(scenario, seed=seed)
    table = {}
    for name, result in tn.compare(METHODS, recording, scenario.open_maps(), seed=seed).items():
        fixed = bool(np.isfinite(result.metrics()["first_fix_s"]))
        metrics = result.metrics(after_first_fix=fixed)
        table[name] = [float(metrics[key]) for key in FIGURES]
    return table


def cell(values: NDArray[np.float64], digits: int = 0) -> str:
    """Median and interval as text."""
    known = values[np.isfinite(values)]
    if not known.size:
        return "-"
    return "{:.{d}f} ({:.{d}f}..{:.{d}f})".format(*median_with_interval(known), d=digits)


def main() -> None:
    """Fly the seeds on both cores and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    seeds = range(1001, 1001 + given.seeds)
    with ProcessPoolExecutor(given.workers) as pool:
        runs = list(pool.map(fly, seeds))
    print(f"demo flight, {given.seeds} runs; median (95 % interval), from the first fix on")
    print(
        "| estimator | DRMS m | 95th percentile m | final m | NEES per axis | in 95 % ellipse | fix after s | lost s |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in runs[0]:
        figures = dict(zip(FIGURES, np.array([run[name] for run in runs]).T, strict=True))
        row = [cell(figures["drms_m"]), cell(figures["r95_m"]), cell(figures["final_m"])]
        row += [cell(figures["nees_per_axis"], 2), f"{100 * figures['contained_95'].mean():.0f} %"]
        row += [cell(figures["first_fix_s"]), f"{figures['lost_s'].mean():.0f}"]
        print(f"| {name} | {' | '.join(row)} |")


if __name__ == "__main__":
    main()

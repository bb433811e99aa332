"""How long `terranav replay` takes over a log of 30 minutes at 10 Hz, and whether two replays give the same bits.

    python -m benchmarks.replay [--minutes 30] [--runs 5] [--report]
    python -m benchmarks.replay --accuracy [--minutes 30] [--runs 20]

The log is a DataFlash flight made up over the sample DEM (`benchmarks.replay_flight`). Every run is its own process,
as a user would start it, with its start-up; time by the clock and of the processor. --report also writes the report.
--accuracy flies as many flights, each with other errors, once by what the log holds and once by a drift of 1 nmi/h.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import t as student

import terranav as tn
from benchmarks.replay_flight import Made, dataflash
from benchmarks.statistics import median_with_interval
from terranav.io.raster_out import write_map

ASKED_S = 20.0
_START = "import sys; from terranav.app.cli import main; sys.exit(main())"
WAYS = {"own position": [], "1 nmi/h": ["--drift-nmph", "1"], "airspeed": ["--by", "airspeed", "--gnss-off", "300"]}


def once(log: Path, chart: Path, *more: str) -> tuple[dict[str, Any], float, float]:
    """What one replay printed, and its time by the clock and of the processor [s]."""
    command = [sys.executable, "-c", _START, "replay", str(log), "--map", str(chart), "--json", *more]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=env)
    elapsed, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode != 0:
        raise SystemExit(done.stderr)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return json.loads(done.stdout), elapsed, used


def mean_with_interval(values: list[float]) -> str:
    """Mean and the half width of its 95 % interval (Student), as text."""
    array = np.array(values)
    half = (
        student.ppf(0.975, array.size - 1) * array.std(ddof=1) / math.sqrt(array.size) if array.size > 1 else math.nan
    )
    return f"{array.mean():.1f} +- {half:.1f} s"


def speed(folder: Path, chart: Path, options: argparse.Namespace) -> int:
    """Time the runs; the status is 1 where the bits differ or the goal is missed."""
    log = folder / "00000001.BIN"
    log.write_bytes(dataflash(Made(minutes=options.minutes)))
    more = ["--out", str(folder / "out")] if options.report else []
    once(log, chart, *more)  # compiles what is compiled once
    runs = [once(log, chart, *more) for _ in range(options.runs)]
    digests = {summary["digest"] for summary, _, _ in runs}
    elapsed, used = [clock for _, clock, _ in runs], [processor for _, _, processor in runs]
    summary = runs[0][0]
    print(f"log          {log.stat().st_size / 1e6:.1f} MB, {summary['log']['epochs']} epochs, {options.minutes:g} min")
    longest = max(elapsed)
    print(
        f"elapsed      {mean_with_interval(elapsed)}, longest {longest:.1f} s, {options.runs} runs; asked {ASKED_S:g} s"
    )
    print(f"processor    {mean_with_interval(used)}")
    print(f"same bits    {'yes' if len(digests) == 1 else 'NO'}: {', '.join(sorted(digests))}")
    print(f"verdict      {summary['verdict']}")
    return 0 if len(digests) == 1 and longest <= ASKED_S else 1


def accuracy(folder: Path, chart: Path, options: argparse.Namespace) -> int:
    """Fly many flights; medians with 95 % intervals over flights."""
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in WAYS}
    for seed in range(1, options.runs + 1):
        log = folder / f"{seed}.BIN"
        log.write_bytes(dataflash(Made(minutes=options.minutes, seed=seed)))
        for name, more in WAYS.items():
            found[name].append(once(log, chart, "--seed", str(seed), "--drift-seed", str(seed), *more)[0]["score"])
        log.unlink()
    heads = f"{'unaided, 95 %':>24}{'with the map, 95 %':>24}{'worst':>8}{'usable':>8}{'in 95 %':>9}{'beyond HPL':>12}"
    print(f"{'navigated by':14}{heads}")
    for name, scores in found.items():
        columns = {key: np.array([score[key] for score in scores], dtype=float) for key in scores[0]}
        alone, held = (told(columns[key]) for key in ("unaided_m", "held_m"))
        usable, inside = (100.0 * columns[key].mean() for key in ("usable", "contained_95"))
        beyond = int(columns["misleading"].sum())
        print(
            f"{name:14}{alone:>24}{held:>24}{columns['held_m'].max():>7.0f}m{usable:>7.0f}%{inside:>8.0f}%{beyond:>12}"
        )
    return 0


def told(values: np.ndarray[Any, np.dtype[np.float64]]) -> str:
    """Median and its interval [m]."""
    middle, low, high = median_with_interval(values)
    return f"{middle:.0f} ({low:.0f}..{high:.0f}) m"


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--accuracy", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        chart = folder / "dem.tif"
        write_map(tn.sample_map(), chart)
        return (accuracy if options.accuracy else speed)(folder, chart, options)


if __name__ == "__main__":
    raise SystemExit(main())

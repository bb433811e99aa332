"""A sensor that reads many times within one map cell: does the navigator stay right, and does it offer its fixes?

    python -m benchmarks.dense_readings [--rate 10] [--runs 20] [--alone]

Flights of 400 s at 60 m/s over terranav.sample_map(), the true ground off by a field of the map's stated sigma,
readings of 3 m; each run has another course, another INS (300 m, 0.5 m/s, 0.5 m/sqrt(s)) and other errors. `--alone`
flies the filter without its monitor, which uses every reading. A flight is right when the RMSE of its second half is
below 100 m.
"""

from __future__ import annotations

import argparse
import os

import numpy as np

import terranav as tn
from terranav.core.earth import shift
from terranav.experiment.studies.plan import wilson
from terranav.maps.fields import gaussian_map

_SECONDS, _SPEED_MPS, _SIGMA_M, _RIGHT_M = 400.0, 60.0, 3.0, 100.0
_INS = tn.InsGrade(300.0, 0.5, 0.5)


def flight(seed: int, rate_hz: float) -> tuple[tn.Recording, tn.Map]:
    """A recording with true and indicated track, and the map."""
    chart, rng = tn.sample_map(), np.random.default_rng(seed)
    time_s = np.arange(round(_SECONDS * rate_hz)) / rate_hz
    course, along = rng.uniform(0.0, 2.0 * np.pi), _SPEED_MPS * (time_s - 0.5 * _SECONDS)
    north, east = along * np.cos(course) + 800.0 * np.sin(along / 3000.0), along * np.sin(course)
    lat, lon = shift(*chart.centre_deg, north, east)
    off = gaussian_map(
        np.random.default_rng([seed, 7]), std=chart.sigma, correlation_m=chart.error_length_m, mean=0.0, cells=601,
        cell_m=90.0,
    )  # fmt: skip
    ground = chart.sample(lat, lon) + off.sample(*shift(*off.centre_deg, north, east))
    columns = {
        "time_s": time_s,
        "lat_deg": lat,
        "lon_deg": lon,
        "alt_m": np.full(time_s.size, 2500.0),
        "terrain_m": ground + rng.normal(0.0, _SIGMA_M, time_s.size),
    }
    return tn.add_drift(tn.Recording(columns, sigma={"terrain_m": _SIGMA_M}), _INS, seed), chart


def main() -> None:
    """Fly, a line a run, and say how many were right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=10.0, help="readings a second")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--alone", action="store_true", help="without the monitor")
    told = parser.parse_args()
    right, beyond, offered = 0, 0, []
    print("  seed   RMSE m   usable   beyond its level")
    for seed in range(told.runs):
        rec, chart = flight(seed, told.rate)
        result = tn.run("marginalized", rec, chart, seed=seed, ins=_INS, integrity=not told.alone)
        error_m = np.hypot(*result.error_m.T)
        rmse_m = float(np.sqrt(np.mean(error_m[error_m.size // 2 :] ** 2)))
        over = int((result.usable & (error_m > result.protection_m)).sum())
        right, beyond = right + (rmse_m < _RIGHT_M), beyond + over
        offered.append(float(result.usable.mean()))
        print(f"{seed:6d} {rmse_m:8.1f} {offered[-1]:8.0%} {over:8d}", flush=True)
    share = wilson(right, told.runs)
    print(f"right {right} of {told.runs} ({share.low:.0%}..{share.high:.0%})")
    print(f"usable {min(offered):.0%} to {max(offered):.0%}, beyond their protection level {beyond}")


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()

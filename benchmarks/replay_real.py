"""Real flights replayed: a helicopter survey's first hours, GNSS taken away, the drift of an INS of 1 nmi/h added.

    python -m benchmarks.replay_real --data DIR [--runs 10] [--day 20210125]

DIR is the folder of data (with wisconsin_helicopter). One N a run, as by `terranav replay FILE --columns
wisconsin_helicopter.toml --map land_surface_100m.tif --gnss-off 0-3600 --drift-nmph 1 --drift-seed N --seed N`. 95th
percentiles of the distance from GNSS, medians over runs with 95 % bootstrap intervals.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np

import terranav as tn
from benchmarks.statistics import median_with_interval
from terranav.app.replay import open_any
from terranav.experiment.replay import Withheld, spaced, withhold
from terranav.experiment.replay_ways import Flown, nautical_miles_an_hour
from terranav.io.logs import Log

DAYS = ("20210120", "20210122", "20210125", "20210203")
HOUR_S, SPACING_CELLS = 3600.0, 0.5
COLUMNS = Path(__file__).resolve().parents[1] / "examples" / "wisconsin_helicopter.toml"


def one(log: Log, dem: tn.Map, seed: int) -> dict[str, float]:
    """Figures of one run."""
    wanted = Withheld([(0.0, HOUR_S)], "drift", Flown(nautical_miles_an_hour(1.0), seed))
    flight = spaced(withhold(log, wanted)[0], SPACING_CELLS * dem.cell_m).recording
    result = tn.run("marginalized", flight, maps=[dem], seed=seed)
    figures, error = result.metrics(), np.hypot(*result.error_m.T)
    return {
        "unaided, 95 % [m]": float(np.percentile(np.hypot(*flight.ins_error_m().T), 95.0)),
        "with the map, 95 % [m]": figures["r95_m"],
        "in its 95 % ellipse": figures["contained_95"],
        "usable": figures["available"],
        "usable beyond protection level": float(np.count_nonzero(result.usable & (error > result.protection_m))),
    }


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--day", choices=DAYS, action="append")
    options = parser.parse_args()
    folder = options.data / "wisconsin_helicopter"
    if not folder.is_dir():
        parser.error(f"{options.data} holds no wisconsin_helicopter: expected the folder of data")
    warnings.simplefilter("ignore")
    dem = tn.open_map(folder / "land_surface_100m.tif", kind="terrain")
    for day in options.day or DAYS:
        log = open_any(folder / f"flight_{day}.csv", columns=COLUMNS)
        runs = [one(log, dem, seed) for seed in range(options.runs)]
        print(f"{day}, {len(runs)} runs", flush=True)
        for key in runs[0]:
            values = np.array([run[key] for run in runs])
            middle, low, high = median_with_interval(values)
            print(
                f"  {key:32}{middle:8.3g} ({low:.3g}..{high:.3g}), worst {values.max():.3g}, least {values.min():.3g}"
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

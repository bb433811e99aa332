"""The GNSS monitor of live mode on the flying test bed in lock-step: when is a pull flagged, and what before it?

    python -m benchmarks.live_monitor --seeds 6

flies, for each way of reckoning and each seed, `--minutes` with an honest GNSS that is pulled away at `--mps` from
`--at` on; fixes are not sent back. A flight is flagged by its first alarm after that; alarms before it are false.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass

import numpy as np

from terranav.experiment.studies.statistics import clopper_pearson
from terranav.ins.grades import grade_named
from terranav.integrity.gnss import ALARMS
from terranav.live.records import Fix
from terranav.live.settings import LiveSettings
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.lockstep import Lockstep
from terranav.live.testbed.settings import FlightSettings
from terranav.maps.sample_dem import sample_map

#: way of reckoning -> what the vehicle reports, and the INS that is told
WAYS = {"position": ("ins", "tactical"), "airspeed": ("own", ""), "velocity": ("own", "")}


@dataclass(frozen=True)
class Flown:
    """One flight: false alarms, time of the flag since the pull began [s], share of usable fixes before the pull."""

    false_alarms: int
    flagged_s: float
    usable: float


def flown(way: str, seed: int, told: argparse.Namespace) -> Flown:
    """Fly once."""
    reports, ins = WAYS[way]
    chart = sample_map()
    flight = Flight(
        chart,
        FlightSettings(
            minutes=told.minutes,
            gnss_off_s=math.inf,
            spoof_at_s=told.at,
            spoof_mps=told.mps,
            reports=reports,
            seed=seed,
        ),
    )
    settings = LiveSettings(ins_source=way, ins=grade_named(ins) if ins else None, monitor=True)
    loop = Lockstep(flight, [chart], settings, feedback=False)
    alarmed, false_alarms, flagged_s, usable = False, 0, math.nan, list[bool]()
    while not flight.over:
        for one in loop.step():
            if not isinstance(one, Fix) or one.gnss is None:
                continue
            now_s, alarm = flight.time_us * 1e-6, one.gnss.status in ALARMS
            if now_s < told.at:
                false_alarms += alarm and not alarmed
                usable.append(one.usable)
            elif alarm and math.isnan(flagged_s):
                flagged_s = now_s - told.at
            alarmed = alarm
    return Flown(false_alarms, flagged_s, float(np.mean(usable)))


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--at", type=float, default=240.0)
    parser.add_argument("--mps", type=float, default=2.0)
    parser.add_argument("--way", choices=sorted(WAYS), action="append")
    told = parser.parse_args()
    for way in told.way or WAYS:
        runs = [flown(way, seed, told) for seed in range(told.seeds)]
        off_m = told.mps * np.array([one.flagged_s for one in runs])
        found = int(np.isfinite(off_m).sum())
        near = int((off_m < 300.0).sum())
        share = clopper_pearson(near, len(runs))
        print(
            f"{way}: flagged {found} of {len(runs)}, before 300 m {near} "
            f"({100 * share.low:.0f} to {100 * share.high:.0f} %), at "
            + ", ".join(f"{one:.0f}" for one in off_m)
            + f" m; false alarms {sum(one.false_alarms for one in runs)} in {told.at * len(runs) / 3600:.2f} h; "
            f"usable before {', '.join(f'{100 * one.usable:.0f}' for one in runs)} %",
            flush=True,
        )


if __name__ == "__main__":
    main()

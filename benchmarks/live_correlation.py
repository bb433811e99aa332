"""How alike successive fixes err, and what widening their sigma for it does to the filter that takes them.

    python -m benchmarks.live_correlation [--seeds 2] [--minutes 10] [--taus 0 10 25]

The test bed (extra 'fly') over the sample map in lock-step with the live engine, GNSS lost after one minute. First the
correlation of the errors of usable fixes over their claimed sigma, by the time between them. Then, for each
`--correlation` (tau), how far off the vehicle's own filter was (95 % of the seconds without GNSS), and what it claimed
(1-sigma over both axes, median): a claim below about half of that distance is too sure. That filter is a simple one
with PX4's gate and noise floor; EKF2 and EKF3 weigh fixes in their own ways.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import offset_m
from terranav.live.records import Fix
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.lockstep import Lockstep
from terranav.live.testbed.settings import FlightSettings
from terranav.live.testbed.telemetry import BOOT_US
from terranav.maps.sample_dem import sample_map

_OFF_S = 60.0
_LAGS_S = (1.0, 5.0, 10.0, 20.0, 30.0)
_GRID_S = 0.5


def errors(flight: Flight, fixes: list[Fix]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times and errors over their sigma (n, 2) of usable fixes."""
    true = flight.recording().columns
    time_s = np.array([((fix.boot_us or 0) - BOOT_US) * 1e-6 for fix in fixes])
    lat, lon = (np.interp(time_s, true["time_s"], true[key]) for key in ("true_lat_deg", "true_lon_deg"))
    north, east = offset_m(lat, lon, [fix.lat_deg for fix in fixes], [fix.lon_deg for fix in fixes])
    return time_s, np.column_stack([north, east]) / np.array([fix.sigma_m for fix in fixes])


def correlations(time_s: NDArray[np.float64], scaled: NDArray[np.float64]) -> list[float]:
    """Correlation of the scaled errors at each lag, both axes together."""
    grid = np.arange(time_s[0], time_s[-1], _GRID_S)
    place = np.clip(np.searchsorted(time_s, grid), 0, len(time_s) - 1)
    on_grid = np.where(np.abs(time_s[place] - grid)[:, None] < 0.5 * _GRID_S, scaled[place], np.nan)
    whole = float(np.nanmean(on_grid**2))
    return [
        float(np.nanmean(on_grid[: -round(lag / _GRID_S)] * on_grid[round(lag / _GRID_S) :])) / whole for lag in _LAGS_S
    ]


def flown(autopilot: str, seed: int, minutes: float, tau: float | None) -> tuple[Flight, Lockstep, list[Fix], float]:
    """One flight; the fixes, and the median claim of the vehicle's filter [m]. No fix is sent for tau None."""
    told = FlightSettings(minutes=minutes, gnss_off_s=_OFF_S, autopilot=autopilot, seed=seed)
    flight = Flight(sample_map(), told, record=True)
    pair = Lockstep(flight, [sample_map()], feedback=tau is not None)
    pair.output._correlation_s = tau or 0.0
    fixes: list[Fix] = []
    claims: list[float] = []
    while not flight.over:
        fixes += [one for one in pair.step() if isinstance(one, Fix) and one.usable]
        if flight.time_us % 1_000_000 == 0 and flight.time_us > (_OFF_S + 30.0) * 1e6:
            claims.append(float(np.sqrt(np.trace(flight.navigation._fusion.cov[:2, :2]))))
    return flight, pair, fixes, float(np.median(claims))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--taus", type=float, nargs="+", default=[0.0, 10.0, 25.0])
    told = parser.parse_args()
    print("autopilot  seed   tau s   own 95 % m   claims m   without m      sent")
    table = []
    for autopilot in ("px4", "ardupilot"):
        for seed in range(told.seeds):
            for number, tau in enumerate(told.taus):
                flight, pair, fixes, claim = flown(autopilot, seed, told.minutes, tau)
                own, without = flight.score.of("own", _OFF_S).p95_m, flight.score.of("without", _OFF_S).p95_m
                head = f"{autopilot:9} {seed:5} {tau:7g}"
                print(f"{head} {own:12.0f} {claim:10.1f} {without:11.0f} {pair.output.sent:9}", flush=True)
                if number == 0:
                    table.append(correlations(*errors(flight, fixes)))
    print("correlation after   " + "".join(f"{lag:8g} s" for lag in _LAGS_S))
    print("least               " + "".join(f"{value:10.2f}" for value in np.min(table, axis=0)))
    print("most                " + "".join(f"{value:10.2f}" for value in np.max(table, axis=0)))


if __name__ == "__main__":
    main()

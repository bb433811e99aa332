"""The live engine against the flying test bed in lock-step: latency, position, share of the time usable, CPU, memory.

    python -m benchmarks.live_flight [--seeds 10] [--minutes 20] [--as px4|ardupilot] [--map DEM]
    python -m benchmarks.live_flight --soak 6
    python -m benchmarks.live_flight --picture docs/fly.png [--first-seed 0]

A run flies the Cessna over terranav.sample_map(), whose true ground differs from the map by its stated error, with GNSS
for two minutes. Route, wind and all errors differ from seed to seed. The engine hears what the vehicle sends, as
`terranav live` does with its defaults, and its fixes go back into the vehicle's own filter by which it steers.
Figures count from the loss of GNSS. `--off 0` flies without GNSS from the start.

Latency is what the engine takes for all messages of one tenth of a second, ten of which arrive at once, up to the fix
that is encoded: the time by the clock (what a user waits) on one thread. CPU is the processor's time of the engine
over the flight's duration.
"""

from __future__ import annotations

import argparse
import gc
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import terranav as tn
from benchmarks.statistics import with_interval
from terranav.core.earth import offset_of
from terranav.live.records import Fix
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.lockstep import Lockstep
from terranav.live.testbed.settings import FlightSettings

FloatArray = NDArray[np.float64]

ASKED = {"p95 ms": 50.0, "p99 ms": 150.0, "CPU %": 30.0, "within m": 100.0, "growth %": 2.0}
FIRST_MINUTES, SAMPLE_S = 10.0, 60.0


@dataclass(frozen=True)
class Run:
    """One flight: per epoch with a fix its latency [ms] and error [m], and sums.

    Attributes
    ----------
    latency_ms : (n,)
    error_m : (k,)
        Of the usable fixes.
    beyond : int
        Usable fixes beyond their protection level.
    usable : float
        Share of the epochs.
    vehicle_m : (s,)
        Error of the vehicle's own position, once a second.
    facts : mapping
        Of the flight.
    cpu : float
        Of one core at real-time speed.
    """

    latency_ms: FloatArray
    error_m: FloatArray
    beyond: int
    usable: float
    vehicle_m: FloatArray
    facts: dict[str, object]
    cpu: float


def fly(chart: tn.Map, settings: FlightSettings) -> Run:
    """Fly once."""
    loop = Lockstep(Flight(chart, settings), [chart])
    flight, since_us = loop.flight, settings.gnss_off_s * 1e6
    latency, errors, vehicle = [], [], []
    beyond = fixes = 0
    cpu_ns = 0
    while not flight.over:
        frames = flight.tick()
        begun, begun_cpu = time.perf_counter_ns(), time.process_time_ns()
        made = [one for one in loop.hear(frames) if isinstance(one, Fix)]
        spent = time.perf_counter_ns() - begun
        cpu_ns += time.process_time_ns() - begun_cpu
        if made:
            latency.append(spent * 1e-6)
        if flight.time_us < since_us:
            continue
        true = flight.truth
        for fix in made:
            fixes += 1
            if fix.usable:
                errors.append(math.hypot(*offset_of(true.lat_deg, true.lon_deg, fix.lat_deg, fix.lon_deg)))
                beyond += errors[-1] > fix.estimate.protection_m
        if flight.time_us % 1_000_000 == 0:
            vehicle.append(flight.own_error_m)
    return Run(
        np.array(latency), np.array(errors), beyond, len(errors) / max(fixes, 1), np.array(vehicle), flight.facts(),
        cpu_ns * 1e-9 / settings.duration_s,
    )  # fmt: skip


def table(chart: tn.Map, settings: list[FlightSettings]) -> None:
    """Fly all and print what is asked beside what came out."""
    runs = []
    print(
        "seed  fix p50  p95   max  usable  beyond  vehicle p95   max  at end  without fixes  off track p95  p95 ms  CPU"
    )
    for told in settings:
        run = fly(chart, told)
        runs.append(run)
        fix, own, facts = run.error_m, run.vehicle_m, run.facts
        print(
            f"{told.seed:4d}  {np.median(fix):5.0f} m {np.percentile(fix, 95):3.0f} m {fix.max():3.0f} m  "
            f"{100 * run.usable:4.1f} %  {run.beyond:6d}  {np.percentile(own, 95):9.0f} m {own.max():4.0f} m "
            f"{own[-1]:5.0f} m  {facts['without_fixes_last_m']:11.0f} m  {facts['off_track_p95_m']:11.0f} m  "
            f"{np.percentile(run.latency_ms, 95):6.1f}  {100 * run.cpu:3.1f} %",
            flush=True,
        )
    latency = np.concatenate([run.latency_ms for run in runs])
    print(f"\n{len(runs)} flights of {settings[0].minutes:g} minutes; 95 % bootstrap intervals over flights\n")
    p50, p95, p99 = np.percentile(latency, [50, 95, 99])
    asked = f"asked p95 {ASKED['p95 ms']:g}, p99 {ASKED['p99 ms']:g}"
    print(f"latency p50 {p50:.1f} ms, p95 {p95:.1f} ms, p99 {p99:.1f} ms ({asked}), longest {latency.max():.0f} ms; "
          f"{latency.size} epochs")  # fmt: skip
    rows: dict[str, list[float]] = {
        "usable fixes, 95th percentile of a flight [m]": [float(np.percentile(run.error_m, 95)) for run in runs],
        "usable fixes within 100 m [%]": [100 * float(np.mean(run.error_m <= ASKED["within m"])) for run in runs],
        "vehicle, 95th percentile of a flight [m]": [float(np.percentile(run.vehicle_m, 95)) for run in runs],
        "vehicle within 100 m [%]": [100 * float(np.mean(run.vehicle_m <= ASKED["within m"])) for run in runs],
        "vehicle without fixes, at the end [m]": [float(str(run.facts["without_fixes_last_m"])) for run in runs],
        "epochs with a usable fix [%]": [100 * run.usable for run in runs],
        "CPU of one core at real-time speed [%]": [100 * run.cpu for run in runs],
    }
    for name, values in rows.items():
        value, low, high = with_interval(np.array(values), lambda sample: np.mean(sample, axis=-1))
        print(f"{name:46s} mean {value:7.1f} ({low:.1f}..{high:.1f}), worst flight {_worst(name, values):.1f}")
    total = sum(run.error_m.size for run in runs)
    print(f"usable fixes beyond their protection level: {sum(run.beyond for run in runs)} of {total}")


def _worst(name: str, values: list[float]) -> float:
    """The least of what should be large, the largest of what should be small."""
    return float(min(values) if "within" in name or "usable fix [" in name else max(values))


def soak(chart: tn.Map, hours: float, seed: int) -> None:
    """Fly for hours and print how memory grows after the first ten minutes of flight."""
    settings = FlightSettings(minutes=60.0 * hours, seed=seed)
    loop = Lockstep(Flight(chart, settings), [chart])
    flight, begun = loop.flight, time.monotonic()
    first, last, fixes = 0.0, 0.0, 0
    while not flight.over:
        fixes += sum(isinstance(one, Fix) for one in loop.step())
        if flight.time_us % round(SAMPLE_S * 1e6) == 0:
            gc.collect()
            last = resident_mb()
            minutes = flight.time_us / 60e6
            if minutes <= FIRST_MINUTES:
                first = max(first, last)
            if minutes % 30 == 0 or minutes == FIRST_MINUTES:
                print(f"{minutes:5.0f} min  {last:7.1f} MiB  {fixes} fixes", flush=True)
    growth = 100.0 * (last / first - 1.0)
    print(f"{hours:g} hours of flight in {time.monotonic() - begun:.0f} s: {first:.1f} MiB after {FIRST_MINUTES:g} "
          f"minutes, {last:.1f} MiB at the end: {growth:+.1f} % (asked at most {ASKED['growth %']:g} %); "
          f"own position {flight.own_error_m:.0f} m off at the end")  # fmt: skip


def picture(chart: tn.Map, settings: FlightSettings) -> bytes:
    """Where the aircraft flew with the fixes and without them, and how far off its own position was."""
    from terranav.app.style import INS, MAIN, new_figure, png, styled
    from terranav.app.trackmap import HALO, dress, shade

    with_fixes, without = Lockstep(Flight(chart, settings), [chart]), Flight(chart, settings)
    ways = [_way(with_fixes.flight, with_fixes.step), _way(without, without.tick)]
    course = np.array(with_fixes.flight.course.places)
    lat, lon = np.concatenate([way[:, 1] for way in ways]), np.concatenate([way[:, 2] for way in ways])
    south, west, north, east = lat.min() - 0.02, lon.min() - 0.05, lat.max() + 0.02, lon.max() + 0.05
    frame = (float(south), float(west), float(north), float(east))
    with styled():
        figure = new_figure(8.6)
        ground, error = figure.subplots(2, 1, height_ratios=[3.4, 1.0])
        shade(ground, chart, frame)
        ground.plot(course[:, 1], course[:, 0], "--", color="#333333", linewidth=1.2, label="planned")
        names = (MAIN, "flown with the fixes of terranav live"), (INS, "flown without fixes")
        for (colour, name), way in zip(names, ways, strict=True):
            ground.plot(way[:, 2], way[:, 1], color=colour, linewidth=2.0, path_effects=HALO, label=name)
            error.plot(way[:, 0] / 60.0, np.maximum(way[:, 3], 0.3), color=colour, linewidth=1.6)
        lost = min(int(settings.gnss_off_s), len(ways[0]) - 1)
        ground.plot(*ways[0][lost, [2, 1]], "o", color="#111111", markersize=7, label="GNSS is lost", zorder=9)
        ground.set(xlim=(frame[1], frame[3]), ylim=(frame[0], frame[2]))
        dress(ground, frame)
        error.axvline(settings.gnss_off_s / 60.0, color="#111111", linewidth=1.0)
        error.set(yscale="log", xlabel="minutes of flight", ylabel="own position\nwrong by [m]")
        error.set_xlim(0.0, settings.minutes)
        figure.legend(loc="outside lower center", ncols=4, fontsize=10)
    return png(figure, dpi=110)


def _way(flight: Flight, step: Callable[[], object]) -> FloatArray:
    """Time [s], true latitude and longitude [deg], and own error [m] (n, 4), once a second."""
    rows = []
    while not flight.over:
        step()
        if flight.time_us % 1_000_000 == 0:
            rows.append((flight.time_us * 1e-6, flight.truth.lat_deg, flight.truth.lon_deg, flight.own_error_m))
    return np.array(rows)


def resident_mb() -> float:
    """Memory of this process that is in RAM [MiB]; Linux."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="flights")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--off", type=float, default=120.0, help="GNSS is lost at this time [s]")
    parser.add_argument("--as", dest="autopilot", default="px4")
    parser.add_argument("--map", type=Path, help="instead of the sample map")
    parser.add_argument("--soak", type=float, metavar="HOURS", help="one long flight: memory")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="one flight with and one without fixes, drawn")
    told = parser.parse_args()
    chart = tn.sample_map() if told.map is None else tn.open_map(told.map, kind="terrain")
    if told.picture is not None:
        told.picture.write_bytes(picture(chart, FlightSettings(minutes=told.minutes, seed=told.first_seed)))
        return
    if told.soak is not None:
        soak(chart, told.soak, told.first_seed)
        return
    seeds = range(told.first_seed, told.first_seed + told.seeds)
    table(chart, [FlightSettings(minutes=told.minutes, seed=seed, gnss_off_s=told.off, autopilot=told.autopilot)
                  for seed in seeds])  # fmt: skip


if __name__ == "__main__":
    main()

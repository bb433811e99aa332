"""Two drives over one road with a phone: a height map built from one holds the other, by its barometer alone.

    python -m benchmarks.phone_drive --data DIR [--runs 16] [--by drift|odometer] [--map 1|2] [--from-start]
                                     [--corridor 2000] [--cell 50]

DIR is the folder of data (or its phone_drive). The map: heights along the first drive, the phone's barometer with its
slow drift taken out by the GNSS altitude (over ten minutes), laid on a grid; a cell off the road has the height of the
nearest piece of road, void beyond the corridor. The other drive loses GNSS when it drives off and navigates

    drift     by the drift of an INS of 1 nmi/h added to its true track
    odometer  by its GNSS speed with a scale error of 1 % (1 sigma, one draw a run), along its GNSS course with a
              heading error of 1 degree at the start and a gyro's drift of 3 deg/h (1 sigma each): a car's usual dead
              reckoning. The phone's own yaw is of no use: it jumps by tens of degrees when it is touched

with one seed a run for these errors, held by `marginalized` with the readings of --ground-vehicle. GNSS goes when the
drive has come within 50 m of the mapped road for a minute (with --from-start when it drives off, though that be beside
the map) and stays away until it leaves that road for good. Each drive is once the map and once the flight. Medians over
runs with 95 % bootstrap intervals.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer
from scipy.spatial import cKDTree

import terranav as tn
from benchmarks.statistics import median_with_interval
from terranav.core.earth import offset_m
from terranav.core.recording import VELOCITY, Recording
from terranav.experiment.replay import Denied, Withheld, spaced, withhold
from terranav.experiment.replay_ways import Flown, nautical_miles_an_hour, summed_up
from terranav.io.logs import Log, open_log

FloatArray = NDArray[np.float64]

FILES = ("2025-07-04_17-24-46.csv", "2025-07-11_13-33-16.csv")
MOUNT_M = 1.0  # of the phone above the road
SMOOTH_S = 600.0  # over which GNSS altitude corrects the barometer of the map
ON_ROAD_M = 50.0  # nearer to the mapped road than this is on it
STEP_M = 10.0  # between two heights along the road
MAP_SIGMA_M = 2.0  # two drives' barometers differ by 1.5 m once their slow drift is out
SCALE, HEADING_DEG, GYRO_DEG_PER_H = 0.01, 1.0, 3.0
ODOMETER = tn.InsGrade(5.0, 0.3, 0.3, 0.02)
SPACING_CELLS = 0.5
NEAR_M, FAR_M = 100.0, 250.0


@dataclass(frozen=True)
class Road:
    """The map's settings: cell and half width of the corridor that heights are laid out to [m]."""

    cell_m: float = 50.0
    corridor_m: float = 2000.0


def road_map(log: Log, road: Road, name: str) -> tn.Map:
    """A height map of the road that was driven."""
    rec = log.recording
    lat, lon, alt = (rec.columns[key] for key in ("true_lat_deg", "true_lon_deg", "true_alt_m"))
    baro = rec.columns["baro_altitude_m"]
    known = np.isfinite(lat) & np.isfinite(alt) & np.isfinite(baro)
    height = baro[known] + slow(rec.time_s[known], (alt - baro)[known]) - MOUNT_M
    crs = f"+proj=tmerc +lat_0={lat[known].mean():.3f} +lon_0={lon[known].mean():.3f} +ellps=WGS84 +units=m"
    x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon[known], lat[known])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    moving = np.concatenate([[True], np.diff(along) > 0.0])
    even = np.arange(0.0, along[-1], STEP_M)
    px, py, pz = (np.interp(even, along[moving], column[moving]) for column in (x, y, height))
    west, north = px.min() - road.corridor_m, py.max() + road.corridor_m
    cols = int((px.max() + road.corridor_m - west) / road.cell_m) + 1
    rows = int((north - py.min() + road.corridor_m) / road.cell_m) + 1
    grid_x, grid_y = np.meshgrid(
        west + road.cell_m * (np.arange(cols) + 0.5), north - road.cell_m * (np.arange(rows) + 0.5)
    )
    tree = cKDTree(np.stack([px, py], axis=1))
    cells = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
    away, nearest = tree.query(cells, distance_upper_bound=road.corridor_m)
    values = np.full(away.size, np.nan, dtype=np.float32)
    near = np.isfinite(away)
    values[near] = pz[nearest[near]]
    transform = (road.cell_m, 0.0, float(west), 0.0, -road.cell_m, float(north))
    return tn.Map(
        values.reshape(rows, cols), transform, crs, sigma=MAP_SIGMA_M, datum="mean sea level", name=name,
        correlation_m=500.0,
    )  # fmt: skip


def slow(time_s: FloatArray, values: FloatArray) -> FloatArray:
    """A running median over SMOOTH_S, (n,)."""
    first = np.searchsorted(time_s, time_s - 0.5 * SMOOTH_S)
    last = np.searchsorted(time_s, time_s + 0.5 * SMOOTH_S)
    return np.array([np.median(values[a:b]) for a, b in zip(first, last, strict=True)])


def on_the_road(built: Log, driven: Log) -> tuple[float, float]:
    """From when to when a drive is on the road that another mapped [s]."""
    here, there = _places(built, driven)
    near = cKDTree(here).query(there)[0] < ON_ROAD_M
    time_s = driven.recording.time_s
    for row in np.flatnonzero(near).tolist():
        minute = (time_s >= time_s[row]) & (time_s <= time_s[row] + 60.0)
        if near[minute].all():
            return float(time_s[row]), float(time_s[np.flatnonzero(near)[-1]])
    raise SystemExit("the drives have no minute of road in common")


def _places(first: Log, second: Log) -> tuple[FloatArray, FloatArray]:
    """True places (n, 2), (m, 2) north and east of the middle of the first [m]."""
    a, b = first.recording.columns, second.recording.columns
    lat, lon = float(a["true_lat_deg"].mean()), float(a["true_lon_deg"].mean())
    here, there = (np.stack(offset_m(lat, lon, c["true_lat_deg"], c["true_lon_deg"]), axis=1) for c in (a, b))
    return here, there


Spans = str | list[tuple[float, float]]


def by_drift(log: Log, spans: Spans, seed: int) -> Denied:
    """The true track and the drift of an INS of 1 nmi/h."""
    flown = Flown(nautical_miles_an_hour(1.0), seed)
    return withhold(log, Withheld(spans, "drift", flown, MOUNT_M))[0]


def by_odometer(log: Log, spans: Spans, seed: int) -> Denied:
    """GNSS speed with a scale error, GNSS course with a heading error that grows: a car's dead reckoning."""
    denied = withhold(log, Withheld(spans, "velocity", on_ground_m=MOUNT_M))[0]
    rec = denied.recording
    scale, heading, gyro = np.random.default_rng([seed, 7]).standard_normal(3)
    velocity = np.stack([_whole(rec, key) for key in VELOCITY[:2]], axis=1)
    elapsed_h = (rec.time_s - rec.time_s[0]) / 3600.0
    turn = np.radians(HEADING_DEG * heading + GYRO_DEG_PER_H * gyro * elapsed_h)
    cos, sin = (1.0 + SCALE * scale) * np.cos(turn), (1.0 + SCALE * scale) * np.sin(turn)
    north, east = cos * velocity[:, 0] - sin * velocity[:, 1], sin * velocity[:, 0] + cos * velocity[:, 1]
    start = float(rec.columns["true_lat_deg"][0]), float(rec.columns["true_lon_deg"][0])
    lat, lon = summed_up(rec.time_s, np.stack([north, east], axis=1), start, rec.alt_m)
    moved = rec.with_columns(lat_deg=lat, lon_deg=lon, **dict(zip(VELOCITY[:2], (north, east), strict=True)))
    return replace(denied, recording=replace(moved, ins=ODOMETER))


def _whole(rec: Recording, key: str) -> FloatArray:
    """A column with its gaps bridged."""
    column = rec.columns[key]
    known = np.isfinite(column)
    return np.interp(rec.time_s, rec.time_s[known], column[known])


WAYS: dict[str, Callable[[Log, Spans, int], Denied]] = {"drift": by_drift, "odometer": by_odometer}


def one(chart: tn.Map, denied: Denied, seed: int) -> dict[str, float]:
    """Figures of one run, with the map and without."""
    flight = spaced(denied, SPACING_CELLS * chart.cell_m).recording
    result = tn.run("marginalized", flight, maps=[chart], seed=seed)
    alone = np.hypot(*flight.ins_error_m().T)
    held = np.hypot(*result.error_m.T)
    figures = result.metrics()
    usable = result.usable & np.isfinite(held)
    return {
        "unaided_r95": float(np.nanpercentile(alone, 95)),
        "unaided_end": float(alone[-1]),
        "aided_r95": figures["r95_m"],
        "aided_end": figures["final_m"],
        "aided_median": float(np.nanmedian(held)),
        "within 100 m": float(np.mean(held[np.isfinite(held)] < NEAR_M)),
        "unaided, so": float(np.mean(alone[np.isfinite(alone)] < NEAR_M)),
        "held for, min": _held_min(flight.time_s, held),
        "in 95 %": figures["contained_95"],
        "usable": figures["available"],
        "beyond HPL": float(np.mean(held[usable] > result.protection_m[usable])) if usable.any() else 0.0,
        "better": float(figures["r95_m"] < np.nanpercentile(alone, 95)),
    }


def _held_min(time_s: FloatArray, error_m: FloatArray) -> float:
    """Minutes until the error first exceeds FAR_M, the whole drive where it never does."""
    beyond = np.flatnonzero(error_m > FAR_M)
    return float(time_s[beyond[0] if beyond.size else -1] - time_s[0]) / 60.0


def overlap(first: Log, second: Log) -> str:
    """How well the two drives agree, in words: where they went and what their barometers said there."""
    a, b = first.recording.columns, second.recording.columns
    here, there = _places(first, second)
    away, nearest = cKDTree(here).query(there)
    near = away < 30.0
    apart = (b["baro_altitude_m"] - a["baro_altitude_m"][nearest])[near]
    time_s = second.recording.time_s[near]
    fast = apart - slow(time_s, apart)
    return (
        f"the second drive is within 30 m of the first at {100 * near.mean():.0f} % of its epochs; its barometer "
        f"differs there by {apart.std():.1f} m (1 sigma), {fast.std():.1f} m once what is slower than "
        f"{SMOOTH_S / 60:.0f} min is out; the road's height varies by {a['baro_altitude_m'].std():.1f} m"
    )


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--runs", type=int, default=16)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--corridor", type=float, default=Road.corridor_m)
    parser.add_argument("--cell", type=float, default=Road.cell_m)
    parser.add_argument("--by", choices=tuple(WAYS), action="append")
    parser.add_argument("--map", type=int, choices=(1, 2), help="the drive that makes the map; else both in turn")
    parser.add_argument("--from-start", action="store_true", help="take GNSS away when it drives off")
    options = parser.parse_args()
    folder = options.data / "phone_drive" if (options.data / "phone_drive").is_dir() else options.data
    if missing := [name for name in FILES if not (folder / name).is_file()]:
        parser.error(f"{folder} holds no {', '.join(missing)}: expected the folder of the phone drives")
    warnings.simplefilter("ignore")
    logs = [open_log(folder / name) for name in FILES]
    print(overlap(*logs))
    road = Road(options.cell, options.corridor)
    for way in options.by or WAYS:
        for built, driven in ((0, 1), (1, 0)):
            if options.map not in (None, built + 1):
                continue
            span = on_the_road(logs[built], logs[driven])
            spans: Spans = "take-off" if options.from_start else [span]
            chart = road_map(logs[built], road, f"drive {built + 1}")
            began = time.perf_counter()
            seeds = range(options.first_seed, options.first_seed + options.runs)
            runs = [one(chart, WAYS[way](logs[driven], spans, seed), seed) for seed in seeds]
            print(f"\nby {way}: the map of drive {built + 1} holds drive {driven + 1}, {len(runs)} runs, "
                  f"GNSS off {'from the start' if options.from_start else f'{span[0]:.0f} to {span[1]:.0f} s'}; "
                  f"took {time.perf_counter() - began:.0f} s", flush=True)  # fmt: skip
            for key in runs[0]:
                values = np.array([run[key] for run in runs])
                middle, low, high = median_with_interval(values)
                print(f"  {key:14}{middle:10.3g} ({low:.3g}..{high:.3g}), worst {values.max():.3g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

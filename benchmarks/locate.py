"""A profile found anywhere on a map: how often right, how often wrong and sure, how honest its sigma, how fast.

    python -m benchmarks.locate [--ground rough] [--runs 100] [--seed 5000] [--heading 2] [--scale 0] [--length 15]
    python -m benchmarks.locate --growth [--runs 20]
    python -m benchmarks.locate --flights

The map is the block of four SRTM tiles beside the checkout (or in the folder that TERRANAV_SHARED names), 2401 x 2401
cells of 3 arcsec. A run draws a straight track anywhere on it, its heading and scale errors evenly within what is told,
and an unknown height offset; readings every 60 m have noise of 5 m, and the map an error of 3 m correlated over 2.5
cells along the track. Ground goes by the spread of the heights under the track about a straight line: rough above
40 m, flat below 5 m, middling between. Right: the track's end within two cells. One thread.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import terranav as tn
from benchmarks.statistics import median_with_interval
from terranav.core.earth import offset_of, shift
from terranav.planning.locate import LocateSettings, Track, locate

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("TERRANAV_SHARED", ROOT.parent / "shared")) / "data" / "srtm"
TILES = (("N48E009", "N48E010"), ("N47E009", "N47E010"))
SPACING_M, SIGMA_M, MAP_SIGMA_M, OFFSET_M = 60.0, 5.0, 3.0, 30.0
GROUNDS = {"rough": (40.0, math.inf), "middling": (5.0, 40.0), "flat": (0.0, 5.0)}
RIGHT_CELLS = 2.0
MOST_DRAWS = 100_000
FLIGHT_INS = tn.InsGrade(20_000.0, 0.3, 0.3)
MIRRORED = (2, 3)  # times the block's side, in the growth of the time with the map

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class World:
    """What is drawn: the ground, and what the search is told at most of heading [deg], scale and length [m]."""

    ground: str = "rough"
    heading_deg: float = 2.0
    scale: float = 0.0
    length_m: float = 15_000.0


@dataclass(frozen=True)
class Outcome:
    """One run: error of the track's end [m], how it was told, time by the clock and of the processor [s], and work."""

    seed: int
    error_m: float
    right: bool
    verdict: str
    places: int
    probability: float
    sigma_m: float
    squared: float  # error in the metric of the covariance told, 2 on average
    seconds: float
    cpu_s: float
    share: float


def block(data: Path = DATA) -> tn.Map:
    """The four tiles as one map; they share a row or column of posts."""
    tiles = [[tn.open_map(data / f"{name}.hgt", sigma=MAP_SIGMA_M) for name in row] for row in TILES]
    rows = [np.hstack([west.values, east.values[:, 1:]]) for west, east in tiles]
    return replace(tiles[0][0], values=np.vstack([rows[0], rows[1][1:]]), name="SRTM block")


def mirrored(chart: tn.Map, times: int) -> tn.Map:
    """A map side by side with its mirror images, so many along each axis."""
    values = chart.values
    row = np.hstack([values[:, :: 1 if k % 2 == 0 else -1] for k in range(times)])
    return replace(chart, values=np.vstack([row[:: 1 if k % 2 == 0 else -1] for k in range(times)]))


def drawn(chart: tn.Map, world: World, seed: int) -> tuple[Track, float, float]:
    """A track as indicated and seen, and where it truly ended [deg]."""
    rng = np.random.default_rng(seed)
    along = np.arange(0.0, world.length_m + 0.5 * SPACING_M, SPACING_M)
    south, west, north, east = chart.bounds_deg
    low, high = GROUNDS[world.ground]
    for _ in range(MOST_DRAWS):
        (lat0, lon0), bearing = rng.uniform((south, west), (north, east)), rng.uniform(0.0, 2.0 * math.pi)
        lat, lon = shift(lat0, lon0, along * math.cos(bearing), along * math.sin(bearing))
        height = chart.sample(lat, lon)
        if np.isfinite(height).all() and low <= _relief(along, height) < high:
            break
    else:
        raise tn.DataError(f"{chart.name}: no {world.ground} track of {world.length_m:g} m in {MOST_DRAWS} draws")
    seen = height + rng.normal(0.0, OFFSET_M) + SIGMA_M * rng.standard_normal(along.size)
    seen += _map_error(rng, along.size, math.exp(-SPACING_M / chart.error_length_m))
    turn = bearing - math.radians(rng.uniform(-world.heading_deg, world.heading_deg))
    flown = along / (1.0 + rng.uniform(-world.scale, world.scale))
    return Track(flown * math.cos(turn), flown * math.sin(turn), seen, SIGMA_M), float(lat[-1]), float(lon[-1])


def _relief(along: FloatArray, height: FloatArray) -> float:
    """Spread of heights about a straight line [m]."""
    return float(np.std(height - np.polyval(np.polyfit(along, height, 1), along)))


def _map_error(rng: np.random.Generator, count: int, keep: float) -> FloatArray:
    """First-order Gauss-Markov along the track [m]."""
    fresh, error = MAP_SIGMA_M * rng.standard_normal(count), np.empty(count)
    error[0] = fresh[0]
    for k in range(1, count):
        error[k] = keep * error[k - 1] + math.sqrt(1.0 - keep * keep) * fresh[k]
    return error


def run(chart: tn.Map, world: World, seed: int) -> Outcome:
    """Draw, locate, compare."""
    track, lat, lon = drawn(chart, world, seed)
    settings = LocateSettings(heading_deg=world.heading_deg, scale=world.scale)
    start = time.perf_counter(), time.thread_time()
    found = locate(track, chart, settings)
    spent = time.perf_counter() - start[0], time.thread_time() - start[1]
    if not found.candidates:
        nothing = math.nan
        return Outcome(seed, math.inf, False, found.verdict, 0, 0.0, nothing, nothing, *spent, found.share)
    best = found.candidates[0]
    off = np.array(offset_of(lat, lon, best.lat_deg, best.lon_deg))
    error, squared = float(np.hypot(*off)), float(off @ np.linalg.solve(best.cov_m2, off))
    right, places = error <= RIGHT_CELLS * chart.cell_m, len(found.candidates)
    return Outcome(
        seed, error, right, found.verdict, places, best.probability, best.sigma_m, squared, *spent, found.share
    )


def wilson(count: int, of: int) -> str:
    """'count of n: share (Wilson 95 % interval)'."""
    z2, p = 1.959964**2, count / of
    middle, half = p + z2 / (2 * of), math.sqrt(z2 * (p * (1 - p) / of + z2 / (4.0 * of * of)))
    low, high = ((middle + side * half) / (1 + z2 / of) for side in (-1, 1))
    return f"{count} of {of}: {100 * p:.1f} % ({100 * max(low, 0.0):.1f}..{100 * high:.1f})"


def told(world: World, outcomes: list[Outcome]) -> Iterator[str]:
    """The lines of a table."""
    n = len(outcomes)
    wrong = [one for one in outcomes if not one.right and one.verdict == "found"]
    seconds = np.array([one.seconds for one in outcomes])
    work = np.array([one.share for one in outcomes])
    heading = "unknown" if world.heading_deg >= 180.0 else f"within {world.heading_deg:g} degrees"
    yield f"{world.ground}, {world.length_m / 1000:g} km, heading {heading}, scale within {100 * world.scale:g} %"
    yield f"  right          {wilson(sum(one.right for one in outcomes), n)}"
    yield f"  said to be     found {wilson(sum(one.verdict == 'found' for one in outcomes), n)}"
    for word in ("ambiguous", "not found", "not searched to the end"):
        yield f"                 {word} {wilson(sum(one.verdict == word for one in outcomes), n)}"
    yield f"  wrong and sure {wilson(len(wrong), n)}" + "".join(f"; seed {one.seed}" for one in wrong)
    sure = [one for one in outcomes if one.verdict == "found" and one.right]
    if sure:
        squared = np.array([one.squared for one in sure])
        yield f"  error          {_middle([one.error_m for one in sure], 'm')}, sigma told {_sigma(sure)}"
        yield f"  error / sigma  mean square {_middle(0.5 * squared, '', np.mean)} per axis (1 is right), "
        yield f"                 in the 95 % ellipse {wilson(int((squared <= 5.991).sum()), len(sure))}"
    late = f"95 % {np.percentile(seconds, 95):.2f} s, most {seconds.max():.2f} s"
    yield f"  time           {_middle(seconds, 's')}, {late}"
    cpu = np.array([one.cpu_s for one in outcomes])
    yield f"  of the thread  {_middle(cpu, 's')}, 95 % {np.percentile(cpu, 95):.2f} s, most {cpu.max():.2f} s"
    yield f"  work           {np.median(work):.2g} of exhaustive search in the median run, {work.max():.2g} at most"


def _middle(values: object, unit: str, statistic: object = None) -> str:
    """A median, or another statistic, with its interval."""
    from benchmarks.statistics import with_interval

    array = np.asarray(values, dtype=np.float64)
    if statistic is not None:
        value, low, high = with_interval(array, lambda sample: np.mean(sample, axis=-1))
        return f"{value:.2f} ({low:.2f}..{high:.2f})"
    value, low, high = median_with_interval(array)
    return f"median {value:.3g} {unit} ({low:.3g}..{high:.3g})"


def _sigma(sure: list[Outcome]) -> str:
    return f"{np.median([one.sigma_m for one in sure]):.3g} m"


def growth(runs: int, seed: int, world: World) -> Iterator[str]:
    """Time over maps of growing area."""
    chart = block()
    south, west, _, _ = chart.bounds_deg
    yield f"{world.ground} tracks of {world.length_m / 1000:g} km, {runs} runs each; beyond the block: mirror images"
    for side in (0.5, 1.0, 1.5, 2.0, *(2.0 * times for times in MIRRORED)):
        if side <= 2.0:
            grown = chart.crop(south, west, south + side, west + side)
        else:
            grown = mirrored(chart, round(side / 2.0))
        part = [run(grown, world, seed + k) for k in range(runs)]
        seconds = np.array([one.cpu_s for one in part])  # of the thread: the machine may be shared
        per = 1e9 * np.median(seconds) / grown.values.size
        yield (
            f"  {grown.shape[0]:5} x {grown.shape[1]:5}  {_middle(seconds, 's')}, most {seconds.max():.2f} s; "
            f"{per:.0f} ns a cell; {np.median([one.share for one in part]):.2g} of exhaustive search"
        )


def flights() -> Iterator[str]:
    """Pieces of the helicopter survey's flights, with an INS drift added."""
    from terranav.io.tables import convert_table

    folder = DATA.parent / "wisconsin_helicopter"
    chart = tn.open_map(folder / "land_surface_100m.tif", kind="terrain", sigma=MAP_SIGMA_M)
    for file in sorted(folder.glob("flight_*.csv")):
        rec = tn.add_drift(convert_table(file, ROOT / "examples" / "wisconsin_helicopter.toml"), FLIGHT_INS, 3)
        for minutes, start_s in ((15, 600.0), (15, 4200.0), (30, 600.0), (30, 4200.0)):
            first_s = float(rec.time_s[0]) + start_s
            part = rec.between(first_s, first_s + 60.0 * minutes)
            rows = np.flatnonzero(np.isfinite(part.columns[part.readings[0]]))
            track = Track.of(part.epochs(), "terrain")
            found = locate(track, chart, LocateSettings(heading_deg=2.0, scale=0.02))
            best, last = found.candidates[0], int(rows[-1])
            lat, lon = (float(part.columns[key][last]) for key in ("true_lat_deg", "true_lon_deg"))
            error = math.hypot(*offset_of(lat, lon, best.lat_deg, best.lon_deg))
            yield (
                f"  {file.stem} from {start_s:g} s, {minutes} min: {found.verdict}; {track.height.size} readings, "
                f"spread {track.height.std():.1f} m; first {error:.0f} m off, "
                + (f"probability {best.probability:.3f}" if found.complete else "search stopped")
            )


@cache
def warmed() -> None:
    """Compile, so that no run is charged with it."""
    chart = tn.sample_map()
    along = np.arange(0.0, 6000.0, SPACING_M)
    track = Track(along, 0.3 * along, chart.sample(*shift(*chart.centre_deg, along, 0.3 * along)), SIGMA_M)
    locate(track, chart, LocateSettings(heading_deg=1.0, scale=0.01))


def main(arguments: list[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.locate", description=__doc__.splitlines()[0])
    parser.add_argument("--ground", choices=[*GROUNDS, "all"], default="rough")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=5000, help="of the first run; each of the others is one more")
    parser.add_argument("--heading", type=float, default=2.0, help="largest heading error [deg]; 180: unknown")
    parser.add_argument("--scale", type=float, default=0.0, help="largest error of lengths [%%]")
    parser.add_argument("--length", type=float, default=15.0, help="of a track [km]")
    parser.add_argument("--growth", action="store_true", help="time over maps of growing area instead")
    parser.add_argument("--flights", action="store_true", help="pieces of the helicopter survey instead")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write every run as JSON")
    given = parser.parse_args(arguments)
    if not DATA.is_dir():
        print("the SRTM tiles are not at hand: set TERRANAV_SHARED to their folder", file=sys.stderr)
        return 2
    warmed()
    world = World("rough", given.heading, given.scale / 100.0, 1000.0 * given.length)
    every: dict[str, list[Mapping[str, object]]] = {}
    if given.growth or given.flights:
        for line in flights() if given.flights else growth(given.runs, given.seed, world):
            print(line, flush=True)
        return 0
    chart = block()
    for ground in GROUNDS if given.ground == "all" else [given.ground]:
        here = replace(world, ground=ground)
        outcomes = [run(chart, here, given.seed + k) for k in range(given.runs)]
        print(*told(here, outcomes), sep="\n", flush=True)
        every[ground] = [asdict(one) for one in outcomes]
        if given.out is not None:
            given.out.write_text(json.dumps(every, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""A flight over 16 tiles in files, with a limit on the memory for the map, beside the same map in memory.

    python -m benchmarks.mosaic --side 10000 --hours 3

The track goes to and fro over all tiles. The map in memory is the whole square; both filters see the same readings,
and must end with the same estimates. Each flight is flown twice: as fast as it goes, thousands of times real time, when
reading and the filter share the processor; and at PACE times real time, when the thread that reads ahead has time, as
it has in a vehicle. Also printed: the share of the time of reading and decoding that no step waited for.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter_ns, sleep

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import Affine

import terranav as tn
from benchmarks.timing import Peer, Row
from terranav.core.earth import shift
from terranav.core.records import Epoch, Measurement
from terranav.experiment.registry import make_estimator
from terranav.experiment.stream import states
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map
from terranav.maps.mosaic import Mosaic

FloatArray = NDArray[np.float64]

TILES, CELL_DEG, WEST, NORTH = 4, 1e-4, 10.0, 46.0  # tiles along a side; cells of about 11 m by 8 m
INS = tn.InsGrade(200.0, 0.02, 0.05)
SIGMA_M, MEMORY_MB = 3.0, 256.0
PERIOD = 2000  # cells: the land repeats itself
METHODS = ("marginalized", "pointmass")
PACE = 300.0  # times real time


def tiles(folder: Path, side: int, layout: str) -> None:
    """Write 16 GeoTIFFs of side x side cells of two bytes that meet at their edges."""
    rng = np.random.default_rng(6)
    land = gaussian_map(rng, std=120.0, correlation_m=900.0, cells=PERIOD, cell_m=10.0).values
    times = -(-side // PERIOD)
    whole = np.tile(np.rint(land).astype(np.int16), (times, times))[:side, :side]
    stored = {"tiled": True, "blockxsize": 512, "blockysize": 512, "compress": "deflate", "predictor": 2}
    profile = {"driver": "GTiff", "dtype": "int16", "crs": "EPSG:4326", "count": 1, "height": side, "width": side}
    for row in range(TILES):
        for col in range(TILES):
            west, north = WEST + col * side * CELL_DEG, NORTH - row * side * CELL_DEG
            at = {"transform": Affine(CELL_DEG, 0.0, west, 0.0, -CELL_DEG, north), "nodata": -32768}
            name = f"{layout}_{row}{col}.tif"
            with rasterio.open(folder / name, "w", **profile, **at, **(stored if layout == "deflate" else {})) as file:
                file.write(whole, 1)


def track(side: int, count: int) -> tuple[FloatArray, FloatArray]:
    """Latitude and longitude of `count` places, evenly along a way to and fro over all tiles."""
    edge, lanes = 0.06 * side * CELL_DEG, np.arange(TILES)
    middle = NORTH - (lanes + 0.5) * side * CELL_DEG
    ends = np.array([WEST + edge, WEST + TILES * side * CELL_DEG - edge])
    lat = np.repeat(middle, 2)
    lon = np.concatenate([ends[:: 1 if lane % 2 == 0 else -1] for lane in lanes])
    far = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(lat), np.diff(lon) * np.cos(np.radians(NORTH))))])
    at = np.linspace(0.0, far[-1], count)
    return np.interp(at, far, lat), np.interp(at, far, lon)


def flight(chart: Map, side: int, count: int) -> tuple[Epoch, ...]:
    """One reading a second along the track, by an INS whose error grows to hundreds of metres."""
    rng = np.random.default_rng(7)
    lat, lon = track(side, count)
    error = rng.normal(0.0, 150.0, 2) + np.cumsum(rng.normal(0.0, 0.3, (count, 2)), axis=0)
    value = chart.sample(lat, lon) + rng.normal(0.0, SIGMA_M, count)
    said_lat, said_lon = shift(lat, lon, error[:, 0], error[:, 1])
    return tuple(
        Epoch(float(t), float(a), float(o), 3000.0, measurements=(Measurement("terrain", float(v), SIGMA_M),))
        for t, (a, o, v) in enumerate(zip(said_lat, said_lon, value, strict=True))
    )


def timed(method: str, chart: Map, epochs: tuple[Epoch, ...], pace: float = 0.0) -> tuple[float, FloatArray]:
    """Nanoseconds a step and the estimates (n, 2) [m], flown at `pace` times real time; 0 is as fast as it goes."""
    filter_ = make_estimator(method, [chart], INS)
    found = np.empty((len(epochs), 2))
    flown = states(filter_, tn.Prior.from_ins(INS), epochs, np.random.default_rng(1))
    spent, begin = 0, perf_counter_ns()
    for k, epoch in enumerate(epochs):
        if pace > 0.0:
            sleep(max(begin + 1e9 * epoch.time_s / pace - perf_counter_ns(), 0.0) * 1e-9)
        start = perf_counter_ns()
        found[k] = filter_.estimate(next(flown)).ins_error_m
        spent += perf_counter_ns() - start
    return spent / len(epochs), found


def measured(side: int, count: int, layouts: tuple[str, ...], flights: int = 2) -> Iterator[Row]:
    """Rows for each way of storing the tiles, estimator and pace."""
    warnings.simplefilter("ignore")
    for layout in layouts:
        with tempfile.TemporaryDirectory() as name:
            tiles(Path(name), side, layout)
            memory = whole_of(name)
            epochs = flight(memory, side, count)
            for method in METHODS:
                timed(method, memory, epochs[:50])
                for pace in (0.0, PACE):
                    yield compared(method, (memory, name), epochs, pace, flights)


def compared(method: str, maps: tuple[Map, str], epochs: tuple[Epoch, ...], pace: float, flights: int) -> Row:
    """A row: tiles in their files beside the map in memory, the best of some flights in turn."""
    (memory, folder), inside, outside, shares = maps, [], [], []
    for _ in range(flights):
        spent, expected = timed(method, memory, epochs, pace)
        inside.append(spent)
        chart = mosaic_of(folder)
        spent, found = timed(method, chart, epochs, pace)
        outside.append(spent)
        if not np.abs(found - expected).max() < 0.1:
            raise AssertionError(f"{method}: a mosaic gives other estimates than the map in memory")
        read, waited = chart.reading_s
        shares.append(1.0 - waited / read)
    how = f"{pace:.0f} times real time" if pace else "as fast as it goes"
    size = f"{chart.tile_count} tiles, {chart.shape[0]}^2 cells in all, {chart.held_bytes / 2**20:.0f} MiB held"
    work = f"{method}, {how}: {size}; {read:.1f} s of reading, {100.0 * max(shares):.0f} % hidden"
    return Row(work, "step", min(outside), (Peer("the map in memory", min(inside), 1.0 / 1.1),))


def mosaic_of(folder: str) -> Mosaic:
    """The tiles in their files."""
    chart = tn.open_map(folder, memory_mb=MEMORY_MB)
    assert isinstance(chart, Mosaic)
    return chart


def whole_of(folder: str) -> Map:
    """All tiles as one map in memory."""
    chart = mosaic_of(folder)
    south, west, north, east = chart.bounds_deg
    return chart.crop(south, west, north, east)


def rows() -> Iterator[Row]:
    """A small one for the table of all benchmarks."""
    yield from measured(2000, 1800, ("deflate",), 1)


def main() -> None:
    """Fly and print."""
    from benchmarks.table import lines

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=int, default=10_000)
    parser.add_argument("--hours", type=float, default=3.0)
    given = parser.parse_args()
    for row in measured(given.side, int(3600 * given.hours), ("deflate", "plain")):
        print(*lines(row), sep="\n", flush=True)


if __name__ == "__main__":
    main()

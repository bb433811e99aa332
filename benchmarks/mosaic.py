"""A flight over 16 tiles in files, with a limit on the memory for the map, beside the same map in memory.

    python -m benchmarks.mosaic --side 10000 --hours 3

The track goes to and fro over all tiles. The map in memory is the whole square; both filters see the same readings,
and must end with the same estimates. Also printed: the share of the time of reading and decoding that was hidden, since
it was spent ahead in another thread.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter_ns

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


def timed(method: str, chart: Map, epochs: tuple[Epoch, ...]) -> tuple[float, FloatArray]:
    """Nanoseconds a step, and the estimates (n, 2) [m]."""
    filter_ = make_estimator(method, [chart], INS)
    found = np.empty((len(epochs), 2))
    prior = tn.Prior.from_ins(INS)
    start = perf_counter_ns()
    for k, state in enumerate(states(filter_, prior, epochs, np.random.default_rng(1))):
        found[k] = filter_.estimate(state).ins_error_m
    return (perf_counter_ns() - start) / len(epochs), found


def measured(side: int, count: int, layouts: tuple[str, ...]) -> Iterator[Row]:
    """A row for each way of storing the tiles and each estimator."""
    warnings.simplefilter("ignore")
    for layout in layouts:
        with tempfile.TemporaryDirectory() as name:
            tiles(Path(name), side, layout)
            memory = whole_of(name)
            epochs = flight(memory, side, count)
            for method in METHODS:
                timed(method, memory, epochs[:50])
                best = {"memory": np.inf, "files": np.inf}
                chart = mosaic_of(name)
                for _ in range(2):
                    inside, expected = timed(method, memory, epochs)
                    chart = mosaic_of(name)
                    outside, found = timed(method, chart, epochs)
                    best = {"memory": min(best["memory"], inside), "files": min(best["files"], outside)}
                    if not np.abs(found - expected).max() < 0.1:
                        raise AssertionError(f"{method}: a mosaic gives other estimates than the map in memory")
                read, waited = chart.reading_s
                hidden = 100.0 * (1.0 - waited / read)
                size = f"16 tiles of {side}^2, {layout}, {chart.held_bytes / 2**20:.0f} MiB held"
                work = f"{method}: {size}; {read:.1f} s of reading, {hidden:.0f} % hidden"
                yield Row(work, "step", best["files"], (Peer("the map in memory", best["memory"], 1.0 / 1.1),))


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
    yield from measured(2000, 1800, ("deflate",))


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

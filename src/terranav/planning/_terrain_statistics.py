"""Blocks of a map, and what the ground around each is like: statistics of the heights alone, no leg is flown."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import metres_per_degree
from terranav.core.errors import ConfigError, DataError
from terranav.kernels.suitability import entropies, likeness
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
Ground = tuple[Float32Array, Float32Array, Float32Array, Float32Array, Float32Array]

MOST_BLOCKS = 4_000_000
PATCH_BLOCKS = 3  # half the side of the patch that statistics are taken over
MOST_REACH = 6  # places looked at on either side for one that is alike


@dataclass(frozen=True)
class BlockGrid:
    """Blocks over a map: square in metres at the middle latitude, rows from north to south.

    Attributes
    ----------
    shape : (rows, cols)
    north_deg, west_deg : float [deg]
        Middle of the first block.
    step_deg : (float, float) [deg]
        South and east from one block to the next.
    side_m : float [m]
    block : int
        Cells of the map along a side.
    """

    shape: tuple[int, int]
    north_deg: float
    west_deg: float
    step_deg: tuple[float, float]
    side_m: float
    block: int

    @classmethod
    def over(cls, chart: Map, block: int) -> BlockGrid:
        """As many whole blocks of so many cells a side as the map holds; DataError, ConfigError as of `suitability`."""
        south, west, north, east = chart.bounds_deg
        per_deg = [float(value) for value in metres_per_degree(0.5 * (south + north))]
        side = block * chart.cell_m
        step = side / per_deg[0], side / per_deg[1]
        rows, cols = int((north - south) / step[0] + 1e-9), int((east - west) / step[1] + 1e-9)
        if min(rows, cols) < 2:
            raise DataError(
                f"{chart.name}: {chart.shape[0]} x {chart.shape[1]} cells hold {rows} x {cols} blocks "
                f"of {block} cells, expected at least 2 x 2"
            )
        if rows * cols > MOST_BLOCKS:
            raise ConfigError(
                f"suitability block is {block}, which makes {rows} x {cols} blocks of {chart.name}, "
                f"expected at most {MOST_BLOCKS}"
            )
        first = north - 0.5 * (north - south - (rows - 1) * step[0]), west + 0.5 * (east - west - (cols - 1) * step[1])
        return cls((rows, cols), *first, step, side, block)

    def lat_deg(self, row: FloatArray | NDArray[np.intp]) -> FloatArray:
        """Latitude of fractional rows [deg]."""
        return np.asarray(self.north_deg - row * self.step_deg[0], dtype=np.float64)

    def lon_deg(self, col: FloatArray | NDArray[np.intp]) -> FloatArray:
        """Longitude of fractional columns [deg]."""
        return np.asarray(self.west_deg + col * self.step_deg[1], dtype=np.float64)


def statistics(chart: Map, grid: BlockGrid, sensor_sigma: float, position_sigma_m: float) -> Ground:
    """What the ground is like around each block; NaN with a void among its cells.

    Parameters
    ----------
    chart : Map
    grid : BlockGrid
        Over this map.
    sensor_sigma : float [unit]
    position_sigma_m : float [m]
        Of the prior: so far another place that looks the same is looked for, twice.

    Returns
    -------
    five (rows, cols) float32
        Roughness, spread, correlation length, entropy, self-similarity, as in
        `terranav.planning.suitability.Suitability`.
    """
    block, (rows, cols) = grid.block, grid.shape
    fine = [(np.arange(size * block) + 0.5) / block - 0.5 for size in grid.shape]
    values = np.concatenate(
        [chart.sample(grid.lat_deg(part)[:, None], grid.lon_deg(fine[1])[None, :]) for part in _parts(fine[0])]
    )
    spacing = grid.side_m / block
    down, right = np.gradient(values, spacing)
    half = PATCH_BLOCKS * block
    slope2, mean = _around(down**2 + right**2, block, half), _around(values, block, half)
    base = float(np.nanmean(values)) if np.isfinite(values).any() else 0.0
    spread2 = np.maximum(_around((values - base) ** 2, block, half) - (mean - base) ** 2, 0.0)
    roughness, spread = np.sqrt(np.maximum(slope2, 0.0)), np.sqrt(spread2)  # rounding of the running sums
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.where(roughness > 0.0, 2.0 * spread / roughness, np.nan)
    entropy, alike = np.empty(grid.shape), np.empty(grid.shape)
    entropies(values, block, half, math.hypot(sensor_sigma, chart.sigma), entropy)
    coarse = values.reshape(rows, block, cols, block).mean(axis=(1, 3))
    reach = int(np.clip(round(2.0 * position_sigma_m / grid.side_m), 2, MOST_REACH))
    likeness(coarse, PATCH_BLOCKS, 1, reach, alike)
    return _single(roughness), _single(spread), _single(length), _single(entropy), _single(alike)


def _single(values: FloatArray) -> Float32Array:
    """As float32."""
    return np.asarray(values, dtype=np.float32)


def _parts(rows: FloatArray) -> list[FloatArray]:
    """Rows in pieces, so that a large map needs no more than a few arrays of its own size."""
    return np.array_split(rows, max(1, rows.size // 256))


def _around(values: FloatArray, block: int, half: int) -> FloatArray:
    """Mean over the cells within `half` of the middle of each block, by running sums; NaN with a void among them."""
    void = np.isnan(values)
    sums = [np.pad(np.where(void, 0.0, values), ((1, 0), (1, 0))), np.pad(void.astype(np.float64), ((1, 0), (1, 0)))]
    total, voids = (part.cumsum(axis=0).cumsum(axis=1) for part in sums)
    ends = []
    for size in values.shape:
        middle = np.arange(size // block) * block + block // 2
        ends.append((np.maximum(middle - half, 0), np.minimum(middle + half, size)))
    (top, bottom), (left, right) = ends

    def boxed(part: FloatArray) -> FloatArray:
        rows = part[bottom] - part[top]
        return np.asarray(rows[:, right] - rows[:, left])

    area = np.outer(bottom - top, right - left)
    return np.where(boxed(voids) > 0.5, np.nan, boxed(total) / area)

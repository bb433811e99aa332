"""Bilinear and bicubic sampling of a cloud of 1e6 points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from benchmarks.limits import byte_ns, fetch_ns
from benchmarks.timing import Limit, Peer, Row, least_ns
from terranav.kernels.sampling import bicubic, bilinear

FloatArray = NDArray[np.float64]

SIDE, SPREAD, COUNT = 1201, 30.0, 1_000_000
STREAMED = 24  # bytes of each point's row, column and value


def rows() -> list[Row]:
    rng = np.random.default_rng(1)
    values = rng.normal(500.0, 100.0, (SIDE, SIDE)).astype(np.float32)
    row, col = rng.normal(SIDE / 2, SPREAD, (2, COUNT))
    ours, theirs = np.empty(COUNT), np.empty(COUNT)
    bilinear(values, row, col, ours)
    map_coordinates(values, [row, col], order=1, output=theirs)
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    bicubic(values, row, col, ours)
    np.testing.assert_allclose(ours[:10_000], _catmull_rom(values, row[:10_000], col[:10_000]), rtol=1e-9, atol=1e-9)
    least = least_ns(
        {
            "bilinear": lambda: bilinear(values, row, col, ours),
            "order 1": lambda: map_coordinates(values, [row, col], order=1, output=theirs),
            "bicubic": lambda: bicubic(values, row, col, ours),
            "order 3": lambda: map_coordinates(values, [row, col], order=3, output=theirs, prefilter=False),
        },
        COUNT,
        repeats=12,
    )
    return [
        _row("bilinear sample, 1e6 points", least["bilinear"], "map_coordinates", least["order 1"], 4),
        _row("bicubic sample, 1e6 points", least["bicubic"], "map_coordinates, B-spline", least["order 3"], 16),
    ]


def _row(work: str, ours: float, name: str, theirs: float, fetches: int) -> Row:
    limit = fetches * fetch_ns(SIDE, SPREAD) + STREAMED * byte_ns(STREAMED * COUNT)
    return Row(work, "point", ours, (Peer(f"scipy {name}", theirs, 6.0),), Limit(f"{fetches} fetches", limit, 1.3))


def _catmull_rom(values: NDArray[np.float32], row: FloatArray, col: FloatArray) -> FloatArray:
    """Keys 1981, eq. 4 with a = -1/2, as a function of the distance to each of the 16 cells."""
    total = np.zeros(row.size)
    for i in range(-1, 3):
        for j in range(-1, 3):
            y, x = np.floor(row) + i, np.floor(col) + j
            total += _kernel(np.abs(row - y)) * _kernel(np.abs(col - x)) * values[y.astype(int), x.astype(int)]
    return total


def _kernel(s: FloatArray) -> FloatArray:
    return np.asarray(np.where(s < 1.0, 1.5 * s**3 - 2.5 * s**2 + 1.0, -0.5 * s**3 + 2.5 * s**2 - 4.0 * s + 2.0))

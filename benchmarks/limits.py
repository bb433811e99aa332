"""What the machine can do at most, measured where the benchmarks run: bytes moved, sums done, map values fetched."""

from __future__ import annotations

from functools import cache

import numpy as np

from benchmarks.timing import least_ns
from terranav.kernels.jit import jit

LANES = 64  # sums side by side, so that each need not wait for the one before


@jit
def _triad(a, b, c, times):  # type: ignore[no-untyped-def]
    for _ in range(times):
        for i in range(a.size):
            a[i] = b[i] + 0.5 * c[i]


@jit
def _multiply_add(lanes, times):  # type: ignore[no-untyped-def]
    own = np.zeros(LANES)
    own[:] = lanes
    for _ in range(times):
        for i in range(LANES):
            own[i] = own[i] * 0.999 + 0.001
    lanes[:] = own


@jit
def _gather(flat, at, out):  # type: ignore[no-untyped-def]
    for i in range(at.size):
        out[i] = flat[at[i]]


@cache
def byte_ns(working_set: int) -> float:
    """Time to read or write one byte in passes over arrays of `working_set` bytes together [ns]."""
    n = max(working_set // 24, 512)
    arrays = [np.ones(n) for _ in range(3)]
    times = max(200_000 // n, 1)
    return least_ns({"": lambda: _triad(*arrays, times)}, 24 * n * times, repeats=25)[""]


@cache
def multiply_add_ns() -> float:
    """Time of one float64 multiply-add (two operations) in registers, many side by side [ns]."""
    lanes, times = np.ones(LANES), 20_000
    return least_ns({"": lambda: _multiply_add(lanes, times)}, LANES * times, repeats=25)[""]


@cache
def fetch_ns(side: int, spread: float) -> float:
    """Time to fetch one float32 of a side x side map at normally scattered places, 1-sigma `spread` cells [ns]."""
    rng, n = np.random.default_rng(0), 1_000_000
    row, col = np.clip(rng.normal(side / 2, spread, (2, n)), 0, side - 1).astype(np.int64)
    at, flat, out = (row * side + col).astype(np.uint64), np.ones(side * side, np.float32), np.empty(n, np.float32)
    return least_ns({"": lambda: _gather(flat, at, out)}, n, repeats=9)[""]

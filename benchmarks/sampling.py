"""Bilinear and bicubic sampling of a cloud of 1e6 points."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from benchmarks.timing import Peer, Row, least_ns
from terranav.kernels.sampling import bicubic, bilinear


def rows() -> list[Row]:
    rng = np.random.default_rng(1)
    values = rng.normal(500.0, 100.0, (1201, 1201)).astype(np.float32)
    n = 1_000_000
    row, col = rng.normal(600.0, 30.0, n), rng.normal(600.0, 30.0, n)
    ours, cubic = np.empty(n), np.empty(n)
    peer = np.asarray(map_coordinates(values, [row, col], order=1, output=np.float64))
    bilinear(values, row, col, ours)
    if np.abs(ours - peer).max() > 1e-3:
        raise AssertionError("bilinear disagrees with scipy.ndimage.map_coordinates")
    linear = least_ns(
        {
            "ours": lambda: bilinear(values, row, col, ours),
            "peer": lambda: map_coordinates(values, [row, col], order=1, output=np.float64),
        },
        n,
    )
    smooth = least_ns(
        {
            "ours": lambda: bicubic(values, row, col, cubic),
            "peer": lambda: map_coordinates(values, [row, col], order=3, output=np.float64, prefilter=False),
        },
        n,
        repeats=5,
    )
    return [
        Row(
            "bilinear sample, 1e6 points",
            "point",
            linear["ours"],
            (Peer("scipy map_coordinates", linear["peer"], 1.0),),
        ),
        Row(
            "bicubic sample, 1e6 points", "point", smooth["ours"], (Peer("scipy map_coordinates", smooth["peer"], 1.2),)
        ),
    ]

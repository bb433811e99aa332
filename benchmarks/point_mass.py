"""One step of a point-mass filter on 201 x 201 cells: diffuse, sample, weigh, normalise, moments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, map_coordinates

from benchmarks.timing import Peer, Row, least_ns
from terranav.filters.pointmass import gaussian_taps
from terranav.kernels.grid import diffuse, measure, weigh
from terranav.kernels.lattice import bilinear_lattice
from terranav.maps.sample_dem import sample_map

FloatArray = NDArray[np.float64]


def rows() -> list[Row]:
    chart = sample_map()
    lat, lon = chart.centre_deg
    size, cell, sigma = 201, 40.0, 5.0
    axis = cell * (np.arange(size, dtype=np.float64) - size // 2)
    density = np.exp(-0.5 * (axis[:, None] ** 2 + axis[None, :] ** 2) / 1200.0**2)
    density /= density.sum()
    taps = gaussian_taps(1.5)
    frame = chart.local_frame(lat, lon, 6000.0)
    value = float(chart.sample(lat, lon)) + 3.0
    field, wide, out = np.empty_like(density), np.empty_like(density), np.empty_like(density)

    def ours() -> FloatArray:
        diffuse(density, taps, taps, wide)
        bilinear_lattice(chart.values, frame.row, frame.col, -axis, -axis, field)
        weigh(wide, field, value, sigma, 0.0, 0.0, 10.0, out)
        moments: FloatArray = measure(out, axis, axis)[0]
        return moments

    def peer() -> FloatArray:
        spread = convolve1d(convolve1d(density, taps, axis=0, mode="constant"), taps, axis=1, mode="constant")
        row, col = frame.cells(-axis[:, None], -axis[None, :])
        height = map_coordinates(chart.values, [row, col], order=1, output=np.float64)
        post = spread * np.exp(-0.5 * ((height - value) / sigma) ** 2)
        post /= post.sum()
        north, east = (post.sum(axis=1) @ axis), (post.sum(axis=0) @ axis)
        nn, ee = post.sum(axis=1) @ axis**2 - north**2, post.sum(axis=0) @ axis**2 - east**2
        return np.array([north, east, nn, axis @ post @ axis - north * east, ee])

    np.testing.assert_allclose(ours(), peer(), rtol=1e-5, atol=1e-3)
    least = least_ns({"ours": ours, "peer": peer}, size * size, repeats=15)
    return [Row("point-mass step, 201 x 201", "cell", least["ours"], (Peer("scipy/numpy", least["peer"], 1.0),))]

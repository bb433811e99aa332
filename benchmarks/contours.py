"""The nearest points of twenty contours to the places of twenty readings."""

from __future__ import annotations

import contourpy
import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import Peer, Row, least_ns
from terranav.kernels.contours import nearest_points
from terranav.maps.sample_dem import sample_map

FloatArray = NDArray[np.float64]
POINTS, REACH_M, NOISE_M = 20, 2000.0, 10.0


def rows() -> list[Row]:
    chart, rng = sample_map(), np.random.default_rng(0)
    frame = chart.local_frame(*chart.centre_deg, 5000.0)
    metric = np.linalg.inv(np.array([frame.row[1:3], frame.col[1:3]]))
    row, col = rng.uniform(60.0, chart.shape[0] - 60.0, POINTS), rng.uniform(60.0, chart.shape[1] - 60.0, POINTS)
    here = chart.values[np.rint(row).astype(int), np.rint(col).astype(int)]
    level = here + rng.normal(0.0, NOISE_M, POINTS)
    out = np.empty((POINTS, 3))

    def ours() -> FloatArray:
        nearest_points(chart.values, row, col, level, metric, REACH_M, out)
        return out[:, 0]

    def peer() -> FloatArray:
        places = zip(row, col, level, strict=True)
        return np.array([_by_contourpy(chart.values, *place, metric) for place in places])

    np.testing.assert_allclose(ours(), peer(), rtol=0.0, atol=1e-9)
    least = least_ns({"ours": ours, "peer": peer}, POINTS, repeats=25)
    name = "contourpy's lines of the window, distance to every segment"
    return [Row("nearest contour points, 20", "point", least["ours"], (Peer(name, least["peer"], 100.0),))]


def _by_contourpy(values: NDArray[np.float32], row: float, col: float, level: float, metric: FloatArray) -> float:
    """Distance to the nearest of all the lines in a window that reaches as far; NaN where there is none."""
    reach = REACH_M / np.linalg.svd(metric, compute_uv=False)[-1]
    top, left = max(int(row - reach), 0), max(int(col - reach), 0)
    window = values[top : int(row + reach) + 2, left : int(col + reach) + 2].astype(np.float64)
    lines = contourpy.contour_generator(z=window, name="serial").lines(level)
    best = np.inf
    for line in lines:
        points = (np.asarray(line)[:, ::-1] - [row - top, col - left]) @ metric.T
        a, b = points[:-1], np.diff(points, axis=0)
        t = np.clip(-np.sum(a * b, axis=1) / np.maximum(np.sum(b * b, axis=1), 1e-300), 0.0, 1.0)
        best = min(best, float(np.hypot(*(a + t[:, None] * b).T).min()))
    return best if best <= REACH_M else np.nan

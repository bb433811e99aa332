from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, RegularGridInterpolator

from terranav.kernels import sampling

KERNELS = {"bilinear": sampling.bilinear, "bicubic": sampling.bicubic}
ROWS, COLS = 9, 12
HEIGHTS = np.random.default_rng(5).normal(size=(ROWS, COLS)).astype(np.float32)
whole = st.integers(-1000, 1000)  # so that single precision holds the plane exactly


def at(method: str, values: NDArray[np.float32], row: object, col: object) -> NDArray[np.float64]:
    rows, cols = np.broadcast_arrays(np.asarray(row, dtype=float), np.asarray(col, dtype=float))
    out = np.empty(rows.size)
    KERNELS[method](values, rows.ravel(), cols.ravel(), out)
    return out.reshape(rows.shape)


def scattered(n: int = 500) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(8)
    return rng.uniform(0, ROWS - 1, n), rng.uniform(0, COLS - 1, n)


@pytest.mark.parametrize("method", KERNELS)
@given(plane_of=st.tuples(whole, whole, whole), shape=st.tuples(st.integers(2, 6), st.integers(2, 6)))
def test_planes_are_exact_up_to_the_edge(method: str, plane_of: tuple[int, int, int], shape: tuple[int, int]) -> None:
    (c, a, b), (rows, cols) = plane_of, shape
    i, j = np.mgrid[:rows, :cols]
    plane = (c + a * i + b * j).astype(np.float32)
    row, col = np.linspace(0, rows - 1, 13)[:, None], np.linspace(0, cols - 1, 11)
    exact = c + a * row + b * col
    np.testing.assert_allclose(at(method, plane, row, col), exact, atol=1e-10)


@pytest.mark.parametrize("method", KERNELS)
def test_cell_centres_keep_their_values(method: str) -> None:
    i, j = np.mgrid[:ROWS, :COLS]
    np.testing.assert_array_equal(at(method, HEIGHTS, i, j), HEIGHTS)


def test_bilinear_agrees_with_scipy() -> None:
    row, col = scattered()
    other = RegularGridInterpolator((np.arange(ROWS), np.arange(COLS)), HEIGHTS.astype(float))
    np.testing.assert_allclose(at("bilinear", HEIGHTS, row, col), other(np.stack([row, col], axis=1)), atol=1e-12)


def test_bicubic_agrees_with_hermite_splines_of_central_slopes() -> None:
    def spline(values: NDArray[np.float64], position: float) -> NDArray[np.float64]:
        slopes = np.gradient(values, axis=0)  # one-sided at the ends: the straight continuation
        curve = CubicHermiteSpline(np.arange(len(values)), values, slopes, axis=0)
        return np.asarray(curve(position))

    row, col = scattered(60)
    expected = [float(spline(spline(HEIGHTS.astype(float), r), c)) for r, c in zip(row, col)]
    np.testing.assert_allclose(at("bicubic", HEIGHTS, row, col), expected, atol=1e-12)


@pytest.mark.parametrize("method", KERNELS)
def test_mirrored_maps_give_mirrored_samples(method: str) -> None:
    row, col = scattered()
    straight = at(method, HEIGHTS, row, col)
    mirrors = {
        "rows": at(method, np.ascontiguousarray(HEIGHTS[::-1]), ROWS - 1 - row, col),
        "columns": at(method, np.ascontiguousarray(HEIGHTS[:, ::-1]), row, COLS - 1 - col),
        "transposed": at(method, np.ascontiguousarray(HEIGHTS.T), col, row),
    }
    for mirrored in mirrors.values():
        np.testing.assert_allclose(mirrored, straight, atol=1e-12)


@pytest.mark.parametrize("method", KERNELS)
def test_the_domain_is_the_hull_of_the_centres(method: str) -> None:
    slack = 0.9e-6
    inside = at(method, HEIGHTS, [-slack, ROWS - 1 + slack, 2, 2], [3, 3, -slack, COLS - 1 + slack])
    np.testing.assert_array_equal(inside, HEIGHTS[[0, ROWS - 1, 2, 2], [3, 3, 0, COLS - 1]])
    over = 1e-5
    nowhere = [(-over, 3), (ROWS - 1 + over, 3), (2, -over), (2, COLS - 1 + over), (np.nan, 3), (2, np.inf), (-1e30, 3)]
    assert np.isnan(at(method, HEIGHTS, *np.array(nowhere).T)).all()


@pytest.mark.parametrize("method", KERNELS)
def test_voids_poison_only_where_they_weigh(method: str) -> None:
    values = HEIGHTS.copy()
    values[4, 5] = np.nan
    beside = [(4, 4), (4, 6), (3, 5), (5, 5), (3, 4), (5, 6)]  # exactly on its neighbours
    for row, col in beside:
        for nudge in (0.0, 1e-9, -1e-9):
            assert at(method, values, row + nudge, col + nudge) == pytest.approx(HEIGHTS[row, col], abs=1e-6)
    along = at(method, values, [3.0, 3.5, 3.0], [4.5, 4.0, 5.5])  # on the lines between neighbours
    np.testing.assert_allclose(along, at(method, HEIGHTS, [3.0, 3.5, 3.0], [4.5, 4.0, 5.5]), atol=1e-12)
    assert np.isnan(at(method, values, [4.0, 3.5, 4.4, 4.0], [5.0, 4.5, 5.4, 5.3])).all()


@pytest.mark.parametrize("shape", [(2, 2), (2, 9), (3, 3), (4, 4), (5, 4), (61, 47)])
@pytest.mark.parametrize("method", KERNELS)
def test_a_long_cloud_is_its_points(method: str, shape: tuple[int, int]) -> None:
    """Off the map, beside voids, on the cells, on the last row and column, not numbers: over several blocks."""
    rng = np.random.default_rng(9)
    values = rng.normal(300.0, 100.0, shape).astype(np.float32)
    values[rng.random(shape) < 0.02] = np.nan
    row, col = (rng.uniform(-0.6, size - 0.4, 3 * sampling.BLOCK + 7) for size in shape)
    row[::5], col[::7] = np.round(row[::5]), np.round(col[::7])
    row[3::50], col[3::60] = shape[0] - 1.0, shape[1] - 1.0
    row[::97], col[::89] = np.nan, np.inf
    one = {"bilinear": sampling.bilinear_at, "bicubic": sampling.bicubic_at}[method]
    expected = np.array([one(values, r, c) for r, c in zip(row, col)])
    assert 0 < np.isnan(expected).sum() < row.size
    np.testing.assert_allclose(at(method, values, row, col), expected, rtol=1e-12, atol=1e-9)
    assert at(method, values, [], []).size == 0


SCRIPT = """
import numpy as np
from terranav.kernels import lattice, sampling
rng = np.random.default_rng(4)
values = rng.normal(size=(20, 30)).astype(np.float32)
values[7, 9] = np.nan
row, col, out = rng.uniform(-1, 20, 300), rng.uniform(-1, 30, 300), np.empty(300)
for kernel in (sampling.bilinear, sampling.bicubic):
    kernel(values, row, col, out)
    print(*out.round(9) + 0.0)
grid, axis = np.empty((9, 9)), np.linspace(-9.0, 9.0, 9)
frame = np.array([9.0, -1.0, 0.1, 1e-3, 0.0, 0.0]), np.array([14.0, 0.1, 1.0, 0.0, 1e-3, 0.0])
lattice.bilinear_lattice(values, *frame, axis, axis, grid)
print(*grid.ravel().round(9) + 0.0)
"""


def test_kernels_say_the_same_without_compilation() -> None:
    said = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env={**os.environ, "NUMBA_DISABLE_JIT": off},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for off in ("0", "1")
    ]
    assert "nan" in said[0]
    assert said[0] == said[1]

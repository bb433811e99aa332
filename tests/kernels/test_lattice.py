"""A lattice against its places one by one: on every kind of map that the kernel tells apart, over voids and edges."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.kernels import lattice
from terranav.kernels.lattice import bilinear_lattice, bilinear_row
from terranav.kernels.sampling import bilinear_at

FloatArray = NDArray[np.float64]
NORTH, EAST = np.arange(-1000.0, 1001.0, 50.0), np.arange(-1500.0, 1501.0, 50.0)


def coefficients(r: tuple[float, ...], c: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    return np.array(r), np.array(c)


IN_DEGREES = coefficients((40.0, -0.01, 0.0, 1e-9, 0.0, 0.0), (50.0, 0.0, 0.013, 0.0, 2e-8, 0.0))
OWN_CELLS = coefficients((40.3, -0.015, 0.0, 0.0, 0.0, 0.0), (50.4, 0.0, 0.02, 0.0, 0.0, 0.0))
FRAMES = {
    "in degrees": IN_DEGREES,
    "of the lattice's own columns": OWN_CELLS,
    "mirrored": coefficients((40.3, 0.015, 0.0, 1e-9, 0.0, 0.0), (50.4, 0.002, -0.02, 1e-8, 0.0, 0.0)),
    "on its very cells": coefficients((40.0, -0.02, 0.0, 0.0, 0.0, 0.0), (50.0, 0.0, 0.02, 0.0, 0.0, 0.0)),
    "with columns that bend": coefficients((40.0, -0.01, 0.0, 0.0, 0.0, 0.0), (50.0, 0.0, 0.013, 0.0, 0.0, 1e-6)),
    "with rows that turn south of it": coefficients(
        (40.0, -0.01, 0.0, 0.0, 1e-6, 0.0), (50.0, 0.0, 0.02, 0.0, 0.0, 0.0)
    ),
    "turned and bent": coefficients((40.0, -0.01, 0.004, 1e-8, -2e-8, 3e-7), (50.0, 0.003, 0.013, 5e-8, 2e-8, -3e-7)),
    "half off the map": coefficients((5.0, -0.01, 0.004, 1e-8, -2e-8, 3e-8), (90.0, 0.003, 0.013, 5e-8, 2e-8, -3e-8)),
    "half off its columns": coefficients((40.0, -0.01, 0.0, 0.0, 0.0, 0.0), (80.4, 0.0, 0.02, 0.0, 0.0, 0.0)),
    "off the map": coefficients((-500.0, -0.01, 0.0, 0.0, 0.0, 0.0), (50.0, 0.0, 0.013, 0.0, 0.0, 0.0)),
    "from the corner": coefficients((0.0, -0.01, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.02, 0.0, 0.0, 0.0)),
    "to the last column": coefficients((40.0, -0.01, 0.0, 0.0, 0.0, 0.0), (69.0, 0.0, 0.02, 0.0, 0.0, 0.0)),
}


def heights(rows: int = 80, cols: int = 100, voids: bool = False) -> NDArray[np.float32]:
    rng = np.random.default_rng(2)
    values = rng.normal(300.0, 100.0, (rows, cols)).astype(np.float32)
    if voids:
        values[35:45, 48:60] = np.nan
        values[rng.random(values.shape) < 0.003] = np.nan
    return values


def one_by_one(
    values: NDArray[np.float32], frame: tuple[FloatArray, FloatArray], north: FloatArray, east: FloatArray
) -> FloatArray:
    n, e = north[:, None], east[None]
    terms = np.stack(np.broadcast_arrays(1.0, n, e, n * n, n * e, e * e))
    row, col = (np.tensordot(one, terms, 1) for one in frame)
    return np.array([bilinear_at(values, r, c) for r, c in zip(row.ravel(), col.ravel())]).reshape(row.shape)


def in_one(
    values: NDArray[np.float32], frame: tuple[FloatArray, FloatArray], north: FloatArray, east: FloatArray
) -> FloatArray:
    out = np.full((north.size, east.size), -1e9)
    bilinear_lattice(values, *frame, north, east, out)
    return out


@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES)
@pytest.mark.parametrize("voids", [False, True])
@pytest.mark.parametrize("side", [1, -1])
def test_a_lattice_is_its_places(frame: tuple[FloatArray, FloatArray], voids: bool, side: int) -> None:
    values, north, east = heights(voids=voids), NORTH[::side].copy(), EAST[::side].copy()
    np.testing.assert_allclose(
        in_one(values, frame, north, east), one_by_one(values, frame, north, east), rtol=1e-11, atol=1e-9
    )


@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES)
@pytest.mark.parametrize("voids", [False, True])
def test_a_line_of_the_lattice_is_the_line_alone(frame: tuple[FloatArray, FloatArray], voids: bool) -> None:
    values = heights(voids=voids)
    out, line, blend = in_one(values, frame, NORTH, EAST), np.empty(EAST.size), np.empty(values.shape[1])
    for i, north in enumerate(NORTH):
        bilinear_row(values, *frame, north, EAST, blend, line)
        np.testing.assert_array_equal(line, out[i])


def test_where_it_is_well_within_the_map_it_is_plain_numpy() -> None:
    values = heights()
    for frame in (IN_DEGREES, OWN_CELLS, FRAMES["turned and bent"]):
        n, e = 0.5 * NORTH[:, None], EAST[None]
        row, col = (a + n * (b + d * n + f * e) + e * (c + g * e) for a, b, c, d, f, g in frame)
        i, j = np.floor(row).astype(int), np.floor(col).astype(int)
        u, v, h = row - i, col - j, values.astype(float)
        expected = (1 - u) * ((1 - v) * h[i, j] + v * h[i, j + 1]) + u * ((1 - v) * h[i + 1, j] + v * h[i + 1, j + 1])
        np.testing.assert_allclose(in_one(values, frame, 0.5 * NORTH, EAST), expected, rtol=1e-11)


@pytest.mark.parametrize("shape", [(2, 2), (2, 7), (3, 2), (5, 4)])
@pytest.mark.parametrize("size", [1, 2, 3, 5, 33])
@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_tiny_maps_and_lattices_of_any_size(shape: tuple[int, int], size: int, turn: float) -> None:
    values = heights(*shape)
    north, east = np.linspace(-0.4, 0.4, 3), np.linspace(-0.5, 0.5, size)
    middle = [0.5 * (n - 1) for n in shape]
    for slope in (1.0 - turn, -1.0, float(size)):
        frame = coefficients((middle[0], -1.0, turn, 0.0, 0.0, 0.0), (middle[1], turn, slope, 0.0, 0.0, 0.0))
        expected = one_by_one(values, frame, north, east)
        np.testing.assert_allclose(in_one(values, frame, north, east), expected, rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize("stray", [0.0, 1e-13, 3e-11, 1e-9, 1e-5])
def test_a_step_that_is_nearly_a_column_is_sampled_where_it_lies(stray: float) -> None:
    row, col = (one.copy() for one in OWN_CELLS)
    col[2] += stray / (EAST[-1] - EAST[0])
    values = heights()
    expected = one_by_one(values, (row, col), NORTH, EAST)
    np.testing.assert_allclose(in_one(values, (row, col), NORTH, EAST), expected, rtol=0.0, atol=1e-7)
    uneven = EAST.copy()
    uneven[7] += 20.0  # the ends are whole steps apart, but not all between
    expected = one_by_one(values, (row, col), NORTH, uneven)
    np.testing.assert_allclose(in_one(values, (row, col), NORTH, uneven), expected, rtol=0.0, atol=1e-7)


def test_the_own_columns_are_told_from_others() -> None:
    """Else the faster way would be dead, or taken where it is wrong, without a test that says so."""
    assert lattice.whole_steps(0.02, EAST, EAST.size) == 1
    assert lattice.whole_steps(-0.02, EAST, EAST.size) == -1
    assert lattice.whole_steps(0.02, -EAST, EAST.size) == -1
    assert lattice.whole_steps(0.02 * (1.0 + 1e-9), EAST, EAST.size) == 0
    assert lattice.whole_steps(0.013, EAST, EAST.size) == 0


def test_it_says_whether_all_values_are_known() -> None:
    out = np.empty((NORTH.size, EAST.size))
    for frame in (IN_DEGREES, OWN_CELLS, FRAMES["turned and bent"]):
        north = 0.5 * NORTH
        assert bilinear_lattice(heights(), *frame, north, EAST, out) == 0
        assert bilinear_lattice(heights(voids=True), *frame, north, EAST, out) > 0
        assert np.isnan(out).any()
    assert bilinear_lattice(heights(), *FRAMES["off the map"], NORTH, EAST, out) == out.size

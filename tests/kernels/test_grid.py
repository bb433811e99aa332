"""Convolution and resampling on a grid against scipy and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from terranav.filters.pointmass import gaussian_taps
from terranav.kernels.grid import FLOOR, diffuse, regrid, resample
from terranav.kernels.sampling import bicubic

FloatArray = NDArray[np.float64]


def convolved(density: FloatArray, north: FloatArray, east: FloatArray) -> FloatArray:
    once = ndimage.convolve1d(density, north, axis=0, mode="constant")
    return np.asarray(ndimage.convolve1d(once, east, axis=1, mode="constant"))


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (13, 17), (40, 33), (64, 70)])
@pytest.mark.parametrize("variances", [(0.0, 0.3), (0.3, 0.0), (0.3, 0.6), (2.0, 0.5), (0.6, 9.0), (70.0, 3.0)])
def test_diffusion_equals_a_plain_convolution(shape: tuple[int, int], variances: tuple[float, float]) -> None:
    density = np.random.default_rng(8).random(shape)
    before = density.copy()
    north, east = (gaussian_taps(variance) for variance in variances)
    out = np.empty_like(density)
    diffuse(density, north, east, out)
    np.testing.assert_allclose(out, convolved(density, north, east), rtol=1e-13)
    assert np.array_equal(density, before)


def test_diffusion_is_the_same_without_compilation() -> None:
    density = np.random.default_rng(9).random((13, 17))
    north, east = gaussian_taps(2.0), gaussian_taps(0.3)
    out, plain = np.empty_like(density), np.empty_like(density)
    diffuse(density, north, east, out)
    diffuse.py_func(density, north, east, plain)
    np.testing.assert_allclose(out, plain, rtol=1e-13)


def plain_resample(log_density: FloatArray, rows: FloatArray, cols: FloatArray) -> FloatArray:
    """exp of the bicubic patch, held below the largest of the four cells around by a factor of two; zero outside."""
    at_row, at_col = (axis.ravel() for axis in np.meshgrid(rows, cols, indexing="ij"))
    value = np.empty(at_row.size)
    bicubic(log_density, at_row, at_col, value)
    i = np.clip(at_row.astype(int), 0, log_density.shape[0] - 2)
    j = np.clip(at_col.astype(int), 0, log_density.shape[1] - 2)
    around = np.max([log_density[i + a, j + b] for a in (0, 1) for b in (0, 1)], axis=0)
    p = np.exp(np.minimum(value, around + 0.7))
    return np.where(np.isnan(value) | (p <= FLOOR), 0.0, p).reshape(rows.size, cols.size)


@pytest.mark.parametrize("shape", [(2, 2), (3, 7), (31, 24)])
@pytest.mark.parametrize("step", [0.37, 1.0, 2.3])
def test_resampling_equals_the_bicubic_patch_of_the_logarithm(shape: tuple[int, int], step: float) -> None:
    rng = np.random.default_rng(10)
    log_density = np.log(np.maximum(rng.random(shape) ** 20, FLOOR))
    log_density[rng.random(shape) < 0.1] = np.log(FLOOR)
    rows, cols = np.arange(-1.6, shape[0] + 1.0, step), np.arange(-1.9, shape[1] + 2.0, step)
    out = np.empty((rows.size, cols.size))
    resample(log_density, rows, cols, out)
    np.testing.assert_allclose(out, plain_resample(log_density, rows, cols), rtol=1e-11, atol=0.0)
    assert out.max() > 0.0


def test_resampling_on_the_same_cells_changes_nothing() -> None:
    density = np.random.default_rng(11).random((9, 12))
    out = np.empty_like(density)
    resample(np.log(density), np.arange(9.0), np.arange(12.0), out)
    np.testing.assert_allclose(out, density, rtol=1e-13)


def test_regridding_resamples_and_normalises() -> None:
    density = np.random.default_rng(12).random((23, 17)) ** 9
    density[3:5, 2:9] = 0.0
    rows, cols = np.linspace(-1.0, 23.0, 31), np.linspace(0.5, 15.5, 40)
    out = np.empty((31, 40))
    regrid(density, rows, cols, out)
    plain = plain_resample(np.log(np.maximum(density, FLOOR)), rows, cols)
    np.testing.assert_allclose(out, plain / plain.sum(), rtol=1e-11, atol=1e-299)
    regrid.py_func(density, rows, cols, out)
    np.testing.assert_allclose(out, plain / plain.sum(), rtol=1e-11, atol=1e-299)

"""The kernel of TERCOM's surface against plain numpy, on every kind of map, over voids and beyond the edge."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.kernels.sampling import bilinear_at
from terranav.kernels.tercom import correlation_surface, quadratics

FloatArray = NDArray[np.float64]
KINDS = {
    "in degrees": ((40.3, -0.0132, 0.0, 1e-8, 0.0, 0.0), (45.4, 0.0, 0.0183, 0.0, 2e-7, 0.0)),
    "own cells": ((40.3, -0.02, 0.0, 0.0, 0.0, 0.0), (45.4, 0.0, 0.02, 0.0, 0.0, 0.0)),
    "own columns, mirrored": ((40.3, 0.013, 0.0, 0.0, 0.0, 0.0), (45.4, 0.0, -0.02, 0.0, 0.0, 0.0)),
    "projected": ((40.3, -0.019, 0.002, 1e-8, -2e-8, 3e-8), (45.4, 0.002, 0.019, 5e-8, 2e-8, -3e-8)),
}
NORTH, EAST = np.arange(-900.0, 901.0, 50.0), np.arange(-1050.0, 1051.0, 50.0)  # 37 x 43


def profile(kind: str, n: int, shift: float = 0.0) -> FloatArray:
    """Frames of n points on a straight line."""
    frames = np.tile(np.array(KINDS[kind]), (n, 1, 1))
    frames[:, 0, 0] += 0.7 * np.arange(n) - 0.35 * n + shift
    frames[:, 1, 0] += 0.4 * np.arange(n) - 0.2 * n
    return frames


def expected(
    values: NDArray[np.float32], frames: FloatArray, readings: FloatArray, absolute: bool, remove_mean: bool
) -> tuple[FloatArray, FloatArray]:
    n, e = -NORTH[:, None], -EAST[None]
    terms = np.stack(np.broadcast_arrays(1.0, n, e, n * n, n * e, e * e))
    difference = np.empty((len(frames), NORTH.size, EAST.size))
    for k, frame in enumerate(frames):
        row, col = np.tensordot(frame, terms, 1)
        field = [bilinear_at(values, r, c) for r, c in zip(row.ravel(), col.ravel())]
        difference[k] = readings[k, 0] - np.reshape(field, row.shape)
    known = np.isfinite(difference)
    weight = readings[:, 1, None, None] * known
    with np.errstate(invalid="ignore"):
        if remove_mean:
            difference = difference - np.nansum(weight * difference, axis=0) / weight.sum(axis=0)
        cost = np.abs(difference) if absolute else difference**2
        return np.nansum(weight * cost, axis=0) / weight.sum(axis=0), known.mean(axis=0)


@pytest.mark.parametrize("remove_mean", [False, True])
@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("ground", ["whole", "voids", "edge", "off"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_surface_is_that_of_plain_numpy(kind: str, ground: str, absolute: bool, remove_mean: bool) -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(300.0, 100.0, (81, 90)).astype(np.float32)
    if ground == "voids":
        values[30:50, 40:44] = np.nan
        values[rng.random(values.shape) < 0.01] = np.nan
    frames = profile(kind, 9, {"edge": 28.0, "off": 400.0}.get(ground, 0.0))
    readings = np.stack([rng.normal(300.0, 100.0, 9), rng.uniform(0.2, 3.0, 9)], axis=1)
    score, valid = np.full((2, NORTH.size, EAST.size), -1.0)
    correlation_surface(values, frames, readings, (NORTH, EAST), absolute, remove_mean, score, valid)
    wanted, share = expected(values, frames, readings, absolute, remove_mean)
    assert (share.min() < 1.0) == (ground != "whole")
    np.testing.assert_allclose(valid, share, atol=1e-12)
    np.testing.assert_allclose(score, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("remove_mean", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_height_offset_is_removed_or_counts(kind: str, remove_mean: bool) -> None:
    """Readings far above the map, whose square dwarfs that of the terrain: no digits may be lost to it."""
    rng = np.random.default_rng(4)
    values = rng.normal(300.0, 10.0, (81, 90)).astype(np.float32)
    frames = profile(kind, 6)
    readings = np.stack([rng.normal(300.0, 10.0, 6), rng.uniform(0.2, 3.0, 6)], axis=1)
    raised = readings + np.array([8000.0, 0.0])
    scores, valid = np.empty((2, NORTH.size, EAST.size)), np.empty((NORTH.size, EAST.size))
    for given, score in zip((readings, raised), scores):
        correlation_surface(values, frames, given, (NORTH, EAST), False, remove_mean, score, valid)
    if remove_mean:
        np.testing.assert_allclose(scores[1], scores[0], rtol=1e-9)
    else:
        assert (scores[1] > 1e6 * 50.0).all()


@pytest.mark.parametrize("shape", [(1, 4), (2, 2), (3, 3), (37, 43)])
def test_quadratics_are_those_of_plain_numpy(shape: tuple[int, int]) -> None:
    """Slopes and bends by differences; the rise by trying the vertex, and the rim."""
    rng = np.random.default_rng(5)
    field = rng.normal(0.0, 3.0, shape)
    field[rng.random(shape) < 0.05] = np.nan
    slope, bend, rise = np.full((2, *shape), 7.0), np.full((3, *shape), 7.0), np.full(shape, 7.0)
    quadratics(field, slope, bend, rise)
    offset = np.linspace(-0.5, 0.5, 41)
    u, v = offset[:, None], offset[None]
    for i, j in np.ndindex(shape):
        near = field[i - 1 : i + 2, j - 1 : j + 2] if i and j else np.empty((0, 0))
        gn = ge = nn = ne = ee = 0.0
        if near.shape == (3, 3) and not np.isnan(near).any():
            gn, ge = 0.5 * (near[2, 1] - near[0, 1]), 0.5 * (near[1, 2] - near[1, 0])
            nn, ee = float(near[:, 1] @ [1.0, -2.0, 1.0]), float(near[1] @ [1.0, -2.0, 1.0])
            ne = 0.25 * (near[2, 2] - near[2, 0] - near[0, 2] + near[0, 0])
        np.testing.assert_allclose([*slope[:, i, j], *bend[:, i, j]], [gn, ge, nn, ne, ee], atol=1e-12)
        value = gn * u + ge * v + 0.5 * (nn * u * u + ee * v * v) + ne * u * v
        corners = value[::20, ::20].max()
        assert corners - 1e-12 <= rise[i, j]
        peaked = nn < 0.0 and nn * ee > ne * ne
        inside = peaked and np.abs(np.linalg.solve([[nn, ne], [ne, ee]], [-gn, -ge])).max() <= 0.5
        if inside:
            assert value.max() - 1e-12 <= rise[i, j] <= value.max() + 0.01
        else:
            np.testing.assert_allclose(rise[i, j], corners, atol=1e-12)

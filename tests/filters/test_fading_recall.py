"""The kernel of the fading memory against plain numpy, over voids and beyond the edge."""

from __future__ import annotations

import numpy as np
import pytest

from terranav.kernels.fading_memory import fade, log_posterior, recall
from terranav.kernels.sampling import bilinear_at


@pytest.mark.parametrize("cells", [1, 7, 33, 201])
def test_fading_is_that_of_plain_numpy(cells: int) -> None:
    rng = np.random.default_rng(1)
    before, field, after = rng.uniform(0.0, 50.0, cells), rng.normal(300.0, 100.0, cells), np.empty(cells)
    field[::5] = np.nan
    unknown = fade(field, 320.0, 0.04, 0.98, before, after)
    assert unknown == np.isnan(field).sum()
    seen = np.where(np.isnan(field), 0.0, 0.04 * (320.0 - field) ** 2)
    np.testing.assert_allclose(after, 0.98 * before + seen, rtol=1e-14)


@pytest.mark.parametrize("shape", [(37, 43), (3, 5), (8, 8), (17, 4)])
@pytest.mark.parametrize("start", [30.3, 3.0])
@pytest.mark.parametrize("turn", [0.0, 0.002])
def test_recalling_is_sampling_and_fading(shape: tuple[int, int], start: float, turn: float) -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(300.0, 100.0, (61, 72)).astype(np.float32)
    values[25:35, 30:36] = np.nan
    north, east = (50.0 * (np.arange(n) - n // 2) for n in shape)
    frame = np.array([[start, -0.013, turn, 1e-8, 0.0, 0.0], [35.4, turn, 0.017, 0.0, 2e-7, 0.0]])
    before, after = rng.uniform(0.0, 50.0, shape), np.empty(shape)
    unknown = recall(values, frame, (north, east), (320.0, 0.04), 0.98, before, after)
    n, e = -north[:, None], -east[None]
    row, col = np.tensordot(frame, np.stack(np.broadcast_arrays(1.0, n, e, n * n, n * e, e * e)), 1)
    field = np.reshape([bilinear_at(values, r, c) for r, c in zip(row.ravel(), col.ravel())], shape)
    assert unknown == np.isnan(field).sum()
    assert unknown > 0 or shape != (37, 43)
    seen = np.where(np.isnan(field), 0.0, 0.04 * (320.0 - field) ** 2)
    np.testing.assert_allclose(after, 0.98 * before + seen, rtol=1e-9)


@pytest.mark.parametrize("shape", [(1, 1), (5, 3), (37, 43), (64, 201)])
@pytest.mark.parametrize("holes", [0.0, 0.3, 1.0])
def test_the_posterior_and_its_peak_are_those_of_plain_numpy(shape: tuple[int, int], holes: float) -> None:
    rng = np.random.default_rng(6)
    surface = np.round(rng.uniform(0.0, 9.0, shape))  # several cells are equally good: the first one counts
    surface[rng.random(shape) < holes] = np.nan
    north, east = (50.0 * (np.arange(n) - n // 2) for n in shape)
    for prior in (np.array([40.0, -30.0, 2e-7, 1e-7, 3e-7]), np.zeros(5)):
        out = np.empty(shape)
        row, col = log_posterior(surface, 0.7, (north, east), prior, out)
        n, e = north[:, None] - prior[0], east[None] - prior[1]
        expected = -0.7 * surface - 0.5 * (prior[2] * n * n + 2.0 * prior[3] * n * e + prior[4] * e * e)
        np.testing.assert_allclose(out, expected, rtol=1e-12, atol=1e-14)
        if np.isnan(surface).all():
            assert (row, col) == (-1, -1)
        else:
            assert (row, col) == np.unravel_index(int(np.nanargmax(out)), shape)

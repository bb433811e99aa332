"""The kernel of the fading memory against plain numpy, over voids and beyond the edge."""

from __future__ import annotations

import numpy as np
import pytest

from terranav.kernels.fading_memory import fade, recall
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

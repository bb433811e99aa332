"""What a grid says of a reading, against plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from terranav.kernels.candidates import compared


@pytest.mark.parametrize("shape", [(2, 2), (2, 5), (5, 2), (3, 3), (38, 41)])
@pytest.mark.parametrize("holes", [0.0, 0.1, 1.0])
def test_sums_are_those_of_plain_numpy(shape: tuple[int, int], holes: float) -> None:
    rng = np.random.default_rng(7)
    heights, prior = rng.normal(300.0, 50.0, shape), rng.random(shape)
    heights[rng.random(shape) < holes] = np.nan
    away = heights - 310.0
    square = 0.5 * (np.gradient(heights, axis=0) ** 2 + np.gradient(heights, axis=1) ** 2)
    expected = [
        np.sum(prior[np.isfinite(away)]),
        np.nansum(prior * away),
        np.nansum(prior * away**2),
        np.nansum(prior * square),
        np.sum(prior[np.isfinite(square)]),
    ]
    np.testing.assert_allclose(compared(heights, prior, 310.0), expected, rtol=1e-11, atol=1e-12)

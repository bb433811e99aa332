"""The whole set of candidates, their probabilities and their spread, against exhaustive search of a small map."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from terranav.core.earth import offset_m
from terranav.planning._fits import fitted
from terranav.planning._placements import Search, relative, searched
from terranav.planning._weigh import _inside, weighed
from terranav.planning.locate import LocateSettings, Track, _prepared, locate
from tests.planning.test_locate import flown, rough

FloatArray = NDArray[np.float64]
STEP, TURNS = 0.25, 9  # cells, and headings


def bilinear(values: NDArray[np.float32], row: FloatArray, col: FloatArray) -> FloatArray:
    """Plain numpy; NaN off the map."""
    rows, cols = values.shape
    on = (row >= 0.0) & (row <= rows - 1) & (col >= 0.0) & (col <= cols - 1)
    i = np.clip(np.floor(np.where(on, row, 0.0)), 0, rows - 2).astype(np.int64)
    j = np.clip(np.floor(np.where(on, col, 0.0)), 0, cols - 2).astype(np.int64)
    u, v = row - i, col - j
    upper = (1.0 - v) * values[i, j] + v * values[i, j + 1]
    lower = (1.0 - v) * values[i + 1, j] + v * values[i + 1, j + 1]
    value: FloatArray = np.where(on, (1.0 - u) * upper + u * lower, np.nan)
    return value


def posterior(work: Search, factors: int) -> tuple[FloatArray, FloatArray]:
    """All placements of a lattice (n, 4), and the probability of each (n,)."""
    rows, cols = work.values.shape
    row, col = (one.ravel() for one in np.mgrid[0 : rows - 1 + 1e-9 : STEP, 0 : cols - 1 + 1e-9 : STEP])
    frame = work.frame(0.5 * rows, 0.5 * cols)
    turns, stretches = (
        half * ((2.0 * np.arange(n) + 1.0) / n - 1.0) for half, n in ((work.half, TURNS), (work.stretch, factors))
    )
    at, misfit = [], []
    for psi, stretch in itertools.product(turns, stretches):
        down, right = relative(frame, *work.turned(float(psi), 1.0 + float(stretch)))
        d = work.height - bilinear(work.values, row[:, None] + down, col[:, None] + right)
        offset = d @ work.weight / (work.weight.sum() + work.offset_weight)
        on = np.isfinite(offset)
        total = (d - offset[:, None]) ** 2 @ work.weight + work.offset_weight * offset**2
        at.append(np.column_stack([row[on], col[on], np.full((on.sum(), 2), (psi, 1.0 + stretch))]))
        misfit.append(total[on])
    whole = np.concatenate(misfit)
    chance = np.exp(-0.5 * (whole - whole.min()))
    return np.concatenate(at), chance / chance.sum()


CASES = [
    (10, 0, 10.0, 0.0, math.inf),
    (11, 1, 25.0, 0.0, math.inf),
    (13, 3, 40.0, 0.0, 60.0),
    (14, 4, 25.0, 0.02, math.inf),
    (16, 6, 15.0, 0.05, math.inf),
]


@pytest.mark.parametrize(("world", "seed", "sigma", "scale", "offset_sigma"), CASES)
def test_the_candidates_hold_all_that_exhaustive_search_finds(
    world: int, seed: int, sigma: float, scale: float, offset_sigma: float
) -> None:
    """All placements with any share of the probability lie in what was kept, and each candidate has its own share.

    How far it spreads there holds as well: root mean square of the rows and columns from the best placement.
    """
    chart = rough(41, seed=world)
    track, _, _ = flown(chart, seed, sigma=sigma, points=16)
    settings = LocateSettings(heading_deg=4.0, scale=scale, most_places=200_000, offset_sigma=offset_sigma)
    found, work = locate(track, chart, settings), _prepared(track, chart, settings)
    assert found.complete
    assert len(found.candidates) > 3
    least = min(place.misfit for place in found.candidates)
    kept, _, _ = searched(work, work.weight, least + found.margin, found.margin, settings.most_places)
    fits, leaves, left = fitted(work, work.weight, kept, found.margin, 60)
    at, chance = posterior(work, 5 if scale else 1)
    owner = np.full(chance.size, -1)
    for number, cells in enumerate(leaves):
        owner[_inside(work, at, cells)] = number
    assert len(left) == 0
    assert chance[owner < 0].sum() < found.tail
    shares = np.array([chance[owner == number].sum() for number in range(len(fits))])
    told = [place.probability for place in found.candidates if place.probability > 1e-3]
    np.testing.assert_allclose(told, np.sort(shares)[: -1 - len(told) : -1], atol=0.02)
    for number, (fit, share) in enumerate(zip(fits, shares, strict=True)):
        if share > 0.1:
            spread = weighed(work, work.weight, fit, leaves[number]).spread
            assert spread is not None
            moved = at[owner == number, :2] - fit.at[:2]
            square = (moved**2).T @ chance[owner == number] / share
            np.testing.assert_allclose(np.sqrt(np.diag(spread)[:2]), np.sqrt(square), rtol=0.1)


def test_a_scale_that_is_wrong_is_found_and_told() -> None:
    chart = rough(161, sigma=0.5)
    track, lat, lon = flown(chart, 3, turn_deg=1.2, points=70)
    short = Track(track.north_m / 1.03, track.east_m / 1.03, track.height, track.sigma)
    found = locate(short, chart, LocateSettings(scale=0.05))
    best = found.candidates[0]
    assert found.verdict == "found"
    assert best.scale == pytest.approx(0.03, abs=0.004)
    assert best.heading_deg == pytest.approx(1.2, abs=0.4)
    assert np.hypot(*offset_m(lat[-1], lon[-1], best.lat_deg, best.lon_deg)) < 0.5 * chart.cell_m
    under = best.under(short)
    assert np.abs(offset_m(lat, lon, *under)).max() < 0.7 * chart.cell_m
    blind = locate(short, chart, LocateSettings())
    assert blind.ambiguous or blind.candidates[0].rms > 1.5 * best.rms

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import terranav as tn
from terranav.core.earth import shift
from tests.real_maps import REAL_MAPS, RealMap

BEARING = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
SHARE = np.array([0.3, 0.7, 1.0])[:, None]


def disc(radius_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacements north and east all over a disc."""
    return radius_m * SHARE * np.cos(BEARING), radius_m * SHARE * np.sin(BEARING)


def worst_cells(m: tn.Map, lat: float, lon: float, radius_m: float) -> float:
    """Largest distance between the frame and the map's own projection within a disc [cells]."""
    north, east = disc(radius_m)
    row, col = m.local_frame(lat, lon, radius_m).cells(north, east)
    true_row, true_col = m.cells(*shift(lat, lon, north, east))
    return float(np.hypot(row - true_row, col - true_col).max())


def places(m: tn.Map) -> NDArray[np.float64]:
    south, west, north, east = m.bounds_deg
    return np.random.default_rng(6).uniform([south, west], [north, east], (5, 2))


@pytest.mark.parametrize("real", REAL_MAPS, ids=lambda real: real.path)
def test_good_to_a_tenth_of_a_cell_on_every_real_map(shared_data: Path, real: RealMap) -> None:
    m = tn.open_map(shared_data / real.path, **real.options)
    for lat, lon in places(m):
        assert worst_cells(m, lat, lon, 5000.0) < 0.02
        assert worst_cells(m, lat, lon, 20000.0) < 0.1


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:4267", "EPSG:3395", "EPSG:3034", "EPSG:27700"])
def test_good_in_other_projections(crs: str) -> None:
    x, y, cell = {
        "EPSG:4326": (-2.0, 60.0, 0.0003),
        "EPSG:4267": (-100.0, 50.0, 0.0003),
        "EPSG:3395": (1.0e6, 8.0e6, 60.0),
        "EPSG:3034": (4.0e6, 3.0e6, 30.0),
        "EPSG:27700": (4.0e5, 3.0e5, 30.0),
    }[crs]
    m = tn.Map(np.ones((500, 500)), (cell, 0.0, x, 0.0, -cell, y), crs=crs)
    for lat, lon in places(m):
        assert worst_cells(m, lat, lon, 5000.0) < 0.1


@pytest.mark.parametrize("lon", [179.99, -179.99, 539.99])
def test_across_the_antimeridian(lon: float) -> None:
    m = tn.Map(np.ones((200, 200)), (0.001, 0.0, 179.9, 0.0, -0.001, 10.1))
    assert worst_cells(m, 10.0, lon, 5000.0) < 0.02
    assert 0.0 < m.local_frame(10.0, lon).col[0] < 200.0


def test_the_origin_is_exact() -> None:
    m = tn.sample_map()
    frame = m.local_frame(36.6, -84.2)
    row, col = m.cells(36.6, -84.2)
    assert frame.row[0] == pytest.approx(float(row), abs=1e-9)
    assert frame.col[0] == pytest.approx(float(col), abs=1e-9)

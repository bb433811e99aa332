"""Metres north and east: inverse of each other, antisymmetric, and close to the geodesic."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.earth import metres_per_degree, offset_m, offset_of, shift, shifted, wrap_longitude

LATITUDES = st.floats(-80.0, 80.0)
LONGITUDES = st.floats(-180.0, 179.999)
METRES = st.floats(-30000.0, 30000.0)


@given(lat=LATITUDES, lon=LONGITUDES, north=METRES, east=METRES)
def test_shift_is_the_inverse_of_offset(lat: float, lon: float, north: float, east: float) -> None:
    to_lat, to_lon = shift(lat, lon, north, east)
    back = offset_m(lat, lon, to_lat, to_lon)
    assert float(back[0]) == pytest.approx(north, abs=1e-5)
    assert float(back[1]) == pytest.approx(east, abs=1e-5)
    reverse = offset_m(to_lat, to_lon, lat, lon)
    assert float(reverse[0]) == pytest.approx(-float(back[0]), abs=1e-6)
    assert float(reverse[1]) == pytest.approx(-float(back[1]), abs=1e-6)


@pytest.mark.parametrize("lat", [0.0, 36.6, -45.0, 70.0])
def test_distance_agrees_with_the_geodesic(lat: float) -> None:
    geod = pyproj.Geod(ellps="WGS84")
    for azimuth in range(0, 360, 30):
        to_lon, to_lat, _ = geod.fwd(179.99, lat, azimuth, 10_000.0)  # across the antimeridian
        north, east = offset_m(lat, 179.99, to_lat, to_lon)
        assert math.hypot(float(north), float(east)) == pytest.approx(10_000.0, abs=0.01)


def test_metres_per_degree_agree_with_the_geodesic() -> None:
    geod = pyproj.Geod(ellps="WGS84")
    for lat in (-60.0, 0.0, 45.0):
        north, east = metres_per_degree(lat)
        assert float(north) * 1e-3 == pytest.approx(geod.inv(7.0, lat - 5e-4, 7.0, lat + 5e-4)[2], rel=1e-7)
        assert float(east) * 1e-3 == pytest.approx(geod.inv(7.0, lat, 7.001, lat)[2], rel=1e-7)


def test_longitudes_wrap_to_the_half_open_circle() -> None:
    np.testing.assert_allclose(wrap_longitude([180.0, -180.0, 359.0, 181.0]), [-180.0, -180.0, -1.0, -179.0])


@given(lat=LATITUDES, lon=LONGITUDES, north=METRES, east=METRES)
def test_single_positions_give_what_arrays_give(lat: float, lon: float, north: float, east: float) -> None:
    place = shifted(lat, lon, north, east)
    np.testing.assert_allclose(place, shift(lat, lon, north, east), rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(offset_of(lat, lon, *place), offset_m(lat, lon, *place), rtol=1e-12, atol=1e-9)

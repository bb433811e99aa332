from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import terranav as tn
from terranav.core.earth import metres_per_degree, offset_m, shift

VALUES = np.random.default_rng(9).normal(300.0, 50.0, (60, 80))
NORTH_UP = (0.01, 0.0, 10.0, 0.0, -0.01, 46.0)
UTM = (30.0, 0.0, 500000.0, 0.0, -30.0, 5000000.0)


def a_map(values: NDArray[Any] = VALUES, transform: tuple[float, ...] = NORTH_UP, **more: Any) -> tn.Map:
    return tn.Map(values, transform, **more)  # type: ignore[arg-type]


def inside(m: tn.Map, n: int = 400) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    south, west, north, east = m.bounds_deg
    rng = np.random.default_rng(1)
    lat, lon = rng.uniform(south, north, 5 * n), rng.uniform(west, east, 5 * n)
    on = m.covers(lat, lon)
    return lat[on][:n], lon[on][:n]


# -- the sample DEM ---------------------------------------------------------------------------------------------------


def test_the_sample_dem_is_where_it_should_be() -> None:
    m = tn.sample_map()
    assert m.shape == (344, 403)
    assert m.bounds_deg == pytest.approx((36.446667, -84.413333, 36.7325, -84.078333), abs=1e-6)
    assert (float(m.values.min()), float(m.values.max())) == (236.0, 1076.0)
    assert m.info()["suspicious"] == []


def test_the_sample_dem_does_not_import_matplotlib() -> None:
    heavy = "{'matplotlib', 'numba', 'rasterio', 'pyproj'}"
    check = f"import sys, terranav as tn; tn.sample_map(); print({heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_the_sample_dem_lies_the_right_way_up() -> None:
    """Its highest cell is Cross Mountain (36.19833 N, 84.23056 W, 1077 m), a map's height south of the labels."""
    m = tn.sample_map()
    row, col = np.unravel_index(np.argmax(m.values), m.shape)
    north, west = m.bounds_deg[2], m.bounds_deg[1]
    assert north - row / 1200 - 344 / 1200 == pytest.approx(36.19833, abs=0.001)
    assert west + col / 1200 == pytest.approx(-84.23056, abs=0.001)


# -- sampling ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["bilinear", "bicubic"])
@given(level=st.integers(-2000, 2000))
def test_a_datum_shift_shifts_every_sample(method: Any, level: int) -> None:
    m = a_map(VALUES.round())
    lat, lon = inside(m)
    moved = replace(m, values=m.values + level).sample(lat, lon, method)
    np.testing.assert_allclose(moved, m.sample(lat, lon, method) + level, atol=1e-9)


@pytest.mark.parametrize("method", ["bilinear", "bicubic"])
def test_a_map_stored_upside_down_or_mirrored_is_the_same_map(method: Any) -> None:
    m = a_map()
    lat, lon = inside(m)
    a, b, c, d, e, f = NORTH_UP
    rows, cols = VALUES.shape
    for other in (
        a_map(VALUES[::-1], (a, b, c, d, -e, f + rows * e)),
        a_map(VALUES[:, ::-1], (-a, b, c + cols * a, d, e, f)),
        a_map(VALUES.T, (b, a, c, e, d, f)),
    ):
        np.testing.assert_allclose(other.sample(lat, lon, method), m.sample(lat, lon, method), atol=1e-9)


@pytest.mark.parametrize("west", [-180.0, -40.0, 10.0, 179.7, 340.0, 359.8])
def test_longitudes_wrap_both_ways(west: float) -> None:
    m = a_map(transform=(0.01, 0.0, west, 0.0, -0.01, 46.0))
    lon = west + np.linspace(0.005, 0.795, 50)
    here = m.sample(45.7, lon)
    assert np.isfinite(here).all()
    for turn in (-360.0, 360.0):
        np.testing.assert_allclose(m.sample(45.7, lon + turn), here, atol=1e-6)
    assert np.isnan(m.sample(45.7, west + 180.0))


def test_shapes_broadcast() -> None:
    m = a_map()
    assert m.sample(45.8, 10.2).shape == ()
    assert m.sample([[45.8], [45.7]], [10.2, 10.3, 10.4]).shape == (2, 3)
    assert m.sample([], []).shape == (0,)
    m = a_map(transform=UTM, crs="EPSG:32633")
    assert m.sample(45.15, 15.01).shape == ()
    assert m.gradient(45.15, 15.01)[0].shape == ()


def test_places_without_an_image_are_nan() -> None:
    m = a_map(transform=UTM, crs="EPSG:32633")
    assert np.isnan(m.sample([np.nan, 0.0, -91.0, np.inf], [15.0, -75.0, 15.0, 15.0])).all()
    assert not m.covers([np.nan, 0.0, np.inf], [15.0, -75.0, 15.0]).any()


def test_an_unknown_method() -> None:
    with pytest.raises(tn.ConfigError, match="sampling method is 'nearest', expected 'bilinear' or 'bicubic'"):
        a_map().sample(45.8, 10.2, "nearest")  # type: ignore[arg-type]


def test_the_same_field_in_two_crs() -> None:
    """A smooth field sampled in UTM and in degrees agrees where both know it."""

    def height(lat: NDArray[np.float64], lon: NDArray[np.float64]) -> NDArray[np.float64]:
        return 500.0 + 40.0 * np.sin(lat * 300.0) * np.cos(lon * 250.0)

    utm = a_map(np.zeros((300, 300)) + 1.0, UTM, crs="EPSG:32633")
    from pyproj import Transformer

    back = Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)
    row, col = np.mgrid[:300, :300]
    lon, lat = back.transform(500015.0 + 30.0 * col, 4999985.0 - 30.0 * row)
    utm = replace(utm, values=height(lat, lon))
    lat, lon = inside(utm)
    assert np.abs(utm.sample(lat, lon, "bicubic") - height(lat, lon)).max() < 0.01


# -- slopes -----------------------------------------------------------------------------------------------------------


def test_the_slope_of_a_plane() -> None:
    from terranav.maps.fields import plane_map

    m = plane_map(0.25, -0.125)
    lat, lon = inside(m)
    north, east = m.gradient(lat, lon)
    np.testing.assert_allclose(north, 0.25, rtol=1e-6)
    np.testing.assert_allclose(east, -0.125, rtol=1e-6)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32633"])
def test_slopes_are_differences_of_samples(crs: str) -> None:
    m = a_map(transform=NORTH_UP if crs == "EPSG:4326" else UTM, crs=crs)
    lat, lon = inside(m)
    for axis, (n, e) in enumerate(((0.5, 0.0), (0.0, 0.5))):
        ahead = m.sample(*shift(lat, lon, n * m.cell_m, e * m.cell_m))
        behind = m.sample(*shift(lat, lon, -n * m.cell_m, -e * m.cell_m))
        whole = np.isfinite(ahead - behind)
        assert whole.mean() > 0.9
        np.testing.assert_allclose(m.gradient(lat, lon)[axis][whole], ((ahead - behind) / m.cell_m)[whole], rtol=1e-6)


def test_slopes_at_an_edge_and_beside_a_void() -> None:
    from terranav.maps.fields import plane_map

    m = plane_map(0.25, -0.125)
    south, west, north, east = m.bounds_deg
    for lat, lon in ((south, west), (north, east), (0.0, west)):
        np.testing.assert_allclose(m.gradient(lat, lon), (0.25, -0.125), rtol=1e-6)
    values = m.values.copy()
    values[100, 101] = np.nan
    holed = replace(m, values=values)
    np.testing.assert_allclose(holed.gradient(0.0, 0.0), (0.25, -0.125), rtol=1e-6)
    assert np.isnan(m.gradient(north + 0.01, 0.0)).all()


# -- extent -----------------------------------------------------------------------------------------------------------


def test_covers_the_hull_of_the_centres() -> None:
    m = a_map()
    assert m.bounds_deg == pytest.approx((45.405, 10.005, 45.995, 10.795))
    assert m.covers([45.405, 45.995, 45.7], [10.005, 10.795, 10.4]).all()
    assert not m.covers([45.404, 45.7, 45.7, np.nan], [10.4, 10.0049, 10.796, 10.4]).any()


def test_bounds_across_the_antimeridian() -> None:
    south, west, north, east = a_map(transform=(0.01, 0.0, 179.7, 0.0, -0.01, 46.0)).bounds_deg
    assert (west, east) == pytest.approx((179.705, 180.495))
    assert (south, north) == pytest.approx((45.405, 45.995))


def test_cell_size() -> None:
    per_lat, per_lon = metres_per_degree(45.7)
    assert a_map().cell_m == pytest.approx(0.01 * float(np.sqrt(per_lat * per_lon)), rel=1e-6)
    assert a_map(transform=UTM, crs="EPSG:32633").cell_m == pytest.approx(30.0 / 0.9996, rel=1e-5)
    feet = a_map(transform=(100.0, 0.0, 2.0e6, 0.0, -100.0, 7.0e5), crs="EPSG:2274")  # Tennessee, US survey feet
    assert feet.cell_m == pytest.approx(30.48, rel=1e-3)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32633"])
def test_a_crop_says_what_the_map_says(crs: str) -> None:
    m = a_map(transform=NORTH_UP if crs == "EPSG:4326" else UTM, crs=crs)
    south, west, north, east = m.bounds_deg
    box = (
        south + 0.3 * (north - south),
        west + 0.2 * (east - west),
        south + 0.6 * (north - south),
        west + 0.5 * (east - west),
    )
    part = m.crop(*box)
    assert part.values.size < 0.2 * m.values.size
    rng = np.random.default_rng(2)
    lat, lon = rng.uniform(box[0], box[2], 300), rng.uniform(box[1], box[3], 300)
    assert part.covers(lat, lon).all()
    np.testing.assert_allclose(part.sample(lat, lon), m.sample(lat, lon), atol=1e-6)
    assert m.crop(south - 1, west - 1, north + 1, east + 1).checksum == m.checksum


def test_a_crop_across_the_antimeridian() -> None:
    m = a_map(transform=(0.01, 0.0, 179.7, 0.0, -0.01, 46.0))
    part = m.crop(45.5, 179.9, 45.6, -179.9)
    assert part.covers(45.55, [179.9, 180.0, -179.9]).all()
    assert part.shape[1] < 25


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((10.0, 10.1, 11.0, 10.2), r"box \(10, 10\.1, 11, 10\.2\) misses the map, which spans \(45\.4050, 10\.0050"),
        ((45.6, 10.1, 45.5, 10.2), "has no area, expected south < north and west < east"),
        ((45.5, 10.1, 45.6, 10.1), "has no area"),
    ],
)
def test_a_crop_of_nothing(box: tuple[float, float, float, float], message: str) -> None:
    with pytest.raises(tn.DataError, match=message):
        a_map().crop(*box)


# -- the object -------------------------------------------------------------------------------------------------------


def test_a_map_cannot_be_changed() -> None:
    mine = VALUES.astype(np.float32)
    m = a_map(mine)
    with pytest.raises(FrozenInstanceError):
        m.sigma = 2.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        m.values[0, 0] = 0.0
    mine[0, 0] = -1.0  # the map keeps its own copy
    assert m.values[0, 0] == np.float32(VALUES[0, 0])


def test_a_pickled_map_is_the_same_map() -> None:
    m = a_map(transform=UTM, crs="EPSG:32633", datum="EGM96", name="somewhere")
    _ = m.sample(45.0, 15.0), m.bounds_deg, m.cell_m
    again = pickle.loads(pickle.dumps(m))
    assert again.checksum == m.checksum
    assert (again.datum, again.name, again.bounds_deg) == (m.datum, m.name, m.bounds_deg)
    assert not again.values.flags.writeable


def test_the_checksum_tells_maps_apart() -> None:
    m = a_map()
    assert a_map().checksum == m.checksum
    others = [
        replace(m, values=m.values + 1),
        replace(m, transform=(0.01, 0.0, 10.0, 0.0, -0.01, 46.1)),
        replace(m, crs="EPSG:4269"),
        replace(m, kind="bathymetry"),
    ]
    assert len({m.checksum, *(other.checksum for other in others)}) == 5


def test_info_counts_and_measures() -> None:
    values = VALUES.copy()
    values[:30] = np.nan
    info = a_map(values, datum="EGM96").info()
    assert (info["rows"], info["cols"], info["voids"], info["datum"]) == (60, 80, 30 * 80, "EGM96")
    assert info["mean"] == pytest.approx(float(np.nanmean(values)), rel=1e-6)
    assert info["roughness"] == pytest.approx(50.0 * np.sqrt(2.0), rel=0.05)  # white noise
    assert info["suspicious"] == ["50 % of the cells are void"]


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"values": np.ones((1, 9))}, tn.DataError, "dem: map of 1 x 9 cells, expected at least 2 rows and 2 columns"),
        ({"values": np.ones(9)}, tn.DataError, "dem: map of 9 cells, expected"),
        ({"values": np.full((3, 3), np.nan)}, tn.DataError, "dem: every cell of the map is void"),
        ({"transform": (0.0, 0.0, 1.0, 0.0, 1.0, 1.0)}, tn.DataError, "dem: map transform is .* invertible affine"),
        ({"transform": (1.0, 0.0, np.nan, 0.0, 1.0, 1.0)}, tn.DataError, "dem: map transform is"),
        ({"transform": (1.0, 0.0, 1.0)}, tn.DataError, "dem: map transform is"),
        ({"crs": "EPSG:0"}, tn.DataError, "dem: unknown crs 'EPSG:0'"),
        ({"sigma": -0.1}, tn.ConfigError, r"dem: map sigma is -0\.1, expected a finite number and >= 0"),
        ({"kind": "gravty"}, tn.ConfigError, r"did you mean 'gravity'\?"),
        ({"unit": "ft"}, tn.ConfigError, "dem: unit is 'ft', expected 'm' for a terrain map"),
    ],
)
def test_impossible_maps(change: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        tn.Map(**{"values": VALUES, "transform": NORTH_UP, "name": "dem", **change})
    assert "\n" not in str(caught.value)


# -- synthetic fields -------------------------------------------------------------------------------------------------


def test_a_plane_map_is_a_plane_in_metres() -> None:
    from terranav.maps.fields import plane_map

    m = plane_map(0.5, -0.25, height=200.0)
    lat, lon = inside(m)
    north, east = offset_m(0.0, 0.0, lat, lon)
    np.testing.assert_allclose(m.sample(lat, lon), 200.0 + 0.5 * north - 0.25 * east, atol=1e-3)


def test_a_gaussian_map_has_the_spread_and_correlation_it_was_asked_for() -> None:
    from terranav.maps.fields import gaussian_map

    m = gaussian_map(np.random.default_rng(3), std=20.0, correlation_m=300.0, mean=400.0, cells=300, cell_m=100.0)
    field = m.values.astype(float)
    assert field.std() == pytest.approx(20.0, rel=0.06)
    assert field.mean() == pytest.approx(400.0, abs=2.0)
    assert m.cell_m == pytest.approx(100.0, rel=1e-3)
    for lag in (1, 3, 5):
        product = ((field - 400.0) * (np.roll(field, lag, axis=1) - 400.0)).mean() / 400.0
        assert product == pytest.approx(np.exp(-((lag / 3.0) ** 2)), abs=0.06)


def test_the_length_of_the_map_error_is_told_or_two_and_a_half_cells() -> None:
    assert a_map().error_length_m == pytest.approx(2.5 * a_map().cell_m)
    told = a_map(correlation_m=400.0)
    assert told.error_length_m == 400.0
    assert pickle.loads(pickle.dumps(told)).error_length_m == 400.0
    assert told.crop(45.6, 10.2, 45.8, 10.4).error_length_m == 400.0
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(tn.ConfigError, match="correlation_m"):
            a_map(correlation_m=wrong)

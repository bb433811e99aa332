"""Maps at the edges of geography: with a pole inside or beside them, across the antimeridian, at high latitudes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pyproj import Geod

import terranav as tn
from terranav.core.earth import shift
from terranav.io.raster_out import write_map
from terranav.maps.fields import gaussian_map
from terranav.maps.georeference import Georeference

Transform = tuple[float, float, float, float, float, float]
Box = tuple[float, float, float, float]

CELL = 20_000.0
NORTH, SOUTH = "EPSG:3413", "EPSG:3031"


def square(x: float, y: float, cells: int = 80, cell_m: float = CELL) -> Transform:
    """Transform of a square map about (x, y)."""
    return cell_m, 0.0, x - 0.5 * cells * cell_m, 0.0, -cell_m, y + 0.5 * cells * cell_m


def lattice(place: Georeference, box: Box, n: int = 400) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows and columns of n x n places all over a box."""
    south, west, north, east = box
    lat, lon = np.meshgrid(np.linspace(south, north, n), np.linspace(west, east, n))
    return place.cells(lat, lon)


def every_centre(place: Georeference) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Latitude and longitude of every cell."""
    row, col = np.mgrid[: place.shape[0], : place.shape[1]]
    a, b, c, d, e, f = place.transform
    return place.projection.inverse(a * (col + 0.5) + b * (row + 0.5) + c, d * (col + 0.5) + e * (row + 0.5) + f)


# -- bounds -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("crs", "pole"), [(NORTH, 90.0), (SOUTH, -90.0)])
@pytest.mark.parametrize("away", [(0.0, 0.0), (3e5, -2e5), (7.8e5, 7.8e5), (-7.89e5, 1e4)])
def test_a_pole_inside_is_in_the_bounds_with_all_longitudes(crs: str, pole: float, away: tuple[float, float]) -> None:
    place = Georeference((80, 80), square(*away), crs)
    south, west, north, east = place.bounds_deg
    assert (west, east) == (-180.0, 180.0)
    assert (north if pole > 0 else south) == pole
    lat, _ = every_centre(place)
    other = lat.min() if pole > 0 else lat.max()
    assert (south if pole > 0 else north) == pytest.approx(other, abs=1e-9)


@pytest.mark.parametrize("crs", [NORTH, SOUTH])
@pytest.mark.parametrize("away", [(8.01e5, 0.0), (1.2e6, 0.0), (-9e5, -9e5), (123.0, -8.2e5), (4e6, 1e6)])
def test_a_pole_beside_is_not(crs: str, away: tuple[float, float]) -> None:
    place = Georeference((80, 80), square(*away), crs)
    south, west, north, east = place.bounds_deg
    lat, lon = every_centre(place)
    middle = place.centre_deg[1]
    along = (lon - middle + 180.0) % 360.0 - 180.0
    assert -180.0 <= west < 180.0
    assert east - west < 180.0  # a straight line beside the pole sees less than half of the meridians
    assert east - west == pytest.approx(np.ptp(along), abs=1e-6)
    assert (west - middle - along.min() + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-6)
    near, far = (north, south) if crs == NORTH else (-south, -north)
    sign = 1.0 if crs == NORTH else -1.0
    assert near < 90.0
    assert (sign * lat).max() - 1e-9 <= near <= (sign * lat).max() + 0.5 * CELL / 111e3  # of the hull, not of centres
    assert far == pytest.approx((sign * lat).min(), abs=1e-9)


@pytest.mark.parametrize(
    ("crs", "transform", "shape", "bounds"),
    [
        ("EPSG:4326", (1.0, 0.0, -180.0, 0.0, -1.0, 90.0), (180, 360), (-89.5, -179.5, 89.5, 179.5)),
        ("EPSG:4326", (1.0, 0.0, -180.5, 0.0, -1.0, 90.5), (181, 361), (-90.0, -180.0, 90.0, 180.0)),
        ("EPSG:4267", (1.0, 0.0, -180.0, 0.0, -1.0, 90.0), (180, 360), (-89.5, -179.5, 89.5, 179.5)),
        ("EPSG:4326", (0.5, 0.0, 170.0, 0.0, -0.5, 10.0), (20, 40), (0.25, 170.25, 9.75, 189.75)),
        ("EPSG:4326", (0.5, 0.0, 350.0, 0.0, 0.5, 0.0), (20, 40), (0.25, -9.75, 9.75, 9.75)),
        ("+proj=eqc", (111319.49, 0.0, -2e7, 0.0, -111319.49, 10018754.0), (180, 359), (-89.5, -179.16, 89.5, 178.84)),
    ],
)
def test_bounds_of_other_maps(crs: str, transform: Transform, shape: tuple[int, int], bounds: Box) -> None:
    np.testing.assert_allclose(Georeference(shape, transform, crs).bounds_deg, bounds, atol=0.01)


def test_bounds_of_a_map_that_is_nowhere() -> None:
    m = tn.Map(np.ones((20, 20)), (1e6, 0.0, 9e7, 0.0, -1e6, 9e7), "EPSG:32633", name="lost")
    with pytest.raises(tn.DataError, match="the middle of the map is not on the Earth"):
        m.info()


def test_the_size_of_a_cell_at_the_pole_itself() -> None:
    place = Georeference((81, 81), square(0.0, 0.0, 81, 1000.0), NORTH)
    assert place.centre_deg[0] == 90.0
    assert place.cell_m == pytest.approx(1000.0 / (0.5 + 0.5 * np.sin(np.radians(70.0))), rel=1e-4)


# -- boxes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("crs", "box"),
    [
        (NORTH, (85.0, -180.0, 90.0, 180.0)),
        (NORTH, (86.0, 0.0, 90.0, 360.0)),
        (NORTH, (84.0, 170.0, 88.0, 190.0)),
        (NORTH, (86.0, -100.0, 89.9, 100.0)),
        (NORTH, (84.1, -46.0, 84.2, -44.0)),
        (SOUTH, (-90.0, -180.0, -87.0, 180.0)),
        (SOUTH, (-88.0, 100.0, -85.0, 260.0)),
    ],
)
def test_a_window_holds_the_box_and_no_more(crs: str, box: Box) -> None:
    place = Georeference((800, 800), square(0.0, 0.0, 800, 2000.0), crs)
    east = box[3] - 360.0 if box[3] > 180.0 and box[1] > 0.0 else box[3]
    (r0, r1), (c0, c1) = place.window(box[0], box[1], box[2], east)
    row, col = lattice(place, box)
    for first, past, at in ((r0, r1, row), (c0, c1, col)):
        assert first <= at.min()
        assert at.min() < first + 1.1
        assert past - 2.1 < at.max() <= past - 1


def test_a_box_beyond_the_map_is_cut_at_its_edge() -> None:
    place = Georeference((80, 80), square(8.5e5, 0.0), NORTH)  # the pole is just outside
    assert place.window(60.0, -180.0, 90.0, 180.0) == ((0, 80), (0, 80))
    m = tn.Map(np.arange(6400.0).reshape(80, 80), place.transform, NORTH)
    assert m.crop(60.0, -180.0, 90.0, 180.0).checksum == m.checksum


@pytest.mark.parametrize(
    ("crs", "transform", "box"),
    [
        ("EPSG:4326", (0.01, 0.0, 9.0, 0.0, -0.01, 48.0), (47.4, 189.0, 47.6, 190.0)),
        ("EPSG:4326", (0.01, 0.0, 9.0, 0.0, -0.01, 48.0), (47.4, -171.0, 47.6, -170.0)),
        ("EPSG:3857", (1000.0, 0.0, 1e6, 0.0, -1000.0, 6e6), (46.0, 179.0, 47.0, -179.0)),
        (NORTH, square(9e5, 0.0, 80, 1e4), (80.0, 100.0, 85.0, 140.0)),  # the other side of the pole
        (NORTH, square(0.0, 0.0), (-90.0, -180.0, -80.0, 180.0)),
    ],
)
def test_a_box_on_the_far_side_of_the_earth_misses(crs: str, transform: Transform, box: Box) -> None:
    with pytest.raises(tn.DataError, match="misses the map"):
        Georeference((80, 80), transform, crs).window(*box)


def test_a_disc_of_the_earth_with_corners_in_space_has_windows() -> None:
    place = Georeference((360, 360), square(0.0, 0.0, 360, 4e4), "+proj=ortho +lat_0=47 +lon_0=9")
    (r0, r1), (c0, c1) = place.window(46.0, 8.0, 48.0, 10.0)
    row, col = lattice(place, (46.0, 8.0, 48.0, 10.0))
    assert r0 <= row.min()
    assert row.max() <= r1 - 1 < r0 + 10
    assert c0 <= col.min()
    assert col.max() <= c1 - 1 < c0 + 10


def test_a_part_of_a_polar_file_is_what_the_map_says(tmp_path: Path) -> None:
    values = np.random.default_rng(5).uniform(0.0, 900.0, (400, 400))
    whole = tn.Map(values, square(1e4, -3e4, 400, 1000.0), NORTH)
    write_map(whole, tmp_path / "polar.tif")
    box = (89.5, -180.0, 90.0, 180.0)
    part = tn.open_map(tmp_path / "polar.tif", box=box)
    assert part.values.size < 0.3 * values.size
    assert part.bounds_deg[1:] == (-180.0, 90.0, 180.0)
    rng = np.random.default_rng(6)
    lat, lon = rng.uniform(89.5, 90.0, 500), rng.uniform(-180.0, 180.0, 500)
    assert part.covers(lat, lon).all()
    np.testing.assert_allclose(part.sample(lat, lon), whole.sample(lat, lon), atol=1e-3)
    assert part.info()["extent_deg"]["north"] == 90.0


# -- the local frame at high latitudes --------------------------------------------------------------------------------


@pytest.mark.parametrize("lat", [81.0, 83.0, 86.0])
@pytest.mark.parametrize("seconds", [(3.0, 3.0), (1.0, 5.0), (30.0, 30.0)])
@pytest.mark.parametrize(("radius_m", "worst_m"), [(1000.0, 0.001), (5000.0, 0.07), (20_000.0, 4.0)])
def test_the_frame_of_narrow_cells(lat: float, seconds: tuple[float, float], radius_m: float, worst_m: float) -> None:
    """The frame is off by metres that grow as the cube of the radius; cells may be 2 m wide."""
    down, right = seconds[0] / 3600.0, seconds[1] / 3600.0
    place = Georeference((900, 900), (right, 0.0, 20.0, 0.0, -down, lat + 450.0 * down), "EPSG:4326")
    lat0, lon0 = place.centre_deg
    bearing, share = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False), np.array([0.3, 0.7, 1.0])[:, None]
    north, east = radius_m * share * np.cos(bearing), radius_m * share * np.sin(bearing)
    row, col = place.local_frame(lat0, lon0, radius_m).cells(north, east)
    there = shift(lat0, lon0, north, east)
    of_row, of_col = place.cells(*there)
    wide_m = right * 111.7e3 * np.cos(np.radians(lat))
    off_m = np.hypot((row - of_row) * down * 111.7e3, (col - of_col) * wide_m)
    assert off_m.max() < worst_m
    a, _, c, _, e, f = place.transform
    _, _, apart = Geod(ellps="WGS84").inv(a * (col + 0.5) + c, e * (row + 0.5) + f, there[1], there[0])
    assert apart.max() < worst_m


# -- flights ----------------------------------------------------------------------------------------------------------


def terrain(transform: Transform, crs: str, cells: int = 500) -> tn.Map:
    """Hills of 60 m on any grid."""
    hills = gaussian_map(np.random.default_rng(1), std=60.0, correlation_m=600.0, mean=500.0, cells=cells)
    return tn.Map(hills.values, transform, crs, sigma=2.0, name="hills")


def flown(m: tn.Map, lat: NDArray[np.float64], lon: NDArray[np.float64]) -> tn.Recording:
    """A flight along a true track, 2 s apart, without an INS yet."""
    noise = np.random.default_rng(3).normal(0.0, 3.0, lat.size)
    columns = {"time_s": 2.0 * np.arange(lat.size), "lat_deg": lat, "lon_deg": lon, "alt_m": np.full(lat.size, 2000.0)}
    return tn.Recording(columns | {"terrain_m": m.sample(lat, lon) + noise}, sigma={"terrain_m": 3.0})


GRADE = tn.InsGrade(position_sigma_m=300.0, velocity_sigma_mps=0.5, position_walk_m_per_sqrt_s=0.5)


def held(m: tn.Map, rec: tn.Recording, estimator: str, worst_m: float) -> None:
    """An estimator finds the position and keeps it, and knows how well."""
    result = tn.run(estimator, rec, maps=[m], seed=7)
    metrics = result.metrics(since_s=200.0)
    assert metrics["drms_m"] < worst_m
    assert metrics["contained_95"] > 0.9
    assert metrics["lost_s"] == 0.0
    assert ((result.lon_deg >= -180.0) & (result.lon_deg < 180.0)).all()


def past_the_pole(m: tn.Map, closest_m: float, n: int = 250) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A straight line at 100 m/s that passes the pole."""
    along = 200.0 * (np.arange(n) - n // 2)
    turn = 0.5
    x, y = along * np.cos(turn) - closest_m * np.sin(turn), along * np.sin(turn) + closest_m * np.cos(turn)
    return m._place.projection.inverse(x, y)


@pytest.mark.parametrize(("estimator", "worst_m"), [("marginalized", 15.0), ("pointmass", 25.0)])
@pytest.mark.parametrize("crs", [NORTH, SOUTH])
def test_a_flight_past_the_pole(crs: str, estimator: str, worst_m: float) -> None:
    m = terrain(square(0.0, 0.0, 600, 100.0), crs, 600)
    rec = tn.add_drift(flown(m, *past_the_pole(m, 5000.0)), GRADE, 3)
    held(m, rec, estimator, worst_m)


def with_grid_error(m: tn.Map, rec: tn.Recording) -> tn.Recording:
    """The INS error of a real one: it points the same way in space, so its north and east turn beside a pole."""
    project = m._place.projection
    x, y = project.forward(rec.lat_deg, rec.lon_deg)
    lat, lon = project.inverse(x + 250.0 + 0.3 * rec.time_s, y - 200.0 - 0.2 * rec.time_s)
    truth = {"true_lat_deg": rec.lat_deg, "true_lon_deg": rec.lon_deg, "true_alt_m": rec.alt_m}
    columns = {**rec.columns, **truth, "lat_deg": lat, "lon_deg": lon}
    return tn.Recording(columns, ins=GRADE, sigma=rec.sigma)


@pytest.mark.parametrize(("estimator", "worst_m"), [("marginalized", 15.0), ("pointmass", 25.0)])
def test_an_error_fixed_in_space_100_km_from_the_pole(estimator: str, worst_m: float) -> None:
    m = terrain(square(-1e5 * np.sin(0.5), 1e5 * np.cos(0.5), 600, 100.0), NORTH, 600)
    held(m, with_grid_error(m, flown(m, *past_the_pole(m, 1e5))), estimator, worst_m)


@pytest.mark.parametrize("estimator", ["marginalized", "pointmass"])
def test_a_flight_over_the_pole_ends_found_or_says_that_it_is_lost(estimator: str) -> None:
    """At the pole itself north and east mean nothing: no traceback, and no false claim 25 km further on."""
    m = terrain(square(0.0, 0.0, 600, 100.0), NORTH, 600)
    rec = with_grid_error(m, flown(m, *past_the_pole(m, 0.0)))
    result = tn.run(estimator, rec, maps=[m], seed=7)
    end = np.hypot(
        *np.subtract(
            m.cells(result.lat_deg[-1], result.lon_deg[-1]),
            m.cells(rec.columns["true_lat_deg"][-1], rec.columns["true_lon_deg"][-1]),
        )
    )
    assert end < 0.5 or result.status[-1] in ("lost", "off_map", "searching")


def across_180(lat: float, n: int = 200) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """East at 100 m/s, 20 km on either side of 180 degrees, longitudes from -180 to 180."""
    lats, lons = shift(lat, 180.0, 0.1 * 200.0 * (np.arange(n) - n // 2), 200.0 * (np.arange(n) - n // 2))
    assert lons.max() > 179.0
    assert lons.min() < -179.0
    return lats, lons


@pytest.mark.parametrize(
    ("crs", "transform"),
    [
        ("EPSG:4326", (0.001, 0.0, 179.75, 0.0, -0.001, -16.75)),  # 0..360
        ("EPSG:4326", (0.001, 0.0, -180.25, 0.0, -0.001, -16.75)),  # -180..180, gone on below
        ("EPSG:32701", (100.0, 0.0, 155e3, 0.0, -100.0, 8.145e6)),
        ("EPSG:3832", (100.0, 0.0, 3.315e6, 0.0, -100.0, -1.895e6)),  # Mercator about 150 E
    ],
)
@pytest.mark.parametrize("estimator", ["marginalized", "pointmass"])
def test_a_flight_across_the_antimeridian(tmp_path: Path, estimator: str, crs: str, transform: Transform) -> None:
    write_map(terrain(transform, crs), tmp_path / "hills.tif")
    m = tn.open_map(tmp_path / "hills.tif", sigma=2.0, box=(-17.2, 179.76, -16.8, -179.76))
    west, east = m.bounds_deg[1::2]
    assert -180.0 <= west < 180.0 < east
    rec = tn.add_drift(flown(m, *across_180(-17.0)), GRADE, 3)
    held(m, rec, estimator, 25.0)
    path = tmp_path / "flight.csv"
    tn.write_recording(rec, path)
    read = tn.read_recording(path)
    np.testing.assert_allclose(read.lon_deg, rec.lon_deg, atol=1e-6)
    held(m, read, estimator, 25.0)


@pytest.mark.filterwarnings("ignore:recording. the maps cover 98.5 % of the indicated positions:terranav.DataWarning")
@pytest.mark.parametrize("estimator", ["marginalized", "pointmass"])
@pytest.mark.parametrize("west", [-180.0, 0.0])
def test_a_flight_across_180_on_a_map_of_the_whole_earth(estimator: str, west: float) -> None:
    """A file from -180 to 180 ends there: a few epochs see the gap between its last column and its first, no more."""
    hills = gaussian_map(np.random.default_rng(1), std=60.0, correlation_m=3000.0, mean=500.0, cells=160, cell_m=500.0)
    values = np.zeros((160, 72_000), np.float32)
    values[:, 35_920:36_080] = hills.values
    values = values if west == 0.0 else np.roll(values, 36_000, axis=1)
    m = tn.Map(values, (0.005, 0.0, west, 0.0, -0.005, -16.6), sigma=2.0)
    lat, lon = across_180(-17.0)
    held(m, tn.add_drift(flown(m, lat, lon), GRADE, 3), estimator, 35.0)


@pytest.mark.parametrize("estimator", ["marginalized", "pointmass"])
def test_a_flight_at_83_degrees_on_narrow_cells(estimator: str) -> None:
    m = terrain((0.001, 0.0, 20.0, 0.0, -0.001, 83.2), "EPSG:4326", 600)  # 112 m high, 14 m wide
    n = 200
    lat, lon = shift(82.75, 20.2, 200.0 * np.arange(n), 0.1 * 200.0 * np.arange(n))
    held(m, tn.add_drift(flown(m, lat, lon), GRADE, 3), estimator, 30.0)

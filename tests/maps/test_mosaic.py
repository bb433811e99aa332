"""Mosaics: the same answers as one map, across seams, grids, the antimeridian, and within a limit of memory."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import terranav as tn
from terranav.core.earth import shift
from terranav.maps import windows
from terranav.maps.georeference import Georeference, Window
from terranav.maps.map import Map
from terranav.maps.mosaic import Mosaic
from terranav.maps.tiles import Tile

CELL = 1.0 / 1200.0
ABOUT = {"kind": "terrain", "sigma": 3.0, "name": "tiles"}


def part(name: str, chart: Map, rows: tuple[int, int], cols: tuple[int, int]) -> Tile:
    """A tile cut out of a map."""
    values = np.array(chart.values[rows[0] : rows[1], cols[0] : cols[1]])
    a, b, c, d, e, f = chart.transform
    moved = (a, b, c + a * cols[0], d, e, f + e * rows[0])
    return tile(name, values, moved, chart.crs)


def tile(name: str, values: NDArray[np.float32], transform: tuple[float, ...], crs: str = "EPSG:4326") -> Tile:
    def read(window: Window) -> NDArray[np.float32]:
        (top, bottom), (left, right) = window
        assert 0 <= top < bottom <= values.shape[0]
        assert 0 <= left < right <= values.shape[1]
        return values[top:bottom, left:right].copy()

    a, b, c, d, e, f = transform
    return Tile(name, Georeference((values.shape[0], values.shape[1]), (a, b, c, d, e, f), crs), read, lambda: name)


@pytest.fixture(scope="module")
def land() -> Map:
    rng = np.random.default_rng(3)
    rough = np.cumsum(np.cumsum(rng.normal(size=(700, 900)), axis=0), axis=1)
    values = (1000.0 + 0.3 * rough).astype(np.float32)
    values[300:310, 500:520] = np.nan
    return Map(values, (CELL, 0.0, 10.0 - CELL / 2, 0.0, -CELL, 47.0 + CELL / 2))


@pytest.fixture(scope="module")
def quarters(land: Map) -> list[Tile]:
    """Four tiles that share a row or column with their neighbours, as .hgt tiles do."""
    rows, cols = ((0, 351), (350, 700)), ((0, 401), (400, 900))
    return [part(f"{i}{j}", land, rows[i], cols[j]) for i in range(2) for j in range(2)]


def track(chart: Map) -> tn.Recording:
    """A flight across the seams, by an INS that errs by 300 m and drifts."""
    rng, n = np.random.default_rng(9), 90
    t = 4.0 * np.arange(n)
    lat, lon = shift(np.full(n, 46.78), np.full(n, 10.2), -55.0 * t * 0.3, 55.0 * t)
    said = shift(lat, lon, 200.0 + 0.2 * t, -220.0 + 0.1 * t)
    columns = {"time_s": t, "lat_deg": said[0], "lon_deg": said[1], "alt_m": np.full(n, 4000.0)}
    truth = {"true_lat_deg": lat, "true_lon_deg": lon, "terrain_m": chart.sample(lat, lon) + rng.normal(0.0, 3.0, n)}
    return tn.Recording({**columns, **truth}, ins=tn.InsGrade(300.0, 0.3, 0.1), sigma={"terrain_m": 3.0})


def places(chart: Map, count: int, seed: int = 1) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    south, west, north, east = chart.bounds_deg
    rng = np.random.default_rng(seed)
    return rng.uniform(south - 2e-3, north + 2e-3, count), rng.uniform(west - 2e-3, east + 2e-3, count)


@pytest.mark.parametrize("method", ["bilinear", "bicubic"])
def test_tiles_of_one_grid_are_the_whole_map_to_the_bit(land: Map, quarters: list[Tile], method: Any) -> None:
    chart = Mosaic(quarters, ABOUT)
    assert (chart.shape, chart.crs) == (land.shape, land.crs)
    np.testing.assert_allclose(chart.transform, land.transform, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(chart.values, land.values)
    lat, lon = places(land, 20_000)
    lat[:2000] = 47.0 - 350 * CELL + np.linspace(-1.5, 1.5, 2000) * CELL  # along a seam
    np.testing.assert_allclose(chart.sample(lat, lon, method), land.sample(lat, lon, method), rtol=0.0, atol=1e-6)
    near = np.abs(lat - 46.7) < 0.01
    np.testing.assert_allclose(
        chart.sample(lat[near], lon[near], method), land.sample(lat[near], lon[near], method), atol=1e-6
    )
    np.testing.assert_array_equal(chart.covers(lat, lon), land.covers(lat, lon))


def test_slopes_boxes_and_figures_are_those_of_the_whole_map(land: Map, quarters: list[Tile]) -> None:
    chart = Mosaic(quarters, ABOUT)
    lat, lon = places(land, 500)
    for one, other in zip(chart.gradient(lat, lon), land.gradient(lat, lon), strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-7)
    box = (46.6, 10.2, 46.8, 10.5)
    cut, expected = chart.crop(*box), land.crop(*box)
    np.testing.assert_array_equal(cut.values, expected.values)
    np.testing.assert_allclose(cut.transform, expected.transform, rtol=0.0, atol=1e-12)
    with pytest.raises(tn.DataError, match="misses the map"):
        chart.crop(40.0, 1.0, 41.0, 2.0)
    mine, theirs = chart.info(), land.info()
    assert mine["tiles"] == 4
    assert mine["looked_at"] == 1.0
    for key in ("voids", "min", "max", "mean", "std", "roughness", "rows", "cols"):
        assert mine[key] == theirs[key]


def test_a_window_is_a_matter_of_the_place_alone(
    land: Map, quarters: list[Tile], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(windows, "BLOCK", 64)
    chart = Mosaic(quarters, ABOUT)
    first = chart.around(46.75, 10.3, 3000.0)
    for lat, lon in zip(*places(land, 50), strict=True):
        chart.around(float(lat), float(lon), 5000.0)
    again = chart.around(46.75, 10.3, 3000.0)
    assert first.transform == again.transform
    np.testing.assert_array_equal(first.values, again.values)
    frame, whole = first.local_frame(46.75, 10.3, 3000.0), land.local_frame(46.75, 10.3, 3000.0)
    north, east = np.random.default_rng(2).uniform(-2000.0, 2000.0, (2, 1000))
    lat, lon = shift(46.75, 10.3, north, east)
    row, col = first.cells(lat, lon)
    assert min(row.min(), col.min()) >= 0.0
    assert row.max() <= first.shape[0] - 1
    assert col.max() <= first.shape[1] - 1
    np.testing.assert_allclose(frame.row[1:], whole.row[1:], rtol=1e-9)
    np.testing.assert_allclose(first.sample(lat, lon), land.sample(lat, lon), rtol=0.0, atol=1e-6)


def test_several_places_have_one_window(land: Map, quarters: list[Tile]) -> None:
    chart = Mosaic(quarters, ABOUT)
    lat, lon = np.array([46.5, 46.7, 46.9]), np.array([10.1, 10.3, 10.2])
    window = chart.around(lat, lon, 1000.0)
    for north, east in ((1000.0, 0.0), (-1000.0, 0.0), (0.0, 1000.0), (0.0, -1000.0)):
        at = shift(lat, lon, north, east)
        np.testing.assert_allclose(window.sample(*at), land.sample(*at), rtol=0.0, atol=1e-6)


def test_where_tiles_overlap_the_first_with_a_value_wins(land: Map) -> None:
    low, high = (np.full((100, 100), value, np.float32) for value in (100.0, 200.0))
    low[:, :10] = np.nan
    at = (CELL, 0.0, 10.0, 0.0, -CELL, 47.0)
    tiles = [tile("low", low, at), tile("high", high, at)]
    np.testing.assert_array_equal(Mosaic(tiles, ABOUT).values[:, :10], 200.0)
    np.testing.assert_array_equal(Mosaic(tiles, ABOUT).values[:, 10:], 100.0)
    np.testing.assert_array_equal(Mosaic(tiles[::-1], ABOUT).values, 200.0)


def test_a_gap_is_void_and_a_vehicle_beside_the_map_meets_voids(
    quarters: list[Tile], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(windows, "BLOCK", 32)
    chart = Mosaic([quarters[0], quarters[3]], ABOUT)
    assert np.isnan(chart.sample(46.9, 10.6))
    assert chart.covers(46.9, 10.6)
    assert np.isnan(chart.around(46.9, 10.65, 500.0).values).all()
    assert np.isnan(chart.around(60.0, 100.0, 500.0).sample(60.0, 100.0))
    assert np.isnan(chart.around(46.9, 10.65, 500.0).local_frame(46.9, 10.65).row).sum() == 0


def test_coarser_and_projected_tiles_are_interpolated_and_finer_ones_win() -> None:
    def height(lat: Any, lon: Any) -> Any:
        return 500.0 + 3000.0 * (lat - 46.5) + 2000.0 * (lon - 10.5)

    def grid(transform: tuple[float, ...], shape: tuple[int, int], crs: str, lift: float = 0.0) -> Tile:
        a, b, c, d, e, f = transform
        place = Georeference(shape, (a, b, c, d, e, f), crs)
        row, col = np.indices(shape) + 0.5
        lat, lon = place.projection.inverse(a * col + c, e * row + f)
        return tile(crs + str(a), (height(lat, lon) + lift).astype(np.float32), transform, crs)

    coarse = grid((0.01, 0.0, 10.0, 0.0, -0.01, 47.0), (100, 100), "EPSG:4326")
    fine = grid((0.001, 0.0, 10.2, 0.0, -0.001, 46.8), (200, 200), "EPSG:4326", 7.0)
    metres = grid((200.0, 0.0, 600_000.0, 0.0, -200.0, 5_190_000.0), (100, 150), "EPSG:32632")
    chart = Mosaic([coarse, fine, metres], ABOUT)
    assert chart.cell_m == pytest.approx(92.0, abs=2.0)
    lat, lon = np.random.default_rng(1).uniform((46.02, 10.02), (46.98, 10.98), (4000, 2)).T
    inside = (np.abs(lat - 46.7) < 0.0985) & (np.abs(lon - 10.3) < 0.0985)
    outside = (np.abs(lat - 46.7) > 0.1015) | (np.abs(lon - 10.3) > 0.1015)
    found = chart.sample(lat, lon)
    np.testing.assert_allclose(found[inside], height(lat, lon)[inside] + 7.0, atol=0.01)
    np.testing.assert_allclose(
        found[outside], height(lat, lon)[outside], atol=0.05
    )  # 200 m cells are not plane in degrees
    assert chart.error_length_m == pytest.approx(2.5 * max(one.place.cell_m for one in (coarse, metres)), rel=1e-6)
    listed = Mosaic([coarse, fine, metres], ABOUT, finest_first=False)
    np.testing.assert_allclose(listed.sample(lat, lon), height(lat, lon), atol=0.05)


def test_neighbours_on_other_grids_meet_without_a_gap() -> None:
    west = tile("west", np.full((100, 100), 5.0, np.float32), (0.01, 0.0, 10.0, 0.0, -0.01, 47.0))
    east = tile("east", np.full((100, 50), 5.0, np.float32), (0.02, 0.0, 11.0, 0.0, -0.01, 47.0))
    chart = Mosaic([west, east], ABOUT)
    lon = np.linspace(10.01, 11.98, 3000)
    np.testing.assert_allclose(chart.sample(46.5, lon), 5.0)


def test_tiles_across_the_antimeridian_are_one_piece() -> None:
    cell = 0.01
    values = np.random.default_rng(4).uniform(0.0, 100.0, (60, 120)).astype(np.float32)
    whole = Map(values, (cell, 0.0, 179.4, 0.0, -cell, -16.0))
    east = tile("east", values[:, 60:].copy(), (cell, 0.0, -180.0, 0.0, -cell, -16.0))
    west = tile("west", values[:, :60].copy(), (cell, 0.0, 179.4, 0.0, -cell, -16.0))
    for tiles in ([east, west], [west, east]):
        chart = Mosaic(tiles, ABOUT)
        assert chart.shape == whole.shape
        lat, lon = places(whole, 3000)
        for turn in (0.0, -360.0):
            np.testing.assert_allclose(chart.sample(lat, lon + turn), whole.sample(lat, lon), atol=1e-5)
        cut = chart.crop(-16.5, 179.9, -16.1, -179.9)
        np.testing.assert_array_equal(cut.values, whole.crop(-16.5, 179.9, -16.1, -179.9).values)


def test_a_grid_around_the_earth_has_no_edge() -> None:
    lon = np.arange(360) - 179.5
    lat = 89.5 - np.arange(180)
    values = (100.0 * np.cos(np.radians(lon))[None, :] * np.cos(np.radians(lat))[:, None]).astype(np.float32)
    for west in (-180.0, 0.0, 77.0):
        rolled = np.roll(values, -round(west + 180.0), axis=1)
        chart = Mosaic([tile("globe", rolled, (1.0, 0.0, west, 0.0, -1.0, 90.0))], ABOUT)
        at = np.array([west - 0.4, west, west + 0.3, 179.9, -179.9, 180.2, 0.1])
        expected = 100.0 * np.cos(np.radians(at)) * np.cos(np.radians(10.5))
        np.testing.assert_allclose(chart.sample(10.5, at), expected, atol=0.02)
        assert chart.covers(10.5, at).all()
        np.testing.assert_allclose(chart.around(10.5, float(west), 300e3).sample(10.5, at[:3]), expected[:3], atol=0.02)
        box = chart.crop(0.0, west - 5.0, 10.0, west + 5.0)
        np.testing.assert_allclose(
            box.sample(5.5, west), 100.0 * np.cos(np.radians(west)) * np.cos(np.radians(5.5)), atol=0.02
        )


def sparse(size: int, read: Callable[[Window], None]) -> Tile:
    """A tile of size x size cells whose values are made when they are read."""

    def made(window: Window) -> NDArray[np.float32]:
        read(window)
        (top, bottom), (left, right) = window
        rows, cols = np.arange(top, bottom), np.arange(left, right)
        return (500.0 + 100.0 * np.sin(rows / 40.0)[:, None] * np.cos(cols / 50.0)).astype(np.float32)

    return Tile("sparse", Georeference((size, size), (1e-4, 0.0, 10.0, 0.0, -1e-4, 47.0), "EPSG:4326"), made)


def test_memory_stays_within_its_limit_and_a_window_beyond_it_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "BLOCK", 128)
    asked: list[int] = []
    chart = Mosaic(
        [sparse(60_000, lambda w: asked.append((w[0][1] - w[0][0]) * (w[1][1] - w[1][0])))], ABOUT, memory_mb=8.0
    )
    for lon in np.linspace(10.5, 12.5, 400):
        window = chart.around(44.0, float(lon), 1500.0)
        assert window.covers(44.0, float(lon))
        assert chart.held_bytes <= 8 * 2**20
    assert 4 * sum(asked) > 20 * 2**20  # more than would be held
    with pytest.warns(tn.DataWarning, match=r"a search over 21\d\d\d x 30\d\d\d cells does not fit into 8 MiB of map"):
        window = chart.around(44.0, 12.0, 120_000.0)
    assert window.covers(44.0, 12.0)
    assert 4 * window.values.size <= 4 * 2**20
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        chart.around(44.1, 12.1, 120_000.0)  # said once
    with pytest.raises(tn.ConfigError, match=r"memory_mb is 1\.0, expected a finite number and >= 8"):
        Mosaic([sparse(100, lambda _: None)], ABOUT, memory_mb=1.0)


def test_what_lies_ahead_is_read_in_another_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "BLOCK", 128)
    here: list[Window] = []
    elsewhere: list[Window] = []

    def read(window: Window) -> None:
        mine = threading.current_thread() is threading.main_thread()
        (here if mine else elsewhere).append(window)

    chart = Mosaic([sparse(20_000, read)], ABOUT)
    for lon in np.linspace(10.5, 11.0, 100):
        chart.around(46.0, float(lon), 300.0)
        for pool in [chart._windows._pool()]:
            pool.submit(int).result()  # let the other thread come to its end
    assert elsewhere
    assert len(here) <= 6  # the first window, all later ones were there


def test_any_number_of_threads_get_the_same_answers(
    land: Map, quarters: list[Tile], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(windows, "BLOCK", 32)
    chart = Mosaic(quarters, ABOUT, memory_mb=8.0)
    lat, lon = places(land, 400)
    expected = land.sample(lat, lon)

    def look(k: int) -> float:
        return float(chart.around(float(lat[k]), float(lon[k]), 400.0).sample(lat[k], lon[k]))

    with ThreadPoolExecutor(8) as pool:
        found = np.array(list(pool.map(look, list(range(400)) * 3)))
    np.testing.assert_allclose(found.reshape(3, 400), np.tile(expected, (3, 1)), rtol=0.0, atol=1e-6)


def test_a_tile_that_cannot_be_read_is_named_once_and_left_out(land: Map, quarters: list[Tile]) -> None:
    def broken(_: Window) -> NDArray[np.float32]:
        raise tn.DataError("bad.tif: not a readable raster (it is cut), expected a map raster")

    bad = Tile("bad.tif", quarters[0].place, broken)
    chart = Mosaic([bad, *quarters[1:]], ABOUT)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert np.isnan(chart.sample(46.9, 10.1))
        np.testing.assert_allclose(chart.sample(46.9, 10.6), land.sample(46.9, 10.6))
        assert np.isnan(chart.values[:300, :300]).all()
    assert [str(one.message) for one in said] == [
        "bad.tif: not a readable raster (it is cut), expected a map raster; the tile is left out"
    ]


@pytest.mark.parametrize(
    "name", ["marginalized", "pointmass", "particle", "viterbi", "sitan", "tercom", "fading_memory", "iccp"]
)
def test_an_estimator_over_tiles_is_as_good_as_over_one_map(
    land: Map, quarters: list[Tile], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(windows, "BLOCK", 64)
    rec = track(land)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tn.DataWarning)
        one = tn.run(name, rec, maps=[land], seed=5)
        two = tn.run(name, rec, maps=[Mosaic(quarters, ABOUT)], seed=5)
    np.testing.assert_allclose(two.error_m, one.error_m, rtol=0.0, atol=0.02)
    assert list(two.status) == list(one.status)

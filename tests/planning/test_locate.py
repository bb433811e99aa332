"""A profile found anywhere on a map, against exhaustive search and known answers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import terranav as tn
from terranav.core.earth import offset_m, shift
from terranav.core.errors import ConfigError, DataError
from terranav.kernels import locating
from terranav.maps.fields import plane_map
from terranav.maps.map import Map
from terranav.planning._fits import fitted
from terranav.planning._placements import TOP, regions_of, searched, shape_in
from terranav.planning.locate import LocateSettings, Track, _margin, _prepared, locate

FloatArray = NDArray[np.float64]
CELL_M = 60.0


def rough(cells: int = 121, sigma: float = 1.0, seed: int = 1, centre: tuple[float, float] = (47.5, 9.5)) -> Map:
    at = np.arange(cells)
    rng = np.random.default_rng(seed)
    height = np.zeros((cells, cells))
    for length in (60.0, 30.0, 17.0, 9.0):
        for _ in range(6):
            turn, phase = rng.uniform(0.0, 2.0 * math.pi, 2)
            along = at[:, None] * math.cos(turn) + at * math.sin(turn)
            height += 1.2 * length * np.cos(2.0 * math.pi * along / length + phase)
    flat = plane_map(0.0, 0.0, cells=cells, cell_m=CELL_M, centre_deg=centre, sigma=sigma)
    return Map(height, flat.transform, sigma=sigma)


def flown(
    chart: Map, seed: int, *, turn_deg: float = 0.0, offset: float = 40.0, sigma: float = 2.0, points: int = 50
) -> tuple[Track, FloatArray, FloatArray]:
    """A track across the middle of a map as indicated, `turn_deg` short of the true one; and the true places."""
    rng = np.random.default_rng(seed)
    along = np.arange(points) * 50.0
    bearing = rng.uniform(0.0, 2.0 * math.pi)
    north = along * math.cos(bearing) + 200.0 * np.sin(along / 500.0)
    east = along * math.sin(bearing)
    start = rng.uniform(-500.0, 500.0, 2)
    lat, lon = shift(*chart.centre_deg, start[0] + north, start[1] + east)
    height = chart.sample(lat, lon) + offset + sigma * rng.standard_normal(points)
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    return Track(north * cos + east * sin, east * cos - north * sin, height, sigma), lat, lon


@pytest.mark.parametrize("seed", range(4))
def test_a_profile_over_rough_land_is_found(seed: int) -> None:
    chart, turn = rough(), (-1.7, -0.4, 0.9, 1.8)[seed]
    track, lat, lon = flown(chart, seed, turn_deg=turn)
    found = locate(track, chart)
    best = found.candidates[0]
    assert not found.ambiguous
    assert found.reasons == ()
    assert found.complete
    assert found.tail < 1e-3
    assert found.share < 0.1
    assert np.hypot(*offset_m(lat[-1], lon[-1], best.lat_deg, best.lon_deg)) < 0.5 * CELL_M
    assert np.hypot(*offset_m(lat[0], lon[0], best.first_lat_deg, best.first_lon_deg)) < 0.5 * CELL_M
    assert best.heading_deg == pytest.approx(turn, abs=0.5)
    assert best.offset == pytest.approx(40.0, abs=2.0)
    assert best.rms == pytest.approx(2.0, abs=0.8)
    assert 0.0 < best.sigma_m < 0.5 * CELL_M
    assert sum(one.probability for one in found.candidates) == pytest.approx(1.0)


def everywhere(work: Any, step: float, headings: int) -> FloatArray:
    """Misfits of all placements on a lattice finer than the cells: row, column, heading, misfit."""
    rows, cols = work.chart.shape
    out = []
    for psi in np.linspace(-work.half, work.half, headings):
        for row in np.arange(0.0, rows - 0.9, step):
            frame = work.frame(row, 0.5 * cols)
            down, right = frame.cells(*work.turned(float(psi)))
            down, right = down - frame.row[0], right - frame.col[0]
            for col in np.arange(0.0, cols - 0.9, step):
                misfit = locating.misfit_at(
                    work.chart.values, row, col, down, right, work.height, work.weight, 0.0, work.void_cost
                )[0]
                out.append((row, col, psi, misfit))
    return np.array(out)


@pytest.mark.parametrize(("seed", "sigma"), [(0, 2.0), (1, 30.0), (2, 60.0)])
def test_nothing_is_skipped_that_exhaustive_search_finds(seed: int, sigma: float) -> None:
    """Every placement within the margin lies in a cell that was kept; the noisier, the more of them there are."""
    chart = rough(61)
    track, _, _ = flown(chart, seed, sigma=sigma, points=24)
    settings = LocateSettings()
    work = _prepared(track, chart, settings)
    margin = 10.0
    lattice = everywhere(work, 0.5, 9)
    best = lattice[:, 3].min()
    kept, limit, complete = searched(work, work.weight, best + margin, margin, 200_000)
    assert complete
    cells = {(int(row), int(col)) for row, col in kept[:, :2]}
    within = lattice[lattice[:, 3] <= limit]
    half = 0.5
    for row, col, _, _ in within:
        around = {(math.floor(row + a), math.floor(col + b)) for a in (0.0, half) for b in (0.0, half)}
        assert cells & around
    fits, _, left = fitted(work, work.weight, kept, margin, 60)
    assert fits[0].misfit <= best + 1e-9
    if sigma < 10.0:
        assert len(left) == 0
        assert len(kept) < 0.02 * chart.values.size * work.shapes[0, 1]


@pytest.mark.parametrize(
    ("crs", "transform", "heading_deg", "scale"),
    [
        ("EPSG:4326", (1e-3, 0.0, 9.0, 0.0, -1e-3, 61.0), 2.0, 0.0),
        ("EPSG:4326", (1e-3, 0.0, 9.0, 0.0, 1e-3, -41.0), 30.0, 0.02),
        ("EPSG:4326", (1e-3, 0.0, 9.0, 0.0, -1e-3, 71.0), 180.0, 0.0),
        ("EPSG:32632", (80.0, 0.0, 700_000.0, 0.0, -80.0, 6_700_000.0), 5.0, 0.1),
        ("EPSG:32632", (60.0, 50.0, 700_000.0, 50.0, -60.0, 6_700_000.0), 0.0, 0.2),
    ],
)
def test_the_cells_of_a_block_hold_all_its_placements(
    crs: str, transform: tuple[float, float, float, float, float, float], heading_deg: float, scale: float
) -> None:
    """At any place in the block, any heading in the interval, and the shape that the map gives the track just there."""
    rng = np.random.default_rng(7)
    chart = Map(rng.random((300, 400)), transform, crs, sigma=1.0)
    along = np.linspace(0.0, 15_000.0, 30)
    track = Track(0.6 * along, 0.8 * along + 500.0 * np.sin(along / 2000.0), along % 77.0, 5.0)
    work = _prepared(track, chart, LocateSettings(heading_deg=heading_deg, scale=scale))
    for i0, i1, j0, j1 in regions_of(work)[::2]:
        ends, places = shape_in(work, (i0, i1, j0, j1))
        top, bottom, west, east = ends
        assert places.shape == (2, work.shapes[0, 1], work.height.size)
        for level in range(TOP + 1):
            begins, count = work.shapes[level]
            block = 2**level
            for _ in range(20):
                at = begins + int(rng.integers(count))
                i, j = (int(rng.integers(a, b)) for a, b in ((i0, i1), (j0, j1)))
                row = min(i - 0.5 + block * rng.random(), i1 - 0.5)
                col = min(j - 0.5 + block * rng.random(), j1 - 0.5)
                (psi, factor), (turn, stretch) = work.mids[at], work.halves[at]
                psi, factor = psi + turn * rng.uniform(-1.0, 1.0), factor * (1.0 + stretch * rng.uniform(-1.0, 1.0))
                frame = work.frame(row, col)
                down, right = frame.cells(*work.turned(float(psi), float(factor)))
                assert (np.floor(down) >= i + top[at]).all()
                assert (np.ceil(down) <= i + block + bottom[at]).all()
                assert (np.floor(right) >= j + west[at]).all()
                assert (np.ceil(right) <= j + block + east[at]).all()


def test_flat_land_is_ambiguous() -> None:
    chart = plane_map(0.0, 0.0, cells=121, cell_m=CELL_M, sigma=1.0)
    track, _, _ = flown(chart, 3)
    found = locate(track, chart, LocateSettings(most_places=2000))
    assert found.ambiguous
    assert not found.complete
    assert found.reasons[0] == "search stopped: more than 2000 cells and headings fit, too little relief to search all"
    assert not any("probability" in reason for reason in found.reasons)
    assert all(math.isnan(place.probability) for place in found.candidates)


def test_a_slope_along_one_axis_leaves_the_other_open() -> None:
    chart = plane_map(0.0, 0.0, cells=121, cell_m=CELL_M, sigma=1.0)
    wave = 80.0 * np.sin(np.arange(121) ** 1.5 / 40.0)
    chart = Map(np.tile(wave[:, None], (1, 121)), chart.transform, sigma=1.0)
    track, _, _ = flown(chart, 3)
    assert locate(track, chart, LocateSettings(heading_deg=0.0)).ambiguous


def test_a_map_that_repeats_itself_is_ambiguous_and_gives_both_places() -> None:
    half = rough(101).values
    twice = plane_map(0.0, 0.0, cells=202, cell_m=CELL_M, sigma=1.0)
    chart = Map(np.tile(half, (2, 2))[:, :], twice.transform, sigma=1.0)
    rng = np.random.default_rng(5)
    along = np.arange(40, dtype=np.float64) * 50.0
    lat, lon = shift(*chart.centre_deg, 1500.0 + 0.7 * along, 1500.0 + 0.7 * along)
    track = Track(0.7 * along, 0.7 * along, chart.sample(lat, lon) + rng.standard_normal(40), 1.0)
    found = locate(track, chart)
    assert found.ambiguous
    assert "probability" in found.reasons[0]
    assert len(found.candidates) == 4
    gaps = [np.hypot(*offset_m(lat[-1], lon[-1], one.lat_deg, one.lon_deg)) for one in found.candidates]
    assert min(gaps) < 0.5 * CELL_M


def test_a_place_that_is_not_on_the_map_is_not_found_for_sure() -> None:
    track, _, _ = flown(rough(seed=1), 1)
    found = locate(track, rough(seed=2))
    assert found.ambiguous


def test_a_known_offset_takes_less_work() -> None:
    chart = rough()
    track, lat, lon = flown(chart, 2, offset=0.0)
    free, held = locate(track, chart), locate(track, chart, LocateSettings(offset_sigma=5.0))
    assert held.lookups < free.lookups
    best = held.candidates[0]
    assert np.hypot(*offset_m(lat[-1], lon[-1], best.lat_deg, best.lon_deg)) < 0.5 * CELL_M


def test_a_heading_that_is_known_needs_no_search() -> None:
    chart = rough()
    track, lat, lon = flown(chart, 2)
    found = locate(track, chart, LocateSettings(heading_deg=0.0))
    best = found.candidates[0]
    assert not found.ambiguous
    assert best.heading_deg == 0.0
    assert np.hypot(*offset_m(lat[-1], lon[-1], best.lat_deg, best.lon_deg)) < 0.5 * CELL_M


def test_voids_on_the_track_cost_no_more_than_their_points() -> None:
    chart = rough()
    track, lat, lon = flown(chart, 0)
    row, col = chart.cells(lat[20], lon[20])
    values = chart.values.copy()
    values[int(row) : int(row) + 3, int(col) : int(col) + 3] = np.nan
    found = locate(track, Map(values, chart.transform, sigma=1.0))
    best = found.candidates[0]
    assert np.hypot(*offset_m(lat[-1], lon[-1], best.lat_deg, best.lon_deg)) < 0.5 * CELL_M


def test_a_projected_map_serves_as_well() -> None:
    chart = in_metres()
    rng = np.random.default_rng(6)
    along = np.arange(60, dtype=np.float64) * 100.0
    lat, lon = shift(*chart.centre_deg, 0.8 * along - 2500.0, 0.6 * along - 1000.0)
    track = Track(0.8 * along, 0.6 * along, chart.sample(lat, lon) + rng.standard_normal(60), 1.0)
    found = locate(track, chart)
    best = found.candidates[0]
    assert not found.ambiguous
    assert np.hypot(*offset_m(lat[-1], lon[-1], best.lat_deg, best.lon_deg)) < 50.0


def in_metres() -> Map:
    chart = rough(161)
    return Map(chart.values, (100.0, 0.0, 500_000.0, 0.0, -100.0, 5_260_000.0), "EPSG:32632", sigma=1.0)


def test_a_margin_leaves_the_tail_asked_for() -> None:
    chart = rough()
    work = _prepared(flown(chart, 0)[0], chart, LocateSettings())
    assert _margin(work, 1e-6, 0.0) > _margin(work, 1e-3, 0.0) > _margin(work, 1e-3, 0.1 * work.leaf) > 20.0


LINE = np.arange(20.0)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"sigma": 0.0}, ConfigError, "sigma is 0.0, expected"),
        ({"north_m": LINE[:9]}, DataError, r"north_m has shape \(9,\), expected \(20,\)"),
        ({"height": np.full(20, np.nan)}, DataError, "height holds nan, expected finite"),
        ({"north_m": 0.0 * LINE}, DataError, "length of 0 m"),
    ],
)
def test_bad_tracks_are_refused(change: dict[str, Any], error: type[Exception], message: str) -> None:
    good = {"north_m": LINE, "east_m": 0.0 * LINE, "height": LINE, "sigma": 1.0}
    with pytest.raises(error, match=message):
        Track(**{**good, **change})


@pytest.mark.parametrize(
    ("name", "value"), [("heading_deg", 181.0), ("offset_sigma", 0.0), ("certain", 1.0), ("tail", 0.0)]
)
def test_bad_settings_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"{name} is {value}"):
        LocateSettings(**{name: value})  # type: ignore[arg-type]


def test_short_and_too_long_tracks_are_refused() -> None:
    with pytest.raises(DataError, match="7 points, expected at least 8"):
        Track(LINE[:7], LINE[:7], LINE[:7], 1.0)
    with pytest.raises(DataError, match="track reaches"):
        locate(Track(1e6 * LINE, 0.0 * LINE, LINE, 1.0), rough(21))


def test_a_map_that_is_mostly_void_is_searched_to_the_end() -> None:
    """Placements on voids fit nothing: they cost what voids cost, in the bound of their blocks too."""
    small = rough()
    track, lat, lon = flown(small, 1)
    values = np.full((400, 400), np.nan, dtype=np.float32)
    values[200:321, 150:271] = small.values
    a, _, west, _, e, north = small.transform
    wide = Map(values, (a, 0.0, west - 150 * a, 0.0, e, north - 200 * e), sigma=1.0)
    found = locate(track, wide)
    best = found.candidates[0]
    assert found.complete
    assert found.verdict == "found"
    assert np.hypot(*offset_m(lat[-1], lon[-1], best.lat_deg, best.lon_deg)) < 0.5 * CELL_M


@pytest.mark.parametrize("seed", [0, 1])
def test_real_land_anywhere_on_a_tile(shared_data: Path, seed: int) -> None:
    """15 km, altimeter 5 m, heading known to 2 degrees and lengths to 1 %: 1.4 million places for the middle alone."""
    tile = tn.open_map(shared_data / "srtm" / "N48E010.hgt", sigma=3.0)
    rng = np.random.default_rng(400 + seed)
    along = np.arange(0.0, 15_000.0, 60.0)
    bearing, turn = (0.4, 3.9)[seed], math.radians((-1.6, 1.1)[seed])
    lat, lon = shift((48.2, 48.8)[seed], 10.4, along * math.cos(bearing), along * math.sin(bearing))
    height = tile.sample(lat, lon) - 20.0 + 5.0 * rng.standard_normal(along.size)
    shown = along / (1.006, 0.992)[seed]
    track = Track(shown * math.cos(bearing - turn), shown * math.sin(bearing - turn), height, 5.0)
    found = locate(track, tile, LocateSettings(heading_deg=2.0, scale=0.01))
    best = found.candidates[0]
    assert found.verdict == "found"
    assert found.tail < 1e-3
    assert np.hypot(*offset_m(lat[-1], lon[-1], best.lat_deg, best.lon_deg)) < min(
        4.0 * best.sigma_m, 2.0 * tile.cell_m
    )
    assert best.heading_deg == pytest.approx(math.degrees(turn), abs=0.5)
    assert found.share < 0.01

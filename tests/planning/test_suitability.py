"""Suitability: the bound of each leg, laws of the grids, and what the statistics say of known ground."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from terranav.core.earth import shift
from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import Recording
from terranav.ins.grades import grade_named
from terranav.io.rasters import open_map
from terranav.kernels.suitability import joined, start
from terranav.maps.fields import gaussian_map, plane_map
from terranav.maps.map import Map
from terranav.planning.bound import bound
from terranav.planning.suitability import LegSettings, Suitability, suitability

WALKING = InsGrade(300.0, 0.5, 1.0, 0.01)
LEGS = LegSettings(distance_m=5000.0, headings=8)


@pytest.fixture(scope="module")
def hills() -> Map:
    return gaussian_map(np.random.default_rng(5), std=80.0, correlation_m=900.0, cell_m=90.0, cells=192, sigma=4.0)


@pytest.fixture(scope="module")
def found(hills: Map) -> Suitability:
    return suitability(hills, WALKING, LEGS)


def bound_m(chart: Map, found: Suitability, at: tuple[int, int, int], ins: InsGrade) -> float:
    """Largest 1-sigma that `bound` has at the end of a leg."""
    settings, (k, i, j) = found.settings, at
    heading = math.radians(found.headings_deg[k])
    t = np.arange(0.0, settings.distance_m / settings.speed_mps + 1e-9, 1.0 / settings.rate_hz)
    away = settings.speed_mps * t - (settings.distance_m if settings.anchor == "end" else 0.0)
    lat, lon = shift(found.lat_deg[i], found.lon_deg[j], away * math.cos(heading), away * math.sin(heading))
    places = {"lat_deg": lat, "lon_deg": lon, "true_lat_deg": lat, "true_lon_deg": lon}
    columns = {"time_s": t, **places, "alt_m": 0.0 * t, "terrain_m": chart.sample(lat, lon)}
    rec = Recording(columns, sigma={"terrain_m": settings.sensor_sigma})
    return math.sqrt(np.linalg.eigvalsh(bound(rec, chart, ins).cov_m2[-1])[-1])


def ratios(chart: Map, found: Suitability, ins: InsGrade, legs: int, seed: int) -> list[float]:
    flown = np.argwhere(np.isfinite(found.sigma_m))
    chosen = flown[np.random.default_rng(seed).choice(len(flown), legs, replace=False)]
    return [float(found.sigma_m[k, i, j]) / bound_m(chart, found, (k, i, j), ins) for k, i, j in chosen]


@pytest.mark.parametrize("anchor", ["end", "start"])
@pytest.mark.parametrize("ins", [WALKING, grade_named("tactical")], ids=["walking", "tactical"])
def test_is_the_bound_of_the_leg(hills: Map, ins: InsGrade, anchor: str) -> None:
    told = ratios(hills, suitability(hills, ins, replace(LEGS, anchor=anchor)), ins, 12, 1)
    assert np.median(told) == pytest.approx(1.0, abs=0.05)
    assert max(abs(ratio - 1.0) for ratio in told) < 0.25


def test_agrees_with_the_bound_on_a_real_map(shared_data: Path) -> None:
    file = shared_data / "srtm" / "N47E009.hgt"
    if not file.is_file():
        pytest.skip(f"{file.name} is not there")
    chart = open_map(file, kind="terrain", sigma=5.0).crop(47.3, 9.3, 47.6, 9.7)
    ins = grade_named("tactical")
    told = np.array(ratios(chart, suitability(chart, ins), ins, 10, 2))
    assert (np.abs(told - 1.0) < 0.25).sum() >= 9


def test_a_fast_sensor_is_not_overrated(hills: Map) -> None:
    """More readings than are followed count for what they are worth, or a little less."""
    fast = replace(LEGS, rate_hz=10.0, sensor_sigma=2.0)
    told = ratios(hills, suitability(hills, WALKING, fast), WALKING, 6, 4)
    assert min(told) > 0.9
    assert max(told) < 1.3


def test_a_window_is_the_same_whatever_stands_before_it(hills: Map, found: Suitability) -> None:
    """Legs end at the same places of a smaller map, whose lines are cut elsewhere."""
    _, west, north, east = hills.bounds_deg
    south_edge = found.lat_deg[23] - 0.5 * (found.lat_deg[0] - found.lat_deg[1])
    part = suitability(hills.crop(south_edge + 1e-7, west, north, east), WALKING, LEGS)
    rows = part.lat_deg.size
    shift_rows = np.abs(part.lat_deg[:, None] - found.lat_deg[None]).argmin(axis=1)
    assert np.ptp(np.diff(shift_rows)) <= 1
    both = part.sigma_m[0], found.sigma_m[0][shift_rows]  # due north, over nearly the same cells
    known = np.isfinite(both[0]) & np.isfinite(both[1])
    assert known.sum() > 0.2 * rows * part.lon_deg.size
    assert np.median(both[0][known] / both[1][known]) == pytest.approx(1.0, abs=0.03)


def test_edges_have_no_leg(found: Suitability) -> None:
    """A leg north of 5 km ends at least 5 km from the southern edge."""
    rows = round(LEGS.distance_m / found.block_m)
    north, south = found.sigma_m[0], found.sigma_m[4]
    assert np.isnan(north[-rows + 1 :]).all()
    assert np.isfinite(north[: -rows - 1]).all()
    assert np.isnan(south[: rows - 1]).all()
    assert np.isfinite(south[rows + 1 :]).all()


def test_a_void_takes_every_leg_over_it(hills: Map) -> None:
    values = hills.values.copy()
    values[90:94, 90:94] = np.nan
    holed = suitability(replace(hills, values=values), WALKING, LEGS)
    col = int(np.abs(holed.lon_deg - hills.centre_deg[1]).argmin()) - 1
    assert np.isnan(holed.sigma_m[0, 10:22, col]).all()
    assert np.isfinite(holed.sigma_m[0, 10:22, col + 4]).all()


def test_a_plane_fixes_along_its_slope_alone() -> None:
    """On a plane that falls north nothing is learned of east, whose variance grows as the INS's alone."""
    chart = plane_map(0.3, 0.0, cells=161, cell_m=90.0, sigma=1.0)
    ins = InsGrade(200.0, 0.0, 1.0)
    told = suitability(chart, ins, replace(LEGS, headings=4))
    for k in (0, 1):
        known = told.sigma_m[k][np.isfinite(told.sigma_m[k])]
        time_s = round(LEGS.distance_m / told.block_m) * told.block_m / LEGS.speed_mps
        np.testing.assert_allclose(known, math.sqrt(200.0**2 + time_s), rtol=1e-3)


def test_better_sensor_smaller_sigma(hills: Map, found: Suitability) -> None:
    better = suitability(hills, WALKING, replace(LEGS, sensor_sigma=1.0))
    known = np.isfinite(found.sigma_m)
    assert (better.sigma_m[known] <= found.sigma_m[known] * (1 + 1e-5)).all()
    assert (found.sigma_m[known] <= found.drms_m[known]).all()
    assert found.sigma_m[known].max() < WALKING.position_sigma_m * 2


def test_best_worst_and_median(found: Suitability) -> None:
    known = np.isfinite(found.best_m)
    with np.errstate(all="ignore"):
        middle = np.nanmedian(found.sigma_m[:, known].astype(np.float64), axis=0)
    np.testing.assert_allclose(found.median_m[known], middle, rtol=1e-6)
    assert (found.best_m[known] <= found.median_m[known]).all()
    assert (found.median_m[known] <= found.worst_m[known]).all()
    assert set(found.best_heading_deg[known]) <= set(found.headings_deg)
    share = found.share_within(float(np.median(found.median_m[known])))
    assert share["worst"] <= share["median"] <= share["best"]
    assert share["median"] == pytest.approx(0.5, abs=0.01)


def test_at_lies_between_blocks_and_headings(found: Suitability) -> None:
    lat, lon = float(found.lat_deg[20]), float(found.lon_deg[30])
    down, right = float(found.lat_deg[20] - found.lat_deg[21]), float(found.lon_deg[31] - found.lon_deg[30])
    logs = np.log(found.sigma_m.astype(np.float64))
    for k, heading in enumerate(found.headings_deg.tolist()):
        for turn, around in ((0.0, 0.0), (360.0, -360.0), (-360.0, 360.0)):
            assert found.at(lat, lon + around, heading + turn) == pytest.approx(found.sigma_m[k, 20, 30], rel=1e-5)
        nearby = logs[[k, (k + 1) % 8]][:, 20:22, 30:32]
        middle = math.exp(nearby.mean())
        assert found.at(lat - 0.5 * down, lon + 0.5 * right, heading + 22.5) == pytest.approx(middle, rel=1e-5)
    k, edge = 4, 0  # due south, along the northern edge: no leg there, but in the rows below
    row = int(np.flatnonzero(np.isfinite(found.sigma_m[k, :, 30]))[0])
    assert found.at(float(found.lat_deg[row]) + 0.4 * down, lon, 180.0) == pytest.approx(found.sigma_m[k, row, 30])
    assert math.isnan(found.at(float(found.lat_deg[edge]), lon, 180.0))
    assert math.isnan(found.at(float(found.lat_deg[0]) + 0.6 * down, lon, 0.0))
    assert math.isnan(found.at(lat, float(found.lon_deg[0]) - 0.6 * right, 0.0))
    a, _, west, _, e, north = found.transform
    assert west + 30.5 * a == pytest.approx(lon, abs=1e-9)
    assert north + 20.5 * e == pytest.approx(lat, abs=1e-9)


def test_statistics_of_known_ground(found: Suitability) -> None:
    """std 80 m and covariance exp(-(r/900)^2) mean an rms slope of 2 std / L = 0.178."""
    assert np.sqrt(np.nanmean(found.roughness.astype(np.float64) ** 2)) == pytest.approx(0.178, rel=0.1)
    assert np.nanmedian(found.correlation_m) == pytest.approx(900.0, rel=0.25)
    length = 2.0 * found.spread / found.roughness
    np.testing.assert_allclose(found.correlation_m, length, rtol=1e-5)
    assert 0.6 * 80.0 < np.sqrt(np.nanmean(found.spread.astype(np.float64) ** 2)) < 80.0  # patches of 2 km are smaller
    assert 2.0 < np.nanmedian(found.entropy_bits) < 7.0
    assert np.nanmax(found.self_similarity) <= 1.0 + 1e-6


def test_ground_that_repeats_is_self_similar() -> None:
    """Two-dimensional waves 8 blocks long look the same a wavelength on; hills do not."""
    chart = plane_map(0.0, 0.0, cells=160, cell_m=90.0)
    row, col = np.indices(chart.shape)
    waves = 50.0 * (np.sin(2 * np.pi * row / 20) + np.sin(2 * np.pi * col / 20))
    told = suitability(replace(chart, values=waves.astype(np.float32)), InsGrade(1000.0), LEGS)
    assert np.nanmin(told.self_similarity) > 0.98


def test_two_short_legs_are_one_long() -> None:
    """The star product against the information form of one linear system, by plain numpy."""
    rng = np.random.default_rng(3)

    def leg() -> list[np.ndarray]:
        root = rng.normal(size=(2, 4, 4))
        return [rng.normal(size=(4, 4)), root[0] @ root[0].T, root[1] @ root[1].T]

    def end(cov: np.ndarray, part: list[np.ndarray]) -> np.ndarray:
        a, c, j = part
        return np.asarray(a @ np.linalg.inv(np.linalg.inv(cov) + j) @ a.T + c)

    first, second, both = leg(), leg(), [np.empty((4, 4)) for _ in range(3)]
    joined(*first, *second, *both)
    np.testing.assert_allclose(end(np.eye(4), both), end(end(np.eye(4), first), second), rtol=1e-8)
    nothing, same = [np.empty((4, 4)) for _ in range(3)], [np.empty((4, 4)) for _ in range(3)]
    start(*nothing)
    joined(*nothing, *first, *same)
    for one, other in zip(same, first, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("sensor_sigma", 0.0),
        ("rate_hz", -1.0),
        ("speed_mps", math.nan),
        ("distance_m", 0.0),
        ("headings", 0),
        ("headings", 2.5),
        ("block", True),
        ("readings_a_cell", 0),
        ("anchor", "middle"),
    ],
)
def test_settings_out_of_range(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=key):
        LegSettings(**{key: value})  # type: ignore[arg-type]


def test_too_small_a_map_and_too_long_a_leg(hills: Map) -> None:
    with pytest.raises(DataError, match="blocks of 150 cells"):
        suitability(hills, WALKING, replace(LEGS, block=150))
    with pytest.raises(ConfigError, match="distance_m"):
        suitability(hills, WALKING, replace(LEGS, distance_m=1e9))


def test_a_leg_longer_than_the_map_is_nowhere(hills: Map) -> None:
    told = suitability(hills, WALKING, replace(LEGS, distance_m=1e6, headings=2))
    assert np.isnan(told.sigma_m).all()
    assert math.isnan(told.share_within(50.0)["best"])

"""Maps in pieces: parts, means of cells, other datums, and GeoTIFFs written without all of it in memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

import terranav as tn
from terranav.core.errors import DataError
from terranav.io import thinning
from terranav.io.raster_out import write_map
from terranav.io.thinning import Part, converted, open_part, part_of, thinned
from terranav.maps.datum import convert
from terranav.maps.geoid import Geoid
from terranav.maps.map import Map
from terranav.maps.mosaic import Mosaic

CELL = 0.001
LAND = (900.0 + np.cumsum(np.random.default_rng(5).normal(0.0, 2.0, (300, 400)), axis=1)).astype(np.float32)
LAND[20:60, 30:90] = np.nan
CHART = Map(LAND, (CELL, 0.0, 10.0, 0.0, -CELL, 47.0), datum="EGM96", name="land")
GEOID = Geoid.from_values(40.0 + np.indices((20, 20))[1] * 0.3, (0.1, 0.0, 9.0, 0.0, -0.1, 48.0), "EGM96")
BOX = (46.8, 10.1, 46.9, 10.3)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The land in four tiles."""
    (tmp_path / "tiles").mkdir()
    for name, rows, cols in (("a", (0, 150), (0, 210)), ("b", (0, 150), (210, 400)), ("c", (150, 300), (0, 400))):
        part = Part(CHART, (rows, cols))
        write_map(part, tmp_path / "tiles" / f"{name}.tif")
    return tmp_path / "tiles"


@pytest.fixture
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "PIECE", 64)
    monkeypatch.setattr(Part.pieces, "__defaults__", (64, 64))


def means(values: np.ndarray, down: int, across: int) -> np.ndarray:
    """Cell by cell, the slow way."""
    rows, cols = -(-values.shape[0] // down), -(-values.shape[1] // across)
    out = np.full((rows, cols), np.nan)
    for i in range(rows):
        for j in range(cols):
            block = values[i * down : (i + 1) * down, j * across : (j + 1) * across].astype(np.float64)
            if np.isfinite(block).any():
                out[i, j] = block[np.isfinite(block)].mean()
    return out


@pytest.mark.usefixtures("small_pieces")
@pytest.mark.parametrize("longest", [25, 37, 90, 150])
def test_thinned_cells_are_means_of_known_cells_at_their_places(longest: int) -> None:
    chart, (down, across) = thinned(part_of(CHART), longest)
    assert (down, across) == (300 // longest, 400 // longest)
    assert chart.shape == (round(300 / down), round(400 / across))
    np.testing.assert_allclose(chart.values, means(LAND, down, across)[: chart.shape[0], : chart.shape[1]], rtol=1e-6)
    row, col = chart.cells(47.0 - CELL * (3.5 * down), 10.0 + CELL * (5.5 * across))
    np.testing.assert_allclose((row, col), (3.0, 5.0), atol=1e-9)
    assert (chart.name, chart.datum) == ("land", "EGM96")


def test_a_small_map_is_not_thinned() -> None:
    chart, of = thinned(part_of(CHART), 201)
    assert of == (1, 1)
    assert chart is CHART


def test_a_map_of_one_value_and_a_void_one() -> None:
    lone = np.full((40, 40), np.nan)
    lone[33, 7] = 5.0
    chart, _ = thinned(part_of(Map(lone, CHART.transform)), 10)
    assert np.isfinite(chart.values).sum() == 1
    assert chart.values[8, 1] == 5.0
    with pytest.raises(DataError, match="every cell of the map is void"):
        thinned(Part(Map(lone, CHART.transform, name="m"), ((0, 30), (0, 40))), 10)


@pytest.mark.usefixtures("small_pieces")
def test_a_mosaic_in_pieces_is_the_map_it_was_cut_from(folder: Path, tmp_path: Path) -> None:
    part = open_part(folder)
    assert isinstance(part.chart, Mosaic)
    np.testing.assert_array_equal(thinned(part, 50)[0].values, thinned(part_of(CHART), 50)[0].values)
    write_map(part, tmp_path / "whole.tif")
    again = tn.open_map(tmp_path / "whole.tif")
    np.testing.assert_array_equal(again.values, LAND)
    np.testing.assert_allclose(again.transform, CHART.transform, atol=1e-12)
    with rasterio.open(tmp_path / "whole.tif") as raster:
        assert raster.profile["tiled"]


@pytest.mark.parametrize("large", [False, True])
def test_a_box_is_what_crop_cuts_out(folder: Path, monkeypatch: pytest.MonkeyPatch, large: bool) -> None:
    if large:
        monkeypatch.setattr(thinning, "LARGE_CELLS", 100)
        monkeypatch.setattr("terranav.io.rasters.LARGE_CELLS", 100)
    cut = CHART.crop(*BOX)
    for path in (folder, next(folder.glob("c.tif"))):
        box = BOX if path is folder else (46.72, 10.1, 46.8, 10.3)
        cut = CHART.crop(*box)
        part = open_part(path, box)
        assert part.shape == cut.shape
        assert part.is_large is large
        np.testing.assert_array_equal(part.whole().values, cut.values)
        np.testing.assert_allclose(part.place.transform, cut.transform, atol=1e-12)
        told, own = part.info(), cut.info()
        for key in ("rows", "cols", "kind", "datum"):
            assert told[key] == own[key]
        assert told["mean"] == pytest.approx(own["mean"], abs=0.5 if large else 1e-3)
        assert told["extent_deg"] == pytest.approx(own["extent_deg"])


def test_a_box_across_the_seam_of_a_mosaic_around_the_earth(tmp_path: Path) -> None:
    values = np.random.default_rng(2).uniform(0.0, 90.0, (40, 360)).astype(np.float32)
    for k in range(2):
        west = -180.0 + 180.0 * k
        write_map(Map(values[:, 180 * k : 180 * k + 180], (1.0, 0.0, west, 0.0, -1.0, 20.0)), tmp_path / f"{k}.tif")
    part = open_part(tmp_path, (-5.0, 170.0, 5.0, -170.0))
    np.testing.assert_array_equal(part.whole().values, part.chart.crop(-5.0, 170.0, 5.0, -170.0).values)
    np.testing.assert_array_equal(part.whole().values, np.roll(values, 180, axis=1)[14:26, 169:191])


@pytest.mark.usefixtures("small_pieces")
def test_heights_go_over_to_another_datum_piece_by_piece(folder: Path, tmp_path: Path) -> None:
    part = converted(open_part(folder), "ellipsoid", GEOID)
    assert part.datum == "ellipsoid"
    write_map(part, tmp_path / "high.tif")
    again, whole = tn.open_map(tmp_path / "high.tif"), convert(CHART, "ellipsoid", GEOID)
    np.testing.assert_allclose(again.values, whole.values, atol=1e-4)
    assert again.datum == "ellipsoid"
    assert part.info()["mean"] == pytest.approx(whole.info()["mean"], abs=1e-3)
    np.testing.assert_allclose(thinned(part, 30)[0].values, thinned(part_of(whole), 30)[0].values, atol=1e-3)


def test_a_geoid_that_ends_within_the_map_is_named_and_nothing_is_left(folder: Path, tmp_path: Path) -> None:
    short = Geoid.from_values(np.full((4, 4), 40.0), (0.1, 0.0, 9.9, 0.0, -0.1, 47.2), "EGM96", "short.gtx")
    with pytest.raises(DataError, match=r"^short\.gtx: no geoid height at 46\.\d+ N"):
        write_map(converted(open_part(folder), "ellipsoid", short), tmp_path / "x.tif")
    assert [file.name for file in tmp_path.iterdir()] == ["tiles"]
    with pytest.raises(DataError, match=r"void, expected values"):
        write_map(Part(CHART, ((25, 40), (40, 80))), tmp_path / "x.tif")

"""terranav map view, convert and fetch: what they write, what they say, and one line for every bad input."""

from __future__ import annotations

import base64
import json
import re
import threading
import zipfile
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import LightSource

import terranav as tn
from terranav.app.cli import main
from terranav.app.mapping import map_words, meridian, parallel
from terranav.app.mapview import map_page, map_picture, map_png, pack, relief, view_of
from terranav.app.polar import Polar
from terranav.app.trackmap import hillshade
from terranav.io.raster_out import write_map
from terranav.maps.map import Map

ROWS, COLS = 40, 60
HEIGHTS = np.random.default_rng(4).normal(0.0, 30.0, (ROWS, COLS)).cumsum(0).cumsum(1).round() / 10 + 700.0
HEIGHTS[10:14, 20:26] = np.nan
CHART = Map(HEIGHTS, (0.01, 0.0, 9.995, 0.0, -0.01, 46.005))


@pytest.fixture
def tif(tmp_path: Path) -> Path:
    write_map(CHART, tmp_path / "hills.tif")
    return tmp_path / "hills.tif"


def answered(capsys: pytest.CaptureFixture[str], *arguments: object) -> Any:
    assert main([str(argument) for argument in arguments]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    return line


def decoded(page: str) -> tuple[np.ndarray[Any, Any], dict[str, Any]]:
    """The heights in a page, and the rest of its data."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found
    data = json.loads(found[1])
    codes = np.frombuffer(base64.b64decode(data["heights"]), "<u2").reshape(data["rows"], data["cols"])
    return np.where(codes == 0, np.nan, data["base"] + data["step"] * (codes - 1.0)), data


# -- view -------------------------------------------------------------------------------------------------------------


def test_view_writes_a_picture_and_a_page(tif: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tif.with_name("look.png")
    facts = answered(capsys, "map", "view", tif, "--out", out, "--page", "--json")
    assert facts["files"] == [str(out), str(out.with_suffix(".html"))]
    assert facts["note"] is None
    assert out.read_bytes().startswith(b"\x89PNG")
    page = out.with_suffix(".html").read_text(encoding="utf-8")
    values, data = decoded(page)
    np.testing.assert_allclose(values, CHART.values, atol=0.51 * data["step"], equal_nan=True)
    np.testing.assert_allclose(data["box"], [45.605, 9.995, 46.005, 10.595])


def test_the_page_asks_for_nothing_and_holds_no_foreign_markup() -> None:
    chart = Map(HEIGHTS, CHART.transform, name="</script><b>&")
    page = map_page(chart, view_of(chart))
    assert "</script><b>" not in page
    assert "default-src 'none'" in page
    assert not re.search(r"(?:src|href)=\"(?!data:)", page)
    assert not re.search(r"https?://|fetch\(|XMLHttpRequest|\bimport\b", page)


def test_view_says_in_words_what_it_did(
    tif: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tif.parent)
    assert main(["map", "view", tif.name, "--box", "45.7,10.1,45.9,10.4"]) == 0
    out = capsys.readouterr().out
    assert "written to hills.png" in out
    assert "21 x 31 cells" in out
    assert not (tif.parent / "hills.html").exists()


def test_a_large_map_is_thinned_with_a_note() -> None:
    view = view_of(CHART, longest=35)
    assert view.values.shape == (35, 35)
    assert view.thinned
    assert "thinned to 35 x 35" in view.note
    lat, lon = 46.0 - 0.39 * 7 / 34, 10.0 + 0.59 * 5 / 34
    np.testing.assert_allclose(view.values[7, 5], CHART.sample(lat, lon))
    assert view_of(CHART).note == ""


def test_a_larger_map_is_thinned_to_means_that_are_lit_as_what_they_are() -> None:
    rng = np.random.default_rng(6)
    slope = 5.0 * np.arange(400.0)[:, None] + 2.0 * np.arange(300.0)[None, :]
    chart = Map(slope + rng.normal(0.0, 30.0, slope.shape), (0.001, 0.0, 9.9995, 0.0, -0.001, 46.0005), name="hill")
    view = view_of(chart, longest=20)
    assert view.means_of == (20, 15)
    assert "thinned to 20 x 20 samples of means of 20 x 15 cells" in view.note
    np.testing.assert_allclose(view.box, [45.6005, 9.9995, 46.0005, 10.2995], atol=1e-9)
    np.testing.assert_allclose(view.values, slope.reshape(20, 20, 20, 15).mean(axis=(1, 3)), atol=9.0)
    title = map_picture(chart, view).axes[0].get_title(loc="left")
    assert title.startswith("hill\n400 x 300 cells of 93 m")
    means = np.asarray(chart.values, dtype=np.float64).reshape(20, 20, 20, 15).mean(axis=(1, 3))
    coarse = view_of(Map(means, (0.015, 0.0, 9.9995, 0.0, -0.02, 46.0005)))
    np.testing.assert_allclose(relief(view, "terrain"), relief(coarse, "terrain"), atol=1e-4)


def test_a_projected_map_is_said_to_be_resampled() -> None:
    chart = Map(HEIGHTS, (100.0, 0.0, 700_000.0, 0.0, -100.0, 5_200_000.0), "EPSG:32633")
    view = view_of(chart)
    assert "resampled" in view.note
    np.testing.assert_allclose(np.nanmean(view.values), np.nanmean(HEIGHTS), atol=5.0)


@pytest.mark.parametrize(
    ("shape", "transform", "crs"),
    [
        ((2, 2), (1.0, 0.0, 9.0, 0.0, -1.0, 46.0), "EPSG:4326"),
        ((3, 400), (0.01, 0.0, 9.0, 0.0, -0.01, 46.0), "EPSG:4326"),
        ((400, 3), (0.01, 0.0, 9.0, 0.0, -0.01, 46.0), "EPSG:4326"),
        ((90, 180), (2.0, 0.0, -180.0, 0.0, -2.0, 90.0), "EPSG:4326"),
        ((50, 60), (0.01, 0.0, 179.7, 0.0, 0.01, -17.0), "EPSG:4326"),  # across the antimeridian, south up
        ((80, 80), (2e4, 0.0, -8e5, 0.0, -2e4, 8e5), "EPSG:3413"),  # with the pole
        ((80, 80), (1e5, 0.0, -4e6, 0.0, -1e5, 4e6), "+proj=ortho +lat_0=47 +lon_0=9"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_maps_of_any_shape_and_place_are_drawn(
    shape: tuple[int, int], transform: tuple[float, float, float, float, float, float], crs: str
) -> None:
    chart = Map(np.random.default_rng(1).uniform(0.0, 100.0, shape), transform, crs)
    view = view_of(chart)
    assert np.isfinite(view.values).any()
    assert map_png(chart, view).startswith(b"\x89PNG")
    values, _ = decoded(map_page(chart, view))
    np.testing.assert_array_equal(np.isnan(values), np.isnan(view.values))


def test_relief_is_transparent_where_void_and_casts_no_shade_from_there() -> None:
    flat = np.full((20, 20), 250.0)
    flat[5:9, 5:9] = np.nan
    flat[0, 0] = 300.0
    picture = relief(view_of(Map(flat, CHART.transform)), "terrain")
    np.testing.assert_array_equal(picture[..., 3] == 0, np.isnan(flat))
    np.testing.assert_allclose(picture[4, 5:9], picture[15, 5:9])
    assert ((picture >= 0) & (picture <= 1)).all()


@pytest.mark.parametrize(
    ("values", "error"),
    [
        ([[1.0, -400.0], [np.nan, 8848.0]], 0.0),  # whole numbers stay exact
        ([[0.25, 0.75], [0.5, np.nan]], 0.5 / 65534),
        ([[7.5, 7.5], [7.5, 7.5]], 0.0),
        ([[np.nan, np.nan], [np.nan, np.nan]], 0.0),
        ([[-1e5, 1e5], [0.0, 1.0]], 2e5 / 65534),
    ],
)
def test_heights_in_two_bytes(values: list[list[float]], error: float) -> None:
    given = np.array(values)
    codes, base, step = pack(given)
    code = np.frombuffer(codes, "<u2").reshape(given.shape)
    np.testing.assert_allclose(np.where(code == 0, np.nan, base + step * (code - 1.0)), given, atol=error, rtol=0)


def test_longitudes_are_from_180_west_to_180_east() -> None:
    said = [meridian(lon, 2) for lon in (179.5, 180.0, 180.25, -180.0, 359.75, 360.0, -0.001, 10.0)]
    assert said == ["179.50° E", "180.00°", "179.75° W", "180.00°", "0.25° W", "0.00°", "0.00°", "10.00° E"]
    assert [parallel(lat, 1) for lat in (-16.5, 0.01, 89.96)] == ["16.5° S", "0.0°", "90.0° N"]
    chart = Map(HEIGHTS, (0.01, 0.0, 179.7, 0.0, -0.01, -16.0))
    picture = map_picture(chart, view_of(chart))
    labels = [text.get_text() for text in picture.axes[0].get_xticklabels()]
    assert {text[-1] for text in labels} == {"E", "W", "°"}
    assert not any(float(text.rstrip("°EW ")) > 180.0 for text in labels)


@pytest.mark.parametrize(("pole", "turn"), [(90.0, 0.0), (-90.0, 0.0), (90.0, -45.0), (-90.0, 170.0)])
def test_the_plane_around_a_pole(pole: float, turn: float) -> None:
    polar = Polar(pole, turn)
    rng = np.random.default_rng(8)
    lat, lon = polar.sign * rng.uniform(60.0, 90.0, 200), rng.uniform(-180.0, 180.0, 200)
    x, y = polar.plane(lat, lon)
    back = polar.earth(x, y)
    np.testing.assert_allclose(back[0], lat, atol=1e-9)
    np.testing.assert_allclose((back[1] - lon + 180.0) % 360.0 - 180.0, 0.0, atol=1e-6)
    x, y = polar.plane(0.5 * pole, [turn, turn + 90.0])
    np.testing.assert_allclose(x, [0.0, 45.0], atol=1e-9)  # east is to the right along the longitude it is turned to
    np.testing.assert_allclose(y, [-45.0 * polar.sign, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("transform", "crs", "turn"),
    [
        ((1000.0, 0.0, -3e4, 0.0, -1000.0, 2e4), "EPSG:3413", -45.0),  # the pole within
        ((1000.0, 0.0, -3e4, 0.0, -1000.0, 2e4), "EPSG:3031", 0.0),
        ((1000.0, 0.0, -3e4, 0.0, -1000.0, -1e4), "EPSG:3413", -45.0),  # beside it
        ((6.0, 0.0, -180.0, 0.0, -0.5, 90.0), "EPSG:4326", 0.0),  # all meridians, 70 to 90 N
    ],
)
def test_a_map_at_a_pole_is_drawn_around_it(
    transform: tuple[float, float, float, float, float, float], crs: str, turn: float
) -> None:
    chart = Map(HEIGHTS, transform, crs)
    view = view_of(chart)
    assert view.polar is not None
    assert view.polar.turn_deg == pytest.approx(turn, abs=1.0)
    assert "plane around the pole" in view.note
    low, left, high, right = view.box
    rows, cols = view.values.shape
    x, y = left + (7 + 0.5) * (right - left) / cols, high - (11 + 0.5) * (high - low) / rows
    np.testing.assert_allclose(view.values[11, 7], chart.sample(*view.polar.earth(x, y)))
    assert np.isfinite(view.values).mean() > 0.7
    names = {text.get_text() for text in map_picture(chart, view).axes[0].texts}
    assert any(re.fullmatch(r"\d+(\.\d+)?° [NS]", name) for name in names)
    assert any(re.fullmatch(r"\d+° [EW]|0°|180°", name) for name in names)
    assert any(name.endswith("km") for name in names)
    _, data = decoded(map_page(chart, view))
    assert (data["pole"], data["turn"]) == (view.polar.sign, view.polar.turn_deg)


@pytest.mark.parametrize(
    ("transform", "crs"),
    [
        ((2.0, 0.0, -180.0, 0.0, -2.0, 80.0), "EPSG:4326"),  # most of the Earth
        ((0.01, 0.0, 20.0, 0.0, -0.01, 80.0), "EPSG:4326"),  # narrow, far north
        ((1000.0, 0.0, 3e5, 0.0, -1000.0, -2.5e6), "EPSG:3413"),  # Greenland's south
    ],
)
def test_other_maps_are_drawn_on_latitude_and_longitude(
    transform: tuple[float, float, float, float, float, float], crs: str
) -> None:
    assert view_of(Map(HEIGHTS, transform, crs)).polar is None


def test_lowlands_beside_mountains_show_their_relief() -> None:
    rng = np.random.default_rng(3)
    land = np.concatenate([rng.normal(0.0, 1.0, (60, 120)), rng.normal(0.0, 60.0, (60, 40))], axis=1)
    steep = np.sqrt(np.mean(np.square(np.gradient(land, 100.0)).sum(axis=0)))
    by_the_mountains = LightSource(315, 45).hillshade(land, vert_exag=0.35 / steep, dx=100.0, dy=100.0)
    light = hillshade(land, 100.0, 100.0)
    assert light[:, 5:115].std() > 1.4 * by_the_mountains[:, 5:115].std()
    level = np.zeros((50, 50))
    level[20, 20] = 1000.0
    assert np.isfinite(hillshade(level, 100.0, 100.0)).all()


# -- info -------------------------------------------------------------------------------------------------------------


def test_info_in_words_a_user_understands(tif: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "info", str(tif)]) == 0
    said = dict(line.split(None, 1) for line in capsys.readouterr().out.splitlines())
    facts = answered(capsys, "map", "info", tif, "--json")
    assert said["map"] == "hills.tif: terrain [m], sigma 3 m"
    assert said["grid"] == "40 x 60 cells of 930 m, EPSG:4326"
    assert said["extent"] == "45.6100° N to 46.0000° N, 10.0000° E to 10.5900° E"
    assert said["values"].startswith(f"{facts['min']:g} to {facts['max']:g} m, mean ")
    assert re.fullmatch(r"[\d.]+ m from cell to cell, [\d.]+ m in all", said["roughness"])
    assert said["voids"] == "24 cells (1.0 %) without a value"
    assert (said["datum"], said["suspicious"]) == ("not stated", "nothing")
    assert facts["voids"] == 24
    assert facts["suspicious"] == []


def test_depths_that_are_positive_are_turned_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_map(Map(HEIGHTS, CHART.transform), tmp_path / "depths.tif")
    asked = (tmp_path / "depths.tif", "--kind", "bathymetry")
    before = answered(capsys, "map", "info", *asked, "--json")
    assert "are these positive depths?" in before["suspicious"][0]
    turned = answered(capsys, "map", "info", *asked, "--positive-down", "--json")
    assert (turned["min"], turned["max"], turned["suspicious"]) == (-before["max"], -before["min"], [])
    answered(capsys, "map", "convert", asked[0], tmp_path / "sea.nc", *asked[1:], "--positive-down", "--json")
    np.testing.assert_array_equal(tn.open_map(tmp_path / "sea.nc", kind="bathymetry").values, -CHART.values)
    seen = answered(capsys, "map", "view", *asked, "--positive-down", "--out", tmp_path / "sea.png", "--page", "--json")
    assert seen["max"] == turned["max"]
    values, _ = decoded((tmp_path / "sea.html").read_text(encoding="utf-8"))
    assert np.nanmax(values) == pytest.approx(turned["max"], abs=1e-3)


@pytest.mark.parametrize(
    ("chart", "said"),
    [
        (Map(HEIGHTS, CHART.transform, "EPSG:32633"), "cells of 10 mm in EPSG:32633: are the coordinates degrees"),
        (Map(HEIGHTS, (100.0, 0.0, 5e5, 0.0, -100.0, 5e6)), "are the coordinates metres of another CRS?"),
        (
            Map(np.where(HEIGHTS > 700.0, HEIGHTS, 0.0), CHART.transform),
            "% of the values are exactly 0 m: sea, or voids",
        ),
        (Map(HEIGHTS, CHART.transform, sigma=900.0), "less than the map's sigma"),
        (Map(np.full((4, 4), 7.0), CHART.transform), "every value is 7 m"),
        (Map(HEIGHTS * 30.0, CHART.transform), "are they in feet?"),
    ],
)
def test_what_is_suspicious_is_said(chart: Map, said: str) -> None:
    facts = chart.info()
    assert [text for text in facts["suspicious"] if said in text]
    assert [text for key, text in map_words(facts) if key == "suspicious"] == facts["suspicious"]


def test_words_for_all_longitudes_and_across_180() -> None:
    polar = Map(HEIGHTS[:40, :40], (2e4, 0.0, -4e5, 0.0, -2e4, 4e5), "EPSG:3413")
    assert dict(map_words(polar.info()))["extent"].endswith(" to 90.0000° N, all longitudes")
    fiji = Map(HEIGHTS, (0.01, 0.0, 179.7, 0.0, -0.01, -16.0))
    assert dict(map_words(fiji.info()))["extent"].endswith("179.7050° E to 179.7050° W")


# -- convert ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".tif", ".nc"])
def test_convert_keeps_values_and_places(tif: Path, capsys: pytest.CaptureFixture[str], suffix: str) -> None:
    out = tif.with_name(f"out{suffix}")
    facts = answered(capsys, "map", "convert", tif, out, "--box", "45.7,10.1,45.9,10.4", "--json")
    assert facts["file"] == str(out)
    part, again = tn.open_map(tif, box=(45.7, 10.1, 45.9, 10.4)), tn.open_map(out)
    np.testing.assert_array_equal(again.values, part.values)
    np.testing.assert_allclose(again.transform, part.transform, rtol=1e-12)


def test_convert_turns_into_the_unit_of_the_kind(tif: Path, capsys: pytest.CaptureFixture[str]) -> None:
    feet = tif.with_name("feet.asc")
    feet.write_text("ncols 2\nnrows 2\nxllcorner 9\nyllcorner 46\ncellsize 0.5\n1000 2000\n3000 4000\n")
    out = tif.with_name("metres.nc")
    assert main(["map", "convert", str(feet), str(out), "--unit", "ft", "--crs", "EPSG:4326"]) == 0
    assert f"written to {out}" in capsys.readouterr().out.replace("\n", "")
    np.testing.assert_allclose(tn.open_map(out).values, np.array([[1000, 2000], [3000, 4000]]) * 0.3048, rtol=1e-6)


def test_convert_never_overwrites_unless_told_to(tif: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = tif.read_bytes()
    assert "is there already, expected a new name or --force" in refused(capsys, "map", "convert", tif, tif)
    assert tif.read_bytes() == before
    assert main(["map", "convert", str(tif), str(tif), "--box", "45.7,10.1,45.9,10.4", "--force"]) == 0
    assert tn.open_map(tif).shape == (21, 31)


# -- fetch ------------------------------------------------------------------------------------------------------------


def test_fetch_from_a_server(tif: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    site, cache = tmp_path / "site", tmp_path / "cache"
    site.mkdir()
    (site / "n45_e010.tif").write_bytes(tif.read_bytes())

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(site))) as http:
        thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        template = f"http://127.0.0.1:{http.server_address[1]}/{{ns}}{{lat02}}_{{ew}}{{lon03}}.tif"
        asked = ("map", "fetch", "--template", template, "--box", "45.2,10.2,46.5,10.7", "--cache", cache)
        facts = answered(capsys, *asked, "--json")
        assert main([str(part) for part in asked]) == 0
        said = capsys.readouterr().out
        missed = refused(capsys, *asked[:4], "--box", "1,2,3,4", "--cache", cache)
        http.shutdown()
        thread.join()
    assert facts["counts"] == {"fetched": 1, "missing": 1}
    assert [tile["state"] for tile in facts["tiles"]] == ["fetched", "missing"]
    assert facts["bytes"] == tif.stat().st_size
    assert "2: 1 cached, 1 missing" in said
    assert "no such    n46_e010.tif" in said
    assert "none of the 4 tiles exists" in missed
    np.testing.assert_array_equal(tn.open_map(cache / "n45_e010.tif").values, CHART.values)


# -- bad input --------------------------------------------------------------------------------------------------------

URL = "http://127.0.0.1:1/{lat}_{lon}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("view", "none.tif"), "no such file"),
        (("view", "TIF", "--out", "map.jpg"), "ends in .png"),
        (("view", "TIF", "--box", "1,2,3"), "expected S,W,N,E"),
        (("view", "TIF", "--box", "1,2,3,nan"), "expected S,W,N,E"),
        (("view", "TIF", "--box", "1,2,3,4"), "misses the map"),
        (("view", "TIF", "--kind", "terain"), "did you mean 'terrain'"),
        (("info", "none.tif"), "no such file"),
        (("info",), "Missing argument 'FILE'"),
        (("info", "TIF", "--kind", "seabed"), "unknown map kind 'seabed'"),
        (("info", "TIF", "--sigma", "-1"), "map sigma is -1.0"),
        (("info", "TIF", "--sigma", "three"), "'--sigma'"),
        (("info", "TIF", "--unit", "parsec"), "unknown unit of a terrain map 'parsec'"),
        (("info", "TIF", "--crs", "EPSG:999999"), "unknown crs 'EPSG:999999'"),
        (("info", "TIF", "--variable", "7"), "no band '7'; bands in it: 1"),
        (("info", "TIF", "--depth"), "--depth"),
        (("info", "TIF", "TIF"), "unexpected extra argument"),
        (("view", "TIF", "--out", "none/map.png"), "is not a folder"),
        (("convert", "TIF", "map.jpg"), "the suffix is '.jpg', expected one of .tif"),
        (("convert", "TIF", "N45E010.hgt"), "40 x 60 cells, expected 1201 x 1201"),
        (("convert", "TIF", "none/map.tif"), "is not a folder"),
        (("convert", "TIF", "map.nc", "--box", "46,10,46,11"), "has no area"),
        (("fetch", "--template", URL, "--box", "46,10,45,11", "--cache", "c"), "has no area"),
        (("fetch", "--template", URL, "--box", "46,10,47,10", "--cache", "c"), "has no area"),
        (("fetch", "--template", "http://x.y/{lat}_{lng}", "--box", "46,10,47,11", "--cache", "c"), "unknown field"),
        (("fetch", "--template", URL, "--box", "46,10,47,11", "--cache", "TIF"), "cache cannot be written"),
        (("fetch", "--template", URL, "--box", "46,10,47,11", "--cache", "c", "--attempts", "1"), "no connection"),
        (("fetch", "--template", URL, "--box", "46,10,47,11"), "--cache"),
    ],
)
def test_bad_input_is_one_line(
    arguments: tuple[str, ...],
    message: str,
    tif: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tif.parent)
    given = [str(tif) if part == "TIF" else part for part in arguments]
    assert message in refused(capsys, "map", *given)
    assert {file.name for file in tif.parent.iterdir()} <= {tif.name, "c"}


# -- datums -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def geoid(tmp_path: Path) -> Path:
    """A geoid 48 m above the ellipsoid in a file whose name does not say which it is."""
    heights = np.full((30, 30), 48.0) + 0.1 * np.arange(30.0)
    write_map(Map(heights, (0.1, 0.0, 9.0, 0.0, -0.1, 47.5)), tmp_path / "undulations.tif")
    return tmp_path / "undulations.tif"


@pytest.mark.parametrize("suffix", [".tif", ".nc"])
def test_convert_brings_heights_to_another_datum(
    tif: Path, geoid: Path, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    out = tif.with_name(f"high{suffix}")
    asked = ("--map-datum", "EGM96", "--datum", "ellipsoid", "--geoid", f"EGM96={geoid}")
    facts = answered(capsys, "map", "convert", tif, out, *asked, "--json")
    assert facts["datum"] == "ellipsoid"
    high = tn.open_map(out)
    assert high.datum == "ellipsoid"
    lat, lon = 45.8, 10.3
    rise = 48.0 + 0.1 * ((lon - 9.0) / 0.1 - 0.5)
    assert float(high.sample(lat, lon)) == pytest.approx(float(CHART.sample(lat, lon)) + rise, abs=1e-3)
    assert answered(capsys, "map", "info", tif, "--map-datum", "EPSG:3855", "--json")["datum"] == "EGM2008"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--datum", "ellipsoid"), "the map's vertical datum is unknown"),
        (("--map-datum", "EGM97"), "map datum is 'EGM97' (did you mean 'EGM96'?)"),
        (("--map-datum", "EGM96", "--datum", "EGM97"), "datum is 'EGM97'"),
        (("--map-datum", "EGM96", "--datum", "unknown"), "expected the vertical datum that the map shall have"),
        (("--map-datum", "EGM96", "--datum", "MLLW"), "differ by the tide"),
        (("--datum", "ellipsoid", "--geoid", "none.gtx"), "none.gtx: no such file, expected a geoid grid"),
        (("--datum", "ellipsoid", "--geoid", "GEOID"), "expected datum= (--geoid EGM2008=FILE)"),
        (("--datum", "ellipsoid", "--geoid", "EGM97=GEOID"), "datum is 'EGM97'"),
        (("--map-datum", "EGM96", "--datum", "ellipsoid", "--geoid", "EGM96=TIF"), "but geoid heights stay within 120"),
        (("--kind", "gravity", "--unit", "mGal", "--datum", "ellipsoid"), "a gravity map has no vertical datum"),
    ],
)
def test_datums_that_do_not_go_together_are_one_line(
    arguments: tuple[str, ...], message: str, tif: Path, geoid: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [part.replace("TIF", str(tif)).replace("GEOID", str(geoid)) for part in arguments]
    assert message in refused(capsys, "map", "convert", tif, tif.with_name("x.tif"), *given)
    assert not tif.with_name("x.tif").exists()


def test_a_zipped_tile_is_a_map(tmp_path: Path, shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = shared_data / "srtm" / "N47E009.hgt"
    with zipfile.ZipFile(tmp_path / "N47E009.hgt.zip", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.write(whole, whole.name)
    for path in (tmp_path, tmp_path / "N47E009.hgt.zip"):
        facts, own = (answered(capsys, "map", "info", each, "--json") for each in (path, whole))
        assert {key: facts[key] for key in ("rows", "voids", "mean", "datum")} == {
            key: own[key] for key in ("rows", "voids", "mean", "datum")
        }


def test_the_word_sample_is_the_embedded_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert answered(capsys, "map", "info", "sample", "--json")["checksum"] == tn.sample_map().checksum
    answered(capsys, "map", "convert", "sample", "part.tif", "--box", "36.5,-84.4,36.6,-84.3", "--json")
    np.testing.assert_array_equal(tn.open_map("part.tif").values, tn.sample_map().crop(36.5, -84.4, 36.6, -84.3).values)
    for given in (("--sigma", "2"), ("--map-datum", "EGM96"), ("--positive-down",), ("--kind", "bathymetry")):
        assert f"{given[0]} is given for the embedded map" in refused(capsys, "map", "info", "sample", *given)

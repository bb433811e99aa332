"""Vertical datums: the words of files, what lies between two, maps converted, and refusals in one line."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.errors import ConfigError, DataError, DataWarning
from terranav.maps.datum import (
    Find,
    Geoid,
    Shift,
    agreed_datum,
    between,
    convert,
    split_crs,
    stated_datum,
    vertical_datum,
)
from terranav.maps.georeference import Window
from terranav.maps.map import Map

STEP = 0.25


def a_geoid(datum: str, level: float = 0.0, shape: tuple[int, int] = (41, 61), west: float = 5.0) -> Geoid:
    """A smooth geoid over 40..50 N, 5..20 E."""
    rows, cols = shape
    lat, lon = 50.0 - STEP * np.arange(rows)[:, None], west + STEP * np.arange(cols)[None, :]
    values = 45.0 + level + 4.0 * np.sin(lat) + 3.0 * np.cos(0.7 * lon)
    transform = (STEP, 0.0, west - 0.5 * STEP, 0.0, -STEP, 50.0 + 0.5 * STEP)
    return Geoid.from_values(values, transform, datum, f"{datum}.gtx")


def finding(*geoids: Geoid) -> Find:
    return {geoid.datum: geoid for geoid in geoids}.get


NONE = finding()
BOTH = finding(a_geoid("EGM96"), a_geoid("EGM2008", 0.7))


def a_map(datum: str | None, **changes: Any) -> Map:
    values = np.random.default_rng(3).normal(500.0, 80.0, (30, 40)).astype(np.float32)
    values[4, 5] = np.nan
    return replace(Map(values, (0.01, 0.0, 10.0, 0.0, -0.01, 47.0), datum=datum, name="hills"), **changes)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("EGM96", "EGM96"),
        ("egm96_15.gtx", "EGM96"),
        ("EGM96 height", "EGM96"),
        ("EPSG:5773", "EGM96"),
        ("urn:ogc:def:crs:EPSG::5773", "EGM96"),
        ("urn:ogc:def:crs:EPSG:9.9:3855", "EGM2008"),
        ("E96", "EGM96"),
        ("us_nga_egm08_25.tif", "EGM2008"),
        ("EGM 2008 geoid", "EGM2008"),
        ("EPSG:3855", "EGM2008"),
        ("EPSG:4326+3855", "EGM2008"),
        ("EPSG:25832+7837", "DHHN2016"),
        ("DHHN2016 height", "DHHN2016"),
        ("EPSG:5798", "EGM84"),
        ("WGS 84 ellipsoid", "ellipsoid"),
        ("height above the Ellipsoid", "ellipsoid"),
        ("EPSG:4979", "ellipsoid"),
        ("MSL", "mean sea level"),
        ("LMSL", "mean sea level"),
        ("AMSL", "mean sea level"),
        ("Mean_Sea_Level", "mean sea level"),
        ("MSL height", "mean sea level"),
        ("EPSG:5714", "mean sea level"),
        ("NAVD88 height", "NAVD 88"),
        ("North American Vertical Datum of 1988", "NAVD 88"),
        ("EPSG:5703", "NAVD 88"),
        ("MLLW", "MLLW"),
        ("Mean Lower Low Water", "MLLW"),
        ("MLLW depth", "MLLW"),
        ("lowest astronomical tide", "LAT"),
        ("local", "local"),
        ("pressure altitude", "local"),
        ("not stated", None),
        ("Unknown", None),
        ("  ", None),
        (None, None),
        ("the gauge at the old pier", "the gauge at the old pier"),
        ("EPSG:4326", None),
    ],
)
def test_the_words_of_files(text: str | None, name: str | None) -> None:
    assert vertical_datum(text) == name


def test_wkt_and_compound_crs() -> None:
    from pyproj import CRS

    assert vertical_datum(CRS.from_epsg(3855).to_wkt()) == "EGM2008"
    assert vertical_datum(CRS.from_user_input("EPSG:4326+5773").to_wkt("WKT1_GDAL")) == "EGM96"
    assert split_crs("EPSG:25832+5773") == ("EPSG:25832", "EGM96 height")
    assert split_crs("EPSG:4979") == ("EPSG:4979", "ellipsoid")
    assert split_crs("EPSG:25832") == ("EPSG:25832", None)
    assert split_crs("no such crs") == ("no such crs", None)
    assert vertical_datum("+proj=longlat +datum=WGS84 +geoidgrids=egm96_15.gtx +vunits=m +type=crs") == "EGM96"


@given(st.text(max_size=40))
def test_any_words_give_a_name_or_none_and_the_name_stays(text: str) -> None:
    name = vertical_datum(text)
    assert name is None or name
    assert vertical_datum(name) == name or name == " ".join(text.split())


def test_what_a_user_states_must_be_known() -> None:
    assert stated_datum("EPSG:5773", "datum") == "EGM96"
    assert stated_datum("EVRF2007", "datum") == "EVRF2007"
    assert stated_datum("unknown", "datum") is None
    with pytest.raises(ConfigError, match=r"^datum is 'EGM69' \(did you mean 'EGM96'\?\), expected ellipsoid, EGM96"):
        stated_datum("EGM69", "datum")


def test_tiles_of_one_datum_agree_and_others_are_named() -> None:
    assert agreed_datum([("a", "EGM96 height"), ("b", "EPSG:5773"), ("c", "E96")]) == "EGM96"
    assert agreed_datum([("a", "EGM96"), ("b", None)]) is None
    assert agreed_datum([]) is None
    with pytest.raises(DataError, match=r"^b\.tif counts heights from EGM96, but d\.tif from EGM2008; expected one"):
        agreed_datum([("a.tif", None), ("b.tif", "EGM96"), ("c.tif", "EGM96 height"), ("d.tif", "EGM2008")])


def test_what_lies_between() -> None:
    n96, n08 = a_geoid("EGM96").height(46.2, 11.3), a_geoid("EGM2008", 0.7).height(46.2, 11.3)
    for source, target, expected in (
        ("ellipsoid", "EGM96", -n96),
        ("EGM96", "ellipsoid", n96),
        ("EGM2008", "ellipsoid", n08),
        ("EGM96", "EGM2008", n96 - n08),
        ("EGM96", "EGM96", 0.0),
        ("ellipsoid", "ellipsoid", 0.0),
    ):
        shift = between(source, target, BOTH)
        assert shift.doubt == ""
        np.testing.assert_allclose(shift.heights(46.2, 11.3), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("source", "target", "find", "doubt", "grids"),
    [
        ("EGM96", "EGM2008", finding(a_geoid("EGM96")), r"differ by 0\.5 m \(rms\).*12 m at most", 0),
        ("EGM2008", "ellipsoid", finding(a_geoid("EGM96")), r"12 m at most.*the geoid of EGM96 stands in", 1),
        ("mean sea level", "ellipsoid", BOTH, r"a metre or two; the geoid of EGM2008 stands in", 1),
        ("NAVD 88", "EGM96", BOTH, "NAVD 88 and EGM96 differ by a metre or two", 0),
        ("MLLW", "mean sea level", BOTH, "by the tide, up to several metres", 0),
        ("ellipsoid", "MLLW", BOTH, "by the tide, up to several metres; the geoid of EGM2008 stands in", 1),
        ("local", "EGM96", BOTH, "by a constant that nothing here knows", 0),
        ("a gauge", "EGM96", BOTH, "by a constant that nothing here knows", 0),
    ],
)
def test_what_is_left_out_is_said(source: str, target: str, find: Find, doubt: str, grids: int) -> None:
    shift: Shift = between(source, target, find)
    assert re.search(doubt, shift.doubt)
    assert len(shift.geoids) == grids
    assert shift.bounded == ("constant" not in doubt)


@pytest.mark.parametrize("sea", ["EGM96", "EGM2008", "mean sea level", "NAVD 88", "MLLW", "DHHN2016"])
def test_without_a_grid_the_ellipsoid_is_refused(sea: str) -> None:
    """PROJ would give the height back unchanged."""
    for pair in ((sea, "ellipsoid"), ("ellipsoid", sea)):
        with pytest.raises(DataError, match=rf"up to 107 m.*expected the geoid grid of {sea} \(geoid=, --geoid FILE\)"):
            between(*pair, NONE)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32632", "EPSG:3035"])
def test_a_map_is_converted_at_every_cell(crs: str) -> None:
    chart = a_map("EGM96 height")
    if crs != "EPSG:4326":
        from pyproj import Transformer

        x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(10.2, 46.8)
        chart = replace(chart, crs=crs, transform=(900.0, 20.0, x, 30.0, -900.0, y))
    high = convert(chart, "WGS 84 ellipsoid", BOTH)
    assert high.datum == "ellipsoid"
    assert (high.transform, high.crs, high.sigma, high.name) == (chart.transform, chart.crs, chart.sigma, chart.name)
    lat, lon = np.random.default_rng(1).uniform((46.75, 10.22), (46.79, 10.3), (50, 2)).T
    added = high.sample(lat, lon) - chart.sample(lat, lon)
    known = np.isfinite(added)
    assert known.sum() > 40
    np.testing.assert_allclose(added[known], a_geoid("EGM96").height(lat, lon)[known], atol=2e-3)
    assert np.isnan(high.values).sum() == 1
    back = convert(high, "EGM96", BOTH)
    np.testing.assert_allclose(back.values, chart.values, atol=1e-4)


def test_a_large_map_is_converted_in_strips_as_a_small_one() -> None:
    values = np.zeros((300, 8000), np.float32)
    chart = Map(values, (0.001, 0.0, 8.0, 0.0, -0.001, 46.0), datum="EGM96", name="large")
    whole = convert(chart, "ellipsoid", BOTH)
    part = convert(replace(chart, values=values[:, :40], name="small"), "ellipsoid", BOTH)
    np.testing.assert_array_equal(whole.values[:, :40], part.values)
    np.testing.assert_allclose(whole.values[299, 7999], a_geoid("EGM96").height(46.0 - 0.2995, 15.9995), atol=1e-4)


def test_one_geoid_is_enough_to_give() -> None:
    converted = convert(a_map("ellipsoid"), "EGM96", a_geoid("EGM96"))
    assert converted.datum == "EGM96"
    with pytest.warns(DataWarning, match=r"^hills: NAVD 88 and EGM2008 differ by a metre or two; the geoid of EGM2008"):
        convert(a_map("NAVD 88"), "ellipsoid", a_geoid("EGM2008"))


@pytest.mark.parametrize(
    ("chart", "to", "find", "error", "message"),
    [
        (a_map("EGM96"), "ellipsoid", NONE, DataError, r"^hills: heights above EGM96 and above ellipsoid .* 107 m"),
        (
            a_map(None),
            "ellipsoid",
            BOTH,
            DataError,
            r"^hills: the map's vertical datum is unknown, expected one \(datum=",
        ),
        (a_map("EGM96"), "EGM69", BOTH, ConfigError, r"^datum is 'EGM69' \(did you mean"),
        (a_map("EGM96"), "unknown", BOTH, ConfigError, "^datum is 'unknown', expected the vertical datum that the map"),
        (a_map("EGM96"), "NAVD 88", BOTH, DataError, "cannot go from EGM96 to NAVD 88: .* expected a grid for each"),
        (a_map("EGM96"), "local", BOTH, DataError, "cannot go from EGM96 to local"),
        (
            a_map("EGM96", kind="gravity", unit="mGal"),
            "ellipsoid",
            BOTH,
            ConfigError,
            "gravity map has no vertical datum",
        ),
        (
            a_map("EGM96", transform=(0.01, 0.0, 30.0, 0.0, -0.01, 47.0)),
            "ellipsoid",
            BOTH,
            DataError,
            "EGM96.gtx: no ge",
        ),
    ],
)
def test_maps_that_cannot_be_converted(chart: Map, to: str, find: Find, error: type, message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        convert(chart, to, find)
    assert "\n" not in str(caught.value)


def test_nothing_to_convert_is_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        chart = convert(a_map("EGM96 height"), "EGM96", NONE)
    np.testing.assert_array_equal(chart.values, a_map(None).values)
    assert chart.datum == "EGM96"


def test_a_geoid_is_the_plane_that_its_grid_is() -> None:
    """Bilinear and bicubic are exact on planes, up to the edges."""
    lat, lon = 50.0 - STEP * np.arange(41)[:, None], 5.0 + STEP * np.arange(61)[None, :]
    plane = Geoid.from_values(2.0 * lat - lon, (STEP, 0.0, 5.0 - STEP / 2, 0.0, -STEP, 50.0 + STEP / 2), "EGM96")
    at = np.random.default_rng(2).uniform((40.0, 5.0), (50.0, 20.0), (200, 2)).T
    np.testing.assert_allclose(plane.height(at[0], at[1], "bilinear"), 2.0 * at[0] - at[1], atol=1e-4)
    np.testing.assert_allclose(plane.height(at[0], at[1], "bicubic"), 2.0 * at[0] - at[1], atol=1e-4)
    np.testing.assert_allclose(plane.height([50.0, 40.0], [5.0, 380.0]), [95.0, 60.0], atol=1e-4)
    assert np.isnan(plane.height([50.1, 45.0, np.nan, 45.0], [10.0, 4.9, 10.0, np.nan])).all()


@pytest.mark.parametrize("west", [-180.0, 0.0, -180.125])
@pytest.mark.parametrize("extra", [0, 1])
def test_a_grid_around_the_earth_has_no_seam(west: float, extra: int) -> None:
    rows, cols = 73, 144 + extra
    lat, lon = 90.0 - 2.5 * np.arange(rows)[:, None], west + 2.5 * np.arange(cols)[None, :]
    field = 30.0 * np.cos(np.radians(lat)) * np.cos(np.radians(lon)) + 10.0 * np.sin(np.radians(lat))
    globe = Geoid.from_values(field, (2.5, 0.0, west - 1.25, 0.0, -2.5, 91.25), "EGM2008")
    at = np.linspace(-725.0, 725.0, 300)
    expected = 30.0 * np.cos(np.radians(20.0)) * np.cos(np.radians(at)) + 10.0 * np.sin(np.radians(20.0))
    np.testing.assert_allclose(globe.height(20.0, at), expected, atol=2e-3)
    across = np.array([179.9, -179.9, 180.1, 180.0, -180.0, 359.9, 0.1])
    expected = 30.0 * np.cos(np.radians(20.0)) * np.cos(np.radians(across)) + 10.0 * np.sin(np.radians(20.0))
    np.testing.assert_allclose(globe.height(20.0, across), expected, atol=2e-3)
    np.testing.assert_allclose(globe.height([90.0, -90.0], [77.0, 200.0]), [10.0, -10.0], atol=1e-4)


def test_only_the_cells_around_are_read() -> None:
    asked: list[Window] = []
    base = a_geoid("EGM96")

    def read(window: Window) -> np.ndarray:
        asked.append(window)
        return base.read(window)

    watched = replace(base, read=read)
    np.testing.assert_array_equal(watched.height([45.1, 45.3], [10.1, 10.2]), base.height([45.1, 45.3], [10.1, 10.2]))
    ((top, bottom), (left, right)) = asked[0]
    assert (bottom - top) * (right - left) <= 64


def test_bicubic_heights_are_catmull_rom() -> None:
    """Against the textbook matrix form, one position at a time."""
    geoid = a_geoid("EGM96")
    grid = geoid.read(((0, 41), (0, 61))).astype(np.float64)
    basis = 0.5 * np.array([[0, 2, 0, 0], [-1, 0, 1, 0], [2, -5, 4, -1], [-1, 3, -3, 1]], dtype=float)
    for lat, lon in np.random.default_rng(5).uniform((41.0, 6.0), (49.0, 19.0), (60, 2)):
        row, col = (50.0 - lat) / STEP, (lon - 5.0) / STEP
        i, j = int(row), int(col)
        by_row = np.array([(row - i) ** k for k in range(4)]) @ basis
        by_col = np.array([(col - j) ** k for k in range(4)]) @ basis
        expected = by_row @ grid[i - 1 : i + 3, j - 1 : j + 3] @ by_col
        assert float(geoid.height(lat, lon)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Geoid.from_values(np.zeros((1, 9)), (1, 0, 0, 0, -1, 0), "EGM96"), DataError, "1 x 9 cells"),
        (lambda: Geoid.from_values(np.zeros(9), (1, 0, 0, 0, -1, 0), "EGM96"), DataError, "of shape"),
        (lambda: Geoid.from_values(np.zeros((9, 9)), (1, 0.1, 0, 0, -1, 0), "EGM96"), DataError, "west to east"),
        (lambda: Geoid.from_values(np.zeros((9, 9)), (-1, 0, 0, 0, -1, 0), "EGM96"), DataError, "west to east"),
        (
            lambda: a_geoid("EGM96").height(45, 9, cast("Any", "nearest")),
            ConfigError,
            "expected 'bilinear' or 'bicubic'",
        ),
    ],
)
def test_what_is_no_geoid(make: object, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        make()  # type: ignore[operator]

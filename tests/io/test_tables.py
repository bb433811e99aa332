"""Foreign tables made recordings: every key of the columns file, the shipped examples, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terranav.core.earth import offset_m
from terranav.core.errors import ConfigError, DataError, DataWarning, TerranavError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import COLUMNS, Recording
from terranav.io.table_units import units_of
from terranav.io.tables import convert_table

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
TABLE = "T,Lat,Lon,Alt,H\n0,47,9,1000,100\n1,47.001,9.001,2000,\n2,47.002,9.002,3000,300\n"
TIME = '[time]\ncolumn = "T"\nformat = "seconds"\n'
PLACE = '[columns]\nlat_deg = "Lat"\nlon_deg = "Lon"\n'
BASIC = f'{TIME}{PLACE}alt_m = "Alt"\n'


@pytest.fixture
def convert(tmp_path: Path) -> Any:
    def call(toml: str, table: str = TABLE) -> Recording:
        (tmp_path / "survey.csv").write_text(table, encoding="utf-8")
        (tmp_path / "columns.toml").write_text(toml, encoding="utf-8")
        return convert_table(tmp_path / "survey.csv", tmp_path / "columns.toml")

    return call


def test_the_plainest_case(convert: Any) -> None:
    rec = convert(BASIC)
    assert rec.name == "survey"
    assert rec.time_s.tolist() == [0.0, 1.0, 2.0]
    assert rec.lon_deg.tolist() == [9.0, 9.001, 9.002]
    assert not rec.has_truth
    assert dict(rec.source) == {"table": "survey.csv", "rows": "3 of 3 kept"}


def test_units_scale_offset_nulls_differences_and_constants(convert: Any) -> None:
    rec = convert(
        f"{TIME}{PLACE}"
        'alt_m = {column = "Alt", unit = "ft", offset = -2.5}\n'
        'depth_m = {column = "H", scale = -1, null = [300]}\n'
        'terrain_m = {subtract = [{column = "Alt", unit = "ft"}, "H"]}\n'
        'baro_altitude_m = {subtract = ["Alt", "H"], unit = "km", scale = 2, offset = 1}\n'
        'heading_deg = {column = "H", unit = "rad"}\n'
        "vn_mps = {value = 3}\n"
    )
    assert rec.alt_m.tolist() == [1000 * 0.3048 - 2.5, 2000 * 0.3048 - 2.5, 3000 * 0.3048 - 2.5]
    np.testing.assert_array_equal(rec.columns["depth_m"], [-100, np.nan, np.nan])
    np.testing.assert_array_equal(rec.columns["terrain_m"], [1000 * 0.3048 - 100, np.nan, 3000 * 0.3048 - 300])
    np.testing.assert_allclose(rec.columns["baro_altitude_m"], [2 * 900e3 + 1, np.nan, 2 * 2700e3 + 1])
    assert rec.columns["heading_deg"][0] == np.degrees(1.0) * 100
    assert rec.columns["vn_mps"].tolist() == [3.0] * 3


@pytest.mark.parametrize(
    ("column", "unit", "one"),
    [
        ("alt_m", "ft", 0.3048),
        ("alt_m", "us_ft", 0.30480060960121924),
        ("depth_m", "fathom", 1.8288),
        ("alt_m", "nmi", 1852.0),
        ("roll_deg", "rad", 57.29577951308232),
        ("lat_deg", "arcsec", 1 / 3600),
        ("ve_mps", "kn", 0.5144444444444445),
        ("ve_mps", "km/h", 1 / 3.6),
        ("gravity_mgal", "m/s2", 1e5),
        ("gravity_mgal", "um/s2", 0.1),
        ("magnetic_nt", "uT", 1000.0),
        ("magnetic_sigma_nt", "G", 1e5),
    ],
)
def test_units(column: str, unit: str, one: float) -> None:
    assert units_of(column)[unit] == pytest.approx(one, rel=1e-15)


def test_every_column_has_units_and_its_own_comes_first() -> None:
    for column in COLUMNS[1:]:
        assert next(iter(units_of(column).values())) == 1.0


@pytest.mark.parametrize(
    ("layout", "table"),
    [
        ('delimiter = ";"\ndecimal_comma = true', "T;Lat;Lon;Alt\n0;47,5;9;10,25\n1;47,5;9;*\n"),
        ('delimiter = "\\t"', "T\tLat\tLon\tAlt\n0\t47.5\t9\t10.25\n1\t47.5\t9\t*\n"),
        ('delimiter = "whitespace"\ncomment = "/"', "/ a survey\nT Lat  Lon Alt\n  0  47.5 9 10.25 / good\n1 47.5 9 *"),
        ('names = ["T", "Lat", "Lon", "Alt"]', "0,47.5,9,10.25,more,more\n1,47.5,9,*,more,more\n"),
        (
            'delimiter = "fixed"\nwidths = [1, 6, 1, 6]',
            "TLat   OAlt   \n047.50 910.25 \n\n147.50 9*     \n".replace("O", "L"),
        ),
        ("skip_lines = 2", 'a title, with a comma\n\nT,Lat,Lon,Alt\n0,47.5,9,10.25\n1,47.5,9,"*"\n'),
    ],
)
def test_layouts(convert: Any, layout: str, table: str) -> None:
    lon = "L" if "widths" in layout else "Lon"
    toml = (
        f'[table]\n{layout}\nnull = ["*"]\n{TIME}[columns]\nlat_deg = "Lat"\nlon_deg = "{lon}"\nalt_m = {{value = 0}}\n'
    )
    rec = convert(f'{toml}laser_altitude_m = "Alt"\n', table)
    assert rec.lat_deg.tolist() == [47.5, 47.5]
    assert rec.lon_deg.tolist() == [9.0, 9.0]
    np.testing.assert_array_equal(rec.columns["laser_altitude_m"], [10.25, np.nan])


def test_encoding_and_a_column_without_a_name(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_bytes(",Höhe,Lat,Lon\n0,5,47,9\n".encode("latin-1"))
    (tmp_path / "c.toml").write_text(
        '[table]\nencoding = "latin-1"\n[time]\ncolumn = ""\nformat = "seconds"\n' + PLACE + 'alt_m = "Höhe"\n', "utf-8"
    )
    assert convert_table(tmp_path / "s.csv", tmp_path / "c.toml").alt_m.tolist() == [5.0]
    (tmp_path / "c.toml").write_text(BASIC)
    with pytest.raises(DataError, match=r"s.csv: is not a text table in utf-8-sig, expected a table as text"):
        convert_table(tmp_path / "s.csv", tmp_path / "c.toml")


def test_numbers_that_mean_no_reading(convert: Any) -> None:
    table = "T,Lat,Lon,H\n0,47,9,-9999.990\n1,47,9,\n2,47,9,5\n"
    rec = convert(f'[table]\nnull = [-9999.99]\n{TIME}{PLACE}alt_m = {{value = 0}}\nterrain_m = "H"\n', table)
    np.testing.assert_array_equal(rec.columns["terrain_m"], [np.nan, np.nan, 5.0])


@pytest.mark.parametrize(
    ("time", "cells", "seconds", "start"),
    [
        ('column = "A"', ["2000-07-16 12:35:00-12:00", "2000-07-17T00:36:00.25Z"], 60.25, "2000-07-17T00:35:00Z"),
        ('column = "A"\nzone = "+01:00"', ["2021-01-20 00:30", "2021-01-20 00:31"], 60, "2021-01-19T23:30:00Z"),
        (
            'column = "A"\nformat = "%d.%m.%Y %H:%M"',
            ["20.01.2021 23:59", "21.01.2021 00:01"],
            120,
            "2021-01-20T23:59:00Z",
        ),
        ('column = "A"\nformat = "%H:%M:%S"', ["17:14:42", "17:15:02"], 20, None),
        (
            'column = "A"\nformat = "%H:%M:%S"\nzero = "2021-01-20"\nrollover = true',
            ["23:59:50", "00:00:05"],
            15,
            "2021-01-20T23:59:50Z",
        ),
        ('column = "A"\nformat = "unix"', ["1626385000.5", "1626385001.5"], 1, "2021-07-15T21:36:40.500000Z"),
        (
            'column = "A"\nformat = "unix"\nunit = "ms"',
            ["1626385000500", "1626385000750"],
            0.25,
            "2021-07-15T21:36:40.500000Z",
        ),
        ('column = "A"\nformat = "seconds"\nunit = "min"', ["70", "71.5"], 90, None),
        (
            'column = "A"\nformat = "seconds"\nzero = 2021-01-20T00:00:00Z\nrollover = true',
            ["86399", "1"],
            2,
            "2021-01-20T23:59:59Z",
        ),
        ("rate_hz = 4", ["x", "x"], 0.25, None),
        ('rate_hz = 4\nzero = "2021-01-20T00:00:00+01:00"', ["x", "x"], 0.25, "2021-01-19T23:00:00Z"),
    ],
)
def test_times(convert: Any, time: str, cells: list[str], seconds: float, start: str | None) -> None:
    rec = convert(
        f"[time]\n{time}\n[columns]\nlat_deg = {{value = 1}}\nlon_deg = {{value = 2}}\nalt_m = {{value = 0}}\n",
        f"A\n{cells[0]}\n{cells[1]}\n",
    )
    np.testing.assert_allclose(rec.time_s, [0.0, seconds], rtol=0, atol=1e-12)
    assert rec.source.get("start_utc") == start


def test_date_and_time_in_two_columns(convert: Any) -> None:
    table = "D,T,Lat,Lon\n2021/01/20,23:59:00,47,9\n2021/01/21,00:01:00,47,9\n"
    time = '[time]\ncolumns = ["D", "T"]\nformat = "%Y/%m/%d %H:%M:%S"\n'
    rec = convert(f"{time}{PLACE}alt_m = {{value = 0}}\n", table)
    assert rec.time_s.tolist() == [0.0, 120.0]
    assert rec.source["start_utc"] == "2021-01-20T23:59:00Z"


@given(st.lists(st.floats(1.0, 40000.0), min_size=1, max_size=15), st.floats(0, 86399))
def test_rollover_undoes_midnight(steps: list[float], first: float) -> None:
    from terranav.io.table_time import _unrolled

    clock = first + np.concatenate([[0.0], np.cumsum(steps)])
    unrolled = _unrolled(clock % 86400.0)
    np.testing.assert_allclose(unrolled - unrolled[0], clock - clock[0], atol=1e-6)


def test_projected_coordinates(convert: Any) -> None:
    table = "T,E,N\n0,500,0\n1,500,10\n"
    axes = 'easting = {column = "E", scale = 1000}\nnorthing = {column = "N", scale = 1e3}\n'
    position = f'[position]\ncrs = "EPSG:32632"\n{axes}'
    rec = convert(f"{TIME}{position}[columns]\nalt_m = {{value = 0}}\n", table)
    np.testing.assert_allclose(rec.lat_deg[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(rec.lon_deg, 9.0, atol=1e-9)  # the central meridian
    north, east = offset_m(rec.lat_deg[0], rec.lon_deg[0], rec.lat_deg[1], rec.lon_deg[1])
    np.testing.assert_allclose([north, east], [10e3 / 0.9996, 0.0], atol=0.01)  # the scale on it


def test_true_positions(convert: Any) -> None:
    rec = convert(f"position_is_true = true\n{BASIC}")
    for key in ("lat_deg", "lon_deg", "alt_m"):
        assert rec.columns[f"true_{key}"].tolist() == rec.columns[key].tolist()
    flat = convert(f'position_is_true = "horizontal"\n{BASIC}')
    assert flat.has_truth
    assert "true_alt_m" not in flat.columns
    own = convert(f'position_is_true = true\n{BASIC}true_alt_m = "H"\n')
    assert own.columns["true_alt_m"][0] == 100.0


def test_what_is_constant_is_passed_through(convert: Any) -> None:
    rec = convert(
        f'name = "a flight"\n{BASIC}terrain_m = "H"\n'
        '[ins]\nposition_sigma_m = 7\n[sigma]\nterrain_m = 2\n[source]\nwho = "me"\n'
    )
    assert (rec.name, rec.ins, dict(rec.sigma)) == ("a flight", InsGrade(position_sigma_m=7), {"terrain_m": 2.0})
    assert rec.source["who"] == "me"


MESSY = (
    "T,Lat,Lon,Line\n"
    "5,47,9,1\n4,47,9,1\n4,48,9,1\n6,,9,1\n7,95,9,1\n,47,9,1\n8,47,9,2\n9,47,9.9,1\n10,47,9,1\n"
)  # fmt: skip


def test_rows_are_dropped_with_reasons(convert: Any) -> None:
    drop = 'on_bad_fix = "drop"\non_unsorted = "sort"\non_duplicate_time = "drop"\nmax_speed_mps = 100\n'
    rec = convert(f"{TIME}{PLACE}alt_m = {{value = 0}}\n[rows]\n{drop}where = {{Line = 1}}\n", MESSY)
    assert rec.time_s.tolist() == [0.0, 1.0, 6.0]
    assert rec.lat_deg.tolist() == [47.0, 47.0, 47.0]
    assert rec.source["rows"] == (
        "3 of 9 kept; 1 dropped without a good time_s; 2 dropped without a good lat_deg; "
        "sorted by time (steps back: 1); 1 dropped with the time of another row; 1 dropped as out of reach at 100 m/s"
    )


@pytest.mark.parametrize("where", ["{Line = 2}", '{Line = "2"}', '{Line = [2, "x"], Lat = 47.0}'])
def test_rows_are_picked_by_value(convert: Any, where: str) -> None:
    rec = convert(f"{TIME}{PLACE}alt_m = {{value = 0}}\n[rows]\nwhere = {where}\n", MESSY)
    assert len(rec) == 1


def test_a_false_start_does_not_take_the_track_with_it(convert: Any) -> None:
    rows = "".join(f"{t},{47 + 1e-4 * t},{0 if t < 3 else 9}\n" for t in range(30))
    rec = convert(f"{TIME}{PLACE}alt_m = {{value = 0}}\n[rows]\nmax_speed_mps = 50\n", f"T,Lat,Lon\n{rows}")
    assert len(rec) == 27
    assert set(rec.lon_deg.tolist()) == {9.0}


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("", "in row 4 lat_deg is missing, expected a number in .* set on_bad_fix = 'drop' under .rows.*"),
        ("where = {Line = 2, Lat = 47}\non_bad_fix = 'drop'", None),
        (
            "on_bad_fix = 'drop'",
            r"in row 2 the time goes back, expected .* \(or set on_unsorted = 'sort' under \[rows\]\)",
        ),
        (
            "on_bad_fix = 'drop'\non_unsorted = 'sort'",
            "in row 3 the time is that of another row, .*on_duplicate_time = 'drop'",
        ),
        ("where = {Line = 3}", r"no row has Line = 3, expected a value that occurs \(1, 2, ...\)"),
        ("where = {Lin = 3}", r"no column 'Lin' \(did you mean 'Line'\?\); the table has 'T', 'Lat', 'Lon', 'Line'"),
    ],
)
def test_row_policies(convert: Any, rows: str, message: str | None) -> None:
    table = MESSY.replace(",47,9,1\n8", "7.5,47,9,1\n8")  # every row has a time
    toml = f"{TIME}{PLACE}alt_m = {{value = 0}}\n[rows]\n{rows}\n"
    if message is None:
        assert len(convert(toml, table)) == 1
    else:
        refused(convert, DataError, toml, table, rf"survey.csv: .*{message}")


def test_a_unit_that_cannot_be_is_doubted(convert: Any) -> None:
    with pytest.warns(DataWarning, match=r"terrain_m runs from 100000 to 300000 m .*: is its unit or sign right\?"):
        convert(f'{BASIC}terrain_m = {{column = "H", unit = "km"}}\n')


def test_speed_that_nothing_satisfies(convert: Any) -> None:
    message = r"only 1 of 3 rows can be reached at max_speed_mps = 0.001, expected at least half"
    refused(convert, DataError, f"{BASIC}[rows]\nmax_speed_mps = 1e-3\n", TABLE, message)


def refused(convert: Any, error: type[TerranavError], toml: str, table: str, message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        convert(toml, table)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        (f"{BASIC}[row]\n", r"columns.toml: unknown key 'row' \(did you mean 'rows'\?\); known: columns, ins, name"),
        (f"{BASIC}[rows]\non_dup = 'drop'", r"unknown key '\[rows\] on_dup' \(did you mean 'on_duplicate_time'\?\)"),
        (
            f"{BASIC}[rows]\non_unsorted = 'srt'",
            r"\[rows\] on_unsorted is 'srt', expected one of error, sort \(did you mean",
        ),
        (f"{BASIC}[rows]\nwhere = {{T = true}}", r"\[rows\] where T is True, expected a number, a text, or a list"),
        (f"{BASIC}[rows]\nmax_speed_mps = -1", r"\[rows\] max_speed_mps is -1, expected a finite number and > 0"),
        (f"{BASIC}terain_m = 'H'", r"unknown key '\[columns\] terain_m' \(did you mean 'terrain_m'\?\)"),
        (f"{BASIC}time_s = 'T'", r"unknown key '\[columns\] time_s'"),
        (f"{BASIC}terrain_m = 5", r"\[columns\] terrain_m is 5, expected a column name, \{column = "),
        (f"{BASIC}terrain_m = {{unit = 'm'}}", r"\[columns\] terrain_m is .*, expected a column name, \{column = "),
        (f"{BASIC}terrain_m = {{column = 'H', value = 1}}", r"\[columns\] terrain_m is .*, expected a column name"),
        (
            f"{BASIC}terrain_m = {{column = 'H', unti = 'ft'}}",
            r"'\[columns\] terrain_m unti' \(did you mean 'unit'\?\)",
        ),
        (
            f"{BASIC}terrain_m = {{column = 'H', unit = 'feet'}}",
            r"terrain_m unit is 'feet', expected one of m, km, .*, ft",
        ),
        (f"{BASIC}terrain_m = {{column = 'H', scale = '2'}}", r"terrain_m scale is '2', expected a finite number"),
        (
            f"{BASIC}terrain_m = {{column = 'H', null = 2}}",
            r"terrain_m null is 2, expected a list of numbers and texts",
        ),
        (f"{BASIC}terrain_m = {{subtract = ['H']}}", r"terrain_m subtract is \['H'\], expected two columns such as"),
        (f"{BASIC}terrain_m = {{subtract = ['H', 3]}}", r"terrain_m subtract second is 3, expected a column name"),
        (
            f"{TIME}{PLACE}",
            r"\[columns\] alt_m is missing, expected what it is made of, such as alt_m = \{value = 0.0\}",
        ),
        (TIME, r"\[columns\] is missing"),
        (f"{PLACE}alt_m = 'Alt'", r"\[time\] is missing"),
        (f"[time]\n{PLACE}alt_m = 'Alt'", r"\[time\] column is missing, expected one of column"),
        (BASIC.replace("seconds", "sec"), r"\[time\] format is 'sec', expected 'iso', 'unix', 'seconds' or a pattern"),
        (BASIC.replace("[columns]", "zone = 'CET'\n[columns]"), r"\[time\] zone is 'CET', expected an offset from UTC"),
        (BASIC.replace("[columns]", "zero = 'noon'\n[columns]"), r"\[time\] zero is 'noon', expected a date and time"),
        (BASIC.replace("[columns]", "unit = 'm'\n[columns]"), r"\[time\] unit is 'm', expected one of s, ms, us"),
        (
            BASIC.replace('column = "T"', 'columns = ["T", "T"]'),
            r"\[time\] columns is .*, expected one column for format",
        ),
        (f"position_is_true = 1.5\n{BASIC}", r"position_is_true is 1.5, expected true, false or 'horizontal'"),
        (f"{BASIC}[table]\ndelimiter = ',,'", r"\[table\] delimiter is ',,', expected one character, 'whitespace'"),
        (f"{BASIC}[table]\ndelimiter = 'fixed'", r"\[table\] widths is missing, expected widths together with"),
        (f"{BASIC}[table]\nwidths = [1]", r"\[table\] widths"),
        (f"{BASIC}[table]\nskip_lines = -1", r"\[table\] skip_lines is -1, expected a whole number >= 0"),
        (f"{BASIC}[table]\nencoding = 'utf-9'", r"\[table\] encoding is 'utf-9', expected an encoding"),
        (f"{BASIC}[table]\ndecimal_comma = 1", r"\[table\] decimal_comma is 1, expected true or false"),
        (f"{BASIC}[ins]\nposition_sigma_m = -1", r"columns.toml: \[ins\] position_sigma_m is -1.0, expected"),
        (
            f"{BASIC}[position]\ncrs = 'EPSG:1'\neasting = 'Lon'\nnorthing = 'Lat'",
            r"\[position\] crs is 'EPSG:1', expected",
        ),
        (f"{BASIC}[position]\ncrs = 'EPSG:32632'\neasting = 'Lon'", r"\[position\] northing is missing"),
        (
            f"{BASIC}[position]\ncrs = 'EPSG:32632'\neasting = 'Lon'\nnorthing = 'Lat'",
            r"unknown key '\[columns\] lat_deg'",
        ),
        ("[time", "is not valid TOML: "),
    ],
)
def test_bad_columns_files(convert: Any, toml: str, message: str) -> None:
    refused(convert, ConfigError, toml, TABLE, message)


@pytest.mark.parametrize(
    ("toml", "table", "message"),
    [
        (BASIC, "", "survey.csv: the file is empty, expected a table as text"),
        (BASIC, "T,Lat,Lon,Alt\n", "survey.csv: the table has a header but no rows"),
        (BASIC, TABLE.replace("47.001", "x"), "survey.csv: Lat in row 2 is 'x', expected a number or nothing"),
        (BASIC, TABLE.replace(",300\n", "\n"), "survey.csv: row 3 has 4 cells, expected 5"),
        (
            BASIC.replace("Alt", "ALT"),
            TABLE,
            r"survey.csv: no column 'ALT' \(did you mean 'Alt'\?\); the table has 'T', ",
        ),
        (
            BASIC.replace("seconds", "%H"),
            TABLE.replace("\n1", "\nxx"),
            "survey.csv: T in row 2 is 'xx', expected a time like %H",
        ),
        (
            BASIC.replace("seconds", "iso"),
            TABLE,
            "survey.csv: T in row 1 is '0', expected a time such as 2021-01-20T17:14:42Z",
        ),
        (BASIC, "T,Lat,Lon,Alt\n,47,9,0\n", "in row 1 time_s is missing, expected a time"),
        (f"{BASIC}[rows]\non_bad_fix='drop'", "T,Lat,Lon,Alt\n,47,9,0\n", "none of 1 rows has a time and a position"),
        (
            f"{BASIC}terrain_sigma_m = 'H'",
            TABLE.replace("300", "-1"),
            "survey.csv: terrain_sigma_m in row 3 is -1, expected",
        ),
        (
            f"[table]\nnames = ['T', 'a', 'b', 'c', 'd', 'e']\n{BASIC}",
            TABLE,
            "row 1 has 5 cells, expected at least the 6 that",
        ),
    ],
)
def test_bad_tables(convert: Any, toml: str, table: str, message: str) -> None:
    refused(convert, DataError, toml, table, message)


def test_missing_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"columns.toml: no such file, expected a columns file"):
        convert_table(tmp_path / "t.csv", tmp_path / "columns.toml")
    (tmp_path / "columns.toml").write_text(BASIC)
    with pytest.raises(DataError, match=r"t.csv: no such file, expected a table as text"):
        convert_table(tmp_path / "t.csv", tmp_path / "columns.toml")
    with pytest.raises(DataError, match="is a folder, expected a table as text"):
        convert_table(tmp_path, tmp_path / "columns.toml")


@pytest.mark.parametrize("day", ["20210120", "20210122", "20210125", "20210203"])
def test_helicopter_days(shared_data: Path, day: str) -> None:
    table = shared_data / "wisconsin_helicopter" / f"flight_{day}.csv"
    rec = convert_table(table, EXAMPLES / "wisconsin_helicopter.toml")
    raw = np.genfromtxt(table, delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert len(rec) == raw.size
    assert rec.readings == ("terrain_m",)
    assert rec.has_truth
    np.testing.assert_array_equal(np.sort(rec.lat_deg), np.sort(raw["Lat"]))
    np.testing.assert_allclose(np.sort(rec.columns["terrain_m"]), np.sort(raw["DEM"]), atol=1e-9)
    north, east = offset_m(rec.lat_deg[:-1], rec.lon_deg[:-1], rec.lat_deg[1:], rec.lon_deg[1:])
    assert (
        np.max(np.hypot(north, east) / np.diff(rec.time_s)) < 40.0
    )  # sorted by time the track is one a helicopter flies
    assert rec.source["start_utc"].startswith(f"{day[:4]}-{day[4:6]}-{day[6:]}T1")


def test_helicopter_from_its_projected_coordinates(shared_data: Path, tmp_path: Path) -> None:
    text = (EXAMPLES / "wisconsin_helicopter.toml").read_text(encoding="utf-8")
    text = text.replace('lat_deg = "Lat"\nlon_deg = "Lon"\n', "")
    text += '\n[position]\ncrs = "EPSG:3070"\neasting = "E_Nad83"\nnorthing = "N_Nad83"\n'
    (tmp_path / "projected.toml").write_text(text, encoding="utf-8")
    table = shared_data / "wisconsin_helicopter" / "flight_20210203.csv"
    projected = convert_table(table, tmp_path / "projected.toml")
    rec = convert_table(table, EXAMPLES / "wisconsin_helicopter.toml")
    error = np.hypot(*offset_m(rec.lat_deg, rec.lon_deg, projected.lat_deg, projected.lon_deg))
    assert np.max(error) < 1e-3


def test_cruise(shared_data: Path) -> None:
    table = shared_data / "ship_ew0007" / "ew0007_first_half.csv"
    rec = convert_table(table, EXAMPLES / "ship_ew0007.toml")
    assert rec.readings == ("depth_m", "gravity_mgal")
    assert rec.source["rows"] == "13292 of 13800 kept; 508 dropped as out of reach at 8 m/s"
    assert rec.source["start_utc"] == "2000-07-17T00:35:00Z"
    first = next(rec.epochs())
    assert [(m.kind, m.value) for m in first.measurements] == [("bathymetry", -980.0), ("gravity", 20.8)]
    # the rows at whole tens of minutes, where the false times were, now lie on the track of the others
    minute = np.round(rec.time_s / 60.0 + 35.0) % 60
    tens = (minute % 10 == 0) & (minute > 0)
    lat, lon = (np.interp(rec.time_s[tens], rec.time_s[~tens], values[~tens]) for values in (rec.lat_deg, rec.lon_deg))
    assert np.max(np.hypot(*offset_m(lat, lon, rec.lat_deg[tens], rec.lon_deg[tens]))) < 1000.0


def test_an_airborne_line_without_header(shared_data: Path, tmp_path: Path) -> None:
    names = ["Flight", "Line", "Original", "Fiducial", "E66", "N66", "E", "N", "Radar", "Baro", "Srtm", "Mag"]
    (tmp_path / "geotem.toml").write_text(
        f'[table]\ndelimiter = "whitespace"\nnames = {names}\nnull = [-999999.9]\n[time]\nrate_hz = 4\n'
        '[position]\ncrs = "EPSG:28354"\neasting = "E"\nnorthing = "N"\n'
        '[columns]\nalt_m = "Baro"\nradar_altitude_m = "Radar"\n[rows]\nwhere = {Line = 10010}\nmax_speed_mps = 120\n'
    )
    rec = convert_table(shared_data / "geotem_1996" / "Geotem_GSQ823.dat", tmp_path / "geotem.toml")
    speed = np.hypot(*offset_m(rec.lat_deg[:-1], rec.lon_deg[:-1], rec.lat_deg[1:], rec.lon_deg[1:])) / np.diff(
        rec.time_s
    )
    assert 50.0 < np.median(speed) < 90.0
    assert "dropped" not in rec.source["rows"]
    assert rec.columns["radar_altitude_m"][0] == 109.0

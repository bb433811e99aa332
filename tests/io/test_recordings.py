"""Recordings in files: exact round trips, and one clear line for everything that is wrong."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from terranav.core.errors import DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import COLUMNS, HEIGHTS, RAW, READY, Recording
from terranav.io.recordings import read_recording, write_recording

HEADER = "time_s,lat_deg,lon_deg,alt_m"
ROWS = f"{HEADER},terrain_m\n0,47,9,500,100\n1,47.1,9.1,500,\n"


def same(a: Recording, b: Recording) -> bool:
    return (
        list(a.columns) == list(b.columns)
        and all(np.array_equal(a.columns[key], b.columns[key], equal_nan=True) for key in a.columns)
        and all(np.array_equal(np.signbit(a.columns[key]), np.signbit(b.columns[key])) for key in a.columns)
        and (a.ins, dict(a.sigma), dict(a.source), a.name) == (b.ins, dict(b.sigma), dict(b.source), b.name)
        and dict(a.datum) == dict(b.datum)
    )


VALUES = st.one_of(st.just(float("nan")), st.floats(allow_nan=False, allow_infinity=False))
TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    n = draw(st.integers(1, 6))

    def column(values: st.SearchStrategy[float]) -> np.ndarray:
        return np.array(draw(st.lists(values, min_size=n, max_size=n)), dtype=np.float64)

    times = draw(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=n, max_size=n, unique=True))
    columns = {
        "time_s": np.array(sorted(times)),
        "lat_deg": column(st.floats(-90, 90)),
        "lon_deg": column(st.floats(-180, 360)),
        "alt_m": column(st.floats(-12000, 100000)),
    }
    for key in draw(st.lists(st.sampled_from([*READY, *RAW, "vn_mps", "heading_deg"]), unique=True, max_size=4)):
        columns[key] = column(VALUES)
    if draw(st.booleans()):
        columns["terrain_sigma_m"] = column(st.floats(min_value=0, exclude_min=True, allow_infinity=False))
    positive = st.floats(min_value=0, exclude_min=True, allow_infinity=False)
    ins = st.builds(InsGrade, position_sigma_m=positive, gyro_walk_deg_per_sqrt_h=positive, name=TEXTS)
    return Recording(
        columns,
        ins=draw(st.none() | ins),
        sigma=draw(st.dictionaries(st.sampled_from([*READY, *RAW]), positive, max_size=3)),
        source=draw(st.dictionaries(TEXTS, TEXTS, max_size=3)),
        name=draw(TEXTS),
        datum=draw(
            st.dictionaries(st.sampled_from(HEIGHTS), st.sampled_from(["EGM96", "EPSG:3855", "MSL"]), max_size=3)
        ),
    )


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(rec=recordings())
def test_round_trip_is_exact(tmp_path: Path, suffix: str, rec: Recording) -> None:
    path = tmp_path / f"flight{suffix}"
    write_recording(rec, path)
    assert same(read_recording(path), rec)
    first = path.read_bytes()
    write_recording(read_recording(path), path)
    assert path.read_bytes() == first


def test_both_formats_say_the_same(tmp_path: Path) -> None:
    (tmp_path / "flight.csv").write_text(ROWS)
    (tmp_path / "flight.toml").write_text("[ins]\nposition_sigma_m = 200\n[sigma]\nterrain_m = 3\n")
    rec = read_recording(tmp_path / "flight.csv")
    assert rec.name == "flight"
    assert rec.ins == InsGrade(position_sigma_m=200.0)
    assert rec.columns["terrain_m"].tolist()[0] == 100.0
    assert np.isnan(rec.columns["terrain_m"][1])
    write_recording(rec, tmp_path / "other.parquet")
    assert same(read_recording(tmp_path / "other.parquet"), rec)
    table = pq.read_table(tmp_path / "other.parquet")
    assert table["terrain_m"].to_pylist() == [100.0, None]
    facts = json.loads(table.schema.metadata[b"terranav.recording"])
    sidecar = tomllib.loads((tmp_path / "flight.toml").read_text())
    assert facts["sigma"] == sidecar["sigma"]


def test_the_csv_is_what_the_contract_says(tmp_path: Path) -> None:
    rec = Recording(
        {
            "time_s": np.array([0.0, 0.1]),
            "alt_m": np.array([500.0, 100.0]),
            "lon_deg": np.array([9.0, 9.1]),
            "lat_deg": np.array([47.0, -0.0]),
            "terrain_m": np.array([np.nan, 1 / 3]),
        },
        source={"who": 'a "b"\n'},
    )
    write_recording(rec, tmp_path / "f.csv")
    text = (tmp_path / "f.csv").read_text()
    assert text == f"{HEADER},terrain_m\n0.0,47.0,9.0,500.0,\n0.1,-0.0,9.1,100.0,0.3333333333333333\n"
    assert tomllib.loads((tmp_path / "f.toml").read_text()) == {"name": "recording", "source": {"who": 'a "b"\n'}}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f.csv", "f.toml"]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_recording_names_what_its_heights_count_from(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "flight.csv").write_text(ROWS)
    (tmp_path / "flight.toml").write_text("[vertical_datum]\nall = 'EPSG:5773'\nalt_m = 'WGS 84 ellipsoid'\n")
    rec = read_recording(tmp_path / "flight.csv")
    assert (rec.datum_of("terrain_m"), rec.datum_of("alt_m")) == ("EPSG:5773", "WGS 84 ellipsoid")
    write_recording(rec, tmp_path / f"again{suffix}")
    again = read_recording(tmp_path / f"again{suffix}")
    assert dict(again.datum) == {"all": "EPSG:5773", "alt_m": "WGS 84 ellipsoid"}
    assert dict(again.between(0.0, 0.5).datum) == dict(again.with_columns(vn_mps=np.zeros(2)).datum) == dict(rec.datum)
    (tmp_path / "flight.toml").write_text("vertical_datum = 'EGM2008'\n")
    short = read_recording(tmp_path / "flight.csv")
    assert (short.datum_of("baro_altitude_m"), dict(short.datum)) == ("EGM2008", {"all": "EGM2008"})
    (tmp_path / "flight.toml").unlink()
    assert read_recording(tmp_path / "flight.csv").datum_of("alt_m") is None


def test_a_datum_that_could_not_be_read_back_is_not_written(tmp_path: Path) -> None:
    columns = {key: np.zeros(1) for key in HEADER.split(",")}
    with pytest.raises(
        DataError, match=r"^recording: vertical_datum of all is 'EGM69' \(did you mean 'EGM96'\?\), exp"
    ):
        write_recording(Recording(columns, datum={"all": "EGM69"}), tmp_path / "f.csv")
    assert not list(tmp_path.iterdir())
    for datum, message in (
        ({"alt": "EGM96"}, r"unknown key 'alt' in \[vertical_datum\]"),
        ({"all": 5}, "all is 5, exp"),
    ):
        with pytest.raises(DataError, match=message):
            Recording(columns, datum=datum)  # type: ignore[arg-type]


def test_a_csv_as_spreadsheets_write_it(tmp_path: Path) -> None:
    text = "\ufeff" + 'lat_deg, "lon_deg",alt_m,time_s\r\n47, 9 ,"500",0\r\n\r\n47,9,5e2,1\r\n'
    (tmp_path / "f.CSV").write_bytes(text.encode())
    rec = read_recording(tmp_path / "f.CSV")
    assert list(rec.columns) == ["time_s", "lat_deg", "lon_deg", "alt_m"]
    assert rec.alt_m.tolist() == [500.0, 500.0]


def test_a_parquet_file_of_another_tool(tmp_path: Path) -> None:
    table = pa.table(
        {
            "time_s": pa.array([0, 1], pa.int64()),
            "lat_deg": pa.array([47.5, 47.25], pa.float32()),
            "lon_deg": [9.0, 9.0],
            "alt_m": [5.0, 6.0],
            "gravity_mgal": pa.array([None, None], pa.null()),
        }
    )
    path = tmp_path / "run=5"  # a folder name that other readers take for a column
    path.mkdir()
    pq.write_table(table, path / "f.parquet")
    rec = read_recording(path / "f.parquet")
    assert rec.lat_deg.tolist() == [47.5, 47.25]
    assert rec.readings == ()
    assert rec.name == "f"


def refused(path: Path, message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        read_recording(path)
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value) or path.with_suffix(".toml").name in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"the file is empty, expected a recording \(.csv or .parquet\)"),
        ("\n\n", "holds no row at all, expected a recording"),
        (HEADER, "zero epochs, expected at least one row"),
        ("time_s,lat_deg,lon_deg\n0,1,2\n", "column alt_m is missing; a recording needs time_s, lat_deg"),
        (f"{HEADER},terain_m\n0,1,2,3,4\n", r"unknown column 'terain_m' \(did you mean 'terrain_m'\?\); known: time_s"),
        (f"{HEADER},Terrain_M\n0,1,2,3,4\n", r"unknown column 'Terrain_M' \(did you mean 'terrain_m'\?\)"),
        (f"{HEADER},alt_m\n0,1,2,3,4\n", "column 'alt_m' stands 2 times, expected once"),
        (f"{HEADER}\n0,1,2,3\n1,abc,2,3\n", r"lat_deg in row 2 is 'abc', expected a number or nothing"),
        (f"{HEADER}\n0,1,2,3\n1,1_000,2,3\n", r"lat_deg in row 2 is '1_000', expected a number or nothing"),
        (f"{HEADER}\n0,1,2,3\n1,1,2\n", "row 2 has 3 cells, expected 4"),
        (f"{HEADER}\n0,1,2,3,4\n", "row 1 has 5 cells, expected 4"),
        (f"{HEADER}\n0,1,2,3\n2,1,2,3\n1,1,2,3\n", "time_s in row 3 is 1.0 after 2.0, expected increasing times"),
        (f"{HEADER}\n0,1,2,3\n0,1,2,3\n", "time_s in row 2 is 0.0 after 0.0, expected increasing times"),
        (f"{HEADER}\n0,,2,3\n", "lat_deg in row 1 is nan, expected a finite number"),
        (f"{HEADER}\n0,95,2,3\n", r"lat_deg in row 1 is 95, expected a value in \[-90, 90\]"),
        (f"{HEADER}\n0,5,361,3\n", r"lon_deg in row 1 is 361, expected a value in \[-180, 360\]"),
        (f"{HEADER},terrain_sigma_m\n0,1,2,3,-4\n", "terrain_sigma_m in row 1 is -4, expected a positive number"),
        (f"{HEADER},terrain_m\n0,1,2,3,inf\n", "terrain_m in row 1 is inf, expected a finite number"),
    ],
)
def test_bad_csv(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "flight.csv"
    path.write_text(text)
    refused(path, message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[inss]\n", r"flight.toml: unknown key 'inss' \(did you mean 'ins'\?\); known: ins, name, sigma, source"),
        ("[ins]\nposition_sigma = 5\n", r"flight.toml: unknown key '\[ins\] position_sigma' \(did you mean 'position_"),
        ("[ins]\nposition_sigma_m = '5'\n", r"flight.toml: \[ins\] position_sigma_m is '5', expected a finite number"),
        ("[ins]\nposition_sigma_m = -5\n", r"flight.toml: \[ins\] position_sigma_m is -5.0, expected a finite number"),
        ("[ins]\nname = 5\n", r"flight.toml: \[ins\] name is 5, expected a text"),
        ("ins = 5\n", r"flight.toml: ins is 5, expected a table \[ins\]"),
        ("[sigma]\nterrain_m = -3.0\n", r"flight.toml: \[sigma\] terrain_m is -3.0, expected a finite number and > 0"),
        ("[sigma]\nterrain = 3.0\n", r"flight.toml: unknown key '\[sigma\] terrain' \(did you mean 'terrain_m'\?\)"),
        ("[source]\nyear = 2021\n", r"flight.toml: \[source\] year is 2021, expected a text"),
        ("vertical_datum = 5\n", r"flight.toml: vertical_datum is 5, expected a text such as \"EGM96\", or a table"),
        ("vertical_datum = 'EGM69'\n", r"flight.toml: \[vertical_datum\] all is 'EGM69' \(did you mean 'EGM96'\?\)"),
        (
            "[vertical_datum]\nalt = 'EGM96'\n",
            r"unknown key '\[vertical_datum\] alt' \(did you mean 'al[tl]_?m?'\?\); known",
        ),
        ("[vertical_datum]\nalt_m = 5\n", r"flight.toml: \[vertical_datum\] alt_m is 5, expected a text"),
        ("name = 3\n", "flight.toml: name is 3, expected a text"),
        ("[ins\n", "flight.toml: is not valid TOML: "),
        ("", "flight.toml: the file is empty, expected what is constant over flight.csv"),
    ],
)
def test_bad_sidecar(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "flight.csv").write_text(ROWS)
    (tmp_path / "flight.toml").write_text(text)
    refused(tmp_path / "flight.csv", message)


def test_binary_sidecar(tmp_path: Path) -> None:
    (tmp_path / "flight.csv").write_text(ROWS)
    (tmp_path / "flight.toml").write_bytes(bytes(range(128, 256)))
    refused(tmp_path / "flight.csv", "flight.toml: is not a UTF-8 text, expected what is constant over flight.csv")


def test_files_that_are_no_recordings(tmp_path: Path) -> None:
    refused(tmp_path / "nowhere.csv", "nowhere.csv: no such file, expected a recording")
    (tmp_path / "folder.csv").mkdir()
    refused(tmp_path / "folder.csv", "folder.csv: is a folder, expected a recording")
    (tmp_path / "flight.txt").write_text(ROWS)
    refused(tmp_path / "flight.txt", "the name ends in '.txt', expected .*terranav convert")
    garbage = bytes(np.random.default_rng(1).integers(0, 256, 5000, dtype=np.uint8))
    for name in ("garbage.csv", "garbage.parquet"):
        (tmp_path / name).write_bytes(garbage)
        refused(tmp_path / name, "is not a")
    (tmp_path / "zeros.csv").write_bytes(bytes(500))
    refused(tmp_path / "zeros.csv", "has NUL characters and is not a text table")


def test_bad_parquet(tmp_path: Path) -> None:
    rec = Recording({key: np.arange(50.0) for key in COLUMNS[:4]})
    path = tmp_path / "flight.parquet"
    write_recording(rec, path)
    path.write_bytes(path.read_bytes()[:-40])
    refused(path, "flight.parquet: is not a readable Parquet file")
    good: dict[str, Any] = {key: [0.0] for key in COLUMNS[:4]}
    pq.write_table(pa.table({**good, "terrain_m": ["high"]}), path)
    refused(path, "column terrain_m is of type string, expected numbers")
    pq.write_table(pa.table({**good, "terain_m": [1.0]}), path)
    refused(path, r"unknown column 'terain_m' \(did you mean 'terrain_m'\?\)")
    pq.write_table(pa.table({**good, "lat_deg": [95.0]}), path)
    refused(path, "flight.parquet: lat_deg in row 1 is 95")
    pq.write_table(pa.table({key: pa.array([], pa.float64()) for key in good}), path)
    refused(path, "flight.parquet: zero epochs")
    for metadata, message in [
        (b"{", "is not valid JSON"),
        (b"[]", r"is \[\], expected an object"),
        (b'{"inss": {}}', r"unknown key 'inss' \(did you mean 'ins'\?\)"),
        (b'{"sigma": {"terrain_m": "x"}}', r"\[sigma\] terrain_m is 'x', expected a finite number"),
    ]:
        pq.write_table(pa.table(good, metadata={b"terranav.recording": metadata}), path)
        refused(path, message)


def test_writing_where_one_cannot(tmp_path: Path) -> None:
    rec = Recording({key: np.arange(2.0) for key in COLUMNS[:4]})
    for target, message in [
        (tmp_path / "flight.txt", "the name ends in '.txt', expected a recording"),
        (tmp_path / "no" / "flight.csv", "no is not a folder"),
        (tmp_path / "no" / "flight.parquet", "no is not a folder"),
    ]:
        with pytest.raises(DataError, match=message):
            write_recording(rec, target)
    (tmp_path / "taken.parquet").mkdir()
    with pytest.raises(DataError, match=r"taken.parquet: is a folder, expected the name of a file"):
        write_recording(rec, tmp_path / "taken.parquet")


def test_a_toml_file_of_another_kind_is_not_overwritten(tmp_path: Path) -> None:
    scenario = tmp_path / "flight.toml"
    scenario.write_text('map = "dem.tif"\n')
    rec = Recording({key: np.arange(2.0) for key in COLUMNS[:4]})
    with pytest.raises(DataError, match=r"flight.toml: would be overwritten, but unknown key 'map'"):
        write_recording(rec, tmp_path / "flight.csv")
    assert scenario.read_text() == 'map = "dem.tif"\n'
    assert not (tmp_path / "flight.csv").exists()


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_failed_write_leaves_the_old_file(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rec = Recording({key: np.arange(2.0) for key in COLUMNS[:4]})
    path = tmp_path / f"flight{suffix}"
    write_recording(rec, path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(DataError, match=r"cannot be written \(No space left on device\)"):
        write_recording(rec.between(0, 0), path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before

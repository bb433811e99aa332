"""The datum guard of a run: heights converted, refused or doubted, and nothing said where nothing is wrong."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import terranav as tn
from terranav.core.errors import DataError, DataWarning
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import FloatArray, Recording
from terranav.experiment.datums import DatumGuard, allows_offset
from terranav.experiment.inputs import Inputs, prepare
from terranav.io import geoid as geoid_io
from terranav.io.geoid import open_geoid
from terranav.io.tables import convert_table
from terranav.maps.datum import Geoid
from terranav.maps.map import Map
from terranav.matchers.tercom import Tercom
from terranav.matchers.windowed import Windowed

N = 40
STEP = 0.25
INS = InsGrade(position_sigma_m=200.0, velocity_sigma_mps=0.5)


def a_geoid(datum: str, level: float = 0.0) -> Geoid:
    """About 48 m over 44..50 N, 6..14 E; it slopes."""
    lat, lon = 50.0 - STEP * np.arange(25)[:, None], 6.0 + STEP * np.arange(33)[None, :]
    values = 48.0 + level + 0.8 * (lat - 47.0) + 0.5 * np.sin(lon)
    return Geoid.from_values(values, (STEP, 0.0, 6.0 - STEP / 2, 0.0, -STEP, 50.0 + STEP / 2), datum, f"{datum}.gtx")


EGM96, EGM2008 = a_geoid("EGM96"), a_geoid("EGM2008", -0.6)
BOTH = DatumGuard((EGM96, EGM2008))


@pytest.fixture(autouse=True)
def _nothing_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geoid_io, "_folders", list)
    monkeypatch.setattr(geoid_io, "_packaged", lambda: None)


def a_map(datum: str | None = None, **changes: Any) -> Map:
    rows, cols = np.mgrid[0:160, 0:160]
    hills = 600.0 + 40.0 * np.sin(rows / 9.0) + 30.0 * np.cos(cols / 7.0) + 10.0 * np.sin((rows + 2 * cols) / 5.0)
    return replace(Map(hills, (0.001, 0.0, 10.0, 0.0, -0.001, 47.16), datum=datum, name="hills"), **changes)


def a_recording(datum: Mapping[str, str] | None = None, *, raw: str = "", above: float = 0.0) -> Recording:
    """A straight flight over the map; `raw` says how the terrain was measured, `above` lifts every height."""
    lat, lon = np.linspace(47.03, 47.13, N), np.linspace(10.04, 10.12, N)
    ground = a_map().sample(lat, lon)
    columns: dict[str, FloatArray] = {
        "time_s": np.arange(N, dtype=np.float64),
        "lat_deg": lat,
        "lon_deg": lon,
        "alt_m": np.full(N, 1500.0) + above,
    }
    sigma = {"terrain_m": 3.0}
    if not raw:
        columns["terrain_m"] = ground + above
    else:
        columns["radar_altitude_m"] = 1500.0 - ground
        sigma = {"radar_altitude_m": 2.0}
        if "baro" in raw:
            columns["baro_altitude_m"] = np.full(N, 1500.0) + above
            sigma["baro_altitude_m"] = 3.0
    return Recording(columns, INS, sigma, name="flight", datum=dict(datum or {}))


def prepared(rec: Recording, maps: Any, guard: DatumGuard | None = BOTH) -> Inputs:
    """Inputs, with any warning an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        return prepare(rec, maps, None, None, needs_maps=True, guard=guard)


def heights(inputs: Inputs, kind: str = "terrain") -> np.ndarray:
    return np.array([m.value for epoch in inputs.epochs for m in epoch.measurements if m.kind == kind])


@pytest.mark.parametrize(
    ("of_rec", "of_map", "sign96", "sign08"),
    [
        ("ellipsoid", "EGM96 height", -1.0, 0.0),
        ("EPSG:4979", "EGM2008", 0.0, -1.0),
        ("EGM96", "ellipsoid", 1.0, 0.0),
        ("EPSG:3855", "EGM96", -1.0, 1.0),
    ],
)
def test_readings_are_brought_to_the_datum_of_the_map(of_rec: str, of_map: str, sign96: float, sign08: float) -> None:
    rec = a_recording({"all": of_rec})
    inputs = prepared(rec, a_map(of_map))
    shift = sign96 * EGM96.height(rec.lat_deg, rec.lon_deg) + sign08 * EGM2008.height(rec.lat_deg, rec.lon_deg)
    np.testing.assert_allclose(heights(inputs), rec.columns["terrain_m"] + shift, atol=1e-9)
    np.testing.assert_array_equal([epoch.alt_m for epoch in inputs.epochs], rec.alt_m)
    assert len(inputs.assumed) == 1
    assert inputs.assumed[0].startswith(
        f"flight: terrain_m was brought from {'ellipsoid' if of_rec[-1] in 'd9' else ''}"
    )
    assert f"{shift.min():+.2f} to {shift.max():+.2f} m along the indicated track (geoid grid" in inputs.assumed[0]


@pytest.mark.parametrize("raw", ["radar", "radar and baro"])
def test_raw_readings_are_converted_by_what_their_altitude_counts_from(raw: str) -> None:
    """An ellipsoidal altitude less a radar height is an ellipsoidal terrain height; a barometer's is its own."""
    above = EGM96.height(np.linspace(47.03, 47.13, N), np.linspace(10.04, 10.12, N))
    rec = a_recording({"alt_m": "ellipsoid", "baro_altitude_m": "EGM96"}, raw=raw)
    lifted = rec.with_columns(alt_m=rec.alt_m + above)
    inputs = prepared(lifted, a_map("EGM96"))
    np.testing.assert_allclose(heights(inputs), a_map().sample(rec.lat_deg, rec.lon_deg), atol=1e-6)
    np.testing.assert_array_equal([epoch.alt_m for epoch in inputs.epochs], lifted.alt_m)
    assert len(inputs.assumed) == (1 if raw == "radar" else 0)


def test_a_barometer_that_stops_leaves_the_altitude_to_be_converted() -> None:
    above = EGM96.height(np.linspace(47.03, 47.13, N), np.linspace(10.04, 10.12, N))
    rec = a_recording({"alt_m": "ellipsoid", "baro_altitude_m": "EGM96"}, raw="radar and baro")
    baro = np.where(np.arange(N) < 20, rec.columns["baro_altitude_m"], np.nan)
    rec = rec.with_columns(alt_m=rec.alt_m + above, baro_altitude_m=baro)
    inputs = prepared(rec, a_map("EGM96"))
    np.testing.assert_allclose(heights(inputs), a_map().sample(rec.lat_deg, rec.lon_deg), atol=0.02)
    assert inputs.assumed[0].startswith("flight: alt_m was brought from ellipsoid to EGM96 by -47.78 to")


def test_depths_are_converted_with_their_sign() -> None:
    sea = a_map("EGM96", values=a_map().values - np.float32(2000.0), kind="bathymetry")
    rec = a_recording()
    depth = -sea.sample(rec.lat_deg, rec.lon_deg)
    columns = {key: value for key, value in rec.columns.items() if key != "terrain_m"}
    rec = Recording({**columns, "depth_m": depth}, INS, {"depth_m": 5.0}, name="dive", datum={"depth_m": "EGM2008"})
    expected = -depth + EGM2008.height(rec.lat_deg, rec.lon_deg) - EGM96.height(rec.lat_deg, rec.lon_deg)
    np.testing.assert_allclose(heights(prepared(rec, sea), "bathymetry"), expected, atol=1e-9)


def test_the_same_datum_in_other_words_changes_no_bit() -> None:
    plain = prepared(a_recording(), a_map(), None)
    named = prepared(a_recording({"all": "EPSG:5773"}), a_map("EGM96 height"), None)
    assert named.epochs == plain.epochs
    assert named.assumed == plain.assumed == ()


def test_a_run_is_the_same_wherever_its_heights_count_from() -> None:
    """Ellipsoidal readings over an EGM96 map: the same fix as with readings that were EGM96 all along."""
    rec = a_recording({"all": "EGM96"})
    lifted = rec.with_columns(terrain_m=rec.columns["terrain_m"] + EGM96.height(rec.lat_deg, rec.lon_deg))
    lifted = replace(lifted, datum={"all": "ellipsoid"})
    straight, converted = prepared(rec, a_map("EGM96")), prepared(lifted, a_map("EGM96"))
    np.testing.assert_allclose(heights(converted), heights(straight), atol=1e-9)
    with pytest.raises(DataError, match="107 m"):
        tn.run("pointmass", lifted, a_map("EGM96"))


@pytest.mark.parametrize(
    ("rec", "maps", "guard", "message"),
    [
        (
            a_recording({"all": "ellipsoid"}),
            a_map("EGM96"),
            DatumGuard(),
            r"^flight: terrain_m counts from ellipsoid, but the map hills from EGM96: .* up to 107 m, .* expected the "
            r"geoid grid of EGM96 \(geoid=, --geoid FILE\)$",
        ),
        (
            a_recording({"all": "EGM96"}, raw="radar"),
            a_map("ellipsoid"),
            DatumGuard(),
            "^flight: alt_m counts from EGM96",
        ),
        (
            a_recording({"all": "local"}),
            a_map("EGM96"),
            DatumGuard(allows_offset=False),
            r"counts from local, but the map hills from EGM96: .* not allow for it; .* \(marginalized, or tercom",
        ),
        (a_recording({"all": "EGM69"}), a_map("EGM96"), None, r"^flight: vertical_datum of terrain_m is 'EGM69' \(did"),
        (
            a_recording(),
            [a_map("EGM96"), a_map("EGM2008", name="valley")],
            None,
            "^hills counts heights from EGM96, but valley from EGM2008; expected one vertical datum",
        ),
        (
            a_recording({"all": "ellipsoid"}),
            a_map("EGM96"),
            DatumGuard(Geoid.from_values(np.zeros((3, 3)), (1.0, 0.0, 60.0, 0.0, -1.0, 10.0), "EGM96", "far.gtx")),
            r"^far\.gtx: no geoid height at 47\.0300 N, 10\.0400 E, expected a grid that covers it",
        ),
    ],
)
def test_what_cannot_be_brought_together_is_refused(
    rec: Recording, maps: Any, guard: DatumGuard | None, message: str
) -> None:
    with pytest.raises(DataError, match=message) as caught:
        prepared(rec, maps, guard)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("of_rec", "of_map", "guard", "message"),
    [
        (
            "EGM96",
            "EGM2008",
            DatumGuard(EGM96),
            r"terrain_m and the map hills: EGM96 and EGM2008 differ by 0\.5 m \(rms\)",
        ),
        ("mean sea level", "EGM2008", BOTH, "mean sea level and EGM2008 differ by a metre or two$"),
        ("mean sea level", "ellipsoid", BOTH, "a metre or two; the geoid of EGM2008 stands in"),
        ("MLLW", "EGM2008", BOTH, "differ by the tide, up to several metres"),
        ("local", "EGM2008", BOTH, "local and EGM2008 differ by a constant that nothing here knows"),
        ("local", "EGM2008", DatumGuard(allows_offset=True), "differ by a constant"),
    ],
)
def test_what_is_left_out_is_a_warning_with_its_figure(
    of_rec: str, of_map: str, guard: DatumGuard, message: str
) -> None:
    above = 48.0 if of_map == "ellipsoid" else 0.0
    chart = a_map(of_map, values=a_map().values + np.float32(above))
    with pytest.warns(DataWarning, match=message) as caught:
        inputs = prepare(a_recording({"all": of_rec}), chart, None, None, needs_maps=True, guard=guard)
    assert [str(one.message) for one in caught] == list(inputs.assumed)[:1]


@pytest.mark.parametrize(
    ("of_rec", "of_map"),
    [({}, None), ({}, "EGM96"), ({}, "NAVD 88"), ({"all": "unknown"}, "EGM96"), ({"all": "EGM96"}, None)],
)
def test_an_unknown_datum_is_no_word_while_the_levels_agree(of_rec: dict[str, str], of_map: str | None) -> None:
    assert prepared(a_recording(of_rec), a_map(of_map), DatumGuard(allows_offset=False)).assumed == ()


@pytest.mark.parametrize(
    ("of_rec", "of_map", "above", "guard", "message"),
    [
        (
            {},
            "EGM96",
            48.0,
            BOTH,
            r"at least \d\d m above hills, and one does not .* \+4\d m .* do the readings count",
        ),
        (
            {"all": "EGM96"},
            None,
            -48.0,
            BOTH,
            r"\d\d m below hills, .*\+4\d m from the ellipsoid here: does the map count",
        ),
        (
            {},
            None,
            200.0,
            BOTH,
            r"lie at least \d+ m above hills, and neither names its vertical datum; say what heights",
        ),
        ({}, "EGM96", 48.0, DatumGuard(), r"m above hills, and one does not name its vertical datum; say what"),
    ],
)
def test_levels_that_differ_are_doubted_where_a_datum_is_unknown(
    of_rec: dict[str, str], of_map: str | None, above: float, guard: DatumGuard, message: str
) -> None:
    flat = a_map(of_map, values=600.0 + 0.1 * (a_map().values - 600.0))
    rec = a_recording(of_rec)
    rec = rec.with_columns(terrain_m=flat.sample(rec.lat_deg, rec.lon_deg) + above)
    with pytest.warns(DataWarning, match=message) as caught:
        inputs = prepare(rec, flat, None, None, needs_maps=True, guard=guard)
    assert [str(one.message) for one in caught] == list(inputs.assumed)
    assert len(caught) == 1


def test_an_estimator_with_a_bias_is_doubted_later_and_rough_ground_says_nothing() -> None:
    rec = a_recording()
    flat = a_map(values=600.0 + 0.1 * (a_map().values - 600.0))
    off = rec.with_columns(terrain_m=flat.sample(rec.lat_deg, rec.lon_deg) + 25.0)
    assert prepared(off, flat, DatumGuard(allows_offset=True)).assumed == ()
    with pytest.warns(DataWarning, match="m above hills"):
        prepare(off, flat, None, None, needs_maps=True, guard=DatumGuard(allows_offset=False))
    steep = a_map(values=10.0 * (a_map().values - 600.0))
    rough = rec.with_columns(terrain_m=steep.sample(rec.lat_deg, rec.lon_deg) + 25.0)
    assert prepared(rough, steep, DatumGuard(allows_offset=False)).assumed == ()


def test_gravity_has_no_vertical_datum() -> None:
    rec = a_recording({"all": "ellipsoid"})
    columns = {key: value for key, value in rec.columns.items() if key != "terrain_m"}
    rec = Recording({**columns, "gravity_mgal": np.zeros(N)}, INS, {"gravity_mgal": 1.0}, datum=dict(rec.datum))
    chart = a_map("EGM96", values=np.random.default_rng(1).normal(0.0, 5.0, (160, 160)), kind="gravity", unit="mGal")
    assert prepared(rec, chart, DatumGuard()).assumed == ()


def test_who_allows_for_an_offset() -> None:
    chart = a_map()
    assert allows_offset("marginalized", {})
    assert allows_offset("tercom", {"remove_mean": True})
    assert allows_offset(Windowed(Tercom((chart,), remove_mean=True), INS), {})
    assert allows_offset(tn.make_estimator("marginalized", [chart], INS), {})
    assert not allows_offset("tercom", {})
    assert not allows_offset("pointmass", {"cell_m": 30.0})
    assert not allows_offset(Tercom((chart,)), {})


def test_a_datum_is_told_with_the_provenance() -> None:
    rec = a_recording({"all": "ellipsoid"})
    inputs = prepared(rec, a_map("EGM96"))
    result = tn.run("ins", rec)
    assert result.provenance["assumed"] == []  # no map, nothing to compare
    assert any("terrain_m was brought from ellipsoid to EGM96" in text for text in inputs.assumed)


def test_a_real_flight_in_ellipsoidal_heights(shared_data: Path, tmp_path: Path) -> None:
    """Over Wisconsin, with a real geoid: refused without the grid, and with it the readings come back to the map."""
    facts = (
        'position_is_true = true\n[time]\nrate_hz = 0.05\n[columns]\nlat_deg = "Lat"\nlon_deg = "Lon"\nalt_m = "Alt"\n'
        'terrain_m = {subtract = ["Alt", "Height"]}\n[rows]\non_bad_fix = "drop"\n[sigma]\nterrain_m = 2.0\n'
    )
    (tmp_path / "columns.toml").write_text(facts)
    flight = convert_table(shared_data / "wisconsin_helicopter" / "flight_20210125.csv", tmp_path / "columns.toml")
    flight = tn.add_drift(flight, InsGrade(position_sigma_m=500.0, velocity_sigma_mps=0.5), 7)
    dem = tn.open_map(shared_data / "wisconsin_helicopter" / "land_surface_100m.tif")
    geoid = open_geoid(shared_data / "gravity" / "egm2008_2p5min_wisconsin_ne.nc")
    height = geoid.height(flight.columns["true_lat_deg"], flight.columns["true_lon_deg"])
    high = flight.with_columns(terrain_m=flight.columns["terrain_m"] + height)
    plain = heights(prepared(flight, dem, DatumGuard()))
    named, chart = replace(high, datum={"all": "ellipsoid"}), replace(dem, datum="EGM2008")
    np.testing.assert_allclose(heights(prepared(named, chart, DatumGuard(geoid))), plain, atol=0.1)
    with pytest.raises(DataError, match=r"counts from ellipsoid, but the map land_surface_100m\.tif from EGM2008"):
        prepared(named, chart, DatumGuard())
    with pytest.warns(
        DataWarning, match=r"at least \d\d m below .* \(the geoid is -37 m from the ellipsoid here: do the r"
    ):
        prepare(high, dem, None, None, needs_maps=True, guard=DatumGuard(geoid))

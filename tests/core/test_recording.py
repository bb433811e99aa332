"""Recording: what it refuses, what it tells, and the stream of epochs it gives to estimators."""

from __future__ import annotations

import pickle
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.errors import DataError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.core.kinds import KINDS
from terranav.core.recording import DEFAULT_RAW_SIGMA_M, RAW, READY, Recording
from terranav.core.records import Epoch

NAN = np.nan


def columns(n: int = 4, **more: Any) -> dict[str, NDArray[np.float64]]:
    base = {
        "time_s": np.arange(n, dtype=float),
        "lat_deg": np.linspace(45.0, 45.1, n),
        "lon_deg": np.linspace(9.0, 9.1, n),
        "alt_m": np.full(n, 800.0),
    }
    return base | {key: np.asarray(value, dtype=float) for key, value in more.items()}


def test_epochs_carry_the_indicated_state_and_the_readings_in_the_maps_sign() -> None:
    rec = Recording(
        columns(
            3,
            vn_mps=[1, 2, NAN],
            ve_mps=[3, 4, 5],
            vd_mps=[0, 0, 0],
            roll_deg=[1, 1, 1],
            pitch_deg=[2, 2, 2],
            heading_deg=[90, 91, 92],
            depth_m=[100, NAN, 120],
            depth_sigma_m=[NAN, 1, 7],
            gravity_mgal=[NAN, NAN, -30],
            radar_altitude_m=[50, NAN, NAN],
        ),
        sigma={"depth_m": 4},
    )
    first, second, third = rec.epochs()
    assert (first.time_s, first.lat_deg, first.lon_deg, first.alt_m) == (0.0, 45.0, 9.0, 800.0)
    assert first.velocity_mps == (1.0, 3.0, 0.0)
    assert third.velocity_mps is None  # one of the three is missing
    assert second.attitude_deg == (1.0, 2.0, 91.0)
    assert [(m.kind, m.value, m.sigma) for m in first.measurements] == [
        ("bathymetry", -100.0, 4.0),
        ("radar_altitude", 50.0, DEFAULT_RAW_SIGMA_M["radar_altitude_m"]),
    ]
    assert second.measurements == ()
    assert [(m.kind, m.value, m.sigma) for m in third.measurements] == [
        ("bathymetry", -120.0, 7.0),
        ("gravity", -30.0, KINDS["gravity"].default_sigma),
    ]


@given(st.lists(st.one_of(st.just(NAN), st.floats(-400, 8000)), min_size=1, max_size=20))
def test_every_reading_arrives_once_and_nothing_else(heights: list[float]) -> None:
    rec = Recording(columns(len(heights), terrain_m=heights))
    epochs = list(rec.epochs())
    assert [epoch.time_s for epoch in epochs] == rec.time_s.tolist()
    seen = [(i, m.value) for i, epoch in enumerate(epochs) for m in epoch.measurements]
    assert seen == [(i, height) for i, height in enumerate(heights) if not np.isnan(height)]


@given(st.floats(0, 30), st.floats(0, 30))
def test_between_cuts_the_stream(a: float, b: float) -> None:
    rec = Recording(columns(31, terrain_m=np.arange(31.0)))
    start, end = sorted((a, b))
    wanted = [epoch for epoch in rec.epochs() if start <= epoch.time_s <= end]
    if wanted:
        assert list(rec.between(start, end).epochs()) == wanted
    else:
        with pytest.raises(DataError, match=r"recording: no epoch has time_s in .*, expected a time within \[0, 30\]"):
            rec.between(start, end)


def test_two_parts_of_a_recording_stream_like_the_whole() -> None:
    rec = Recording(columns(10, terrain_m=np.arange(10.0)), ins=InsGrade(), name="whole")
    parts = [*rec.between(0, 4).epochs(), *rec.between(5, 9).epochs()]
    assert parts == list(rec.epochs())
    assert rec.between(0, 4).ins == rec.ins


def test_the_truth_never_reaches_an_epoch() -> None:
    track = columns(5, terrain_m=np.arange(5.0))
    truth = {"true_lat_deg": [46.0] * 5, "true_lon_deg": [8.0] * 5, "true_alt_m": [1.0] * 5}
    with_truth = Recording({**track, **{key: np.array(value) for key, value in truth.items()}})
    assert list(with_truth.epochs()) == list(Recording(track).epochs())
    assert not [entry.name for entry in fields(Epoch) if "true" in entry.name]


@given(st.floats(-80, 80), st.floats(-180, 179), st.floats(-9000, 9000), st.floats(-9000, 9000))
def test_the_ins_error_is_indicated_minus_true(lat: float, lon: float, north: float, east: float) -> None:
    indicated_lat, indicated_lon = shift(lat, lon, north, east)
    track = columns(1, lat_deg=[indicated_lat], lon_deg=[indicated_lon], true_lat_deg=[lat], true_lon_deg=[lon])
    np.testing.assert_allclose(Recording(track).ins_error_m(), [[north, east]], atol=1e-5)


def test_the_ins_error_needs_the_truth() -> None:
    assert not Recording(columns(2, true_lat_deg=[45, 45])).has_truth
    assert not Recording(columns(2, true_lat_deg=[NAN, NAN], true_lon_deg=[9, 9])).has_truth
    with pytest.raises(StateError, match="needs the columns true_lat_deg and true_lon_deg"):
        Recording(columns()).ins_error_m()
    partly = Recording(columns(2, true_lat_deg=[NAN, 45.1], true_lon_deg=[9.0, 9.1])).ins_error_m()
    assert np.isnan(partly[0]).all()
    np.testing.assert_allclose(partly[1], 0.0, atol=1e-6)


def test_sigma_column_goes_before_the_constant_and_the_constant_before_the_default() -> None:
    for key, kind in READY.items():
        rec = Recording(columns(2, **{key: [1, 1], kind.sigma_column: [9, NAN]}))
        assert rec.sigma_of(key).tolist() == [9.0, kind.default_sigma]
        told = Recording(columns(2, **{key: [1, 1], kind.sigma_column: [9, NAN]}), sigma={key: 3})
        assert told.sigma_of(key).tolist() == [9.0, 3.0]
    for key in RAW:
        assert Recording(columns(1)).sigma_of(key).tolist() == [DEFAULT_RAW_SIGMA_M[key]]


def test_readings_names_the_columns_that_hold_something() -> None:
    rec = Recording(columns(2, terrain_m=[NAN, NAN], gravity_mgal=[1, NAN], baro_altitude_m=[1, 2]))
    assert rec.readings == ("gravity_mgal", "baro_altitude_m")


def test_a_recording_is_its_own_and_cannot_be_written() -> None:
    track = columns()
    rec = Recording(track)
    track["alt_m"][0] = -1.0
    assert rec.alt_m[0] == 800.0
    with pytest.raises(ValueError, match="read-only"):
        rec.alt_m[0] = 0.0
    with pytest.raises(TypeError):
        rec.columns["alt_m"] = track["alt_m"]  # type: ignore[index]
    assert rec.with_columns(alt_m=np.zeros(4)).alt_m.tolist() == [0.0] * 4
    assert rec.alt_m[0] == 800.0


def test_pickle_gives_the_same_recording() -> None:
    rec = Recording(columns(terrain_m=[1, NAN, 3, 4]), InsGrade(name="x"), {"terrain_m": 2}, {"who": "me"}, "flight")
    back = pickle.loads(pickle.dumps(rec))
    assert list(back.columns) == list(rec.columns)
    assert all(back.columns[key].tobytes() == rec.columns[key].tobytes() for key in rec.columns)
    assert (back.ins, back.sigma, back.source, back.name) == (rec.ins, rec.sigma, rec.source, rec.name)
    assert not back.alt_m.flags.writeable


def test_repr_is_one_short_line() -> None:
    rec = Recording(columns(terrain_m=[1, NAN, 3, 4], true_lat_deg=[1] * 4, true_lon_deg=[1] * 4), ins=InsGrade())
    assert repr(rec) == "Recording('recording': 4 epochs in 3.0 s, terrain_m 3, truth, ins)"
    assert repr(Recording(columns())) == "Recording('recording': 4 epochs in 3.0 s, no readings)"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"alt_m": None}, "flight: column alt_m is missing; a recording needs time_s, lat_deg, lon_deg, alt_m"),
        ({"terain_m": [1] * 4}, r"flight: unknown column 'terain_m' \(did you mean 'terrain_m'\?\); known: time_s, "),
        ({"alt_m": [1]}, r"flight: column alt_m has shape \(1,\), expected \(4,\) like time_s"),
        ({"time_s": [0, 2, 1, 3]}, "flight: time_s in row 3 is 1.0 after 2.0, expected increasing times"),
        ({"time_s": [0, 1, 1, 3]}, "flight: time_s in row 3 is 1.0 after 1.0, expected increasing times"),
        ({"lat_deg": [45, NAN, 45, 45]}, "flight: lat_deg in row 2 is nan, expected a finite number"),
        ({"lat_deg": [45, 45, 95, 45]}, r"flight: lat_deg in row 3 is 95, expected a value in \[-90, 90\]"),
        ({"lon_deg": [9, 9, 9, 361]}, r"flight: lon_deg in row 4 is 361, expected a value in \[-180, 360\]"),
        ({"true_lat_deg": [-91, 0, 0, 0]}, r"flight: true_lat_deg in row 1 is -91, expected a value in"),
        ({"terrain_m": [1, np.inf, 1, 1]}, "flight: terrain_m in row 2 is inf, expected a finite number, or none"),
        ({"terrain_sigma_m": [1, 1, -2, 1]}, "flight: terrain_sigma_m in row 3 is -2, expected a positive number"),
        ({"depth_sigma_m": [0, 1, 1, 1]}, "flight: depth_sigma_m in row 1 is 0, expected a positive number"),
    ],
)
def test_bad_columns_get_one_line(change: dict[str, Any], message: str) -> None:
    track: dict[str, Any] = {**columns(), **change}
    with pytest.raises(DataError, match=message) as caught:
        Recording({key: value for key, value in track.items() if value is not None}, name="flight")
    assert "\n" not in str(caught.value)


def test_zero_epochs() -> None:
    with pytest.raises(DataError, match="flight: zero epochs, expected at least one row"):
        Recording(columns(0), name="flight")


@pytest.mark.parametrize(
    ("sigma", "source", "message"),
    [
        ({"terrain_m": -1.0}, {}, r"flight: \[sigma\] terrain_m is -1.0, expected a positive number"),
        ({"terrain_m": True}, {}, r"\[sigma\] terrain_m is True, expected a positive number"),
        ({"terrain_m": NAN}, {}, r"\[sigma\] terrain_m is nan, expected a positive number"),
        ({"terrain": 1.0}, {}, r"unknown key 'terrain' in \[sigma\] \(did you mean 'terrain_m'\?\)"),
        ({}, {"seed": 7}, r"flight: \[source\] seed is 7, expected a text"),
    ],
)
def test_bad_facts_get_one_line(sigma: dict[str, Any], source: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        Recording(columns(), sigma=sigma, source=source, name="flight")

"""The flying test bed: what it sends is true to what it flies, the same bits always, and fixes bring it back."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("jsbsim")

from terranav.core.earth import offset_of, shifted
from terranav.core.errors import ConfigError, DataError, StateError
from terranav.core.ins_grade import InsGrade
from terranav.ins.grades import grade_named
from terranav.io.logs.found import pressure_altitude_m
from terranav.live.mavlink_in import dialect
from terranav.live.records import Fix, Remark
from terranav.live.testbed.aircraft import Aircraft
from terranav.live.testbed.course import plan_course
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.lockstep import Lockstep
from terranav.live.testbed.settings import FlightSettings
from terranav.maps.map import Map
from terranav.maps.sample_dem import sample_map

BOOT_S = 60.0
FAST_DRIFT = InsGrade(3.0, 4.0, 0.0, name="fast")  # some metres a second


@cache
def chart() -> Map:
    return sample_map()


def flight(**told: Any) -> Flight:
    return Flight(chart(), FlightSettings(**{"minutes": 1.0, **told}))


def decoded(frames: list[tuple[int, bytes]]) -> list[Any]:
    link = dialect().MAVLink(None)
    return [link.decode(bytearray(data)) for _, data in frames]


def digest(one: Flight) -> str:
    whole = hashlib.sha256()
    for stamp, data in one:
        whole.update(stamp.to_bytes(8, "big") + data)
    return whole.hexdigest()


@cache
def minute(autopilot: str = "px4") -> tuple[tuple[Any, ...], tuple[tuple[float, Any], ...]]:
    """The messages of a minute, and the truth at every tick."""
    one, messages, truth = flight(autopilot=autopilot), [], []
    while not one.over:
        messages += decoded(list(one.tick()))
        truth.append((one.time_us * 1e-6, one.truth))
    return tuple(messages), tuple(truth)


def of(messages: tuple[Any, ...], name: str) -> list[Any]:
    return [message for message in messages if message.get_type() == name]


def test_same_seed_same_bits() -> None:
    assert digest(flight(minutes=0.2)) == digest(flight(minutes=0.2))
    assert digest(flight(minutes=0.2)) != digest(flight(minutes=0.2, seed=1))


def test_a_key_changes_nothing_but_signatures() -> None:
    signed = flight(minutes=0.2, sign_key=bytes(32))
    plain = decoded(list(flight(minutes=0.2)))
    for one, other in zip(plain, decoded(list(signed)), strict=True):
        assert one.to_dict() == other.to_dict()


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_messages_tell_what_is_flown(autopilot: str) -> None:
    messages, truth = minute(autopilot)
    at = {round((t + BOOT_S) * 1000): state for t, state in truth}
    for message in of(messages, "GLOBAL_POSITION_INT"):
        state = at[message.time_boot_ms]
        north, east = offset_of(state.lat_deg, state.lon_deg, message.lat / 1e7, message.lon / 1e7)
        assert math.hypot(north, east) < 12.0  # GNSS
        assert message.alt / 1e3 == pytest.approx(state.alt_m, abs=12.0)
        assert message.vx / 100.0 == pytest.approx(state.velocity_mps[0], abs=0.6)
        assert message.vz / 100.0 == pytest.approx(state.velocity_mps[2], abs=0.02)
    for message in of(messages, "ATTITUDE"):
        state = at[message.time_boot_ms]
        assert math.degrees(message.roll) == pytest.approx(state.attitude_deg[0], abs=0.3)
        turned = (math.degrees(message.yaw) - state.attitude_deg[2] + 180.0) % 360.0 - 180.0
        assert abs(turned) < 1.5
    for message in of(messages, "DISTANCE_SENSOR"):
        if message.signal_quality == 100:
            state = at[message.time_boot_ms]
            clearance = state.alt_m - float(chart().sample(state.lat_deg, state.lon_deg))
            assert message.current_distance / 100.0 == pytest.approx(clearance, abs=15.0 + 0.05 * clearance)
            assert message.orientation == 25
    heights = [pressure_altitude_m(message.press_abs) for message in of(messages, "SCALED_PRESSURE")]
    assert np.ptp(np.array(heights) - [at[m.time_boot_ms].alt_m for m in of(messages, "SCALED_PRESSURE")]) < 6.0


def test_rates_and_names_are_those_of_the_autopilot() -> None:
    px4, ardupilot = ({message.get_type() for message in minute(autopilot)[0]} for autopilot in ("px4", "ardupilot"))
    assert px4 - ardupilot == {"ALTITUDE", "HIGHRES_IMU"}
    assert ardupilot - px4 == {"RANGEFINDER"}
    for name, rate in (("HEARTBEAT", 1), ("GPS_RAW_INT", 5), ("ATTITUDE", 10), ("LOCAL_POSITION_NED", 10)):
        assert len(of(minute()[0], name)) == 60 * rate + 1
    assert of(minute()[0], "HEARTBEAT")[0].autopilot == 12
    assert of(minute("ardupilot")[0], "HEARTBEAT")[0].autopilot == 3


def test_it_flies_its_course_and_keeps_clear_of_the_ground() -> None:
    one = Flight(chart(), FlightSettings(minutes=3.0, gnss_off_s=math.inf, seed=4))
    for _ in one:
        pass
    facts = one.facts()
    assert facts["off_track_p95_m"] < 300.0  # turns at waypoints included
    assert facts["lowest_m"] > 80.0
    assert facts["own_p95_m"] < 5.0


def test_without_gnss_it_drifts_and_steers_by_what_it_believes() -> None:
    one = flight(minutes=2.0, gnss_off_s=20.0, grade=replace(grade_named("industrial"), position_sigma_m=3.0))
    for _ in one:
        pass
    assert one.facts()["own_last_m"] > 20.0
    assert one.facts()["own_last_m"] == one.facts()["without_fixes_last_m"]


@pytest.mark.parametrize(
    ("autopilot", "kind"), [("px4", "global"), ("px4", "odometry"), ("ardupilot", "odometry"), ("ardupilot", "gps")]
)
def test_fixes_pull_the_vehicle_back(autopilot: str, kind: str) -> None:
    one = flight(minutes=2.0, gnss_off_s=0.0, grade=FAST_DRIFT, autopilot=autopilot)
    d, rng = dialect(), np.random.default_rng(3)
    out = d.MAVLink(None, srcSystem=1, srcComponent=191)
    home = one.course.places[0]
    while not one.over:
        one.tick()
        if one.time_us < 60_000_000 or one.time_us % 500_000:
            continue
        noise = rng.normal(0.0, 5.0, 2)
        lat, lon = shifted(one.truth.lat_deg, one.truth.lon_deg, *noise.tolist())
        now, place = one.time_us + 60_000_000, (round(lat * 1e7), round(lon * 1e7))
        if kind == "global":
            message = d.MAVLink_global_position_sensor_message(0, 0, 0, now, 0, 4, 0, *place, 0.0, 0.0, 5.0, 50.0)
        elif kind == "gps":
            nothing = (0.0, 0.0, 0.0)
            message = d.MAVLink_gps_input_message(
                now, 0, 8 | 16 | 32, 0, 0, 3, *place, 0.0, 1.0, 1.0, *nothing, 1.0, 5.0, 50.0, 10, 0
            )
        else:
            pose = [0.0] * 21
            pose[0] = pose[6] = 25.0
            at = offset_of(*home, lat, lon)
            message = d.MAVLink_odometry_message(
                now, 20, 12, *at, 0.0, [1.0, 0.0, 0.0, 0.0], 0, 0, 0, 0, 0, 0, pose, [0.0] * 21, 0, 0, 90
            )
        one.take(message.pack(out))
    facts = one.facts()
    assert facts["fixes_used"] > 100
    assert facts["without_fixes_last_m"] > 100.0
    assert facts["own_last_m"] < 12.0


def test_gnss_is_lost_jammed_and_pulled_away_as_told() -> None:
    lost = of(tuple(decoded(list(flight(minutes=0.5, gnss_off_s=10.0)))), "GPS_RAW_INT")
    assert [m.fix_type >= 3 for m in lost] == [m.time_usec < 70_000_000 for m in lost]
    never = math.inf
    jammed = of(tuple(decoded(list(flight(minutes=0.5, gnss_off_s=never, jam_at_s=5.0)))), "GPS_RAW_INT")
    worst = max(m.h_acc for m in jammed if m.fix_type >= 3)
    assert worst > 10 * jammed[0].h_acc
    assert jammed[-1].fix_type < 3
    one, off = flight(gnss_off_s=never, spoof_at_s=20.0, spoof_mps=3.0), []
    while not one.over:
        for message in of(tuple(decoded(list(one.tick()))), "GPS_RAW_INT"):
            place = one.truth.lat_deg, one.truth.lon_deg
            off.append((one.time_us * 1e-6, math.hypot(*offset_of(*place, message.lat / 1e7, message.lon / 1e7))))
    for time_s, away in off:
        assert away == pytest.approx(3.0 * max(time_s - 20.0, 0.0), abs=9.0)
    assert one.own_error_m > 60.0  # the vehicle believes it


def test_reports_of_the_ins_are_corrected_by_nothing() -> None:
    own, ins = (flight(gnss_off_s=math.inf, grade=FAST_DRIFT, reports=what) for what in ("own", "ins"))
    far = []
    for one in (own, ins):
        last = of(tuple(decoded(list(one))), "GLOBAL_POSITION_INT")[-1]
        far.append(math.hypot(*offset_of(one.truth.lat_deg, one.truth.lon_deg, last.lat / 1e7, last.lon / 1e7)))
    assert far[0] < 6.0
    assert far[1] > 40.0


def test_the_engine_holds_the_vehicle_in_lock_step() -> None:
    loop = Lockstep(Flight(chart(), FlightSettings(minutes=2.5, gnss_off_s=60.0, seed=1)), [chart()])
    usable, remarks = [], []
    while not loop.flight.over:
        for said in loop.step():
            if isinstance(said, Remark):
                remarks.append(said)
            elif isinstance(said, Fix) and said.usable:
                true = loop.flight.truth
                error = math.hypot(*offset_of(true.lat_deg, true.lon_deg, said.lat_deg, said.lon_deg))
                assert error < said.estimate.protection_m
                usable.append(error)
    assert len(usable) > 400
    assert np.percentile(usable, 95) < 100.0
    assert loop.flight.facts()["fixes_used"] > 50
    assert loop.flight.facts()["fix_resets"] == 0
    assert loop.flight.own_error_m < 60.0
    assert not any(remark.level == "error" for remark in remarks)


def test_a_recording_holds_truth_and_readings() -> None:
    one = Flight(chart(), FlightSettings(minutes=0.5), record=True)
    for _ in one:
        pass
    rec = one.recording()
    assert len(rec) == 301
    assert rec.has_truth
    assert rec.readings == ("radar_altitude_m", "baro_altitude_m")
    assert rec.columns["true_alt_m"][-1] == one.truth.alt_m
    with pytest.raises(StateError, match="record=True"):
        flight(minutes=0.1).recording()


def test_jsbsim_is_silent_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    aircraft = Aircraft(46.0, 7.0, 1500.0, 90.0, 50.0)
    aircraft.step(120)
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []
    assert aircraft.state.velocity_mps[1] == pytest.approx(50.0, abs=1.0)


@pytest.mark.parametrize(
    ("told", "match"),
    [
        ({"minutes": 0.0}, "minutes is 0.0"),
        ({"minutes": math.nan}, "minutes"),
        ({"gnss_off_s": -1.0}, "gnss-off is -1.0"),
        ({"autopilot": "px5"}, "did you mean 'px4'"),
        ({"reports": "gps"}, "unknown reports 'gps'"),
        ({"seed": -1}, "seed is -1"),
        ({"system_id": 255}, "system_id is 255"),
        ({"airspeed_mps": 90.0}, "airspeed"),
        ({"sign_key": b"short"}, "sign_key has 5 bytes"),
    ],
)
def test_impossible_settings_are_named(told: dict[str, Any], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        FlightSettings(**told)


def test_maps_that_cannot_be_flown_over_are_named() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(DataError, match=r"jacksboro: .* km, expected at least 14 x 14 km"):
        plan_course(chart().crop(36.55, -84.3, 36.6, -84.25), 1000.0, 150.0, rng)
    with pytest.raises(DataError, match="a map of gravity, expected terrain"):
        plan_course(replace(chart(), kind="gravity", unit="mGal"), 1000.0, 150.0, rng)
    holes = chart().values.copy()
    holes[:, ::12] = np.nan
    with pytest.raises(DataError, match="no leg without voids"):
        plan_course(replace(chart(), values=holes), 1000.0, 150.0, rng)

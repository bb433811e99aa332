"""What the test bed answers: parameters, missions, commands, signatures, and anything else that comes in."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

pytest.importorskip("jsbsim")

from terranav.live.mavlink_in import dialect
from terranav.live.signing import Checker, sign_with
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.settings import FlightSettings
from terranav.maps.sample_dem import sample_map

D = dialect()


def flight(**told: Any) -> Flight:
    one = Flight(sample_map(), FlightSettings(**{"minutes": 1.0, **told}))
    one.tick()
    return one


class Station:
    """A ground station that asks a flight and hears its answers."""

    def __init__(self, one: Flight, system: int = 255, component: int = 190) -> None:
        self.flight = one
        self.out = D.MAVLink(None, srcSystem=system, srcComponent=component)

    def ask(self, message: Any) -> list[Any]:
        self.flight.take(message.pack(self.out))
        return [D.MAVLink(None).decode(bytearray(data)) for _, data in self.flight.answers()]

    def command(self, number: int, *params: float) -> list[Any]:
        seven = [*params, *[0.0] * (7 - len(params))]
        return self.ask(D.MAVLink_command_long_message(1, 1, number, 0, *seven))


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_parameters_are_listed_read_and_set(autopilot: str) -> None:
    station = Station(flight(autopilot=autopilot))
    listed = station.ask(D.MAVLink_param_request_list_message(1, 1))
    assert [one.param_index for one in listed] == list(range(listed[0].param_count))
    name = listed[2].param_id
    (read,) = station.ask(D.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    assert (read.param_id, read.param_value) == (name, listed[2].param_value)
    (told,) = station.ask(D.MAVLink_param_set_message(1, 1, name.encode(), 7.0, 9))
    assert told.param_value == 7.0
    (kept,) = station.ask(D.MAVLink_param_set_message(1, 1, name.encode(), math.nan, 9))
    assert kept.param_value == 7.0
    assert station.ask(D.MAVLink_param_request_read_message(1, 1, b"NOTHING", -1)) == []
    assert station.ask(D.MAVLink_param_request_list_message(9, 1)) == []  # another vehicle


def test_the_mission_is_the_course() -> None:
    one = flight()
    station = Station(one)
    (count,) = station.ask(D.MAVLink_mission_request_list_message(1, 1))
    assert count.count == len(one.course.places)
    (item,) = station.ask(D.MAVLink_mission_request_int_message(1, 1, 1))
    assert (item.x / 1e7, item.y / 1e7) == pytest.approx(one.course.places[1], abs=1e-7)
    assert station.ask(D.MAVLink_mission_request_int_message(1, 1, 999)) == []


def test_commands_are_done_or_refused_and_acknowledged() -> None:
    station = Station(flight())
    version, ack = station.command(520, 1)
    assert version.get_type() == "AUTOPILOT_VERSION"
    assert (ack.command, ack.result, ack.target_system) == (520, 0, 255)
    home, ack = station.command(512, 242)
    assert (home.get_type(), ack.result) == ("HOME_POSITION", 0)
    (ack,) = station.command(512, 9999)
    assert ack.result == D.MAV_RESULT_UNSUPPORTED
    (ack,) = station.command(400, 1)
    assert ack.result == D.MAV_RESULT_UNSUPPORTED
    (ack,) = station.command(511, 30, -1)
    assert ack.result == 0
    sent = [D.MAVLink(None).decode(bytearray(data)).get_type() for _ in range(9) for _, data in station.flight.tick()]
    assert "ATTITUDE" not in sent
    assert "GLOBAL_POSITION_INT" in sent
    (ack,) = station.command(511, math.nan, math.nan)
    assert ack.result == D.MAV_RESULT_UNSUPPORTED


def test_our_time_is_told() -> None:
    (told,) = Station(flight()).ask(D.MAVLink_timesync_message(0, 123))
    assert (told.tc1, told.ts1) == (60_000_000_000, 123)


def reset(one: Flight, **other: Any) -> Any:
    told = {"frame": D.MAV_FRAME_GLOBAL, "param2": 0.1, "param3": 20.0} | other
    place = round(one.truth.lat_deg * 1e7), round(one.truth.lon_deg * 1e7)
    return D.MAVLink_command_int_message(
        1, 1, told["frame"], 43003, 0, 0, 0.0, told["param2"], told["param3"], 0.0, *place, math.nan
    )


def test_a_position_reset_is_taken_while_reckoning_dead_and_not_before() -> None:
    one = flight(autopilot="ardupilot", gnss_off_s=2.0, minutes=0.5)
    station = Station(one)
    (ack,) = station.ask(reset(one))
    assert ack.result == D.MAV_RESULT_FAILED
    for _ in range(120):
        one.tick()
    (ack,) = station.ask(reset(one, param2=9.0))
    assert ack.result == D.MAV_RESULT_FAILED  # too old
    (ack,) = station.ask(reset(one, param3=math.nan))
    assert ack.result == D.MAV_RESULT_DENIED
    (ack,) = station.ask(reset(one))
    assert (ack.command, ack.result) == (43003, D.MAV_RESULT_ACCEPTED)
    assert one.facts()["fix_resets"] == 1
    (ack,) = station.ask(reset(one))
    assert ack.result == D.MAV_RESULT_FAILED  # it has just been told
    (ack,) = Station(flight()).ask(reset(one))
    assert ack.result == D.MAV_RESULT_UNSUPPORTED  # PX4 has no such command


def test_each_autopilot_takes_its_own_messages_only() -> None:
    px4, ardupilot = flight(), flight(autopilot="ardupilot")
    place = round(px4.truth.lat_deg * 1e7), round(px4.truth.lon_deg * 1e7)
    sensor = D.MAVLink_global_position_sensor_message(0, 0, 0, 60_000_000, 0, 4, 0, *place, 0.0, 0.0, 5.0, 50.0)
    for one in (px4, ardupilot):
        Station(one, 1, 191).ask(sensor)
    assert px4.facts()["fixes_used"] == 1
    assert ardupilot.facts()["fixes_used"] == 0
    assert ardupilot.facts()["ignored"] == {"GLOBAL_POSITION_SENSOR": 1}


@pytest.mark.parametrize("field", ["eph", "lat", "time_usec"])
def test_impossible_fixes_are_left(field: str) -> None:
    one = flight()
    place = round(one.truth.lat_deg * 1e7), round(one.truth.lon_deg * 1e7)
    message = D.MAVLink_global_position_sensor_message(0, 0, 0, 60_000_000, 0, 4, 0, *place, 0.0, 0.0, 5.0, 50.0)
    setattr(message, field, {"eph": -1.0, "lat": 2**31 - 1, "time_usec": 1}[field])
    Station(one, 1, 191).ask(message)
    assert one.facts()["fixes_used"] == 0
    assert math.isfinite(one.own_error_m)


def test_noise_on_the_line_does_no_harm() -> None:
    rng = np.random.default_rng(5)
    one, quiet = flight(), flight()
    frame = D.MAVLink_param_request_list_message(1, 1).pack(Station(one).out)
    for k in range(300):
        one.take(rng.bytes(int(rng.integers(1, 80))), peer=k % 40)
        cut = bytearray(frame)
        cut[int(rng.integers(0, len(cut)))] ^= 1 << int(rng.integers(0, 8))
        one.take(bytes(cut[: int(rng.integers(1, len(cut) + 1))]), peer=1)
    one.answers()
    states = [(run.tick(), run.truth)[1] for run in (one, quiet)]
    assert states[0] == states[1]
    assert Station(one).ask(D.MAVLink_param_request_list_message(1, 1))


def test_with_a_key_all_is_signed_and_only_that_is_taken() -> None:
    key = bytes(range(32))
    one = flight(sign_key=key)
    check = Checker(key, lambda: (one.settings.start_us + one.time_us - 1_420_070_400_000_000) // 10)
    assert all(check(data) for _, data in one.tick())
    station = Station(one)
    ask = D.MAVLink_param_request_list_message(1, 1)
    assert station.ask(ask) == []
    sign_with(station.out, bytes(32))
    station.out.signing.timestamp = (one.settings.start_us + one.time_us - 1_420_070_400_000_000) // 10
    assert station.ask(ask) == []  # another key
    station.out.signing.secret_key = key
    assert station.ask(ask)
    assert one.facts()["ignored"] == {"unsigned": 2}


def test_answers_leave_before_what_is_packed_after_them() -> None:
    """Else their stamps are old, and who checks signatures refuses them."""
    key = bytes(range(32))
    one = flight(sign_key=key)
    check = Checker(key, lambda: (one.settings.start_us + one.time_us - 1_420_070_400_000_000) // 10)
    assert all(check(data) for _, data in one.tick())
    station = Station(one)
    sign_with(station.out, key)
    station.out.signing.timestamp = (one.settings.start_us + one.time_us - 1_420_070_400_000_000) // 10
    one.take(D.MAVLink_param_request_list_message(1, 1).pack(station.out))
    sent = [data for _, data in one.tick()]
    assert any(data[7] == D.MAVLINK_MSG_ID_PARAM_VALUE for data in sent)
    assert all(check(data) for data in sent)

"""What each output sends, when, to whom, and why not."""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from terranav.core.earth import shift
from terranav.core.errors import ConfigError
from terranav.live.autopilot import Autopilot
from terranav.live.links import Address, outputs
from terranav.live.mavlink_in import dialect
from terranav.live.mavlink_out import Encoder
from terranav.live.outputs import JsonOutput, MavlinkOutput, NmeaOutput, json_file
from terranav.live.records import Fix, Packet
from terranav.live.websocket import FixServer
from tests.live.test_outputs_gate import NOW_US, fix

SECOND = 1_000_000


class Tape:
    """A wire that keeps what is written."""

    def __init__(self, connected: bool = True) -> None:
        self.address, self.facts = Address("tape", "mavlink", "udpin"), Counter[str]()
        self.connected, self.written = connected, list[bytes]()

    async def open(self, heard: Any) -> None: ...

    async def close(self) -> None: ...

    def write(self, data: bytes) -> bool:
        if self.connected:
            self.written.append(data)
        return self.connected

    @property
    def messages(self) -> list[Any]:
        link = dialect().MAVLink(None)
        return [link.decode(bytearray(data)) for data in self.written]


def packet(message: Any, system: int = 1, component: int = 1, link: int = 0) -> Packet:
    return Packet(NOW_US, link, bytes(message.pack(dialect().MAVLink(None, srcSystem=system, srcComponent=component))))


def beat(autopilot: int, kind: int = 2) -> Any:
    return dialect().MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)


def heard(autopilot: int, *messages: Any) -> Autopilot:
    pilot = Autopilot()
    for message in (beat(autopilot), *messages):
        pilot.hear(packet(message))
    return pilot


def made(pilot: Autopilot, tape: Tape, **more: Any) -> MavlinkOutput:
    told: dict[str, Any] = {"what": None, "max_age_s": 1.0, "rate_hz": None, "correlation_s": 0.0}
    return MavlinkOutput("out", lambda: tape, pilot, Encoder(), on_sent=lambda *_: None, **{**told, **more})


def fixes(count: int, step_us: int = 100_000) -> list[Fix]:
    return [fix(stamp_us=NOW_US + i * step_us, boot_us=12_000_000 + i * step_us) for i in range(count)]


def heard_of(pilot: Autopilot) -> tuple[int | None, str | None, int | None]:
    return pilot.system, pilot.kind, pilot.link


ORIGIN = dialect().MAVLink_gps_global_origin_message(470_000_000, 90_000_000, 400_000)


@pytest.mark.parametrize(("autopilot", "message", "count"), [(12, "GLOBAL_POSITION_SENSOR", 3), (3, "ODOMETRY", 15)])
def test_the_heartbeat_says_what_is_sent_and_how_often(autopilot: int, message: str, count: int) -> None:
    tape = Tape()
    output = made(heard(autopilot, ORIGIN), tape)
    for one in fixes(30):
        output.send(one, one.stamp_us + 5000)
    assert Counter(one.get_type() for one in tape.messages) == {message: count}
    assert output.sent == count
    assert output.held["sent a moment ago"] == 30 - count


def test_an_unknown_autopilot_is_remarked_on_once_and_sent_nothing() -> None:
    tape, pilot = Tape(), Autopilot()
    said = [remark for _ in range(3) for remark in pilot.hear(packet(beat(7)))]
    assert len(said) == 1
    assert "autopilot 7 is neither ArduPilot nor PX4" in said[0].text
    output = made(pilot, tape)
    assert not output.send(fix(), NOW_US)
    assert not tape.written
    assert output.held == {"autopilot not known": 1}
    asked = made(pilot, tape, what="gps-input")
    assert asked.send(fix(), NOW_US)
    assert tape.messages[0].get_type() == "GPS_INPUT"


def test_nothing_is_sent_before_an_autopilot_is_heard() -> None:
    tape = Tape()
    for what in (None, "px4"):
        output = made(Autopilot(), tape, what=what)
        assert not output.send(fix(), NOW_US)
        assert output.held == {"no autopilot heard": 1}
    assert not tape.written


def test_ground_stations_cameras_and_we_ourselves_are_no_vehicle() -> None:
    pilot = Autopilot()
    pilot.hear(packet(beat(8, 6), system=255))
    pilot.hear(packet(beat(3), component=191))
    pilot.hear(packet(beat(8, 30), component=100))
    assert heard_of(pilot) == (None, None, None)
    pilot.hear(packet(beat(12), system=9, link=2))
    assert heard_of(pilot) == (9, "px4", 2)
    pilot.hear(packet(beat(3), system=4))
    assert heard_of(pilot) == (9, "px4", 2)


def test_odometry_waits_for_the_origin_and_asks_for_it() -> None:
    tape, pilot = Tape(), heard(3)
    output = made(pilot, tape)
    assert not output.send(fix(), NOW_US)
    assert output.held == {"origin of the autopilot not known": 1}
    output.tick(NOW_US)
    asked = [one for one in tape.messages if one.get_type() == "COMMAND_LONG"]
    assert [(one.command, one.param1) for one in asked] == [(512, 49.0)]
    pilot.hear(packet(ORIGIN))
    later = fix(stamp_us=NOW_US + SECOND)
    assert output.send(later, NOW_US + SECOND)
    tape.written.clear()
    output.tick(NOW_US + 20 * SECOND)
    assert [one.get_type() for one in tape.messages] == ["HEARTBEAT"]


def test_the_origin_is_found_from_a_local_and_a_global_position() -> None:
    lat, lon = (float(one) for one in shift(47.0, 9.0, 1500.0, -700.0))
    local = dialect().MAVLink_local_position_ned_message(1000, 1500.0 - 4.0, -700.0 + 2.0, -80.0, 20.0, -10.0, 0.0)
    there = dialect().MAVLink_global_position_int_message(
        1200, round(lat * 1e7), round(lon * 1e7), 480_000, 0, 0, 0, 0, 0
    )
    pilot = heard(3, local, there)
    assert pilot.origin is not None
    assert pilot.origin == pytest.approx((47.0, 9.0, 400.0), abs=2e-7)
    pilot.hear(packet(ORIGIN))
    assert pilot.origin == pytest.approx((47.0, 9.0, 400.0), abs=1e-9)
    late = dialect().MAVLink_local_position_ned_message(9000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert heard(3, late, there).origin is None


def test_odometry_without_attitude_is_held() -> None:
    output = made(heard(3, ORIGIN), Tape())
    assert not output.send(fix(attitude_deg=None), NOW_US)
    assert output.held == {"no attitude": 1}


def test_between_rare_fixes_odometry_is_carried_on_within_the_age_limit() -> None:
    tape = Tape()
    output = made(heard(3, ORIGIN), tape)
    one = fix(stamp_us=NOW_US, velocity_mps=(30.0, 0.0, 0.0))
    output.send(one, NOW_US + 5000)
    for i in range(1, 40):
        output.tick(NOW_US + i * 100_000)
    sent = [message for message in tape.messages if message.get_type() == "ODOMETRY"]
    assert len(sent) == 6  # the fix, and five more until it is a second old
    assert sent[-1].x - sent[0].x == pytest.approx(30.0 * 0.995, abs=0.1)
    assert sent[-1].time_usec - sent[0].time_usec == 995_000
    assert sent[-1].pose_covariance[0] > sent[0].pose_covariance[0]


def test_the_reset_counter_never_changes_since_it_would_freeze_the_error() -> None:
    tape = Tape()
    output = made(heard(3, ORIGIN), tape)
    for stamp in (0, 1, 2, 30, 31):
        output.send(fix(stamp_us=NOW_US + stamp * SECOND), NOW_US + stamp * SECOND)
    assert [one.reset_counter for one in tape.messages] == [0] * 5


def test_a_reset_may_be_five_seconds_old_and_other_messages_one() -> None:
    tape, pilot = Tape(), heard(3, ORIGIN)
    old = fix(stamp_us=NOW_US - 4 * SECOND)
    assert made(pilot, tape, what="reset").send(old, NOW_US)
    assert tape.messages[0].param2 == pytest.approx(4.0)
    assert not made(pilot, tape, what="reset").send(fix(stamp_us=NOW_US - 6 * SECOND), NOW_US)
    assert not made(pilot, tape).send(old, NOW_US)


def test_answers_to_resets_are_counted_and_a_refusal_is_said_once() -> None:
    pilot = heard(3)
    answers = [dialect().MAVLink_command_ack_message(43003, result) for result in (0, 2, 2, 0)]
    said = [remark for answer in answers for remark in pilot.hear(packet(answer))]
    assert pilot.answers == {"accepted": 2, "denied": 2}
    assert len(said) == 1
    assert "denied" in said[0].text
    pilot.hear(packet(dialect().MAVLink_command_ack_message(511, 2)))
    assert sum(pilot.answers.values()) == 4


def test_sigmas_are_widened_for_fixes_that_follow_one_another() -> None:
    tape = Tape()
    output = made(heard(12), tape, correlation_s=10.0)
    for stamp in (0, 1, 2):
        output.send(fix(stamp_us=NOW_US + stamp * SECOND), NOW_US + stamp * SECOND)
    first, second, third = (one.eph for one in tape.messages)
    assert first == pytest.approx(15.0)
    assert second == third == pytest.approx(15.0 * (1 / pytest.importorskip("numpy").tanh(0.05)) ** 0.5, rel=1e-5)


def test_a_question_for_our_time_is_answered_on_the_vehicles_clock() -> None:
    tape, pilot = Tape(), heard(12)
    output = made(pilot, tape)
    pilot.hear(packet(dialect().MAVLink_timesync_message(0, 77)))
    output.send(fix(stamp_us=NOW_US, boot_us=12_000_000), NOW_US)
    output.tick(NOW_US + 50_000)
    (answer,) = (one for one in tape.messages if one.get_type() == "TIMESYNC")
    assert (answer.tc1, answer.ts1) == (12_050_000_000, 77)
    output.tick(NOW_US + 60_000)
    assert sum(one.get_type() == "TIMESYNC" for one in tape.messages) == 1


def test_heartbeats_come_once_a_second_from_the_onboard_computer() -> None:
    tape = Tape()
    output = made(heard(12), tape)
    for i in range(31):
        output.tick(NOW_US + i * 100_000)
    beats = tape.messages
    assert len(beats) == 4
    assert {(one.get_srcSystem(), one.get_srcComponent(), one.type, one.autopilot) for one in beats} == {
        (1, 191, 18, 8)
    }


def test_nobody_connected_is_counted() -> None:
    output = made(heard(12), Tape(connected=False))
    assert not output.send(fix(), NOW_US)
    assert output.held == {"nobody is connected": 1}


def test_nmea_once_a_second() -> None:
    tape, kept = Tape(), list[bytes]()
    output = NmeaOutput("n", tape, max_age_s=1.0, rate_hz=None, on_sent=lambda name, stamp, line: kept.append(line))
    for one in fixes(30):
        output.send(one, one.stamp_us)
    assert output.sent == 3
    assert [line[:6] for line in kept] == [b"$GPGGA", b"$GPRMC"] * 3
    assert not output.send(replace(fix(), usable=False), NOW_US)


def test_json_lines_hold_no_position_that_may_not_leave(tmp_path: Path) -> None:
    output = json_file("json:f", tmp_path / "f.jsonl", 1.0)
    assert output.send(fix(), NOW_US)
    assert not output.send(fix(usable=False, withheld=("lost",)), NOW_US)
    assert not output.send(fix(lat_deg=float("nan")), NOW_US)
    output.close()
    good, held, nan = (json.loads(line) for line in (tmp_path / "f.jsonl").read_text(encoding="utf-8").splitlines())
    assert (good["usable"], good["lat_deg"], good["sigma_m"]) == (True, 47.01, [15.0, 12.0])
    assert held == {"stamp_us": NOW_US - 100_000, "usable": False, "status": "converged", "withheld": ["lost"]}
    assert nan["withheld"] == ["not finite"]
    assert "lat_deg" not in nan


def test_a_json_file_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        json_file("json:x", tmp_path / "none" / "x.jsonl", 1.0)


def test_a_reader_that_went_away_costs_the_lines_alone() -> None:
    def gone(line: bytes) -> bool:
        return False

    output = JsonOutput("j", gone, max_age_s=1.0)
    assert not output.send(fix(), NOW_US)
    assert output.held == {"nobody is connected": 1}


def test_websocket_sends_to_programs_and_local_pages_and_no_others() -> None:
    client = pytest.importorskip("websockets.asyncio.client")
    from websockets.exceptions import InvalidStatus

    async def main() -> None:
        server = FixServer(outputs(["ws:0"])[0])
        await server.open()
        place = f"ws://127.0.0.1:{server.port}"
        output = JsonOutput("ws", server.write, max_age_s=1.0)
        assert not output.send(fix(), NOW_US)  # nobody is there
        async with client.connect(place) as one, client.connect(place, origin="http://localhost:8000") as two:
            while not output.send(fix(), NOW_US):
                await asyncio.sleep(0.01)
            for connection in (one, two):
                assert json.loads(await connection.recv())["lat_deg"] == 47.01
        with pytest.raises(InvalidStatus, match="403"):
            await client.connect(place, origin="https://elsewhere.example")
        assert server.facts["refused"] == 1
        await server.close()

    asyncio.run(main())


def test_a_websocket_port_in_use_is_one_line() -> None:
    pytest.importorskip("websockets.asyncio.server")

    async def main() -> None:
        one = FixServer(outputs(["ws:0"])[0])
        await one.open()
        try:
            with pytest.raises(ConfigError, match=f"port {one.port} of 127.0.0.1 is in use"):
                await FixServer(outputs([f"ws:{one.port}"])[0]).open()
        finally:
            await one.close()

    asyncio.run(main())


def test_damaged_frames_do_no_harm() -> None:
    pilot = Autopilot()
    good = packet(beat(3)).data
    for cut in range(len(good)):
        pilot.hear(Packet(0, 0, good[:cut]))
        pilot.hear(Packet(0, 0, good[:cut] + b"\xff" + good[cut + 1 :]))

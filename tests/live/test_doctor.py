"""What the doctor finds of a vehicle that has all, and of one that lacks something."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

from terranav.app.cli import main
from terranav.io.raster_out import write_map
from terranav.live.doctor import Finding, Notes, examined, findings
from terranav.live.links import inputs
from terranav.live.mavlink_in import dialect
from terranav.live.plan import Plan
from terranav.live.records import Packet
from terranav.live.settings import LiveSettings
from terranav.maps.map import Map
from tests.live.flights import HOST_US, Flight, chart

FLIGHT = Flight(seconds=12.0)


def found(packets: Iterable[Packet], maps: tuple[Map, ...] | None = None, **told: Any) -> dict[str, Finding]:
    notes = Notes(("udpin:14550",), told.get("system_id"))
    for packet in packets:
        notes.hear(packet)
    return {one.name: one for one in findings(notes, LiveSettings(**told), maps or (chart(),))}


def changed(edit: Callable[[Any], Any]) -> list[Packet]:
    """The flight with every message edited; None leaves it out."""
    link, packets = dialect().MAVLink(None, srcSystem=1, srcComponent=1), []
    for packet in FLIGHT.packets():
        message = edit(dialect().MAVLink(None).decode(bytearray(packet.data)))
        if message is not None:
            packets.append(Packet(packet.stamp_us, 0, bytes(message.pack(link))))
    return packets


def test_a_vehicle_that_has_all_is_ready() -> None:
    states = {name: one.state for name, one in found(FLIGHT.packets()).items()}
    assert set(states.values()) <= {"ok", "warning"}
    assert [name for name, state in states.items() if state == "warning"] == ["date", "datum"]
    assert {
        "link 0",
        "autopilot",
        "position",
        "attitude",
        "pressure",
        "altimeter",
        "GNSS",
        "clock",
        "map cover",
    } <= set(states)


@pytest.mark.parametrize(
    ("left_out", "name", "state"),
    [
        ("DISTANCE_SENSOR", "altimeter", "missing"),
        ("GLOBAL_POSITION_INT", "position", "missing"),
        ("ATTITUDE", "attitude", "missing"),
        ("SCALED_PRESSURE", "pressure", "warning"),
        ("HEARTBEAT", "autopilot", "warning"),
    ],
)
def test_what_is_not_sent_is_missing_and_what_to_set_is_told(left_out: str, name: str, state: str) -> None:
    one = found(changed(lambda message: None if message.get_type() == left_out else message))[name]
    assert one.state == state
    assert one.advice


def sensor(**fields: Any) -> Callable[[Any], Any]:
    def edit(message: Any) -> Any:
        if message.get_type() == "DISTANCE_SENSOR":
            for key, value in fields.items():
                setattr(message, key, value)
        return message

    return edit


def test_an_altimeter_that_does_not_reach_the_ground() -> None:
    one = found(changed(sensor(current_distance=5000, max_distance=5000)))["altimeter"]
    assert one.state == "missing"
    assert "0% in range, measures 1 to 50 m" in one.text
    near = found(changed(sensor(current_distance=4500, max_distance=5000)))["altimeter"]
    assert (near.state, near.advice) == ("warning", "little is left to its limit: do not climb")


def test_rates_that_are_low() -> None:
    count = iter(range(10**6))
    kept = changed(lambda message: message if message.get_type() != "ATTITUDE" or next(count) % 5 == 0 else None)
    one = found(kept)["attitude"]
    assert one.state == "warning"
    assert one.text == "2.0 Hz, expected 4 or more"
    assert one.advice == "SRx_EXTRA1 10"


def test_off_the_map_and_no_map() -> None:
    def moved(message: Any) -> Any:
        if message.get_type() == "GLOBAL_POSITION_INT":
            message.lat += 30_000_000
        return message

    one = found(changed(moved))["map cover"]
    assert one.state == "missing"
    assert "says nothing at 39." in one.text
    notes = Notes(("a",), None)
    assert {finding.name: finding.state for finding in findings(notes, LiveSettings(), ())}["map"] == "missing"


def test_another_autopilot_and_a_second_vehicle() -> None:
    def other(message: Any) -> Any:
        if message.get_type() == "HEARTBEAT":
            message.autopilot = 7
        return message

    assert found(changed(other))["autopilot"].text == "number 7 is not known"
    second = Flight(seconds=12.0, system=2).packets()
    both = sorted([*FLIGHT.packets(), *second], key=lambda packet: packet.stamp_us)
    one = found(both)["vehicle"]
    assert (one.state, one.text, one.advice) == ("warning", "systems 2 speak too", "--system 1")
    assert "vehicle" not in found(both, system_id=2)
    assert found(FLIGHT.packets(), system_id=5)["vehicle"].state == "missing"


def test_nothing_heard_damage_and_a_clock_that_runs_fast() -> None:
    silent = found([])
    assert silent["link 0"].state == "missing"
    assert "vehicle" not in silent
    damaged = found([*FLIGHT.packets(), Packet(HOST_US, 0, b"\xfd\x05\x00broken")])
    assert damaged["messages"].text == "1 are damaged"
    fast = [Packet(HOST_US + (one.stamp_us - HOST_US) // 3, 0, one.data) for one in FLIGHT.packets()]
    assert found(fast)["clock"].state == "warning"


def test_a_file_and_a_silent_port_are_examined(tmp_path: Path) -> None:
    file = tmp_path / "f.tlog"
    file.write_bytes(b"".join(struct.pack(">Q", one.stamp_us) + one.data for one in FLIGHT.packets()))
    seen = asyncio.run(examined(Plan(inputs([f"file:{file}"])), LiveSettings(), (chart(),)))
    assert [one.name for one in seen if one.state == "missing"] == []
    quiet = asyncio.run(examined(Plan(inputs(["udpin:0"]), stop_after_s=0.05), LiveSettings(), (chart(),)))
    assert quiet[0].state == "missing"


def test_the_command_says_ready_or_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, dem = tmp_path / "f.tlog", tmp_path / "dem.tif"
    file.write_bytes(b"".join(struct.pack(">Q", one.stamp_us) + one.data for one in FLIGHT.packets()))
    write_map(chart(), dem)
    assert main(["doctor", "--in", f"file:{file}", "--map", str(dem)]) == 0
    said = capsys.readouterr().out
    assert "altimeter" in said
    assert "ready, " in said
    assert main(["live", "--check", "--in", f"file:{file}", "--map", str(dem), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ready"] is True
    assert main(["doctor", "--in", f"file:{file}", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in told["findings"] if one["state"] == "missing"] == ["map"]
    assert main(["doctor", "--map", str(dem)]) == 2
    assert capsys.readouterr().err.startswith("terranav: error: --in is not given")

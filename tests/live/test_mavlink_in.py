"""MAVLink in: meanings and scales as in a log's reader, impossible fields left out, whole frames out of bytes."""

from __future__ import annotations

import math
import random
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from terranav.io.logs import open_log
from terranav.live.deframing import Deframer, crc
from terranav.live.engine import Engine
from terranav.live.heard import Altitude, Attitude, Beat, Gnss, Heard, Position, Pressure, Range, Velocity
from terranav.live.mavlink_in import MavlinkIn
from terranav.live.records import Fix
from tests.live.flights import Flight, chart, flown, settings


def frame(message: Any, system: int = 1, component: int = 1, sequence: int = 0) -> bytes:
    link = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
    link.seq = sequence
    return bytes(message.pack(link))


def heard(message: Any) -> Heard:
    found = MavlinkIn().heard(frame(message))
    assert found is not None
    return found


def test_a_position_says_place_altitude_and_velocity() -> None:
    message = dialect.MAVLink_global_position_int_message(5250, 467123456, -71234567, 812_340, 0, 1234, -567, 89, 65535)
    found = heard(message)
    assert found.clock_s == 5.25
    assert found.sender == (1, 1)
    assert found.words == (
        Position(46.7123456, -7.1234567, 812.34),
        Velocity(12.34, -5.67, 0.89, "GLOBAL_POSITION_INT"),
    )


def test_no_place_yet_is_none() -> None:
    found = heard(dialect.MAVLink_global_position_int_message(5250, 0, 0, 812_340, 0, 0, 0, 0, 65535))
    assert found.words[0] == Altitude(812.34)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_what_is_not_finite_is_left_out_and_named(bad: float) -> None:
    found = heard(dialect.MAVLink_attitude_message(1, bad, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert found.words == ()
    assert "ATTITUDE roll" in found.rejected[0]
    found = heard(dialect.MAVLink_scaled_pressure_message(1, bad, 0.0, 0))
    assert found.words == ()
    assert "press_abs" in found.rejected[0]
    found = heard(dialect.MAVLink_local_position_ned_message(1, 0.0, 0.0, 0.0, bad, 0.0, 0.0))
    assert found.words == ()


def test_angles_and_pressure() -> None:
    (attitude,) = heard(dialect.MAVLink_attitude_message(1, 0.1, -0.2, -math.pi / 2, 0.0, 0.0, 0.0)).words
    assert isinstance(attitude, Attitude)
    assert (attitude.roll_deg, attitude.pitch_deg, attitude.heading_deg) == pytest.approx(
        (math.degrees(0.1), math.degrees(-0.2), 270.0), abs=1e-4
    )
    (pressure,) = heard(dialect.MAVLink_scaled_pressure_message(1, 898.746, 0.0, 0)).words
    assert isinstance(pressure, Pressure)
    assert pressure.altitude_m == pytest.approx(1000.0, abs=0.1)  # ICAO standard atmosphere


@pytest.mark.parametrize(
    ("current", "low", "high", "expected"),
    [(12345, 100, 65500, 123.45), (65500, 100, 65500, None), (50, 100, 65500, None), (0, 0, 0, None), (900, 0, 0, 9.0)],
)
def test_ranges_at_their_limits_are_none(current: int, low: int, high: int, expected: float | None) -> None:
    found = heard(dialect.MAVLink_distance_sensor_message(1, low, high, current, 3, 7, 25, 255))
    assert found.words == (Range("radar", "radar 1.7", expected),)


def test_a_range_that_does_not_look_down_or_has_no_signal_is_none() -> None:
    assert heard(dialect.MAVLink_distance_sensor_message(1, 1, 5000, 300, 0, 0, 0, 255)).words == ()
    message = dialect.MAVLink_distance_sensor_message(1, 1, 5000, 300, 0, 0, 25, 255, signal_quality=1)
    assert heard(message).words == (Range("laser", "laser 1.0", None),)


def test_gnss_goes_to_monitors_alone() -> None:
    (word,) = heard(
        dialect.MAVLink_gps_raw_int_message(5, 3, 467123456, 71234567, 812_340, 80, 80, 2000, 9000, 9, h_acc=1500)
    ).words
    assert isinstance(word, Gnss)
    assert (word.fix, word.lat_deg, word.sigma_m) == (3, 46.7123456, 1.5)
    assert word.velocity_mps == pytest.approx((0.0, 20.0), abs=1e-9)
    (none,) = heard(dialect.MAVLink_gps_raw_int_message(5, 1, 0, 0, 0, 80, 80, 65535, 65535, 0)).words
    assert isinstance(none, Gnss)
    assert none.fix == 1
    assert math.isnan(none.lat_deg)


def test_ground_stations_and_cameras_are_no_vehicle() -> None:
    assert heard(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)).words == (Beat(3, 2),)
    assert heard(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)).words == ()
    assert heard(dialect.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)).words == ()


def test_damage_is_none() -> None:
    good = frame(dialect.MAVLink_attitude_message(1, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    reader = MavlinkIn()
    for at in range(1, len(good)):
        assert reader.heard(good[:at]) is None
        flipped = bytearray(good)
        flipped[at] ^= 0x10
        found = reader.heard(bytes(flipped))
        assert found is None or found.words == ()  # another number, which is not read


def test_the_checksum_is_the_protocol_s() -> None:
    assert crc(b"123456789", 0) == dialect.x25crc(b"123456789\0").crc
    good = frame(dialect.MAVLink_attitude_message(1, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0))
    extra = dialect.mavlink_map[30].crc_extra
    assert crc(good[1:-2], extra) == struct.unpack("<H", good[-2:])[0]


def test_frames_come_out_of_bytes_however_they_are_cut() -> None:
    frames = [data for _, data in Flight(seconds=3.0).frames()]
    first = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    old = bytes(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(first, force_mavlink1=True))
    frames.insert(3, old)
    stream, rng = b"".join(frames), random.Random(1)
    deframer, found, at = Deframer(), [], 0
    while at < len(stream):
        size = rng.randrange(1, 90)
        found += deframer.feed(stream[at : at + size])
        at += size
    assert found == frames
    assert deframer.garbage == 0


def test_frames_survive_garbage_between_them_and_none_is_made_up() -> None:
    frames = [data for _, data in Flight(seconds=20.0).frames()]
    rng = random.Random(2)
    deframer, found, noise = Deframer(), [], 0
    for data in frames:
        garbage = rng.randbytes(rng.randrange(0, 40)).replace(b"\xfd", b"").replace(b"\xfe", b"")
        noise += len(garbage)
        found += deframer.feed(garbage + data)
    assert found == frames
    assert deframer.garbage == noise
    for _ in range(300):
        found = deframer.feed(rng.randbytes(1000))
        known = [data for data in found if MavlinkIn().heard(data) is not None and data[7] in (30, 33, 132)]
        assert known == []
    assert len(deframer._rest) < 300  # an unfinished frame at the most


def test_a_log_and_the_engine_see_the_same_flight(tmp_path: Path) -> None:
    flight = Flight(seconds=60.0, kind=0)
    path = tmp_path / "flight.tlog"
    packets = flight.packets()
    path.write_bytes(b"".join(struct.pack(">Q", packet.stamp_us) + packet.data for packet in packets))
    log = open_log(path).recording
    engine = Engine(settings(ins_source="position", spacing_cells=0.0), [chart()])
    epochs = []
    for packet in packets:
        if any(isinstance(one, Fix) for one in engine.feed(packet)) and engine.epoch is not None:
            epochs.append(engine.epoch)
    assert len(epochs) > 550
    start = flight.start_s
    rows = {round(float(t) + start, 3): i for i, t in enumerate(log.time_s)}
    compared = 0
    for epoch in epochs:
        row = rows.get(round(epoch.time_s, 3))
        if row is None or not epoch.measurements or epoch.time_s < start + 6.0:  # the barometer is set by then
            continue
        compared += 1
        assert epoch.lat_deg == pytest.approx(log.lat_deg[row], abs=1e-9)
        assert epoch.lon_deg == pytest.approx(log.lon_deg[row], abs=1e-9)
        assert epoch.alt_m == pytest.approx(log.alt_m[row], abs=1e-6)
        (terrain,) = epoch.measurements
        assert terrain.value == pytest.approx(log.columns["terrain_m"][row], abs=0.15)  # how the barometer is set
        assert terrain.sigma == pytest.approx(log.columns["terrain_sigma_m"][row], rel=1e-6)
    assert compared > 500


def test_speed_of_the_flight_is_heard_as_flown() -> None:
    """The whole chain against the truth: no altimeter, no drift, reckoning by velocity stays within a few metres."""
    flight = Flight(seconds=60.0, drift_mps=(0.0, 0.0))
    packets = [p for p in flight.packets() if p.data[7] != 132]
    engine = Engine(settings(), [chart()])
    fixes, _ = flown(engine, packets)
    away = [flight.error_m(fix) for fix in fixes]
    assert len(fixes) == pytest.approx(120, abs=5)  # two a second while nothing is measured
    assert np.max(away) < 5.0
    assert not any(fix.usable for fix in fixes)

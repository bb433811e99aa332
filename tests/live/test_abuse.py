"""What flights do to messages: nothing crashes, no NaN comes out, no false fix is offered, and recovery is reported.

A false fix is one that is offered as usable and lies farther from the truth than its protection level.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from terranav.live.engine import NAVIGATOR_FAULT, Engine
from terranav.live.records import Fix, Packet, Remark
from tests.live.flights import HOST_US, Flight, chart, flown, settings

SECONDS = 130.0
Packets = list[Packet]


@cache
def flight() -> Flight:
    return Flight(seconds=SECONDS)


def since_start_s(packet: Packet) -> float:
    return (packet.stamp_us - HOST_US) * 1e-6


def number(packet: Packet) -> int:
    return packet.data[7] | packet.data[8] << 8


def changed(packet: Packet, change: Callable[[Any], None]) -> Packet:
    """The packet with fields of its message changed, and a right checksum."""
    message = dialect.MAVLink(None).decode(bytearray(packet.data))
    change(message)
    link = dialect.MAVLink(None, srcSystem=message.get_srcSystem(), srcComponent=1)
    link.seq = packet.data[4]
    return replace(packet, data=bytes(message.pack(link)))


def flown_safely(packets: Packets, truth: Flight | None = None) -> tuple[list[Fix], list[Remark]]:
    """Fly, and hold every fix to what must never happen."""
    engine = Engine(settings(), [chart()])
    fixes, remarks = flown(engine, packets)
    true = truth or flight()
    assert NAVIGATOR_FAULT not in [one.key for one in remarks]
    for fix in fixes:
        numbers = [fix.lat_deg, fix.lon_deg, fix.alt_m, *fix.sigma_m, *(fix.velocity_mps or ())]
        assert all(map(math.isfinite, numbers))
        assert min(fix.sigma_m) > 0.0
        if fix.usable:
            assert true.error_m(fix) <= fix.estimate.protection_m
        else:
            assert fix.withheld
    return fixes, remarks


def held(fixes: list[Fix]) -> bool:
    """Whether most of the last half minute was offered."""
    last = fixes[-1].estimate.time_s
    return float(np.mean([fix.usable for fix in fixes if fix.estimate.time_s > last - 30.0])) > 0.7


def reordered(packets: Packets, rng: random.Random, share: float = 1.0) -> Packets:
    """Each late by up to 2 s, its own time."""
    late = [
        replace(p, stamp_us=p.stamp_us + (rng.randrange(2_000_000) if rng.random() < share else 0)) for p in packets
    ]
    return sorted(late, key=lambda packet: packet.stamp_us)


def test_a_fifth_is_lost() -> None:
    rng = random.Random(1)
    assert held(flown_safely([p for p in flight().packets() if rng.random() > 0.2])[0])


def test_duplicates_change_nothing() -> None:
    rng = random.Random(2)
    doubled = [p for packet in flight().packets() for p in [packet] * (1 + (rng.random() < 0.3))]
    engine = Engine(settings(), [chart()])
    fixes, _ = flown(engine, doubled)
    assert engine.facts["duplicates"] == len(doubled) - len(flight().packets())
    plain, _ = flown(Engine(settings(), [chart()]), flight().packets())
    assert [(f.lat_deg, f.lon_deg, f.usable) for f in fixes] == [(f.lat_deg, f.lon_deg, f.usable) for f in plain]


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_messages_overtake_each_other_by_2_s(share: float) -> None:
    fixes, remarks = flown_safely(reordered(flight().packets(), random.Random(3), share))
    assert held(fixes)
    assert not [one for one in remarks if one.key in ("vehicle restarted", "reckoning broke", "clock step")]


def test_loss_doubles_and_disorder_at_once() -> None:
    rng = random.Random(4)
    packets = [p for packet in flight().packets() if rng.random() > 0.2 for p in [packet] * (1 + (rng.random() < 0.3))]
    assert held(flown_safely(reordered(packets, rng))[0])


@pytest.mark.parametrize("hours", [1.0, -1.0])
def test_the_host_s_clock_is_set_by_an_hour(hours: float) -> None:
    step_us = round(hours * 3.6e9)
    packets = [
        replace(p, stamp_us=p.stamp_us + (step_us if since_start_s(p) > 80.0 else 0)) for p in flight().packets()
    ]
    fixes, remarks = flown_safely(packets)
    assert held(fixes)
    (step,) = [one for one in remarks if one.key == "clock step" and one.level == "warning"]
    assert f"{hours * 3600.0:+.1f} s" in step.text
    assert fixes[-1].stamp_us == pytest.approx(packets[-1].stamp_us, abs=20_000)
    plain, _ = flown(Engine(settings(), [chart()]), flight().packets())
    assert [(f.lat_deg, f.boot_us) for f in fixes] == [(f.lat_deg, f.boot_us) for f in plain]


def test_a_third_of_the_messages_hold_what_is_no_number_or_no_value() -> None:
    rng = random.Random(5)

    def spoil(message: Any) -> None:
        bad = rng.choice([math.nan, math.inf, -math.inf, 1e30, -1e30])
        kind = message.get_type()
        if kind == "ATTITUDE":
            message.roll, message.yaw = bad, rng.choice([bad, message.yaw])
        elif kind == "SCALED_PRESSURE":
            message.press_abs = bad
        elif kind == "VFR_HUD":
            message.airspeed = bad
        elif kind == "GLOBAL_POSITION_INT":
            message.lat = rng.choice([message.lat, 2**31 - 1, -(2**31)])
            message.vx, message.vz = rng.choice([32767, -32768, message.vx]), rng.choice([32767, -32768, message.vz])
            message.alt = rng.choice([message.alt, 2**31 - 1, -(2**31)])
        elif kind == "DISTANCE_SENSOR":
            message.current_distance = rng.choice([0, 65535, 60000])

    packets = [changed(p, spoil) if rng.random() < 0.3 else p for p in flight().packets()]
    fixes, remarks = flown_safely(packets)
    assert held(fixes)
    assert "impossible value" in [one.key for one in remarks]


def test_random_truncated_and_flipped_bytes() -> None:
    rng, packets = random.Random(6), []
    for packet in flight().packets():
        packets.append(packet)
        if rng.random() < 0.2:
            packets.append(replace(packet, data=rng.randbytes(rng.randrange(1, 60))))
        if rng.random() < 0.1:
            packets[-1] = replace(packet, data=packet.data[: rng.randrange(1, len(packet.data))])
        if rng.random() < 0.05:
            flipped = bytearray(packet.data)
            flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
            packets.append(replace(packet, data=bytes(flipped)))
    fixes, remarks = flown_safely(packets)
    assert held(fixes)
    assert {"not understood", "damaged message"} <= {one.key for one in remarks}


def test_wild_positions_velocities_and_times_with_a_right_checksum() -> None:
    rng, packets = random.Random(7), []

    def wild(message: Any) -> None:
        message.lat += rng.randrange(-(10**7), 10**7)
        message.alt += rng.randrange(-(10**6), 10**6)
        message.vx, message.vy = rng.randrange(-32768, 32767), rng.randrange(-32768, 32767)
        message.time_boot_ms += rng.choice([0, 20, -20, 50])

    def late(message: Any) -> None:
        message.time_boot_ms = rng.randrange(2**32)

    for packet in flight().packets():
        packets.append(packet)
        if number(packet) == 33 and rng.random() < 0.05:
            packets.append(changed(packet, rng.choice([wild, late])))
    assert held(flown_safely(packets)[0])


#: message and fields that hang, what is said of it, and whether the fix lasts, or may (None)
HANGS: dict[str, tuple[int, tuple[str, ...], str, bool | None]] = {
    "altimeter": (132, ("current_distance",), "altimeter hangs", None),
    "barometer": (29, ("press_abs",), "", True),
    "velocity": (33, ("vx", "vy", "vz"), "velocity hangs", False),
    "all of the position": (33, ("vx", "vy", "vz", "lat", "lon", "alt"), "velocity hangs", False),
    "attitude": (30, ("roll", "pitch", "yaw"), "attitude hangs", True),
}


@pytest.mark.parametrize("what", HANGS)
def test_a_sensor_that_hangs_is_left_out_and_comes_back(what: str) -> None:
    wanted, fields, key, lasts = HANGS[what]
    frozen: dict[str, Any] = {}

    def freeze(message: Any) -> None:
        for name in fields:
            setattr(message, name, frozen.setdefault(name, getattr(message, name)))

    packets = [
        changed(p, freeze) if number(p) == wanted and 60.0 < since_start_s(p) < 90.0 else p for p in flight().packets()
    ]
    fixes, remarks = flown_safely(packets)
    assert key in ["", *(one.key for one in remarks)]
    during = [fix.usable for fix in fixes if 175.0 < fix.estimate.time_s < 190.0]
    if lasts:
        assert np.mean(during) > 0.5
    elif lasts is False:
        assert not any(during)
    assert np.hypot(*fixes[-1].sigma_m) < 60.0
    assert flight().error_m(fixes[-1]) < 60.0


def test_a_link_dies_and_returns() -> None:
    packets = [p for p in flight().packets() if not 60.0 < since_start_s(p) < 72.0]
    fixes, remarks = flown_safely(packets)
    keys = [one.key for one in remarks]
    assert keys.count("link 0 silent") == 2
    assert "reckoning broke" in keys
    offers = [one.stamp_us for one in remarks if one.key == "fix usable"]
    assert max(offers) > HOST_US + 72_000_000  # recovery is reported
    assert fixes[-1].usable
    assert flight().error_m(fixes[-1]) < 40.0


def test_two_links_with_the_same_vehicle_are_one() -> None:
    both = [
        p for packet in flight().packets() for p in (packet, replace(packet, link=1, stamp_us=packet.stamp_us + 40))
    ]
    one, _ = flown(Engine(settings(), [chart()]), flight().packets())
    engine = Engine(settings(), [chart()])
    two, _ = flown(engine, both)
    assert [(f.lat_deg, f.usable) for f in one] == [(f.lat_deg, f.usable) for f in two]
    assert engine.facts["duplicates"] == len(flight().packets())


def test_two_vehicles_on_one_link() -> None:
    other = Flight(seconds=SECONDS, seed=5, system=7, start_s=3000.0)
    mixed = sorted([*flight().packets(), *other.packets()], key=lambda packet: packet.stamp_us)
    fixes, remarks = flown_safely(mixed)
    assert held(fixes)
    assert [one.key for one in remarks].count("vehicle 7") == 1
    told = Engine(settings(system_id=7), [chart()])
    theirs, _ = flown(told, mixed)
    assert told.facts["system_id"] == 7
    assert all(other.error_m(fix) <= fix.estimate.protection_m for fix in theirs if fix.usable)


def test_the_autopilot_starts_again_in_flight() -> None:
    """Its clock starts anew, 3 s of messages are missing, and the fix comes back."""

    def restarted(packet: Packet) -> Packet:
        def change(message: Any) -> None:
            if hasattr(message, "time_boot_ms"):
                message.time_boot_ms = round((since_start_s(packet) - 58.0) * 1000.0)

        return changed(packet, change) if since_start_s(packet) > 60.0 else packet

    packets = [restarted(p) for p in flight().packets() if not 60.0 < since_start_s(p) < 63.0]
    fixes, remarks = flown(Engine(settings(), [chart()]), packets)
    assert [one.key for one in remarks].count("vehicle restarted") >= 1
    for fix in fixes:
        if fix.usable:
            t = (fix.stamp_us - HOST_US) * 1e-6 - 0.005
            assert flight().away_m(t, fix.lat_deg, fix.lon_deg) <= fix.estimate.protection_m
    assert held(fixes)
    assert fixes[-1].boot_us is not None
    assert fixes[-1].boot_us < 100_000_000


def test_an_altimeter_that_is_wrong_now_and_then() -> None:
    rng = random.Random(8)

    def wrong(message: Any) -> None:
        message.current_distance = rng.randrange(100, 65000)

    packets = [changed(p, wrong) if number(p) == 132 and rng.random() < 0.15 else p for p in flight().packets()]
    fixes, _ = flown_safely(packets)
    assert held(fixes)


def test_a_free_position_that_leaps_is_bridged_by_its_velocity() -> None:
    def leap(message: Any) -> None:
        message.lat += 50_000  # half a kilometre

    packets = [changed(p, leap) if number(p) == 33 and since_start_s(p) > 70.0 else p for p in flight().packets()]
    engine = Engine(settings(ins_source="position"), [chart()])
    fixes, remarks = flown(engine, packets)
    assert "position" in [one.key for one in remarks]
    assert all(flight().error_m(fix) <= fix.estimate.protection_m for fix in fixes if fix.usable)
    assert flight().error_m(fixes[-1]) < 60.0

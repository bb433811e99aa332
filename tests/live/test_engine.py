"""The live engine: a pure function of its packets that holds a vehicle, whatever its source of reckoning."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.live.checkpoint import packed, unpacked
from terranav.live.engine import Engine
from terranav.live.records import Fix, Packet, Remark
from terranav.live.settings import GRADES, LiveSettings
from terranav.maps.map import Map
from tests.live.flights import HOST_US, Flight, chart, digest, flown, settings


@cache
def flight(seconds: float = 90.0, **more: Any) -> Flight:
    return Flight(seconds=seconds, **more)


@cache
def outcome() -> tuple[list[Fix], list[Remark]]:
    return flown(Engine(settings(), [chart()]), flight().packets())


def test_the_fix_holds_while_reckoning_drifts() -> None:
    fixes, remarks = outcome()
    away = np.array([flight().error_m(fix) for fix in fixes])
    usable = np.array([fix.usable for fix in fixes])
    protection = np.array([fix.estimate.protection_m for fix in fixes])
    assert usable[-300:].mean() > 0.9
    assert np.max(away[usable]) < 50.0  # reckoning alone is 65 m off at the end
    assert not np.any(usable & (away > protection))
    assert [one.key for one in remarks if one.level == "info"][:4] == ["vehicle", "autopilot", "start", "fix usable"]


def test_every_number_of_a_fix_is_finite_and_times_are_the_measurement_s() -> None:
    fixes, _ = outcome()
    boot = [fix.boot_us for fix in fixes]
    assert all(b is not None for b in boot)
    assert boot == sorted(set(boot))  # type: ignore[type-var]
    for fix in fixes:
        numbers = [fix.lat_deg, fix.lon_deg, fix.alt_m, *fix.sigma_m, *(fix.velocity_mps or ())]
        assert all(map(math.isfinite, numbers))
        assert min(fix.sigma_m) >= 1.0
        assert fix.usable or fix.withheld
        assert fix.boot_us is not None
        assert fix.stamp_us - HOST_US == pytest.approx(fix.boot_us - 100_000_000 + 5000, abs=20_000)


def test_a_reading_makes_a_fix_at_once() -> None:
    """When position and attitude of the same time are there, nothing waits."""
    engine = Engine(settings(), [chart()])
    packets = flight().packets()[:2000]
    late = []
    for packet in packets:
        late += [packet.stamp_us - one.stamp_us for one in engine.feed(packet) if isinstance(one, Fix)]
    # all but the epochs of the start, when nothing is measured yet
    assert np.mean(np.array(late) < 1000) > 0.95


def test_the_same_packets_give_the_same_bits() -> None:
    fixes, remarks = flown(Engine(settings(), [chart()]), flight().packets())
    assert digest(fixes) == digest(outcome()[0])
    assert remarks == outcome()[1]
    other, _ = flown(Engine(settings(seed=1), [chart()]), flight().packets())
    assert digest(other) != digest(fixes)


@pytest.mark.parametrize("at", [37, 1200, 3001])
def test_a_resumed_engine_gives_the_same_bits(at: int) -> None:
    packets = flight().packets()
    first = Engine(settings(), [chart()])
    before, _ = flown(first, packets[:at])
    data = first.checkpoint()
    second = Engine.resumed(settings(), [chart()], data)
    after, _ = flown(second, packets[at:])
    assert digest(before + after) == digest(outcome()[0])
    assert second.facts["packets"] == len(packets)
    # the stopped one was not touched by being looked at
    again, _ = flown(first, packets[at:])
    assert digest(again) == digest(after)


def test_a_checkpoint_of_another_run_or_damaged_is_refused() -> None:
    engine = Engine(settings(), [chart()])
    flown(engine, flight().packets()[:500])
    data = engine.checkpoint()
    with pytest.raises(ConfigError, match="other settings or maps"):
        Engine.resumed(settings(seed=3), [chart()], data)
    with pytest.raises(ConfigError, match="other settings or maps"):
        Engine.resumed(settings(), [replace(chart(), sigma=5.0)], data)
    for bad in (b"", b"nonsense", data[:-1], data[:5000], data[:60] + b"\xff" + data[61:]):
        with pytest.raises(DataError, match="checkpoint"):
            Engine.resumed(settings(), [chart()], bad)


def test_a_checkpoint_makes_records_and_nothing_else() -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return print, ("never",)

    with pytest.raises(DataError, match="does not belong"):
        unpacked(packed(Evil(), "0" * 64, settings()), "0" * 64, settings())
    with pytest.raises(DataError, match="cannot be read"):
        unpacked(packed(np.load, "0" * 64, settings()), "0" * 64, settings())
    assert b"jacksboro" not in Engine(settings(), [chart()]).checkpoint()  # no map in it


@pytest.mark.parametrize("source", ["position", "airspeed"])
def test_other_sources_hold_too(source: str) -> None:
    blown = Flight(seconds=180.0, wind_mps=(3.0, -2.0)) if source == "airspeed" else flight(180.0)
    engine = Engine(LiveSettings(ins_source=source), [chart()])
    fixes, _ = flown(engine, blown.packets())
    away = np.array([blown.error_m(fix) for fix in fixes])
    usable = np.array([fix.usable for fix in fixes])
    protection = np.array([fix.estimate.protection_m for fix in fixes])
    assert usable[-300:].mean() > 0.5
    assert away[-1] < 60.0  # the wind alone carries it 650 m off
    assert not np.any(usable & (away > protection))


def test_reckoning_by_velocity_does_not_heed_the_vehicle_s_position() -> None:
    """Once the autopilot uses our fixes its position jumps after them: the track must not."""
    plain, _ = outcome()
    shifted = []
    for packet in flight().packets():
        data = bytearray(packet.data)
        if data[7] == 33 and packet.stamp_us - HOST_US > 10_000_000:
            shifted.append(replace(packet, data=_moved(packet.data)))
        else:
            shifted.append(packet)
    fixes, _ = flown(Engine(settings(), [chart()]), shifted)
    assert [(f.lat_deg, f.lon_deg) for f in fixes] == [(f.lat_deg, f.lon_deg) for f in plain]


def _moved(frame: bytes) -> bytes:
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    message = link.decode(bytearray(frame))
    message.lat += 20_000
    link.seq = frame[4]
    return bytes(message.pack(link))


def test_gnss_is_told_and_never_used() -> None:
    engine = Engine(settings(), [chart()])
    packets = flight().packets()
    flown(engine, packets[:3000])
    assert engine.gnss is not None
    assert engine.gnss[1].fix == 3
    assert engine.facts["gnss"]["fix"] == 3
    without = [packet for packet in packets if packet.data[7] != 24]
    # the counter of lost messages aside, all is the same
    fixes, _ = flown(Engine(settings(), [chart()]), without)
    assert digest(fixes) == digest(outcome()[0])


def test_the_end_of_the_map_is_told_ahead() -> None:
    whole = chart()
    true = flight().truth
    south, west, north, _ = whole.bounds_deg
    edge = whole.crop(south, west, north, float(true["lon_deg"].max()) - 0.004)
    engine = Engine(settings(warn_ahead_s=20.0), [edge])
    _, remarks = flown(engine, flight().packets())
    ends = [one for one in remarks if one.key == "map ends ahead"]
    assert ends
    assert "the map ends" in ends[0].text
    crossed_s = float(true["time_s"][np.argmax(true["lon_deg"] > edge.bounds_deg[3])])
    warned_s = (ends[0].stamp_us - HOST_US) * 1e-6
    assert 3.0 < crossed_s - warned_s < 25.0
    assert "off map" in [one.key for one in remarks]
    none = Engine(settings(warn_ahead_s=0.0), [edge])
    assert not any(one.key == "map ends ahead" for one in flown(none, flight().packets()[:3000])[1])


def test_facts_are_plain_json_and_count() -> None:
    engine = Engine(settings(), [chart()])
    assert json.loads(json.dumps(engine.facts))["packets"] == 0
    packets = [packet for i, packet in enumerate(flight().packets()) if i % 10]
    fixes, _ = flown(engine, packets)
    facts = json.loads(json.dumps(engine.facts, allow_nan=False))
    assert facts["packets"] == len(packets)
    assert facts["fixes"] == len(fixes)
    assert facts["usable"] == sum(fix.usable for fix in fixes)
    assert facts["lost"] == pytest.approx(len(packets) / 9, abs=2)
    assert facts["rejected"] == {"impossible value": 0}
    assert facts["autopilot"] == "ArduPilot"
    assert facts["system_id"] == 1
    assert facts["messages"]["ATTITUDE"]["rate_hz"] == pytest.approx(9.0, abs=1.5)
    assert facts["links"]["0"]["silent"] is False


def test_time_passes_by_empty_packets() -> None:
    engine = Engine(settings(), [chart()])
    packets = flight().packets()
    flown(engine, packets[:1000])
    last = packets[999].stamp_us
    said = [one for i in range(5) for one in engine.feed(Packet(last + (i + 1) * 1_000_000, 0, b""))]
    assert [one.key for one in said if isinstance(one, Remark)] == ["link 0 silent"]
    back = engine.feed(Packet(last + 6_000_000, 0, packets[1000].data))
    assert [one.text for one in back if isinstance(one, Remark) and one.key == "link 0 silent"] == [
        "link 0 is back after 6.0 s"
    ]


def test_the_told_start_counts() -> None:
    true = flight().truth
    place = float(true["lat_deg"][0]) + 0.001, float(true["lon_deg"][0])
    fixes, _ = flown(Engine(settings(start_deg=place), [chart()]), flight().packets()[:30])
    assert flight().away_m(0.0, *place) == pytest.approx(111.0, abs=1.0)
    assert flight().error_m(fixes[0]) == pytest.approx(111.0, abs=15.0)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"ins_source": "velocty"}, "did you mean 'velocity'"),
        ({"rate_hz": 0.0}, "rate_hz is 0.0"),
        ({"lag_s": math.nan}, "lag_s is nan"),
        ({"sigma": {"radar": 1.0}}, "unknown key in sigma 'radar'"),
        ({"sigma": {"depth_m": -1.0}}, "sigma depth_m is -1.0"),
        ({"start_deg": (91.0, 0.0)}, "start_deg lat_deg is 91.0"),
        ({"start_deg": 4}, "start_deg is 4, expected two numbers"),
        ({"system_id": 0}, "system_id is 0"),
        ({"estimator": "marginalised"}, "did you mean 'marginalized'"),
        ({"seed": -1}, "seed is -1"),
        ({"ins": 3}, "ins is 3, expected an InsGrade"),
        ({"alt_datum": "moon"}, "alt_datum is 'moon'"),
    ],
)
def test_impossible_settings_are_one_line(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        LiveSettings(**wrong)


def test_maps_that_nothing_measures_are_refused() -> None:
    with pytest.raises(ConfigError, match="expected terrain or bathymetry"):
        Engine(settings(), [])
    magnetic = Map(chart().values, chart().transform, chart().crs, "magnetic", "nT", 3.0)
    with pytest.raises(ConfigError, match="magnetic"):
        Engine(settings(), [magnetic])


def test_altitudes_go_to_the_datum_of_the_map() -> None:
    """A map that counts from the ellipsoid is met 30 m lower where the geoid is 30 m below it."""
    pytest.importorskip("pyproj")
    from terranav.io.geoid import finder

    if finder(None)("EGM96") is None and finder(None)("EGM2008") is None:
        with pytest.raises(DataError, match="no grid"):
            Engine(settings(), [replace(chart(), datum="ellipsoid")])
        return
    plain = Engine(settings(), [chart()])
    raised = Engine(settings(), [replace(chart(), datum="ellipsoid")])
    values = []
    for engine in (plain, raised):
        engine_values = []
        for packet in flight().packets()[:600]:
            engine.feed(packet)
            if engine.epoch is not None and engine.epoch.measurements:
                engine_values.append((engine.epoch.time_s, engine.epoch.measurements[0].value))
        values.append(dict(engine_values))
    both = [values[1][t] - values[0][t] for t in values[0] if t in values[1]]
    assert both
    assert np.ptp(both) < 0.1
    assert -40.0 < float(np.mean(both)) < -20.0  # the geoid of Tennessee


def test_settings_and_their_digest_are_stable() -> None:
    assert settings().digest([chart()]) == settings().digest([chart()])
    assert settings().digest([chart()]) != settings(lag_s=0.1).digest([chart()])
    assert LiveSettings().grade == GRADES["velocity"]
    assert LiveSettings(ins=InsGrade(5.0)).grade.position_sigma_m == 5.0
    assert pickle.dumps(outcome()[0][:3])  # fixes travel between processes


def test_what_is_missing_for_a_start_is_said() -> None:
    none = [packet for packet in flight().packets()[:1500] if packet.data[7] != 33]
    fixes, remarks = flown(Engine(settings(), [chart()]), none)
    assert fixes == []
    (said,) = [one.text for one in remarks if one.key == "no start"]
    assert said == "reckoning by velocity waits for a position, or to be told the start, an altitude, a velocity"


def test_a_clock_that_stands_still_is_said() -> None:
    frozen = [packet for packet in flight().packets() if packet.data[7] == 33][:1]
    still = [
        replace(frozen[0], stamp_us=frozen[0].stamp_us + i * 100_000, data=_numbered(frozen[0].data, i))
        for i in range(60)
    ]
    _, remarks = flown(Engine(settings(), [chart()]), still)
    assert "clock stands still" in [one.key for one in remarks]


def _numbered(frame: bytes, sequence: int) -> bytes:
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    link = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    link.seq = sequence
    return bytes(link.decode(bytearray(frame)).pack(link))


def test_a_navigator_that_fails_starts_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    from terranav.integrity.monitored import Monitored

    step, calls = Monitored.step, []

    def failing(self: Monitored, *told: Any) -> Any:
        calls.append(1)
        if len(calls) == 700:
            raise ValueError("no such thing")
        return step(self, *told)

    monkeypatch.setattr(Monitored, "step", failing)
    fixes, remarks = flown(Engine(settings(), [chart()]), flight().packets())
    (said,) = [one for one in remarks if one.key == "navigator fault" and one.level == "error"]
    assert said.text == "the navigator failed and starts anew: ValueError: no such thing"
    assert len(fixes) > 800
    assert flight().error_m(fixes[-1]) < 60.0
    assert all(flight().error_m(fix) <= fix.estimate.protection_m for fix in fixes if fix.usable)

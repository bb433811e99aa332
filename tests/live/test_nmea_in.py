"""NMEA in: what sentences say, damaged ones say nothing, and a ship is located by its echo sounder."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor

import numpy as np
import pytest

from terranav.core.earth import offset_m, shift
from terranav.core.ins_grade import InsGrade
from terranav.live.deframing import LineDeframer
from terranav.live.engine import Engine
from terranav.live.heard import AirData, Attitude, Depth, Gnss, Ground, Position, Velocity, Word
from terranav.live.nmea_in import KNOT_MPS, NmeaIn
from terranav.live.records import Packet
from terranav.live.settings import LiveSettings
from terranav.maps.fields import gaussian_map
from terranav.maps.map import Map
from tests.live.flights import HOST_US, flown


def line(text: str) -> bytes:
    return b"$" + text.encode() + b"*%02X" % reduce(xor, text.encode())


def words(text: str) -> tuple[Word, ...]:
    found = NmeaIn().heard(line(text))
    assert found is not None
    return found.words


def test_what_sentences_say() -> None:
    position, gnss = words("GPGGA,092725.00,4717.11399,N,00833.91590,E,1,08,1.01,499.6,M,48.0,M,,")
    assert isinstance(position, Position)
    assert (position.lat_deg, position.lon_deg) == pytest.approx((47.28523, 8.56527), abs=1e-5)
    assert position.alt_m == 499.6
    assert isinstance(gnss, Gnss)
    assert gnss.fix == 3
    assert words("GPGGA,092725.00,,,,,0,00,,,M,,M,,") == ()
    # a position that no receiver measured is one, but none for a monitor
    assert len(words("GPGGA,092725.00,4717.11399,N,00833.91590,E,6,08,1.01,499.6,M,48.0,M,,")) == 1
    _, velocity = words("GPRMC,083559.00,A,4717.11437,N,00833.91522,E,10.0,90.0,091202,,,A")
    assert isinstance(velocity, Velocity)
    assert (velocity.north_mps, velocity.east_mps) == pytest.approx((0.0, 10.0 * KNOT_MPS), abs=1e-9)
    assert words("GPRMC,083559.00,V,4717.11437,N,00833.91522,E,10.0,90.0,091202,,,N") == ()
    assert words("HEHDT,274.1,T") == (Attitude(None, None, 274.1),)
    assert words("SDDPT,36.4,1.6") == (Depth(38.0, True),)
    assert words("SDDPT,36.4,-0.5") == (Depth(36.4, False),)
    assert words("SDDBT,119.4,f,36.4,M,19.9,F") == (Depth(36.4, False),)
    (over_ground,) = words("GPVTG,180.0,T,,M,5.0,N,9.26,K,A")
    assert isinstance(over_ground, Velocity)
    assert (over_ground.north_mps, over_ground.east_mps) == pytest.approx((-5.0 * KNOT_MPS, 0.0), abs=1e-9)
    ground, water = words("VDVBW,4.0,0.5,A,5.0,-0.2,A")
    assert ground == Ground(5.0 * KNOT_MPS, -0.2 * KNOT_MPS)
    assert water == AirData(4.0 * KNOT_MPS, 0.5 * KNOT_MPS, calibrated=False)
    assert words("VDVBW,4.0,0.5,V,5.0,-0.2,V") == ()


def test_impossible_fields_are_named() -> None:
    found = NmeaIn().heard(line("HEHDT,9999.0,T"))
    assert found is not None
    assert found.words == ()
    assert "HDT headingT is 9999" in found.rejected[0]


@pytest.mark.parametrize(
    "bad",
    [
        b"$SDDPT,36.4,1.6*00",
        b"$SDDPT,36.4,1.6",
        b"SDDPT",
        b"$",
        b"$SDDPT,\xff\xfe*12",
        line("SDDPT,abc,def"),
        b"$" + b"A" * 5000,
    ],
)
def test_damage_says_nothing(bad: bytes) -> None:
    found = NmeaIn().heard(bad)
    assert found is None or found.words == ()


def test_lines_come_out_of_bytes_however_they_are_cut() -> None:
    texts = [line("SDDPT,36.4,1.6"), line("HEHDT,274.1,T"), line("SDDBT,119.4,f,36.4,M,19.9,F")]
    stream = b"noise" + b"\r\n".join(texts) + b"\r\n"
    for size in (1, 2, 7, 100):
        lines = LineDeframer()
        found = [one for at in range(0, len(stream), size) for one in lines.feed(stream[at : at + size])]
        assert found == texts
        assert lines.garbage == 5
    lines = LineDeframer()
    for _ in range(100):
        assert lines.feed(b"\0" * 10_000) == []
    assert len(lines._rest) <= 1024


def seabed() -> Map:
    made = gaussian_map(
        np.random.default_rng(7), std=25.0, correlation_m=250.0, cells=161, cell_m=25.0, sigma=0.5, kind="bathymetry"
    )
    return replace(made, values=made.values - float(made.values.max()) - 20.0)


def sentences(chart: Map, seconds: int, off_mps: float) -> tuple[list[Packet], list[tuple[float, float]]]:
    """A ship by log and gyro compass, with a current that the log does not feel."""
    packets, track = [], []
    start = datetime(2026, 5, 1, 23, 58, 0, tzinfo=UTC)  # over midnight
    lat, lon = (float(v) for v in shift(*chart.centre_deg, -900.0, -900.0))
    rng = np.random.default_rng(3)
    for i in range(seconds):
        heading = 40.0 + 25.0 * math.sin(i / 60.0)
        speed = 4.0
        now = start + timedelta(seconds=i)
        stamp = HOST_US + i * 1_000_000
        degrees, minutes = divmod(abs(lat), 1.0)[0], (abs(lat) % 1.0) * 60.0
        east, east_min = divmod(abs(lon), 1.0)[0], (abs(lon) % 1.0) * 60.0
        depth = -float(chart.sample(lat, lon)) + rng.normal(0.0, 0.5)
        texts = [f"HEHDT,{heading:.2f},T", f"VDVBW,{speed / KNOT_MPS:.3f},0.0,A,{speed / KNOT_MPS:.3f},0.0,A"]
        if i < 3:
            ns, ew = "N" if lat >= 0 else "S", "E" if lon >= 0 else "W"
            place = f"{degrees:02.0f}{minutes:08.5f},{ns},{east:03.0f}{east_min:08.5f},{ew}"
            texts.insert(0, f"GPGGA,{now:%H%M%S}.00,{place},1,08,1.0,0.0,M,0.0,M,,")
        texts.append(f"SDDPT,{depth - 2.0:.2f},2.0")
        packets += [Packet(stamp + 20_000 * k, 0, line(text)) for k, text in enumerate(texts)]
        track.append((lat, lon))
        north = speed * math.cos(math.radians(heading)) + off_mps
        lat, lon = (float(v) for v in shift(lat, lon, north, speed * math.sin(math.radians(heading))))
    return packets, track


def test_a_ship_is_held_by_its_echo_sounder() -> None:
    chart = seabed()
    packets, track = sentences(chart, 500, 0.3)
    told = LiveSettings(ins=InsGrade(100.0, 0.5, 0.3), sigma={"depth_m": 0.6})
    fixes, remarks = flown(Engine(told, [chart]), packets)
    keys = [remark.key for remark in remarks]
    assert "start" in keys
    assert not any(key.startswith(("clock", "vehicle")) for key in keys)
    last = fixes[-1]
    t = round((last.stamp_us - HOST_US) * 1e-6)
    away = float(np.hypot(*offset_m(*track[min(t, len(track) - 1)], last.lat_deg, last.lon_deg)))
    assert last.boot_us is None
    assert away < 30.0  # the current alone carries it off by 150 m
    assert any(fix.usable for fix in fixes)

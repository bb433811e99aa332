"""Nothing leaves but a fix that is usable, finite, sure of something above nought, and young enough."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from terranav.core.earth import offset_of
from terranav.core.records import Estimate, Status
from terranav.live.mavlink_in import dialect
from terranav.live.mavlink_out import EXTERNAL_POSITION_ESTIMATE, Encoder, quaternion
from terranav.live.nmea_out import sentences
from terranav.live.outgoing import LEAST_SIGMA_M, MOST_SIGMA_M, Offer, Pace, offer
from terranav.live.records import Fix

NOW_US = 1_700_000_000_000_000
ORIGIN = (47.0, 9.0, 400.0)


def fix(**changes: Any) -> Fix:
    estimate = Estimate(1.0, 47.0, 9.0, 900.0, np.zeros(2), np.eye(2) * 225.0, Status.CONVERGED, 1.0, 60.0, True)
    one = Fix(
        stamp_us=NOW_US - 100_000,
        boot_us=12_000_000,
        lat_deg=47.01,
        lon_deg=9.02,
        alt_m=900.0,
        sigma_m=(15.0, 12.0),
        velocity_mps=(20.0, -30.0, 1.0),
        attitude_deg=(5.0, -3.0, 300.0),
        estimate=estimate,
        usable=True,
    )
    return replace(one, **changes)


any_float = st.floats(allow_nan=True, allow_infinity=True)
near_float = st.floats(-1e6, 1e6)
number = st.one_of(any_float, near_float)
triple = st.one_of(st.none(), st.tuples(number, number, number))
any_fix = st.builds(
    fix,
    stamp_us=st.one_of(st.integers(NOW_US - 7_000_000, NOW_US + 1_000_000), st.integers(-(1 << 70), 1 << 70)),
    boot_us=st.one_of(st.none(), st.integers(-5, 1 << 40), st.integers(-(1 << 70), 1 << 70)),
    lat_deg=st.one_of(st.floats(-91, 91), any_float),
    lon_deg=st.one_of(st.floats(-181, 181), any_float),
    alt_m=number,
    sigma_m=st.tuples(st.one_of(st.floats(0, 200), any_float), st.one_of(st.floats(0, 200), any_float)),
    velocity_mps=triple,
    attitude_deg=triple,
    usable=st.one_of(st.just(True), st.booleans()),
)


def decoded(frame: bytes) -> Any:
    return dialect().MAVLink(None).decode(bytearray(frame))


def fields_of(message: Any) -> list[tuple[str, float]]:
    found: list[tuple[str, float]] = []
    for name in message.get_fieldnames():
        value = getattr(message, name)
        found += [(name, float(one)) for one in (value if isinstance(value, (list, tuple)) else [value])]
    return found


def all_messages(made: Offer) -> list[Any]:
    encoder = Encoder(1)
    frames = [
        encoder.global_position(made),
        encoder.odometry(made, ORIGIN),
        encoder.gps_input(made),
        encoder.reset(made, 1),
    ]
    return [decoded(frame) for frame in frames]


@given(any_fix, st.floats(0.0, 5.0), st.floats(1.0, 1e9))
@example(fix(sigma_m=(1e-60, 1e-60)), 1.0, 1.0)
@example(fix(sigma_m=(1e5, 1e5), lat_deg=90.0, lon_deg=-180.0), 1.0, 1e9)
def test_whatever_leaves_is_finite_sure_and_young(one: Fix, max_age_s: float, factor: float) -> None:
    made = offer(one, NOW_US, max_age_s)
    if isinstance(made, str):
        assert made
        return
    assert one.usable
    assert (NOW_US - one.stamp_us) * 1e-6 <= max_age_s
    for sent in (made, made.widened(factor), made.carried(200_000, max_age_s)):
        if sent is None:
            continue
        assert all(LEAST_SIGMA_M <= sigma <= 1.0001 * MOST_SIGMA_M for sigma in sent.sigma_m)
        for message in all_messages(sent):
            assert all(math.isfinite(value) for _, value in fields_of(message)), message
        position, odometry, receiver, reset = all_messages(sent)
        accuracies = (position.eph, position.epv, receiver.horiz_accuracy, receiver.vert_accuracy, reset.param3)
        assert min(*accuracies, odometry.pose_covariance[0], odometry.pose_covariance[6]) >= 0.99 * LEAST_SIGMA_M
        assert reset.param2 <= 5.0 + 1e-3
        assert b"nan" not in sentences(sent).lower()
        assert b"inf" not in sentences(sent).lower()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"usable": False}, "not usable"),
        ({"stamp_us": NOW_US - 1_000_001}, "too old"),
        ({"stamp_us": NOW_US + 200_000}, "measured after now"),
        ({"lat_deg": math.nan}, "not finite"),
        ({"velocity_mps": (1.0, math.inf, 0.0)}, "not finite"),
        ({"sigma_m": (0.0, 3.0)}, "no accuracy"),
        ({"sigma_m": (3.0, -1.0)}, "no accuracy"),
        ({"sigma_m": (3.0, 2e5)}, "no accuracy"),
        ({"lat_deg": 90.1}, "no position on earth"),
        ({"lon_deg": 180.1}, "no position on earth"),
        ({"alt_m": 2e5}, "no position on earth"),
        ({"boot_us": -1}, "impossible time"),
        ({"attitude_deg": (0.0, 0.0, 721.0)}, "impossible attitude"),
        ({"velocity_mps": (2e4, 0.0, 0.0)}, "impossible velocity"),
    ],
)
def test_what_is_held_says_why(changes: dict[str, Any], reason: str) -> None:
    assert offer(fix(**changes), NOW_US, 1.0) == reason


def test_an_estimate_that_is_not_usable_is_held_even_where_the_fix_says_otherwise() -> None:
    one = fix()
    assert offer(replace(one, estimate=replace(one.estimate, usable=False)), NOW_US, 1.0) == "not usable"


def made() -> Offer:
    one = offer(fix(), NOW_US, 1.0)
    assert isinstance(one, Offer)
    return one


def test_global_position_sensor_says_terrain_and_when_it_was_measured() -> None:
    message = decoded(Encoder(7).global_position(made()))
    assert (message.get_msgId(), message.id) == (296, 1)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (7, 191)
    assert message.id == 1  # 0 would be fused by no slot
    assert message.source == dialect().GLOBAL_POSITION_SRC_TERRAIN
    assert message.time_usec - message.processing_time == 12_000_000  # sending less processing is the measurement
    assert message.processing_time == 100_000
    assert (message.lat, message.lon) == (470_100_000, 90_200_000)
    assert message.eph == pytest.approx(15.0)
    assert message.alt == pytest.approx(900.0)


def test_odometry_has_the_frames_layout_and_axes_that_ardupilot_reads() -> None:
    message = decoded(Encoder(1).odometry(made(), ORIGIN))
    assert message.frame_id == dialect().MAV_FRAME_LOCAL_FRD
    assert message.child_frame_id == dialect().MAV_FRAME_BODY_FRD
    north, east = offset_of(47.0, 9.0, 47.01, 9.02)
    assert (message.x, message.y, message.z) == pytest.approx((north, east, -500.0), rel=1e-6)
    diagonal = [message.pose_covariance[place] for place in (0, 6, 11, 15, 18, 20)]
    assert diagonal[:3] == pytest.approx([225.0, 144.0, 225.0])
    assert sum(abs(value) for value in message.pose_covariance) == pytest.approx(sum(diagonal))
    assert message.time_usec == 12_000_000
    assert message.reset_counter == 0
    assert 1 <= message.quality <= 100
    # the receiver turns the velocity back by the quaternion: the inverse, written out as a matrix
    w, x, y, z = message.q
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    assert turn @ [message.vx, message.vy, message.vz] == pytest.approx([20.0, -30.0, 1.0], abs=1e-4)


@pytest.mark.parametrize(
    ("angles", "axis", "points"),
    [
        ((0.0, 0.0, 90.0), (1, 0, 0), (0, 1, 0)),  # nose to the east
        ((0.0, 90.0, 0.0), (1, 0, 0), (0, 0, -1)),  # nose up
        ((90.0, 0.0, 0.0), (0, 1, 0), (0, 0, 1)),  # right wing down
    ],
)
def test_quaternion_turns_the_body_into_north_east_down(
    angles: tuple[float, float, float], axis: tuple[int, int, int], points: tuple[int, int, int]
) -> None:
    w, x, y, z = quaternion(*angles)
    q = np.array([x, y, z])
    v = np.array(axis, dtype=float)
    turned = v + 2 * w * np.cross(q, v) + 2 * np.cross(q, np.cross(q, v))
    assert turned == pytest.approx(np.array(points, dtype=float), abs=1e-12)


def test_gps_input_gives_no_velocity_and_a_position_in_three_dimensions() -> None:
    message = decoded(Encoder(1).gps_input(made()))
    assert message.ignore_flags == 8 | 16 | 32
    assert message.fix_type == 3
    assert message.horiz_accuracy == pytest.approx(15.0)
    assert message.time_week == 0


def test_reset_is_the_command_with_its_age() -> None:
    message = decoded(Encoder(1).reset(made(), 5))
    assert (message.command, message.target_system) == (EXTERNAL_POSITION_ESTIMATE, 5)
    assert message.param2 == pytest.approx(0.1)
    assert message.param3 == pytest.approx(15.0)
    assert 0.0 <= message.param1 < 3600.0
    assert (message.x, message.y) == (470_100_000, 90_200_000)


def test_nmea_reads_back_by_another_parser() -> None:
    reader = pytest.importorskip("pynmeagps").NMEAReader
    gga, rmc = (reader.parse(line) for line in sentences(made()).splitlines(keepends=True))
    assert (gga.lat, gga.lon) == pytest.approx((47.01, 9.02), abs=2e-7)
    assert gga.alt == pytest.approx(900.0)
    assert gga.quality == 6
    assert rmc.spd == pytest.approx(math.hypot(20, 30) * 3600 / 1852, abs=0.01)
    assert rmc.cog == pytest.approx(math.degrees(math.atan2(-30, 20)) % 360, abs=0.01)
    assert f"{rmc.date:%Y-%m-%d}" == "2023-11-14"


@pytest.mark.parametrize(
    ("lat", "lon", "texts"),
    [(-0.9999999999, -179.9999999999, (b"0100.00000,S", b"18000.00000,W")), (0.5, 0.25, (b"0030.00000,N", b"00015"))],
)
def test_nmea_minutes_never_reach_sixty(lat: float, lon: float, texts: tuple[bytes, bytes]) -> None:
    line = sentences(replace(made(), lat_deg=lat, lon_deg=lon))
    assert all(text in line for text in texts)
    assert b"60.00000" not in line


def test_messages_are_numbered_one_after_the_other() -> None:
    encoder = Encoder(1)
    assert [decoded(encoder.heartbeat()).get_seq() for _ in range(258)] == [*range(256), 0, 1]


def test_pace_keeps_the_rate_and_widens_what_comes_often() -> None:
    pace = Pace(5.0, 10.0)
    sent = [stamp for stamp in range(0, 10_000_000, 100_000) if pace.due(stamp) and pace.taken(stamp) >= 1.0]
    assert len(sent) == 50
    # the variance of a mean of n values of a first-order process, by its definition, against the factor
    gap_s, tau_s, n = 0.2, 10.0, 20_000
    rho = math.exp(-gap_s / tau_s)
    lags = np.arange(1, n)
    exact = 1.0 + 2.0 * float(np.sum((1.0 - lags / n) * rho**lags))
    pace = Pace(5.0, tau_s)
    pace.taken(0)
    assert pace.taken(200_000) == pytest.approx(exact, rel=0.01)
    assert Pace(5.0, 10.0).taken(0) == 1.0  # the first says nothing twice


def test_pace_goes_on_after_the_clock_was_set_back() -> None:
    pace = Pace(1.0, 0.0)
    pace.taken(3_600_000_000)
    assert not pace.due(3_599_000_000)
    assert pace.due(0)


def test_a_fix_is_carried_on_as_if_measured_later_and_no_further_than_it_may_be_old() -> None:
    one = made()
    on = one.carried(500_000, 1.0)
    assert on is not None
    assert offset_of(one.lat_deg, one.lon_deg, on.lat_deg, on.lon_deg) == pytest.approx((10.0, -15.0), abs=1e-6)
    assert (on.stamp_us - one.stamp_us, on.boot_us, on.age_us) == (500_000, 12_500_000, one.age_us)
    assert on.sigma_m == pytest.approx((math.hypot(15.0, 0.5), math.hypot(12.0, 0.5)))
    assert one.carried(900_001, 1.0) is None
    assert one.carried(-1, 1.0) is None
    assert replace(one, velocity_mps=None).carried(100_000, 1.0) is None

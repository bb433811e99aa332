"""Routes flown smoothly: speeds, waypoints, coordination, and clear refusals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terranav.core.earth import GRAVITY_MPS2, metres_per_degree, offset_m, shift
from terranav.core.errors import ConfigError
from terranav.ins.trajectory import Route, Trajectory, fly

POINTS = [[46.0, 7.0, 1500.0], [46.2, 7.1, 2500.0], [46.2, 7.5, 2500.0], [46.0, 7.6, 1800.0]]


def ground_speed(path: Trajectory) -> np.ndarray:
    """Speed over the ellipsoid: the horizontal velocity brought down from its altitude."""
    per_lat, per_lon = metres_per_degree(path.lat_deg)
    meridian, prime = np.degrees(per_lat), np.degrees(per_lon) / np.cos(np.radians(path.lat_deg))
    north, east, _ = path.velocity_mps.T
    return np.asarray(np.hypot(north / (1.0 + path.alt_m / meridian), east / (1.0 + path.alt_m / prime)))


def nearest(path: Trajectory, point: list[float]) -> tuple[float, int]:
    distance = np.hypot(*offset_m(path.lat_deg, path.lon_deg, point[0], point[1]))
    i = int(distance.argmin())
    return float(distance[i]), i


def curve_about(angle_deg: float, lat: float = 46.0, leg_m: float = 20000.0) -> list[list[float]]:
    """Two legs of the same length with a turn of this angle between them."""
    turn = math.radians(angle_deg)
    middle = shift(lat, 7.0, leg_m, 0.0)
    last = shift(*middle, leg_m * math.cos(turn), leg_m * math.sin(turn))
    return [[lat, 7.0, 1000.0], [*map(float, middle), 1000.0], [*map(float, last), 1000.0]]


@settings(max_examples=25)
@given(
    angle=st.floats(-150.0, 150.0), lat=st.floats(-80.0, 80.0), speed=st.floats(15.0, 250.0), bank=st.floats(10.0, 45.0)
)
def test_velocity_is_the_rate_of_position(angle: float, lat: float, speed: float, bank: float) -> None:
    path = fly(Route(curve_about(angle, lat, 80000.0 if speed > 60.0 else 20000.0), speed, bank), 20.0)
    per_lat, per_lon = metres_per_degree(path.lat_deg)
    rate = 20.0 / 2.0
    lon = np.unwrap(path.lon_deg, period=360.0)
    north = rate * (path.lat_deg[2:] - path.lat_deg[:-2]) * (per_lat + np.radians(path.alt_m))[1:-1]
    parallel = per_lon + np.radians(path.alt_m) * np.cos(np.radians(path.lat_deg))
    east = rate * (lon[2:] - lon[:-2]) * parallel[1:-1]
    # central differences err by dt^2 / 6 times the jerk of the roll-in
    np.testing.assert_allclose(path.velocity_mps[1:-1, 0], north, atol=6e-3)
    np.testing.assert_allclose(path.velocity_mps[1:-1, 1], east, atol=6e-3)


def test_vertical_velocity_is_the_rate_of_altitude() -> None:
    path = fly(Route(POINTS, 80.0), 20.0)
    np.testing.assert_allclose(path.velocity_mps[1:-1, 2], -10.0 * (path.alt_m[2:] - path.alt_m[:-2]), atol=2e-3)
    assert path.alt_m.min() >= 1500.0
    assert path.alt_m.max() <= 2500.0 + 1e-9


def test_speed_is_constant_over_the_ellipsoid() -> None:
    np.testing.assert_allclose(ground_speed(fly(Route(POINTS, 80.0), 10.0)), 80.0, rtol=1e-6)


def test_speed_changes_smoothly_into_each_leg() -> None:
    path = fly(Route(POINTS, [80.0, 100.0, 60.0], accel_mps2=0.5), 20.0)
    speed = ground_speed(path)
    assert speed[0] == pytest.approx(80.0, rel=1e-6)
    assert speed.max() == pytest.approx(100.0, rel=1e-6)
    assert speed[-1] == pytest.approx(60.0, rel=1e-6)
    acceleration = np.diff(speed) * 20.0
    assert np.abs(acceleration).max() == pytest.approx(0.5, rel=1e-3)
    assert np.abs(np.diff(acceleration)).max() < 0.01


def test_waypoints_are_flown_by() -> None:
    path = fly(Route(POINTS, 80.0, bank_deg=25.0), 20.0)
    assert nearest(path, POINTS[0])[0] < 1e-6
    assert nearest(path, POINTS[-1])[0] < 80.0 / 20.0
    radius = 80.0**2 / (GRAVITY_MPS2 * math.tan(math.radians(25.0)))
    for point, angle in ((POINTS[1], 71.0), (POINTS[2], 71.0)):
        distance, i = nearest(path, point)
        miss = radius * (1.0 / math.cos(math.radians(angle / 2.0)) - 1.0)  # of a circle without roll-in
        assert distance == pytest.approx(miss, rel=0.03)
        assert path.alt_m[i] == pytest.approx(point[2], abs=0.1)


@given(angle=st.sampled_from([-170.0, -90.0, -20.0, -1.0, 0.0, 1e-3, 5.0, 45.0, 120.0]))
@settings(max_examples=9)
def test_turns_are_coordinated_and_continuous(angle: float) -> None:
    path = fly(Route(curve_about(angle), 60.0, bank_deg=20.0), 20.0)
    roll, _, heading = path.attitude_deg.T
    heading = np.unwrap(heading, period=360.0)
    turn_rate = np.radians(np.gradient(heading, path.time_s))
    # heading also turns by the convergence of the meridians, v tan(lat) / R, without any roll
    np.testing.assert_allclose(60.0 * turn_rate / GRAVITY_MPS2, np.tan(np.radians(roll)), atol=2e-3)
    assert np.abs(np.diff(roll)).max() < 20.0 * 1.6 / (3.0 * 20.0)
    assert heading[-1] - heading[0] == pytest.approx(angle, abs=0.5)
    assert abs(roll).max() <= 20.0 + 0.05


def test_a_given_radius_is_the_radius_flown() -> None:
    path = fly(Route(curve_about(90.0), 60.0, turn_radius_m=1500.0), 20.0)
    bank = math.degrees(math.atan(60.0**2 / (GRAVITY_MPS2 * 1500.0)))
    assert path.attitude_deg[:, 0].max() == pytest.approx(bank, rel=1e-3)


def test_routes_may_cross_the_antimeridian() -> None:
    path = fly(Route([[-17.0, 179.9, 500.0], [-17.0, -179.9, 500.0]], 50.0), 1.0)
    assert nearest(path, [-17.0, -179.9])[0] < 50.0
    assert np.abs(offset_m(path.lat_deg[1:], path.lon_deg[1:], path.lat_deg[:-1], path.lon_deg[:-1])[1]).max() < 51.0
    assert (path.lon_deg >= -180.0).all()
    assert (path.lon_deg < 180.0).all()


def test_long_legs_are_close_to_geodesics() -> None:
    from pyproj import Geod

    path = fly(Route([[46.0, 7.0, 500.0], [46.5, 9.0, 500.0]], 100.0), 1.0)
    (lon, lat), *_ = Geod(ellps="WGS84").npts(7.0, 46.0, 9.0, 46.5, 1)
    assert nearest(path, [lat, lon])[0] < 100.0


def test_columns_are_those_of_a_recording() -> None:
    from terranav.core.recording import Recording

    path = fly(Route(POINTS, 80.0), 1.0).every(10)
    rec = Recording({**path.columns(), **path.truth()})
    assert len(rec) == len(path)
    assert rec.has_truth
    assert not rec.ins_error_m().any()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"waypoints": [[46.0, 7.0, 0.0]]}, "route waypoints has shape (1, 3)"),
        ({"waypoints": [[46.0, 7.0], [46.1, 7.0]]}, "route waypoints has shape (2, 2)"),
        ({"waypoints": [[46.0, 7.0, 0.0], [46.1, 7.0]]}, "route waypoints is [["),
        ({"speed_mps": "fast"}, "route speed_mps is 'fast', expected numbers"),
        ({"waypoints": [[46.0, 7.0, 0.0], [95.0, 7.0, 0.0]]}, "route waypoint 2 latitude is 95.0"),
        ({"waypoints": [[46.0, 7.0, 0.0], [46.0, 400.0, 0.0]]}, "route waypoint 2 longitude is 400.0"),
        ({"waypoints": [[46.0, 7.0, math.nan], [46.1, 7.0, 0.0]]}, "route waypoint 1 altitude is nan"),
        ({"waypoints": [*POINTS[:2], POINTS[1]]}, "route waypoints 2 and 3 are the same place"),
        ({"speed_mps": 0.0}, "route speed_mps is 0.0, expected a finite number and > 0"),
        ({"speed_mps": [50.0, 60.0]}, "route speed_mps has 2 values, expected one or one a leg (3)"),
        ({"bank_deg": 80.0}, "route bank_deg is 80.0"),
        ({"roll_in_s": 0.0}, "route roll_in_s is 0.0"),
        ({"accel_mps2": 0.0}, "route accel_mps2 is 0.0"),
        ({"turn_radius_m": -5.0}, "route turn_radius_m is -5.0"),
        ({"turn_radius_m": 100.0}, "route turn_radius_m is 100 at 80 m/s: its bank is"),
    ],
)
def test_impossible_routes_get_one_clear_line(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Route(**{"waypoints": POINTS, "speed_mps": 80.0, **keys})
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_a_turn_that_does_not_fit_names_the_radius_that_does() -> None:
    points = curve_about(90.0, leg_m=2000.0)
    with pytest.raises(
        ConfigError, match=r"turn at waypoint 2 with radius 5000 m .* largest radius that fits is (\d+) m"
    ) as e:
        fly(Route(points, 60.0, turn_radius_m=5000.0))
    radius = int(str(e.value).split()[-2])
    assert radius < 2000
    fly(Route(points, 60.0, turn_radius_m=radius), 1.0)
    with pytest.raises(ConfigError, match="does not fit"):
        fly(Route(points, 60.0, turn_radius_m=radius + 2), 1.0)


def test_what_else_cannot_be_flown() -> None:
    with pytest.raises(ConfigError, match="rolling in alone takes more room"):
        fly(Route(curve_about(90.0, leg_m=1000.0), 60.0, roll_in_s=60.0))
    with pytest.raises(ConfigError, match="reverses its course at waypoint 2"):
        fly(Route(curve_about(180.0), 60.0))
    with pytest.raises(ConfigError, match=r"route leg 2 is too short to go from 60 to 200 m/s"):
        fly(Route(curve_about(30.0, leg_m=5000.0), [60.0, 200.0]))
    with pytest.raises(ConfigError, match="rate_hz"):
        fly(Route(POINTS, 80.0), 0.0)

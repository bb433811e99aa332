"""Terrain avoidance cueing: laws with an answer known beforehand."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from terranav.core.earth import shift
from terranav.core.errors import ConfigError
from terranav.core.records import Estimate, Status
from terranav.maps.fields import plane_map
from terranav.maps.map import Map
from terranav.planning.cue import Cue, CueSettings, CueState, cue

CELL_M = 50.0
FLAT = plane_map(0.0, 0.0, height=100.0, cells=401, cell_m=CELL_M, sigma=0.0)
EXACT = CueSettings(margin_m=100.0, lookahead_s=60.0, altitude_sigma_m=0.0, velocity_sigma_mps=0.0)
NORTHWARD = (100.0, 0.0, 0.0)


def at_centre(altitude_m: float = 500.0, sigma_m: float = 0.0, status: Status = Status.CONVERGED) -> Estimate:
    return Estimate(0.0, *FLAT.centre_deg, altitude_m, np.zeros(2), np.eye(2) * sigma_m**2, status)


def land(height: NDArray[np.float64]) -> Map:
    """A map of heights given on the grid of FLAT."""
    return replace(FLAT, values=height)


def offsets() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Metres north and east of the centre of every cell."""
    at = (np.arange(401) - 200) * CELL_M
    return -at[:, None] + 0.0 * at, at + 0.0 * at[:, None]


def wall(north_m: float = 3000.0, height_m: float = 900.0) -> Map:
    """Flat land of 100 m up to `north_m`, then a plateau one cell further north."""
    north, _ = offsets()
    return land(np.where(north > north_m + 1.0, height_m, 100.0))


def test_flat_land_below_is_clear() -> None:
    found = cue(at_centre(sigma_m=300.0), NORTHWARD, FLAT, replace(EXACT, altitude_sigma_m=10.0))
    assert found.state is CueState.CLEAR
    assert found.peak == pytest.approx(0.0, abs=1e-12)
    assert math.isnan(found.time_to_s)
    assert math.isnan(found.unknown_from_s)
    assert (found.left_deg, found.right_deg, found.climb_mps) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("speed_mps", [40.0, 100.0, 230.0])
def test_time_to_a_wall_is_exact(speed_mps: float) -> None:
    """The ramp rises 800 m over one cell beyond 3 km; at 500 m altitude the margin is broken at 400 m of ground."""
    found = cue(at_centre(), (speed_mps, 0.0, 0.0), wall(), replace(EXACT, lookahead_s=6000.0 / speed_mps))
    distance_m = 3000.0 + CELL_M * (400.0 - 100.0) / 800.0
    assert found.state is CueState.WARNING
    assert found.time_to_s == pytest.approx(distance_m / speed_mps, abs=2e-3)
    assert found.peak == pytest.approx(1.0)
    assert set(np.round(found.probability, 9)) == {0.0, 1.0}


def test_descending_into_flat_land() -> None:
    found = cue(at_centre(), (80.0, 30.0, 10.0), FLAT, EXACT)
    assert found.time_to_s == pytest.approx((500.0 - 100.0 - 100.0) / 10.0, abs=1e-4)
    assert found.climb_mps == 0.0  # levelling off is enough


def test_climb_is_the_geometry() -> None:
    """Over the top of a wall: 900 + 100 m at the first cell of the plateau, from 500 m, and steeper ramps before it."""
    found = cue(at_centre(), NORTHWARD, wall(), EXACT)
    ahead_s = np.linspace(0.0, 60.0, 60_001)[1:]
    ground = np.interp(100.0 * ahead_s, [0.0, 3000.0, 3050.0, 6000.0], [100.0, 100.0, 900.0, 900.0])
    needed = ((ground + 100.0 - 500.0) / ahead_s).max()
    assert needed == pytest.approx(500.0 / 30.5, rel=1e-3)
    assert found.climb_mps == pytest.approx(needed, rel=0.01)
    up = cue(at_centre(), (100.0, 0.0, -found.climb_mps - 0.01), wall(), EXACT, evade=False)
    assert up.state is CueState.CLEAR


def test_altitude_noise_is_the_normal_distribution() -> None:
    settings = replace(EXACT, altitude_sigma_m=30.0, threshold=0.5)
    found = cue(at_centre(240.0), NORTHWARD, replace(FLAT, sigma=40.0), settings)
    np.testing.assert_allclose(found.probability, norm.cdf(-40.0 / 50.0), rtol=1e-9)


def test_position_noise_over_a_plane_is_the_normal_distribution() -> None:
    """Clearance over a plane is Gaussian: slope times the position error, and the altitude's."""
    slope, sigma_m = 0.125, 200.0
    plane = plane_map(slope, 0.0, height=100.0, cells=401, cell_m=CELL_M, sigma=0.0)
    settings = replace(EXACT, altitude_sigma_m=20.0, lookahead_s=10.0, nodes=31)
    found = cue(at_centre(350.0, sigma_m), NORTHWARD, plane, settings)
    short = 100.0 - (350.0 - 100.0 - slope * 100.0 * found.ahead_s)
    np.testing.assert_allclose(found.probability, norm.cdf(short / math.hypot(20.0, slope * sigma_m)), atol=1e-4)


def test_probability_grows_with_the_covariance() -> None:
    """A wall beside the path: the less certain the position, the likelier it is hit."""
    _, east = offsets()
    beside = land(np.where(east > 800.0, 900.0, 100.0))
    peaks = [cue(at_centre(sigma_m=s), NORTHWARD, beside, EXACT, evade=False).peak for s in (0.0, 200.0, 400.0, 800.0)]
    assert peaks == sorted(peaks)
    assert peaks[0] == 0.0 < peaks[1] < peaks[3]
    drifting = replace(EXACT, velocity_sigma_mps=10.0)
    later = cue(at_centre(sigma_m=200.0), NORTHWARD, beside, drifting, evade=False).probability
    assert later[-1] > later[0]


def test_symmetric_valley_turns_are_equal() -> None:
    """A wall ahead between two equal open sides."""
    north, east = offsets()
    ridge = land(np.where((north > 3000.0) & (np.abs(east) < 2000.0), 900.0, 100.0))
    found = cue(at_centre(sigma_m=30.0), NORTHWARD, ridge, replace(EXACT, lookahead_s=55.0))
    assert found.state is CueState.WARNING
    assert found.left_deg == found.right_deg > 0.0


def test_the_open_side_is_named() -> None:
    north, east = offsets()
    land_left = land(np.where((north > 3000.0) | (east < -300.0), 900.0, 100.0))
    found = cue(at_centre(sigma_m=10.0), NORTHWARD, land_left, EXACT)
    assert math.isnan(found.left_deg)
    assert found.right_deg >= 60.0


def test_a_turn_follows_its_circle() -> None:
    """A half turn ends two radii to the side: a wall just beyond is cleared, one just before is not."""
    radius_m = 100.0**2 / (9.80665 * math.tan(math.radians(30.0)))
    north, east = offsets()
    settings = replace(EXACT, turns_deg=(180.0,))
    for gap, clear in ((1.1, True), (0.9, False)):
        canyon = land(
            np.where((north > 1.2 * radius_m + 200) | (east > 2 * gap * radius_m) | (east < -200), 900.0, 100.0)
        )
        assert (cue(at_centre(), NORTHWARD, canyon, settings).right_deg == 180.0) is clear


@pytest.mark.parametrize("sigma_m", [0.0, 100.0])
def test_beyond_the_map_is_unknown_and_never_clear(sigma_m: float) -> None:
    lat, lon = shift(*FLAT.centre_deg, 7000.0, 0.0)
    near_edge = replace(at_centre(sigma_m=sigma_m), lat_deg=float(lat), lon_deg=float(lon))
    found = cue(near_edge, NORTHWARD, FLAT, EXACT)
    assert found.state is CueState.UNKNOWN
    assert found.unknown_from_s == pytest.approx(30.0, abs=0.01 if sigma_m == 0.0 else 4.0)
    assert np.isnan(found.probability[-1])
    assert found.unknown[-1] == 1.0
    assert math.isnan(found.climb_mps)
    assert found.right_deg >= 60.0  # along the edge, or back


def test_off_the_map_everything_is_unknown() -> None:
    found = cue(replace(at_centre(), lat_deg=40.0), NORTHWARD, FLAT, EXACT)
    assert found.state is CueState.UNKNOWN
    assert found.unknown_from_s == 0.0
    assert math.isnan(found.peak)
    assert np.isnan([found.left_deg, found.right_deg, found.climb_mps]).all()


def test_a_void_ahead_hides_nothing() -> None:
    north, _ = offsets()
    holed = land(np.where((north > 2000.0) & (north < 2500.0), np.nan, 100.0))
    assert cue(at_centre(), NORTHWARD, holed, EXACT).state is CueState.UNKNOWN
    both = land(np.where((north > 2000.0) & (north < 2500.0), np.nan, wall().values))
    assert cue(at_centre(), NORTHWARD, both, EXACT).state is CueState.WARNING


def test_a_lost_estimate_is_never_clear() -> None:
    found = cue(at_centre(status=Status.LOST), NORTHWARD, FLAT, EXACT)
    assert found.state is CueState.UNKNOWN
    assert np.isnan([found.left_deg, found.right_deg, found.climb_mps]).all()


def test_too_near_already() -> None:
    found = cue(at_centre(150.0), NORTHWARD, FLAT, EXACT)
    assert found.time_to_s == 0.0
    assert np.isnan([found.left_deg, found.right_deg, found.climb_mps]).all()


def test_standing_still() -> None:
    found = cue(at_centre(), (0.0, 0.0, 0.0), FLAT, EXACT)
    assert found.state is CueState.CLEAR
    assert math.isnan(cue(at_centre(150.0), (0.0, 0.0, 0.0), FLAT, EXACT).left_deg)


def test_same_input_same_bits() -> None:
    def bits(found: Cue) -> list[Any]:
        return [found.probability.tobytes(), found.time_to_s.hex(), found.left_deg.hex(), found.climb_mps.hex()]

    assert bits(cue(at_centre(sigma_m=40.0), NORTHWARD, wall())) == bits(
        cue(at_centre(sigma_m=40.0), NORTHWARD, wall())
    )


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("margin_m", -1.0),
        ("lookahead_s", 0.0),
        ("threshold", 1.0),
        ("threshold", 0.0),
        ("altitude_sigma_m", -5.0),
        ("velocity_sigma_mps", math.nan),
        ("bank_deg", 90.0),
        ("turns_deg", (200.0,)),
        ("nodes", 2),
    ],
)
def test_impossible_settings(key: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=key):
        CueSettings(**{key: value})


def test_impossible_input() -> None:
    with pytest.raises(ConfigError, match="kind gravity"):
        cue(at_centre(), NORTHWARD, plane_map(0.0, 0.0, kind="gravity"))
    with pytest.raises(ConfigError, match="velocity_mps"):
        cue(at_centre(), (math.nan, 0.0, 0.0), FLAT)
    with pytest.raises(ConfigError, match="alt_m"):
        cue(at_centre(math.nan), NORTHWARD, FLAT)

"""What the test bed flies."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from terranav.core.checks import finite, unknown_name
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.sensors.altimeter import Altimeter
from terranav.sensors.bands import Band
from terranav.sensors.barometer import Barometer

AUTOPILOTS = ("px4", "ardupilot")
REPORTS = ("own", "ins")
#: DISTANCE_SENSOR holds no more [m]: 16 bits of centimetres, the last of which means 'unknown'
FARTHEST_M = 655.34
#: 2026-01-01 12:00 UTC [us since 1970]
START_US = 1_767_268_800_000_000


def _calibrated() -> InsGrade:
    """An INS of tactical grade whose biases were found in the flight before: it drifts by 1 to 3 km in 18 minutes."""
    return InsGrade(
        name="calibrated",
        position_sigma_m=3.0,
        velocity_sigma_mps=0.1,
        position_walk_m_per_sqrt_s=0.0,
        attitude_sigma_deg=0.02,
        heading_sigma_deg=0.3,
        gyro_bias_sigma_deg_per_h=0.2,
        accel_bias_sigma_ug=200.0,
        gyro_walk_deg_per_sqrt_h=0.05,
        accel_walk_mps_per_sqrt_h=0.02,
    )


def _radar() -> Altimeter:
    """A radar altimeter as light aircraft carry: 1 m and 1 %, to 650 m, lost in short gaps for 2 % of the time."""
    return Altimeter(
        bands=(Band(650.0, sigma_m=1.0, sigma_fraction=0.01),),
        min_m=1.0,
        dropout_probability=0.02,
        dropout_length=5.0,
        resolution_m=0.01,
    )


def _barometer() -> Barometer:
    """A barometer whose height is 20 m off, wanders by 4 m within 20 minutes, and is noisy by 0.3 m."""
    return Barometer(bands=(Band(sigma_m=0.3),), bias_m=20.0, drift_sigma_m=4.0, drift_correlation_s=1200.0)


@dataclass(frozen=True)
class FlightSettings:
    """What the test bed flies; the same settings give the same bits.

    Attributes
    ----------
    minutes : float
        How long, 0.1 to 6000.
    gnss_off_s : float
        GNSS is switched off at this time; infinite for never [s].
    jam_at_s : float
        GNSS is jammed from this time: noisy, then gone; infinite for never [s].
    spoof_at_s, spoof_mps : float
        GNSS is pulled away from this time on, at this speed; infinite for never [s], [m/s].
    autopilot : 'px4' or 'ardupilot'
        Which one the vehicle says it is; it decides which messages it sends and which fixes it takes.
    reports : 'own' or 'ins'
        What the messages of position, velocity and attitude carry: what the vehicle's own filter makes of everything,
        as autopilots report it, or its INS, which nothing corrects.
    seed : int
        Of the route, the wind, and all errors.
    airspeed_mps : float
        True airspeed, 42 to 58.
    clearance_m : float
        Planned height above the highest ground near the route [m]; well below the altimeter's range.
    wind_mps : float
        Mean wind; gusts of a fifth of it are added.
    grade : InsGrade
        Of the vehicle's INS.
    altimeter, barometer : Altimeter, Barometer
    system_id : int
        MAVLink's, 1 to 249.
    start_us : int
        The date at the start [us since 1970]: it stands in SYSTEM_TIME and in signatures.
    sign_key : bytes or None
        32 bytes: sign all that is sent, and take only what is signed.

    Raises
    ------
    ConfigError
        Naming the setting, the value and what was expected.
    """

    minutes: float = 20.0
    gnss_off_s: float = 120.0
    jam_at_s: float = math.inf
    spoof_at_s: float = math.inf
    spoof_mps: float = 2.0
    autopilot: str = "px4"
    reports: str = "own"
    seed: int = 0
    airspeed_mps: float = 50.0
    clearance_m: float = 150.0
    wind_mps: float = 5.0
    grade: InsGrade = field(default_factory=_calibrated)
    altimeter: Altimeter = field(default_factory=_radar)
    barometer: Barometer = field(default_factory=_barometer)
    system_id: int = 1
    start_us: int = START_US
    sign_key: bytes | None = None

    def __post_init__(self) -> None:
        finite("minutes", self.minutes, minimum=0.1, maximum=6000.0)
        for key in ("gnss_off_s", "jam_at_s", "spoof_at_s"):
            if getattr(self, key) != math.inf:
                finite(key.replace("_", "-").removesuffix("-s"), getattr(self, key), minimum=0.0)
        finite("spoof-mps", self.spoof_mps, minimum=0.0, maximum=100.0)
        finite("airspeed", self.airspeed_mps, minimum=42.0, maximum=58.0)
        finite("clearance", self.clearance_m, minimum=50.0, maximum=3000.0)
        finite("wind", self.wind_mps, minimum=0.0, maximum=15.0)
        if self.autopilot not in AUTOPILOTS:
            unknown_name("autopilot", str(self.autopilot), AUTOPILOTS)
        if self.reports not in REPORTS:
            unknown_name("reports", str(self.reports), REPORTS)
        for key, low, high in (("seed", 0, 2**63), ("system_id", 1, 249), ("start_us", 10**15, 4 * 10**15)):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise ConfigError(f"{key} is {value!r}, expected a whole number from {low} to {high}")
        top = self.altimeter.bands[-1].below_m
        if top > FARTHEST_M:
            raise ConfigError(
                f"altimeter reaches {top:g} m, expected at most {FARTHEST_M:g} m: DISTANCE_SENSOR holds no more"
            )
        if self.sign_key is not None and len(self.sign_key) != 32:
            raise ConfigError(f"sign_key has {len(self.sign_key)} bytes, expected 32")

    @property
    def duration_s(self) -> float:
        """How long the flight is [s]."""
        return 60.0 * self.minutes

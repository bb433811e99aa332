"""MAVLink messages out: what a PX4 or an ArduPilot plane with these sensors sends, at rates that a client may change.

Both send HEARTBEAT, SYS_STATUS, SYSTEM_TIME, GPS_RAW_INT, ATTITUDE, GLOBAL_POSITION_INT, LOCAL_POSITION_NED,
SCALED_PRESSURE, VFR_HUD, DISTANCE_SENSOR, GPS_GLOBAL_ORIGIN, HOME_POSITION and EXTENDED_SYS_STATE; PX4 also ALTITUDE
and HIGHRES_IMU, ArduPilot RANGEFINDER. Stamps of `time_boot_ms` and `time_usec` count from the start of the vehicle, a
minute before the flight begins; messages carry what was so at that time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import offset_of
from terranav.live.mavlink_in import dialect
from terranav.live.testbed.aircraft import AircraftState, Triple
from terranav.live.testbed.inertial import Indicated
from terranav.live.testbed.senses import GnssReading
from terranav.live.testbed.settings import FlightSettings

FloatArray = NDArray[np.float64]

#: the vehicle has run for so long when the flight begins
BOOT_US = 60_000_000
AUTOPILOT_COMPONENT = 1
#: signatures count from 2015-01-01 UTC [s since 1970]
_SIGNING_EPOCH_US = 1_420_070_400_000_000
_ISA_M, _ISA_POWER, _ISA_HPA = 44330.77, 0.190263, 1013.25  # standard atmosphere (ICAO Doc 7488)
_DOWN = 25  # orientation of a sensor that looks straight down
#: message -> its number and how many a second
RATES_HZ = {
    "HEARTBEAT": (0, 1.0), "SYS_STATUS": (1, 1.0), "SYSTEM_TIME": (2, 1.0), "GPS_RAW_INT": (24, 5.0),
    "SCALED_PRESSURE": (29, 5.0), "ATTITUDE": (30, 10.0), "LOCAL_POSITION_NED": (32, 10.0),
    "GLOBAL_POSITION_INT": (33, 10.0), "GPS_GLOBAL_ORIGIN": (49, 0.2), "VFR_HUD": (74, 5.0), "HIGHRES_IMU": (105, 10.0),
    "DISTANCE_SENSOR": (132, 10.0), "ALTITUDE": (141, 5.0), "RANGEFINDER": (173, 10.0), "HOME_POSITION": (242, 0.2),
    "EXTENDED_SYS_STATE": (245, 1.0),
}  # fmt: skip
_ONLY = {"HIGHRES_IMU": "px4", "ALTITUDE": "px4", "RANGEFINDER": "ardupilot"}


@dataclass(frozen=True, slots=True)
class Told:
    """What the vehicle has to tell at one tick.

    Attributes
    ----------
    time_us : int
        Since the start of the flight [us].
    shown : Indicated
        Position, velocity and attitude that it reports.
    alt_m : float
        Height above mean sea level that it reports [m].
    rates_radps, force_mps2 : (3,)
        What gyros and accelerometers read, body axes.
    pressure_alt_m : float
        What the barometer reads, as a height in the standard atmosphere.
    range_m : float or None
        What the altimeter reads; infinite beyond its limits.
    gnss : GnssReading or None
    gnss_fresh : bool
        Whether the receiver spoke at this tick.
    truth : AircraftState
        For the airspeed.
    """

    time_us: int
    shown: Indicated
    alt_m: float
    rates_radps: FloatArray
    force_mps2: FloatArray
    pressure_alt_m: float
    range_m: float | None
    gnss: GnssReading | None
    gnss_fresh: bool
    truth: AircraftState


class Telemetry:
    """Packs messages.

    Parameters
    ----------
    settings : FlightSettings
    home : (lat_deg, lon_deg, alt_m)
        Where local positions count from.
    limits_m : (low, high)
        Of the altimeter.
    """

    def __init__(self, settings: FlightSettings, home: Triple, limits_m: tuple[float, float]) -> None:
        self._d = dialect()
        self._mav = self._d.MAVLink(None, srcSystem=settings.system_id, srcComponent=AUTOPILOT_COMPONENT)
        self._settings, self._home, self._limits = settings, home, limits_m
        self.home_e7 = (round(home[0] * 1e7), round(home[1] * 1e7), round(home[2] * 1e3))
        self.system_id = settings.system_id
        self.px4 = settings.autopilot == "px4"
        if settings.sign_key is not None:
            self._mav.signing.secret_key, self._mav.signing.sign_outgoing = settings.sign_key, True
        self.interval_us = {
            name: round(1e6 / rate)
            for name, (_, rate) in RATES_HZ.items()
            if _ONLY.get(name, settings.autopilot) == settings.autopilot
        }
        self._due = dict.fromkeys(self.interval_us, 0)
        self._makers: dict[str, Callable[[Told], Any]] = {
            name: getattr(self, f"_{name.lower()}") for name in self.interval_us
        }

    def pack(self, time_us: int, message: Any) -> bytes:
        """One frame, signed where there is a key."""
        signing = self._mav.signing
        if signing.sign_outgoing:
            signing.timestamp = max(signing.timestamp, signing_stamp(self._settings.start_us + time_us))
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame

    def due(self, told: Told) -> Iterator[bytes]:
        """The messages whose time has come."""
        for name, interval in self.interval_us.items():
            if interval > 0 and told.time_us >= self._due[name]:
                self._due[name] += interval * max(1, math.ceil((told.time_us - self._due[name] + 1) / interval))
                frame = self.one(name, told)
                if frame is not None:
                    yield frame

    def one(self, name: str, told: Told) -> bytes | None:
        """One message by its name; None where there is nothing to say or the vehicle has no such message."""
        maker = self._makers.get(name)
        message = maker(told) if maker is not None else None
        return None if message is None else self.pack(told.time_us, message)

    def set_interval(self, number: int, interval_us: float) -> bool:
        """Change how often a message is sent: -1 never, 0 its usual rate; False for a message it does not have."""
        name = next((name for name, (its, _) in RATES_HZ.items() if its == number), "")
        if name not in self.interval_us or not math.isfinite(interval_us):
            return False
        usual = round(1e6 / RATES_HZ[name][1])
        self.interval_us[name] = 0 if interval_us < 0 else max(round(interval_us), 100_000) if interval_us else usual
        return True

    def local_m(self, told: Told) -> Triple:
        """Reported position from home, north, east, down [m]."""
        north, east = offset_of(self._home[0], self._home[1], told.shown.lat_deg, told.shown.lon_deg)
        return north, east, self._home[2] - told.alt_m

    def _heartbeat(self, told: Told) -> Any:
        d = self._d
        mode = d.MAV_MODE_FLAG_SAFETY_ARMED | d.MAV_MODE_FLAG_AUTO_ENABLED | d.MAV_MODE_FLAG_GUIDED_ENABLED
        mode |= d.MAV_MODE_FLAG_STABILIZE_ENABLED | d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        # mission: PX4's main mode auto (4) and sub mode mission (4); number 10 of ArduPlane
        kind, custom = (d.MAV_AUTOPILOT_PX4, 4 << 16 | 4 << 24) if self.px4 else (d.MAV_AUTOPILOT_ARDUPILOTMEGA, 10)
        return d.MAVLink_heartbeat_message(d.MAV_TYPE_FIXED_WING, kind, mode, custom, d.MAV_STATE_ACTIVE, 3)

    def _sys_status(self, told: Told) -> Any:
        d = self._d
        there = d.MAV_SYS_STATUS_SENSOR_3D_GYRO | d.MAV_SYS_STATUS_SENSOR_3D_ACCEL | d.MAV_SYS_STATUS_AHRS
        there |= d.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE | d.MAV_SYS_STATUS_SENSOR_GPS
        well = there if told.gnss is not None else there & ~d.MAV_SYS_STATUS_SENSOR_GPS
        return d.MAVLink_sys_status_message(there, there, well, 200, 12600, -1, 90, 0, 0, 0, 0, 0, 0)

    def _system_time(self, told: Told) -> Any:
        return self._d.MAVLink_system_time_message(self._settings.start_us + told.time_us, _boot_ms(told))

    def _gps_raw_int(self, told: Told) -> Any:
        if not told.gnss_fresh:
            return None
        gnss, stamp = told.gnss, _boot_us(told)
        if gnss is None:
            return self._d.MAVLink_gps_raw_int_message(
                stamp, self._d.GPS_FIX_TYPE_NO_FIX, 0, 0, 0, 65535, 65535, 65535, 65535, 0
            )
        north, east, _ = gnss.velocity_mps
        course = round(math.degrees(math.atan2(east, north)) % 360.0 * 100.0) % 36000
        accuracy = round(gnss.sigma_m * 1e3), round(gnss.height_sigma_m * 1e3), round(gnss.velocity_sigma_mps * 1e3)
        dilution = min(round(gnss.sigma_m / 1.5 * 80.0), 65534)
        height, speed = round(gnss.alt_m * 1e3), round(math.hypot(north, east) * 100.0)
        moving = dilution, dilution, speed, course, gnss.satellites
        place = *_e7(gnss.lat_deg, gnss.lon_deg), height
        return self._d.MAVLink_gps_raw_int_message(
            stamp, self._d.GPS_FIX_TYPE_3D_FIX, *place, *moving, height, *accuracy
        )

    def _scaled_pressure(self, told: Told) -> Any:
        equivalent = told.truth.equivalent_mps
        return self._d.MAVLink_scaled_pressure_message(
            _boot_ms(told), pressure_hpa(told.pressure_alt_m), 0.5 * 1.225 * equivalent**2 / 100.0, 1500
        )

    def _attitude(self, told: Told) -> Any:
        roll, pitch, heading = (math.radians((angle + 180.0) % 360.0 - 180.0) for angle in told.shown.attitude_deg)
        return self._d.MAVLink_attitude_message(_boot_ms(told), roll, pitch, heading, *told.rates_radps.tolist())

    def _local_position_ned(self, told: Told) -> Any:
        return self._d.MAVLink_local_position_ned_message(_boot_ms(told), *self.local_m(told), *told.shown.velocity_mps)

    def _global_position_int(self, told: Told) -> Any:
        speeds = [round(speed * 100.0) for speed in told.shown.velocity_mps]
        height = round(told.alt_m * 1e3)
        heading = round(told.shown.attitude_deg[2] * 100.0) % 36000
        return self._d.MAVLink_global_position_int_message(
            _boot_ms(told),
            *_e7(told.shown.lat_deg, told.shown.lon_deg),
            height,
            height - self.home_e7[2],
            *speeds,
            heading,
        )

    def _gps_global_origin(self, told: Told) -> Any:
        return self._d.MAVLink_gps_global_origin_message(*self.home_e7, _boot_us(told))

    def _home_position(self, told: Told) -> Any:
        level = (1.0, 0.0, 0.0, 0.0)
        return self._d.MAVLink_home_position_message(*self.home_e7, 0, 0, 0, level, 0, 0, 0, _boot_us(told))

    def _vfr_hud(self, told: Told) -> Any:
        ground = math.hypot(*told.shown.velocity_mps[:2])
        heading = round(told.shown.attitude_deg[2]) % 360
        return self._d.MAVLink_vfr_hud_message(
            told.truth.equivalent_mps, ground, heading, round(100 * told.truth.throttle), told.alt_m,
            -told.shown.velocity_mps[2],
        )  # fmt: skip

    def _highres_imu(self, told: Told) -> Any:
        pressure, height = pressure_hpa(told.pressure_alt_m), told.pressure_alt_m
        read = 0x1E3F  # accelerations, turn rates, pressures, height, temperature; no magnetometer
        difference = 0.5 * 1.225 * told.truth.equivalent_mps**2 / 100.0
        return self._d.MAVLink_highres_imu_message(
            _boot_us(told),
            *told.force_mps2.tolist(),
            *told.rates_radps.tolist(),
            0,
            0,
            0,
            pressure,
            difference,
            height,
            15.0,
            read,
        )

    def _distance_sensor(self, told: Told) -> Any:
        if told.range_m is None:
            return None
        low, high = (round(limit * 100.0) for limit in self._limits)
        seen = math.isfinite(told.range_m)
        current = round(told.range_m * 100.0) if seen else high
        return self._d.MAVLink_distance_sensor_message(
            _boot_ms(told), low, high, min(current, high), self._d.MAV_DISTANCE_SENSOR_RADAR, 0, _DOWN, 255,
            signal_quality=100 if seen else 1,
        )  # fmt: skip

    def _rangefinder(self, told: Told) -> Any:
        if told.range_m is None:
            return None
        return self._d.MAVLink_rangefinder_message(min(told.range_m, self._limits[1]), 0.0)

    def _altitude(self, told: Told) -> Any:
        seen = told.range_m is not None and math.isfinite(told.range_m)
        clearance = told.range_m if seen else -1.0
        above = told.alt_m - self._home[2]
        ground = told.alt_m - clearance if seen and clearance is not None else math.nan
        return self._d.MAVLink_altitude_message(
            _boot_us(told), told.pressure_alt_m, told.alt_m, above, above, ground, clearance
        )

    def _extended_sys_state(self, told: Told) -> Any:
        return self._d.MAVLink_extended_sys_state_message(
            self._d.MAV_VTOL_STATE_UNDEFINED, self._d.MAV_LANDED_STATE_IN_AIR
        )


def signing_stamp(date_us: int) -> int:
    """A date [us since 1970] as signatures count it [10 us since 2015]."""
    return (date_us - _SIGNING_EPOCH_US) // 10


def pressure_hpa(altitude_m: float) -> float:
    """Pressure at a height in the standard atmosphere, below 11 km [hPa]."""
    return float(_ISA_HPA * (1.0 - altitude_m / _ISA_M) ** (1.0 / _ISA_POWER))


def _boot_us(told: Told) -> int:
    return told.time_us + BOOT_US


def _boot_ms(told: Told) -> int:
    return _boot_us(told) // 1000 % 2**32


def _e7(lat_deg: float, lon_deg: float) -> tuple[int, int]:
    return round(lat_deg * 1e7), round(lon_deg * 1e7)

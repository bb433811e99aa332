"""Fixes as MAVLink messages: what each autopilot takes, in the units and frames that it reads.

- px4: GLOBAL_POSITION_SENSOR (296), source terrain. time_usec is the time of sending and processing_time what lies
  between the measurement and it (MAVLink common.xml); eph is one horizontal sigma.
- ardupilot: ODOMETRY (331). ArduPilot takes it only in the frames LOCAL_FRD and BODY_FRD; x, y, z count from the EKF's
  origin, north, east, down; the velocity is along the body. The covariances are upper triangles by rows, so that the
  diagonal has the places 0, 6, 11, 15, 18, 20. The reset counter never changes: with VISO_TYPE 3 ArduPilot would shift
  all that comes after a reset to where it was before, and so keep the error that the fix is to take away.
- gps-input: GPS_INPUT (232) without velocity, which would be the autopilot's own come back, or GPS time.
- reset: COMMAND_INT with MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003): sender's time, processing time [s], 1 sigma [m].

No field is ever NaN: what MAVLink would have as NaN for 'not known' is a wide number.
"""

from __future__ import annotations

import math
from typing import Any

from terranav.core.earth import offset_of
from terranav.live.mavlink_in import dialect
from terranav.live.outgoing import Offer
from terranav.live.signing import sign_with, tick

ONBOARD_COMPUTER, AUTOPILOT = 191, 1
EXTERNAL_POSITION_ESTIMATE, REQUEST_MESSAGE, GLOBAL_ORIGIN = 43003, 512, 49
#: the sender's clock of a reset starts again so often: 32-bit floats still tell a quarter of a millisecond there [s]
_WRAP_S = 3600.0
_ONBOARD_CONTROLLER, _NO_AUTOPILOT, _ACTIVE = 18, 8, 4
_LOCAL_FRD, _BODY_FRD, _GLOBAL, _NO_RESETS = 20, 12, 0, 0
_SOURCE_TERRAIN = 4
#: of this source among the auxiliary ones of PX4, its parameter EKF2_AGP0_ID; 0 would mean none
SENSOR_ID = 1
_DIAGONAL = (0, 6, 11, 15, 18, 20)
#: claimed for what the map says nothing of: height [m], attitude [rad], velocity [m/s], rates [rad/s]
_ALT_SIGMA_M, _ATTITUDE_SIGMA, _VELOCITY_SIGMA, _RATE_SIGMA = 100.0, 0.1, 5.0, 1.0
_IGNORED = 8 | 16 | 32  # horizontal and vertical velocity, speed accuracy
#: ArduPilot refuses a receiver with fewer; no satellite stands behind it
_SATELLITES = 10

Origin = tuple[float, float, float]


class Encoder:
    """Packs messages of one component, numbered and, with a key, signed.

    Parameters
    ----------
    system : int
        The vehicle's system id: the onboard computer is a component of it.
    key : bytes, optional
        Sign with it.
    link : int
        The number of the link in signatures.
    """

    def __init__(self, system: int = 1, key: bytes | None = None, link: int = 0) -> None:
        self._messages = dialect()
        self._out = self._messages.MAVLink(None, srcSystem=system, srcComponent=ONBOARD_COMPUTER)
        if key is not None:
            sign_with(self._out, key, link)

    @property
    def system(self) -> int:
        """The system id under which it sends."""
        return int(self._out.srcSystem)

    @system.setter
    def system(self, system: int) -> None:
        self._out.srcSystem = system

    def _packed(self, message: Any) -> bytes:
        """The bytes of a message; every number in it is finite."""
        for name in message.fieldnames:
            value = getattr(message, name)
            for number in value if isinstance(value, (list, tuple)) else (value,):
                if isinstance(number, float) and not math.isfinite(number):
                    raise ValueError(f"{message.msgname}.{name} is {number}, expected a finite number")
        tick(self._out)
        frame = bytes(message.pack(self._out))
        self._out.seq = (self._out.seq + 1) % 256
        return frame

    def heartbeat(self) -> bytes:
        """We are there: an onboard computer."""
        make = self._messages.MAVLink_heartbeat_message
        return self._packed(make(_ONBOARD_CONTROLLER, _NO_AUTOPILOT, 0, 0, _ACTIVE, 3))

    def origin_request(self, target: int) -> bytes:
        """Ask the autopilot where x, y, z count from."""
        make = self._messages.MAVLink_command_long_message
        return self._packed(make(target, AUTOPILOT, REQUEST_MESSAGE, 0, GLOBAL_ORIGIN, 0, 0, 0, 0, 0, 0))

    def timesync(self, time_us: int, asked_ns: int) -> bytes:
        """Answer a request for our time."""
        return self._packed(self._messages.MAVLink_timesync_message(time_us * 1000, asked_ns))

    def global_position(self, offer: Offer) -> bytes:
        """GLOBAL_POSITION_SENSOR, for PX4."""
        sent_us = (offer.stamp_us if offer.boot_us is None else offer.boot_us) + offer.age_us
        make = self._messages.MAVLink_global_position_sensor_message
        place = (_degrees_e7(offer.lat_deg), _degrees_e7(offer.lon_deg))
        # its altitude is the one that the autopilot told, and above the sea: the ellipsoid's is left at the same value
        heights = (float(offer.alt_m), float(offer.alt_m))
        times = (sent_us, min(offer.age_us, 0xFFFFFFFF))
        return self._packed(
            make(0, 0, SENSOR_ID, *times, _SOURCE_TERRAIN, 0, *place, *heights, offer.horizontal_m, _ALT_SIGMA_M)
        )

    def odometry(self, offer: Offer, origin: Origin) -> bytes:
        """ODOMETRY, for ArduPilot; the offer has an attitude.

        Parameters
        ----------
        offer : Offer
        origin : (lat, lon [deg], altitude above the sea [m])
            Of the EKF.
        """
        north, east = offset_of(origin[0], origin[1], offer.lat_deg, offer.lon_deg)
        turn = quaternion(*(offer.attitude_deg or (0.0, 0.0, 0.0)))
        along = _into_body(turn, offer.velocity_mps or (0.0, 0.0, 0.0))
        north_m, east_m = offer.sigma_m
        pose = _triangle(
            (north_m, east_m, offer.horizontal_m, _ATTITUDE_SIGMA, _ATTITUDE_SIGMA, _ATTITUDE_SIGMA),
        )
        moving = _triangle((*(_VELOCITY_SIGMA,) * 3, *(_RATE_SIGMA,) * 3))
        quality = max(1, min(100, round(1000.0 / max(offer.horizontal_m, 10.0))))
        time_us = offer.stamp_us if offer.boot_us is None else offer.boot_us
        make = self._messages.MAVLink_odometry_message
        place = (north, east, origin[2] - offer.alt_m)
        rates, after = (0.0, 0.0, 0.0), (_NO_RESETS, 0, quality)
        body = (list(turn), *along, *rates, pose, moving)
        return self._packed(make(time_us, _LOCAL_FRD, _BODY_FRD, *place, *body, *after))

    def gps_input(self, offer: Offer) -> bytes:
        """GPS_INPUT, where the autopilot takes nothing better."""
        sigma = offer.horizontal_m
        time_us = offer.stamp_us if offer.boot_us is None else offer.boot_us
        make = self._messages.MAVLink_gps_input_message
        place = (_degrees_e7(offer.lat_deg), _degrees_e7(offer.lon_deg), float(offer.alt_m))
        dilution = max(1.0, sigma / 5.0)
        still = (0.0, 0.0, 0.0)
        accuracy = (1.0, sigma, _ALT_SIGMA_M, _SATELLITES, 0)
        return self._packed(make(time_us, 0, _IGNORED, 0, 0, 3, *place, dilution, dilution, *still, *accuracy))

    def reset(self, offer: Offer, target: int) -> bytes:
        """The command 43003, for a vehicle that dead-reckons."""
        make = self._messages.MAVLink_command_int_message
        sent_s = ((offer.stamp_us + offer.age_us) * 1e-6) % _WRAP_S
        place = (_degrees_e7(offer.lat_deg), _degrees_e7(offer.lon_deg), float(offer.alt_m))
        told = (sent_s, offer.age_us * 1e-6, offer.horizontal_m, 0.0)
        return self._packed(make(target, AUTOPILOT, _GLOBAL, EXTERNAL_POSITION_ESTIMATE, 0, 0, *told, *place))


def _degrees_e7(degrees: float) -> int:
    """Degrees as MAVLink's 32-bit integers."""
    return round(degrees * 1e7)


def quaternion(roll_deg: float, pitch_deg: float, heading_deg: float) -> tuple[float, float, float, float]:
    """From the body (forward, right, down) to north, east, down: w, x, y, z of yaw, pitch, roll in this order."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(0.5 * math.radians(angle)), math.sin(0.5 * math.radians(angle)))
        for angle in (roll_deg, pitch_deg, heading_deg)
    )
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _into_body(turn: tuple[float, float, float, float], ned: tuple[float, float, float]) -> tuple[float, float, float]:
    """A vector in north, east, down along the axes of the body: turned by the inverse quaternion."""
    w, (x, y, z), (a, b, c) = turn[0], (-turn[1], -turn[2], -turn[3]), ned
    # v' = v + w t + q x t with t = 2 q x v
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (
        a + w * tx + y * tz - z * ty,
        b + w * ty + z * tx - x * tz,
        c + w * tz + x * ty - y * tx,
    )


def _triangle(sigmas: tuple[float, ...]) -> list[float]:
    """The upper triangle of a diagonal covariance by rows (21)."""
    values = [0.0] * 21
    for place, sigma in zip(_DIAGONAL, sigmas, strict=True):
        values[place] = sigma * sigma
    return values

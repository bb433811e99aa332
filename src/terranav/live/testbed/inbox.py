"""What comes in: fixes for the vehicle's filter, and what ground stations ask of a vehicle.

Which fixes are taken is what the autopilot takes that the vehicle says it is:

- PX4: GLOBAL_POSITION_SENSOR (an auxiliary global position) and ODOMETRY (external vision);
- ArduPilot: ODOMETRY (external navigation), GPS_INPUT, and COMMAND_INT 43003 (MAV_CMD_EXTERNAL_POSITION_ESTIMATE), a
  reset that it accepts while it reckons dead, that is without GNSS and fixes.

ODOMETRY counts from the origin that GPS_GLOBAL_ORIGIN tells, north, east and down (frames LOCAL_NED, and LOCAL_FRD
whose forward axis is taken for north, as both autopilots do when it is aligned).
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, Protocol

from terranav.core.earth import shifted
from terranav.live.deframing import Deframer
from terranav.live.mavlink_in import dialect
from terranav.live.testbed.course import Course
from terranav.live.testbed.fusion import OLDEST_S, Fix
from terranav.live.testbed.telemetry import AUTOPILOT_COMPONENT, BOOT_US, RATES_HZ, Telemetry

#: of a message without covariance [m]
_UNKNOWN_M = 10.0
#: stamps beyond are microseconds since 1970, those below since the vehicle's start
_DATES_US = 10**14
_PX4, _ARDUPILOT = ("px4",), ("ardupilot",)
_TAKEN_BY = {"GLOBAL_POSITION_SENSOR": _PX4, "ODOMETRY": (*_PX4, *_ARDUPILOT), "GPS_INPUT": _ARDUPILOT}
_EXTERNAL_POSITION = 43003
_MOST_PENDING, _MOST_PEERS = 4096, 16


class Vehicle(Protocol):
    """What the inbox needs of the flight."""

    @property
    def time_us(self) -> int:
        """Since the start of the flight."""

    @property
    def reckons_dead(self) -> bool:
        """Whether the filter has neither GNSS nor a fix."""

    def fuse(self, fix: Fix) -> bool:
        """Give a fix to the filter."""

    def message(self, name: str) -> bytes | None:
        """A message of telemetry, now."""


@dataclass
class Inbox:
    """Answers.

    Attributes
    ----------
    telemetry : Telemetry
    vehicle : Vehicle
    course : Course
        For the mission that is shown.
    autopilot : str
    origin_deg : (lat, lon)
        Where ODOMETRY counts from.
    start_us : int
        Date of the flight's start.
    checker : callable or None
        Whether a frame is signed as it must be; None takes all.
    """

    telemetry: Telemetry
    vehicle: Vehicle
    course: Course
    autopilot: str
    origin_deg: tuple[float, float]
    start_us: int
    checker: Callable[[bytes], bool] | None = None
    heard: dict[str, int] = field(default_factory=dict)
    ignored: dict[str, int] = field(default_factory=dict)
    out: deque[bytes] = field(default_factory=lambda: deque(maxlen=_MOST_PENDING))

    def __post_init__(self) -> None:
        self._d = dialect()
        self._system = self.telemetry.system_id
        self._decoder = self._d.MAVLink(None)
        self._deframers: dict[Hashable, Deframer] = {}
        self._resets: dict[tuple[int, int], int] = {}
        self.parameters: dict[str, float] = {"SYSID_THISMAV": float(self._system), "SYS_AUTOSTART": 2106.0}
        if self.autopilot == "px4":
            self.parameters |= {"MAV_SYS_ID": float(self._system), "EKF2_AGP0_CTRL": 1.0, "EKF2_AGP0_NOISE": 0.9}
        else:
            self.parameters |= {"VISO_TYPE": 1.0, "EK3_SRC1_POSXY": 6.0, "EK3_SRC1_VELXY": 0.0, "GPS1_TYPE": 1.0}
        self._answers: dict[str, Callable[[Any], None]] = {
            "PARAM_REQUEST_LIST": self._all_parameters,
            "PARAM_REQUEST_READ": self._parameter,
            "PARAM_SET": self._set_parameter,
            "MISSION_REQUEST_LIST": self._mission,
            "MISSION_REQUEST_INT": self._mission_item,
            "MISSION_REQUEST": self._mission_item,
            "COMMAND_LONG": self._command,
            "COMMAND_INT": self._command,
            "TIMESYNC": self._time,
            "PING": self._ping,
        }

    def take(self, data: bytes, peer: Hashable = 0) -> None:
        """Bytes of a peer, in pieces as they come; garbage, and messages for another vehicle, are left."""
        if peer not in self._deframers and len(self._deframers) >= _MOST_PEERS:
            self._deframers.pop(next(iter(self._deframers)))
        for frame in self._deframers.setdefault(peer, Deframer()).feed(data):
            if self.checker is not None and not self.checker(frame):
                self._count(self.ignored, "unsigned")
                continue
            try:
                message = self._decoder.decode(bytearray(frame))
            except (self._d.MAVError, TypeError, ValueError, LookupError, struct.error):
                self._count(self.ignored, "undecoded")
                continue
            name = message.get_type()
            if self._for_us(message):
                self._heard(name, message)
            else:
                self._count(self.ignored, name)

    def answers(self) -> list[bytes]:
        """What there is to say since the last time."""
        frames = list(self.out)
        self.out.clear()
        return frames

    def _for_us(self, message: Any) -> bool:
        """Whether it is meant for this vehicle, and no echo of its own."""
        echo = message.get_srcSystem() == self._system and message.get_srcComponent() == AUTOPILOT_COMPONENT
        return not echo and getattr(message, "target_system", 0) in (0, self._system)

    def _heard(self, name: str, message: Any) -> None:
        self._count(self.heard, name)
        if name in _TAKEN_BY:
            fix = self._fix(name, message) if self.autopilot in _TAKEN_BY[name] else None
            if fix is None or not self.vehicle.fuse(fix):
                self._count(self.ignored, name)
        elif name in self._answers:
            self._answers[name](message)

    @staticmethod
    def _count(of: dict[str, int], name: str) -> None:
        of[name] = of.get(name, 0) + 1

    def _say(self, message: Any) -> None:
        self.out.append(self.telemetry.pack(self.vehicle.time_us, message))

    def _age_s(self, stamp_us: int) -> float:
        """How old a stamp is; one that lies in the future is now."""
        since = stamp_us - self.start_us if stamp_us > _DATES_US else stamp_us - BOOT_US
        return max(0.0, (self.vehicle.time_us - since) * 1e-6) if stamp_us else 0.0

    def _fix(self, name: str, m: Any) -> Fix | None:
        """A fix from one of the messages that carry one; None where it says that it is none."""
        if name == "GLOBAL_POSITION_SENSOR":
            eph = m.eph if math.isfinite(m.eph) else _UNKNOWN_M
            # its stamp is that of sending, and the measurement older by the time of processing
            age = self._age_s(m.time_usec) + m.processing_time * 1e-6
            return Fix(age, m.lat / 1e7, m.lon / 1e7, (eph, eph))
        if name == "GPS_INPUT":
            if m.fix_type < 3:
                return None
            sigma = (
                _UNKNOWN_M if m.ignore_flags & self._d.GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY else m.horiz_accuracy
            )
            unknown = self._d.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ | self._d.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY
            speed = None if m.ignore_flags & unknown else (m.vn, m.ve)
            age = self._age_s(m.time_usec)
            return Fix(age, m.lat / 1e7, m.lon / 1e7, (sigma, sigma), speed, m.speed_accuracy)
        frames = [self._d.MAV_FRAME_LOCAL_FRD]
        if self.autopilot == "px4":
            frames.append(self._d.MAV_FRAME_LOCAL_NED)
        if m.quality < 0 or m.frame_id not in frames or not math.isfinite(m.x + m.y):
            return None
        variances = m.pose_covariance[0], m.pose_covariance[6]  # of x and y in the upper triangle of 6 x 6
        sigma = tuple(math.sqrt(v) if math.isfinite(v) and v > 0 else _UNKNOWN_M for v in variances)
        who = (m.get_srcSystem(), m.get_srcComponent())
        reset = self._resets.setdefault(who, m.reset_counter) != m.reset_counter
        self._resets[who] = m.reset_counter
        return Fix(self._age_s(m.time_usec), *shifted(*self.origin_deg, m.x, m.y), sigma, reset=reset)

    def _all_parameters(self, m: Any) -> None:
        for index in range(len(self.parameters)):
            self._tell_parameter(index)

    def _tell_parameter(self, index: int) -> None:
        name, value = list(self.parameters.items())[index]
        self._say(
            self._d.MAVLink_param_value_message(
                name.encode(), value, self._d.MAV_PARAM_TYPE_REAL32, len(self.parameters), index
            )
        )

    def _parameter(self, m: Any) -> None:
        index = m.param_index if m.param_index >= 0 else self._index(m.param_id)
        if 0 <= index < len(self.parameters):
            self._tell_parameter(index)

    def _set_parameter(self, m: Any) -> None:
        index = self._index(m.param_id)
        if index >= 0:
            if math.isfinite(m.param_value):
                self.parameters[m.param_id] = m.param_value
            self._tell_parameter(index)

    def _index(self, name: str) -> int:
        return list(self.parameters).index(name) if name in self.parameters else -1

    def _mission(self, m: Any) -> None:
        kind = getattr(m, "mission_type", 0)
        count = len(self.course.places) if kind == 0 else 0  # no fences, no rally points
        self._say(
            self._d.MAVLink_mission_count_message(m.get_srcSystem(), m.get_srcComponent(), count, mission_type=kind)
        )

    def _mission_item(self, m: Any) -> None:
        if not 0 <= m.seq < len(self.course.places):
            return
        lat, lon = self.course.places[m.seq]
        height, _ = self.course.height(float(self.course.along_m[m.seq]))
        what = self._d.MAV_FRAME_GLOBAL_INT, self._d.MAV_CMD_NAV_WAYPOINT, int(m.seq == 1), 1, 0, 0, 0, 0
        where = round(lat * 1e7), round(lon * 1e7), height
        sender = m.get_srcSystem(), m.get_srcComponent()
        self._say(self._d.MAVLink_mission_item_int_message(*sender, m.seq, *what, *where))

    def _command(self, m: Any) -> None:
        """Do what can be done, and say so."""
        d = self._d
        done = d.MAV_RESULT_ACCEPTED
        if m.command == d.MAV_CMD_REQUEST_MESSAGE:
            done = self._request(m.param1)
        elif m.command == d.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            done = self._request(d.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        elif m.command == d.MAV_CMD_GET_HOME_POSITION:
            done = self._request(d.MAVLINK_MSG_ID_HOME_POSITION)
        elif m.command == d.MAV_CMD_SET_MESSAGE_INTERVAL:
            known = math.isfinite(m.param1) and self.telemetry.set_interval(int(m.param1), m.param2)
            done = d.MAV_RESULT_ACCEPTED if known else d.MAV_RESULT_UNSUPPORTED
        elif m.command == _EXTERNAL_POSITION and self.autopilot == "ardupilot":
            done = self._external_position(m)
        else:
            done = d.MAV_RESULT_UNSUPPORTED
        self._say(d.MAVLink_command_ack_message(m.command, done, 0, 0, m.get_srcSystem(), m.get_srcComponent()))

    def _external_position(self, m: Any) -> int:
        """A reset of the position while the vehicle reckons dead."""
        d = self._d
        if m.get_type() != "COMMAND_INT":
            return int(d.MAV_RESULT_COMMAND_INT_ONLY)
        if m.frame != d.MAV_FRAME_GLOBAL or not all(map(math.isfinite, (m.param2, m.param3))) or m.param3 <= 0:
            return int(d.MAV_RESULT_DENIED)
        if not self.vehicle.reckons_dead or m.param2 > OLDEST_S:
            return int(d.MAV_RESULT_FAILED)
        fix = Fix(max(m.param2, 0.0), m.x / 1e7, m.y / 1e7, (m.param3, m.param3), reset=True)
        return int(d.MAV_RESULT_ACCEPTED if self.vehicle.fuse(fix) else d.MAV_RESULT_FAILED)

    def _request(self, number: float) -> int:
        """Send one message by its number."""
        d = self._d
        if number == d.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            can = d.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | d.MAV_PROTOCOL_CAPABILITY_MISSION_INT
            can |= d.MAV_PROTOCOL_CAPABILITY_COMMAND_INT | d.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
            major = (1, 16) if self.autopilot == "px4" else (4, 6)
            none = [0] * 8
            version = major[0] << 24 | major[1] << 16 | 255
            self._say(d.MAVLink_autopilot_version_message(can, version, 0, 0, 0, none, none, none, 0, 0, 1))
            return int(d.MAV_RESULT_ACCEPTED)
        name = next((name for name, (its, _) in RATES_HZ.items() if its == number), "")
        frame = self.vehicle.message(name)
        if frame is None:
            return int(d.MAV_RESULT_UNSUPPORTED)
        self.out.append(frame)
        return int(d.MAV_RESULT_ACCEPTED)

    def _time(self, m: Any) -> None:
        if m.tc1 == 0:  # a question; ours is the time since start, in nanoseconds
            self._say(self._d.MAVLink_timesync_message((self.vehicle.time_us + BOOT_US) * 1000, m.ts1))

    def _ping(self, m: Any) -> None:
        if m.target_system == 0:
            stamp = self.vehicle.time_us + BOOT_US
            self._say(self._d.MAVLink_ping_message(stamp, m.seq, m.get_srcSystem(), m.get_srcComponent()))

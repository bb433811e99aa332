"""What outputs must know of the vehicle: which autopilot it is, where its origin lies, what it answered.

The navigator does not hear of this: it changes what is sent, never what a fix is.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from terranav.core.earth import shifted
from terranav.live.mavlink_in import dialect, message_number
from terranav.live.mavlink_out import AUTOPILOT, EXTERNAL_POSITION_ESTIMATE, ONBOARD_COMPUTER, Origin
from terranav.live.records import Packet, Remark

_HEARTBEAT, _LOCAL, _GLOBAL, _ORIGIN, _ACK, _TIMESYNC = 0, 32, 33, 49, 77, 111
_WANTED = frozenset((_HEARTBEAT, _LOCAL, _GLOBAL, _ORIGIN, _ACK, _TIMESYNC))
_KINDS = {3: "ardupilot", 12: "px4"}
_NO_AUTOPILOT, _GROUND_STATION = 8, 6
_RESULTS = {1: "temporarily rejected", 2: "denied", 3: "unsupported", 4: "failed", 5: "in progress", 6: "cancelled"}
#: a local and a global position so far apart in time still tell the origin, moved by the velocity [ms]
_TOGETHER_MS = 250


def sender(frame: bytes) -> tuple[int, int]:
    """System and component of a whole MAVLink frame."""
    return (frame[3], frame[4]) if frame[0] == 0xFE else (frame[5], frame[6])


class Autopilot:
    """Listens beside the engine.

    Parameters
    ----------
    system_id : int, optional
        The vehicle; else the first whose heartbeat names an autopilot.

    Attributes
    ----------
    system : int or None
    kind : str or None
        'ardupilot', 'px4', 'other', None before the first heartbeat.
    number : int
        MAV_AUTOPILOT as it said.
    link : int or None
        The input link that its heartbeat came over last.
    origin : (lat, lon [deg], alt [m]) or None
        Of its local frame: as it told, else from a local and a global position of one time.
    answers : Counter
        Results of our resets: 'accepted', 'denied', ...
    asked_ns : list of int
        Requests for our time that have not been answered.
    """

    def __init__(self, system_id: int | None = None) -> None:
        self._decoder: Any = None
        self.system, self.number = system_id, -1
        self.kind: str | None = None
        self.link: int | None = None
        self.origin: Origin | None = None
        self.told_origin = False
        self.answers: Counter[str] = Counter()
        self.asked_ns: list[int] = []
        self._local: Any = None
        self._global: Any = None

    def hear(self, packet: Packet) -> list[Remark]:
        """Take one packet of any message; those that tell nothing here cost a look at their number."""
        frame = packet.data
        number = message_number(frame)
        if number is None or number not in _WANTED:
            return []
        if self._decoder is None:
            self._decoder = dialect().MAVLink(None)
        try:
            message = self._decoder.decode(bytearray(frame))
        except Exception:  # noqa: BLE001 - whatever pymavlink raises at damage: the engine counts it
            return []
        if number == _HEARTBEAT:
            return self._heartbeat(*sender(frame), message, packet)
        return self._take(number, sender(frame)[0], message, packet.stamp_us)

    def _take(self, number: int, system: int, message: Any, stamp_us: int) -> list[Remark]:
        """One decoded message."""
        if system != self.system:
            return []
        if number == _ACK:
            return self._answer(message, stamp_us)
        if number == _TIMESYNC and message.tc1 == 0:
            self.asked_ns = [*self.asked_ns[-3:], int(message.ts1)]
        elif number == _ORIGIN:
            return self._origin((message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3), stamp_us)
        elif number in (_LOCAL, _GLOBAL) and not self.told_origin:
            if number == _LOCAL:
                self._local = message
            else:
                self._global = message
            self._from_both()
        return []

    def _heartbeat(self, system: int, component: int, message: Any, packet: Packet) -> list[Remark]:
        """Who is there; a ground station, a camera or ourselves is no vehicle."""
        if message.autopilot == _NO_AUTOPILOT or message.type == _GROUND_STATION or component == ONBOARD_COMPUTER:
            return []
        if self.system is None:
            self.system = system
        if system != self.system or component != AUTOPILOT:
            return []
        self.link = packet.link
        if message.autopilot == self.number:
            return []
        self.number = int(message.autopilot)
        self.kind = _KINDS.get(self.number, "other")
        if self.kind != "other":
            return []
        text = f"autopilot {self.number} is neither ArduPilot nor PX4: nothing is sent to it unless --send says what"
        return [Remark(packet.stamp_us, "warning", "autopilot not known", text)]

    def _answer(self, message: Any, stamp_us: int) -> list[Remark]:
        """What became of a reset."""
        if message.command != EXTERNAL_POSITION_ESTIMATE:
            return []
        result = "accepted" if message.result == 0 else _RESULTS.get(int(message.result), f"result {message.result}")
        self.answers[result] += 1
        if result == "accepted" or self.answers[result] > 1:
            return []
        text = f"the autopilot answers {result!r} to a position reset (43003); it takes none while it uses GNSS"
        return [Remark(stamp_us, "warning", f"reset {result}", text)]

    def _origin(self, told: Origin, stamp_us: int) -> list[Remark]:
        """The autopilot says where its local frame begins."""
        if not (abs(told[0]) <= 90.0 and abs(told[1]) <= 180.0 and told[:2] != (0.0, 0.0)):
            return []
        moved = self.told_origin and told != self.origin
        self.origin, self.told_origin = told, True
        return [Remark(stamp_us, "warning", "origin moved", "the autopilot has moved its origin")] if moved else []

    def _from_both(self) -> None:
        """The origin from a local and a global position, the first brought to the time of the second."""
        local, place = self._local, self._global
        if local is None or place is None:
            return
        apart_ms = place.time_boot_ms - local.time_boot_ms
        numbers = (local.x, local.y, local.z, local.vx, local.vy, local.vz)
        if abs(apart_ms) > _TOGETHER_MS or not all(abs(number) < 1e7 for number in numbers):
            return
        later_s = apart_ms * 1e-3
        north, east, down = (at + speed * later_s for at, speed in zip(numbers[:3], numbers[3:], strict=True))
        lat, lon = shifted(place.lat * 1e-7, place.lon * 1e-7, -north, -east)
        self.origin = (lat, lon, place.alt * 1e-3 + down)

"""Is all there that live navigation needs? Listens for a while, and says of each thing ok, warning or missing.

What is said of the vehicle is taken from its messages alone; what to set is for ArduPilot and PX4 as their
documentation names it.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from terranav.core.earth import shift
from terranav.core.errors import DataError
from terranav.live.autopilot import sender
from terranav.live.ears import Ear
from terranav.live.heard import Attitude, Beat, Depth, Gnss, Heard, Position, Pressure, Range, UnixTime, Velocity, Word
from terranav.live.mavlink_in import MARKERS, MavlinkIn, dialect, message_number
from terranav.live.navigator import Navigator
from terranav.live.nmea_in import NmeaIn
from terranav.live.plan import Plan
from terranav.live.plumbing import make_wires, place
from terranav.live.recordings import opened
from terranav.live.records import Packet
from terranav.live.settings import LiveSettings
from terranav.live.signing import Checker
from terranav.maps.map import Map

LISTENS_S = 10.0
_DISTANCE_SENSOR, _DOWN = 132, 25
_AROUND_M = 5000.0
_ARDUPILOT, _PX4 = 3, 12
_NAMES = {_ARDUPILOT: "ArduPilot", _PX4: "PX4"}
_FLAT_M = 10.0
#: least rates that serve, and what sets them: words -> Hz, name, ArduPilot, PX4
_RATES: tuple[tuple[type[Word], float, str, str, str], ...] = (
    (Position, 2.0, "GLOBAL_POSITION_INT", "SRx_POSITION", "mavlink stream -s GLOBAL_POSITION_INT -r 10"),
    (Velocity, 2.0, "GLOBAL_POSITION_INT", "SRx_POSITION", "mavlink stream -s GLOBAL_POSITION_INT -r 10"),
    (Attitude, 4.0, "ATTITUDE", "SRx_EXTRA1", "mavlink stream -s ATTITUDE -r 10"),
    (Pressure, 1.0, "SCALED_PRESSURE", "SRx_RAW_SENS", "mavlink stream -s SCALED_PRESSURE -r 5"),
)


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at: `state` is 'ok', 'warning' or 'missing', `advice` what to do about it."""

    name: str
    state: str
    text: str
    advice: str = ""


@dataclass
class Notes:
    """What was heard.

    Attributes
    ----------
    words : dict
        Of each kind of word the latest, how many, and the times of the first and the last [s].
    """

    links: tuple[str, ...]
    system_id: int | None
    packets: Counter[int] = field(default_factory=Counter)
    first_us: int = 0
    last_us: int = 0
    words: dict[type, tuple[Any, int]] = field(default_factory=dict)
    vehicles: dict[int, Beat | None] = field(default_factory=dict)
    ranges: list[float | None] = field(default_factory=list)
    limits_m: tuple[float, float] | None = None
    clocks: list[tuple[float, float]] = field(default_factory=list)
    unread: int = 0
    _mavlink: MavlinkIn | None = None
    _nmea: NmeaIn | None = None

    @property
    def seconds(self) -> float:
        """From the first packet to the last [s]."""
        return (self.last_us - self.first_us) * 1e-6

    def rate_hz(self, kind: type) -> float:
        """How often such a word was heard."""
        count = self.words[kind][1] if kind in self.words else 0
        return count / self.seconds if self.seconds > 0.0 else 0.0

    def latest(self, kind: type) -> Any:
        """The latest word of a kind, None where none was heard."""
        return self.words[kind][0] if kind in self.words else None

    def hear(self, packet: Packet) -> None:
        """Take one packet."""
        if not packet.data:
            return
        self.packets[packet.link] += 1
        self.first_us = self.first_us or packet.stamp_us
        self.last_us = packet.stamp_us
        heard = self._read(packet.data)
        if heard is None:
            self.unread += 1
        elif packet.data[0] not in MARKERS or self._of_vehicle(heard, packet.data):
            self._take(heard, packet)

    def _read(self, data: bytes) -> Heard | None:
        if data[0] in MARKERS:
            self._mavlink = self._mavlink or MavlinkIn()
            return self._mavlink.heard(data)
        self._nmea = self._nmea or NmeaIn()
        return self._nmea.heard(data)

    def _of_vehicle(self, heard: Heard, frame: bytes) -> bool:
        """Whether the vehicle that is listened to sent it; the first with an autopilot is that one."""
        system, _ = sender(frame)
        beat = next((word for word in heard.words if isinstance(word, Beat)), None)
        if beat is not None or any(isinstance(word, (Position, Velocity, Attitude)) for word in heard.words):
            self.vehicles[system] = beat or self.vehicles.get(system)
        told = self.system_id if self.system_id is not None else next(iter(self.vehicles), None)
        return system == told

    def _take(self, heard: Heard, packet: Packet) -> None:
        for word in heard.words:
            _, count = self.words.get(type(word), (None, 0))
            self.words[type(word)] = word, count + 1
            if isinstance(word, Range):
                self.ranges.append(word.range_m)
        if heard.clock_s is not None:
            self.clocks.append((packet.stamp_us * 1e-6, heard.clock_s))
        if packet.data[0] in MARKERS and message_number(packet.data) == _DISTANCE_SENSOR:
            message = dialect().MAVLink(None).decode(bytearray(packet.data))
            if message.orientation == _DOWN and message.max_distance > message.min_distance:
                self.limits_m = message.min_distance / 100.0, message.max_distance / 100.0


async def listened(plan: Plan, settings: LiveSettings) -> Notes:
    """Hear what comes in for a while, or what a file holds."""
    files = [opened(address.path) for address in plan.inputs if address.wire == "file"]
    notes = Notes(plan.links(files), settings.system_id)
    for number, _, source in plan.numbered(files):
        for packet in source.packets() if source is not None else ():
            notes.hear(Packet(packet.stamp_us, number + packet.link, packet.data))
    wires = make_wires(plan)
    if wires:
        dialect()
    for number, address, source in plan.numbered(files):
        if source is None:
            check = None if plan.key is None else Checker(plan.key)
            await wires[place(address)].open(Ear(number, notes.hear, check))
    if wires:
        await asyncio.sleep(plan.stop_after_s or LISTENS_S)
    for wire in wires.values():
        await wire.close()
    return notes


async def examined(plan: Plan, settings: LiveSettings, maps: Sequence[Map]) -> list[Finding]:
    """Listen, and look at everything; the findings in the order in which to mend them.

    Raises
    ------
    ConfigError, DataError
        A link or a file that cannot be opened.
    """
    notes = await listened(plan, settings)
    return list(findings(notes, settings, maps))


def findings(notes: Notes, settings: LiveSettings, maps: Sequence[Map]) -> Iterator[Finding]:
    """What the notes say."""
    yield from _links(notes)
    yield from _vehicle(notes, settings)
    yield from _rates(notes)
    yield from _sensors(notes)
    yield from _time(notes)
    yield from _maps(notes, settings, maps)


def _links(notes: Notes) -> Iterator[Finding]:
    for number, name in enumerate(notes.links):
        count = notes.packets[number]
        if not count:
            yield Finding(
                f"link {number}", "missing", f"{name}: nothing was heard", "is the vehicle on, the port right?"
            )
        else:
            rate = count / notes.seconds if notes.seconds > 0.0 else float(count)
            yield Finding(f"link {number}", "ok", f"{name}: {count} messages, {rate:.0f} a second")
    if notes.unread:
        yield Finding("messages", "warning", f"{notes.unread} are damaged", "is the speed of the serial port right?")


def _vehicle(notes: Notes, settings: LiveSettings) -> Iterator[Finding]:
    if not notes.vehicles:
        if notes.packets and Position not in notes.words:
            yield Finding("vehicle", "missing", "no vehicle speaks", "connect the autopilot's telemetry port")
        return
    system = settings.system_id if settings.system_id is not None else next(iter(notes.vehicles))
    beat = notes.vehicles.get(system)
    others = [str(number) for number in notes.vehicles if number != system]
    name = _NAMES.get(beat.autopilot) if beat is not None else None
    if system not in notes.vehicles:
        yield Finding("vehicle", "missing", f"system {system} does not speak, {', '.join(others)} does", "--system")
    elif beat is None:
        yield Finding("autopilot", "warning", f"system {system} sends no heartbeat", "nothing can be sent to it")
    elif name is None:
        yield Finding("autopilot", "warning", f"number {beat.autopilot} is not known", "say what to send: --send")
    else:
        yield Finding("autopilot", "ok", f"{name}, system {system}")
    if others and settings.system_id is None and system in notes.vehicles:
        yield Finding("vehicle", "warning", f"systems {', '.join(others)} speak too", f"--system {system}")


def _setting(notes: Notes, ardupilot: str, px4: str) -> str:
    """What to set, for the autopilot that is there."""
    kinds = {beat.autopilot for beat in notes.vehicles.values() if beat is not None}
    return ardupilot if kinds == {_ARDUPILOT} else px4 if kinds == {_PX4} else f"{ardupilot} or {px4}"


def _rates(notes: Notes) -> Iterator[Finding]:
    for kind, least_hz, message, ardupilot, px4 in _RATES:
        name, rate = kind.__name__.lower(), notes.rate_hz(kind)
        advice = _setting(notes, f"{ardupilot} 10", px4) if notes.vehicles else f"send it more often: {message}"
        if kind not in notes.words:
            state = "missing" if kind is not Pressure else "warning"
            yield Finding(name, state, f"no {message} was heard", advice)
        elif rate < least_hz:
            yield Finding(name, "warning", f"{rate:.1f} Hz, expected {least_hz:g} or more", advice)
        else:
            yield Finding(name, "ok", f"{rate:.1f} Hz")


def _sensors(notes: Notes) -> Iterator[Finding]:
    if Depth in notes.words:
        yield Finding("depth", "ok", f"{notes.rate_hz(Depth):.1f} Hz, now {notes.latest(Depth).depth_m:.1f} m")
    elif not notes.ranges:
        advice = _setting(notes, "RNGFND1_TYPE, RNGFND1_ORIENT 25, SRx_EXTRA3 10", "mavlink stream -s DISTANCE_SENSOR")
        yield Finding("altimeter", "missing", "no DISTANCE_SENSOR looks down", advice)
    else:
        yield _altimeter(notes)
    gnss = notes.latest(Gnss)
    if gnss is not None:
        told = "has a fix" if gnss.fix >= 3 else "has no fix"
        yield Finding("GNSS", "ok", f"{told}; it is not used to navigate")


def _altimeter(notes: Notes) -> Finding:
    """How often it measures, and whether it reaches the ground."""
    good = [one for one in notes.ranges if one is not None]
    share = len(good) / len(notes.ranges)
    rate = len(notes.ranges) / notes.seconds if notes.seconds > 0.0 else 0.0
    limits = f", measures {notes.limits_m[0]:g} to {notes.limits_m[1]:g} m" if notes.limits_m else ""
    now = f", now {good[-1]:.1f} m above ground" if good else ""
    text = f"{rate:.1f} Hz, {share:.0%} in range{limits}{now}"
    if not good:
        return Finding("altimeter", "missing", text, "it does not reach the ground: fly lower, or fit one that does")
    if share < 0.8:
        return Finding("altimeter", "warning", text, "it does not always reach the ground: fly lower")
    if notes.limits_m and good[-1] > 0.8 * notes.limits_m[1]:
        return Finding("altimeter", "warning", text, "little is left to its limit: do not climb")
    if rate < 1.0:
        return Finding("altimeter", "warning", text, _setting(notes, "SRx_EXTRA3 10", "DISTANCE_SENSOR at 10 Hz"))
    return Finding("altimeter", "ok", text)


def _time(notes: Notes) -> Iterator[Finding]:
    if len(notes.clocks) > 1:
        (host0, own0), (host1, own1) = notes.clocks[0], notes.clocks[-1]
        run = (own1 - own0) / (host1 - host0) if host1 - host0 > 1.0 else 1.0
        fast = f"the vehicle's clock runs {run:.3f} times as fast as this computer's"
        if abs(run - 1.0) > 0.05:
            yield Finding("clock", "warning", fast, "is it a simulation that does not run at real time?")
        else:
            yield Finding("clock", "ok", fast)
    unix = notes.latest(UnixTime)
    if unix is not None:
        apart_s = unix.unix_us * 1e-6 - notes.last_us * 1e-6
        if abs(apart_s) > 2.0:
            text = f"the vehicle's date is {apart_s:+.1f} s off this computer's"
            yield Finding("date", "warning", text, "set this computer's clock; navigation does not depend on it")


def _maps(notes: Notes, settings: LiveSettings, maps: Sequence[Map]) -> Iterator[Finding]:
    if not maps:
        yield Finding("map", "missing", "none is given", "--map DEM")
        return
    try:
        doubt = Navigator(settings, maps).doubt
        state, text = ("warning", doubt) if doubt else ("ok", f"altitudes count from {settings.alt_datum}")
        yield Finding("datum", state, text, "the navigator estimates a constant offset" if doubt else "")
    except DataError as problem:
        yield Finding("datum", "missing", str(problem), "--map-datum, --geoid")
    at = notes.latest(Position)
    for chart in maps:
        if at is None:
            yield Finding("map cover", "warning", f"{chart.name}: the vehicle says no position", "see position")
        else:
            yield _cover(chart, at, notes)


def _cover(chart: Map, at: Position, notes: Notes) -> Finding:
    """Whether a map says something here and around, and enough to navigate by."""
    here = float(chart.sample(at.lat_deg, at.lon_deg))
    if not math.isfinite(here):
        where = f"{at.lat_deg:.4f} N, {at.lon_deg:.4f} E"
        south, west, north, east = chart.bounds_deg
        text = (
            f"{chart.name} says nothing at {where}; it reaches from {south:.3f}, {west:.3f} to {north:.3f}, {east:.3f}"
        )
        return Finding("map cover", "missing", text, "give the map of this place")
    steps = np.linspace(-_AROUND_M, _AROUND_M, 41)
    lat, lon = shift(at.lat_deg, at.lon_deg, steps[:, None], steps[None, :])
    around = chart.sample(lat, lon)
    known = np.isfinite(around)
    rough = float(np.nanstd(around))
    text = f"{chart.name}: {known.mean():.0%} known within {_AROUND_M / 1000:g} km, heights vary by {rough:.0f} m"
    good = [one for one in notes.ranges if one is not None]
    if good and at.alt_m is not None and chart.kind == "terrain":
        text += f"; the reading is {at.alt_m - good[-1] - here:+.0f} m off the map at the position told"
    if known.mean() < 0.9:
        return Finding("map cover", "warning", text, "the map ends near, or has voids")
    if rough < _FLAT_M:
        return Finding("map cover", "warning", text, "flat land: a fix will take long, or not come")
    return Finding("map cover", "ok", text)

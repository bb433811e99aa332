"""Who speaks, and when: vehicles, their clocks, lost and doubled messages, silent links. Words get their time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from terranav.live.book import Book
from terranav.live.clock import LATE_S, SenderClock
from terranav.live.heard import Attitude, Beat, Gnss, Heard, Position, UnixTime, Velocity, Word
from terranav.live.records import Packet

GROUND_STATIONS = 250
AUTOPILOTS = {3: "ArduPilot", 12: "PX4"}
_RECENT = 200  # frames among which a double is looked for: after 256 a message without a time is the same again
_MOST_SENDERS, _MOST_NAMES, _MOST_LINKS = 64, 100, 64
_HOST_STEP_S, _PAUSE_S = 120.0, 1.0
_STANDS_S = 3.0


@dataclass(slots=True)
class Rate:
    """How many, and how many a second of late."""

    count: int = 0
    last_s: float = math.nan
    gap_s: float = math.nan

    def heard(self, now_s: float) -> None:
        """One more."""
        self.count += 1
        gap = now_s - self.last_s
        if math.isfinite(gap):
            self.gap_s = gap if math.isnan(self.gap_s) else self.gap_s + 0.05 * (gap - self.gap_s)
        self.last_s = now_s

    def hz(self, now_s: float) -> float:
        """Messages a second, falling once they stay away."""
        gap = max(self.gap_s, now_s - self.last_s) if math.isfinite(self.gap_s) else math.nan
        return 1.0 / gap if gap > 0.0 else 0.0


@dataclass(slots=True)
class Listening:
    """Hears packets and messages. All of it is plain data that pickles.

    Attributes
    ----------
    system_id : int or None
        The vehicle to hear.
    silent_s : float
    clock : SenderClock
        Of the vehicle; the time of everything.
    vehicle : (int, int) or None
        System and component that are heard.
    autopilot, vehicle_type : int or None
    gnss : (time, Gnss) or None
        The receiver's latest word.
    utc_offset_us : int or None
        UTC as the vehicle knows it less the time [us].
    lost, doubled, impossible : int
        Messages; fields that cannot be.
    """

    system_id: int | None
    silent_s: float
    clock: SenderClock = field(default_factory=SenderClock)
    vehicle: tuple[int, int] | None = None
    autopilot: int | None = None
    vehicle_type: int | None = None
    gnss: tuple[float, Gnss] | None = None
    utc_offset_us: int | None = None
    lost: int = 0
    doubled: int = 0
    impossible: int = 0
    links: dict[int, Rate] = field(default_factory=dict)
    names: dict[str, Rate] = field(default_factory=dict)
    dead: set[int] = field(default_factory=set)
    restarted: bool = False
    _now_s: float = 0.0
    _stands: tuple[float, float] = (-1.0, 0.0)  # the vehicle's clock, and since when it says that
    _stamp_us: int = 0
    _recent: dict[bytes, None] = field(default_factory=dict)
    _sequences: dict[tuple[int, int], int] = field(default_factory=dict)
    _others: dict[tuple[int, int], SenderClock] = field(default_factory=dict)

    @property
    def speaks_mavlink(self) -> bool:
        """Whether the clock is a MAVLink vehicle's."""
        return self.vehicle is not None

    def arrives(self, packet: Packet, book: Book) -> bool:
        """Hear that a packet came in; whether it is worth reading. An empty one says that time passes."""
        passed = (packet.stamp_us - self._stamp_us) * 1e-6 if self._stamp_us else 0.0
        self._stamp_us = packet.stamp_us
        self._now_s += passed if 0.0 <= passed <= _HOST_STEP_S else (_PAUSE_S if passed > 0.0 else 0.0)
        book.stamp_us, book.now_s = packet.stamp_us, self._now_s
        self._watch_links(packet, book)
        if not packet.data:
            return False
        if packet.data[0] in b"\xfd\xfe":
            if packet.data in self._recent:
                self.doubled += 1
                return False
            self._recent[packet.data] = None
            if len(self._recent) > _RECENT:
                self._recent.pop(next(iter(self._recent)))
        return True

    def _watch_links(self, packet: Packet, book: Book) -> None:
        """Silent links, and those that are back."""
        for number, rate in self.links.items():
            away = self._now_s - rate.last_s
            if number not in self.dead and away > self.silent_s:
                self.dead.add(number)
                book.begins("warning", f"link {number} silent", f"link {number} has been silent for {away:.1f} s")
            if number == packet.link and packet.data and number in self.dead:
                self.dead.discard(number)
                text = f"link {number} is back after {away:.1f} s"
                book.ends(f"link {number} silent", text)
        if packet.data and (packet.link in self.links or len(self.links) < _MOST_LINKS):
            self.links.setdefault(packet.link, Rate()).heard(self._now_s)

    def words(self, heard: Heard, packet: Packet, book: Book) -> list[tuple[float, Word]]:
        """The words of a message with their times; none where it is another's, or of no time."""
        self._count(heard)
        self.impossible += len(heard.rejected)
        for text in heard.rejected:
            book.begins("warning", "impossible value", f"{text}; such fields are left out", lasting=False)
        mavlink = heard.sequence is not None
        if mavlink and not self._known(heard, book):
            return []
        time_s = self._time_of(heard, packet, book) if mavlink else self._nmea_time(packet, book)
        if time_s is None:
            return []
        words: list[tuple[float, Word]] = []
        for word in heard.words:
            if isinstance(word, Gnss):
                self.gnss = time_s, word
            elif isinstance(word, UnixTime):
                self.utc_offset_us = word.unix_us - round(time_s * 1e6)
            elif not isinstance(word, Beat):
                words.append((time_s, word))
        return words

    def _count(self, heard: Heard) -> None:
        """Rates by message, and losses by the sender's counter."""
        name = heard.name if heard.name in self.names or len(self.names) < _MOST_NAMES else "other"
        self.names.setdefault(name, Rate()).heard(self._now_s)
        if heard.sequence is None:
            return
        before = self._sequences.get(heard.sender)
        if before is None and len(self._sequences) >= _MOST_SENDERS:
            return
        ahead = 1 if before is None else (heard.sequence - before) & 0xFF
        if 0 < ahead < 128:
            self.lost += ahead - 1
            self._sequences[heard.sender] = heard.sequence
        elif ahead:
            self.lost = max(self.lost - 1, 0)  # it was counted when it was overtaken

    def _known(self, heard: Heard, book: Book) -> bool:
        """Whether the vehicle speaks; the first that does is the one, unless the user told which."""
        system, component = heard.sender
        told = self.system_id
        beat = next((word for word in heard.words if isinstance(word, Beat)), None)
        leads = beat is not None or any(isinstance(word, (Position, Velocity, Attitude)) for word in heard.words)
        if self.vehicle is None:
            # a camera's mount tells an attitude too, and is no vehicle
            speaks = beat is not None or any(isinstance(word, Position) for word in heard.words)
            if not speaks or system >= GROUND_STATIONS or (told is not None and system != told):
                return False
            self.vehicle = system, component
            book.say("info", "vehicle", f"hears vehicle {system}, component {component}")
        if system != self.vehicle[0]:
            if leads and system < GROUND_STATIONS:
                text = f"vehicle {system} speaks too and is not heard: {self.vehicle[0]} is"
                book.begins("warning", f"vehicle {system}", text)
            return False
        if (
            beat is not None
            and component == self.vehicle[1]
            and (beat.autopilot, beat.type)
            != (
                self.autopilot,
                self.vehicle_type,
            )
        ):
            self.autopilot, self.vehicle_type = beat.autopilot, beat.type
            book.say(
                "info", "autopilot", f"its autopilot is {AUTOPILOTS.get(beat.autopilot, f'of kind {beat.autopilot}')}"
            )
        return component == self.vehicle[1] or not leads

    def _time_of(self, heard: Heard, packet: Packet, book: Book) -> float | None:
        """The time of a MAVLink message: by its own clock, else by when it came in."""
        host_s = packet.stamp_us * 1e-6
        if heard.clock_s is None or not heard.steady:
            if not self.clock.running:
                return None
            time_s = heard.clock_s + self.clock.shift_s if heard.clock_s is not None else math.nan
            near = -LATE_S <= time_s - self.clock.newest_s <= 1.0
            return time_s if near else self.clock.time_of(host_s)
        if heard.sender == self.vehicle:
            return self._ticked(self.clock, heard.clock_s, host_s, book)
        if not self.clock.running:
            return None
        if heard.sender not in self._others and len(self._others) >= _MOST_SENDERS:
            return None
        other = self._others.setdefault(heard.sender, SenderClock())
        tick = other.tick(heard.clock_s, host_s)
        return None if tick.time_s is None else self.clock.time_of(other.host_us(tick.time_s) * 1e-6)

    def _nmea_time(self, packet: Packet, book: Book) -> float | None:
        """The time of a sentence is when it came in: most have none, and those that do stop with the receiver."""
        host_s = packet.stamp_us * 1e-6
        if self.speaks_mavlink:
            return self.clock.time_of(host_s) if self.clock.running else None
        return self._ticked(self.clock, self._now_s, host_s, book)

    def _ticked(self, clock: SenderClock, clock_s: float, host_s: float, book: Book) -> float | None:
        """Tick the vehicle's clock and remark on what it does."""
        if clock_s == self._stands[0]:
            if self._now_s - self._stands[1] > _STANDS_S:
                text = f"the vehicle's clock stands still at {clock_s:.3f} s, so that nothing it says has a time"
                book.begins("error", "clock stands still", text, lasting=False)
        else:
            self._stands = clock_s, self._now_s
        tick = clock.tick(clock_s, host_s)
        if tick.event == "host step":
            text = f"this computer's clock was set by {tick.amount_s:+.1f} s; time goes on as before"
            book.begins("warning", "clock step", text, lasting=False)
        elif tick.event:
            self.restarted = True
            text = f"the vehicle's clock leapt by {tick.amount_s:+.1f} s: it started again; so does what is measured"
            book.begins("warning", "vehicle restarted", text, lasting=False)
        return tick.time_s

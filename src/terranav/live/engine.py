"""The live engine: packets in, fixes and remarks out, as a function of the packets alone.

It has no clock, no socket, no file and no randomness but its seeded generator, so that what was recorded replays to the
same bits, and a checkpoint goes on as if nothing had happened. An empty packet says that time passes: whoever feeds the
engine sends one a second while the links are silent, and records it like any other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from terranav.core.errors import ConfigError
from terranav.core.records import Epoch, Estimate
from terranav.live.ahead import map_ends_s
from terranav.live.assembly import Assembly
from terranav.live.book import Book
from terranav.live.checkpoint import packed, unpacked
from terranav.live.heard import Gnss, Heard
from terranav.live.listening import AUTOPILOTS, Listening
from terranav.live.mavlink_in import MARKERS, MavlinkIn
from terranav.live.navigator import Memory, Navigator
from terranav.live.nmea_in import NmeaIn
from terranav.live.records import Fix, Packet, Remark
from terranav.live.settings import LiveSettings
from terranav.live.track import Break
from terranav.live.watching import Watching
from terranav.maps.map import Map

_PATIENCE_S = 10.0  # before it is said what is missing
NAVIGATOR_FAULT = "navigator fault"
_FAULT_SPREAD_M = 100.0  # added to the error of a navigator that failed, whatever it failed of
_LOOK_EVERY_S = 1.0  # ahead, for the end of the map
_WORST_SIGMA_M = 1e7


@dataclass(slots=True)
class _State:
    """All that an engine remembers."""

    listening: Listening
    assembly: Assembly
    memory: Memory
    book: Book = field(default_factory=Book)
    packets: int = 0
    alien: int = 0
    damaged: int = 0
    rejected: dict[str, int] = field(default_factory=dict)  # what was refused -> how many times
    fixes: int = 0
    usable: int = 0
    offered: bool = False
    looked_s: float = -math.inf
    fix: Fix | None = None
    watching: Watching | None = None


class Engine:
    """Hears a vehicle and says where it is.

    Parameters
    ----------
    settings : LiveSettings
    maps : sequence of Map
        At least one of terrain or bathymetry, one a kind.

    Raises
    ------
    ConfigError, DataError
        Settings and maps that do not go together; a library that is not installed.
    """

    def __init__(self, settings: LiveSettings, maps: Sequence[Map]) -> None:
        self.settings = settings
        self._navigator = Navigator(settings, maps)
        self._mavlink: MavlinkIn | None = None
        self._nmea: NmeaIn | None = None
        self._digest = settings.digest(self._navigator.maps)
        listening = Listening(settings.system_id, settings.silent_s)
        self._state = _State(listening, Assembly(settings), self._navigator.memory)
        self._state.watching = Watching.of(settings.grade) if settings.monitor else None

    def feed(self, packet: Packet) -> list[Fix | Remark]:
        """Hear one packet; what there is to say because of it, in order.

        Parameters
        ----------
        packet : Packet
            Stamps may step; packets of a recording must come in the order in which they came in.
        """
        state = self._state
        state.packets += 1
        wanted = state.listening.arrives(packet, state.book)
        if state.packets == 1:
            self._introduce()
        if wanted:
            heard = self._heard(packet.data)
            if heard is not None:
                self._hear(heard, packet)
        made = [self._fix(epoch) for epoch in state.assembly.epochs(state.listening.clock.newest_s)]
        self._watch_sensors()
        self._watch_start()
        state.book.settle()
        return [*state.book.taken(), *(fix for fix in made if fix is not None)]

    def _introduce(self) -> None:
        """Say what is to be known from the start."""
        state = self._state
        if self._navigator.doubt:
            state.book.say("warning", "vertical datum", self._navigator.doubt)
        if state.watching is not None:
            state.watching.introduce(self.settings, state.book)

    def _heard(self, data: bytes) -> Heard | None:
        """What a message says, by its first byte."""
        state = self._state
        if data[0] in MARKERS:
            self._mavlink = self._mavlink or MavlinkIn()
            heard = self._mavlink.heard(data)
        elif data[:1] in (b"$", b"!"):
            self._nmea = self._nmea or NmeaIn()
            heard = self._nmea.heard(data)
        else:
            state.alien += 1
            state.book.begins("warning", "not understood", "bytes that are no message came in", lasting=False)
            return None
        if heard is None:
            state.damaged += 1
            state.book.begins("warning", "damaged message", "damaged messages come in and are left out", lasting=False)
        return heard

    def _hear(self, heard: Heard, packet: Packet) -> None:
        """Hand the words on, and follow what they break."""
        state = self._state
        listening, assembly, book = state.listening, state.assembly, state.book
        words = listening.words(heard, packet, book)
        if listening.restarted:
            listening.restarted = False
            assembly.restart_clock()
        for time_s, word in words:
            begun = assembly.started
            assembly.hear(time_s, word)
            if assembly.broken is not None:
                self._break()
            if assembly.started and not begun:
                node = assembly.track.nodes[-1]
                text = f"reckons by {self.settings.ins_source} from {node.lat_deg:.5f} N, {node.lon_deg:.5f} E"
                book.say("info", "start", text)
        for key, text in assembly.notes:
            state.rejected[key] = state.rejected.get(key, 0) + 1
            book.begins("warning", key, text, lasting=False)
        assembly.notes.clear()

    def _watch_sensors(self) -> None:
        """Sensors that were heard and are silent, and those that are back."""
        state, newest = self._state, self._state.listening.clock.newest_s
        for sensor, last_s in state.assembly.heard_s.items():
            key = f"{sensor} silent"
            if newest - last_s > self.settings.silent_s:
                text = f"{sensor}: nothing that can be used for {newest - last_s:.1f} s"
                state.book.begins("warning", key, text)
            elif key in state.book.standing:
                state.book.ends(key, f"{sensor}: readings are back")

    def _watch_start(self) -> None:
        """Say what is missing when nothing begins."""
        state = self._state
        book, assembly = state.book, state.assembly
        if assembly.started:
            book.ends("no start", "reckoning has a start")
        elif state.listening.clock.running and book.now_s > _PATIENCE_S:
            missing = assembly.missing()
            book.begins("warning", "no start", f"reckoning by {self.settings.ins_source} waits for {missing}")

    def _break(self) -> None:
        """Reckoning broke: start the navigator anew from where it was last known to be."""
        state = self._state
        broken, state.assembly.broken = state.assembly.broken, None
        if broken is None:
            return
        self._restart(broken)
        text = (
            f"reckoning broke for {broken.gap_s:.1f} s: up to {broken.spread_m:.0f} m per axis are added to its error"
        )
        state.book.begins("warning", "reckoning broke", text, lasting=False)

    def _restart(self, broken: Break) -> None:
        """Start the navigator anew, and with it what is known of the reckoning."""
        state = self._state
        self._navigator.restart(state.assembly.track, broken)
        if state.watching is not None:
            state.watching.restart(state.memory.prior)

    def _fix(self, epoch: Epoch) -> Fix | None:
        """Step the navigator, and what is said of it; None where it failed, which must not end a flight."""
        state = self._state
        try:
            estimate = self._navigator.step(epoch)
        except (ArithmeticError, IndexError, ValueError, np.linalg.LinAlgError) as problem:
            text = f"the navigator failed and starts anew: {type(problem).__name__}: {' '.join(str(problem).split())}"
            state.book.begins("error", NAVIGATOR_FAULT, text, lasting=False)
            self._restart(Break(0.0, _FAULT_SPREAD_M))
            return None
        epoch = self._navigator.memory.epoch or epoch
        fix = self._watched(epoch, self._made(epoch, estimate))
        state.fix = fix
        state.fixes += 1
        state.usable += fix.usable
        if fix.usable != state.offered:
            state.offered = fix.usable
            if fix.usable:
                sigma = max(fix.sigma_m)
                text = f"fix usable: 1-sigma {sigma:.0f} m, protection level {estimate.protection_m:.0f} m"
                state.book.say("info", "fix usable", text)
            else:
                state.book.say("warning", "fix withheld", f"fix withheld: {'; '.join(fix.withheld)}")
        if self.settings.warn_ahead_s and epoch.time_s - state.looked_s >= _LOOK_EVERY_S:
            state.looked_s = epoch.time_s
            self._look_ahead(fix)
        return fix

    def _made(self, epoch: Epoch, estimate: Estimate) -> Fix:
        """The fix of an estimate; usable only when all of it is finite."""
        clock = self._state.listening.clock
        sigma = np.sqrt(np.diag(estimate.cov_m2))
        place = (estimate.lat_deg, estimate.lon_deg, estimate.alt_m)
        numbers = [*place, *sigma.tolist(), *(epoch.velocity_mps or ()), *(epoch.attitude_deg or ())]
        sound = all(map(math.isfinite, numbers)) and bool((sigma > 0.0).all())
        floor = self.settings.sigma_floor_m
        north, east = (
            min(max(float(one), floor), _WORST_SIGMA_M) if math.isfinite(one) else _WORST_SIGMA_M for one in sigma
        )
        reasons = () if estimate.usable else estimate.reasons or (f"the estimate is {estimate.status}",)
        if not sound:
            reasons = (*reasons, "the estimate is not finite")
        boot = clock.boot_us(epoch.time_s) if self._state.listening.speaks_mavlink else None
        return Fix(
            clock.host_us(epoch.time_s),
            boot,
            *place,
            (north, east),
            epoch.velocity_mps,
            epoch.attitude_deg,
            estimate,
            estimate.usable and sound,
            reasons,
        )

    def _watched(self, epoch: Epoch, fix: Fix) -> Fix:
        """The fix with what is said of GNSS, where that is watched."""
        state = self._state
        if state.watching is None:
            return fix
        return replace(fix, gnss=state.watching.step(epoch, fix.estimate, state.listening.gnss, state.book))

    def _look_ahead(self, fix: Fix) -> None:
        """Warn where the map ends ahead, in time."""
        if fix.velocity_mps is None or not math.isfinite(fix.lat_deg + fix.lon_deg):
            return
        within = self.settings.warn_ahead_s
        ends_s = map_ends_s(self._navigator.answering, (fix.lat_deg, fix.lon_deg), fix.velocity_mps[:2], within)
        book = self._state.book
        if ends_s == 0.0:
            book.ends("map ends ahead", "the map has ended")
            book.begins("warning", "off map", "no map says anything here")
            return
        book.ends("off map", "a map says something here again")
        if math.isfinite(ends_s):
            away = math.hypot(*fix.velocity_mps[:2]) * ends_s
            text = f"the map ends, or has a void, in {ends_s:.0f} s ({away / 1000.0:.1f} km ahead)"
            book.begins("warning", "map ends ahead", text)
        else:
            book.ends("map ends ahead", f"the map goes on for the next {within:.0f} s")

    @property
    def epoch(self) -> Epoch | None:
        """The latest epoch that the navigator saw: indicated position, readings made ready."""
        return self._navigator.memory.epoch

    @property
    def gnss(self) -> tuple[float, Gnss] | None:
        """The latest word of a GNSS receiver and its time [s], which the navigator never sees."""
        return self._state.listening.gnss

    @property
    def facts(self) -> dict[str, Any]:
        """Counters for status pages; plain JSON."""
        state = self._state
        return facts_of(state, self.settings)

    def checkpoint(self) -> bytes:
        """All that the engine remembers, for `resumed`."""
        return packed(self._state, self._digest, self.settings)

    @classmethod
    def resumed(cls, settings: LiveSettings, maps: Sequence[Map], data: bytes) -> Engine:
        """An engine that goes on from a checkpoint with the same bits.

        Raises
        ------
        ConfigError
            Settings or maps differ from those of the checkpoint.
        DataError
            It is damaged, or no checkpoint.
        """
        engine = cls(settings, maps)
        state = unpacked(data, engine._digest, settings)
        if not isinstance(state, _State):
            raise ConfigError("checkpoint holds something else, expected the state of a live engine")
        engine._state = state
        engine._navigator.memory = state.memory
        return engine


def facts_of(state: _State, settings: LiveSettings) -> dict[str, Any]:
    """The counters of an engine."""
    listening, assembly, fix = state.listening, state.assembly, state.fix
    now, newest = state.book.now_s, listening.clock.newest_s
    receiver = listening.gnss
    return {
        "packets": state.packets,
        "links": {
            str(number): {"packets": rate.count, "rate_hz": rate.hz(now), "silent": number in listening.dead}
            for number, rate in listening.links.items()
        },
        "messages": {
            name: {"count": rate.count, "rate_hz": rate.hz(now)} for name, rate in sorted(listening.names.items())
        },
        "lost": listening.lost,
        "duplicates": listening.doubled,
        "damaged": state.damaged,
        "not_understood": state.alien,
        "rejected": {"impossible value": listening.impossible, **state.rejected},
        "readings": {**assembly.counts, "spared": state.memory.spared, "odd": state.memory.odd},
        "fixes": state.fixes,
        "usable": state.usable,
        "usable_share": state.usable / state.fixes if state.fixes else 0.0,
        "status": str(fix.estimate.status) if fix is not None else "",
        "withheld": list(fix.withheld) if fix is not None else [],
        "age_s": newest - fix.estimate.time_s if fix is not None else None,
        "starts": state.memory.starts,
        "ins_source": settings.ins_source,
        "system_id": listening.vehicle[0] if listening.vehicle else None,
        "component_id": listening.vehicle[1] if listening.vehicle else None,
        "autopilot": AUTOPILOTS.get(listening.autopilot, "other") if listening.autopilot is not None else None,
        "utc_us": None if listening.utc_offset_us is None else listening.utc_offset_us + round(newest * 1e6),
        "gnss": None if receiver is None else {"fix": receiver[1].fix, "age_s": newest - receiver[0]},
        "monitor": None if state.watching is None else state.watching.facts(),
        "remarks": sorted(state.book.standing),
    }

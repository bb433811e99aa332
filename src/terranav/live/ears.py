"""From the bytes of a link to packets with a stamp: whole messages, signed ones alone where there is a key."""

from __future__ import annotations

import re
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

from terranav.live.deframing import Deframer, LineDeframer
from terranav.live.records import Packet
from terranav.live.signing import Checker

_MOST_PEERS = 16
_SENTENCE = re.compile(rb"[$!][A-Z]{1,2}[A-Z0-9]{2,3}[A-Z],[\x20-\x7e]*", re.ASCII)


#: the host's clock when the program began, by the clock that people set and by the one that nobody sets [ns]
_BEGAN_NS = (time.time_ns(), time.monotonic_ns())


def host_us() -> int:
    """The host's clock when the program began, and what has passed since [us since 1970].

    So a clock that is set while the program runs, by NTP or by hand, moves no stamp.
    """
    set_ns, steady_ns = _BEGAN_NS
    return (set_ns + time.monotonic_ns() - steady_ns) // 1000


@dataclass
class _Peer:
    """One sender on a link; what it first says whole tells what it speaks."""

    frames: Deframer | None = field(default_factory=Deframer)
    lines: LineDeframer | None = field(default_factory=LineDeframer)

    def feed(self, data: bytes) -> list[bytes]:
        """The messages that these bytes complete."""
        found = self.frames.feed(data) if self.frames is not None else []
        if found:
            self.lines = None
            return found
        told = [line for line in self.lines.feed(data) if _SENTENCE.fullmatch(line)] if self.lines is not None else []
        if told:
            self.frames = None
        return told


class Ear:
    """Makes packets of what one link hears.

    Parameters
    ----------
    link : int
    on_packet : callable
        Takes each packet.
    check : Checker, optional
        Only frames that it lets pass are heard, and no NMEA, which cannot be signed.

    Attributes
    ----------
    refused : int
        Messages that were not signed as they should be.
    """

    def __init__(self, link: int, on_packet: Callable[[Packet], None], check: Checker | None = None) -> None:
        self._link, self._on_packet, self._check = link, on_packet, check
        self._peers: OrderedDict[Hashable, _Peer] = OrderedDict()
        self.refused = 0

    def __call__(self, data: bytes, peer: Hashable) -> bool:
        """Hear bytes of one peer; whether they completed a message that may be heard."""
        stamp_us = host_us()
        if peer not in self._peers and len(self._peers) >= _MOST_PEERS:
            self._peers.popitem(last=False)
        known = self._peers.setdefault(peer, _Peer())
        self._peers.move_to_end(peer)
        heard = False
        for message in known.feed(data):
            if self._check is not None and not self._check(message):
                self.refused += 1
                continue
            heard = True
            self._on_packet(Packet(stamp_us, self._link, message))
        return heard

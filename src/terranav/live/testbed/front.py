"""Sockets around a flight, and the pace at which it is flown."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Hashable, Sequence
from typing import BinaryIO

from terranav.core.errors import ConfigError
from terranav.live.links import Address, outputs
from terranav.live.testbed.flight import Flight, Sent
from terranav.live.testbed.records import Tlog
from terranav.live.testbed.senses import RATE_HZ
from terranav.live.wires import Wire, wire

_WIRES = ("udpin", "udpout", "tcp", "tcpin", "serial")
_ANSWER_S = 0.02  # longest time until a question is answered
_BEHIND_S = 1.0  # lost time that is not made up for


def addresses(texts: Sequence[str]) -> tuple[Address, ...]:
    """Read the links that the vehicle speaks on; ConfigError for one that carries no MAVLink."""
    found = outputs(texts)
    for address in found:
        if address.speaks != "mavlink" or address.wire not in _WIRES:
            raise ConfigError(
                f"--out {address.text}: expected udpout, udpin, tcp, tcpin or serial, to speak MAVLink on"
            )
    return found


class Front:
    """Flies in real time, or faster, with the vehicle's messages on links.

    Parameters
    ----------
    flight : Flight
    links : sequence of Address
    speed : float
        Times real time; 0 is as fast as it goes.
    tlog : binary file, optional
        All that is sent, as a telemetry log.
    """

    def __init__(
        self, flight: Flight, links: Sequence[Address], *, speed: float = 1.0, tlog: BinaryIO | None = None
    ) -> None:
        self.flight, self.speed = flight, speed
        self.wires: list[Wire] = [wire(address) for address in links]
        self._log = None if tlog is None else Tlog(tlog)

    async def run(self, status: Callable[[], None] | None = None, *, wait: bool = False) -> None:
        """Fly to the end.

        Parameters
        ----------
        status : callable, optional
            Called after every tick.
        wait : bool
            Start when somebody is there on every link: a connection of tcpin, a datagram for udpin.

        Raises
        ------
        ConfigError
            A link cannot be opened.
        """
        try:
            for number, each in enumerate(self.wires):
                await each.open(self._hears(number))
            while wait and not all(each.connected for each in self.wires):
                await asyncio.sleep(_ANSWER_S)
            await self._fly(status)
            await asyncio.sleep(_ANSWER_S)  # what was written last gets out
        finally:
            for each in self.wires:
                await each.close()

    def _hears(self, number: int) -> Callable[[bytes, Hashable], None]:
        """Hands on what comes in on one of the links."""
        return lambda data, peer: self.flight.take(data, (number, peer))

    async def _fly(self, status: Callable[[], None] | None) -> None:
        """Tick by tick, each when it is due."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while not self.flight.over:
            self._send(self.flight.tick())
            if status is not None:
                status()
            if self.speed <= 0.0:
                await asyncio.sleep(0)
                continue
            due = max(due + 1.0 / (RATE_HZ * self.speed), loop.time() - _BEHIND_S)
            while (left := due - loop.time()) > 0.0:
                await asyncio.sleep(min(left, _ANSWER_S))
                self._send(self.flight.answers())
            await asyncio.sleep(0)

    def _send(self, frames: Sequence[Sent]) -> None:
        """Write to all links and to the log; who is not there misses it."""
        for stamp, frame in frames:
            for each in self.wires:
                with contextlib.suppress(OSError):
                    each.write(frame)
            if self._log is not None:
                self._log.add(stamp, frame)

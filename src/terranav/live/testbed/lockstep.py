"""The test bed and the live engine in lock-step: no socket, no clock, as fast as it goes, the same bits always.

What the vehicle sends is fed to an engine, and its fixes go back through the very gate, pace and encoder that
`terranav live` sends them with.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence

from terranav.live.autopilot import Autopilot
from terranav.live.engine import Engine
from terranav.live.links import Address
from terranav.live.mavlink_out import Encoder
from terranav.live.outputs import MavlinkOutput
from terranav.live.records import Fix, Packet, Remark
from terranav.live.settings import LiveSettings
from terranav.live.testbed.flight import Flight, Sent
from terranav.live.wires import Heard
from terranav.maps.map import Map

#: as `terranav live` has them
MAX_AGE_S, CORRELATION_S = 1.0, 10.0


class _Back:
    """A wire that ends at the vehicle, at once."""

    def __init__(self, flight: Flight) -> None:
        self.address, self.facts = Address("back", "mavlink", "back"), Counter[str]()
        self._flight = flight

    async def open(self, heard: Heard) -> None:
        """It always is."""

    async def close(self) -> None:
        """It never is."""

    @property
    def connected(self) -> bool:
        return True

    def write(self, data: bytes) -> bool:
        peer: Hashable = "engine"
        self._flight.take(data, peer)
        return True


class Lockstep:
    """An engine that hears a flight, and a flight that takes its fixes.

    Parameters
    ----------
    flight : Flight
    maps : sequence of Map
        The engine's; the flight has its own.
    settings : LiveSettings, optional
    what : str, optional
        Message to send, a key of `terranav.live.outputs.RATES_HZ`; else what the autopilot takes.
    feedback : bool
        Whether fixes are sent to the vehicle at all.
    """

    def __init__(
        self,
        flight: Flight,
        maps: Sequence[Map],
        settings: LiveSettings | None = None,
        *,
        what: str | None = None,
        feedback: bool = True,
    ) -> None:
        self.flight = flight
        self.engine = Engine(LiveSettings() if settings is None else settings, maps)
        self._autopilot = Autopilot(flight.settings.system_id)
        back = _Back(flight)
        self.output = MavlinkOutput(
            "back",
            lambda: back,
            self._autopilot,
            Encoder(flight.settings.system_id),
            what=what,
            max_age_s=MAX_AGE_S,
            rate_hz=None,
            correlation_s=CORRELATION_S,
            on_sent=lambda name, now_us, frame: None,
        )
        self._feedback = feedback

    def step(self) -> list[Fix | Remark]:
        """A tenth of a second of flight, and what the engine says of it."""
        return self.hear(self.flight.tick())

    def hear(self, frames: Sequence[Sent]) -> list[Fix | Remark]:
        """Feed what the vehicle sent, and send the fixes back."""
        made: list[Fix | Remark] = []
        for stamp_us, data in frames:
            packet = Packet(stamp_us, 0, data)
            made += self._autopilot.hear(packet)
            for said in self.engine.feed(packet):
                made.append(said)
                if self._feedback and isinstance(said, Fix):
                    self.output.send(said, stamp_us)
        if frames and self._feedback:
            self.output.tick(frames[-1][0])
        return made

"""From addresses to wires and outputs: one wire where an input and an output are the same link."""

from __future__ import annotations

from collections.abc import Callable

from terranav.live.autopilot import Autopilot
from terranav.live.links import Address
from terranav.live.mavlink_out import Encoder
from terranav.live.outputs import JsonOutput, MavlinkOutput, NmeaOutput, Output, Sent, json_file
from terranav.live.plan import Plan
from terranav.live.websocket import FixServer
from terranav.live.wires import Wire, wire

_WIRES = ("udpin", "udpout", "tcp", "tcpin", "serial")
_Place = tuple[str, str, int, str]


def place(address: Address) -> _Place:
    """What makes two addresses the same link."""
    return address.wire, address.host, address.port, str(address.path)


def make_wires(plan: Plan) -> dict[_Place, Wire]:
    """A wire, not yet open, for every link that has one."""
    made: dict[_Place, Wire] = {}
    for address in (*plan.inputs, *plan.outputs):
        if address.wire in _WIRES and place(address) not in made:
            made[place(address)] = wire(address)
    return made


class Outputs:
    """All outputs of a run.

    Parameters
    ----------
    plan : Plan
    wires : dict of Wire by place
    back : callable
        Gives the wire that the vehicle is heard on.
    autopilot : Autopilot
    on_sent : callable
    """

    def __init__(
        self,
        plan: Plan,
        wires: dict[_Place, Wire],
        back: Callable[[], Wire | None],
        autopilot: Autopilot,
        on_sent: Sent,
    ) -> None:
        self._plan, self._wires, self._back = plan, wires, back
        self._autopilot, self._on_sent = autopilot, on_sent
        self._servers: list[FixServer] = []
        self.all: list[Output] = []

    async def open(self) -> None:
        """Open what is no wire; ConfigError where that cannot be."""
        for address in self._plan.outputs:
            self.all.append(await self._made(address))

    async def _made(self, address: Address) -> Output:
        """The output of one address."""
        plan, max_age_s = self._plan, self._plan.max_age_s
        if address.wire == "ws":
            server = FixServer(address)
            await server.open()
            self._servers.append(server)
            return JsonOutput(address.text, server.write, max_age_s=max_age_s)
        if address.wire in ("file", "stdout"):
            return json_file(address.text, None if address.wire == "stdout" else address.path, max_age_s)
        if address.speaks == "json":
            return JsonOutput(address.text, self._wires[place(address)].write, max_age_s=max_age_s)
        if address.speaks == "nmea":
            end = self._wires[place(address)]
            return NmeaOutput(address.text, end, max_age_s=max_age_s, rate_hz=plan.rate_hz, on_sent=self._on_sent)
        over = self._back if address.wire == "back" else lambda: self._wires[place(address)]
        return MavlinkOutput(
            address.text,
            over,
            self._autopilot,
            Encoder(self._autopilot.system or 1, plan.key, link=len(self.all)),
            what=plan.send,
            max_age_s=max_age_s,
            rate_hz=plan.rate_hz,
            correlation_s=plan.correlation_s,
            on_sent=self._on_sent,
        )

    async def close(self) -> None:
        """Close what is no wire."""
        for server in self._servers:
            await server.close()
        for output in self.all:
            output.close()

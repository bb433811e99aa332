"""The test bed and live engines, each on a port of its own, in the loop of a test."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

from terranav.live.links import inputs, outputs
from terranav.live.plan import Plan
from terranav.live.running import Live
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.front import Front
from terranav.live.testbed.settings import FlightSettings
from tests.live.flights import chart, settings
from tests.live.thirdparty.peers import until

#: the flight whose terrain gives a usable fix soonest of the first four seeds, after 18 s: it keeps the tests short
SEED = 3


class Bed:
    """A flight behind a port."""

    def __init__(self, front: Front, port: int) -> None:
        self.front, self.port = front, port

    @property
    def flight(self) -> Flight:
        """What flies."""
        return self.front.flight

    @property
    def heard(self) -> dict[str, int]:
        """Messages that the vehicle took, and how many."""
        return self.flight.inbox.heard

    @property
    def ignored(self) -> dict[str, int]:
        """Messages that it did not take."""
        return self.flight.inbox.ignored


@contextlib.asynccontextmanager
async def flying(
    told: FlightSettings, *, link: str = "tcpin:0", speed: float = 10.0, record: bool = False, tlog: Path | None = None
) -> AsyncIterator[Bed]:
    """The test bed, which takes off when somebody is there."""
    with contextlib.ExitStack() as files:
        stream = None if tlog is None else files.enter_context(tlog.open("wb"))
        front = Front(Flight(chart(), told, record=record), outputs([link]), speed=speed, tlog=stream)
        task = asyncio.create_task(front.run(wait=True))
        try:
            yield Bed(front, await _port(front.wires[0], task))
            if task.done():
                task.result()
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def _port(wire: Any, task: asyncio.Task[Any]) -> int:
    """The port of a wire, once it is open."""

    def opened() -> bool:
        if task.done():
            task.result()
        return getattr(wire, "_server", None) is not None or getattr(wire, "_transport", None) is not None

    await until(opened, "a port is open")
    return int(wire.port)


@contextlib.asynccontextmanager
async def navigating(
    link: str = "tcpin:0", outs: Sequence[str] = ("back",), **plan: Any
) -> AsyncIterator[tuple[Live, list[int]]]:
    """A live engine, and the ports that it opened."""
    live = Live(Plan(inputs([link]), outputs(outs), **plan), settings(), [chart()])
    task = asyncio.create_task(live.run())
    try:
        await until(lambda: task.done() or live.ready, "the engine is ready")
        if task.done():
            task.result()
        yield live, [getattr(wire, "port", 0) for wire in live.wires.values()]
    finally:
        live.stop()
        await asyncio.gather(task, return_exceptions=True)

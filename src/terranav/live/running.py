"""The program around the engine: links in, the engine, the recorder, outputs, checkpoints, until someone stops it.

All of it runs in one loop of asyncio: links put packets into a bounded queue, one task takes them out, writes each down
and feeds it to the engine, and offers the fixes to the outputs at once. Time is that of the newest packet and what has
passed since by a clock that nobody sets, so that a host clock that is set does not make fixes old, and a recording
replays as it was flown.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from terranav.live.autopilot import Autopilot
from terranav.live.ears import Ear, host_us
from terranav.live.logbook import Logbook
from terranav.live.mavlink_in import dialect
from terranav.live.mavlink_out import Encoder
from terranav.live.plan import Plan
from terranav.live.plumbing import Outputs, make_wires, place
from terranav.live.recordings import Opened, opened
from terranav.live.records import Packet, Remark
from terranav.live.session import Delays, Session
from terranav.live.settings import LiveSettings
from terranav.live.signing import Checker
from terranav.live.wires import Wire
from terranav.maps.map import Map

_MOST_WAITING = 20_000
_BATCH = 64
_TICK_S = 0.1
_QUIET_S = 1.0
_STATUS_S = 1.0


class Live:
    """One run.

    Parameters
    ----------
    plan : Plan
    settings : LiveSettings
    maps : sequence of Map
    on_remark, on_status : callable, optional
        Told each remark, and once a second the facts.
    """

    def __init__(
        self,
        plan: Plan,
        settings: LiveSettings,
        maps: Sequence[Map],
        *,
        on_remark: Callable[[Remark], None] = lambda remark: None,
        on_status: Callable[[dict[str, Any]], None] = lambda facts: None,
    ) -> None:
        self.plan = plan
        self._on_remark, self._on_status = on_remark, on_status
        self._files = [opened(address.path) for address in plan.inputs if address.wire == "file"]
        plan.check_folder(self._files)
        self.session = Session(settings, maps)
        self.autopilot = Autopilot(settings.system_id)
        self.wires = make_wires(plan)
        self._heard_on: dict[int, Wire] = {}
        self.outputs = Outputs(plan, self.wires, self._back, self.autopilot, self._sent)
        self._logbook = Logbook(plan.folder, plan.links(self._files), fresh=plan.fresh)
        self._waiting: deque[tuple[Packet, float]] = deque()
        self._awake, self._stopped = asyncio.Event(), asyncio.Event()
        self._ears: list[Ear] = []
        self._reading = 0
        self._now = (host_us(), time.perf_counter())
        self._ready_s = 0.0
        self.dropped = 0
        self._dropping = self._told_failed = False
        self.since_measured, self.since_arrived = Delays(), Delays()
        self._door: Encoder | None = None
        self._knocked_us = 0

    @property
    def ready(self) -> bool:
        """Whether all is open and loaded, so that a fix is worked on as it comes."""
        return self._ready_s > 0.0

    def stop(self) -> None:
        """End the run: what has come in is still worked on."""
        self._stopped.set()
        self._awake.set()

    async def run(self) -> dict[str, Any]:
        """Run until a file ends, `stop` is called, or the program is asked to end; the facts at the end.

        Raises
        ------
        ConfigError, DataError
            A link, file or folder that cannot be used, before anything is navigated.
        """
        loop, tasks = asyncio.get_running_loop(), set[asyncio.Task[None]]()
        for number in (signal.SIGINT, signal.SIGTERM):
            # only the main thread of a system with signals can; a KeyboardInterrupt or `stop` ends the others
            with contextlib.suppress(NotImplementedError, RuntimeError, ValueError):
                loop.add_signal_handler(number, self.stop)
        try:
            await self._open()
            await self._begin()
            files = [(number, source) for number, _, source in self.plan.numbered(self._files) if source is not None]
            self._reading = len(files)
            work = loop.create_task(self._work())
            tasks = {work, loop.create_task(self._tick()), loop.create_task(self._save())}
            tasks |= {loop.create_task(self._read(number, source)) for number, source in files}
            if self.plan.stop_after_s is not None:
                loop.call_later(self.plan.stop_after_s, self.stop)
            while not work.done():
                done, tasks = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await self._close()
        return self.facts()

    async def _open(self) -> None:
        """Open every link; an error before anything is written."""
        if self.wires:
            dialect()
        for number, address, source in self.plan.numbered(self._files):
            if source is None:
                ear = Ear(number, self._arrived, None if self.plan.key is None else Checker(self.plan.key))
                self._ears.append(ear)
                self._heard_on[number] = self.wires[place(address)]
                await self._heard_on[number].open(ear)
        for wire in self.wires.values():
            if wire not in self._heard_on.values():
                await wire.open(lambda data, peer: None)
        await self.outputs.open()

    async def _begin(self) -> None:
        """Bring the session to where the run stopped, and load what the first fix would wait for."""
        for level, key, text in await asyncio.to_thread(self._logbook.begin, self.session):
            self._note(Remark(host_us(), level, key, text))
        await asyncio.to_thread(self.session.warm)
        self._ready_s = time.perf_counter()

    def _back(self) -> Wire | None:
        """The wire that the vehicle is heard on."""
        return self._heard_on.get(self.autopilot.link) if self.autopilot.link is not None else None

    def now_us(self) -> int:
        """The time of the newest packet, and what has passed since [us since 1970]."""
        base_us, base_s = self._now
        return base_us + int((time.perf_counter() - base_s) * 1e6)

    def _arrived(self, packet: Packet) -> None:
        """Put a packet in the queue; when that is full the oldest is dropped."""
        if len(self._waiting) >= _MOST_WAITING:
            self._waiting.popleft()
            self.dropped += 1
            if not self._dropping:
                self._dropping = True
                text = f"more comes in than can be worked on: of {_MOST_WAITING} waiting packets the oldest are dropped"
                self._note(Remark(packet.stamp_us, "warning", "queue full", text))
        self._waiting.append((packet, time.perf_counter()))
        self._awake.set()

    async def _work(self) -> None:
        """Take packets out of the queue until there are no more to come."""
        while True:
            for _ in range(min(_BATCH, len(self._waiting))):
                packet, arrived_s = self._waiting.popleft()
                # what a file holds did not come in while it waited for its turn
                self._take(packet, arrived_s if self._heard_on else time.perf_counter())
            self._logbook.flush()
            if self._waiting:
                await asyncio.sleep(0)
                continue
            if self._dropping:
                self._dropping = False
                text = f"the queue is empty again; {self.dropped} packets were dropped in all"
                self._note(Remark(self.now_us(), "info", "queue full", text))
            if self._stopped.is_set() or (self._files and not self._reading):
                return
            self._awake.clear()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._awake.wait(), 0.25)

    def _take(self, packet: Packet, arrived_s: float) -> None:
        """One packet: write it down, hear it, send what comes of it."""
        self._now = packet.stamp_us, arrived_s
        self._logbook.packet(packet)
        for remark in self.autopilot.hear(packet):
            if self.plan.outputs:
                self._note(remark)
        for one in self.session.take(packet):
            if isinstance(one, Remark):
                self._note(one)
                continue
            self._logbook.fix(self.session.packets, one)
            for output in self.outputs.all:
                output.send(one, self.now_us())
            if one.usable and arrived_s >= self._ready_s:
                self.since_measured.add((self.now_us() - one.stamp_us) * 1e-6)
                self.since_arrived.add(time.perf_counter() - arrived_s)

    def _note(self, remark: Remark) -> None:
        """Write a remark down and tell it."""
        self._logbook.remark(remark)
        self._on_remark(remark)

    def _sent(self, output: str, stamp_us: int, data: bytes) -> None:
        """Write down what went out."""
        self._logbook.sent(output, stamp_us, data)

    async def _read(self, number: int, source: Opened) -> None:
        """Play a file into the queue at its speed."""
        speed, first = self.plan.speed, None
        try:
            for packet in source.packets():
                while len(self._waiting) >= 4 * _BATCH and not self._stopped.is_set():
                    await asyncio.sleep(0)
                if self._stopped.is_set():
                    return
                if speed > 0.0:
                    first = first or (packet.stamp_us, time.perf_counter())
                    wait_s = first[1] + (packet.stamp_us - first[0]) * 1e-6 / speed - time.perf_counter()
                    if wait_s > 0.001:
                        await asyncio.sleep(min(wait_s, 60.0))
                self._arrived(Packet(packet.stamp_us, number + packet.link, packet.data))
        finally:
            self._reading -= 1
            self._awake.set()
            for text in source.remarks:
                self._note(Remark(self.now_us(), "warning", "file", f"{source.path}: {text}"))

    async def _tick(self) -> None:
        """What is due by the clock: heartbeats, the word that time passes, the status."""
        told_s = 0.0
        while True:
            await asyncio.sleep(_TICK_S)
            now_us = self.now_us()
            for output in self.outputs.all:
                output.tick(now_us)
            self._knock(now_us)
            if self._heard_on and not self._waiting and time.perf_counter() - self._now[1] > _QUIET_S:
                self._arrived(Packet(host_us(), 0, b""))
            if self._logbook.failed and not self._told_failed:
                self._told_failed = True
                self._on_remark(Remark(now_us, "error", "recorder", self._logbook.failed))
            if time.perf_counter() - told_s >= _STATUS_S:
                told_s = time.perf_counter()
                self._on_status(self.facts())

    def _knock(self, now_us: int) -> None:
        """Say on links that must speak first that we are there, unless an output does."""
        beats = self.autopilot.system is not None and any(one.wire == "back" for one in self.plan.outputs)
        wires = [wire for wire in self._heard_on.values() if wire.address.wire == "udpout"]
        if beats or not wires or 0 <= now_us - self._knocked_us < 1_000_000:
            return
        self._knocked_us = now_us
        self._door = self._door or Encoder(self.autopilot.system or 1, self.plan.key)
        beat = self._door.heartbeat()
        for wire in wires:
            wire.write(beat)

    async def _save(self) -> None:
        """A checkpoint every few seconds."""
        while True:
            await asyncio.sleep(self.plan.checkpoint_s)
            await self._checkpoint()

    async def _checkpoint(self) -> None:
        await self._logbook.checkpoint(
            self.session, lambda text: self._note(Remark(self.now_us(), "error", "checkpoint", text))
        )

    async def _close(self) -> None:
        """Write all that is left, and close everything."""
        for wire in self.wires.values():
            await wire.close()
        await self.outputs.close()
        if self.ready:
            await self._checkpoint()
        self._logbook.close(self.facts())

    def facts(self) -> dict[str, Any]:
        """Counts so far; plain JSON."""
        links = {str(number): {"address": one.address.text, **one.facts} for number, one in self._heard_on.items()}
        return {
            **self.session.facts(),
            "waiting": len(self._waiting),
            "dropped": self.dropped,
            "refused": sum(ear.refused for ear in self._ears),
            "outputs": {one.name: {"sent": one.sent, "held": dict(one.held)} for one in self.outputs.all},
            "answers": dict(self.autopilot.answers),
            "autopilot": self.autopilot.kind,
            "since_measured": self.since_measured.facts(),
            "since_arrived": self.since_arrived.facts(),
            "checkpoints": self._logbook.checkpoints,
            "recording_failed": self._logbook.failed,
            "links": links,
        }

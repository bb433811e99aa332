"""MAVProxy as a program, in a folder of its own; and whether it is there."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import sys
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

#: where `make test` puts it, so that its modules are not among those of the environment
PEERS = Path(sys.prefix) / "peers"
#: no modules that fetch tiles or need a screen
_MODULES = "log,signing,wp,param,mode,arm,misc,cmdlong,output"
PATIENCE_S = 240.0


def mavproxy_command() -> list[str]:
    """How to start MAVProxy; skips the test where it is not installed."""
    script = PEERS / "bin" / "mavproxy.py"
    if script.is_file():
        return [sys.executable, str(script)]
    found = shutil.which("mavproxy.py")
    if found is None:
        pytest.skip("MAVProxy is not installed: make test gets it from the index, requirements/peers.txt")
    return [found]


async def until(true: Callable[[], Any], what: str, pause_s: float = 0.05) -> None:
    """Wait for something, and say what did not happen."""
    end = asyncio.get_running_loop().time() + PATIENCE_S
    while not true():
        assert asyncio.get_running_loop().time() < end, f"did not happen in {PATIENCE_S:.0f} s: {what}"
        await asyncio.sleep(pause_s)


@dataclass
class Proxy:
    """A MAVProxy that runs, or ran.

    Attributes
    ----------
    folder : Path
        Its home, where it leaves its log.
    process : asyncio.subprocess.Process
    """

    folder: Path
    process: asyncio.subprocess.Process

    @property
    def tlog(self) -> Path:
        """All that it received or handed on, as it wrote it."""
        return self.folder / "mav.tlog"

    @property
    def said(self) -> str:
        """What it printed."""
        return (self.folder / "said.txt").read_text(encoding="utf-8", errors="replace")

    def type(self, line: str) -> None:
        """Type a command."""
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode() + b"\n")

    def messages(self) -> list[Any]:
        """Its log so far, as pymavlink reads it."""
        return read_tlog(self.tlog)

    def counts(self) -> Counter[tuple[str, int, int]]:
        """(message, system, component) and how often it stands in the log so far."""
        return Counter((m.get_type(), m.get_srcSystem(), m.get_srcComponent()) for m in self.messages())

    async def logs(self, name: str, sender: tuple[int, int] = (1, 1), count: int = 1) -> None:
        """Wait until so many messages of a sender stand in its log."""
        await until(lambda: self.counts()[name, *sender] >= count, f"MAVProxy logs {count} {name} of {sender}", 0.3)

    async def stop(self) -> None:
        """Ask it to end, and see that it does: it reads commands until there are no more."""
        assert self.process.stdin is not None
        for end in (self.process.stdin.close, self.process.terminate, self.process.kill):
            if self.process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    end()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self.process.wait(), 20.0)


def read_tlog(path: Path) -> list[Any]:
    """Messages of a telemetry log, read by pymavlink."""
    from pymavlink import mavutil

    if not path.is_file() or path.stat().st_size == 0:
        return []
    log = mavutil.mavlogfile(str(path), notimestamps=False)
    found = []
    try:
        while (message := log.recv_msg()) is not None:
            found.append(message)
    finally:
        log.close()
    return found


@contextlib.asynccontextmanager
async def mavproxy(
    folder: Path, master: str, outs: Sequence[str] = (), commands: Sequence[str] = ()
) -> AsyncIterator[Proxy]:
    """Run MAVProxy between a vehicle and others; it is ended whatever happens."""
    command = mavproxy_command()
    folder.mkdir(parents=True, exist_ok=True)
    command += [f"--master={master}", "--retries=60", f"--state-basedir={folder}", f"--default-modules={_MODULES}"]
    command += [f"--out={out}" for out in outs] + [f"--cmd={line}" for line in ("set flushlogs True", *commands)]
    told = {**os.environ, "HOME": str(folder), "PYTHONPATH": str(PEERS), "PYTHONUNBUFFERED": "1"}
    told |= {"TERM": "dumb", "OPENBLAS_NUM_THREADS": "1"}
    with (folder / "said.txt").open("wb") as said:
        process = await asyncio.create_subprocess_exec(
            *command, cwd=folder, env=told, stdin=asyncio.subprocess.PIPE, stdout=said, stderr=asyncio.subprocess.STDOUT
        )
        proxy = Proxy(folder, process)
        try:
            yield proxy
        finally:
            await proxy.stop()

"""A serial port as a wire: read by a thread of its own, opened again when it was unplugged."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import Counter
from typing import Any

from terranav.core.errors import ConfigError
from terranav.live.links import Address
from terranav.live.wires import Heard

_AGAIN_S = 1.0
_POLL_S = 0.1
_READ_BYTES = 4096


class SerialWire:
    """A serial port (extra 'live': pyserial).

    Parameters
    ----------
    address : Address
    """

    def __init__(self, address: Address) -> None:
        self.address, self.facts = address, Counter[str]()
        self._port: Any = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    async def open(self, heard: Heard) -> None:
        """Open the port, which must be there now; later it may come and go."""
        try:
            import serial
        except ImportError:
            raise ConfigError(
                f"{self.address.text}: a serial port needs pyserial, which is not installed: pip install terranav[live]"
            ) from None
        self._serial = serial
        try:
            self._port = self._opened()
        except (OSError, ValueError) as problem:  # SerialException is an OSError
            reason = str(getattr(problem, "strerror", None) or problem)
            raise ConfigError(f"{self.address.text}: {self.address.path} cannot be opened ({reason})") from None
        loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._read, args=(heard, loop), daemon=True, name="serial")
        self._thread.start()

    def _opened(self) -> Any:
        """The port, opened."""
        port = self._serial.Serial(
            str(self.address.path), self.address.baud, timeout=_POLL_S, write_timeout=0, exclusive=True
        )
        self.facts["opened"] += 1
        return port

    def _read(self, heard: Heard, loop: asyncio.AbstractEventLoop) -> None:
        """Read until stopped; after a failure try to open the port again."""
        while not self._stop.is_set():
            try:
                if self._port is None:
                    self._port = self._opened()
                port = self._port
                data = port.read(max(1, min(port.in_waiting, _READ_BYTES)))
            except (OSError, ValueError, TypeError):  # TypeError: pyserial's, when the port is closed while it reads
                self._lost()
                self._stop.wait(_AGAIN_S)
                continue
            if data:
                self.facts["bytes_in"] += len(data)
                try:
                    loop.call_soon_threadsafe(heard, bytes(data), 0)
                except RuntimeError:  # the loop has ended
                    return

    def _lost(self) -> None:
        """Forget a port that failed."""
        port, self._port = self._port, None
        if port is not None:
            self.facts["broken"] += 1
            with contextlib.suppress(OSError):
                port.close()

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    def write(self, data: bytes) -> bool:
        """Hand the bytes to the system's buffer; what does not fit there is lost, and counted."""
        port = self._port
        try:
            sent = port is not None and port.write(data) == len(data)
        except (OSError, ValueError, TypeError):
            sent = False
        self.facts["bytes_out" if sent else "unsent"] += len(data) if sent else 1
        return bool(sent)

    async def close(self) -> None:
        """Stop reading and close the port."""
        self._stop.set()
        if self._thread is not None:
            await asyncio.to_thread(self._thread.join, 2.0)
        self._lost()

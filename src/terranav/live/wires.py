"""Transports under asyncio: bytes in, bytes out, and what to do when the other end goes away.

A wire hands on what it hears at once, with the peer it came from (one datagram's sender, one connection), since bytes
of two peers must not be joined. What is written while nobody is connected is lost, and counted: a fix that waits is
worth nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any, Protocol

from terranav.core.errors import ConfigError
from terranav.live.links import Address

#: is told of bytes and of the peer that sent them; False says that they are not worth an answer
Heard = Callable[[bytes, Hashable], bool | None]
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.5, 8.0
_BUFFER_BYTES = 1 << 20
#: a connection that takes nothing for so many bytes loses what is written next
_BACKLOG_BYTES = 1 << 16
_READ_BYTES = 65536
_MOST_CONNECTIONS = 16
#: a sender of datagrams is answered for so long after it was understood [s]
_ANSWERED_S = 30.0


class Wire(Protocol):
    """One open link.

    Attributes
    ----------
    address : Address
    facts : Counter
        bytes_in, bytes_out, unsent, opened, broken.
    """

    address: Address
    facts: Counter[str]

    async def open(self, heard: Heard) -> None:
        """Open it; ConfigError, in one line, where that cannot ever succeed (a port in use, no such device)."""
        ...

    def write(self, data: bytes) -> bool:
        """Send at once or not at all; whether it was sent."""
        ...

    @property
    def connected(self) -> bool:
        """Whether anyone would hear what is written."""
        ...

    async def close(self) -> None:
        """Close it."""
        ...


def wire(address: Address) -> Wire:
    """The wire that an address asks for, not yet open."""
    if address.wire in ("udpin", "udpout"):
        return _Udp(address)
    if address.wire == "tcp":
        return _TcpClient(address)
    if address.wire == "tcpin":
        return _TcpServer(address)
    from terranav.live.serial_wire import SerialWire

    return SerialWire(address)


def refused(address: Address, problem: OSError) -> ConfigError:
    """What to say where a link cannot be opened."""
    reason = (problem.strerror or str(problem)).lower()
    if problem.errno == 98 or "in use" in reason:
        return ConfigError(f"{address.text}: port {address.port} of {address.host} is in use by another program")
    place = f"{address.host} port {address.port}" if address.port or address.wire != "serial" else str(address.path)
    return ConfigError(f"{address.text}: {place} cannot be opened ({reason})")


class _Udp(asyncio.DatagramProtocol):
    """Datagrams: bound and answering whoever was understood of late, or sent to one place."""

    def __init__(self, address: Address) -> None:
        self.address, self.facts = address, Counter[str]()
        self._transport: Any = None
        self._peers: dict[Any, float] = {}

    async def open(self, heard: Heard) -> None:
        self._heard = heard
        place = (self.address.host, self.address.port)
        loop = asyncio.get_running_loop()
        try:
            if self.address.wire == "udpin":
                self._transport, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=place)
            else:
                self._transport, _ = await loop.create_datagram_endpoint(lambda: self, remote_addr=place)
        except OSError as problem:
            raise refused(self.address, problem) from None
        self.facts["opened"] += 1
        with contextlib.suppress(OSError):
            self._transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self.facts["bytes_in"] += len(data)
        if self._heard(data, addr) is not False and (addr in self._peers or len(self._asking()) < _MOST_CONNECTIONS):
            self._peers[addr] = time.monotonic()

    def error_received(self, exc: Exception) -> None:
        """Nobody listens there just now: the next datagram may find someone."""
        self.facts["broken"] += 1

    @property
    def port(self) -> int:
        """The port that is open, also where 0 was asked for."""
        return int(self._transport.get_extra_info("sockname")[1])

    @property
    def connected(self) -> bool:
        return self._transport is not None and (self.address.wire == "udpout" or bool(self._asking()))

    def _asking(self) -> list[Any]:
        """Who was understood of late."""
        since = time.monotonic() - _ANSWERED_S
        self._peers = {peer: when for peer, when in self._peers.items() if when >= since}
        return list(self._peers)

    def write(self, data: bytes) -> bool:
        if not self.connected or self._transport.is_closing():
            self.facts["unsent"] += 1
            return False
        for peer in (None,) if self.address.wire == "udpout" else self._asking():
            self._transport.sendto(data, peer)
        self.facts["bytes_out"] += len(data)
        return True

    async def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


class _Tcp:
    """What client and server share: connections that are read until they end."""

    def __init__(self, address: Address) -> None:
        self.address, self.facts = address, Counter[str]()
        self._writers: dict[int, asyncio.StreamWriter] = {}
        self._heard: Heard
        self._count = 0

    @property
    def connected(self) -> bool:
        return bool(self._writers)

    def write(self, data: bytes) -> bool:
        sent = False
        for writer in list(self._writers.values()):
            transport = writer.transport
            if transport.is_closing() or transport.get_write_buffer_size() > _BACKLOG_BYTES:
                continue
            writer.write(data)
            sent = True
        self.facts["bytes_out" if sent else "unsent"] += len(data) if sent else 1
        return sent

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Read one connection until it ends."""
        self._count += 1
        number = self._count
        if len(self._writers) >= _MOST_CONNECTIONS:
            writer.close()
            return
        self._writers[number] = writer
        self.facts["opened"] += 1
        try:
            while data := await reader.read(_READ_BYTES):
                self.facts["bytes_in"] += len(data)
                self._heard(data, number)
        except OSError:
            pass
        finally:
            self.facts["broken"] += 1
            self._writers.pop(number, None)
            writer.close()


class _TcpClient(_Tcp):
    """Connects, and connects again with growing pauses whenever the connection ends."""

    _task: asyncio.Task[None] | None = None

    async def open(self, heard: Heard) -> None:
        self._heard = heard
        self._task = asyncio.get_running_loop().create_task(self._keep())

    async def _keep(self) -> None:
        wait_s = _FIRST_WAIT_S
        while True:
            try:
                reader, writer = await asyncio.open_connection(self.address.host, self.address.port)
            except OSError:
                self.facts["refused"] += 1
            else:
                before = self.facts["bytes_in"]
                await self._serve(reader, writer)
                if self.facts["bytes_in"] > before:
                    wait_s = _FIRST_WAIT_S
            await asyncio.sleep(wait_s)
            wait_s = min(2.0 * wait_s, _LONGEST_WAIT_S)

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task


class _TcpServer(_Tcp):
    """Listens; what is written goes to all that are connected."""

    _server: asyncio.Server | None = None

    async def open(self, heard: Heard) -> None:
        self._heard = heard
        try:
            self._server = await asyncio.start_server(self._serve, self.address.host, self.address.port)
        except OSError as problem:
            raise refused(self.address, problem) from None

    @property
    def port(self) -> int:
        """The port that is open, also where 0 was asked for."""
        assert self._server is not None
        return int(self._server.sockets[0].getsockname()[1])

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        for writer in list(self._writers.values()):
            writer.close()
        await asyncio.sleep(0)

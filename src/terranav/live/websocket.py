"""A WebSocket server that sends the JSON of every fix to all who are connected (extra 'live': websockets).

It takes programs, and pages of this machine; a page from anywhere else that a browser has open may not listen in.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from terranav.core.errors import ConfigError
from terranav.live.links import Address
from terranav.live.wires import refused

_MOST_CLIENTS = 32
#: a client that has taken nothing of so many bytes misses what follows
_BACKLOG_BYTES = 1 << 18
_LOCAL = ("localhost", "127.0.0.1", "::1")


class FixServer:
    """The server.

    Parameters
    ----------
    address : Address

    Attributes
    ----------
    facts : Counter
        clients, refused, missed (messages that a slow client did not get).
    """

    def __init__(self, address: Address) -> None:
        self.address, self.facts = address, Counter[str]()
        self._server: Any = None
        self._clients: set[Any] = set()

    async def open(self) -> None:
        """Listen; ConfigError, in one line, where that cannot be."""
        try:
            from websockets.asyncio.server import serve
        except ImportError:
            raise ConfigError(
                f"{self.address.text}: a WebSocket needs websockets 13 or newer, which is not installed: "
                "pip install terranav[live]"
            ) from None
        try:
            self._server = await serve(
                self._client,
                self.address.host,
                self.address.port,
                process_request=self._allowed,
                compression=None,
                max_size=4096,
            )
        except OSError as problem:
            raise refused(self.address, problem) from None

    @property
    def port(self) -> int:
        """The port that is open, also where 0 was asked for."""
        return int(self._server.sockets[0].getsockname()[1])

    def _allowed(self, connection: Any, request: Any) -> Any:
        """Refuse pages from elsewhere, and more clients than there is room for."""
        origin = request.headers.get("Origin")
        ours = origin is None or urlsplit(origin).hostname in (*_LOCAL, self.address.host)
        if ours and len(self._clients) < _MOST_CLIENTS:
            return None
        self.facts["refused"] += 1
        status = HTTPStatus.SERVICE_UNAVAILABLE if ours else HTTPStatus.FORBIDDEN
        return connection.respond(status, "no place is left\n" if ours else "pages of this machine only\n")

    async def _client(self, connection: Any) -> None:
        """One client, until it goes; what it says is not heard."""
        from websockets.exceptions import ConnectionClosed

        self._clients.add(connection)
        self.facts["clients"] += 1
        try:
            with contextlib.suppress(ConnectionClosed):
                async for _ in connection:
                    pass
        finally:
            self._clients.discard(connection)

    def write(self, line: bytes) -> bool:
        """Send one message to all; whether anyone got it."""
        from websockets.asyncio.server import broadcast

        ready = [one for one in self._clients if one.transport.get_write_buffer_size() <= _BACKLOG_BYTES]
        self.facts["missed"] += len(self._clients) - len(ready)
        broadcast(ready, line.decode().strip())
        return bool(ready)

    async def close(self) -> None:
        """Say goodbye to all."""
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

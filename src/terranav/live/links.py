"""Where live mode listens and sends: the addresses a user types, checked before anything is opened.

    udpin:[HOST:]PORT (or udp:)   wait for datagrams; what is sent goes back to whoever was understood
    udpout:HOST:PORT              send there, and hear what comes back
    tcp:HOST:PORT                 connect, and connect again when it breaks
    tcpin:[HOST:]PORT             wait for connections
    serial:DEVICE[:BAUD]          a serial port, 57600 baud unless told
    file:PATH                     a recording of live mode, a .tlog or NMEA text (input only)

    back                          (output only) over the link the vehicle is heard on, as MAVLink
    nmea+ADDRESS                  (output only) NMEA 0183 GGA and RMC over udpout, tcp, tcpin or serial
    json:PATH, json:-             (output only) JSON lines into a file or to stdout
    json+udpout:HOST:PORT         (output only) a datagram of JSON a fix
    ws:[HOST:]PORT                (output only) a WebSocket server, a text message of JSON a fix

Without a HOST a port is opened on the loopback address alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from terranav.core.checks import unknown_name
from terranav.core.errors import ConfigError

LOOPBACK = "127.0.0.1"
BAUD = 57600
_IN = ("udpin", "udp", "udpout", "tcp", "tcpin", "serial", "file")
_WIRES = ("udpin", "udp", "udpout", "tcp", "tcpin", "serial")
_OUT = (*_WIRES, "back", "nmea+udpout", "nmea+tcp", "nmea+tcpin", "nmea+serial", "json", "json+udpout", "ws")
_FORMS = {
    "udpin": "udpin:[HOST:]PORT",
    "udp": "udp:[HOST:]PORT",
    "udpout": "udpout:HOST:PORT",
    "tcp": "tcp:HOST:PORT",
    "tcpin": "tcpin:[HOST:]PORT",
    "serial": "serial:DEVICE[:BAUD]",
    "file": "file:PATH",
    "json": "json:PATH or json:-",
    "ws": "ws:[HOST:]PORT",
}
_MUST_NAME_HOST = ("udpout", "tcp")


@dataclass(frozen=True, slots=True)
class Address:
    """One place to listen or send.

    Attributes
    ----------
    text : str
        As typed.
    speaks : str
        'mavlink' (on an input also NMEA: what comes in tells), 'nmea' or 'json'.
    wire : str
        'udpin', 'udpout', 'tcp', 'tcpin', 'serial', 'file', 'stdout', 'ws' or 'back'.
    host, port : str, int
        For what goes over the network.
    path : Path
        A file or a serial device.
    baud : int
    """

    text: str
    speaks: str
    wire: str
    host: str = LOOPBACK
    port: int = 0
    path: Path = Path()
    baud: int = BAUD


def inputs(texts: Sequence[str]) -> tuple[Address, ...]:
    """Read the addresses to listen at; ConfigError for one that is unknown, or given twice."""
    return _distinct("--in", [_address("--in", text, _IN) for text in texts])


def outputs(texts: Sequence[str]) -> tuple[Address, ...]:
    """Read the addresses to send to; ConfigError for one that is unknown, or given twice."""
    return _distinct("--out", [_address("--out", text, _OUT) for text in texts])


def _distinct(key: str, addresses: list[Address]) -> tuple[Address, ...]:
    """The addresses, each once."""
    for i, address in enumerate(addresses):
        same = (address.wire, address.host, address.port, address.path)
        if any(same == (o.wire, o.host, o.port, o.path) for o in addresses[:i]):
            raise ConfigError(f"{key} {address.text} is given twice, expected each link once")
    return tuple(addresses)


def _address(key: str, text: str, known: Sequence[str]) -> Address:
    """One address."""
    name, _, rest = text.partition(":")
    if name not in known:
        unknown_name(f"{key} link", name, known)
    if name == "back":
        if rest:
            raise ConfigError(f"{key} {text}: expected back, without anything after it")
        return Address(text, "mavlink", "back")
    speaks, _, wire = name.rpartition("+")
    if wire == "json":
        return _json_file(key, text, rest)
    form = f"{speaks}+{_FORMS[wire]}" if speaks else _FORMS[wire]
    speaks = speaks or ("json" if wire == "ws" else "mavlink")
    wire = "udpin" if wire == "udp" else wire
    if not rest:
        raise ConfigError(f"{key} {text}: nothing follows {name!r}, expected {form}")
    if wire == "file":
        return Address(text, speaks, wire, path=Path(rest))
    if wire == "serial":
        return _serial(key, text, rest, speaks)
    host, port = _host_port(key, text, rest, form, must=wire in _MUST_NAME_HOST)
    return Address(text, speaks, wire, host, port)


def _json_file(key: str, text: str, rest: str) -> Address:
    """Where JSON lines go."""
    if not rest:
        raise ConfigError(f"{key} {text}: names no file, expected {_FORMS['json']}")
    if rest == "-":
        return Address(text, "json", "stdout")
    return Address(text, "json", "file", path=Path(rest))


def _serial(key: str, text: str, rest: str, speaks: str) -> Address:
    """A serial port and its speed."""
    device, colon, baud = rest.rpartition(":")
    if not colon or not baud.isascii() or not baud.isdigit():
        if colon and "/" not in baud:
            raise ConfigError(f"{key} {text}: the speed is {baud!r}, expected a number of baud, such as 57600")
        device, baud = rest, str(BAUD)
    if not 50 <= int(baud) <= 12_000_000:
        raise ConfigError(f"{key} {text}: the speed is {baud}, expected a number of baud, such as 57600")
    return Address(text, speaks, "serial", path=Path(device), baud=int(baud))


def _host_port(key: str, text: str, rest: str, form: str, *, must: bool) -> tuple[str, int]:
    """A host and a port; an IPv6 address stands in brackets."""
    host, colon, port = rest.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") if host.startswith("[") and host.endswith("]") else host
    if (must and not host) or (colon and not host) or any(c in host for c in " /[]"):
        raise ConfigError(f"{key} {text}: names no host, expected {form}")
    if not (port.isascii() and port.isdigit() and len(port) < 6 and (0 if not must else 1) <= int(port) <= 65535):
        raise ConfigError(f"{key} {text}: the port is {port!r}, expected {form} with a port from 1 to 65535")
    return host or LOOPBACK, int(port)

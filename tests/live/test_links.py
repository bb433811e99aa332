"""Addresses as typed, signatures, and wires that break and come back."""

from __future__ import annotations

import asyncio
import os
import pty
import socket
import tty
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.core.errors import ConfigError, DataError
from terranav.live.ears import Ear, host_us
from terranav.live.links import Address, inputs, outputs
from terranav.live.mavlink_in import dialect
from terranav.live.mavlink_out import Encoder
from terranav.live.records import Packet
from terranav.live.signing import Checker, clock, read_key
from terranav.live.wires import wire

KEY = bytes(range(32))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("udpin:14550", ("udpin", "127.0.0.1", 14550)),
        ("udp:0.0.0.0:14550", ("udpin", "0.0.0.0", 14550)),
        ("udpout:10.0.0.1:14550", ("udpout", "10.0.0.1", 14550)),
        ("tcp:vehicle.local:5760", ("tcp", "vehicle.local", 5760)),
        ("tcpin:[::1]:5760", ("tcpin", "::1", 5760)),
    ],
)
def test_network_addresses(text: str, expected: tuple[str, str, int]) -> None:
    (address,) = inputs([text])
    assert (address.wire, address.host, address.port) == expected


def test_serial_and_file_addresses() -> None:
    one, two, three = inputs(["serial:/dev/ttyUSB0:921600", "serial:/dev/ttyACM0", "file:C:/a b/flight.tlog"])
    assert (one.path, one.baud) == (Path("/dev/ttyUSB0"), 921600)
    assert (two.path, two.baud) == (Path("/dev/ttyACM0"), 57600)
    assert three.path == Path("C:/a b/flight.tlog")


def test_output_addresses() -> None:
    wanted = ["back", "nmea+udpout:10.0.0.2:10110", "json:-", "json:out.jsonl", "json+udpout:[::1]:9", "ws:8765"]
    found = [(one.speaks, one.wire) for one in outputs(wanted)]
    assert found == [
        ("mavlink", "back"),
        ("nmea", "udpout"),
        ("json", "stdout"),
        ("json", "file"),
        ("json", "udpout"),
        ("json", "ws"),
    ]


@pytest.mark.parametrize(
    ("read", "text", "says"),
    [
        (inputs, "udpn:14550", "unknown --in link 'udpn' (did you mean 'udpin'?)"),
        (inputs, "14550", "unknown --in link '14550'"),
        (inputs, "udpin:", "nothing follows 'udpin', expected udpin:[HOST:]PORT"),
        (inputs, "udpin:70000", "the port is '70000'"),
        (inputs, "udpin:12a", "the port is '12a'"),
        (inputs, "udpin:-1", "the port is '-1'"),
        (inputs, "udpout:14550", "names no host, expected udpout:HOST:PORT"),
        (inputs, "tcp::14550", "names no host"),
        (inputs, "tcp:host:0", "the port is '0'"),
        (inputs, "serial:/dev/tty:fast", "the speed is 'fast'"),
        (inputs, "serial:/dev/tty:9", "the speed is 9"),
        (inputs, "file:", "nothing follows 'file'"),
        (inputs, "ws:8765", "unknown --in link 'ws'"),
        (outputs, "file:a.tlog", "unknown --out link 'file'"),
        (outputs, "json:", "names no file"),
        (outputs, "back:1", "expected back"),
        (outputs, "nmea+udpout:14550", "expected nmea+udpout:HOST:PORT"),
    ],
)
def test_wrong_addresses_are_one_line(read: Callable[[list[str]], Any], text: str, says: str) -> None:
    with pytest.raises(ConfigError) as error:
        read([text])
    assert says in str(error.value)
    assert text.split(":", maxsplit=1)[0] in str(error.value)
    assert "\n" not in str(error.value)


def test_a_link_is_given_once() -> None:
    with pytest.raises(ConfigError, match="given twice"):
        inputs(["udp:14550", "udpin:127.0.0.1:14550"])


def test_keys(tmp_path: Path) -> None:
    (tmp_path / "raw").write_bytes(KEY)
    (tmp_path / "hex").write_text(KEY.hex() + "\n", encoding="ascii")
    assert read_key(tmp_path / "raw") == read_key(tmp_path / "hex") == KEY
    for bad in (b"short", KEY + b"x", b"zz" * 32, b"\xff" * 64):
        (tmp_path / "bad").write_bytes(bad)
        with pytest.raises(DataError, match="expected a MAVLink signing key: 32 bytes, or 64 hex"):
            read_key(tmp_path / "bad")
    with pytest.raises(DataError, match="no such file"):
        read_key(tmp_path / "none")


def test_what_we_sign_pymavlink_accepts_and_we_accept_what_it_signs() -> None:
    peer = dialect().MAVLink(None, srcSystem=1, srcComponent=1)
    peer.signing.secret_key, peer.signing.sign_outgoing, peer.signing.timestamp = KEY, True, clock()
    ours = Encoder(1, KEY).heartbeat()
    (message,) = peer.parse_buffer(ours)
    assert message.get_signed()
    theirs = bytes(dialect().MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(peer))
    check = Checker(KEY)
    assert check(theirs)
    assert not check(theirs)  # played back
    assert not check(Encoder(1).heartbeat())
    assert not check(Encoder(1, bytes(32)).heartbeat())
    assert (check.unsigned, check.wrong, check.late) == (1, 1, 1)


def test_a_forged_late_stamp_does_not_lock_the_true_sender_out() -> None:
    encoder, check = Encoder(1, KEY), Checker(KEY)
    good = encoder.heartbeat()
    forged = good[:-12] + (clock() + 10**9).to_bytes(6, "little") + good[-6:]
    assert not check(forged)
    assert check(good)


def test_an_old_recording_does_not_pass_for_a_new_stream() -> None:
    frame = Encoder(1, KEY).heartbeat()
    assert not Checker(KEY, lambda: clock() + 7_000_000)(frame)
    assert Checker(KEY, lambda: clock() + 5_000_000)(frame)


class Listener:
    """Keeps what a wire hears."""

    def __init__(self) -> None:
        self.heard: list[tuple[bytes, Hashable]] = []

    def __call__(self, data: bytes, peer: Hashable) -> bool:
        self.heard.append((data, peer))
        return not data.startswith(b"noise")

    @property
    def data(self) -> bytes:
        return b"".join(data for data, _ in self.heard)


async def until(true: Callable[[], Any], limit_s: float = 10.0) -> None:
    end = asyncio.get_running_loop().time() + limit_s
    while not true():
        assert asyncio.get_running_loop().time() < end, "did not happen"
        await asyncio.sleep(0.01)


def test_udp_hears_all_and_answers_those_who_were_understood() -> None:
    async def main() -> None:
        one, ear, other = wire(Address("", "mavlink", "udpin")), Listener(), Listener()
        await one.open(ear)
        assert not one.connected
        assert not one.write(b"lost")
        two = wire(Address("", "mavlink", "udpout", port=one.port))  # type: ignore[attr-defined]
        await two.open(other)
        assert two.write(b"noise")
        await until(lambda: ear.data == b"noise")
        assert not one.write(b"to nobody")
        third, more = wire(Address("", "mavlink", "udpout", port=one.port)), Listener()  # type: ignore[attr-defined]
        await third.open(more)
        two.write(b"hello")
        third.write(b"hello")
        await until(lambda: ear.data == b"noisehellohello")
        assert one.write(b"there")
        await until(lambda: other.data == more.data == b"there")
        await third.close()
        assert one.facts["unsent"] == 2
        await one.close()
        await two.close()

    asyncio.run(main())


def test_tcp_server_keeps_peers_apart_and_the_client_comes_back() -> None:
    async def main() -> None:
        server, ear = wire(Address("", "mavlink", "tcpin")), Listener()
        await server.open(ear)
        port = server.port  # type: ignore[attr-defined]
        clients = [wire(Address("", "mavlink", "tcp", port=port)) for _ in range(2)]
        ears = [Listener(), Listener()]
        for client, one in zip(clients, ears, strict=True):
            await client.open(one)
        await until(lambda: all(client.connected for client in clients))
        clients[0].write(b"a")
        clients[1].write(b"b")
        await until(lambda: len(ear.heard) == 2)
        assert len({peer for _, peer in ear.heard}) == 2
        server.write(b"to both")
        await until(lambda: all(one.data == b"to both" for one in ears))
        await server.close()
        await until(lambda: not any(client.connected for client in clients))
        again = wire(Address("", "mavlink", "tcpin", port=port))
        await again.open(ear)
        await until(lambda: all(client.connected for client in clients))
        for client in clients:
            await client.close()
        await again.close()

    asyncio.run(main())


@pytest.mark.parametrize(("kind", "family"), [("udpin", socket.SOCK_DGRAM), ("tcpin", socket.SOCK_STREAM)])
def test_a_port_in_use_is_one_line_that_names_it(kind: str, family: socket.SocketKind) -> None:
    with socket.socket(socket.AF_INET, family) as other:
        other.bind(("127.0.0.1", 0))
        if family == socket.SOCK_STREAM:
            other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=f"{kind}:{port}: port {port} of 127.0.0.1 is in use"):
            asyncio.run(wire(inputs([f"{kind}:{port}"])[0]).open(Listener()))


def test_a_host_that_is_not_ours_is_one_line() -> None:
    with pytest.raises(ConfigError, match="cannot be opened"):
        asyncio.run(wire(Address("udpin:192.0.2.1:5", "mavlink", "udpin", "192.0.2.1", 5)).open(Listener()))


def test_serial_reads_writes_and_survives_a_hang_up() -> None:
    pytest.importorskip("serial")
    master, slave = pty.openpty()
    tty.setraw(master)
    name = Path(os.ttyname(slave))

    async def main() -> None:
        port, ear = wire(Address("", "mavlink", "serial", path=name)), Listener()
        await port.open(ear)
        os.write(master, b"\xfd from the vehicle")
        await until(lambda: ear.data == b"\xfd from the vehicle")
        assert port.write(b"fix")
        assert os.read(master, 100) == b"fix"
        os.close(master)
        await until(lambda: not port.connected)
        assert not port.write(b"nobody")
        await port.close()

    asyncio.run(main())
    os.close(slave)


def test_a_serial_port_that_is_not_there() -> None:
    pytest.importorskip("serial")
    with pytest.raises(ConfigError, match="/nowhere/tty cannot be opened"):
        asyncio.run(wire(inputs(["serial:/nowhere/tty"])[0]).open(Listener()))


def ears(data: list[tuple[bytes, Hashable]], check: Checker | None = None) -> list[bytes]:
    packets: list[Packet] = []
    ear = Ear(3, packets.append, check)
    for some, peer in data:
        ear(some, peer)
    assert all(packet.link == 3 and packet.stamp_us > 1_600_000_000_000_000 for packet in packets)
    return [packet.data for packet in packets]


GGA = b"$GPGGA,000000.50,4700.00000,N,00900.00000,E,1,08,1.0,400.0,M,,M,,*5B"


def test_what_comes_in_tells_what_is_spoken() -> None:
    beats = [Encoder(system).heartbeat() for system in (1, 2)]
    assert ears([(b"".join(beats), "a")]) == beats
    assert ears([(GGA + b"\r\n" + GGA[:20], "a"), (GGA[20:] + b"\r\n", "a")]) == [GGA, GGA]
    # each peer in its own language, and in pieces of any size
    pieces: list[tuple[bytes, Hashable]] = [(bytes([byte]), "mavlink") for byte in b"noise" + beats[0]]
    lines: list[tuple[bytes, Hashable]] = [(bytes([byte]), "nmea") for byte in GGA + b"\n"]
    mixed = [one for both in zip(lines, pieces, strict=False) for one in both] + lines[len(pieces) :]
    assert sorted(ears([*mixed, *pieces[len(lines) :]])) == sorted([GGA, beats[0]])


def test_text_within_mavlink_is_no_sentence() -> None:
    beat = Encoder(1).heartbeat()
    assert ears([(b"$x\n\xfd\x00$\n" + beat + b"$no sentence\n" + beat, "a")]) == [beat, beat]


def test_random_bytes_and_many_peers_cost_no_more_memory() -> None:
    rng = np.random.default_rng(0)
    packets: list[Packet] = []
    ear = Ear(0, packets.append)
    for peer in range(200):
        ear(rng.bytes(2000), peer)
    assert len(ear._peers) <= 16
    assert len(packets) < 5
    beat = Encoder(1).heartbeat()
    ear(beat, "new")
    assert packets[-1].data == beat


def test_a_clock_that_is_set_moves_no_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    before = host_us()
    monkeypatch.setattr("time.time_ns", lambda: 0)
    monkeypatch.setattr("time.time", lambda: 0.0)
    assert 0 <= host_us() - before < 60_000_000

"""A run from its links to its files: what comes in is navigated, sent, recorded, and goes on after a stop."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from terranav.core.errors import ConfigError, DataError
from terranav.live import running
from terranav.live.links import Address, inputs, outputs
from terranav.live.mavlink_in import dialect
from terranav.live.plan import Plan
from terranav.live.recorder import FIXES, RECEIVED
from terranav.live.recordings import opened
from terranav.live.records import Packet, Remark
from terranav.live.running import Live
from terranav.live.signing import clock
from tests.live.flights import Flight, chart, settings

FLIGHT = Flight(seconds=50.0)
FRAMES = [frame for _, frame in FLIGHT.frames()]
UDP = (Address("udpin:0", "mavlink", "udpin", port=0),)
KEY = bytes(range(32))


class Vehicle(asyncio.DatagramProtocol):
    """Sends frames to a run and keeps what it answers."""

    def __init__(self) -> None:
        self.answers: list[Any] = []
        self._link = dialect().MAVLink(None)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self.answers.append(self._link.decode(bytearray(data)))


def made(plan: Plan, **more: Any) -> Live:
    return Live(plan, settings(), [chart()], **more)


async def until(true: Callable[[], Any], limit_s: float = 60.0) -> None:
    end = asyncio.get_running_loop().time() + limit_s
    while not true():
        assert asyncio.get_running_loop().time() < end, "did not happen"
        await asyncio.sleep(0.01)


async def flown(live: Live, frames: Sequence[bytes], vehicle: Vehicle | None = None) -> dict[str, Any]:
    """Send frames to a run that listens on UDP, each once the run has taken the ones before; its facts at the end."""
    task = asyncio.create_task(live.run())
    await until(lambda: task.done() or live.ready)
    if task.done():
        return await task
    port = next(iter(live.wires.values())).port  # type: ignore[attr-defined]
    loop = asyncio.get_running_loop()
    transport, _ = await loop.create_datagram_endpoint(lambda: vehicle or Vehicle(), remote_addr=("127.0.0.1", port))
    before = live.session.packets
    for number, frame in enumerate(frames):
        transport.sendto(frame)
        if number % 20 == 19:
            await until(lambda sent=number: live.session.packets - before > sent - 20)  # type: ignore[misc]
    await until(lambda: live.session.packets - before >= len(frames))
    live.stop()
    facts = await task
    transport.close()
    return facts


def replayed(folder: Path, **more: Any) -> dict[str, Any]:
    plan = Plan(inputs([f"file:{folder / RECEIVED}"]), speed=0.0, **more)
    return asyncio.run(made(plan).run())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], Vehicle]:
    """One run on UDP that answers with GPS_INPUT and writes everything down."""
    folder = tmp_path_factory.mktemp("live") / "run"
    plan = Plan(UDP, outputs(["back", f"json:{folder.parent / 'out.jsonl'}"]), send="gps-input", folder=folder)
    vehicle = Vehicle()

    async def main() -> dict[str, Any]:
        return await flown(made(plan), FRAMES, vehicle)

    return folder, asyncio.run(main()), vehicle


def test_a_run_navigates_and_counts(run: tuple[Path, dict[str, Any], Vehicle]) -> None:
    _, facts, _ = run
    assert facts["packets"] >= len(FRAMES)
    assert facts["fixes"] > 450
    assert facts["usable"] > 0
    assert facts["dropped"] == facts["faults"] == facts["refused"] == 0
    assert facts["autopilot"] == "ardupilot"
    assert 0.0 <= facts["since_arrived"]["p50_ms"] <= facts["since_arrived"]["p99_ms"]
    assert facts["since_measured"]["of"] == facts["usable"]


def test_fixes_and_heartbeats_go_back_to_the_vehicle(run: tuple[Path, dict[str, Any], Vehicle]) -> None:
    _, facts, vehicle = run
    kinds = [message.get_type() for message in vehicle.answers]
    assert kinds.count("GPS_INPUT") == facts["outputs"]["back"]["sent"] > 0
    assert "HEARTBEAT" in kinds
    assert {message.get_srcComponent() for message in vehicle.answers} == {191}


def test_a_replay_of_what_was_received_gives_the_same_digest(run: tuple[Path, dict[str, Any], Vehicle]) -> None:
    folder, facts, _ = run
    again = replayed(folder)
    assert facts["digest"] != "00" * 32
    assert (again["digest"], again["fixes"], again["usable"]) == (facts["digest"], facts["fixes"], facts["usable"])


def test_the_tlog_of_the_one_link_gives_the_same_fixes(run: tuple[Path, dict[str, Any], Vehicle]) -> None:
    folder, facts, _ = run
    packets = list(opened(folder / RECEIVED).packets())
    if any(not packet.data for packet in packets):
        pytest.skip("the machine paused for a second, and the word that time passes is not in a .tlog")
    again = asyncio.run(made(Plan(inputs([f"file:{folder / 'link0.tlog'}"]), speed=0.0)).run())
    assert again["digest"] == facts["digest"]


def test_the_files_of_a_run_are_whole(run: tuple[Path, dict[str, Any], Vehicle]) -> None:
    folder, facts, vehicle = run
    lines = [json.loads(line) for line in (folder / FIXES).read_text(encoding="utf-8").splitlines()]
    assert len(lines) == facts["fixes"]
    assert sum(line["usable"] for line in lines) == facts["usable"]
    assert [packet.data for packet in opened(folder / RECEIVED).packets() if packet.data] == FRAMES
    assert len(list(opened(folder / "sent.tlog").packets())) == len(vehicle.answers)
    assert json.loads((folder / "summary.json").read_text(encoding="utf-8"))["digest"] == facts["digest"]
    told = [json.loads(line) for line in (folder.parent / "out.jsonl").read_text(encoding="utf-8").splitlines()]
    assert sum(line["usable"] for line in told) == facts["outputs"][f"json:{folder.parent / 'out.jsonl'}"]["sent"]


def test_a_run_in_the_same_folder_goes_on_where_the_last_one_stopped(tmp_path: Path) -> None:
    plan = Plan(UDP, folder=tmp_path / "run", checkpoint_s=0.2)
    remarks: list[Remark] = []
    first = asyncio.run(flown(made(plan), FRAMES[:900]))
    second = asyncio.run(flown(made(plan, on_remark=remarks.append), FRAMES[900:1500]))
    assert second["fixes"] > first["fixes"] > 0
    assert any(remark.key == "resumed" for remark in remarks)
    again = replayed(tmp_path / "run")
    assert again["digest"] == second["digest"]
    assert len((tmp_path / "run" / FIXES).read_text(encoding="utf-8").splitlines()) == second["fixes"]


def test_fresh_removes_the_run_that_was_there(tmp_path: Path) -> None:
    plan = Plan(UDP, folder=tmp_path / "run")
    asyncio.run(flown(made(plan), FRAMES[:300]))
    facts = asyncio.run(flown(made(replace(plan, fresh=True)), FRAMES[:100]))
    assert facts["packets"] < 250
    assert replayed(tmp_path / "run")["digest"] == facts["digest"]


def test_a_run_on_other_links_does_not_go_on(tmp_path: Path) -> None:
    asyncio.run(flown(made(Plan(UDP, folder=tmp_path / "run")), FRAMES[:100]))
    before = (tmp_path / "run" / RECEIVED).read_bytes()
    other = (Address("udpin:1", "mavlink", "udpin", port=0),)
    with pytest.raises(ConfigError, match="holds a run on udpin:0, expected the same links"):
        asyncio.run(made(Plan(other, folder=tmp_path / "run")).run())
    assert (tmp_path / "run" / RECEIVED).read_bytes() == before


def test_silence_is_told_to_the_engine_and_recorded(tmp_path: Path) -> None:
    remarks: list[Remark] = []
    live = made(Plan(UDP, folder=tmp_path / "run"), on_remark=remarks.append)

    async def main() -> dict[str, Any]:
        task = asyncio.create_task(live.run())
        await until(lambda: live.ready)
        port = next(iter(live.wires.values())).port  # type: ignore[attr-defined]
        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
            Vehicle, remote_addr=("127.0.0.1", port)
        )
        for frame in FRAMES[:100]:
            transport.sendto(frame)
        await until(lambda: any(remark.key == "link 0 silent" for remark in remarks))
        transport.sendto(FRAMES[100])
        await until(lambda: any("is back" in remark.text for remark in remarks))
        live.stop()
        return await task

    facts = asyncio.run(main())
    assert any(not packet.data for packet in opened(tmp_path / "run" / RECEIVED).packets())
    assert replayed(tmp_path / "run")["digest"] == facts["digest"]


def test_a_full_queue_drops_the_oldest_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "_MOST_WAITING", 10)
    remarks: list[Remark] = []
    live = made(Plan(UDP), on_remark=remarks.append)
    for number in range(25):
        live._arrived(Packet(number, 0, b""))
    assert live.dropped == 15
    assert [packet.stamp_us for packet, _ in live._waiting] == list(range(15, 25))
    assert [remark.key for remark in remarks] == ["queue full"]


def test_a_failure_of_the_engine_does_not_end_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    remarks: list[Remark] = []
    live = made(Plan(UDP), on_remark=remarks.append)
    feed, count = live.session.engine.feed, iter(range(10**6))

    def failing(packet: Packet) -> Any:
        if next(count) in (50, 60):
            raise ZeroDivisionError("by accident")
        return feed(packet)

    monkeypatch.setattr(live.session.engine, "feed", failing)
    facts = asyncio.run(flown(live, FRAMES[:600]))
    assert facts["faults"] == 2
    assert facts["fixes"] > 50
    assert [remark.text for remark in remarks if remark.key == "engine fault"] == [
        "the engine failed at packet 51: ZeroDivisionError: by accident"
    ]


def signed(frames: Sequence[bytes]) -> list[bytes]:
    peer = dialect().MAVLink(None, srcSystem=1, srcComponent=1)
    peer.signing.secret_key, peer.signing.sign_outgoing, peer.signing.timestamp = KEY, True, clock()
    plain = dialect().MAVLink(None)
    return [bytes(plain.decode(bytearray(frame)).pack(peer)) for frame in frames]


def test_with_a_key_only_what_is_signed_is_heard_and_answers_are_signed(tmp_path: Path) -> None:
    plan = Plan(UDP, outputs(["back"]), send="gps-input", key=KEY, folder=tmp_path / "run")
    vehicle = Vehicle()
    live = made(plan)

    async def main() -> dict[str, Any]:
        task = asyncio.create_task(live.run())
        await until(lambda: live.ready)
        port = next(iter(live.wires.values())).port  # type: ignore[attr-defined]
        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: vehicle, remote_addr=("127.0.0.1", port)
        )
        for frame in (*FRAMES[:50], *signed(FRAMES[:50])):
            transport.sendto(frame)
        transport.sendto(b"$GPGGA,000000.50,4700.00000,N,00900.00000,E,1,08,1.0,400.0,M,,M,,*5B\r\n")
        await until(lambda: live.session.packets >= 50 and vehicle.answers)
        live.stop()
        return await task

    facts = asyncio.run(main())
    assert facts["refused"] >= 50
    kept = [packet.data for packet in opened(tmp_path / "run" / RECEIVED).packets() if packet.data]
    assert len(kept) == 50
    assert all(data[2] & 1 for data in kept)
    assert all(message.get_signed() or message._msgbuf[2] & 1 for message in vehicle.answers)


def test_a_link_over_tcp_that_dies_and_returns(tmp_path: Path) -> None:
    async def main() -> dict[str, Any]:
        server_end: list[asyncio.StreamWriter] = []

        async def taken(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            server_end.append(writer)

        server = await asyncio.start_server(taken, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        live = made(Plan(inputs([f"tcp:127.0.0.1:{port}"]), folder=tmp_path / "run"))
        task = asyncio.create_task(live.run())
        for number, part in enumerate((FRAMES[:200], FRAMES[200:400])):
            await until(lambda many=number: live.ready and len(server_end) > many)  # type: ignore[misc]
            # a frame that is cut off with the connection must not spoil the first of the next
            server_end[-1].write(b"".join(part) + FRAMES[400][:10])
            await server_end[-1].drain()
            await until(lambda many=200 * (number + 1): heard(live) >= many)  # type: ignore[misc]
            server_end[-1].close()
        live.stop()
        server.close()
        return await task

    facts = asyncio.run(main())
    assert facts["links"]["0"]["broken"] == 2
    assert [packet.data for packet in opened(tmp_path / "run" / RECEIVED).packets() if packet.data] == FRAMES[:400]


def heard(live: Live) -> int:
    return sum(rate["packets"] for rate in live.session.facts()["engine"]["links"].values())


def test_a_link_that_must_speak_first_knocks() -> None:
    async def main() -> None:
        vehicle, place = Vehicle(), ("127.0.0.1", 0)
        loop = asyncio.get_running_loop()
        transport, _ = await loop.create_datagram_endpoint(lambda: vehicle, local_addr=place)
        port = transport.get_extra_info("sockname")[1]
        live = made(Plan(inputs([f"udpout:127.0.0.1:{port}"])))
        task = asyncio.create_task(live.run())
        await until(lambda: vehicle.answers)
        assert {message.get_type() for message in vehicle.answers} == {"HEARTBEAT"}
        live.stop()
        await task
        transport.close()

    asyncio.run(main())


def test_a_file_plays_at_its_speed(tmp_path: Path) -> None:
    file = tmp_path / "f.tlog"
    packets = FLIGHT.packets()[:160]
    file.write_bytes(b"".join(struct.pack(">Q", packet.stamp_us) + packet.data for packet in packets))
    waits: list[float] = []
    sleep = asyncio.sleep

    async def slept(seconds: float) -> None:
        waits.append(seconds)
        await sleep(0.0)

    plan = Plan(inputs([f"file:{file}"]), speed=10.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio, "sleep", slept)
        asyncio.run(made(plan).run())
    span = (packets[-1].stamp_us - packets[0].stamp_us) * 1e-6
    assert max(wait for wait in waits if wait not in (running._TICK_S, 3.0)) <= span / 10.0
    assert any(0.001 < wait < span for wait in waits)


def test_a_port_in_use_stops_before_anything_is_written(tmp_path: Path) -> None:
    async def main() -> None:
        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
            asyncio.DatagramProtocol, local_addr=("127.0.0.1", 0)
        )
        port = transport.get_extra_info("sockname")[1]
        try:
            with pytest.raises(ConfigError, match=f"port {port} of 127.0.0.1 is in use"):
                await made(Plan(inputs([f"udpin:{port}"]), folder=tmp_path / "run")).run()
        finally:
            transport.close()

    asyncio.run(main())
    assert not (tmp_path / "run").exists()


def test_a_recording_is_not_written_over_while_it_is_read(tmp_path: Path) -> None:
    asyncio.run(flown(made(Plan(UDP, folder=tmp_path / "run")), FRAMES[:50]))
    asyncio.run(flown(made(Plan(UDP, folder=tmp_path / "old")), FRAMES[:50]))
    source = inputs([f"file:{tmp_path / 'run' / RECEIVED}"])
    with pytest.raises(ConfigError, match="which is read"):
        made(Plan(source, folder=tmp_path / "run", fresh=True))
    with pytest.raises(ConfigError, match="holds a run"):
        made(Plan(source, folder=tmp_path / "old"))


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"inputs": ()}, "--in is not given"),
        ({"send": "px5"}, "unknown message for --send 'px5' \\(did you mean 'px4'"),
        ({"speed": -1.0}, "--speed is -1.0"),
        ({"max_age_s": 6.0}, "--max-age is 6.0"),
        ({"max_age_s": float("nan")}, "--max-age is nan"),
        ({"rate_hz": 0.0}, "--rate is 0.0"),
        ({"checkpoint_s": 0.0}, "--checkpoint is 0.0"),
        ({"inputs": inputs(["file:a"]), "outputs": outputs(["back"])}, "no --in link can be answered"),
    ],
)
def test_plans_that_cannot_be_are_one_line(more: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        Plan(**{"inputs": UDP, **more})


def test_a_file_that_is_not_there_is_one_line() -> None:
    with pytest.raises(DataError, match=r"/nowhere/a\.tlog: no such file"):
        made(Plan(inputs(["file:/nowhere/a.tlog"])))

"""`terranav fly`: what it prints, writes and sends, and one line for every wrong use."""

from __future__ import annotations

import asyncio
import json
import socket
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("jsbsim")

from terranav.app.cli import main
from terranav.app.commands.fly import verdict
from terranav.io.logs import open_log
from terranav.io.recordings import read_recording
from terranav.live.mavlink_in import dialect
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.front import Front, addresses
from terranav.live.testbed.settings import FlightSettings
from terranav.maps.sample_dem import sample_map

D = dialect()


@pytest.fixture
def listener() -> Any:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 21)
        heard.bind(("127.0.0.1", 0))
        heard.settimeout(20.0)
        yield heard


def out_to(listener: socket.socket) -> str:
    return f"udpout:127.0.0.1:{listener.getsockname()[1]}"


def test_a_short_flight_is_sent_recorded_and_summed_up(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], listener: socket.socket
) -> None:
    arguments = ["fly", "--minutes", "0.5", "--speed", "0", "--gnss-off", "10", "--out", out_to(listener)]
    assert main([*arguments, "--record", str(tmp_path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["flown_s"] == 30.0
    assert facts["fixes_used"] == 0
    assert D.MAVLink(None).decode(bytearray(listener.recv(2048))).get_type() == "HEARTBEAT"
    truth = read_recording(tmp_path / "truth.csv")
    log = open_log(tmp_path / "telemetry.tlog").recording
    assert len(truth) == len(log) == 301
    assert truth.ins is not None
    assert log.readings[-2:] == ("radar_altitude_m", "baro_altitude_m")
    assert log.lat_deg[50] == pytest.approx(truth.columns["true_lat_deg"][50], abs=1e-4)


def test_the_summary_is_one_line(capsys: pytest.CaptureFixture[str], listener: socket.socket) -> None:
    assert main(["fly", "--minutes", "0.1", "--speed", "0", "--out", out_to(listener)]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("without fixes: own position wrong by ")


def test_the_verdict_tells_what_the_fixes_were_worth() -> None:
    facts = {
        "fixes_used": 7, "own_p95_m": 24.0, "own_last_m": 11.0, "without_fixes_p95_m": 2600.0,
        "without_fixes_last_m": 3000.0, "off_track_p95_m": 101.0,
    }  # fmt: skip
    expected = "with fixes: own position wrong by 24 m (95 %), 11 m at the end (without: 2.6 km, 3.0 km); within 101 m"
    assert verdict(facts).startswith(expected)


def test_a_client_over_tcp_is_waited_for_and_answered() -> None:
    flight = Flight(sample_map(), FlightSettings(minutes=0.2))
    front = Front(flight, addresses(["tcpin:127.0.0.1:0"]), speed=20.0)
    ask = D.MAVLink_param_request_read_message(1, 1, b"MAV_SYS_ID", -1).pack(D.MAVLink(None, 255, 190))

    async def client() -> bytes:
        flying = asyncio.create_task(front.run(wait=True))
        while getattr(front.wires[0], "_server", None) is None:
            await asyncio.sleep(0.01)
        assert flight.time_us == 0
        reader, writer = await asyncio.open_connection("127.0.0.1", front.wires[0].port)  # type: ignore[attr-defined]
        writer.write(ask)
        answer = await reader.readuntil(b"MAV_SYS_ID")
        await flying
        writer.close()
        return answer

    assert b"\xfd" in asyncio.run(client())
    assert flight.inbox.heard == {"PARAM_REQUEST_READ": 1}
    assert flight.over


def test_speed_changes_no_bit(listener: socket.socket, tmp_path: Path) -> None:
    logs = []
    for speed in ("0", "30"):
        arguments = ["fly", "--minutes", "0.1", "--speed", speed, "--out", out_to(listener)]
        assert main([*arguments, "--record", str(tmp_path / speed)]) == 0
        logs.append((tmp_path / speed / "telemetry.tlog").read_bytes())
    assert logs[0] == logs[1]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--minutes", "0"], "minutes is 0.0, expected a finite number and >= 0.1"),
        (["--speed", "-1"], "speed is -1.0"),
        (["--out", "upd:127.0.0.1:1"], "did you mean 'udp'"),
        (["--out", "json:-"], "--out json:-: expected udpout, udpin, tcp, tcpin or serial"),
        (["--out", "udpout:127.0.0.1:1", "--out", "udpout:127.0.0.1:1"], "given twice"),
        (["--as", "px5"], "unknown autopilot 'px5'"),
        (["--reports", "all"], "unknown reports 'all'"),
        (["--ins", "tacticl"], "did you mean 'tactical'"),
        (["--gnss-off", "-5"], "gnss-off is -5.0"),
        (["--spoof-mps", "nan"], "spoof-mps is nan"),
        (["--system", "0"], "system_id is 0"),
        (["--sign-key", "no-such-file"], "no-such-file"),
        (["--map", "no-such-file.tif"], "no-such-file.tif"),
        (["--map", "a.tif", "--map", "b.tif"], "--map is given 2 times"),
    ],
)
def test_wrong_use_is_one_line(arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fly", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert told in err
    assert len(err.splitlines()) == 1


def test_a_port_in_use_and_a_folder_that_is_a_file_are_named(
    listener: socket.socket, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = listener.getsockname()[1]
    assert main(["fly", "--minutes", "0.1", "--out", f"udpin:127.0.0.1:{port}"]) == 2
    assert f"port {port} of 127.0.0.1 is in use" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["fly", "--record", str(tmp_path / "file")]) == 2
    assert "--record" in capsys.readouterr().err

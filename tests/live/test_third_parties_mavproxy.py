"""MAVProxy, as a program, beside the test bed and between it and the live engine."""

from __future__ import annotations

import asyncio
import socket
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terranav.core.earth import offset_of, shifted
from terranav.io.logs import open_log
from terranav.live.recordings import opened
from terranav.live.testbed.settings import FlightSettings
from terranav.live.testbed.telemetry import BOOT_US
from tests.live.thirdparty.peers import Proxy, mavproxy, mavproxy_command, until
from tests.live.thirdparty.scene import SEED, Bed, flying, navigating

PROGRAM = [sys.executable, "-c", "import sys; from terranav.app.cli import main; sys.exit(main())"]


@pytest.fixture(autouse=True)
def _there() -> None:
    pytest.importorskip("jsbsim", reason="needs the extra 'fly'")
    mavproxy_command()


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def test_mavproxy_connects_to_terranav_fly(tmp_path: Path) -> None:
    """The command as a user types it; MAVProxy fetches parameters and the mission, and writes its log."""
    port = free_port()
    command = [
        *PROGRAM,
        "fly",
        "--out",
        f"tcpin:{port}",
        "--wait",
        "--minutes",
        "60",
        "--speed",
        "5",
        "--as",
        "ardupilot",
    ]

    async def main() -> Proxy:
        fly = await asyncio.create_subprocess_exec(
            *command, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL
        )
        try:
            async with mavproxy(tmp_path, f"tcp:127.0.0.1:{port}") as proxy:
                await proxy.logs("GLOBAL_POSITION_INT", count=100)
                proxy.type("wp list")
                await until(lambda: "Received" in proxy.said, "parameters are fetched")
                await proxy.logs("MISSION_ITEM_INT", count=2)
                assert fly.returncode is None
        finally:
            if fly.returncode is None:
                fly.kill()
            await fly.wait()
        return proxy

    proxy = asyncio.run(main())
    assert "Detected vehicle 1:1 on link 0" in proxy.said
    assert "AUTO> Mode AUTO" in proxy.said
    assert {"HEARTBEAT", "ATTITUDE", "GPS_RAW_INT", "DISTANCE_SENSOR"} <= {name for name, _, _ in proxy.counts()}
    log = open_log(proxy.tlog)
    assert log.facts["format"] == "MAVLink telemetry log"
    assert log.facts["vehicle"] == {"system_id": 1, "firmware": "ArduPilot"}
    assert log.facts["series"]["own"]["rows"] >= 100


def off_m(bed: Bed, m: Any) -> float:
    """How far a fix lies from the truth of its time, a command from all of the track [m]."""
    true = bed.flight.recording().columns
    lat, lon = true["true_lat_deg"], true["true_lon_deg"]
    if m.get_type() == "ODOMETRY":
        place = shifted(*bed.flight.inbox.origin_deg, m.x, m.y)
    else:
        place = (m.x / 1e7, m.y / 1e7) if m.get_type() == "COMMAND_INT" else (m.lat / 1e7, m.lon / 1e7)
    if m.get_type() != "COMMAND_INT":
        at = (m.time_usec - getattr(m, "processing_time", 0) - BOOT_US) * 1e-6
        lat, lon = (np.interp([at], true["time_s"], column) for column in (lat, lon))
    return min(float(np.hypot(*offset_of(float(a), float(b), *place))) for a, b in zip(lat, lon, strict=True))


@pytest.mark.parametrize(
    ("autopilot", "send", "name"),
    [
        ("px4", None, "GLOBAL_POSITION_SENSOR"),
        ("ardupilot", None, "ODOMETRY"),
        ("ardupilot", "gps-input", "GPS_INPUT"),
        ("ardupilot", "reset", "COMMAND_INT"),
    ],
)
def test_fixes_go_through_mavproxy_and_into_its_log(
    tmp_path: Path, autopilot: str, send: str | None, name: str
) -> None:
    """Vehicle - MAVProxy - engine: what the engine sends arrives, is used, and stands in the log byte by byte."""
    told = FlightSettings(minutes=10.0, gnss_off_s=5.0, seed=SEED, autopilot=autopilot)
    enough = 1 if send == "reset" else 3

    async def main() -> tuple[Proxy, Bed, dict[str, Any]]:
        async with (
            flying(told, speed=5.0, record=True) as bed,
            navigating(send=send, folder=tmp_path / "run") as (live, (port,)),
            mavproxy(tmp_path / "proxy", f"tcp:127.0.0.1:{bed.port}", [f"tcp:127.0.0.1:{port}"]) as proxy,
        ):
            await until(lambda: bed.heard.get(name, 0) >= enough, f"{name} arrives")
            await proxy.logs(name, (1, 191), enough)
            await until(lambda: bed.flight.navigation.used >= enough, "fixes are used")
            if send == "reset":
                await until(lambda: live.autopilot.answers["accepted"], "the reset is accepted")
        return proxy, bed, live.facts()

    proxy, bed, facts = asyncio.run(main())
    logged = [m for m in proxy.messages() if m.get_srcComponent() == 191]
    assert {name, "HEARTBEAT"} <= {m.get_type() for m in logged}
    sent = {packet.data for packet in opened(tmp_path / "run" / "sent.tlog").packets()}
    assert {bytes(m.get_msgbuf()) for m in logged} <= sent
    assert facts["dropped"] == facts["faults"] == facts["refused"] == 0
    assert facts["engine"]["system_id"] == 1  # not MAVProxy, whose heartbeat came too
    ours = [m for m in logged if m.get_type() == name]
    assert max(off_m(bed, m) for m in ours) < 150.0
    if name == "COMMAND_INT":
        assert {m.command for m in ours} == {43003}

"""MAVSDK beside the test bed and beside the live engine: it finds them, and tells what they told."""

from __future__ import annotations

import asyncio
import json
import math
import sys
from pathlib import Path
from typing import Any

import pytest

from terranav.live.testbed.settings import FlightSettings
from tests.live.thirdparty.peers import read_tlog
from tests.live.thirdparty.scene import SEED, flying, navigating

STREAMS = ("position", "attitude_euler", "velocity_ned", "health", "gps_info", "in_air", "flight_mode")


@pytest.fixture(autouse=True)
def _there() -> None:
    pytest.importorskip("jsbsim", reason="needs the extra 'fly'")
    pytest.importorskip("mavsdk", reason="MAVSDK is not installed: pip install mavsdk")


async def heard(url: str, message: str, count: int, *streams: str) -> dict[str, Any]:
    """What a program with MAVSDK hears."""
    client = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "tests.live.thirdparty.mavsdk_client", url, message, str(count), *streams,
        cwd=Path(__file__).parents[2], stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        out, err = await asyncio.wait_for(client.communicate(), 300.0)
    finally:
        if client.returncode is None:
            client.kill()
            await client.wait()
    assert client.returncode == 0, err.decode()
    found: dict[str, Any] = json.loads(out)
    return found


@pytest.mark.parametrize(
    ("autopilot", "link", "url"),
    [("px4", "tcpin:0", "tcpout://127.0.0.1:{}"), ("ardupilot", "udpin:0", "udpout://127.0.0.1:{}")],
)
def test_mavsdk_tells_what_the_test_bed_told(tmp_path: Path, autopilot: str, link: str, url: str) -> None:
    told = FlightSettings(minutes=60.0, seed=SEED, autopilot=autopilot, system_id=7)

    async def main() -> tuple[dict[str, Any], dict[str, int]]:
        async with flying(told, link=link, speed=3.0, tlog=tmp_path / "bed.tlog") as bed:
            return await heard(url.format(bed.port), "GLOBAL_POSITION_INT", 30, *STREAMS), bed.heard

    found, asked = asyncio.run(main())
    assert (found["system"], found["autopilot"].lower(), found["components"]) == (7, autopilot, [1])
    assert found["connected"]
    assert "COMMAND_LONG" in asked  # it asks for the vehicle's version
    sent: dict[str, list[Any]] = {}
    for m in read_tlog(tmp_path / "bed.tlog"):
        sent.setdefault(m.get_type(), []).append(m)
    places = [(m.lat, m.lon, m.alt) for m in sent["GLOBAL_POSITION_INT"]]
    for one in found["position"]:
        lat, lon = round(one["latitude_deg"] * 1e7), round(one["longitude_deg"] * 1e7)
        assert (lat, lon, round(one["absolute_altitude_m"] * 1e3)) in places
    angles = {m.time_boot_ms: (m.roll, m.pitch, m.yaw) for m in sent["ATTITUDE"]}
    for one in found["attitude_euler"]:
        expected = [math.degrees(angle) for angle in angles[one["timestamp_us"] // 1000]]
        assert [one["roll_deg"], one["pitch_deg"], one["yaw_deg"]] == pytest.approx(expected, abs=1e-3)
    speeds = [(m.vx, m.vy, m.vz) for m in sent["GLOBAL_POSITION_INT"]]
    for one in found["velocity_ned"]:
        assert tuple(round(one[f"{axis}_m_s"] * 100.0) for axis in ("north", "east", "down")) in speeds
    assert found["gps_info"][-1]["fix_type"] == "FIX_3D"
    assert found["gps_info"][-1]["num_satellites"] == sent["GPS_RAW_INT"][-1].satellites_visible
    assert found["in_air"][-1] is True
    assert found["flight_mode"][-1] == "MISSION"
    assert found["health"][-1]["is_global_position_ok"]


def test_mavsdk_sees_the_engine_as_a_companion_and_its_fixes(tmp_path: Path) -> None:
    """On an output of the engine's own: a component without an autopilot, and what it sends."""
    told = FlightSettings(minutes=60.0, gnss_off_s=5.0, seed=SEED, system_id=7)

    async def main() -> tuple[dict[str, Any], dict[str, Any]]:
        async with (
            flying(told) as bed,
            navigating(f"tcp:127.0.0.1:{bed.port}", ("back", "tcpin:0")) as (live, ports),
        ):
            found = await heard(f"tcpout://127.0.0.1:{ports[-1]}", "GLOBAL_POSITION_SENSOR", 3)
            return found, live.facts()

    found, facts = asyncio.run(main())
    assert (found["system"], found["autopilot"], found["components"]) == (7, None, [191])
    for fix in found["GLOBAL_POSITION_SENSOR"]:
        assert fix["component"] == 191
        assert fix["source"] == 4  # terrain
        assert fix["eph"] >= 1.0
    assert facts["outputs"]["tcpin:0"]["sent"] >= 3

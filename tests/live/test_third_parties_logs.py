"""Logs that MAVProxy wrote of the test bed's flight, telemetry and DataFlash, opened and flown once more."""

from __future__ import annotations

import asyncio
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from terranav.app.cli import main
from terranav.io.logs import open_log
from terranav.io.raster_out import write_map
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.settings import FlightSettings
from tests.live.flights import chart
from tests.live.thirdparty.dataflash import BLOCK_BYTES, dataflash, stream
from tests.live.thirdparty.peers import Proxy, mavproxy, mavproxy_command, until
from tests.live.thirdparty.scene import SEED, flying

#: longer than is logged: who is connected to a vehicle that goes away loses what it has not read
SETTINGS = FlightSettings(minutes=10.0, gnss_off_s=1000.0, seed=SEED, autopilot="ardupilot")
LOGGED_S = 90.0


@dataclass(frozen=True)
class Logs:
    """Three logs of one flight, the DataFlash log as it was sent, and the map."""

    ours: Path
    telemetry: Path
    flash: Path
    sent: bytes
    dem: Path


def recorded(folder: Path) -> Logs:
    """The test bed flies, MAVProxy writes its telemetry and takes in the DataFlash log that the vehicle streams."""
    write_map(chart(), folder / "dem.tif")
    twin = Flight(chart(), SETTINGS)  # the same settings fly the same flight
    log = dataflash(frame for _ in range(round(LOGGED_S * 10)) for _, frame in twin.tick())
    flash = folder / "proxy" / "1.BIN"

    async def fly() -> Proxy:
        async with (
            flying(SETTINGS, tlog=folder / "bed.tlog") as bed,
            mavproxy(folder / "proxy", f"tcp:127.0.0.1:{bed.port}", commands=["module load dataflash_logger"]) as proxy,
        ):
            size = await asyncio.wait_for(stream(bed, log, LOGGED_S), 300.0)
            await until(lambda: flash.is_file() and flash.stat().st_size >= size - BLOCK_BYTES, "the .BIN is written")
            await proxy.logs("GLOBAL_POSITION_INT", count=round(10 * LOGGED_S))
        return proxy

    proxy = asyncio.run(fly())
    return Logs(folder / "bed.tlog", proxy.tlog, flash, log, folder / "dem.tif")


def replayed(logs: Logs, log: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """GNSS is withheld, and such a drift is put on the track that it had."""
    arguments = ["replay", str(log), "--map", str(logs.dem), "--gnss-off", "10-85", "--drift", "200,2,0.5"]
    assert main([*arguments, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_telemetry_and_dataflash_that_mavproxy_wrote_fly_through_replay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("jsbsim", reason="needs the extra 'fly'")
    mavproxy_command()
    logs = recorded(tmp_path)
    assert logs.flash.read_bytes()[: len(logs.sent)] == logs.sent
    for path, kind in ((logs.telemetry, "MAVLink telemetry log"), (logs.flash, "ArduPilot DataFlash log")):
        facts = open_log(path).facts
        assert facts["format"] == kind
        assert facts["whole"], facts["remarks"]
        assert facts["duration_s"] >= LOGGED_S - 0.2
        assert facts["series"]["radar"]["covers"] > 0.95

    ours, telemetry, flash = (replayed(logs, path, capsys) for path in (logs.ours, logs.telemetry, logs.flash))
    # ten times real time: its host's stamps are of no use, and the vehicle's own are the same
    assert (telemetry["verdict"], telemetry["score"]) == (ours["verdict"], ours["score"])
    # readings are rounded otherwise in a DataFlash log, and its rows come at other times
    assert flash["verdict"].split()[0] == telemetry["verdict"].split()[0]
    assert flash["score"]["unaided_m"] == pytest.approx(telemetry["score"]["unaided_m"], rel=0.02)
    assert flash["score"]["held_m"] == pytest.approx(telemetry["score"]["held_m"], rel=0.2)
    assert telemetry["score"]["held_m"] < 0.5 * telemetry["score"]["unaided_m"]

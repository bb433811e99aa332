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


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Logs:
    """The test bed flies, MAVProxy writes its telemetry and takes in the DataFlash log that the vehicle streams."""
    pytest.importorskip("jsbsim", reason="needs the extra 'fly'")
    mavproxy_command()
    folder = tmp_path_factory.mktemp("logs")
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


def test_a_tlog_that_mavproxy_wrote_flies_as_ours_does(logs: Logs, capsys: pytest.CaptureFixture[str]) -> None:
    """Ten times real time: its host's stamps are of no use, and the vehicle's own are the same."""
    ours, theirs = replayed(logs, logs.ours, capsys), replayed(logs, logs.telemetry, capsys)
    assert theirs["verdict"].startswith(("held within", "hardly helped"))
    assert (theirs["verdict"], theirs["score"]) == (ours["verdict"], ours["score"])


def test_what_mavproxy_wrote_is_what_was_sent(logs: Logs) -> None:
    assert logs.flash.read_bytes()[: len(logs.sent)] == logs.sent
    sent = [frame for _, frame in Flight(chart(), SETTINGS).tick()]
    written = logs.telemetry.read_bytes()
    assert sent
    assert all(frame in written for frame in sent)


def test_telemetry_and_dataflash_of_one_flight_give_the_same_verdict(
    logs: Logs, capsys: pytest.CaptureFixture[str]
) -> None:
    telemetry, flash = replayed(logs, logs.telemetry, capsys), replayed(logs, logs.flash, capsys)
    assert flash["verdict"].split()[0] == telemetry["verdict"].split()[0]
    assert flash["score"]["unaided_m"] == pytest.approx(telemetry["score"]["unaided_m"], rel=0.02)
    assert flash["score"]["held_m"] == pytest.approx(telemetry["score"]["held_m"], rel=0.2)
    assert telemetry["score"]["held_m"] < 0.5 * telemetry["score"]["unaided_m"]


def test_both_are_opened_whole_and_say_what_they_are(logs: Logs) -> None:
    for path, kind in ((logs.telemetry, "MAVLink telemetry log"), (logs.flash, "ArduPilot DataFlash log")):
        facts = open_log(path).facts
        assert facts["format"] == kind
        assert facts["whole"], facts["remarks"]
        assert facts["duration_s"] >= LOGGED_S - 0.2
        assert facts["series"]["radar"]["covers"] > 0.95

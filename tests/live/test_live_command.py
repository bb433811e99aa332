"""The command `terranav live`: files, wrong use, Ctrl-C, and a process that is killed."""

from __future__ import annotations

import json
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from terranav.app.cli import main
from terranav.io.raster_out import write_map
from terranav.live.recorder import FIXES, RECEIVED
from terranav.live.recordings import opened
from tests.live.flights import Flight, chart

PROGRAM = [sys.executable, "-c", "import sys; from terranav.app.cli import main; sys.exit(main())"]
INS = "100,0.7,0.5"
FLIGHT = Flight(seconds=100.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """A map and a flight."""
    folder = tmp_path_factory.mktemp("files")
    write_map(chart(), folder / "dem.tif")
    packets = FLIGHT.packets()[:2600]
    (folder / "f.tlog").write_bytes(b"".join(struct.pack(">Q", one.stamp_us) + one.data for one in packets))
    return str(folder / "dem.tif"), str(folder / "f.tlog")


def live(*arguments: str) -> int:
    return main(["live", *arguments])


def test_a_file_flies_and_its_recording_flies_the_same(
    files: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dem, tlog = files
    told = ("--map", dem, "--ins", INS, "--speed", "0")
    run, out = str(tmp_path / "run"), tmp_path / "fixes.jsonl"
    assert live("--in", f"file:{tlog}", *told, "--record", run, "--out", f"json:{out}", "--json") == 0
    first = json.loads(capsys.readouterr().out)
    assert first["fixes"] > 400
    assert first["outputs"][f"json:{out}"]["sent"] == first["usable"] > 0
    assert live("--in", f"file:{run}/{RECEIVED}", *told) == 0
    said = capsys.readouterr()
    assert f"digest     {first['digest']}" in said.out
    assert "usable " in said.out
    assert "terranav: note: reckons by velocity" in said.err
    assert live("--in", f"file:{tlog}", *told, "--seed", "5", "--json") == 0
    assert json.loads(capsys.readouterr().out)["digest"] != first["digest"]


def test_fixes_on_stdout_leave_it_to_the_fixes(files: tuple[str, str]) -> None:
    dem, tlog = files
    command = [*PROGRAM, "live", "--in", f"file:{tlog}", "--map", dem, "--ins", INS, "--speed", "0", "--out", "json:-"]
    done = subprocess.run(command, capture_output=True, check=True, timeout=120)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(lines) > 400
    assert b"terranav: note: digest: " in done.stderr


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "--in is not given, expected a link such as udpin:14550"),
        (["--in", "udpn:14550"], "unknown --in link 'udpn' (did you mean 'udpin'?)"),
        (["--in", "file:/nowhere.tlog"], "/nowhere.tlog: no such file"),
        (["--in", "udpin:14550", "--send", "px5"], "unknown message for --send 'px5'"),
        (["--in", "udpin:14550", "--by", "gnss"], "unknown ins_source 'gnss'"),
        (["--in", "udpin:14550", "--start", "here"], "--start is 'here', expected two numbers"),
        (["--in", "udpin:14550", "--sigma", "laser"], "--sigma is 'laser', expected NAME=M"),
        (["--in", "udpin:14550", "--sign-key", "/nowhere"], "/nowhere: no such file, expected a MAVLink signing key"),
        (["--in", "udpin:14550", "--resume"], "--resume needs --record DIR"),
        (["--in", "udpin:14550", "--system", "300"], "system_id is 300"),
        (["--in", "udpin:14550", "--out", "file:x"], "unknown --out link 'file'"),
    ],
)
def test_wrong_use_is_one_line_and_status_two(
    files: tuple[str, str], arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert live("--map", files[0], *arguments) == 2
    said = capsys.readouterr().err
    assert says in said
    assert len([line for line in said.splitlines() if "error" in line]) == 1
    assert "Traceback" not in said


def test_a_port_in_use_names_the_port(files: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        assert live("--map", files[0], "--in", f"udpin:{port}") == 2
    assert f"udpin:{port}: port {port} of 127.0.0.1 is in use by another program" in capsys.readouterr().err


def test_without_a_map_is_one_line(files: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    assert live("--in", f"file:{files[1]}") == 2
    assert "expected terrain or bathymetry" in capsys.readouterr().err


class Feeder(threading.Thread):
    """Sends the frames of the flight to whoever connects, in order, a little ahead of what is recorded of them."""

    def __init__(self, run: Path) -> None:
        super().__init__(daemon=True)
        self.frames, self.sent, self._run = [frame for _, frame in FLIGHT.frames()], 0, run
        self.over = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.2)
        self.port = self._listener.getsockname()[1]

    def run(self) -> None:
        while not self.over.is_set():
            try:
                peer, _ = self._listener.accept()
            except TimeoutError:
                continue
            with peer:
                self._serve(peer)

    def _serve(self, peer: socket.socket) -> None:
        first, passed = recorded(self._run), 0
        while self.sent < len(self.frames) and not self.over.is_set():
            if passed > recorded(self._run) - first + 2000:
                time.sleep(0.002)
                continue
            try:
                peer.sendall(self.frames[self.sent])
            except OSError:
                return
            passed += len(self.frames[self.sent])
            self.sent += 1


@pytest.fixture
def feeder(tmp_path: Path) -> Iterator[Feeder]:
    one = Feeder(tmp_path / "run")
    one.start()
    yield one
    one.over.set()
    one.join(5.0)


def recorded(folder: Path) -> int:
    file = folder / RECEIVED
    return file.stat().st_size if file.exists() else 0


def test_a_killed_process_goes_on_and_ctrl_c_ends_it_cleanly(
    files: tuple[str, str], feeder: Feeder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, rng = tmp_path / "run", np.random.default_rng(3)
    command = [*PROGRAM, "live", "--in", f"tcp:127.0.0.1:{feeder.port}", "--map", files[0], "--ins", INS]
    command += ["--record", str(run), "--checkpoint", "0.3"]
    size, held = 0, []
    for number in range(3):
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            size += 12_000 + int(rng.integers(0, 12_000))
            end = time.monotonic() + 60.0
            while recorded(run) < size and process.poll() is None and time.monotonic() < end:
                time.sleep(0.005)
            process.send_signal(signal.SIGKILL if number < 2 else signal.SIGINT)
            out, err = process.communicate(timeout=60)
        size = recorded(run)
        held.append([packet for packet in opened(run / RECEIVED).packets() if packet.data])
        if number:
            assert b"goes on after" in err
    assert process.returncode == 0
    assert b"digest" in out
    # what had been recorded before a kill is still there after it, and no frame came in twice
    assert held[1][: len(held[0])] == held[0]
    assert held[2][: len(held[1])] == held[1]
    places = {frame: place for place, frame in enumerate(feeder.frames)}
    order = [places[packet.data] for packet in held[2]]
    assert order == sorted(set(order))
    # the fixes are those of a run that was never killed
    summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
    assert live("--in", f"file:{run}/{RECEIVED}", "--map", files[0], "--ins", INS, "--speed", "0", "--json") == 0
    again = json.loads(capsys.readouterr().out)
    assert (again["digest"], again["fixes"]) == (summary["digest"], summary["fixes"])
    numbers = [json.loads(line)["packet"] for line in (run / FIXES).read_text(encoding="utf-8").splitlines()]
    assert len(numbers) == summary["fixes"] > 50
    assert numbers == sorted(numbers)

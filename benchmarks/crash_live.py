"""Kill -9 a live run at random moments: does it go on, how soon, how far off, and what is lost?

    python -m benchmarks.crash_live [--kills 20] [--speed 1] [--seed 0]

A flight of the test bed (extra 'fly') over the sample map, its INS left to itself, is sent over TCP on the loopback
address to `terranav live --record DIR`, which is killed and started again. The flight goes on meanwhile.
Printed for each kill: what was sent last before it against what is recorded, how long after it was heard again the
first fix and the first usable one came (in flight time), and the error of that fix over its 1-sigma. At the end the
recording is replayed in one go: it must give the digest of the run that was killed.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terranav.core.earth import offset_of
from terranav.io.raster_out import write_map
from terranav.live.recorder import FIXES, RECEIVED
from terranav.live.recordings import opened
from terranav.live.testbed.flight import Flight
from terranav.live.testbed.settings import FlightSettings
from terranav.live.testbed.telemetry import BOOT_US
from terranav.maps.sample_dem import sample_map

_INS = "200,1,1"
_PROGRAM = (sys.executable, "-c", "import sys; from terranav.app.cli import main; sys.exit(main())")


class Flown:
    """A flight of the test bed, computed beforehand: frames by flight time, and the truth."""

    def __init__(self, minutes: float, seed: int) -> None:
        flight = Flight(
            sample_map(), FlightSettings(minutes=minutes, gnss_off_s=0.0, reports="ins", seed=seed), record=True
        )
        start_us = flight.settings.start_us
        self.frames = [((sent.time_us - start_us) * 1e-6, sent.data) for sent in flight]
        self._truth = flight.recording()

    def away_m(self, t: float, lat_deg: float, lon_deg: float) -> float:
        """How far a place lies from the truth at a flight time [m]."""
        true = self._truth.columns
        lat, lon = (float(np.interp(t, true["time_s"], true[key])) for key in ("true_lat_deg", "true_lon_deg"))
        return float(np.hypot(*offset_of(lat, lon, lat_deg, lon_deg)))


class Server(threading.Thread):
    """Flies a flight at a speed and sends it to whoever is connected; what is sent meanwhile is lost.

    Attributes
    ----------
    sent : list of (wall [s], flight time [s])
        What went to a connection.
    reached : list of float
        Flight time of the first frame of each connection, NaN until there is one.
    """

    def __init__(self, flight: Flown, speed: float) -> None:
        super().__init__(daemon=True)
        self.flight, self.speed = flight, speed
        self.sent: list[tuple[float, float]] = []
        self.reached: list[float] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.001)
        self.port: int = self._listener.getsockname()[1]
        self.over = threading.Event()
        self._peer: socket.socket | None = None

    def run(self) -> None:
        """Wait for the first connection, then fly."""
        while self._peer is None and not self.over.is_set():
            self._accept()
        began = time.time()
        for number, (t, frame) in enumerate(self.flight.frames):
            if self.over.is_set():
                break
            wait = t / self.speed - (time.time() - began)
            if wait > 0.0005:
                time.sleep(wait)
            if self._peer is None and number % 50 == 0:
                self._accept()
            self._send(t, frame)
        self.over.set()
        if self._peer is not None:
            self._peer.close()

    def heard_again(self, connections: int) -> bool:
        """Whether someone came after so many connections, and was sent something."""
        return len(self.reached) > connections and not np.isnan(self.reached[-1])

    def _accept(self) -> None:
        try:
            self._peer, _ = self._listener.accept()
        except TimeoutError:
            return
        self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.reached.append(float("nan"))

    def _send(self, t: float, frame: bytes) -> None:
        if self._peer is None:
            return
        try:
            self._peer.sendall(frame)
        except OSError:
            self._peer.close()
            self._peer = None
            return
        if np.isnan(self.reached[-1]):
            self.reached[-1] = t
        self.sent.append((time.time(), t))


@dataclass(frozen=True)
class Kill:
    """What one kill did."""

    at_s: float  # flight time of what was sent last
    lost_s: float  # of flight time, not in the recording
    outage_s: float  # until it was heard again
    first_fix_s: float  # after that, in flight time
    first_usable_s: float
    error_m: float  # of the first fix after it
    sigma_m: float
    error_before_m: float  # of the last fix before it
    sigma_before_m: float


def started(port: int, folder: Path, dem: Path) -> subprocess.Popen[bytes]:
    """The program, in a process of its own."""
    command = [*_PROGRAM, "live", "--in", f"tcp:127.0.0.1:{port}", "--map", str(dem)]
    command += ["--ins", _INS, "--record", str(folder)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def fixes_of(folder: Path, flight: Flown) -> list[dict[str, Any]]:
    """Every whole line of the fixes so far, with flight time and error."""
    found = []
    for line in (folder / FIXES).read_bytes().split(b"\n")[:-1]:
        fix = json.loads(line)
        if fix["boot_us"] is None:
            continue
        t = (fix["boot_us"] - BOOT_US) * 1e-6
        fix["t"], fix["error_m"] = t, flight.away_m(t, fix["lat_deg"], fix["lon_deg"])
        found.append(fix)
    return found


def crash_run(folder: Path, kills: int, speed: float, seed: int, waits: tuple[float, float]) -> Iterator[Kill]:
    """Kill a run at random moments, so many real seconds after it was heard again; raises where it does not go on."""
    rng = np.random.default_rng(seed)
    dem = folder / "dem.tif"
    write_map(sample_map(), dem)
    run = folder / "run"
    flight = Flown((speed * (kills + 1) * (waits[1] + 12.0) + 100.0) / 60.0, seed)
    server = Server(flight, speed)
    server.start()
    process = started(server.port, run, dem)
    _await(lambda: bool(server.sent), process, 60.0)
    pending: tuple[float, float, dict[str, Any]] | None = None
    # no fix is expected at once the first time: give the navigator time to find itself
    time.sleep(40.0 / speed)
    try:
        for number in range(kills + 1):
            time.sleep(float(rng.uniform(*waits)))
            process.send_signal(signal.SIGKILL if number < kills else signal.SIGINT)
            killed_wall = time.time()
            process.wait(60)
            found = fixes_of(run, flight)
            if pending is not None:
                yield _judged(pending, found, server.reached[-1])
            if number == kills:
                break
            last_sent = max(t for wall, t in server.sent if wall <= killed_wall)
            recorded = [packet.stamp_us * 1e-6 for packet in opened(run / RECEIVED).packets() if packet.data]
            lost = last_sent - max(t for wall, t in server.sent if wall <= recorded[-1])
            pending = (last_sent, max(lost, 0.0), found[-1])
            count = len(server.reached)
            process = started(server.port, run, dem)
            _await(functools.partial(server.heard_again, count), process, 60.0)
    finally:
        server.over.set()
        if process.poll() is None:
            process.kill()
        if process.stderr is not None:
            process.stderr.close()


def _await(true: Any, process: subprocess.Popen[bytes], limit_s: float) -> None:
    """Wait until something is true, as long as the program runs."""
    end = time.time() + limit_s
    while not true():
        if process.poll() is not None:
            said = process.stderr.read().decode() if process.stderr is not None else ""
            raise RuntimeError(f"the program ended with {process.returncode}: {said}")
        if time.time() > end:
            raise RuntimeError("nothing came for too long")
        time.sleep(0.01)


def _judged(pending: tuple[float, float, dict[str, Any]], found: Sequence[dict[str, Any]], heard_s: float) -> Kill:
    """What became of one kill, seen from the next."""
    at_s, lost_s, before = pending
    after = [fix for fix in found if fix["t"] >= heard_s - 0.3]
    usable = [fix for fix in after if fix["usable"]]
    first = after[0] if after else None
    return Kill(
        at_s,
        lost_s,
        heard_s - at_s,
        first["t"] - heard_s if first else float("inf"),
        usable[0]["t"] - heard_s if usable else float("inf"),
        first["error_m"] if first else float("nan"),
        float(np.hypot(*first["sigma_m"])) if first else float("nan"),
        before["error_m"],
        float(np.hypot(*before["sigma_m"])),
    )


def replayed_digest(folder: Path) -> tuple[str, str]:
    """The digest of the run that was killed, and of its recording replayed in one go."""
    told = json.loads((folder / "run" / "summary.json").read_text(encoding="utf-8"))["digest"]
    command = [*_PROGRAM, "live", "--in", f"file:{folder / 'run' / RECEIVED}", "--speed", "0"]
    command += ["--map", str(folder / "dem.tif"), "--ins", _INS, "--json"]
    done = subprocess.run(command, capture_output=True, check=True)
    return told, str(json.loads(done.stdout)["digest"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    told = parser.parse_args()
    print("   at s   lost s  outage s  first fix s  usable s   before m (sigma)    after m (sigma)")
    kills = []
    with tempfile.TemporaryDirectory() as name:
        for one in crash_run(Path(name), told.kills, told.speed, told.seed, (6.0, 14.0)):
            kills.append(one)
            before, after = (one.error_before_m, one.sigma_before_m), (one.error_m, one.sigma_m)
            print(f"{one.at_s:7.1f} {one.lost_s:8.2f} {one.outage_s:9.1f} {one.first_fix_s:12.2f}", end="")
            print(
                "{:10.2f} {:9.1f} ({:5.1f}) {:10.1f} ({:5.1f})".format(one.first_usable_s, *before, *after), flush=True
            )
        whole, again = replayed_digest(Path(name))
    n = len(kills)
    within = sum(one.first_fix_s <= 5.0 for one in kills)
    beyond = sum(one.error_m > 3.0 * one.sigma_m for one in kills)
    print(
        f"a fix within 5 s of data: {within} of {n}; a usable one: {sum(k.first_usable_s <= 5.0 for k in kills)} of {n}"
    )
    print(f"first fix after it beyond three sigma: {beyond} of {n}")
    print(f"recording lost at most {max(one.lost_s for one in kills):.2f} s")
    print(f"digest of the run and of its replay: {'equal' if whole == again else 'DIFFERENT'}")
    sys.exit(0 if within == n and not beyond and whole == again else 1)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()

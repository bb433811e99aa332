"""One engine with the count and digest of what came of it: the same whether packets come from links or from a file."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from terranav.core.earth import shifted
from terranav.core.errors import ConfigError, DataError, StateError, TerranavError
from terranav.core.records import Epoch, Measurement
from terranav.live import checkpoints
from terranav.live.engine import Engine
from terranav.live.navigator import Navigator
from terranav.live.recorder import RECEIVED, chained
from terranav.live.recordings import opened, walk
from terranav.live.records import Fix, Packet, Remark
from terranav.live.settings import LiveSettings
from terranav.maps.map import Map

_KEPT_DELAYS = 20_000
_WARM_S = 150


class Session:
    """Feeds an engine.

    Parameters
    ----------
    settings : LiveSettings
    maps : sequence of Map

    Attributes
    ----------
    engine : Engine
    packets, fixes, usable, faults : int
    digest : bytes
        Over all fixes so far (`recorder.chained`).
    first_us, last_us : int
        Stamps of the first and the latest packet.
    newest : Fix or None
    """

    def __init__(self, settings: LiveSettings, maps: Sequence[Map]) -> None:
        self._settings, self._maps = settings, maps
        self.engine = Engine(settings, maps)
        self.packets = self.fixes = self.usable = self.faults = 0
        self.digest = bytes(32)
        self.first_us = self.last_us = 0
        self.newest: Fix | None = None
        self._failed_by: set[type[Exception]] = set()

    def take(self, packet: Packet) -> list[Fix | Remark]:
        """Feed one packet; a failure of the engine costs what came of it, and its kind is remarked on once."""
        self.packets += 1
        self.first_us = self.first_us or packet.stamp_us
        self.last_us = packet.stamp_us
        try:
            said = self.engine.feed(packet)
        except Exception as problem:  # noqa: BLE001 - in flight nothing that comes in may end the program
            self.faults += 1
            if type(problem) in self._failed_by:
                return []
            self._failed_by.add(type(problem))
            text = f"the engine failed at packet {self.packets}: {type(problem).__name__}: {problem}"
            return [Remark(packet.stamp_us, "error", "engine fault", " ".join(text.split()))]
        for one in said:
            if isinstance(one, Fix):
                self.fixes += 1
                self.usable += one.usable
                self.digest = chained(self.digest, one)
                self.newest = one
        return said

    def warm(self) -> None:
        """Load and compile what the first fix would wait for, on an engine that is thrown away."""
        if self.fixes or not self._maps:
            return
        chart = self._maps[0]
        lat0, lon0 = chart.centre_deg
        with suppress(TerranavError):
            navigator = Navigator(self._settings, self._maps)
            # long enough to find itself: what watches a fix runs only once there is one
            for second in range(_WARM_S):
                lat, lon = shifted(lat0, lon0, 50.0 * (second - 0.5 * _WARM_S), 0.0)
                value = float(chart.sample(lat, lon))
                reading = (Measurement(chart.kind, value, 3.0),) if math.isfinite(value) else ()
                navigator.step(Epoch(float(second), lat, lon, 0.0, (50.0, 0.0, 0.0), (0.0, 0.0, 0.0), reading))

    def saved(self, received_bytes: int) -> tuple[dict[str, Any], bytes]:
        """What a checkpoint holds, for a recording that is so long now."""
        facts = {
            "received_bytes": received_bytes,
            "packets": self.packets,
            "fixes": self.fixes,
            "usable": self.usable,
            "faults": self.faults,
            "digest": self.digest.hex(),
            "first_us": self.first_us,
            "last_us": self.last_us,
        }
        return facts, self.engine.checkpoint()

    def _restore(self, facts: dict[str, Any], data: bytes) -> int:
        """Go on from a checkpoint; where in the recording."""
        engine = Engine.resumed(self._settings, self._maps, data)
        for key in ("packets", "fixes", "usable", "faults", "first_us", "last_us"):
            setattr(self, key, int(facts[key]))
        self.digest = bytes.fromhex(facts["digest"])
        self.engine = engine
        return int(facts["received_bytes"])

    def resume(self, folder: Path, remarks: list[str]) -> Resumed:
        """Go on from the newest checkpoint that can be used, and from what was recorded after it.

        So the session is as if it had never stopped, whatever checkpoint it came from; with none, all of the recording
        is worked through again.

        Raises
        ------
        ConfigError
            The checkpoints are of other settings or maps.
        DataError
            There is no recording to go on from.
        """
        recording = opened(folder / RECEIVED)
        if recording.kind != "received":
            raise DataError(f"{recording.path}: is a {recording.kind}, expected a recording of terranav live")
        size, start, found = recording.path.stat().st_size, recording.start, 0
        alien: ConfigError | None = None
        for facts, data in checkpoints.usable(folder, remarks):
            try:
                if int(facts["received_bytes"]) > size:
                    raise DataError("the recording ends before it")
                start, found = self._restore(facts, data), int(facts["packets"])
                break
            except ConfigError as problem:
                alien = problem
                remarks.append(f"a checkpoint is of another run ({problem}), the one before it is taken")
            except (DataError, StateError, KeyError, ValueError, TypeError) as problem:
                remarks.append(f"a checkpoint cannot be used ({problem}), the one before it is taken")
        if alien is not None and not found:
            raise alien
        return Resumed(self, recording.path, recording.links, start, found)

    def facts(self) -> dict[str, Any]:
        """Counts of the run, with what the engine knows."""
        return {
            "packets": self.packets,
            "duration_s": (self.last_us - self.first_us) * 1e-6,
            "fixes": self.fixes,
            "usable": self.usable,
            "usable_share": self.usable / self.fixes if self.fixes else None,
            "faults": self.faults,
            "digest": self.digest.hex(),
            "engine": self.engine.facts,
        }


class Resumed:
    """A session that goes on: works through what was recorded after the checkpoint.

    Attributes
    ----------
    links : tuple of str
        Of the recording.
    checkpoint : int
        Packets that the checkpoint stood for, 0 where there was none.
    end_bytes : int
        Where the last whole record of the recording ends, once all is worked through.
    """

    def __init__(self, session: Session, path: Path, links: tuple[str, ...], start: int, checkpoint: int) -> None:
        self._session, self._path = session, path
        self.links, self.checkpoint, self.end_bytes = links, checkpoint, start

    def catch_up(self, remarks: list[str]) -> Iterator[tuple[Packet, list[Fix | Remark]]]:
        """Feed the rest of the recording; each packet, and what was said."""
        with self._path.open("rb") as stream:
            stream.seek(self.end_bytes)
            for packet, end in walk(stream, remarks):
                self.end_bytes = end
                yield packet, self._session.take(packet)


class Delays:
    """Percentiles of the latest delays."""

    def __init__(self) -> None:
        self._kept: deque[float] = deque(maxlen=_KEPT_DELAYS)
        self.count = 0

    def add(self, seconds: float) -> None:
        """One delay [s]."""
        self._kept.append(seconds)
        self.count += 1

    def facts(self) -> dict[str, float | int] | None:
        """Median, 95th and 99th percentile and the largest of the latest delays [ms]; None before any."""
        if not self._kept:
            return None
        values = 1000.0 * np.array(self._kept)
        p50, p95, p99 = np.percentile(values, [50, 95, 99]).tolist()
        return {"p50_ms": p50, "p95_ms": p95, "p99_ms": p99, "max_ms": float(values.max()), "of": len(values)}

"""What a live run listens to, sends and writes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from terranav.core.checks import finite, unknown_name
from terranav.core.errors import ConfigError
from terranav.live.links import Address
from terranav.live.outputs import RATES_HZ
from terranav.live.recorder import RECEIVED
from terranav.live.recordings import Opened


@dataclass(frozen=True)
class Plan:
    """What a run listens to, sends and writes.

    Attributes
    ----------
    inputs, outputs : tuple of Address
    send : str, optional
        'px4', 'ardupilot', 'gps-input' or 'reset'; else what the autopilot's heartbeat asks for.
    folder : Path, optional
        Where the run is recorded, with its checkpoints.
    fresh : bool
        Begin anew in a folder that holds a run; its files are removed.
    speed : float
        Of files: 1 as it was recorded, 0 as fast as it goes.
    max_age_s : float
        No older measurement is sent (5 s for resets).
    rate_hz : float, optional
        Of MAVLink and NMEA outputs, instead of their own.
    correlation_s : float
        See `outgoing.Pace`.
    checkpoint_s : float
        Between checkpoints.
    key : bytes, optional
        Sign what is sent, and refuse what is not signed.
    stop_after_s : float, optional
        Stop by itself.
    """

    inputs: tuple[Address, ...]
    outputs: tuple[Address, ...] = ()
    send: str | None = None
    folder: Path | None = None
    fresh: bool = False
    speed: float = 1.0
    max_age_s: float = 1.0
    rate_hz: float | None = None
    correlation_s: float = 10.0
    checkpoint_s: float = 3.0
    key: bytes | None = None
    stop_after_s: float | None = None

    def __post_init__(self) -> None:
        if not self.inputs:
            raise ConfigError("--in is not given, expected a link such as udpin:14550 or file:flight.tlog")
        if self.send is not None and self.send not in RATES_HZ:
            unknown_name("message for --send", self.send, RATES_HZ)
        finite("--speed", self.speed, minimum=0.0)
        finite("--max-age", self.max_age_s, above=0.0, maximum=5.0)
        finite("--correlation", self.correlation_s, minimum=0.0, maximum=600.0)
        finite("--checkpoint", self.checkpoint_s, minimum=0.1)
        if self.rate_hz is not None:
            finite("--rate", self.rate_hz, above=0.0, maximum=50.0)
        if self.stop_after_s is not None:
            finite("--seconds", self.stop_after_s, above=0.0)
        wires = [address for address in self.inputs if address.wire != "file"]
        if any(address.wire == "back" for address in self.outputs) and not wires:
            raise ConfigError("--out back: no --in link can be answered, expected one that is no file")

    def numbered(self, files: list[Opened]) -> Iterator[tuple[int, Address, Opened | None]]:
        """The inputs, each with its first link number; a recording has as many links as it was made of."""
        number, rest = 0, iter(files)
        for address in self.inputs:
            source = next(rest) if address.wire == "file" else None
            yield number, address, source
            number += len(source.links) if source is not None else 1

    def links(self, files: list[Opened]) -> tuple[str, ...]:
        """The links by number, as typed; those of a recording as they were typed then."""
        names: list[str] = []
        for _, address, source in self.numbered(files):
            names += [name or address.text for name in source.links] if source is not None else [address.text]
        return tuple(names)

    def check_folder(self, files: list[Opened]) -> None:
        """Raise ConfigError where recording would destroy what is read, or an older run that was not asked to go."""
        folder = self.folder
        if folder is None or not (folder / RECEIVED).exists():
            return
        source = next((one.path for one in files if one.path.resolve().parent == folder.resolve()), None)
        if source is not None:
            raise ConfigError(f"--record {folder}: holds {source.name}, which is read; expected another folder")
        if files and not self.fresh:
            raise ConfigError(f"--record {folder}: holds a run; give another folder, or --fresh to remove that run")

    def check_resume(self, asked: bool) -> None:
        """Raise ConfigError where a run is to go on that is not there."""
        if not asked:
            return
        if self.folder is None or self.fresh:
            raise ConfigError("--resume needs --record DIR with the run to go on with, and no --fresh")
        if not (self.folder / RECEIVED).exists():
            raise ConfigError(f"--resume: {self.folder} holds no run to go on with, expected {RECEIVED} in it")

"""From a log and maps to a verdict: would matching with the map have held the position without GNSS?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from terranav.app.console import OK, as_json, show, show_json, show_pairs, width, working
from terranav.core.errors import ConfigError

if TYPE_CHECKING:
    from terranav.app.replay_words import Flight
    from terranav.experiment.replay import Withheld
    from terranav.io.logs import Log
    from terranav.maps.geoid import Geoid
    from terranav.maps.map import Map

_HEAD_BYTES = 4096
REPLAY = "replay.json"


@dataclass(frozen=True)
class Typed:
    """What `terranav replay` was asked for beside the log and the maps.

    Attributes
    ----------
    withheld : Withheld
    estimator : str
    settings : mapping
        Of the estimator.
    seed : int
    spacing_cells : float
        A reading is used once the vehicle has moved by so much of the finest map's cell since the last that was.
    geoid : sequence of Geoid
        For heights that count from other datums than the maps.
    out : Path or None
        An existing folder.
    json : bool
    command : str
        As it was typed.
    """

    withheld: Withheld
    estimator: str = "marginalized"
    settings: Mapping[str, Any] | None = None
    seed: int = 0
    spacing_cells: float = 0.5
    geoid: Sequence[Geoid] = ()
    out: Path | None = None
    json: bool = False
    command: str = ""


def open_any(path: Path, *, rate_hz: float = 10.0, columns: Path | None = None, imu: bool = False) -> Log:
    """Open a log of any kind, a recording, or a table with its columns file.

    Raises
    ------
    DataError, ConfigError
        One line that names the file and what was expected.
    """
    from terranav.experiment.replay import as_log
    from terranav.io.logs import open_log
    from terranav.io.recordings import read_recording

    if columns is not None:
        from terranav.io.tables import convert_table

        return as_log(convert_table(path, columns))
    if _is_recording(path):
        return as_log(read_recording(path))
    return open_log(path, rate_hz=rate_hz, imu=imu)


def _is_recording(path: Path) -> bool:
    """Whether a file is a recording of terranav's own, by its first bytes."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError:
        return False  # open_log says what is wrong
    if head.startswith(b"PAR1"):
        return True
    names = {name.strip().strip('"') for name in head.split(b"\n", 1)[0].decode("utf-8", "replace").split(",")}
    return b"\0" not in head and {"time_s", "lat_deg", "lon_deg"} <= names


def spans_from(text: str) -> str | float | list[tuple[float, float]]:
    """What --gnss-off means: 'auto', 'take-off', a time, or spans START-END with commas between [s]."""
    if text in ("auto", "take-off"):
        return text
    expected = "take-off, a time in s, or START-END,START-END,... in s since the log began"
    try:
        if "-" not in text.lstrip("-"):
            return _seconds(text)
        pairs = [part.split("-") for part in text.split(",")]
        return [(_seconds(start), _seconds(end)) for start, end in pairs]
    except ValueError:
        raise ConfigError(f"--gnss-off is {text!r}, expected {expected}") from None


def _seconds(text: str) -> float:
    """A time >= 0, or ValueError."""
    value = float(text)
    if not 0.0 <= value < 1e12:
        raise ValueError(text)
    return value


def replay(log: Log, maps: tuple[Map, ...], typed: Typed) -> int:
    """Take GNSS away, navigate, aid with the maps, score, write and show; return the exit status."""
    from terranav.app.flying import Wanted, fly, with_baseline
    from terranav.app.replay_words import Flight, denied_pairs, log_pairs
    from terranav.experiment.replay import spaced, withhold

    if not typed.json:
        show_pairs(log_pairs(log))
    if not maps:
        raise ConfigError("--map is not given, expected a map of what the log measured")
    with working("taking GNSS away"):
        spacing_m = typed.spacing_cells * min(chart.cell_m for chart in maps)
        denied = [spaced(one, spacing_m) for one in withhold(log, typed.withheld)]
    if not typed.json:
        show_pairs(denied_pairs(denied))
    methods = with_baseline([typed.estimator], typed.settings)
    wanted = Wanted(typed.out, typed.json, 0.0, typed.command, typed.estimator)
    same: dict[str, Any] = {"methods": methods, "seed": typed.seed, "wanted": wanted, "geoid": typed.geoid}
    flights = [Flight(one, fly(one.recording, maps, one.recording.ins, **same)) for one in denied]
    return _conclude(log, flights, typed)


def _conclude(log: Log, flights: Sequence[Flight], typed: Typed) -> int:
    """Save the results first, draw after, and show what came out."""
    from rich.text import Text

    from terranav.app.flying import save
    from terranav.app.replay_page import write_page
    from terranav.app.replay_words import as_json as summary_of
    from terranav.app.replay_words import verdict
    from terranav.app.tables import facts, rich_table
    from terranav.io.files import replacing

    status, pages = OK, []
    summary = summary_of(log, flights, typed.command)
    if typed.out is not None:
        folders = [typed.out / (f"span-{i}" if len(flights) > 1 else "") for i in range(1, len(flights) + 1)]
        for flight, spanned, folder in zip(flights, summary["spans"], folders, strict=True):
            folder.mkdir(exist_ok=True)
            save(flight.outcome, spanned, folder)
        with replacing(typed.out / REPLAY) as path:
            path.write_text(as_json(summary) + "\n", encoding="utf-8")
        status = max(write_page(log, flight, folder) for flight, folder in zip(flights, folders, strict=True))
        pages = [folder / "report.html" for folder in folders]
    if typed.json:
        show_json(summary)
        return status
    for flight in flights:
        show_pairs(facts(flight.outcome))
        show(rich_table(flight.outcome, width()))
    show(Text(verdict(flights), style="bold"))
    if status == OK and pages:
        show(Text(f"report: {', '.join(map(str, pages))}"))
    return status
